"""The metrics that come with the simulator, one table in one place; each reads as its name is written."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.dynamics.spatial import norm
from mjx_climb.walk.metrics.extremes import peak, smallest
from mjx_climb.walk.metrics.metric import Context, Metric, MetricTable
from mjx_climb.walk.sample import Sample

FAILURES = ("detached_at", "detached_limb", "missed_grips", "diverged")  # how a walk failed: nothing to better


def foot_forces(sample: Sample, _: Context) -> Array:
    """Return the sizes of the foot forces, (limb,) N."""
    sizes: Array = norm(sample.foot_force)
    return sizes


def pull_forces(sample: Sample, context: Context) -> Array:
    """Return the sizes of the foot forces where the ground pulls a supporting foot down, else 0, (limb,) N."""
    pulling = sample.support & (sample.foot_force[:, 2] < 0)
    return jnp.where(pulling, foot_forces(sample, context), 0.0)


def joint_limit_margins(sample: Sample, context: Context) -> Array:
    """Return how far the joints are from the nearer of their limits, (limb, joint) rad; negative beyond."""
    robot = context.robot
    return jnp.minimum(sample.joint_angles - robot.joint_lower, robot.joint_upper - sample.joint_angles)


class _Way(NamedTuple):
    """Where the base was at the first sample and at the last, (2,) m each."""

    start: Array
    end: Array


def _no_way(zero: Array) -> _Way:
    nowhere = jnp.stack([zero, zero])
    return _Way(nowhere, nowhere)


def _longer_way(way: _Way, sample: Sample, context: Context) -> _Way:
    here = sample.base_position[:2]
    return _Way(jnp.where(context.first, here, way.start), here)


def _travel(way: _Way, context: Context) -> Array:
    moved = way.end - way.start
    return jnp.cos(context.heading) * moved[0] + jnp.sin(context.heading) * moved[1]


class _Transport(NamedTuple):
    """What a transport took."""

    work: Array  # () J, integral of the power of all joints, each counted as positive
    mass: Array  # () kg, the largest so far, cargo included
    way: _Way


def _more_transport(running: _Transport, sample: Sample, context: Context) -> _Transport:
    power = jnp.abs(sample.joint_torque * sample.joint_rates).sum()
    return _Transport(
        work=running.work + power * context.time_step,
        mass=jnp.maximum(running.mass, context.robot.total_mass + sample.cargo_mass),
        way=_longer_way(running.way, sample, context),
    )


def _cost_of_transport(running: _Transport, context: Context) -> Array:
    """Return work by weight and travel; without gravity, or without travel, there is none: NaN."""
    weight_travel = running.mass * norm(jnp.asarray(context.gravity)) * jnp.abs(_travel(running.way, context))
    defined = weight_travel > 0
    return jnp.where(defined, running.work / jnp.where(defined, weight_travel, 1.0), jnp.nan)


class _Variation(NamedTuple):
    """How much a force has varied, and its last value, () N each."""

    total: Array
    last: Array


def _more_variation(running: _Variation, sample: Sample, context: Context) -> _Variation:
    force = jnp.max(foot_forces(sample, context))
    return _Variation(running.total + jnp.where(context.first, 0.0, jnp.abs(force - running.last)), force)


def _first_limb(limb: Array, sample: Sample, _: Context) -> Array:
    """Return the limb that was torn off first, of several in one step the first in their order; -1 for none."""
    limbs = len(sample.torn_off)
    torn = jnp.min(jnp.where(sample.torn_off, jnp.arange(limbs, dtype=limb.dtype), limbs))
    return jnp.where((limb < 0) & (torn < limbs), torn, limb)


METRICS = MetricTable(
    (
        peak("peak_foot_force", "N", "peak foot force", foot_forces),
        Metric(
            "force_variation", "N", "force variation", larger_is_better=False,
            init=lambda zero: _Variation(zero, zero),
            update=_more_variation,
            finish=lambda running, _: running.total,
        ),
        peak("peak_pull_force", "N", "peak pull force", pull_forces),
        peak("peak_joint_torque", "N m", "peak joint torque", lambda sample, _: jnp.abs(sample.joint_torque)),
        Metric(
            "cost_of_transport", "1", "cost of transport", larger_is_better=False,
            init=lambda zero: _Transport(zero, zero, _no_way(zero)),
            update=_more_transport,
            finish=_cost_of_transport,
        ),
        Metric("travel", "m", "travel", larger_is_better=True, init=_no_way, update=_longer_way, finish=_travel),
        peak(
            "base_deviation", "m", "base deviation",
            lambda sample, _: norm(sample.base_position - sample.base_reference),
        ),
        smallest("min_tsm", "m", "min TSM", lambda sample, _: sample.tsm, scale=0.01),
        smallest("min_gia_margin", "m/s^2", "min GIA margin", lambda sample, _: sample.gia_margin, scale=1.0),
        smallest("joint_limit_margin", "rad", "joint limit margin", joint_limit_margins, scale=0.1),
        Metric(
            "detached_at", "s", "detached at", larger_is_better=True,
            init=lambda zero: zero + jnp.nan,
            update=lambda at, sample, _: jnp.where(jnp.isnan(at) & sample.torn_off.any(), sample.time, at),
        ),
        Metric(
            "detached_limb", "1", "detached limb", larger_is_better=False,  # its place among the limbs
            init=lambda zero: jnp.full((), -1, jnp.int32),
            update=_first_limb,
        ),
        Metric(
            "missed_grips", "1", "missed grips", larger_is_better=False,
            init=lambda zero: jnp.zeros((), jnp.int32),
            update=lambda count, sample, _: count + sample.missed.sum(dtype=jnp.int32),
        ),
        Metric(
            "diverged", "1", "diverged", larger_is_better=False,
            init=lambda zero: (),
            update=lambda running, *_: running,
            finish=lambda _, context: jnp.asarray(context.diverged),
        ),
    )
)  # fmt: skip


def shipped(name: str) -> Metric:
    """Return a shipped metric, or the companion of one, by its name."""
    return METRICS.with_companions[name]
