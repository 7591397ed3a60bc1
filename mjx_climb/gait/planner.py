"""The planner: in a loop of its own, slower than that of the joints, it chooses footholds and interrupts the gait.

What it decides is a `Progress`, which changes at its ticks alone; between them schedule and reference are functions of
it and of the step. A limb swings from where it stands to where the planner wants it. The base follows the planned
path, or, where footholds are chosen, moves with each swing over the point where the lines between opposite feet meet
(ClimbLab's rule), as far as all feet stay within reach: ahead, or from way point to way point.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import PyTree

from mjx_climb.arrays import AnyArray, Tree
from mjx_climb.control import Reference
from mjx_climb.gait.base_path import swayed
from mjx_climb.gait.footholds.footholds import AHEAD, SAME, Candidate, Footholds, Prospects, Situation, pull_of_grip
from mjx_climb.gait.recovery import Body, Recovery, danger, interrupts, stopping_margin, ways_beside
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
from mjx_climb.ground import Holds, pull_within
from mjx_climb.physics.inverse_kinematics import Chain, LimbGeometry, inverse_kinematics
from mjx_climb.physics.kinematics import UP, Surface
from mjx_climb.physics.spatial import norm
from mjx_climb.robot.constants import Robot

_ALONG = 1e-4  # sine of the angle of directions that count as along each other
_NEAR = 0.1  # share of a swing within which the foot is near its hold: some 3 % of the way
_TINY = 1e-9  # N
_SHARES = (0.25, 0.5, 0.75, 1.0)  # of a move of the base, of which the largest is made that the feet allow
_SPARE = 0.05  # of the length of a limb, which is never stretched farther
_ROUNDS = 4  # of inverse kinematics without a closed form, from the rest stance


class Held(NamedTuple):
    """The holds of limbs; they bear forces f of the ground on the foot, world axes, with `rows f <= bound`."""

    normal: Array  # (limb, 3) 1, unit, out of the ground
    rows: Array  # (limb, m, 3)
    bound: Array  # (limb, m) N


class Planner(NamedTuple):
    """What decides, and what it knows that stays the same."""

    robot: Robot
    geometry: LimbGeometry | Chain
    plan: Plan
    rule: Footholds | None  # None: the planned footholds
    holds: Holds | None
    recovery: Recovery | None
    period: int  # steps between ticks
    moves: int  # of the base in a cycle: the lift-offs
    time_step: float
    free: bool = False  # the limb that gains most is next, in place of the order of the periodic gait
    way_points: tuple[tuple[float, float], ...] = ()  # m, world, that the base walks to in turn; none: it walks ahead


class Progress(NamedTuple):
    """What the planner has decided; times in steps."""

    step: Array  # () of the last tick
    clock: Array  # () the gait's own time then
    running: Array  # () 1 or 0: whether that time goes on
    resumes: Array  # () step at which it does
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
    offset: Array  # (3,) m, of the base reference from its path
    offset_since: Array  # () the gait's time since which it shrinks
    force: Array  # (limb, 3) N, on the feet at the last tick
    interruptions: Array  # () number of interruptions
    held: Held | None = None  # at the goals; None: there are no holds
    left: Array | None = None  # (limb, 3) 1, normals of the ground where the last swings began
    reached: Array | None = None  # () number of way points that the base has reached; None: there are none


def begin(planner: Planner, base_position: Array) -> Progress:
    """Return the progress of a robot that stands on its first footholds and has not swung."""
    plan, zero = planner.plan, jnp.zeros_like(planner.plan.cycle_steps)
    feet, limbs = first_footholds(plan), jnp.zeros_like(plan.swing_offset)
    held = _no_holds(planner.holds, feet)
    begun = plan.swing_offset - 2 * plan.cycle_steps
    return Progress(
        step=zero, clock=zero, running=zero + 1, resumes=zero, start=feet, goal=feet, below=feet[:, 2], begun=begun,
        span=limbs + plan.swing_steps, rise=limbs + plan.step_height, touched=begun + plan.swing_steps,
        base_start=base_position, base_goal=base_position, base_begun=zero, offset=jnp.zeros_like(base_position),
        offset_since=zero, force=jnp.zeros_like(feet), interruptions=zero, held=held,
        left=None if held is None else held.normal, reached=zero if planner.way_points else None,
    )  # fmt: skip


def _no_holds(holds: Holds | None, feet: Array) -> Held | None:
    """Return the holds of feet (limb, 3) m on level ground without limits; None where there are no holds."""
    if holds is None:
        return None
    rows = holds.limit_bound.shape[1]
    bound = jnp.full_like(feet, jnp.inf, shape=(len(feet), rows))
    return Held(_up(feet), jnp.zeros_like(feet, shape=(len(feet), rows, 3)), bound)


def _up(feet: Array) -> Array:
    """Return the normals (limb, 3) of level ground."""
    return jnp.broadcast_to(jnp.array(UP, feet.dtype), feet.shape)


# --- between ticks


def clock_at(progress: Progress, step: Array) -> Array:
    """Return the gait's own time at a step, () steps."""
    return progress.clock + progress.running * (step.astype(progress.clock.dtype) - progress.step)


