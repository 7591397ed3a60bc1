"""The metrics of a walk: the type, the shipped ones in one table, and their accumulation over a walk.

A plain extreme has a derivative almost everywhere, but one that sees a single instant and jumps where another instant
takes over. So each has a smooth companion. The power mean of order 32 over all instants (and feet, or joints) tends to
the maximum, to within some ten per cent, and sees every instant close to it. Of signed values the companion is a
log-sum-exp mean in units of a hundredth of the first value. They serve searches that follow gradients; results are
reported with the true extremes.
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, SupportsIndex, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import PyTree

from mjx_climb.control.sensor_watch import SILENCE
from mjx_climb.physics.spatial import norm
from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.sample import Sample

PREFIX = "smooth_"  # of the name of a companion
# how a walk failed, or its law: nothing to better
FAILURES = (
    "detached_at",
    "detached_limb",
    "missed_grips",
    "stands_at",
    "diverged",
    "sensor_lost_at",
    "sensor_lost_limb",
)
_SQUARINGS = 5  # the order of a power mean is 2**5
_SHARPNESS = 100.0
Value = Callable[[Sample, "Context"], Array]  # of one sample
# how the values of one sample after the other become one number: `init`, `update` and `finish` of a metric
_Reduction = tuple[Callable[[Array], PyTree], Callable[[PyTree, Array], PyTree], Callable[[PyTree], Array]]
_Way = tuple[Array, Array]  # where the base was at the first sample, and at this one, (2,) m each
_Transport = tuple[Array, Array, _Way]  # work, J, largest mass so far, kg, and the way


class Context(NamedTuple):
    """Inputs of a metric beside a sample: constants of a walk, and its progress."""

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
    init: Callable[[Array], PyTree]  # of a zero (): the running value before the first sample
    update: Callable[[PyTree, Sample, Context], PyTree]  # the running value with one more sample
    # the metric () of the last running value, itself where there is no function; NaN where it is not defined
    finish: Callable[[PyTree, Context], Array] = _as_it_is
    smooth: "Metric | None" = None  # its companion for searches that follow gradients; in place of an extreme
    scale: float | None = None  # how much counts as much, in its unit, where values pass through zero

    def __reduce_ex__(self, protocol: SupportsIndex) -> str | tuple[object, ...]:
        """A shipped one is pickled by its name, as its functions have none; your own by its fields."""
        own = all(metric is not self for metric in (*METRICS.with_companions, *SENSORS, *GRIPS))
        return super().__reduce_ex__(protocol) if own else (_shipped, (self.name,))


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
        """Return the long name of a metric, for pictures, tables and sentences."""
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


# --- constructors of metrics: integrals and extremes over time


def total(name: str, unit: str, long_name: str, value: Value, *, larger_is_better: bool = False) -> Metric:
    """Return the metric that integrates a value () of each sample over time: `unit` is the value's times s."""
    return Metric(
        name, unit, long_name, larger_is_better,
        init=lambda zero: zero,
        update=lambda running, sample, context: running + value(sample, context) * context.time_step,
    )  # fmt: skip


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
    def update(reduction: _Reduction) -> Callable[[PyTree, Sample, Context], PyTree]:
        return lambda running, sample, context: reduction[1](running, value(sample, context))

    name, unit, long_name, better = about
    about_smooth = PREFIX + name, unit, f"{long_name}, smooth", better
    companion = Metric(*about_smooth, smooth[0], update(smooth), lambda mean, _: smooth[2](mean))
    return Metric(*about, plain[0], update(plain), smooth=companion, scale=scale)


class _Mean(NamedTuple):
    """A running mean of scaled powers or exponentials, each (); no derivative goes through `extreme` and `unit`."""

    extreme: Array  # so far; keeps the powers and exponentials between 0 and 1
    unit: Array  # of the exponentials
    total: Array
    number: Array  # of values


