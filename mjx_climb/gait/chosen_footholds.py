"""A gait that chooses its footholds among holds, and the way of its base over them.

The base moves with each swing over the point where the lines between opposite feet meet (ClimbLab's rule), as far as
all feet stay within reach: ahead, or from way point to way point.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.control import Reference
from mjx_climb.gait.base_path import swayed
from mjx_climb.gait.first_holds import first_holds
from mjx_climb.gait.footholds.choice import Candidates, best
from mjx_climb.gait.footholds.footholds import Footholds, Situation
from mjx_climb.gait.footholds.held import Held, pulls_of_holds, upright
from mjx_climb.gait.footholds.reach import HeightTable, ranges, within_ranges, within_reach
from mjx_climb.gait.gait import Body
from mjx_climb.gait.own_swings import OwnSwings, Swings, clock_at
from mjx_climb.gait.schedule import Plan, Schedule, unswayed
from mjx_climb.gait.swing import rest_to_rest
from mjx_climb.ground import Holds
from mjx_climb.physics.spatial import norm, quaternion_to_matrix

Answer = Callable[[Array], Array]  # for points (limb, 3) m, (limb,) bool
_SHARES = (0.25, 0.5, 0.75, 1.0)  # of a move of the base: the largest that the feet allow is made


class ChosenFootholds(OwnSwings):
    """Swings in the order of the periodic gait to the holds that a rule chooses."""

    holds: Holds = dataclasses.field(metadata={"tree": True})
    rule: Footholds = dataclasses.field(metadata={"tree": True})
    moves: int  # of the base in a cycle: the lift-offs
    # m, world, that the base walks to in turn; none: it walks ahead
    way_points: tuple[tuple[float, float], ...] = ()
    # None: reach by inverse kinematics
    table: HeightTable | None = dataclasses.field(default=None, metadata={"tree": True})
    # (3,) m/s^2, for the axes of holds
    gravity: Array = dataclasses.field(default_factory=lambda: jnp.zeros(3), metadata={"tree": True})

    def init(self) -> tuple[Swings, Reference]:
        """The memory of a robot that stands on the holds next to its rest stance and has reached no way point."""
        memory, reference = super().init()
        base, rotation = reference.base_position, quaternion_to_matrix(reference.base_orientation)
        place = base, rotation, memory.goal, self.gravity
        feet, held = first_holds(self.robot, self.geometry, self.holds, place, memory.held)
        memory = memory._replace(
            start=feet, goal=feet, below=feet[:, 2], held=held, left=None if held is None else held.normal
        )
        memory = memory._replace(reached=memory.clock if self.way_points else None)
        return memory, reference._replace(foot_position=feet)

    def base_path(self, memory: Swings, now: Schedule, step: Array, start: Array) -> Array:
        """Where the base should be, (3,) m, by its last move."""
        span = self.plan.cycle_steps / self.moves
        phase = jnp.clip((clock_at(memory, step) - memory.base_begun) / span, 0.0, 1.0)
        position = memory.base_start + rest_to_rest(phase) * (memory.base_goal - memory.base_start)
        return position if self.plan.sway is None else position + swayed(self.plan.sway, now.cycle_phase)

    def lift_off(self, memory: Swings, now: Schedule, base_path: Array, body: Body) -> Swings:
        """The memory with swings to chosen holds, and a move of the base, where limbs lift off before the next tick."""
        plan, base = self.plan, unswayed(self.plan, now, base_path)
        advance = plan.advance
        if memory.reached is not None:
            reached, advance = next_way(self.way_points, memory.reached, base, advance)
            memory = memory._replace(reached=reached)
        # of the base until the touchdown, where the other feet may keep it, and until the next lift-off
        ways = jnp.zeros_like(advance), advance
        situation = situation_of(plan, memory, body, advance)
        lifts, wait, situation = self.next_swings(memory, now, situation, body, base, ways)
        if memory.reached is not None:
            lifts = lifts & (memory.reached < len(self.way_points))
        situation = situation._replace(stands=~lifts)
        # the loop over holds is carried out where it is needed alone
        goal, held = jax.lax.cond(
            lifts.any(),
            lambda: self.choose(situation, body, ways, memory.held),
            lambda: (memory.goal, memory.held),
        )
        left = None if memory.held is None else memory.held.normal
        below = body.grip_point[:, 2]
        memory = self.swung(memory, lifts, wait, start=body.grip_point, goal=goal, below=below, held=held, left=left)
        moves, reach = lifts.any(), self.reach_at((memory.goal - base) @ body.base_rotation)
        place = towards(reach, memory.goal, body.base_rotation, base, self.over(memory.goal))
        return memory._replace(
            base_start=jnp.where(moves, base, memory.base_start),
            base_goal=jnp.where(moves, place, memory.base_goal),
            base_begun=jnp.where(moves, memory.clock, memory.base_begun),
        )

    def next_swings(
        self, memory: Swings, now: Schedule, situation: Situation, body: Body, base: Array, ways: tuple[Array, Array]
    ) -> tuple[Array, Array, Situation]:
        """Which limbs lift off before the next tick, in how many steps, (limb,), and the situation with their plans.

        Arguments:
            base: (3,) m, on the base's path without its sway.
            ways: as of `choose`.
        """
        lifts, wait = self.due(memory, now)
        if memory.reached is None:
            return lifts, wait, situation._replace(planned=self.footholds_at(memory.clock + wait))
        # limbs swing one after the other: those that have waited longer stand farther behind
        share = (self.moves + 1) / (2 * self.moves)
        place = base + self.plan.footholds - self.plan.base_start + share * ways[1]
        beside = jnp.concatenate([place[:, :2], memory.goal[:, 2:]], axis=1)
        return lifts, wait, situation._replace(planned=beside)

    def choose(
        self, situation: Situation, body: Body, ways: tuple[Array, Array], held: Held | None
    ) -> tuple[Array, Held | None]:
        """Where each limb would swing to, (limb, 3) m, and the hold there; where it stands, if it reaches none.

        Arguments:
            ways: (3,) m each, of the base until the touchdown and until the next lift-off: limbs reach a hold from
                both.
            held: where limbs stand.
        """

        def score(position: Array, one: Candidates) -> Array:
            return self.score(situation, position, one)

        allowed = self.allowed(situation, body, ways)
        return best(score, allowed, Candidates.of(self.holds), (situation.feet, held), situation.weight)

    def score(self, situation: Situation, position: Array, one: Candidates) -> Array:
        """How much a hold at (limb, 3) m is worth to each limb, (limb,)."""
        return self.rule.score(situation, one.with_feet(position, situation.holding_force))

    def allowed(self, situation: Situation, body: Body, ways: tuple[Array, Array]) -> Answer:
        """Which limbs may swing to points: they reach them, no foot is there, and the base can follow if it must."""
        reached = self.reached(body, ways)
        follows = self.follows(situation, body) if self.rule.base_must_follow else reached

        def may(position: Array) -> Array:
            return reached(position) & self.rule.apart(situation, position) & follows(position)

        return may

    def reached(self, body: Body, ways: tuple[Array, Array]) -> Answer:
        """Which limbs reach points from the base now, and from a stride on where the rule asks for that."""

        def reached(position: Array) -> Array:
            here = (position - body.base_position) @ body.base_rotation
            reach, found = self.reach_at(here), jnp.ones_like(position[:, 0], bool)
            for way in ways if self.rule.reach_a_stride_on else ways[:1]:
                found = found & reach(here - way @ body.base_rotation)
            return found

        return reached

    def follows(self, situation: Situation, body: Body) -> Answer:
        """Which limbs may swing to points so that these and all feet are in reach of the base in its new place."""
        feet = (situation.feet - body.base_position) @ body.base_rotation
        standing, limbs = self.reach_at(feet), np.eye(len(feet), dtype=bool)

        def follows(position: Array) -> Array:
            point = (position - body.base_position) @ body.base_rotation
            landed, found = self.reach_at(point), []
            for limb, own in enumerate(limbs):
                place = self.over(jnp.where(own[:, None], position, situation.feet))
                move = (place - body.base_position) @ body.base_rotation
                found.append(standing(feet - move).all() & landed(point - move)[limb])
            return jnp.stack(found)

        return follows

    def reach_at(self, points: Array) -> Answer:
        """Which limbs reach points (limb, 3) m of the base's axes; by the table, as high over the base as `points`."""
        if self.table is None:
            return functools.partial(within_reach, self.robot, self.geometry)
        return functools.partial(within_ranges, self.table, ranges(self.table, points))

    def over(self, feet: Array) -> Array:
        """Where the base is to be over feet (limb, 3) m, (3,) m: as over those of the rest stance."""
        return middle_of(feet) + self.plan.base_start - middle_of(self.plan.footholds)


