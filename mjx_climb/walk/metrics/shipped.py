"""The metrics that come with the simulator, one table in one place; each reads as its name is written."""

from typing import Any

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


# --- metrics of several running values: tuples


def _way_begun(zero: Array) -> tuple[Array, Array]:
    nowhere = jnp.stack([zero, zero])
    return nowhere, nowhere


def _longer_way(way: tuple[Array, Array], sample: Sample, context: Context) -> tuple[Array, Array]:
    """Return where the base was at the first sample, and at this one, (2,) m each."""
    here = sample.base_position[:2]
    return jnp.where(context.first, here, way[0]), here


def _travel(way: tuple[Array, Array], context: Context) -> Array:
    moved = way[1] - way[0]
    return jnp.cos(context.heading) * moved[0] + jnp.sin(context.heading) * moved[1]


def _more_transport(running: Any, sample: Sample, context: Context) -> Any:
    """Return the work of all joints, each power counted as positive, J, the largest mass so far, kg, and the way."""
    work, mass, way = running
    power = jnp.abs(sample.joint_torque * sample.joint_rates).sum()
    mass = jnp.maximum(mass, context.robot.total_mass + sample.cargo_mass)
    return work + power * context.time_step, mass, _longer_way(way, sample, context)


def _cost_of_transport(running: Any, context: Context) -> Array:
    """Return work by weight and travel; without gravity, or without travel, there is none: NaN."""
    work, mass, way = running
    weight_travel = mass * norm(jnp.asarray(context.gravity)) * jnp.abs(_travel(way, context))
    defined = weight_travel > 0
    return jnp.where(defined, work / jnp.where(defined, weight_travel, 1.0), jnp.nan)


def _more_variation(running: tuple[Array, Array], sample: Sample, context: Context) -> tuple[Array, Array]:
    """Return by how much the largest foot force has varied, and its value now, N."""
    total, last = running
    force = jnp.max(foot_forces(sample, context))
    return total + jnp.where(context.first, 0.0, jnp.abs(force - last)), force


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
            init=lambda zero: (zero, zero),
            update=_more_variation,
            finish=lambda running, _: running[0],
        ),
        peak("peak_pull_force", "N", "peak pull force", pull_forces),
        peak("peak_joint_torque", "N m", "peak joint torque", lambda sample, _: jnp.abs(sample.joint_torque)),
        Metric(
            "cost_of_transport", "1", "cost of transport", larger_is_better=False,
            init=lambda zero: (zero, zero, _way_begun(zero)),
            update=_more_transport,
            finish=_cost_of_transport,
        ),
        Metric("travel", "m", "travel", larger_is_better=True, init=_way_begun, update=_longer_way, finish=_travel),
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
