"""Metrics that are extremes over a walk, with their smooth companions.

A plain maximum has a derivative almost everywhere, but one that sees a single instant and jumps where another instant
takes over. The power mean of order 32 over all instants (and feet, or joints) tends to the maximum, to within some
ten per cent, and sees every instant close to it. Of what may be negative the companion is a log-sum-exp mean in units
of a hundredth of the first value. They serve searches that follow gradients; results are reported with the true
extremes.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient

from mjx_climb.walk.metrics.metric import PREFIX, Metric, Value

_SQUARINGS = 5
ORDER = 2**_SQUARINGS
_SHARPNESS = 100.0


def peak(name: str, unit: str, long_name: str, value: Value) -> Metric:
    """Return the metric that is the largest over time of a value that is never negative, and should be small.

    `value` of a sample and the context may have any shape: the largest of its elements counts.
    """
    return _with_companion(_metric(_PEAK, value, name, unit, long_name, False), _POWER_MEAN, value)


def smallest(
    name: str, unit: str, long_name: str, value: Value, *, larger_is_better: bool = True, scale: float | None = None
) -> Metric:
    """Return the metric that is the smallest over time of a value of either sign; `value` as of `peak`."""
    metric = _metric(_SMALLEST, value, name, unit, long_name, larger_is_better)
    return _with_companion(dataclasses.replace(metric, scale=scale), _SOFT_MINIMUM, value)


def largest(
    name: str, unit: str, long_name: str, value: Value, *, larger_is_better: bool = False, scale: float | None = None
) -> Metric:
    """Return the metric that is the largest over time of a value of either sign; `value` as of `peak`."""
    metric = _metric(_LARGEST, value, name, unit, long_name, larger_is_better)
    return _with_companion(dataclasses.replace(metric, scale=scale), _SOFT_MAXIMUM, value)


class _Reduction(NamedTuple):
    """How the values of one sample after the other become one number."""

    init: Callable[[Array], Any]  # of a zero ()
    take: Callable[[Any, Array], Any]  # the running value and the values of a sample
    finish: Callable[[Any], Array]


def _metric(
    reduction: _Reduction, value: Value, name: str, unit: str, long_name: str, larger_is_better: bool
) -> Metric:
    return Metric(
        name,
        unit,
        long_name,
        larger_is_better,
        init=reduction.init,
        update=lambda running, sample, context: reduction.take(running, value(sample, context)),
        finish=lambda running, _: reduction.finish(running),
    )


def _with_companion(metric: Metric, reduction: _Reduction, value: Value) -> Metric:
    name, long_name = PREFIX + metric.name, f"{metric.long_name}, smooth"
    smooth = _metric(reduction, value, name, metric.unit, long_name, metric.larger_is_better)
    return dataclasses.replace(metric, smooth=smooth)


class _Mean(NamedTuple):
    """A running mean of scaled powers or exponentials, each (); no derivative goes through `extreme` and `unit`."""

    extreme: Array  # so far; keeps the powers and exponentials between 0 and 1
    unit: Array  # of the exponentials
    total: Array
    number: Array  # of values


def _power(value: Array) -> Array:
    for _ in range(_SQUARINGS):
        value = value * value
    return value


def _with_large(mean: _Mean, values: Array) -> _Mean:
    extreme = jnp.maximum(stop_gradient(mean.extreme), jnp.max(stop_gradient(values)))
    scale = jnp.where(extreme > 0, extreme, 1.0)
    total = mean.total * _power(mean.extreme / scale) + jnp.sum(_power(values / scale))
    return _Mean(extreme, mean.unit, total, mean.number + values.size)


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


_PEAK = _Reduction(lambda zero: zero, lambda running, v: jnp.maximum(running, jnp.max(v)), lambda running: running)
_LARGEST = _PEAK._replace(init=lambda zero: zero - jnp.inf)
_SMALLEST = _Reduction(
    lambda zero: zero + jnp.inf, lambda running, v: jnp.minimum(running, jnp.min(v)), lambda running: running
)
_POWER_MEAN = _Reduction(lambda zero: _Mean(zero, zero + 1, zero, zero), _with_large, _power_mean)
_SOFT_MINIMUM = _Reduction(lambda zero: _Mean(zero + jnp.inf, zero, zero, zero), _with_small, _soft_minimum)
_SOFT_MAXIMUM = _Reduction(_SOFT_MINIMUM.init, lambda mean, v: _with_small(mean, -v), lambda mean: -_soft_minimum(mean))