def _with_powers(mean: _Mean, values: Array) -> _Mean:
    # powers of shares of the largest value so far: between 0 and 1, they do not overflow
    extreme = jnp.maximum(stop_gradient(mean.extreme), jnp.max(stop_gradient(values)))
    scale = jnp.where(extreme > 0, extreme, 1.0)
    before, powers = mean.extreme / scale, values / scale
    for _ in range(_SQUARINGS):
        before, powers = before * before, powers * powers
    return _Mean(extreme, mean.unit, mean.total * before + jnp.sum(powers), mean.number + values.size)


def _with_exponentials(mean: _Mean, values: Array) -> _Mean:
    first = mean.number == 0
    least = jnp.min(stop_gradient(values))
    # a first value near zero gives no unit: 1e-6 takes its place
    unit = jnp.where(first, jnp.maximum(jnp.abs(least), 1e-6) / _SHARPNESS, mean.unit)
    extreme = jnp.minimum(stop_gradient(mean.extreme), least)
    before = jnp.where(first, 0.0, mean.total * jnp.exp((extreme - jnp.where(first, extreme, mean.extreme)) / unit))
    return _Mean(extreme, unit, before + jnp.sum(jnp.exp((extreme - values) / unit)), mean.number + values.size)


def _power_mean(mean: _Mean) -> Array:
    share = mean.total / mean.number
    some = share > 0
    return jnp.where(some, mean.extreme * jnp.where(some, share, 1.0) ** (1 / 2**_SQUARINGS), 0.0)


def _soft_minimum(mean: _Mean) -> Array:
    share = mean.total / mean.number
    return mean.extreme - mean.unit * jnp.log(jnp.where(share > 0, share, 1.0))


_PEAK: _Reduction = (lambda zero: zero, lambda running, v: jnp.maximum(running, jnp.max(v)), lambda running: running)
_LARGEST = (lambda zero: zero - jnp.inf, *_PEAK[1:])
_SMALLEST: _Reduction = (lambda zero: zero + jnp.inf, lambda running, v: jnp.minimum(running, jnp.min(v)), _PEAK[2])
_POWER_MEAN: _Reduction = (lambda zero: _Mean(zero, zero + 1, zero, zero), _with_powers, _power_mean)
_SOFT_MINIMUM: _Reduction = (
    lambda zero: _Mean(zero + jnp.inf, zero, zero, zero), _with_exponentials, _soft_minimum
)  # fmt: skip
_SOFT_MAXIMUM: _Reduction = (
    _SOFT_MINIMUM[0], lambda mean, v: _with_exponentials(mean, -v), lambda mean: -_soft_minimum(mean)
)  # fmt: skip


# --- the shipped metrics


def foot_forces(sample: Sample, _: Context) -> Array:
    """Return the sizes of the foot forces, (limb,) N."""
    return jnp.asarray(norm(sample.foot_force))


def _pull_forces(sample: Sample, context: Context) -> Array:
    """Return the sizes of the foot forces where the ground pulls a supporting foot to itself, else 0, (limb,) N."""
    pulled = (sample.foot_force * sample.ground_normal).sum(1) < 0
    return jnp.where(sample.support & pulled, foot_forces(sample, context), 0.0)


def _joint_limit_margins(sample: Sample, context: Context) -> Array:
    """Return how far the joints are from the nearer of their limits, (limb, joint) rad; negative beyond."""
    robot = context.robot
    return jnp.minimum(sample.joint_angles - robot.joint_lower, robot.joint_upper - sample.joint_angles)


def _way_begun(zero: Array) -> _Way:
    nowhere = jnp.stack([zero, zero])
    return nowhere, nowhere


def _longer_way(way: _Way, sample: Sample, context: Context) -> _Way:
    here = sample.base_position[:2]
    return jnp.where(context.first, here, way[0]), here


def _travel(way: _Way, context: Context) -> Array:
    moved = way[1] - way[0]
    return jnp.cos(context.heading) * moved[0] + jnp.sin(context.heading) * moved[1]


def _more_transport(running: _Transport, sample: Sample, context: Context) -> _Transport:
    """Return the transport with one more sample; each joint's power counts as positive."""
    work, mass, way = running
    power = jnp.abs(sample.joint_torque * sample.joint_rates).sum()
    mass = jnp.maximum(mass, context.robot.total_mass + sample.cargo_mass)
    return work + power * context.time_step, mass, _longer_way(way, sample, context)


