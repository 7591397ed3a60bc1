"""Periodic gait: which gripper is open, where the base and the feet should be (ClimbLab's default gait)."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.control import Reference
from mjx_climb.gait.base_path import Sway, sway_of, swayed
from mjx_climb.gait.swing import added_shapes, lift, rest_to_rest
from mjx_climb.hardware.stages import IDEAL, Stages
from mjx_climb.parameter_types import Parameters, stance_steps, whole_steps
from mjx_climb.physics.spatial import quaternion_from_rotation_vector, quaternion_multiply, quaternion_to_matrix
from mjx_climb.robot.constants import Robot


class Plan(NamedTuple):
    """The walk that a scenario asks for; world axes, times counted in steps."""

    base_start: Array  # (3,) m
    base_orientation: Array  # (4,) wxyz, held throughout
    footholds: Array  # (limb, 3) m, where the feet would stand at the start on flat ground
    advance: Array  # (3,) m, of base and feet in one cycle
    heights: Array  # (limb, N) m, of each limb's footholds in order; N = 0: flat ground
    step_height: Array  # () m
    swing_path: Array  # (limb, 3, K) m, added to the cubics of a swing, shape by shape; K = 0: nothing
    settling: Array  # () share of a swing, at its end, spent over the new foothold
    cycle_steps: Array  # () steps
    swing_steps: Array  # () steps
    swing_offset: Array  # (limb,) steps after the start of a cycle at which a limb lifts off
    sway: Sway | None = None
    landing: Array | None = None  # () m, speed of landing times the time that a foot moves in a swing


class Schedule(NamedTuple):
    """Where each limb is in its swing at one step."""

    cycle: Array  # () number of cycles completed
    cycle_phase: Array  # () in [0, 1)
    swing_phase: Array  # (limb,) in [0, 1) while swinging
    closed: Array  # (limb,) bool: the gripper is commanded shut
    foothold: Array  # (limb,) number of the foothold below the foot: the next one from the middle of a swing on
    until_lift_off: Array  # (limb,) steps until the gripper opens next; 0 in a swing
    since_touchdown: Array  # (limb,) steps since the gripper shut last; 0 in a swing


def plan(
    robot: Robot,
    stance_feet: Array,
    parameters: Parameters,
    lift_off: tuple[tuple[str, float], ...],
    time_step: float,
    stages: Stages = IDEAL,
) -> Plan:
    """Return the walk of a robot whose feet stand at `stance_feet` (limb, 3) m in world axes at heading zero.

    `lift_off` has the limbs' names, each with the share of the cycle at which it lifts off. `stages` say whether the
    base has a height of its own or sways, and whether feet land with a speed.
    """
    values = parameters.gait
    zero = jnp.zeros_like(values.heading)
    heading = quaternion_from_rotation_vector(jnp.stack([zero, zero, values.heading]))
    turned, step_height = quaternion_to_matrix(heading), jnp.asarray(values.step_height)
    cycle_steps = whole_steps(values.cycle, time_step)
    lifts = [dict(lift_off)[limb] for limb in robot.limbs]
    shares, start = jnp.asarray(lifts, cycle_steps.dtype), jnp.asarray(robot.stance_position)
    swing_steps = cycle_steps - stance_steps(values.duty, cycle_steps)
    sway = landing = None
    if stages.sway:
        sway = sway_of((stance_feet - start) @ turned.T, lifts, values.duty, values.sway)
    if stages.landing_speed:
        landing = values.landing_speed * (1 - values.settling) * swing_steps * time_step
    if stages.height:
        start = start * jnp.stack([zero + 1, zero + 1, values.height])
    return Plan(
        base_start=turned @ start,
        base_orientation=quaternion_multiply(heading, jnp.asarray(robot.stance_orientation)),
        footholds=stance_feet @ turned.T,
        advance=turned @ jnp.stack([values.stride, zero, zero]),
        heights=jnp.asarray(parameters.ground.foothold_height),
        step_height=step_height,
        swing_path=step_height * (turned @ values.swing_path),
        settling=jnp.asarray(values.settling),
        cycle_steps=cycle_steps,
        swing_steps=swing_steps,
        swing_offset=whole_steps(shares * cycle_steps, 1),
        sway=sway,
        landing=landing,
    )


def schedule(plan: Plan, step: Array) -> Schedule:
    """Return the phases of the limbs at a step, () integer."""
    step = step.astype(plan.cycle_steps.dtype)
    # half a step in, so that rounding cannot put the first step of a cycle into the last
    cycle = jnp.floor((step + 0.5) / plan.cycle_steps)
    in_cycle = step - cycle * plan.cycle_steps
    since_lift_off = jnp.mod(in_cycle - plan.swing_offset, plan.cycle_steps)
    closed = since_lift_off >= plan.swing_steps
    # a limb that has not swung yet has stood since a cycle before the walk begins
    stood = since_lift_off - plan.swing_steps + jnp.where(step < plan.swing_offset, plan.cycle_steps, 0.0)
    return Schedule(
        cycle=cycle,
        cycle_phase=in_cycle / plan.cycle_steps,
        swing_phase=since_lift_off / plan.swing_steps,
        closed=closed,
        foothold=cycle + (in_cycle - plan.swing_offset >= plan.swing_steps / 2),
        until_lift_off=jnp.where(closed, plan.cycle_steps - since_lift_off, 0.0),
        since_touchdown=jnp.where(closed, stood, 0.0),
    )


def foothold_height(plan: Plan, number: Array) -> Array:
    """Return the heights (limb,) m of footholds by their number, (limb,) or (); the last one goes on for ever.

    The ground below a foot is as high as its foothold, as a terrace.
    """
    if not plan.heights.size:
        return jnp.zeros_like(plan.swing_offset)
    height = plan.heights[:, 0]
    for n in range(1, plan.heights.shape[1]):
        height = jnp.where(number >= n, plan.heights[:, n], height)
    return height


def _raised(points: Array, height: Array) -> Array:
    """Return points (3,) or (limb, 3) raised by `height`, () or (limb,)."""
    return jnp.concatenate([points[..., :2], points[..., 2:] + height[..., None]], axis=-1)


def first_footholds(plan: Plan) -> Array:
    """Return where the feet stand at the start, (limb, 3) m in world axes."""
    return _raised(plan.footholds, foothold_height(plan, jnp.zeros_like(plan.cycle_steps)))


def planned_start(plan: Plan, cycle: Array) -> Array:
    """Return where the gait plans the base at the start of a cycle, (3,) m in world axes."""
    return _raised(plan.base_start + cycle * plan.advance, foothold_height(plan, cycle).mean())


def reference(plan: Plan, now: Schedule, start: Array, grip_point: Array, time_step: float) -> Reference:
    """Return the reference of a base that began its cycle at `start` (3,) m; shut grippers stay where they grip.

    `grip_point` is (limb, 3) m, in world axes.
    """
    return Reference(
        base_position=base_reference(plan, now, start),
        base_orientation=plan.base_orientation,
        foot_position=foot_targets(plan, now, grip_point),
        until_lift_off=now.until_lift_off * time_step,
        since_touchdown=now.since_touchdown * time_step,
    )


def base_reference(plan: Plan, now: Schedule, start: Array) -> Array:
    """Return where the base should be, (3,) m in world axes: one cubic a cycle, rest to rest, from `start`.

    On uneven ground the base rises and sinks with the mean height of the footholds. The sway comes on top.
    """
    old, new = (foothold_height(plan, cycle).mean() for cycle in (now.cycle, now.cycle + 1))
    way = _raised(plan.advance, new - old)
    position = start + rest_to_rest(now.cycle_phase) * way
    return position if plan.sway is None else position + swayed(plan.sway, now.cycle_phase)


def unswayed(plan: Plan, now: Schedule, position: Array) -> Array:
    """Return where a base at `position` (3,) m would be without its sway."""
    return position if plan.sway is None else position - swayed(plan.sway, now.cycle_phase)


def foot_targets(plan: Plan, now: Schedule, grip_point: Array) -> Array:
    """Return where the feet should be, (limb, 3) m in world axes.

    A shut gripper stays where it grips. A swing is always the same curve: from the cycle's planned
    foothold to the next, even where a sagging robot touched down short of it; up to the step height above the higher
    of both. The additions to the cubics are zero, with zero slope, at both ends; but for a landing speed v of a swing
    that takes T: `v T x^2 (1 - x) / 2` over its second half, x from 0 to 1.
    """
    phase = settled_phase(plan, now)
    swing = plan.footholds + (now.cycle + rest_to_rest(phase))[:, None] * plan.advance
    old, new = foothold_height(plan, now.cycle), foothold_height(plan, now.cycle + 1)
    swing, height = arc(plan, phase, swing, old, new, plan.step_height)
    return jnp.where(now.closed[:, None], grip_point, _raised(swing, height))


def settled_phase(plan: Plan, now: Schedule) -> Array:
    """Return how far the feet are on their way, (limb,) from 0 to 1, settled at the end of the swing."""
    # a limb on the ground has no swing: its phase runs past one
    return jnp.where(now.closed, 0.0, jnp.minimum(now.swing_phase / (1 - plan.settling), 1.0))


def arc(plan: Plan, phase: Array, swing: Array, old: Array, new: Array, rise: Array) -> tuple[Array, Array]:
    """Return feet in swing with the shapes that the gait adds, (limb, 3) m, and the heights of their arcs, (limb,) m.

    Arguments:
        phase: of `settled_phase`, (limb,).
        swing: points (limb, 3) m on the way from one foothold to the next, in world axes.
        old, new: heights of these footholds, (limb,) m.
        rise: of the arc above the higher of both, m.
    """
    end = jnp.where(phase < 0.5, old, new)
    height = end + (jnp.maximum(old, new) + rise - end) * lift(phase)
    if plan.landing is not None:
        half = jnp.clip(2 * phase - 1, 0.0, 1.0)
        height = height + plan.landing * (half * half * (1 - half) / 2)
    if plan.swing_path.shape[2]:
        horizontal, vertical = (jnp.stack(shapes) for shapes in added_shapes(phase))  # (K, limb)
        shapes = jnp.stack([horizontal, horizontal, vertical])  # (3, K, limb)
        swing = swing + (plan.swing_path * jnp.moveaxis(shapes, 2, 0)).sum(2)
    return swing, height
