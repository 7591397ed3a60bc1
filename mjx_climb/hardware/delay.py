"""A signal that comes late, by a time that need not be whole steps: a buffer of fixed length, read between samples."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_climb.quantities.whole_steps import ROUNDING
from mjx_climb.scenario.hardware import MAX_DELAY

_MULTIPLE = 4  # lengths are rounded up to it, so that drawing other delays seldom needs another program


def samples(delay: ArrayLike, time_step: float) -> int:
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


def start(value: Array, length: int) -> tuple[Array, ...]:
    """Return the buffer of a signal that has always been `value` (..., B), newest sample first."""
    return (value,) * length


def weights(steps: Array, length: int) -> tuple[Array, ...]:
    """Return how much of each sample (B,) of a buffer makes up the signal as it was `steps` (B,) steps ago.

    Between samples the signal is linear, so that the delay has a derivative: at a whole number of steps the one towards
    longer delays. A delay beyond the buffer is cut to what the buffer holds.
    """
    steps = jnp.minimum(steps, length - 1)
    whole = jax.lax.stop_gradient(jnp.floor(steps * (1 + ROUNDING)))
    part = steps - whole
    return tuple(jnp.where(whole == age, 1 - part, jnp.where(whole == age - 1, part, 0.0)) for age in range(length))


def delayed(buffer: tuple[Array, ...], value: Array, weights: tuple[Array, ...]) -> tuple[tuple[Array, ...], Array]:
    """Return the buffer with the newest sample, and the late signal, see `weights`."""
    buffer = (value, *buffer[:-1])
    return buffer, sum((weight * sample for weight, sample in zip(weights, buffer, strict=True)), jnp.zeros_like(value))
