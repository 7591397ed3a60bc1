"""Metrics that are extremes over a walk, with their smooth companions.

A plain maximum has a derivative almost everywhere, but one that sees a single instant and jumps where another instant
takes over. The power mean of order 32 over all instants (and feet, or joints) tends to the maximum, to within some
ten per cent, and sees every instant close to it. Of what may be negative the companion is a log-sum-exp mean in units
of a hundredth of the first value. They serve searches that follow gradients; results are reported with the true
extremes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient

from mjx_climb.walk.metrics.metric import PREFIX, Context, Metric, Value
from mjx_climb.walk.sample import Sample

_SQUARINGS = 5
ORDER = 2**_SQUARINGS
_SHARPNESS = 100.0


# how the values of one sample after the other become one number: `init`, `update` and `finish` of a metric
_Reduction = tuple[Callable[[Array], Any], Callable[[Any, Array], Any], Callable[[Any], Array]]


def peak(name: str, unit: str, long_name: str, value: Value) -> Metric:
    """Return the metric that is the largest over time of a value that is never negative, and should be small.

    `value` of a sample and the context may have any shape: the largest of its elements counts.
    """
    return _extreme((name, unit, long_name, False), value, _PEAK, _POWER_MEAN)


def smallest(
    name: str, unit: str, long_name: str, value: Value, *, larger_is_better: bool = True, scale: float | None = None
) -> Metric:
    """Return the metric that is the smallest over time of a value of either sign; `value` as of `peak`."""
    return _extreme((name, unit, long_name, larger_is_better), value, _SMALLEST, _SOFT_MINIMUM, scale)


def largest(
    name: str, unit: str, long_name: str, value: Value, *, larger_is_better: bool = False, scale: float | None = None
) -> Metric:
    """Return the metric that is the largest over time of a value of either sign; `value` as of `peak`."""
    return _extreme((name, unit, long_name, larger_is_better), value, _LARGEST, _SOFT_MAXIMUM, scale)


def _extreme(
    about: tuple[str, str, str, bool], value: Value, plain: _Reduction, smooth: _Reduction, scale: float | None = None
) -> Metric:
    def update(reduction: _Reduction) -> Callable[[Any, Sample, Context], Any]:
        return lambda running, sample, context: reduction[1](running, value(sample, context))

    name, unit, long_name, better = about
    companion = Metric(
        PREFIX + name, unit, f"{long_name}, smooth", better, smooth[0], update(smooth), lambda mean, _: smooth[2](mean)
    )
    return Metric(*about, plain[0], update(plain), smooth=companion, scale=scale)


class _Mean(NamedTuple):
    """A running mean of scaled powers or exponentials, each (); no derivative goes through `extreme` and `unit`."""

    extreme: Array  # so far; keeps the powers and exponentials between 0 and 1
    unit: Array  # of the exponentials
    total: Array
    number: Array  # of values


def _with_large(mean: _Mean, values: Array) -> _Mean:
    extreme = jnp.maximum(stop_gradient(mean.extreme), jnp.max(stop_gradient(values)))
    scale = jnp.where(extreme > 0, extreme, 1.0)
    before, powers = mean.extreme / scale, values / scale
    for _ in range(_SQUARINGS):
        before, powers = before * before, powers * powers
    return _Mean(extreme, mean.unit, mean.total * before + jnp.sum(powers), mean.number + values.size)


def _with_small(mean: _Mean, values: Array) -> _Mean:
    first = mean.number == 0
    least = jnp.min(stop_gradient(values))
    unit = jnp.where(first, jnp.maximum(jnp.abs(least), 1e-6) / _SHARPNESS, mean.unit)
    extreme = jnp.minimum(stop_gradient(mean.extreme), least)
    before = jnp.where(first, 0.0, mean.total * jnp.exp((extreme - jnp.where(first, extreme, mean.extreme)) / unit))
    total = before + jnp.sum(jnp.exp((extreme - values) / unit))
    return _Mean(extreme, unit, total, mean.number + values.size)


def _power_mean(mean: _Mean) -> Array:
    share = mean.total / mean.number
    some = share > 0
    return jnp.where(some, mean.extreme * jnp.where(some, share, 1.0) ** (1 / ORDER), 0.0)


def _soft_minimum(mean: _Mean) -> Array:
    share = mean.total / mean.number
    return mean.extreme - mean.unit * jnp.log(jnp.where(share > 0, share, 1.0))


_PEAK: _Reduction = (lambda zero: zero, lambda running, v: jnp.maximum(running, jnp.max(v)), lambda running: running)
_LARGEST = (lambda zero: zero - jnp.inf, *_PEAK[1:])
_SMALLEST: _Reduction = (lambda zero: zero + jnp.inf, lambda running, v: jnp.minimum(running, jnp.min(v)), _PEAK[2])
_POWER_MEAN: _Reduction = (lambda zero: _Mean(zero, zero + 1, zero, zero), _with_large, _power_mean)
_SOFT_MINIMUM: _Reduction = (lambda zero: _Mean(zero + jnp.inf, zero, zero, zero), _with_small, _soft_minimum)
_SOFT_MAXIMUM: _Reduction = (_SOFT_MINIMUM[0], lambda mean, v: _with_small(mean, -v), lambda mean: -_soft_minimum(mean))