def next_way(
    way_points: tuple[tuple[float, float], ...], reached: Array, base: Array, advance: Array
) -> tuple[Array, Array]:
    """Return how many way points are reached, (), and the way of the base in the next cycle, (3,) m.

    It leads to the next way point; one is reached at half a stride, the length of `advance` (3,) m. `base` (3,) m is on
    the base's path.
    """
    stride, points = norm(advance), jnp.asarray(way_points, advance.dtype)

    def left(reached: Array) -> Array:
        point = points[0]
        for number in range(1, len(points)):
            point = jnp.where(reached >= number, points[number], point)
        return point - base[:2]

    there = (reached < len(points)) & (norm(left(reached)) <= stride / 2)
    reached = reached + there
    way = left(reached)
    share = jnp.where(reached < len(points), jnp.minimum(stride / norm(way, at_zero=1.0), 1.0), 0.0)
    return reached, jnp.concatenate([share * way, jnp.zeros_like(way[:1])])


def situation_of(plan: Plan, swings: Swings, body: Body, advance: Array) -> Situation:
    """Return the situation as it is known without the limbs that lift off; `advance` (3,) m, of a cycle."""
    if swings.held is None:
        pull = body.holding_force * upright(swings.goal)
    else:
        pull = pulls_of_holds(swings.held, body.holding_force)
    length = jnp.sqrt((advance * advance).sum())
    return Situation(
        feet=swings.goal, planned=swings.goal + advance, forward=advance / jnp.where(length > 0, length, 1.0),
        stands=body.support, center_of_mass=body.center_of_mass + plan.swing_steps / plan.cycle_steps * advance,
        weight=body.weight, holding_force=body.holding_force, pull=pull,
    )  # fmt: skip


