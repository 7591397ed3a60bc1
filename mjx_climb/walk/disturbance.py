"""What the world does to the base: cargo and pushes, each in its window of time."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.quantities.parameters import Parameters
from mjx_climb.quantities.whole_steps import whole_steps


class Window(NamedTuple):
    """The steps in which something acts: from the first on, until before the second."""

    start: Array  # (..., B) steps
    stop: Array  # (..., B) steps


class Windows(NamedTuple):
    """When disturbances act."""

    cargo: Window  # (B,)
    pushes: Window  # (pushes, B)


def windows(numbers: Parameters, time_step: float) -> Windows:
    """Return the windows of a walk in time steps of `time_step` s."""
    cargo, pushes = (numbers.cargo_start, numbers.cargo_stop), (numbers.push_start, numbers.push_stop)
    return Windows(*(Window(*(whole_steps(time, time_step) for time in times)) for times in (cargo, pushes)))


def _active(window: Window, step: Array) -> Array:
    return (step >= window.start) & (step < window.stop)


def cargo_mass(numbers: Parameters, window: Window, step: Array) -> Array:
    """Return the cargo on the base, (B,) kg."""
    return jnp.where(_active(window, step), numbers.cargo_mass, 0.0)


def push(numbers: Parameters, window: Window, step: Array) -> Array:
    """Return force and moment on the base at its centre of mass, (6, B) N and N m, world axes."""
    if not numbers.push_start.size:  # XLA cannot compile pieces of a step that work on nothing, see `kernels`
        return jnp.zeros((6, 1), numbers.push_force.dtype)
    active = _active(window, step)
    force, moment = (jnp.asarray(value) for value in (numbers.push_force, numbers.push_moment))
    if force.shape != moment.shape:  # one of them varies from environment to environment
        force, moment = jnp.broadcast_arrays(force, moment)
    wrenches = jnp.concatenate([force, moment], axis=1)
    return jnp.where(active[:, None], wrenches, 0.0).sum(0)