def _cost_of_transport(running: _Transport, context: Context) -> Array:
    """Return work by weight and travel; without gravity, or without travel, there is none: NaN."""
    work, mass, way = running
    # the paper does not define its average: work over weight times travel (docs/explanation/departures.md, 13)
    weight_travel = mass * norm(jnp.asarray(context.gravity)) * jnp.abs(_travel(way, context))
    defined = weight_travel > 0
    return jnp.where(defined, work / jnp.where(defined, weight_travel, 1.0), jnp.nan)


def _more_variation(running: tuple[Array, Array], sample: Sample, context: Context) -> tuple[Array, Array]:
    """Return by how much the largest foot force has varied, and its value now, N."""
    total, last = running
    force = jnp.max(foot_forces(sample, context))
    return total + jnp.where(context.first, 0.0, jnp.abs(force - last)), force


def _first_limb(limb: Array, happens: Array) -> Array:
    """Return the limb that something happens to first, of several in one step the first in their order; -1: none."""
    limbs = len(happens)
    one = jnp.min(jnp.where(happens, jnp.arange(limbs, dtype=limb.dtype), limbs))
    return jnp.where((limb < 0) & (one < limbs), one, limb)


def _larger_gap(running: tuple[Array, Array], sample: Sample, _: Context) -> tuple[Array, Array]:
    gap, missed = running
    return jnp.where(missed, gap, jnp.maximum(gap, sample.grip_gap.max())), missed | sample.missed.any()


METRICS = MetricTable(
    (
        peak("peak_foot_force", "N", "peak foot force", foot_forces),
        Metric(
            "force_variation", "N", "force variation", larger_is_better=False,
            init=lambda zero: (zero, zero), update=_more_variation, finish=lambda running, _: running[0],
        ),
        peak("peak_pull_force", "N", "peak pull force", _pull_forces),
        peak("peak_utilization", "1", "peak utilization of a grip's limit", lambda sample, _: sample.utilization),
        peak("peak_joint_torque", "N m", "peak joint torque", lambda sample, _: jnp.abs(sample.joint_torque)),
        Metric(
            "cost_of_transport", "1", "cost of transport", larger_is_better=False,
            init=lambda zero: (zero, zero, _way_begun(zero)), update=_more_transport, finish=_cost_of_transport,
        ),
        Metric("travel", "m", "travel", larger_is_better=True, init=_way_begun, update=_longer_way, finish=_travel),
        peak(
            "base_deviation", "m", "base deviation",
            lambda sample, _: norm(sample.base_position - sample.base_reference),
        ),
        smallest("min_tsm", "m", "min TSM", lambda sample, _: sample.tsm, scale=0.01),
        smallest("min_gia_margin", "m/s^2", "min GIA margin", lambda sample, _: sample.gia_margin, scale=1.0),
        smallest("joint_limit_margin", "rad", "joint limit margin", _joint_limit_margins, scale=0.1),
        Metric(
            "detached_at", "s", "detached at", larger_is_better=True,
            init=lambda zero: zero + jnp.nan,
            update=lambda at, sample, _: jnp.where(jnp.isnan(at) & sample.torn_off.any(), sample.time, at),
        ),
        Metric(  # its place among the limbs
            "detached_limb", "1", "detached limb", larger_is_better=False,
            init=lambda zero: jnp.full((), -1, jnp.int32),
            update=lambda limb, sample, _: _first_limb(limb, sample.torn_off),
        ),
        Metric(
            "missed_grips", "1", "missed grips", larger_is_better=False,
            init=lambda zero: jnp.zeros((), jnp.int32),
            update=lambda count, sample, _: count + sample.missed.sum(dtype=jnp.int32),
        ),
        Metric(  # a robot whose foot holds after all goes on
            "stands_at", "s", "stands for want of a grip from", larger_is_better=True,
            init=lambda zero: zero + jnp.nan,
            update=lambda at, sample, _: jnp.where(
                sample.stands.any(), jnp.where(jnp.isnan(at), sample.time, at), jnp.nan
            ),
        ),
        Metric(
            "diverged", "1", "diverged", larger_is_better=False,
            init=lambda zero: (), update=lambda running, *_: running,
            finish=lambda _, context: jnp.asarray(context.diverged),
        ),
    )
)  # fmt: skip