def schedule_at(planner: Planner, progress: Progress, step: Array) -> Schedule:
    """Return the phases of the limbs at a step, () integer; `foothold` is that of the periodic gait.

    In a free order a limb is known to lift off once it is chosen; the others are not expected to within a cycle.
    """
    plan = planner.plan
    clock, now = clock_at(progress, step), step.astype(progress.clock.dtype)
    periodic, elapsed = schedule(plan, clock), now - progress.begun
    closed = (elapsed < 0) | (elapsed >= progress.span)
    since_lift_off = jnp.mod(clock - plan.swing_offset, plan.cycle_steps)
    until = plan.cycle_steps - since_lift_off
    if planner.free:
        until = jnp.where(elapsed < 0, -elapsed, plan.cycle_steps)
    stood = jnp.where(elapsed < 0, now - progress.touched, elapsed - progress.span)
    return periodic._replace(
        closed=closed,
        swing_phase=elapsed / progress.span,
        until_lift_off=jnp.where(closed, until, 0.0),
        since_touchdown=jnp.where(closed, stood, 0.0),
    )


def ground_at(progress: Progress, now: Schedule) -> Array:
    """Return the height of the ground below each foot, (limb,) m."""
    return jnp.where(now.swing_phase < 0.5, progress.below, progress.goal[:, 2])


def surface_at(planner: Planner, progress: Progress, now: Schedule) -> Surface | None:
    """Return the planes of the ground at the feet; None where there are no holds.

    That of a hold counts near it alone: at the beginning and the end of a swing. Between them the ground is level.
    """
    if progress.held is None or progress.left is None:
        return None
    phase = now.swing_phase / (1 - planner.plan.settling)
    first, last = (phase < _NEAR)[:, None], (phase >= 1 - _NEAR)[:, None]
    normal = jnp.where(last, progress.held.normal, jnp.where(first, progress.left, _up(progress.goal)))
    place = jnp.where(first, progress.start, progress.goal)
    return Surface(jnp.concatenate([place[:, :2], ground_at(progress, now)[:, None]], axis=1), normal)


def share_of_limits(held: Held, now: Schedule, foot_force: Array) -> Array:
    """Return the largest share of a hold's limit that forces (limb, 3) N of the ground on the feet use up, (limb,)."""
    used = (held.rows * foot_force[:, None]).sum(2)
    # a limit of 0 is passed by any force
    share = jnp.where(used > 0, used / jnp.maximum(held.bound, _TINY), 0.0).max(1, initial=0.0)
    return jnp.where(now.swing_phase >= 1, share, 0.0)


def pulls_of_feet(progress: Progress, now: Schedule, surface: Surface | None, holding_force: Array) -> Array:
    """Return the pulls that margins may count on, () N; on holds (limb, 3) N, each foot's times its hold's normal.

    `holding_force` () N is that of the contact; 0: it names none, and that of the hold counts.
    """
    if progress.held is None or surface is None:
        return holding_force
    bound = jnp.where((now.swing_phase >= 1)[:, None], progress.held.bound, jnp.inf)
    return pulls_of_holds(Held(surface.normal, progress.held.rows, bound), holding_force)


def pulls_of_holds(held: Held, holding_force: Array) -> Array:
    """Return the pulls that grips on holds bear, (limb, 3) N, each times the hold's normal; `holding_force` () N."""
    most = pull_within(-(held.rows * held.normal[:, None]).sum(2), held.bound)
    return pull_of_grip(most, holding_force)[:, None] * held.normal


