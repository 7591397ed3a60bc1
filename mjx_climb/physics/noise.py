"""Noise made by counting: the same bits for a seed, a sample and a channel, in any batch, on any device."""

import math

import jax.numpy as jnp
from jax import Array

_PARTS = 8  # of 16 bits each, two to a word
# a sum of uniform numbers (Irwin-Hall): the variance of one from 0 to n - 1 is (n^2 - 1) / 12
_MEAN = _PARTS * (2**16 - 1) / 2
_DEVIATION = math.sqrt(_PARTS * (2.0**32 - 1) / 12)
_GOLDEN = 0x9E3779B9  # 2^32 / golden ratio: neighbouring counts fall far apart


def normal(seed: Array, sample: Array, channels: Array, dtype: jnp.dtype) -> Array:
    """Return noise of mean 0 and variance 1 in the shape of `channels`.

    The sum of eight uniform numbers: its excess kurtosis is -0.15, it ends at 4.9 standard deviations, and it is
    exact in integers up to its scale. `sample` is the number of the time step; `channels` are whole numbers, one for
    each independent signal.
    """
    word = _mixed(seed.astype(jnp.uint32) + jnp.uint32(_GOLDEN))
    word = _mixed(word ^ sample.astype(jnp.uint32))
    word = _mixed(word ^ (channels.astype(jnp.uint32) * jnp.uint32(_GOLDEN)))
    total = jnp.zeros_like(word)
    for _ in range(_PARTS // 2):
        word = _mixed(word + jnp.uint32(_GOLDEN))
        total = total + (word >> jnp.uint32(16)) + (word & jnp.uint32(0xFFFF))
    return jnp.asarray((total.astype(dtype) - _MEAN) * (1 / _DEVIATION))


def _mixed(word: Array) -> Array:
    """32 bits, each dependent on every bit of `word`, by invertible multiplications and shifts.

    The constants are those of Wellons' `lowbias32` (2018), found by search for the least bias.
    """
    word = (word ^ (word >> jnp.uint32(16))) * jnp.uint32(0x7FEB352D)
    word = (word ^ (word >> jnp.uint32(15))) * jnp.uint32(0x846CA68B)
    return jnp.asarray(word ^ (word >> jnp.uint32(16)))
