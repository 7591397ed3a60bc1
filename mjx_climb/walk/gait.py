"""Periodic gait: which gripper is open, where the base and the feet should be (DESIGN of ClimbLab's default gait)."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.dynamics.spatial import quaternion_about_z, quaternion_multiply, rotate, rotation_about_z
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.quantities.swing import added_shapes, rest_to_rest
from mjx_climb.quantities.whole_steps import stance_steps, whole_steps
from mjx_climb.robot.constants import Robot


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Plan:
    """The walk that a scenario asks for: B or 1 environments, times counted in steps."""

    base_start: Array  # (3, B) m, world
    base_orientation: Array  # (4, B) wxyz, held throughout
    footholds: Array  # (3, L, B) m, world, where the feet stand at the start
    advance: Array  # (3, B) m, world, of base and feet in one cycle
    heights: Array  # (L, N, B) m, of each limb's footholds in order; N = 0: flat ground
    step_height: Array  # (B,) m
    swing_path: Array  # (L, 3, K, B) m, world, what is added to the swings' cubics, shape by shape; K = 0: nothing
    cycle_steps: Array  # (B,) steps
    swing_steps: Array  # (B,) steps
    swing_offset: Array  # (L, B) steps after the start of a cycle at which a limb lifts off


class Schedule(NamedTuple):
    """Where each limb is in its swing at one step."""

    cycle: Array  # (B,) number of cycles completed
    cycle_phase: Array  # (B,) in [0, 1)
    swing_phase: Array  # (L, B) in [0, 1) while swinging
    closed: Array  # (L, B) bool: the gripper is commanded shut
    foothold: Array  # (L, B) number of the foothold below the foot: the next one from the middle of a swing on


def plan(
    robot: Robot, stance_feet: Array, numbers: Parameters, lift_off: tuple[tuple[str, float], ...], time_step: float
) -> Plan:
    """Return the walk of a robot whose feet stand at `stance_feet` (3, L, 1) m in world axes at heading zero.

    `lift_off` are the names of the limbs, each with the share of the cycle at which it lifts off.
    """
    heading = rotation_about_z(numbers.heading)
    cycle_steps = whole_steps(numbers.cycle, time_step)
    phase = jnp.asarray([dict(lift_off)[limb] for limb in robot.limbs], numbers.cycle.dtype)
    zero = jnp.zeros_like(numbers.stride)
    return Plan(
        base_start=rotate(heading, robot.stance_position),
        base_orientation=quaternion_multiply(quaternion_about_z(numbers.heading), robot.stance_orientation),
        footholds=rotate(heading[:, :, None], stance_feet),
        advance=rotate(heading, jnp.stack([numbers.stride, zero, zero])),
        heights=jnp.asarray(numbers.foothold_height),
        step_height=jnp.asarray(numbers.step_height),
        swing_path=_turned(heading, numbers.step_height, jnp.asarray(numbers.swing_path)),
        cycle_steps=cycle_steps,
        swing_steps=cycle_steps - stance_steps(numbers.duty, cycle_steps),
        swing_offset=whole_steps(phase[:, None] * cycle_steps, 1),
    )


def _turned(heading: Array, step_height: Array | np.ndarray, swing_path: Array) -> Array:
    """Return what is added to the swings (L, 3, K, B) m along the axes of the world, from step heights ahead."""
    if not swing_path.shape[2]:
        return swing_path
    along = rotate(heading[:, :, None, None], jnp.moveaxis(swing_path, 1, 0))
    return jnp.asarray(step_height) * jnp.moveaxis(along, 0, 1)


def schedule(plan: Plan, step: Array) -> Schedule:
    """Return the phases of the limbs at a step (scalar integer)."""
    step = step.astype(plan.cycle_steps.dtype)
    # half a step in, so that rounding cannot put the first step of a cycle into the last
    cycle = jnp.floor((step + 0.5) / plan.cycle_steps)
    in_cycle = step - cycle * plan.cycle_steps
    since_lift_off = jnp.mod(in_cycle - plan.swing_offset, plan.cycle_steps)
    return Schedule(
        cycle=cycle,
        cycle_phase=in_cycle * (1 / plan.cycle_steps),
        swing_phase=since_lift_off * (1 / plan.swing_steps),
        closed=since_lift_off >= plan.swing_steps,
        foothold=cycle + (in_cycle - plan.swing_offset >= plan.swing_steps / 2),
    )


def is_flat(plan: Plan) -> bool:
    """Return whether all footholds are at height zero; known when the walk is compiled."""
    return plan.heights.shape[1] == 0


def foothold_height(plan: Plan, number: Array) -> Array:
    """Return the heights (L, B) m of footholds by their number (L, B) or (B,); the last one goes on for ever."""
    height = jnp.broadcast_to(plan.heights[:, 0], jnp.broadcast_shapes(plan.heights[:, 0].shape, number.shape))
    for n in range(1, plan.heights.shape[1]):
        height = jnp.where(number >= n, plan.heights[:, n], height)
    return height


def ground_height(plan: Plan, now: Schedule) -> Array:
    """Return the height of the ground below each foot, (L, B) m: that of its foothold, as a terrace."""
    return jnp.zeros_like(plan.swing_offset) if is_flat(plan) else foothold_height(plan, now.foothold)


def first_footholds(plan: Plan) -> Array:
    """Return where the feet stand at the start, (3, L, B) m in world axes."""
    return plan.footholds if is_flat(plan) else _raised(plan.footholds, foothold_height(plan, jnp.zeros(1)))


def _raised(points: Array, height: Array) -> Array:
    """Return points (3, L, B or 1) higher by `height` (L, B)."""
    return jnp.stack(jnp.broadcast_arrays(points[0], points[1], points[2] + height))


def rise(plan: Plan, cycle: Array) -> Array:
    """Return by how much a cycle's footholds lie higher than flat ground on average, (3, B) m in world axes."""
    if is_flat(plan):
        return jnp.zeros_like(plan.advance)
    height = foothold_height(plan, cycle).mean(0)
    return jnp.stack([jnp.zeros_like(height), jnp.zeros_like(height), height])