def reference_at(
    planner: Planner, progress: Progress, now: Schedule, step: Array, start: Array, grip_point: Array
) -> Reference:
    """Return the reference at a step; shut grippers stay where they grip, (limb, 3) m, world.

    `start` (3,) m is where the base began its cycle, on the planned path.
    """
    return Reference(
        base_position=_path_at(planner, progress, now, step, start) + _offset_at(planner, progress, step),
        base_orientation=planner.plan.base_orientation,
        foot_position=foot_targets_at(planner.plan, progress, now, grip_point),
        until_lift_off=now.until_lift_off * planner.time_step,
        since_touchdown=now.since_touchdown * planner.time_step,
    )


def _path_at(planner: Planner, progress: Progress, now: Schedule, step: Array, start: Array) -> Array:
    """Return where the base should be, (3,) m, as far as nothing has interrupted the walk."""
    plan = planner.plan
    if planner.rule is None:
        return base_reference(plan, now, start)
    span = plan.cycle_steps / planner.moves
    phase = jnp.clip((clock_at(progress, step) - progress.base_begun) / span, 0.0, 1.0)
    position = progress.base_start + rest_to_rest(phase) * (progress.base_goal - progress.base_start)
    return position if plan.sway is None else position + swayed(plan.sway, now.cycle_phase)


def _offset_at(planner: Planner, progress: Progress, step: Array) -> Array:
    """Return how far the base reference is from its path, (3,) m."""
    if planner.recovery is None:
        return progress.offset
    steps = jnp.maximum(planner.recovery.return_time / planner.time_step, 1.0)
    phase = jnp.clip((clock_at(progress, step) - progress.offset_since) / steps, 0.0, 1.0)
    return progress.offset * (1 - rest_to_rest(phase))


def foot_targets_at(plan: Plan, progress: Progress, now: Schedule, grip_point: Array) -> Array:
    """Return where the feet should be, (limb, 3) m in world axes; swings are those of `gait.schedule.foot_targets`."""
    phase = settled_phase(plan, now)
    swing = progress.start + rest_to_rest(phase)[:, None] * (progress.goal - progress.start)
    swing, height = arc(plan, phase, swing, progress.start[:, 2], progress.goal[:, 2], progress.rise)
    target = jnp.concatenate([swing[:, :2], height[:, None]], axis=1)
    return jnp.where(now.closed[:, None], grip_point, target)


# --- at ticks


def tick(
    planner: Planner,
    progress: Progress,
    now: Schedule,
    step: Array,
    reference: Reference,
    base: tuple[Array, Array],
    grip_point: Array,
    body: Body,
) -> Progress:
    """Return the progress after the decisions of a step.

    Arguments:
        now: schedule at that step.
        reference: at that step, without an interruption now.
        base: position (3,) m and rotation (3, 3) of the base, world.
        grip_point: (limb, 3) m, where feet grip or last gripped.
        body: of the robot.
    """
    at, clock = step.astype(progress.clock.dtype), clock_at(progress, step)
    offset = _offset_at(planner, progress, step)
    if planner.recovery is not None:
        progress = _interrupted(planner, planner.recovery, progress, now, at, clock, reference, base, body)
        stands_still = progress.resumes > at
        # an offset begins to shrink when the gait goes on
        progress = progress._replace(
            running=jnp.where(stands_still, 0.0, 1.0).astype(clock.dtype),
            force=body.foot_force,
        )
    progress = progress._replace(step=at, clock=clock)
    return _lifted_off(planner, progress, now, at, reference.base_position - offset, base, grip_point, body)