def towards(reach: Answer, feet: Array, rotation: Array, start: Array, goal: Array) -> Array:
    """Return the place (3,) m of a base on its way from start to goal, as far as feet (limb, 3) m stay within reach."""
    place = start
    for share in _SHARES:
        ahead = start + share * (goal - start)
        place = jnp.where(reach((feet - ahead) @ rotation).all(), ahead, place)
    return place


def middle_of(feet: Array) -> Array:
    """Return the point over which the base stands, (3,) m, of feet (limb, 3) m in order around it.

    It is level with the feet's mean and nearest, in the sum of squared level distances, to the lines between opposite
    feet: where the diagonals of four feet meet. With an odd number of limbs it is the feet's mean.
    """
    count, mean = len(feet), feet.mean(0)
    if count % 2 or count < 4:
        return mean
    one, other = feet[: count // 2, :2], feet[count // 2 :, :2]
    way = other - one
    squared = (way * way).sum(1)
    along = way / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))[:, None]
    # I - u u^T of each line, summed, in the two level axes
    xx, yy, xy = (1 - along[:, 0] ** 2).sum(), (1 - along[:, 1] ** 2).sum(), -(along[:, 0] * along[:, 1]).sum()
    off = one - mean[:2]
    across = off - (off * along).sum(1)[:, None] * along
    right = across.sum(0)
    determinant = xx * yy - xy * xy
    crosses = determinant > 1e-6 * count
    safe = jnp.where(crosses, determinant, 1.0)
    x, y = (yy * right[0] - xy * right[1]) / safe, (xx * right[1] - xy * right[0]) / safe
    meet = jnp.where(crosses, jnp.stack([x, y]), 0.0)
    return jnp.concatenate([mean[:2] + meet, mean[2:]])
