"""The planner: in a loop of its own, slower than that of the joints, it chooses footholds and interrupts the gait.

What it decides is a `Progress`, which changes at its ticks alone; between them schedule and reference are functions of
it and of the step. A limb swings from where it stands to where the planner wants it. The base follows the planned
path, or, where footholds are chosen, moves with each swing over the point where the lines between opposite feet meet
(ClimbLab's rule).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import PyTree

from mjx_climb.control import Reference
from mjx_climb.gait.base_path import swayed
from mjx_climb.gait.footholds.footholds import AHEAD, SAME, Candidate, Footholds, Prospects, Situation, pulls
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
from mjx_climb.ground import Holds
from mjx_climb.physics.inverse_kinematics import Chain, LimbGeometry, inverse_kinematics
from mjx_climb.physics.spatial import norm
from mjx_climb.robot.constants import Robot

_ALONG = 1e-4  # sine of the angle of directions that count as along each other
_ROUNDS = 4  # of inverse kinematics without a closed form, from the rest stance


class Limits(NamedTuple):
    """Forces f that holds bear, of the ground on the foot, world axes: `rows f <= bound`."""

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
    limits: Limits | None = None  # of the holds at the goals; None: holds have none


def begin(planner: Planner, base_position: Array) -> Progress:
    """Return the progress of a robot that stands on its first footholds and has not swung."""
    plan, zero = planner.plan, jnp.zeros_like(planner.plan.cycle_steps)
    feet, limbs = first_footholds(plan), jnp.zeros_like(plan.swing_offset)
    begun = plan.swing_offset - 2 * plan.cycle_steps
    return Progress(
        step=zero, clock=zero, running=zero + 1, resumes=zero, start=feet, goal=feet, below=feet[:, 2], begun=begun,
        span=limbs + plan.swing_steps, rise=limbs + plan.step_height, touched=begun + plan.swing_steps,
        base_start=base_position, base_goal=base_position, base_begun=zero, offset=jnp.zeros_like(base_position),
        offset_since=zero, force=jnp.zeros_like(feet), interruptions=zero, limits=_no_limits(planner.holds, feet),
    )  # fmt: skip


def _no_limits(holds: Holds | None, feet: Array) -> Limits | None:
    """Return the limits of feet (limb, 3) that stand on no hold, None where no hold has one."""
    rows = 0 if holds is None else holds.limit_bound.shape[1]
    if not rows:
        return None
    bound = jnp.full_like(feet, jnp.inf, shape=(len(feet), rows))
    return Limits(jnp.zeros_like(feet, shape=(len(feet), rows, 3)), bound)


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


def overloaded(progress: Progress, now: Schedule, foot_force: Array) -> Array:
    """Return which holds bear less than forces of the ground on the feet, (limb, 3) N, (limb,) bool."""
    if progress.limits is None:
        return jnp.zeros_like(now.closed)
    used = (progress.limits.rows * foot_force[:, None]).sum(2)
    return (now.swing_phase >= 1) & (used > progress.limits.bound).any(1)


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
    swing = plan.swing_steps / plan.cycle_steps
    ways = swing * plan.advance, plan.advance  # of the base until the touchdown, and until the next lift-off
    situation = Situation(
        feet=progress.goal, planned=progress.goal + plan.advance, forward=_forward(plan), stands=body.support,
        center_of_mass=body.center_of_mass + ways[0], weight=body.weight, holding_force=body.holding_force,
    )  # fmt: skip
    if planner.free and planner.rule is not None and planner.holds is not None:
        wait = jnp.maximum(plan.cycle_steps / planner.moves - plan.swing_steps, 0.0)
        stand = (at >= progress.begun + progress.span).all() & (progress.running > 0)
        prospects = prospects_of(planner, planner.holds, situation, base, ways)
        lifts = stand & _first_largest(planner.rule.limb_worth(prospects))
    else:
        wait = jnp.mod(plan.swing_offset - clock, plan.cycle_steps)
        lifts = now.closed & (at >= progress.begun) & (wait < planner.period) & (progress.running > 0)
        situation = situation._replace(planned=_planned(plan, clock + wait))
    chosen, goal, height = situation.planned, progress.goal, progress.goal[:, 2]
    if planner.rule is not None and planner.holds is not None:
        situation = situation._replace(stands=~lifts)
        chosen, limits = choose(planner, planner.rule, planner.holds, situation, base, ways, progress.limits)
        progress = progress._replace(limits=_of_some(lifts, limits, progress.limits))
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
    unswayed = base_path if plan.sway is None else base_path - swayed(plan.sway, now.cycle_phase)
    middle = middle_of(goal) + plan.base_start - middle_of(plan.footholds)
    return progress._replace(
        base_start=jnp.where(moves, unswayed, progress.base_start),
        base_goal=jnp.where(moves, middle, progress.base_goal),
        base_begun=jnp.where(moves, clock, progress.base_begun),
    )


def _planned(plan: Plan, lift_off: Array) -> Array:
    """Return the footholds (limb, 3) m of the periodic gait for swings that begin at its times (limb,) steps."""
    number = jnp.floor((lift_off + 0.5) / plan.cycle_steps) + 1
    points = plan.footholds + number[:, None] * plan.advance
    return jnp.concatenate([points[:, :2], points[:, 2:] + foothold_height(plan, number)[:, None]], axis=1)


def _forward(plan: Plan) -> Array:
    """Return the direction of travel, (3,)."""
    length = jnp.sqrt((plan.advance * plan.advance).sum())
    return plan.advance / jnp.where(length > 0, length, 1.0)


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
    limits: Limits | None,
) -> tuple[Array, Limits | None]:
    """Return the hold that each limb would swing to, (limb, 3) m, and its limits; where it stands, if it reaches none.

    Arguments:
        base: position (3,) m and rotation (3, 3) of the base, now.
        ways: (3,) m each, of the base until the touchdown and until the next lift-off: limbs reach a hold from both.
        limits: of the holds where limbs stand.
    """

    def score(position: Array, pull: Array) -> Array:
        return rule.score(situation, Candidate(position, pull))

    def allowed(position: Array) -> Array:
        return _allowed(planner, situation, base, ways, position)

    def of_all(position: Array) -> Array:
        return jnp.broadcast_to(position, situation.feet.shape)

    each = Candidates.of(holds, situation.holding_force)
    return _best(score, allowed, of_all, each, (situation.feet, limits), situation.weight)


def _allowed(
    planner: Planner, situation: Situation, base: tuple[Array, Array], ways: tuple[Array, Array], position: Array
) -> Array:
    """Return which limbs may swing to points (limb, 3) m, (limb,) bool: they reach them, and no other limb is there."""
    apart = jnp.sum((position[:, None] - situation.feet) ** 2, axis=2) > SAME**2
    others = ~np.eye(len(position), dtype=bool)
    free = (apart | ~others).all(1)
    for way in ways:
        free = free & within_reach(planner, (position - base[0] - way) @ base[1])
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
        may = _allowed(planner, situation, base, ways, position) & valid
        near = may & (ahead > 0) & ((step * step).sum(1) <= AHEAD**2)
        farthest = jnp.where(may, jnp.maximum(found.farthest, ahead), found.farthest)
        return Prospects(farthest, found.near + near), None

    none = jnp.zeros_like(situation.feet[:, 0])
    found, _ = jax.lax.scan(look, Prospects(none - jnp.inf, none), (holds.position, holds.valid > 0))
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
    pull: Array  # (n,) N, that they bear along their normals
    valid: Array  # (n,) bool
    normal: Array | None = None  # (n, 3), where holds have limits
    matrix: Array | None = None  # (n, m, 3) 1, of forces in the holds' axes
    bound: Array | None = None  # (n, m) N

    @classmethod
    def of(cls, holds: Holds, holding_force: Array) -> "Candidates":
        """The holds of a ground, with the pull of a grip () N where they have no limits."""
        limits = (holds.normal, holds.limit_matrix, holds.limit_bound) if holds.limit_bound.shape[1] else ()
        return cls(holds.position, pulls(holds, holding_force), holds.valid > 0, *limits)


def _best(
    score: Callable[[Array, Array], Array],
    allowed: Callable[[Array], Array],
    of_limbs: Callable[[Array], Array],
    candidates: Candidates,
    otherwise: tuple[Array, Limits | None],
    weight: Array,
) -> tuple[Array, Limits | None]:
    """Return the points of the largest score, (limb, 3) m, of several the first, and the limits of these holds.

    Arguments:
        score: of points (limb, 3) m that bear a pull () N, (limb,).
        allowed: whether points may be chosen, (limb,) bool.
        of_limbs: gives the points (limb, 3) m at which the limbs would hold a candidate at (3,) m.
        otherwise: points and limits where none is allowed.
        weight: (3,) N, by which holds have their axes.
    """

    def look(best: tuple[Array, Array, Limits | None], one: Candidates) -> tuple[PyTree, None]:
        worth, place, limits = best
        position = of_limbs(one.vector)
        frozen = stop_gradient(position)
        found = stop_gradient(jnp.where(allowed(frozen) & one.valid, score(frozen, one.pull), -jnp.inf))
        better = found > worth
        own = None
        if one.normal is not None and one.matrix is not None and one.bound is not None:
            own = Limits(one.matrix @ hold_axes(one.normal, weight).T, one.bound)
        return (
            jnp.where(better, found, worth),
            jnp.where(better[:, None], position, place),
            _of_some(better, own, limits),
        ), None

    worst = jnp.full_like(otherwise[0][:, 0], -jnp.inf)
    (_, place, limits), _ = jax.lax.scan(look, (worst, *otherwise), candidates)
    return place, limits


def _of_some(some: Array, new: Limits | None, old: Limits | None) -> Limits | None:
    """Return limits of which those of some limbs (limb,) are new."""
    if new is None or old is None:
        return old
    each = some[:, None]
    return Limits(jnp.where(each[..., None], new.rows, old.rows), jnp.where(each, new.bound, old.bound))


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


def within_reach(planner: Planner, target: Array) -> Array:
    """Return whether limbs reach points (limb, 3) m of the base's axes within their joints' limits, (limb,) bool."""
    geometry, robot = planner.geometry, planner.robot
    solution = inverse_kinematics(geometry, target)
    if isinstance(geometry, Chain):
        for _ in range(_ROUNDS - 1):
            solution = inverse_kinematics(geometry, target, solution.joint_angles)
    angles = solution.joint_angles
    within = (angles >= robot.joint_lower) & (angles <= robot.joint_upper)
    return jnp.asarray(solution.reachable & within.all(1))


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
    stops = interrupts(recovery, danger(recovery, body, rate, shift)) & (at > 0)
    landing_steps = jnp.ceil(recovery.landing_time / time_step) + 1
    left = progress.span - (at - progress.begun)
    lands = ~now.closed & stops & (left > landing_steps)
    ground = ground_at(progress, now)

    def score(position: Array, pull: Array) -> Array:
        stopping = body._replace(holding_force=jnp.minimum(body.holding_force, pull))
        worth = stopping_margin(recovery, stopping, lands, position)
        # of equal ones the nearest
        return worth - 1e-6 * jnp.sum((position - reference.foot_position) ** 2, axis=1)

    def allowed(position: Array) -> Array:
        return within_reach(planner, (position - base[0] - recovery.landing_time * body.velocity) @ base[1])

    below = jnp.concatenate([reference.foot_position[:, :2], ground[:, None]], axis=1)
    if planner.holds is None:
        ways = ways_beside(below.dtype) * recovery.reach
        pull = jnp.broadcast_to(body.holding_force, ways.shape[:1])
        each = Candidates(ways, pull, jnp.ones(ways.shape[:1], bool))
        place, limits = _best(score, allowed, lambda way: below + way, each, (below, progress.limits), body.weight)
    else:
        each, now_there = Candidates.of(planner.holds, body.holding_force), (progress.goal, progress.limits)
        place, limits = _best(
            score, allowed, lambda point: jnp.broadcast_to(point, below.shape), each, now_there, body.weight
        )
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
        limits=_of_some(lands, limits, progress.limits),
        interruptions=progress.interruptions + jnp.where(stops & ~stood_still, 1.0, 0.0),
    )
