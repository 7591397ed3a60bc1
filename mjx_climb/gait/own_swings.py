"""A gait whose limbs swing each from where it stands, to the planned footholds: swings are decided at ticks.

Between its ticks, a planning period apart, schedule and reference are functions of the memory and of the step.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.control import Reference
from mjx_climb.gait.footholds.held import Held, no_holds, of_some, pulls_of_holds, upright
from mjx_climb.gait.gait import Body
from mjx_climb.gait.periodic import Periodic
from mjx_climb.gait.schedule import (
    Plan,
    Schedule,
    arc,
    base_reference,
    first_footholds,
    foothold_height,
    schedule,
    settled_phase,
)
from mjx_climb.gait.swing import rest_to_rest
from mjx_climb.ground import Holds
from mjx_climb.physics.inverse_kinematics import Chain, LimbGeometry
from mjx_climb.physics.kinematics import Surface
from mjx_climb.robot.constants import Robot

_NEAR = 0.1  # share of a swing within which the foot is near its hold: some 3 % of the way
_TINY = 1e-9  # N


class Swings(NamedTuple):
    """Memory of the gait; times in steps."""

    cycle_start: Array  # (3,) m, memory of the periodic gait
    step: Array  # () of the last tick
    clock: Array  # () the gait's own time then
    running: Array  # () 1 or 0: whether that time goes on
    start: Array  # (limb, 3) m, world, where the last swing of a limb began, or the next one begins
    goal: Array  # (limb, 3) m, where it ends
    below: Array  # (limb,) m, height of the ground where it began
    begun: Array  # (limb,) step at which it began
    span: Array  # (limb,) steps that it takes
    rise: Array  # (limb,) m, above the higher of both ends
    touched: Array  # (limb,) step of the touchdown before
    base_start: Array  # (3,) m, where the base's last move began; of chosen footholds
    base_goal: Array  # (3,) m
    base_begun: Array  # () the gait's time at which it began
    held: Held | None = None  # at the goals; None: there are no holds
    left: Array | None = None  # (limb, 3) 1, normals of the ground where the last swings began
    reached: Array | None = None  # () number of way points that the base has reached; None: there are none
    waits: Any = None  # `gait.waiting.Waits` of a gait that waits for grips
    interruptions: Any = None  # `gait.recovery.Interruptions` of a gait that is interrupted


def clock_at(swings: Swings, step: Array) -> Array:
    """Return the gait's own time at a step, () steps."""
    return swings.clock + swings.running * (step.astype(swings.clock.dtype) - swings.step)


def at_tick(swings: Swings, step: Array) -> Swings:
    """Return the memory with the time of a tick, which is that of a step, () integer."""
    return swings._replace(step=step.astype(swings.clock.dtype), clock=clock_at(swings, step))


def with_swings(swings: Swings, some: Array, **new: Any) -> Swings:
    """Return the memory with new swings of some limbs (limb,): fields of `Swings`."""
    return swings._replace(**{name: of_some(some, value, getattr(swings, name)) for name, value in new.items()})


def foot_targets_at(plan: Plan, swings: Swings, now: Schedule, grip_point: Array) -> Array:
    """Return where the feet should be, (limb, 3) m in world axes; swings are those of `gait.schedule.foot_targets`."""
    phase = settled_phase(plan, now)
    swing = swings.start + rest_to_rest(phase)[:, None] * (swings.goal - swings.start)
    swing, height = arc(plan, phase, swing, swings.start[:, 2], swings.goal[:, 2], swings.rise)
    target = jnp.concatenate([swing[:, :2], height[:, None]], axis=1)
    return jnp.where(now.closed[:, None], grip_point, target)


