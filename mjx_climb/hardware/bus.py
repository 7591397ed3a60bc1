"""Imperfections of a signal: delay, rounding, and sampling once in a control period.

Every function works on the samples of one signal of any shape; a signal is sampled once in a time step.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_climb.arrays import Tree
from mjx_climb.component import Component
from mjx_climb.parameter_types import ROUNDING, whole_steps
from mjx_climb.scenario import declared
from mjx_climb.scenario.model import MAX_DELAY

_MULTIPLE = 4  # lengths of buffers are rounded up to it, so that other delays seldom need another program
Buffer = tuple[Array, ...]  # samples, newest first


class Bus(declared.Bus, Component):
    """The bus between law and joints, and the seed of all noise.

    `interpolation` of joint targets between two control periods: "hold", or "linear".
    """

    interpolation: str = "hold"


def buffer_length(delay: ArrayLike, time_step: float) -> int:
    """Return how long a buffer the longest of some delays in s needs, 0 where there is none.

    Raises:
        ValueError: a delay of more than 500 time steps.
    """
    longest = float(np.max(np.asarray(delay), initial=0.0)) / time_step
    if longest == 0:
        return 0
    if not longest <= MAX_DELAY:
        raise ValueError(f"delay: expected at most {MAX_DELAY} time steps of {time_step:g} s, got {longest:g}")
    return -(-(int(longest * (1 + 2 * ROUNDING)) + 2) // _MULTIPLE) * _MULTIPLE


def weights(steps: Array, length: int) -> Buffer:
    """Return how much of each sample of a buffer makes up the signal as it was `steps` () time steps ago.

    Between samples the signal is linear, so that the delay has a derivative: at a whole number of steps the one towards
    longer delays. A delay beyond the buffer is cut to the buffer's length.
    """
    steps = jnp.minimum(steps, length - 1)
    whole = jax.lax.stop_gradient(jnp.floor(steps * (1 + ROUNDING)))
    part = steps - whole
    return tuple(jnp.where(whole == age, 1 - part, jnp.where(whole == age - 1, part, 0.0)) for age in range(length))


def delayed(buffer: Buffer, value: Array, weights: Buffer) -> tuple[Buffer, Array]:
    """Return the buffer with the newest sample, and the late signal, see `weights`."""
    buffer = (value, *buffer[:-1])
    return buffer, sum((weight * sample for weight, sample in zip(weights, buffer, strict=True)), jnp.zeros_like(value))


def rounded(value: Array, resolution: Array) -> Array:
    """Return the nearest multiples of the resolution, the value itself where that is 0; the derivative is that of none.

    A staircase is flat wherever it has a derivative: searches would take the sensor for a blind one.
    """
    unit = jnp.where(resolution > 0, resolution, 1.0)
    return value + jnp.where(resolution > 0, jax.lax.stop_gradient(unit * jnp.round(value / unit) - value), 0.0)


def period_steps(period: Array, time_step: float) -> Array:
    """Return how many time steps a control period in s has, at least one."""
    return jnp.maximum(whole_steps(period, time_step), 1.0)


def steps_into(step: Array, steps: Array) -> Array:
    """Return how many steps ago the current control period of so many `steps` began: 0 where the law is evaluated."""
    number = step.astype(steps.dtype)
    # half a step in, so that rounding cannot put the first step of a period into the last
    return number - steps * jnp.floor((number + 0.5) / steps)


def held(now: Array, new: Tree, before: Tree) -> Tree:
    """Return `new` where the law is evaluated `now` (), else its last result; trees of arrays."""

    def choose(fresh: Array, old: Array) -> Array:
        # a value that a law hands on unchanged stays the same, and a loop over steps need not carry it
        return old if fresh is old else jnp.where(now, fresh, old)

    result: Tree = jax.tree.map(choose, new, before)
    return result