def nominal_start(plan: Plan, now: Schedule, memory: Array, base_position: Array) -> tuple[Array, Array]:
    """Return the memory, unchanged, and where the cycle's base reference starts: where the last one ended."""
    del base_position
    start = plan.base_start + now.cycle * plan.advance
    return memory, start if is_flat(plan) else start + rise(plan, now.cycle)


def actual_start(plan: Plan, now: Schedule, memory: Array, base_position: Array) -> tuple[Array, Array]:
    """Return, twice, where the cycle's base reference starts: where the base was when the cycle began."""
    del plan
    start = jnp.where(now.cycle_phase == 0, base_position, memory)
    return start, start


# memory and start of the cycle, both (3, B) m in world axes
CYCLE_STARTS = {"nominal": nominal_start, "actual": actual_start}


def base_reference(plan: Plan, now: Schedule, start: Array) -> Array:
    """Return where the base should be, (3, B) m in world axes: one cubic a cycle, rest to rest.

    On uneven ground the base rises and sinks with the mean height of the footholds.
    """
    advance = plan.advance
    if not is_flat(plan):
        advance = advance + rise(plan, now.cycle + 1) - rise(plan, now.cycle)
    return start + rest_to_rest(now.cycle_phase) * advance


def _added(plan: Plan, phase: Array) -> Array:
    """Return what is added to the cubic swings at their phases (L, B), (3, L, B) m in world axes."""
    horizontal, vertical = added_shapes(phase)
    return jnp.stack(
        [
            sum((plan.swing_path[:, axis, k] * shape for k, shape in enumerate(shapes)), jnp.zeros_like(phase))
            for axis, shapes in enumerate((horizontal, horizontal, vertical))
        ]
    )


def foot_targets(plan: Plan, now: Schedule, grip_point: Array) -> Array:
    """Return where the feet should be, (3, L, B) m in world axes.

    A shut gripper stays where it grips. A swing is the same curve whatever came before: from the cycle's planned
    foothold to the next, even where a sagging robot touched down short of it. What is added to the cubics is zero, with
    zero slope, at both ends.
    """
    foothold = plan.footholds + now.cycle * plan.advance[:, None]
    # a limb on the ground has no swing: its phase runs past one
    phase = jnp.where(now.closed, 0.0, now.swing_phase)
    swing = foothold + rest_to_rest(phase) * plan.advance[:, None]
    lift = rest_to_rest(jnp.where(phase < 0.5, 2 * phase, 2 - 2 * phase))
    if is_flat(plan):
        lift = plan.step_height * lift
    else:  # from the old height to step_height above the higher of both, and down to the new one
        old, new = foothold_height(plan, now.cycle), foothold_height(plan, now.cycle + 1)
        end = jnp.where(phase < 0.5, old, new)
        lift = end + (jnp.maximum(old, new) + plan.step_height - end) * lift
    if plan.swing_path.shape[2]:
        swing = swing + _added(plan, phase)
    return jnp.where(now.closed, grip_point, _raised(swing, lift))