def _lifted_off(
    planner: Planner,
    progress: Progress,
    now: Schedule,
    at: Array,
    base_path: Array,
    base: tuple[Array, Array],
    grip_point: Array,
    body: Body,
) -> Progress:
    """Return the progress with swings of the limbs that lift off before the next tick."""
    plan, clock = planner.plan, progress.clock
    unswayed = base_path if plan.sway is None else base_path - swayed(plan.sway, now.cycle_phase)
    progress, advance = _on_its_way(planner, progress, unswayed)
    # of the base until the touchdown, where the other feet may keep it, and until the next lift-off
    ways = jnp.zeros_like(advance), advance
    situation = situation_of(plan, progress, body, advance)
    if planner.free and planner.rule is not None and planner.holds is not None:
        wait = jnp.maximum(plan.cycle_steps / planner.moves - plan.swing_steps, 0.0)
        stand = (at >= progress.begun + progress.span).all() & (progress.running > 0)
        look, none = planner.holds, Prospects.none(situation.feet)
        prospects = jax.lax.cond(stand, lambda: prospects_of(planner, look, situation, base, ways), lambda: none)
        lifts = stand & _first_largest(planner.rule.limb_worth(prospects))
    else:
        wait = jnp.mod(plan.swing_offset - clock, plan.cycle_steps)
        lifts = now.closed & (at >= progress.begun) & (wait < planner.period) & (progress.running > 0)
        ahead = (
            _planned(plan, clock + wait) if progress.reached is None else _beside(planner, progress, unswayed, advance)
        )
        situation = situation._replace(planned=ahead)
    if progress.reached is not None:
        lifts = lifts & (progress.reached < len(planner.way_points))
    chosen, goal, height = situation.planned, progress.goal, progress.goal[:, 2]
    if planner.rule is not None and planner.holds is not None:
        rule, holds, now_there = planner.rule, planner.holds, (progress.goal, progress.held)
        situation = situation._replace(stands=~lifts)
        # the loop over holds is carried out where it is needed alone
        chosen, held = jax.lax.cond(
            lifts.any(), lambda: choose(planner, rule, holds, situation, base, ways, progress.held), lambda: now_there
        )
        if progress.held is not None:
            height = grip_point[:, 2]
            progress = _with_holds(progress, lifts, held, progress.held.normal)
    each = lifts[:, None]
    goal = jnp.where(each, chosen, goal)
    progress = progress._replace(
        start=jnp.where(each, grip_point, progress.start),
        goal=goal,
        below=jnp.where(lifts, height, progress.below),
        begun=jnp.where(lifts, at + wait, progress.begun),
        span=jnp.where(lifts, plan.swing_steps, progress.span),
        rise=jnp.where(lifts, plan.step_height, progress.rise),
        touched=jnp.where(lifts, progress.begun + progress.span, progress.touched),
    )
    if planner.rule is None:
        return progress
    moves = lifts.any()
    middle = middle_of(goal) + plan.base_start - middle_of(plan.footholds)
    return progress._replace(
        base_start=jnp.where(moves, unswayed, progress.base_start),
        base_goal=jnp.where(moves, towards(planner, goal, base[1], unswayed, middle), progress.base_goal),
        base_begun=jnp.where(moves, clock, progress.base_begun),
    )


def situation_of(plan: Plan, progress: Progress, body: Body, advance: Array) -> Situation:
    """Return the situation as it is known without the limbs that lift off; `advance` (3,) m, of a cycle."""
    if progress.held is None:
        pull = body.holding_force * _up(progress.goal)
    else:
        pull = pulls_of_holds(progress.held, body.holding_force)
    return Situation(
        feet=progress.goal, planned=progress.goal + advance, forward=_direction(advance), stands=body.support,
        center_of_mass=body.center_of_mass + plan.swing_steps / plan.cycle_steps * advance,
        weight=body.weight, holding_force=body.holding_force, pull=pull,
    )  # fmt: skip


def towards(planner: Planner, feet: Array, rotation: Array, start: Array, goal: Array) -> Array:
    """Return the place (3,) m of a base on its way from start to goal, as far as feet (limb, 3) m stay within reach."""
    place = start
    for share in _SHARES:
        ahead = start + share * (goal - start)
        place = jnp.where(within_reach(planner.robot, planner.geometry, (feet - ahead) @ rotation).all(), ahead, place)
    return place


def _planned(plan: Plan, lift_off: Array) -> Array:
    """Return the footholds (limb, 3) m of the periodic gait for swings that begin at its times (limb,) steps."""
    number = jnp.floor((lift_off + 0.5) / plan.cycle_steps) + 1
    points = plan.footholds + number[:, None] * plan.advance
    return jnp.concatenate([points[:, :2], points[:, 2:] + foothold_height(plan, number)[:, None]], axis=1)


def _direction(advance: Array) -> Array:
    """Return the direction of travel, (3,)."""
    length = jnp.sqrt((advance * advance).sum())
    return advance / jnp.where(length > 0, length, 1.0)


