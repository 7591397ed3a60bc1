"""Cargo and pushes on the base, each in its window of time."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.parameter_types import Parameters, whole_steps


class Windows(NamedTuple):
    """The steps in which disturbances act: from the first one on, until before the second."""

    cargo: tuple[Array, Array]  # () each
    pushes: tuple[Array, Array]  # (push,)


def windows(parameters: Parameters, time_step: float) -> Windows:
    """Return the windows of a walk in time steps of `time_step` s."""
    cargo, pushes = (parameters.cargo_start, parameters.cargo_stop), (parameters.push_start, parameters.push_stop)
    return Windows(*(tuple(whole_steps(time, time_step) for time in times) for times in (cargo, pushes)))


def acting(parameters: Parameters, windows: Windows, step: Array) -> tuple[Array, Array]:
    """Return the cargo at the base's centre of mass, () kg, and force and moment there, (6,) N and N m, world axes."""
    loaded, pushed = ((step >= start) & (step < stop) for start, stop in windows)
    wrenches = jnp.concatenate([parameters.push_force, parameters.push_moment], axis=1)
    cargo = jnp.where(loaded, parameters.cargo_mass, 0.0)
    return cargo, jnp.where(pushed[:, None], wrenches, 0.0).sum(0)