# of laws that look after their force sensors: the first that one does without, and from when on
SENSORS = MetricTable(
    (
        Metric(
            "sensor_lost_at", "s", "force sensor lost at", larger_is_better=True,
            init=lambda zero: zero + jnp.nan,
            update=lambda at, sample, _: jnp.where(
                jnp.isnan(at) & sample.sensor_lost.any(), jnp.maximum(sample.time - SILENCE, 0.0), at
            ),
        ),
        Metric(
            "sensor_lost_limb", "1", "limb without force sensor", larger_is_better=False,
            init=lambda zero: jnp.full((), -1, jnp.int32),
            update=lambda limb, sample, _: _first_limb(limb, sample.sensor_lost),
        ),
    )
)  # fmt: skip

# of walks whose grips are looked into
GRIPS = MetricTable(
    (
        Metric(  # later ones may be those of a robot that falls
            "grip_gap", "m", "largest gap at which a gripper shuts, up to the first miss", larger_is_better=False,
            init=lambda zero: (zero, zero > 0), update=_larger_gap, finish=lambda running, _: running[0],
        ),
    )
)  # fmt: skip


def failed(metrics: Any) -> Any:
    """Return which walks lose a gripper, diverge, or stand for want of a grip, by their metrics of any shape, bool."""
    lost = (metrics["detached_limb"] >= 0) | metrics["diverged"].astype(bool)
    return lost | (metrics["stands_at"] >= 0) if "stands_at" in metrics else lost


def _shipped(name: str) -> Metric:
    return (METRICS.with_companions + SENSORS + GRIPS)[name]


# --- metrics of a walk under way: they take in one sample after the other, up to the last one that is finite


class Running(NamedTuple):
    """Running values of metrics."""

    steps: Array  # (), how many samples came
    finite: Array  # (), how many of them came before the first that is not finite
    values: tuple[PyTree, ...]  # of the metrics, in their order


def start(metrics: MetricTable, dtype: jnp.dtype) -> Running:
    """Return the values of a walk that has not begun."""
    none, zero = jnp.zeros((), jnp.int32), jnp.zeros((), dtype)
    return Running(none, none, tuple(jax.tree.map(jnp.asarray, metric.init(zero)) for metric in metrics))


def accumulate(metrics: MetricTable, running: Running, sample: Sample, context: Context) -> Running:
    """Return the values with one more sample of the walk; they stay as they are from one that is not finite on.

    Raises:
        ConfigError: a metric whose running value changes its structure, its shapes or its types.
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
            raise ConfigError(f"metric {metric.name}", "", f"`update` to keep {expected}", got)
        return result

    values = []
    for metric, value in zip(metrics, running.values, strict=True):
        updated = metric.update(value, sample, context)
        before: object = jax.tree.structure(value)
        if before != jax.tree.structure(updated):
            raise ConfigError(f"metric {metric.name}", "", "`update` to return a value structured as `init` does")
        values.append(jax.tree.map(choose, value, updated))
    return Running(running.steps + 1, running.finite + taken, tuple(values))


def finish(metrics: MetricTable, running: Running, context: Context) -> dict[str, Array]:
    """Return the metrics () of a walk that has ended; a walk without a finite sample has NaN for all real ones.

    Raises:
        ConfigError: a metric that is not one number.
    """
    context = context._replace(first=running.steps == 0, diverged=running.finite < running.steps)
    result = {}
    for metric, value in zip(metrics, running.values, strict=True):
        found = jnp.asarray(metric.finish(value, context))
        if found.shape:
            raise ConfigError(f"metric {metric.name}", "", "`finish` to return one number", f"shape {found.shape}")
        real = jnp.issubdtype(found.dtype, jnp.floating)
        result[metric.name] = jnp.where(running.finite > 0, found, jnp.nan) if real else found
    return result