def _on_its_way(planner: Planner, progress: Progress, base: Array) -> tuple[Progress, Array]:
    """Return the progress with the way points reached, and the way of the base in the next cycle, (3,) m.

    It leads to the next way point; one is reached at half a stride. `base` (3,) m is on the base's path.
    """
    advance, reached = planner.plan.advance, progress.reached
    if reached is None:
        return progress, advance
    stride, points = norm(advance), jnp.asarray(planner.way_points, advance.dtype)

    def left(reached: Array) -> Array:
        point = points[0]
        for number in range(1, len(points)):
            point = jnp.where(reached >= number, points[number], point)
        return point - base[:2]

    there = (reached < len(points)) & (norm(left(reached)) <= stride / 2)
    reached = reached + there
    way = left(reached)
    share = jnp.where(reached < len(points), jnp.minimum(stride / norm(way, at_zero=1.0), 1.0), 0.0)
    return progress._replace(reached=reached), jnp.concatenate([share * way, jnp.zeros_like(way[:1])])


def _beside(planner: Planner, progress: Progress, base: Array, advance: Array) -> Array:
    """Return the footholds (limb, 3) m at which limbs that lift off now keep pace with a base at (3,) m."""
    plan = planner.plan
    # limbs swing one after the other: those that have waited longer stand farther behind
    share = (planner.moves + 1) / (2 * planner.moves)
    place = base + plan.footholds - plan.base_start + share * advance
    return jnp.concatenate([place[:, :2], progress.goal[:, 2:]], axis=1)


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


def choose(
    planner: Planner,
    rule: Footholds,
    holds: Holds,
    situation: Situation,
    base: tuple[Array, Array],
    ways: tuple[Array, Array],
    held: Held | None,
) -> tuple[Array, Held | None]:
    """Return where each limb would swing to, (limb, 3) m, and the hold there; where it stands, if it reaches none.

    Arguments:
        base: position (3,) m and rotation (3, 3) of the base, now.
        ways: (3,) m each, of the base until the touchdown and until the next lift-off: limbs reach a hold from both.
        held: where limbs stand.
    """

    def score(position: Array, one: Candidates) -> Array:
        return rule.score(situation, one.with_feet(position, situation.holding_force))

    def allowed(position: Array) -> Array:
        return _allowed(planner, situation, base, ways, position)

    def of_all(position: Array) -> Array:
        return jnp.broadcast_to(position, situation.feet.shape)

    each = Candidates.of(holds)
    return _best(score, allowed, of_all, each, (situation.feet, held), situation.weight)


def _allowed(
    planner: Planner, situation: Situation, base: tuple[Array, Array], ways: tuple[Array, Array], position: Array
) -> Array:
    """Return which limbs may swing to points (limb, 3) m, (limb,) bool: they reach them, and no other limb is there."""
    apart = jnp.sum((position[:, None] - situation.feet) ** 2, axis=2) > SAME**2
    others = ~np.eye(len(position), dtype=bool)
    free = (apart | ~others).all(1)
    for way in ways:
        free = free & within_reach(planner.robot, planner.geometry, (position - base[0] - way) @ base[1])
    return free


def prospects_of(
    planner: Planner, holds: Holds, situation: Situation, base: tuple[Array, Array], ways: tuple[Array, Array]
) -> Prospects:
    """Return the prospects of each limb; arguments as of `choose`."""

    def look(found: Prospects, hold: tuple[Array, Array]) -> tuple[Prospects, None]:
        point, valid = hold
        position = stop_gradient(jnp.broadcast_to(point, situation.feet.shape))
        step = position - situation.feet
        ahead = (step * situation.forward).sum(1)
        may = _allowed(planner, situation, base, ways, position) & (valid > 0)
        near = may & (ahead > 0) & ((step * step).sum(1) <= AHEAD**2)
        farthest = jnp.where(may, jnp.maximum(found.farthest, ahead), found.farthest)
        return Prospects(farthest, found.near + near), None

    found, _ = jax.lax.scan(look, Prospects.none(situation.feet), (holds.position, holds.valid))
    return Prospects(*map(stop_gradient, found))


