"""Metrics of a walk under way: they take in one sample after the other, up to the last one that is finite."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.walk.metrics.metric import Context, Metric, MetricTable
from mjx_climb.walk.sample import Sample


class Running(NamedTuple):
    """Running values of metrics."""

    steps: Array  # (), how many samples came
    finite: Array  # (), how many of them came before the first that is not finite
    values: tuple[Any, ...]  # of the metrics, in their order


def start(metrics: MetricTable, dtype: jnp.dtype) -> Running:
    """Return the values of a walk that has not begun."""
    values = tuple(jax.tree.map(jnp.asarray, metric.init(jnp.zeros((), dtype))) for metric in metrics)
    return Running(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32), values)


def accumulate(metrics: MetricTable, running: Running, sample: Sample, context: Context) -> Running:
    """Return the values with one more sample of the walk; they stay as they are from one that is not finite on.

    Raises:
        ValueError: a metric whose running value changes its structure, its shapes or its types.
    """
    context = _now(running, context)
    # a sum is not finite as soon as one of its terms is not: cheaper than asking each
    base = (sample.base_position + sample.base_linear_velocity + sample.base_angular_velocity).sum()
    joints = (sample.joint_angles + sample.joint_rates + sample.joint_torque).sum()
    taken = ~context.diverged & jnp.isfinite(base + joints + sample.foot_force.sum())
    values = tuple(
        _updated(metric, value, sample, context, taken) for metric, value in zip(metrics, running.values, strict=True)
    )
    return Running(running.steps + 1, running.finite + taken, values)


def finish(metrics: MetricTable, running: Running, context: Context) -> dict[str, Array]:
    """Return the metrics () of a walk that has ended; a walk without a finite sample has NaN for all real ones.

    Raises:
        ValueError: a metric that is not one number.
    """
    context = _now(running, context)
    result = {}
    for metric, value in zip(metrics, running.values, strict=True):
        found = jnp.asarray(metric.finish(value, context))
        if found.shape:
            raise ValueError(f"metric {metric.name}: expected `finish` to return one number, got shape {found.shape}")
        real = jnp.issubdtype(found.dtype, jnp.floating)
        result[metric.name] = jnp.where(running.finite > 0, found, jnp.nan) if real else found
    return result


def _now(running: Running, context: Context) -> Context:
    return context._replace(first=running.steps == 0, diverged=running.finite < running.steps)


def _updated(metric: Metric, value: Any, sample: Sample, context: Context, taken: Array) -> Any:
    updated = metric.update(value, sample, context)
    before: Any = jax.tree.structure(value)
    if before != jax.tree.structure(updated):
        raise ValueError(f"metric {metric.name}: expected `update` to return a value structured as `init` does")

    def choose(old: Array, new: Array) -> Array:
        result = jnp.where(taken, new, old)
        if result.shape != old.shape or result.dtype != old.dtype:
            expected, got = (f"{v.dtype} {v.shape}" for v in (old, result))
            raise ValueError(f"metric {metric.name}: expected `update` to keep {expected}, got {got}")
        return result

    return jax.tree.map(choose, value, updated)
