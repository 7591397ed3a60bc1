"""What the world does to the base: cargo and pushes, each in its window of time."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.quantities.parameters import Parameters


def _active(start: Array | np.ndarray, stop: Array | np.ndarray, step: Array, time_step: float) -> Array:
    """Tell whether a step lies in [start, stop), both rounded to whole steps."""
    return (step >= jnp.round(start / time_step)) & (step < jnp.round(stop / time_step))


def cargo_mass(numbers: Parameters, step: Array, time_step: float) -> Array:
    """Return the cargo on the base, (B,) kg."""
    return jnp.where(_active(numbers.cargo_start, numbers.cargo_stop, step, time_step), numbers.cargo_mass, 0.0)


def push(numbers: Parameters, step: Array, time_step: float) -> Array:
    """Return force and moment on the base at its centre of mass, (6, B) N and N m, world axes."""
    if not numbers.push_start.size:  # XLA cannot compile pieces of a step that work on nothing, see `kernels`
        return jnp.zeros((6, 1), numbers.push_force.dtype)
    active = _active(numbers.push_start, numbers.push_stop, step, time_step)
    force, moment = (jnp.asarray(value) for value in (numbers.push_force, numbers.push_moment))
    if force.shape != moment.shape:  # one of them varies from environment to environment
        force, moment = jnp.broadcast_arrays(force, moment)
    wrenches = jnp.concatenate([force, moment], axis=1)
    return jnp.where(active[:, None], wrenches, 0.0).sum(0)