def _first_largest(values: Array) -> Array:
    """Return which of values (limb,) is the largest, of equal ones the first, (limb,) bool."""
    largest, before, found = values.max(), jnp.asarray(False), []
    for limb in range(len(values)):
        is_it = (values[limb] == largest) & ~before
        before = before | is_it
        found.append(is_it)
    return jnp.stack(found)


class Candidates(NamedTuple):
    """Points to choose among, by their number."""

    vector: Array  # (n, 3), what makes the limbs' points
    valid: Array  # (n,) 1: one, 0: padding
    holds: tuple[Array, Array, Array] | None = None  # (n, 3) normals, (n, m, 3) and (n, m) N, limits in their axes

    @classmethod
    def of(cls, holds: Holds) -> "Candidates":
        """The holds of a ground."""
        return cls(holds.position, holds.valid, (holds.normal, holds.limit_matrix, holds.limit_bound))

    def with_feet(self, position: Array, holding_force: Array) -> Candidate:
        """One of them as rules see it, with the limbs' feet at (limb, 3) m, for grips that bear () N; 0: any."""
        if self.holds is None:
            return Candidate(position, holding_force, jnp.array(UP, position.dtype))
        normal, matrix, bound = self.holds
        return Candidate(position, pull_of_grip(pull_within(-matrix[..., 2], bound), holding_force), normal)


def _best(
    score: Callable[[Array, Candidates], Array],
    allowed: Callable[[Array], Array],
    of_limbs: Callable[[Array], Array],
    candidates: Candidates,
    otherwise: tuple[Array, Held | None],
    weight: Array,
) -> tuple[Array, Held | None]:
    """Return the points of the largest score, (limb, 3) m, of several the first, and the holds there.

    Arguments:
        score: of points (limb, 3) m of a candidate, (limb,).
        allowed: whether points may be chosen, (limb,) bool.
        of_limbs: gives the points (limb, 3) m at which the limbs would hold a candidate at (3,) m.
        otherwise: points and holds where none is allowed.
        weight: (3,) N, by which holds have their axes.
    """

    def look(best: tuple[Array, Array, PyTree], one: Candidates) -> tuple[PyTree, None]:
        worth, place, found_hold = best
        position = of_limbs(one.vector)
        frozen = stop_gradient(position)
        found = stop_gradient(jnp.where(allowed(frozen) & (one.valid > 0), score(frozen, one), -jnp.inf))
        better = found > worth
        place, found_hold = _of_some(better, (position, one.holds), (place, found_hold))
        return (jnp.where(better, found, worth), place, found_hold), None

    place, held = otherwise
    worst, before = jnp.full_like(place[:, 0], -jnp.inf), None
    if candidates.holds is not None:
        before = tuple(jnp.zeros_like(each, shape=(len(place), *each.shape[1:])) for each in candidates.holds)
    (worth, place, hold), _ = jax.lax.scan(look, (worst, place, before), candidates)
    if held is None or hold is None:
        return place, held
    normal, matrix, bound = hold
    axes = jnp.stack([hold_axes(each, weight) for each in normal])
    return place, _of_some(worth > -jnp.inf, Held(normal, matrix @ axes.mT, bound), held)


def _of_some(some: Array, new: Tree, old: Tree) -> Tree:
    """Return trees of arrays with the limbs in front, of which those of some limbs (limb,) are new."""
    each: Tree = jax.tree.map(lambda a, b: jnp.where(some.reshape(-1, *[1] * (b.ndim - 1)), a, b), new, old)
    return each


def _with_holds(progress: Progress, some: Array, held: Held | None, left: Array | None) -> Progress:
    """Return the progress in which some limbs (limb,) swing to holds, from ground of normals (limb, 3)."""
    if progress.held is None or progress.left is None or held is None or left is None:
        return progress
    return progress._replace(held=_of_some(some, held, progress.held), left=_of_some(some, left, progress.left))


def hold_axes(normal: Array, weight: Array) -> Array:
    """Return the axes of a hold as columns (3, 3): up the surface, across it, along the normal (3,).

    Up is against the weight (3,), or where that is along the normal the world's x, else its y.
    """
    length = norm(weight)
    x, y = jnp.eye(3, dtype=normal.dtype)[:2]
    up = y - (y @ normal) * normal
    for way in (x, -weight / jnp.where(length > 0, length, 1.0)):
        along = way - (way @ normal) * normal
        up = jnp.where(norm(along) > _ALONG, along, up)
    up = up / norm(up, at_zero=1.0)
    return jnp.stack([up, jnp.cross(normal, up), normal], axis=1)


