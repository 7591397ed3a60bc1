"""A metric: one number of a walk, accumulated from its samples so that a batch needs no memory over time."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, SupportsIndex, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.robot.constants import Robot
from mjx_climb.walk.sample import Sample

PREFIX = "smooth_"  # of the name of a companion
Value = Callable[[Sample, "Context"], Array]  # of one sample


class Context(NamedTuple):
    """What a metric may know beside a sample: what stays the same all through a walk, and how far this has come."""

    robot: Robot  # as heavy as it is in this walk
    gravity: Array | np.ndarray  # (3,) m/s^2
    heading: Array | np.ndarray  # () rad
    time_step: float | Array  # s
    first: Array | bool = True  # () whether this is the first sample
    diverged: Array | bool = False  # () whether an earlier sample was not finite


def _as_it_is(running: Array, _: Context) -> Array:
    return running


@dataclasses.dataclass(frozen=True)
class Metric:
    """One number of a walk of one robot, with its name, unit and meaning, and how it comes from the samples.

    A running value is an array or a tree of them, and keeps its shapes and types. Samples from the first one on that is
    not finite are left out.
    """

    name: str  # in mappings, options and files
    unit: str  # "1" where there is none
    long_name: str  # for people: on pictures, in tables
    larger_is_better: bool  # of two walks the one with more is the better one
    init: Callable[[Array], Any]  # of a zero (): the running value before the first sample
    update: Callable[[Any, Sample, Context], Any]  # the running value with one more sample
    # the metric () of the last running value, itself where there is no function; NaN where it is not defined
    finish: Callable[[Any, Context], Array] = _as_it_is
    smooth: "Metric | None" = None  # its companion for searches that follow gradients; in place of an extreme
    scale: float | None = None  # how much counts as much, in its unit, where values pass through zero

    def __reduce_ex__(self, protocol: SupportsIndex) -> Any:
        """A shipped one is pickled by its name, as its functions have none; one's own by its fields."""
        from mjx_climb.walk.metrics.shipped import METRICS, shipped

        own = all(metric is not self for metric in METRICS.with_companions)
        return super().__reduce_ex__(protocol) if own else (shipped, (self.name,))


def total(name: str, unit: str, long_name: str, value: Value, *, larger_is_better: bool = False) -> Metric:
    """Return the metric that integrates a value () of each sample over time: `unit` is the value's times s."""
    return Metric(
        name,
        unit,
        long_name,
        larger_is_better,
        init=lambda zero: zero,
        update=lambda running, sample, context: running + value(sample, context) * context.time_step,
    )


class MetricTable(tuple[Metric, ...]):
    """Metrics in order, immutable: `table + (mine,)` is a longer one, `table["travel"]` one metric by its name.

    Raises:
        ValueError: two metrics of one name, a name that no variable of Python could have, or something else than
            metrics.
    """

    __slots__ = ()

    def __new__(cls, metrics: Iterable[Metric]) -> "MetricTable":
        table = super().__new__(cls, metrics)
        seen: set[str] = set()
        for metric in table:
            if not isinstance(metric, Metric):
                raise ValueError(f"metrics: expected objects of mjx_climb.Metric, got {metric!r}")
            if not metric.name.isidentifier():
                raise ValueError(f"metric {metric.name!r}: expected a name of letters, digits and underscores")
            if metric.name in seen:
                raise ValueError(f"metric {metric.name}: expected one of this name, got two")
            seen.add(metric.name)
        return table

    @property
    def names(self) -> tuple[str, ...]:
        """The names in order."""
        return tuple(metric.name for metric in self)

    def in_words(self, name: str) -> str:
        """Return what a metric is called for people, on pictures, in tables and in sentences."""
        return self[name].long_name if name in self.names else name.replace("_", " ")

    @property
    def with_companions(self) -> "MetricTable":
        """The table with the smooth companions of its metrics behind them, as a search uses it."""
        return self + tuple(metric.smooth for metric in self if metric.smooth is not None)

    @overload  # type: ignore[override]  # a name too
    def __getitem__(self, index: int | str) -> Metric: ...

    @overload
    def __getitem__(self, index: slice) -> "MetricTable": ...

    def __getitem__(self, index: int | str | slice) -> "Metric | MetricTable":
        if isinstance(index, str):
            if index not in self.names:
                raise KeyError(f"metric {index}: expected one of {', '.join(self.names)}")
            return self[self.names.index(index)]
        found = super().__getitem__(index)
        return found if isinstance(found, Metric) else MetricTable(found)

    def __add__(self, others: Iterable[Metric]) -> "MetricTable":  # type: ignore[override]  # lists too
        return MetricTable((*self, *others))

    def __repr__(self) -> str:
        return f"MetricTable({', '.join(self.names)})"


# --- metrics of a walk under way: they take in one sample after the other, up to the last one that is finite


class Running(NamedTuple):
    """Running values of metrics."""

    steps: Array  # (), how many samples came
    finite: Array  # (), how many of them came before the first that is not finite
    values: tuple[Any, ...]  # of the metrics, in their order


def start(metrics: MetricTable, dtype: jnp.dtype) -> Running:
    """Return the values of a walk that has not begun."""
    none = jnp.zeros((), jnp.int32)
    return Running(
        none, none, tuple(jax.tree.map(jnp.asarray, metric.init(jnp.zeros((), dtype))) for metric in metrics)
    )


def accumulate(metrics: MetricTable, running: Running, sample: Sample, context: Context) -> Running:
    """Return the values with one more sample of the walk; they stay as they are from one that is not finite on.

    Raises:
        ValueError: a metric whose running value changes its structure, its shapes or its types.
    """
    context = context._replace(first=running.steps == 0, diverged=running.finite < running.steps)
    # a sum is not finite as soon as one of its terms is not: cheaper than asking each
    base = (sample.base_position + sample.base_linear_velocity + sample.base_angular_velocity).sum()
    joints = (sample.joint_angles + sample.joint_rates + sample.joint_torque).sum()
    taken = ~context.diverged & jnp.isfinite(base + joints + sample.foot_force.sum())

    def choose(old: Array, new: Array) -> Array:
        result = jnp.where(taken, new, old)
        if result.shape != old.shape or result.dtype != old.dtype:
            expected, got = (f"{v.dtype} {v.shape}" for v in (old, result))
            raise ValueError(f"metric {metric.name}: expected `update` to keep {expected}, got {got}")
        return result

    values = []
    for metric, value in zip(metrics, running.values, strict=True):
        updated = metric.update(value, sample, context)
        before: Any = jax.tree.structure(value)
        if before != jax.tree.structure(updated):
            raise ValueError(f"metric {metric.name}: expected `update` to return a value structured as `init` does")
        values.append(jax.tree.map(choose, value, updated))
    return Running(running.steps + 1, running.finite + taken, tuple(values))


def finish(metrics: MetricTable, running: Running, context: Context) -> dict[str, Array]:
    """Return the metrics () of a walk that has ended; a walk without a finite sample has NaN for all real ones.

    Raises:
        ValueError: a metric that is not one number.
    """
    context = context._replace(first=running.steps == 0, diverged=running.finite < running.steps)
    result = {}
    for metric, value in zip(metrics, running.values, strict=True):
        found = jnp.asarray(metric.finish(value, context))
        if found.shape:
            raise ValueError(f"metric {metric.name}: expected `finish` to return one number, got shape {found.shape}")
        real = jnp.issubdtype(found.dtype, jnp.floating)
        result[metric.name] = jnp.where(running.finite > 0, found, jnp.nan) if real else found
    return result
