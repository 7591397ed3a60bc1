"""What a walk is judged by: each metric accumulates step by step, so a batch needs no memory over time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.dynamics.spatial import norm
from mjx_climb.robot.constants import Robot
from mjx_climb.walk.sample import Sample

METRICS: dict[str, str] = {
    "peak_foot_force": "N",
    "force_variation": "N",
    "peak_pull_force": "N",
    "peak_joint_torque": "N m",
    "cost_of_transport": "1",
    "travel": "m",
    "base_deviation": "m",
    "min_tsm": "m",
    "min_gia_margin": "m/s^2",
    "joint_limit_margin": "rad",
    "detached_at": "s",
    "detached_limb": "1",
    "diverged": "1",
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Accumulator:
    """Running values of the metrics, each (B,)."""

    steps: Array  # (), how many samples went in
    peak_foot_force: Array
    largest_foot_force: Array  # of the last sample
    force_variation: Array
    peak_pull_force: Array
    peak_joint_torque: Array
    work: Array  # J, integral of sum |tau phidot|
    mass: Array  # kg, the largest so far, cargo included
    start: Array  # (3, B) m, base at the first sample
    end: Array  # (3, B) m, base at the last sample
    base_deviation: Array
    min_tsm: Array
    min_gia_margin: Array
    joint_limit_margin: Array
    detached_at: Array  # s, NaN while all limbs hold
    detached_limb: Array  # index of the limb, -1 while all hold
    finite: Array  # bool


def start(batch: int, dtype: jnp.dtype) -> Accumulator:
    """Return the accumulator of a walk that has not begun."""
    zero, big = jnp.zeros(batch, dtype), jnp.full(batch, jnp.inf, dtype)
    return Accumulator(
        steps=jnp.zeros((), jnp.int32),
        peak_foot_force=zero,
        largest_foot_force=zero,
        force_variation=zero,
        peak_pull_force=zero,
        peak_joint_torque=zero,
        work=zero,
        mass=zero,
        start=jnp.zeros((3, batch), dtype),
        end=jnp.zeros((3, batch), dtype),
        base_deviation=zero,
        min_tsm=big,
        min_gia_margin=big,
        joint_limit_margin=big,
        detached_at=jnp.full(batch, jnp.nan, dtype),
        detached_limb=jnp.full(batch, -1, jnp.int32),
        finite=jnp.ones(batch, bool),
    )


def accumulate(total: Accumulator, sample: Sample, robot: Robot, time_step: float) -> Accumulator:
    """Return the accumulator with one more sample of the walk."""
    first = total.steps == 0
    force = norm(sample.foot_force)
    largest = force.max(0)
    pulling = sample.support & (sample.foot_force[2] < 0)
    power = jnp.abs(sample.joint_torque * sample.joint_rates).sum((0, 1))
    margin = jnp.minimum(sample.joint_angles - robot.joint_lower, robot.joint_upper - sample.joint_angles)
    limbs = len(robot.limbs)
    limb = jnp.where(sample.torn_off, jnp.arange(limbs, dtype=jnp.int32)[:, None], limbs).min(0)
    newly = (total.detached_limb < 0) & (limb < limbs)
    # one number that is not finite as soon as anything is not: cheaper than asking each
    everything = largest + power + sample.base_position.sum(0) + sample.joint_angles.sum((0, 1))
    return Accumulator(
        steps=total.steps + 1,
        peak_foot_force=jnp.maximum(total.peak_foot_force, largest),
        largest_foot_force=largest,
        force_variation=total.force_variation + jnp.where(first, 0.0, jnp.abs(largest - total.largest_foot_force)),
        peak_pull_force=jnp.maximum(total.peak_pull_force, jnp.where(pulling, force, 0.0).max(0)),
        peak_joint_torque=jnp.maximum(total.peak_joint_torque, jnp.abs(sample.joint_torque).max((0, 1))),
        work=total.work + power * time_step,
        mass=jnp.maximum(total.mass, robot.total_mass + sample.cargo_mass),
        start=jnp.where(first, sample.base_position, total.start),
        end=sample.base_position,
        base_deviation=jnp.maximum(total.base_deviation, norm(sample.base_position - sample.base_reference)),
        min_tsm=jnp.minimum(total.min_tsm, sample.tsm),
        min_gia_margin=jnp.minimum(total.min_gia_margin, sample.gia_margin),
        joint_limit_margin=jnp.minimum(total.joint_limit_margin, margin.min((0, 1))),
        detached_at=jnp.where(newly, sample.time, total.detached_at),
        detached_limb=jnp.where(newly, limb, total.detached_limb),
        finite=total.finite & jnp.isfinite(everything),
    )


def finish(total: Accumulator, gravity: Array | np.ndarray, heading: Array | np.ndarray) -> dict[str, Array]:
    """Return the metrics (B,) of a walk under `gravity` (3, B) m/s^2 along `heading` (B,) rad.

    Travel is the way made along the heading.

    Where the state stopped being finite all but `diverged` are NaN (`detached_limb` -1). Without gravity, or without
    travel, there is no cost of transport: NaN.
    """
    moved = total.end - total.start
    travel = jnp.cos(heading) * moved[0] + jnp.sin(heading) * moved[1]
    weight_travel = total.mass * norm(gravity) * jnp.abs(travel)
    defined = weight_travel > 0
    values = {name: getattr(total, name) for name in METRICS if hasattr(total, name)}
    values["travel"] = travel
    values["cost_of_transport"] = jnp.where(defined, total.work / jnp.where(defined, weight_travel, 1.0), jnp.nan)
    values["diverged"] = ~total.finite
    result = {}
    for name in METRICS:
        value = values[name]
        if jnp.issubdtype(value.dtype, jnp.floating):
            value = jnp.where(total.finite, value, jnp.nan)
        elif name == "detached_limb":
            value = jnp.where(total.finite, value, -1)
        result[name] = value
    return result