class OwnSwings(Periodic):
    """Swings in the order of the periodic gait, from where limbs stand to its footholds."""

    robot: Robot = dataclasses.field(metadata={"tree": True})
    geometry: LimbGeometry | Chain = dataclasses.field(metadata={"tree": True})
    holds: Holds | None = dataclasses.field(metadata={"tree": True})
    period: int  # steps between ticks

    def init(self) -> tuple[Swings, Reference]:
        """The memory of a robot that stands on its first footholds."""
        base, reference = super().init()
        plan, zero = self.plan, jnp.zeros_like(self.plan.cycle_steps)
        feet, limbs = first_footholds(plan), jnp.zeros_like(plan.swing_offset)
        held, begun = no_holds(self.holds, feet), plan.swing_offset - 2 * plan.cycle_steps
        memory = Swings(
            cycle_start=base, step=zero, clock=zero, running=zero + 1, start=feet, goal=feet, below=feet[:, 2],
            begun=begun, span=limbs + plan.swing_steps, rise=limbs + plan.step_height, touched=begun + plan.swing_steps,
            base_start=base, base_goal=base, base_begun=zero, held=held, left=None if held is None else held.normal,
        )  # fmt: skip
        return memory, reference

    def schedule(self, memory: Swings, step: Array) -> Schedule:
        """The phases of each limb's own swing; `foothold` is that of the periodic gait."""
        clock, now = clock_at(memory, step), step.astype(memory.clock.dtype)
        periodic, elapsed = schedule(self.plan, clock), now - memory.begun
        closed = (elapsed < 0) | (elapsed >= memory.span)
        stood = jnp.where(elapsed < 0, now - memory.touched, elapsed - memory.span)
        return periodic._replace(
            closed=closed,
            swing_phase=elapsed / memory.span,
            until_lift_off=jnp.where(closed, self.until_lift_off(clock, elapsed), 0.0),
            since_touchdown=jnp.where(closed, stood, 0.0),
        )

    def until_lift_off(self, clock: Array, elapsed: Array) -> Array:
        """The steps until limbs that stand lift off, (limb,).

        `clock` () steps is the gait's own time, `elapsed` (limb,) steps the time since their swings began.
        """
        since_lift_off = jnp.mod(clock - self.plan.swing_offset, self.plan.cycle_steps)
        return self.plan.cycle_steps - since_lift_off

    def ground(self, memory: Swings, now: Schedule) -> tuple[Array, Surface | None]:
        """The ground below the feet.

        The plane of a hold counts near it alone: at the beginning and the end of a swing. Between them it is level.
        """
        height = jnp.where(now.swing_phase < 0.5, memory.below, memory.goal[:, 2])
        if memory.held is None or memory.left is None:
            return height, None
        phase = now.swing_phase / (1 - self.plan.settling)
        first, last = (phase < _NEAR)[:, None], (phase >= 1 - _NEAR)[:, None]
        normal = jnp.where(last, memory.held.normal, jnp.where(first, memory.left, upright(memory.goal)))
        place = jnp.where(first, memory.start, memory.goal)
        return height, Surface(jnp.concatenate([place[:, :2], height[:, None]], axis=1), normal)

    def reference(
        self, memory: Swings, now: Schedule, step: Array, base_position: Array, grip_point: Array
    ) -> tuple[Swings, Reference]:
        """The memory after a step, and the reference at it."""
        cycle_start, start = self.cycle_start(memory.cycle_start, now, base_position)
        return memory._replace(cycle_start=cycle_start), Reference(
            base_position=self.base_path(memory, now, step, start),
            base_orientation=self.plan.base_orientation,
            foot_position=foot_targets_at(self.plan, memory, now, grip_point),
            until_lift_off=now.until_lift_off * self.time_step,
            since_touchdown=now.since_touchdown * self.time_step,
        )

    def base_path(self, memory: Swings, now: Schedule, step: Array, start: Array) -> Array:
        """Where the base should be, (3,) m, having begun its cycle at `start` (3,) m."""
        return base_reference(self.plan, now, start)

    def look_ahead(self, memory: Swings, now: Schedule, step: Array, reference: Reference, body: Body) -> Swings:
        """The memory with the swings that begin before the next tick."""
        return self.lift_off(at_tick(memory, step), now, reference.base_position, body)

    def lift_off(self, memory: Swings, now: Schedule, base_path: Array, body: Body) -> Swings:
        """The memory with new swings of limbs that lift off before the next tick; the base should be at (3,) m.

        A planned foothold is no hold, even where recovery landed the limb on one.
        """
        lifts, wait = self.due(memory, now)
        planned, held = self.footholds_at(memory.clock + wait), no_holds(self.holds, memory.goal)
        left = None if memory.held is None else memory.held.normal
        places = {"start": body.grip_point, "goal": planned, "below": memory.goal[:, 2], "held": held, "left": left}
        return self.swung(memory, lifts, wait, **places)

    def due(self, memory: Swings, now: Schedule) -> tuple[Array, Array]:
        """Which limbs lift off before the next tick, by the periodic gait, and in how many steps, (limb,)."""
        wait = jnp.mod(self.plan.swing_offset - memory.clock, self.plan.cycle_steps)
        return now.closed & (memory.step >= memory.begun) & (wait < self.period) & (memory.running > 0), wait

    def footholds_at(self, lift_off: Array) -> Array:
        """The footholds (limb, 3) m of the periodic gait for swings that begin at its times (limb,) steps."""
        number = jnp.floor((lift_off + 0.5) / self.plan.cycle_steps) + 1
        points = self.plan.footholds + number[:, None] * self.plan.advance
        height = points[:, 2:] + foothold_height(self.plan, number)[:, None]
        return jnp.concatenate([points[:, :2], height], axis=1)

    def swung(self, memory: Swings, lifts: Array, wait: Array, **places: Any) -> Swings:
        """The memory with swings that begin in `wait` steps between `places`, fields of `Swings`."""
        plan, touched = self.plan, memory.begun + memory.span
        timed = {"begun": memory.step + wait, "span": plan.swing_steps, "rise": plan.step_height, "touched": touched}
        return with_swings(memory, lifts, **places, **timed)

    def share_of_limits(self, memory: Swings, now: Schedule, foot_force: Array) -> Array | None:
        """The largest share of its hold's limits that each foot uses; a limit holds from the end of a swing on."""
        if memory.held is None or not memory.held.bound.shape[1]:
            return None
        used = (memory.held.rows * foot_force[:, None]).sum(2)
        # a limit of 0 is passed by any force
        share = jnp.where(used > 0, used / jnp.maximum(memory.held.bound, _TINY), 0.0).max(1, initial=0.0)
        return jnp.where(now.swing_phase >= 1, share, 0.0)

    def pulls(self, memory: Swings, now: Schedule, surface: Surface | None, holding_force: Array) -> Array:
        """The pulls that margins may count on: of grip and hold the weaker one's."""
        if memory.held is None or surface is None:
            return holding_force
        bound = jnp.where((now.swing_phase >= 1)[:, None], memory.held.bound, jnp.inf)
        return pulls_of_holds(Held(surface.normal, memory.held.rows, bound), holding_force)
