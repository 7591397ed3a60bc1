"""Metrics that are extremes over a walk, with their smooth companions.

A plain maximum has a derivative almost everywhere, but one that sees a single instant and jumps where another instant
takes over. The power mean of order 32 over all instants (and feet, or joints) tends to the maximum, to within some
ten per cent, and sees every instant close to it. Of what may be negative the companion is a log-sum-exp mean in units
of a hundredth of the first value. They serve searches that follow gradients; results are reported with the true
extremes.
"""

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient

from mjx_climb.walk.chosen import larger, largest_row, smaller, smallest_row
from mjx_climb.walk.metrics.metric import Context, Metric, Value
from mjx_climb.walk.metrics.table import PREFIX
from mjx_climb.walk.sample import Sample

_SQUARINGS = 5
ORDER = 2**_SQUARINGS
_SHARPNESS = 100.0


def peak(name: str, unit: str, long_name: str, value: Value) -> Metric:
    """Return the metric that is the largest over time of a value that is never negative, and should be small.

    `value` of a sample and the context is (..., B): the largest over its leading axes counts.
    """
    return Metric(
        name,
        unit,
        long_name,
        larger_is_better=False,
        init=lambda zero: zero,
        update=lambda running, sample, context: larger(running, _best(largest_row, value(sample, context))),
        finish=lambda running, _: running,
        smooth=Metric(
            PREFIX + name,
            unit,
            f"{long_name}, smooth",
            larger_is_better=False,
            init=lambda zero: _Mean(zero, zero + 1, zero, zero),
            update=lambda mean, sample, context: _with_large(mean, value(sample, context)),
            finish=lambda mean, _: _power_mean(mean),
        ),
    )


def smallest(
    name: str, unit: str, long_name: str, value: Value, *, larger_is_better: bool = True, scale: float | None = None
) -> Metric:
    """Return the metric that is the smallest over time of a value of either sign; `value` as of `peak`."""
    return Metric(
        name,
        unit,
        long_name,
        larger_is_better,
        init=lambda zero: zero + jnp.inf,
        update=lambda running, sample, context: smaller(running, _best(smallest_row, value(sample, context))),
        finish=lambda running, _: running,
        smooth=Metric(
            PREFIX + name,
            unit,
            f"{long_name}, smooth",
            larger_is_better,
            init=lambda zero: _Mean(zero + jnp.inf, zero, zero, zero),
            update=lambda mean, sample, context: _with_small(mean, value(sample, context)),
            finish=lambda mean, _: _soft_minimum(mean),
        ),
        scale=scale,
    )


def largest(
    name: str, unit: str, long_name: str, value: Value, *, larger_is_better: bool = False, scale: float | None = None
) -> Metric:
    """Return the metric that is the largest over time of a value of either sign; `value` as of `peak`."""

    def negative(sample: Sample, context: Context) -> Array:
        return -value(sample, context)

    mirrored = smallest(name, unit, long_name, negative, larger_is_better=larger_is_better, scale=scale)
    assert mirrored.smooth is not None
    return dataclasses.replace(_negated(mirrored), smooth=_negated(mirrored.smooth))


def _negated(metric: Metric) -> Metric:
    finish: Callable[..., Array] = metric.finish
    return dataclasses.replace(metric, finish=lambda running, context: -finish(running, context))


def _best(row: Callable[[Array], Array], values: Array) -> Array:
    """Return the best (B,) of values (..., B), axis after axis: `row` gives that of the first one."""
    while values.ndim > 1:
        values = row(values)
    return values


def _leading(values: Array) -> tuple[int, ...]:
    return tuple(range(values.ndim - 1))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Mean:
    """A running mean of scaled powers or exponentials, each (B,); no derivative goes through `extreme` and `unit`."""

    extreme: Array  # so far; keeps the powers and exponentials between 0 and 1
    unit: Array  # of the exponentials
    total: Array
    count: Array


def _power(value: Array) -> Array:
    for _ in range(_SQUARINGS):
        value = value * value
    return value


def _with_large(mean: _Mean, values: Array) -> _Mean:
    extreme = jnp.maximum(stop_gradient(mean.extreme), stop_gradient(values).max(_leading(values)))
    scale = jnp.where(extreme > 0, extreme, 1.0)
    total = mean.total * _power(mean.extreme / scale) + _power(values / scale).sum(_leading(values))
    return _Mean(extreme, mean.unit, total, mean.count + math.prod(values.shape[:-1]))


def _with_small(mean: _Mean, values: Array) -> _Mean:
    first = mean.count == 0
    least = stop_gradient(values).min(_leading(values))
    unit = jnp.where(first, jnp.maximum(jnp.abs(least), 1e-6) / _SHARPNESS, mean.unit)
    extreme = jnp.minimum(stop_gradient(mean.extreme), least)
    before = jnp.where(first, 0.0, mean.total * jnp.exp((extreme - jnp.where(first, extreme, mean.extreme)) / unit))
    return _Mean(
        extreme,
        unit,
        before + jnp.exp((extreme - values) / unit).sum(_leading(values)),
        mean.count + math.prod(values.shape[:-1]),
    )


def _share(mean: _Mean) -> tuple[Array, Array]:
    """Return the mean of the powers or exponentials, 1 where it is zero, and where it is not."""
    share = mean.total / mean.count
    some = share > 0
    return jnp.where(some, share, 1.0), some


def _power_mean(mean: _Mean) -> Array:
    share, some = _share(mean)
    return jnp.where(some, mean.extreme * share ** (1 / ORDER), 0.0)


def _soft_minimum(mean: _Mean) -> Array:
    share, _ = _share(mean)
    return mean.extreme - mean.unit * jnp.log(share)
