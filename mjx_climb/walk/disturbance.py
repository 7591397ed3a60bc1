"""What the world does to the base: cargo and pushes, each in its window of time."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.quantities.parameters import Parameters, whole_steps


class Windows(NamedTuple):
    """The steps in which disturbances act: from the first one on, until before the second."""

    cargo: tuple[Array, Array]  # () each
    pushes: tuple[Array, Array]  # (push,)


def windows(parameters: Parameters, time_step: float) -> Windows:
    """Return the windows of a walk in time steps of `time_step` s."""
    cargo, pushes = (parameters.cargo_start, parameters.cargo_stop), (parameters.push_start, parameters.push_stop)
    return Windows(*(tuple(whole_steps(time, time_step) for time in times) for times in (cargo, pushes)))


def _active(window: tuple[Array, Array], step: Array) -> Array:
    start, stop = window
    return (step >= start) & (step < stop)


def cargo_mass(parameters: Parameters, windows: Windows, step: Array) -> Array:
    """Return the cargo on the base, () kg."""
    return jnp.where(_active(windows.cargo, step), parameters.cargo_mass, 0.0)


def push(parameters: Parameters, windows: Windows, step: Array) -> Array:
    """Return force and moment on the base at its centre of mass, (6,) N and N m, world axes."""
    active = _active(windows.pushes, step)[:, None]
    wrenches = jnp.concatenate([parameters.push_force, parameters.push_moment], axis=1)
    return jnp.where(active, wrenches, 0.0).sum(0)