def within_reach(robot: Robot, geometry: LimbGeometry | Chain, target: AnyArray) -> AnyArray:
    """Return whether limbs reach points (limb, 3) m of the base's axes within their joints' limits, (limb,) bool.

    They must reach a little farther from their first joints: a limb that is stretched straight cannot give way, and
    its joint gains are stiffer at the foot than a time step allows.
    """
    target = target + _SPARE * (target - robot.frame_position[:, 0])
    solution = inverse_kinematics(geometry, target)
    if isinstance(geometry, Chain):
        for _ in range(_ROUNDS - 1):
            solution = inverse_kinematics(geometry, target, solution.joint_angles)
    angles = solution.joint_angles
    return solution.reachable & ((angles >= robot.joint_lower) & (angles <= robot.joint_upper)).all(-1)


def _interrupted(
    planner: Planner,
    recovery: Recovery,
    progress: Progress,
    now: Schedule,
    at: Array,
    clock: Array,
    reference: Reference,
    base: tuple[Array, Array],
    body: Body,
) -> Progress:
    """Return the progress with the gait interrupted, where the robot is in danger."""
    time_step, offset = planner.time_step, _offset_at(planner, progress, at)
    rate = (body.foot_force - progress.force) / (planner.period * time_step)
    shift = base[0] - reference.base_position
    near = danger(recovery, body, rate, shift)
    if progress.held is not None:
        force = body.foot_force + recovery.lead_time * rate
        share = jnp.where(body.support, share_of_limits(progress.held, now, force), 0.0).max()
        near = near._replace(utilization=jnp.maximum(near.utilization, share))
    stops = interrupts(recovery, near) & (at > 0)
    landing_steps = jnp.ceil(recovery.landing_time / time_step) + 1
    left = progress.span - (at - progress.begun)
    lands = ~now.closed & stops & (left > landing_steps)
    ground = ground_at(progress, now)

    def score(position: Array, one: Candidates) -> Array:
        grip = one.with_feet(position, body.holding_force)
        pull = grip.pull if one.holds is None else jnp.where(lands[:, None], grip.pull * grip.normal, body.pull)
        worth = stopping_margin(recovery, body._replace(pull=pull), lands, position)
        # of equal ones the nearest
        return worth - 1e-6 * jnp.sum((position - reference.foot_position) ** 2, axis=1)

    def allowed(position: Array) -> Array:
        ahead = base[0] + recovery.landing_time * body.velocity
        return jnp.asarray(within_reach(planner.robot, planner.geometry, (position - ahead) @ base[1]))

    below = jnp.concatenate([reference.foot_position[:, :2], ground[:, None]], axis=1)
    if planner.holds is None:
        ways = ways_beside(below.dtype) * recovery.reach
        each = Candidates(ways, jnp.ones_like(ways[:, 0]))
        of_limbs, otherwise = (lambda way: below + way), (below, progress.held)
    else:
        each, otherwise = Candidates.of(planner.holds), (progress.goal, progress.held)
        of_limbs = lambda point: jnp.broadcast_to(point, below.shape)  # noqa: E731
    place, held = jax.lax.cond(
        lands.any(), lambda: _best(score, allowed, of_limbs, each, otherwise, body.weight), lambda: otherwise
    )
    progress = _with_holds(progress, lands, held, _up(below))
    one = lands[:, None]
    stood_still = progress.resumes > at
    return progress._replace(
        resumes=jnp.where(stops, at + landing_steps + jnp.ceil(recovery.rest_time / time_step), progress.resumes),
        start=jnp.where(one, reference.foot_position, progress.start),
        goal=jnp.where(one, place, progress.goal),
        below=jnp.where(lands, ground, progress.below),
        begun=jnp.where(lands, at, progress.begun),
        span=jnp.where(lands, landing_steps, progress.span),
        rise=jnp.where(lands, 0.0, progress.rise),
        offset=jnp.where(stops, offset + recovery.take_over * shift, progress.offset),
        offset_since=jnp.where(stops, clock, progress.offset_since),
        interruptions=progress.interruptions + jnp.where(stops & ~stood_still, 1.0, 0.0),
    )
