"""What the planner decides, step by step, against numbers by hand and choices by loops in NumPy."""

import collections
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.gait.base_path import sway_of, swayed
from mjx_climb.gait.chosen_footholds import ChosenFootholds, next_way, situation_of
from mjx_climb.gait.footholds.best_margin import BestMargin
from mjx_climb.gait.footholds.farthest import Farthest
from mjx_climb.gait.footholds.footholds import Situation
from mjx_climb.gait.footholds.held import Held, no_holds
from mjx_climb.gait.footholds.nearest import Nearest
from mjx_climb.gait.footholds.reach import within_reach
from mjx_climb.gait.free_order import FreeOrder
from mjx_climb.gait.gait import Body
from mjx_climb.gait.own_swings import OwnSwings, Swings, clock_at
from mjx_climb.gait.recovery import (
    Danger,
    Interruptions,
    RecoveringGait,
    Recovery,
    danger,
    interrupts,
    stopping_margin,
    ways_beside,
)
from mjx_climb.gait.schedule import Plan
from mjx_climb.ground import Holds
from mjx_climb.physics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from tests.gait import footholds_reference as by_loops

ROBOT = load_robot("hubrobo_v3_2")
BASE = ROBOT.stance_position
FEET = BASE + np.asarray(limb_frames(ROBOT, None, ROBOT.stance_joints).foot)
LF, LH, RH, RF = range(4)
CYCLE, SWING, PERIOD, MOVES, STEP = 800.0, 200.0, 20, 4, 1e-3
ADVANCE = np.array([0.04, 0.0, 0.0])
LEVEL, UP = np.eye(3), np.tile([0.0, 0.0, 1.0], (4, 1))
MASS, GRAVITY = 2.0, np.array([1.0, 0.5, -9.0])


def doubles(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), tree, is_leaf=lambda leaf: isinstance(leaf, list))


LIGHT = BestMargin(distance_weight=0.1)
NEVER = doubles(Recovery(margin=-1.0))  # no threshold is ever passed
PLAN = Plan(
    base_start=jnp.asarray(BASE), base_orientation=jnp.asarray(ROBOT.stance_orientation), footholds=jnp.asarray(FEET),
    advance=jnp.asarray(ADVANCE), heights=jnp.zeros((4, 0)), step_height=jnp.asarray(0.02),
    swing_path=jnp.zeros((4, 3, 0)), settling=jnp.asarray(0.2), cycle_steps=jnp.asarray(CYCLE),
    swing_steps=jnp.asarray(SWING), swing_offset=jnp.array([200.0, 0.0, 400.0, 600.0]),
)  # fmt: skip


def planner_of(rule=None, holds=None, recovery=None, plan=PLAN, free=False, way_points=()):
    own = plan, STEP, False, ROBOT, limb_geometry(ROBOT), holds, PERIOD
    kind = FreeOrder if free else ChosenFootholds
    found = OwnSwings(*own) if rule is None else kind(*own, rule, MOVES, way_points)
    return found if recovery is None else RecoveringGait.of(found, recovery)


# the memory of either gait in one row
OF_RECOVERY = (*Interruptions._fields[:-1], "interruptions")
Memory = collections.namedtuple("Memory", (*Swings._fields[:-1], *OF_RECOVERY))


def flat(memory):
    own = [None] * len(OF_RECOVERY) if memory.interruptions is None else memory.interruptions
    return Memory(*memory[:-1], *own)


def nested(memory):
    count = len(Swings._fields) - 1
    own = None if memory.resumes is None else Interruptions(*memory[count:])
    return Swings(*memory[:count], own)


def body_of(**changes):
    body = Body(
        mass=MASS, center_of_mass=[0.01, -0.02, 0.1], velocity=[0.0, 0.0, 0.0], weight=MASS * GRAVITY, feet=FEET,
        support=np.ones(4, bool), foot_force=np.tile(-MASS * GRAVITY / 4, (4, 1)), holding_force=15.0, normal=UP,
        pull=15.0, base_position=BASE, base_rotation=LEVEL, grip_point=FEET,
    )  # fmt: skip
    body = body._replace(**changes)
    return body._replace(**{n: jnp.asarray(v, float) for n, v in body._asdict().items() if n != "support"})


@functools.lru_cache
def compiled(**changes):
    """Return schedule, reference and tick in one program for all plans, recoveries and holds."""

    def ticked(given, memory, step, body):
        planner = planner_of(**given, **changes)
        now = planner.schedule(memory, step)
        _, reference = planner.reference(memory, now, step, body.base_position, body.grip_point)
        return planner.look_ahead(memory, now, step, reference, body), now, reference

    return jax.jit(ticked)


def tick(given, progress, step, grip_point=FEET, body=None, place=BASE, **changes):
    """Return the progress after a tick, the schedule and the reference that it was given."""
    body = body_of(pull=15 * UP if "holds" in given else 15.0) if body is None else body
    body = body._replace(base_position=place, grip_point=grip_point)
    # numbers of one kind, of which there is one program
    found, *others = compiled(**changes)(*jax.tree.map(np.asarray, (given, nested(progress), step, body)))
    return flat(found), *others


def begun(planner, **changes):
    """Return the memory of a robot that stands in its rest stance on level ground, whatever holds are near."""
    memory, feet = flat(planner.init()[0]), jnp.asarray(FEET)
    memory = memory._replace(start=feet, goal=feet, below=feet[:, 2])
    if memory.held is not None:
        memory = memory._replace(held=no_holds(planner.holds, feet))
        memory = memory._replace(left=memory.held.normal)
    return memory._replace(**{name: jnp.asarray(value, float) for name, value in changes.items()})


def ground_of(position, random):
    """Return holds of any normal with two rows of limits each, the last of which is padding."""
    normal = random.normal([0, 0, 1], 0.4, position.shape)
    return Holds(
        position=jnp.asarray(position), normal=jnp.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True)),
        limit_matrix=jnp.asarray(random.normal([0, 0, -1], 0.3, (len(position), 2, 3))),
        limit_bound=jnp.asarray(random.uniform(5, 40, (len(position), 2))),
        valid=jnp.arange(len(position)) < len(position) - 1.0,
    )  # fmt: skip


# --- between ticks


def test_a_limb_is_where_its_own_swing_has_it():
    """LF waits for a swing that was decided, LH is in one, RH has swung, RF is at the end of a swing; step 640."""
    own = {"begun": [650.0, 600.0, 340.0, 440.0], "span": [200.0, 100.0, 200.0, 200.0], "touched": [500.0, 0, 0, 0]}
    for running, clock in ((1.0, 140.0), (0.0, 100.0)):
        progress = begun(planner_of(), step=600.0, clock=100.0, running=running, **own)
        assert clock_at(progress, jnp.asarray(640)) == clock
        for free in (False, True):
            now = planner_of(rule=Farthest() if free else None, free=free).schedule(progress, jnp.asarray(640))
            np.testing.assert_array_equal(now.closed, [True, False, True, True])
            np.testing.assert_allclose(now.swing_phase, [-0.05, 0.4, 1.5, 1.0])
            np.testing.assert_array_equal(now.since_touchdown, [140.0, 0.0, 100.0, 0.0])
            periodic = [200 - clock, 0.0, 400 - clock, 600 - clock]
            np.testing.assert_array_equal(now.until_lift_off, [10, 0, 800, 800] if free else periodic)


def test_the_ground_and_the_limits_of_a_foot_change_with_its_swing():
    """Below the middle of a swing the old foothold counts; a hold's limit from the end of a swing on, as `<=`."""
    planner = planner_of()
    goal = FEET + np.outer([1.0, 2, 3, 4], [0.0, 0, 0.01])
    progress = begun(planner, goal=goal, below=[0.1, 0.2, 0.3, 0.4], step=100.0)._replace(
        begun=jnp.array([1.0, 0.0, -100.0, 50.0]), span=jnp.full(4, 200.0)
    )
    now = planner.schedule(progress, jnp.asarray(100))  # 0.495, 0.5, 1 and 0.25 of a swing
    np.testing.assert_allclose(planner.ground(progress, now)[0], [0.1, 0.02, 0.03, 0.4])
    rows = jnp.asarray(np.tile([[1.0, 0, 0], [0, 0, -2.0]], (4, 1, 1)))
    held = Held(jnp.asarray(UP), rows, jnp.array([[6.0, 8.0], [6.0, 8.0], [6.0, 8.0], [0.0, 8.0]]))
    now = now._replace(swing_phase=jnp.array([1.0, 0.99, 1.0, 3.0]))
    force = jnp.array([[3.0, 0, -4.0], [3.0, 0, -40.0], [-9.0, 0, -4.2], [1e-6, 0, 1.0]])
    progress = progress._replace(held=held)
    share = planner.share_of_limits(progress, now, force)
    np.testing.assert_array_equal(share > 1, [False, False, True, True])
    np.testing.assert_allclose(share[:3], [1.0, 0.0, 1.05])
    assert share[3] > 1
    # what only pushes uses up nothing
    np.testing.assert_array_equal(planner.share_of_limits(progress, now, jnp.asarray(UP)), 0.0)


def test_the_reference_follows_swings_moves_and_offsets():
    """A cubic between both ends of each: 5/32 of the way at a quarter, one half at the middle."""
    given = {"rule": LIGHT, "recovery": doubles(dataclasses.replace(NEVER, return_time=0.4))}
    given["holds"] = rock(np.random.default_rng(0), FEET)
    goal = FEET + np.array([0.04, 0.02, 0.01])
    progress = begun(
        planner_of(**given), goal=goal, begun=[900.0, 960.0, 800.0, 0.0], rise=[0.03] * 4, base_start=[0.0, 0.0, 0.1],
        base_goal=[0.04, 0.08, 0.1], base_begun=900.0, offset=[0.0, 0.01, 0.0], offset_since=850.0, step=900.0,
        clock=900.0,
    )  # fmt: skip
    _, _, reference = tick(given, progress, 950, FEET - 1)
    np.testing.assert_allclose(reference.base_position, [0.04 * 5 / 32, 0.08 * 5 / 32 + 0.01 * 27 / 32, 0.1])
    # LF at 50 of 160 steps, RH at 150 of them; LH and RF grip
    for limb, phase in ((LF, 50 / 160), (RH, 150 / 160)):
        share, lift = (x * x * (3 - 2 * x) for x in (phase, 1 - abs(2 * phase - 1)))
        place = FEET[limb] + share * (goal[limb] - FEET[limb])
        end = FEET[limb, 2] if phase < 0.5 else goal[limb, 2]
        place[2] = end + (goal[limb, 2] + 0.03 - end) * lift
        np.testing.assert_allclose(reference.foot_position[limb], place, atol=1e-12)
    np.testing.assert_array_equal(reference.foot_position[jnp.array([LH, RF])], FEET[[LH, RF]] - 1)
    np.testing.assert_allclose(reference.until_lift_off, [0, 0.65, 0, 0.45])
    np.testing.assert_allclose(reference.since_touchdown, [0, 2.35, 0, 0.75], atol=1e-9)
    # without a time to return an offset is over a step later
    given["recovery"] = doubles(dataclasses.replace(NEVER, return_time=0.0))
    for since, offset in ((950.0, 0.01), (949.0, 0.0)):
        _, _, reference = tick(given, progress._replace(offset_since=jnp.asarray(since)), 950, FEET - 1)
        np.testing.assert_allclose(reference.base_position, [0.04 * 5 / 32, 0.08 * 5 / 32 + offset, 0.1])


# --- recovery


def random_body(random, **changes):
    feet = FEET + random.normal(0, 0.03, (4, 3))
    own = {
        "center_of_mass": random.normal([0, 0, 0.1], 0.02), "velocity": random.normal(0, 0.3, 3), "feet": feet,
        "foot_force": random.normal(0, 4, (4, 3)), "pull": random.uniform(0, 15, (4, 1)) * UP,
    }  # fmt: skip
    return body_of(**own | changes)


def test_what_threatens_the_robot_is_measured():
    """The pull that is predicted over what a grip bears; of grips that pull and stand, and the GIA margin by hand."""
    recovery, measured = doubles(Recovery(lead_time=0.02)), jax.jit(danger)
    normal = np.array([[0, 0, 1.0], [0, 0, 1.0], [0.6, 0, 0.8], [0, 0, 1.0]])
    force = np.array([[3.0, 0, -4.0], [0, 0, 9.0], [-8.0, 0, 2.0], [0, 0, -20.0]])
    rate = np.array([[0, 0, 0], [0, 0, 0], [0, 200.0, 0], [0, 0, 0]])  # 4 N within the lead time
    body = body_of(foot_force=force, normal=normal, support=np.arange(4) < 3, pull=0.0, holding_force=10.0)
    found = measured(recovery, body, jnp.asarray(rate), jnp.array([0.3, 0.0, 0.4]))
    assert found.shift == pytest.approx(0.5)
    assert found.utilization == pytest.approx(np.sqrt(64 + 16 + 4) / 10)
    # LH leaves the ground within the lead time, and is not pulled yet
    rising = measured(recovery, body, jnp.asarray(rate).at[LH, 2].set(-1000.0), jnp.zeros(3))
    assert rising.utilization == pytest.approx(11 / 10)
    assert measured(recovery, body._replace(holding_force=jnp.asarray(0.0)), jnp.asarray(rate), jnp.zeros(3)) == (
        0,
        0,
        0,
    )
    # at rest, 0.05 m from the front edge and 0.1 m above it
    still = body_of(pull=0.0, center_of_mass=[FEET[0, 0] - 0.05, 0, 0.1], foot_force=np.tile([0, 0, 5.0], (4, 1)))
    margin = measured(recovery, still, jnp.full((4, 3), 1e3), jnp.zeros(3)).margin
    assert margin == pytest.approx(10.0 * 0.05 / np.hypot(0.05, 0.1), rel=1e-6)


def test_any_threshold_interrupts():
    recovery, safe = Recovery(shift=0.1, utilization=0.8, margin=2.0), Danger(0.1, 0.8, 2.0)
    assert not interrupts(recovery, safe)
    for name, value in {"shift": 0.101, "utilization": 0.81, "margin": 1.99}.items():
        assert interrupts(recovery, safe._replace(**{name: jnp.asarray(value)})), name
    for way in np.asarray(ways_beside(float))[1:]:
        assert np.linalg.norm(way) in (pytest.approx(0.5), pytest.approx(1.0)) and way[2] == 0
    assert len(np.unique(np.round(ways_beside(float), 6), axis=0)) == 17


def stops_by_loops(recovery, body, landing, position):
    """Return the margin of `stopping_margin` by the reference: the base is stopped half of its way on."""
    stands = np.asarray(body.support) | landing
    feet = np.where(landing[:, None], position, body.feet)[stands]
    time, velocity = max(float(recovery.landing_time), 1e-3), np.asarray(body.velocity)
    pushed = np.asarray(body.weight) + float(body.mass) * velocity / time
    middle = np.asarray(body.center_of_mass) + velocity * time / 2
    return by_loops.tumbling_margin(feet, middle, pushed, np.asarray(body.pull)[stands])


def test_a_landing_is_worth_the_moment_that_stops_the_robot():
    random, found = np.random.default_rng(0), []
    worth = jax.jit(stopping_margin)
    for landing, time in zip((np.arange(4) == 1, np.arange(4) == 3) * 6, (0.3, 0.3, 0.0) * 4, strict=True):
        recovery = doubles(Recovery(landing_time=time))
        body = random_body(random, support=~landing)
        position = FEET + random.normal(0, 0.03, (4, 3))
        own = worth(recovery, body, jnp.asarray(landing), jnp.asarray(position))
        found.append(stops_by_loops(recovery, body, landing, position))
        np.testing.assert_allclose(own, found[-1], atol=1e-9)
    assert np.count_nonzero(found) > 6


# --- choices


reached = jax.jit(jax.vmap(functools.partial(within_reach, ROBOT, limb_geometry(ROBOT))))


def reaches(points, place, rotation=LEVEL):
    """Return which limbs reach points (n, 3) m from a base at (3,) m, (limb, n) bool."""
    own = (points - place) @ rotation
    return np.asarray(reached(np.repeat(own[:, None], 4, axis=1))).T


def test_a_point_is_within_reach_where_one_a_little_farther_from_the_first_joint_is():
    """By a twentieth, within the joints' limits there; not so far is what a limb reaches at all."""
    points = np.random.default_rng(0).uniform(-0.35, 0.35, (400, 3)) * [1, 1, 0.5]
    first = np.asarray(ROBOT.frame_position)[:, 0]
    each = np.repeat(points[:, None], 4, axis=1)

    @jax.jit
    def solved(target):
        found = inverse_kinematics(limb_geometry(ROBOT), target)
        inside = (found.joint_angles >= ROBOT.joint_lower) & (found.joint_angles <= ROBOT.joint_upper)
        return found.reachable & inside.all(-1)

    farther = np.asarray(solved(first + 1.05 * (each - first)))
    np.testing.assert_array_equal(np.asarray(reached(each)), farther)
    assert (farther != np.asarray(solved(each))).sum() > 10


def test_a_limb_swings_to_the_best_hold_that_it_reaches_from_both_ends_and_that_is_free():
    """Grounds of 12 holds, of which some are near feet, and a base that is turned; prospects of the same holds."""
    random, rule, chosen = np.random.default_rng(1), Nearest(), []
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1.0]])
    base, ways = (BASE + np.array([0.01, 0, 0]), turn), (np.array([0.0, 0.02, 0.0]), np.array([0.05, -0.01, 0]))

    @jax.jit
    def both(holds, situation, held):
        planner, body = planner_of(rule, holds, free=True), body_of(base_position=base[0], base_rotation=base[1])
        return *planner.choose(situation, body, ways, held), planner.prospects(situation, body, ways)

    for _ in range(12):
        feet = FEET + random.normal(0, 0.01, (4, 3))
        position = np.concatenate(
            [feet[:3] + 4e-4, feet + random.normal(0, 0.06, (4, 3)), FEET + np.array([0.15, 0, 0]), FEET[:1]]
        )
        forward = np.array([0.8, 0.6, 0.0])
        situation = Situation(
            jnp.asarray(feet), jnp.asarray(feet[[1, 0, 3, 2]] * [0.7, 0.7, 1]), jnp.asarray(forward),
            jnp.ones(4, bool), None, jnp.asarray(GRAVITY), jnp.asarray(15.0), None,
        )  # fmt: skip
        holds = ground_of(position, random)
        held = Held(jnp.asarray(UP), jnp.full((4, 2, 3), 0.5), jnp.full((4, 2), np.inf))
        place, on, prospects = both(holds, situation, held)
        both_ends = np.all([reaches(position, base[0] + way, turn) for way in ways], axis=0)
        for limb in range(4):
            others = np.delete(feet, limb, 0)
            far = np.linalg.norm(others[:, None] - position, axis=2).min(0) > 1e-3
            may = far & both_ends[limb] & (np.arange(len(position)) < len(position) - 1)
            step = position - feet[limb]
            ahead = step @ forward
            near = both_ends[limb] & (np.arange(len(position)) < len(position) - 1)
            near = near & (ahead > 0) & (np.linalg.norm(step, axis=1) <= 0.2)
            assert prospects.near[limb] == near.sum()
            assert prospects.farthest[limb] == pytest.approx(max(ahead[may], default=-np.inf))
            best = by_loops.nearest(position, np.tile(may, (4, 1)), np.asarray(situation.planned))[limb]
            chosen.append(best)
            away = np.linalg.norm(position - situation.planned[limb], axis=1)
            nearer = away < (np.inf if best == by_loops.NONE else away[best])
            assert prospects.in_vain[limb] == (near & nearer).sum()
            if best == by_loops.NONE:
                np.testing.assert_array_equal(place[limb], feet[limb])
                np.testing.assert_array_equal(on.bound[limb], np.inf)
                continue
            np.testing.assert_array_equal(place[limb], position[best])
            axes = by_loops.frame(np.asarray(holds.normal[best]), GRAVITY)
            np.testing.assert_allclose(on.rows[limb], holds.limit_matrix[best] @ axes.T, atol=1e-12)
            np.testing.assert_array_equal(on.bound[limb], holds.limit_bound[best])
            np.testing.assert_array_equal(on.normal[limb], holds.normal[best])
    assert len({*chosen}) > 6


# --- ticks


def only(limb, new, old):
    return np.where((np.arange(4) == limb).reshape(-1, *[1] * (np.ndim(old) - 1)), new, old)


def assert_swings(found, before, limb, **new):
    """Assert that one limb, or none, swings anew, and that the others are where they were."""
    for name in ("start", "goal", "below", "begun", "span", "rise", "touched"):
        old = np.asarray(getattr(before, name))
        want = old if limb is None else only(limb, new[name], old)
        np.testing.assert_allclose(getattr(found, name), want, atol=1e-9, err_msg=name)


LIFTS = {  # step, what differs in the progress, and the limb that lifts off with its foothold's number
    "in the first step": (0, {}, LH, 0.0, 1),
    "a period before, not yet": (180, {}, None, 0, 0),
    "within a period": (181, {}, LF, 200.0, 1),
    "of the second cycle": (790, {}, LH, 800.0, 2),
    "not where the gait stands still": (181, {"running": 0.0, "resumes": 182.0}, None, 0, 0),
    "by the gait's own time": (500, {"clock": 190.0, "step": 490.0}, LF, 500.0, 1),
    "not before a swing that was decided": (181, {"begun": [190.0, -1600, -1200, -1000]}, None, 0, 0),
    "not in a swing": (181, {"begun": [150.0, -1600, -1200, -1000]}, None, 0, 0),
}


@pytest.mark.parametrize("name", LIFTS)
def test_limbs_lift_off_before_the_next_tick(name):
    step, own, limb, begins, number = LIFTS[name]
    own = {"begun": [-1400.0, -1600.0, -1200.0, -1000.0], "step": step, "clock": step} | own
    before = begun(planner_of(recovery=NEVER), **own)
    grip = FEET + np.array([0.001, 0.002, -0.003])
    found, *_ = tick({"recovery": NEVER}, before, step, grip)
    new = {"start": grip, "goal": FEET + number * ADVANCE, "below": 0.0, "begun": begins, "span": SWING, "rise": 0.02}
    assert_swings(found, before, limb, **new, touched=before.begun + SWING)
    assert (found.step, found.interruptions) == (step, 0) and found.running == before.running


def test_a_planned_swing_from_a_hold_ends_on_no_hold():
    """Recovery landed LF and RH on holds: LF swings on, to level ground without a limit; RH stands on its hold."""
    given = {"recovery": NEVER, "holds": ground_of(FEET, np.random.default_rng(2))}
    tilted = np.tile([0.6, 0.0, 0.8], (4, 1))
    before = begun(planner_of(**given), begun=[-1400.0, -1600.0, -1200.0, -1000.0], step=190.0, clock=190.0)
    on = Held(jnp.asarray(tilted), jnp.full((4, 2, 3), 0.5), jnp.full((4, 2), 3.0))
    found, *_ = tick(given, before._replace(held=on), 190)
    np.testing.assert_array_equal(found.held.normal, only(LF, UP, tilted))
    np.testing.assert_array_equal(found.held.bound, only(LF, np.full((4, 2), np.inf), on.bound))
    np.testing.assert_array_equal(found.left, only(LF, tilted, before.left))


def pull_of(holds, number):
    """Return the pull that a grip of 15 N bears on a hold."""
    down = np.maximum(-np.asarray(holds.limit_matrix[number])[:, 2], 1e-30)
    return min(15.0, *(holds.limit_bound[number] / down))


def rock(random, planned):
    """Return holds near planned footholds and elsewhere."""
    near = planned + random.normal(0, 0.02, (3, 4, 3))
    points = np.concatenate([*near, random.uniform(-0.3, 0.3, (4, 3)), FEET[:1]])
    return ground_of(points, random)


def test_a_limb_swings_to_a_hold_and_the_base_moves_with_it():
    """The base goes where it stands over all goals as over the footholds, from its path; the hold has its normal.

    The gait has stood still for 300 steps: the base moves by the gait's own time, the foot by that of the steps. What
    an interruption has left between reference and path is not of the path.
    """
    random = np.random.default_rng(8)
    holds, grip = rock(random, FEET + ADVANCE), FEET + np.array([0.0, 0.001, 0.004])
    given = {"rule": LIGHT, "holds": holds, "recovery": NEVER}
    before = begun(
        planner_of(**given),
        step=490.0,
        clock=190.0,
        base_begun=150.0,
        base_goal=BASE + np.array([0.02, 0, 0.0]),
        offset=[0.0, 0.01, 0.0],
        offset_since=190.0,
    )
    found, _, reference = tick(given, before, 490, grip)
    # with the limb off the ground, and the robot where it is a swing later
    each, normals = (np.asarray(value)[:-1] for value in (holds.position, holds.normal))
    pulls = [pull_of(holds, number) for number in range(len(each))]
    com, stands = np.array([0.02, -0.02, 0.1]), np.arange(4) != LF
    may = np.all([reaches(each, BASE + way) for way in (0 * ADVANCE, ADVANCE)], axis=0)
    situation = FEET, FEET + ADVANCE, stands, com, MASS * GRAVITY
    best = by_loops.best_margin(each, normals, pulls, may, *situation, 15 * UP, distance_weight=0.1)[LF]
    assert best not in (by_loops.NONE, by_loops.nearest(each, may, FEET + ADVANCE)[LF])
    point = each[best]
    new = {"start": grip, "goal": point, "below": 0.004, "begun": 500.0, "span": SWING, "rise": 0.02}
    assert_swings(found, before, LF, **new, touched=before.begun + SWING)
    np.testing.assert_allclose(found.held.normal, only(LF, holds.normal[best], UP))
    np.testing.assert_array_equal(found.held.bound[LF], holds.limit_bound[best])
    assert np.isinf(found.held.bound[1:]).all()
    path = BASE + np.array([0.02 * (4 / 20) ** 2 * (3 - 8 / 20), 0, 0])
    np.testing.assert_allclose(reference.base_position, path + np.array([0, 0.01, 0]))
    np.testing.assert_allclose(found.base_start, path)
    middle = by_loops.diagonals(only(LF, point, FEET)) - by_loops.diagonals(FEET) + BASE
    np.testing.assert_allclose(found.base_goal, middle, atol=1e-9)
    assert found.base_begun == 190
    # the next swing leaves the ground of that hold
    landed = found._replace(begun=found.begun - 1100, step=jnp.asarray(990.0), clock=jnp.asarray(990.0))
    again, *_ = tick(given, landed, 990, np.asarray(found.goal))
    np.testing.assert_array_equal(again.left[LF], holds.normal[best])
    # between lift-offs nothing changes
    later, *_ = tick(given, found, 530, grip)
    assert_swings(later, found, None)
    np.testing.assert_array_equal(later.base_goal, found.base_goal)


def test_a_margin_is_chosen_with_the_robot_where_the_limb_touches_down():
    """Limbs of a situation stand where their swings end, the base goes on by the swing's share of the cycle."""
    holds = ground_of(FEET, np.random.default_rng(0))
    progress = begun(planner_of(holds=holds), goal=FEET + 0.01)
    body = body_of(support=np.arange(4) > 0)
    found = situation_of(PLAN, progress, body, jnp.array([0.03, 0.04, 0.0]))
    np.testing.assert_allclose(found.center_of_mass, [0.0175, -0.01, 0.1])
    np.testing.assert_allclose(found.planned, FEET + 0.01 + [0.03, 0.04, 0])
    np.testing.assert_allclose(found.forward, [0.6, 0.8, 0])
    np.testing.assert_array_equal(found.feet, FEET + 0.01)
    np.testing.assert_allclose(found.pull, 15 * UP)
    np.testing.assert_array_equal(found.stands, body.support)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, limb",
    {"all stand": RH, "one swings": None, "the gait stands still": None, "at the last way point": None}.items(),
)
def test_in_a_free_order_one_limb_lifts_off_once_all_stand(name, limb):
    """It waits until the base is there: a quarter of the cycle less its swing; it has the farthest hold ahead."""
    plan = PLAN._replace(swing_steps=jnp.asarray(150.0))
    ways = np.array([0.02, -0.04, 0.05, 0.03])
    holds = ground_of(np.vstack([FEET + np.outer(ways, [1.0, 0, 0]), FEET[:1]]), np.random.default_rng(5))
    given = {"rule": Farthest(), "holds": holds, "plan": plan}
    changes = {"free": True, "way_points": ((0.1, 0.0),)}
    before = begun(planner_of(**given, **changes), step=500.0, clock=500.0, begun=[0.0, 10.0, 150.0, 350.0])
    before = before._replace(reached=jnp.asarray(float(name == "at the last way point")))
    if name == "one swings":
        before = before._replace(begun=before.begun.at[RF].add(1.0))
    if name == "the gait stands still":
        before = before._replace(running=jnp.asarray(0.0))
    found, *_ = tick(given, before, 500, **changes)
    new = {"start": FEET, "goal": holds.position[RH], "below": 0.0, "begun": 550.0, "span": 150.0, "rise": 0.02}
    assert_swings(found, before, limb, **new, touched=300.0)


@pytest.mark.slow
def test_a_base_walks_from_way_point_to_way_point_and_its_feet_beside_it():
    """By a stride at most; a point is reached at half a stride, and at the last one no limb lifts off."""
    random = np.random.default_rng(4)
    changes = {"way_points": ((0.1, 0.0), (0.1, 0.05))}
    # the base sways about its way
    plan = PLAN._replace(sway=sway_of(jnp.asarray(FEET - BASE), [0.25, 0.0, 0.5, 0.75], 0.75, 0.3))
    cases = {  # place of the base, points reached before and after, way of the next cycle
        (0.0, 0.0): (0, 0, [0.04, 0.0]),
        (0.079, 0.0): (0, 0, [0.021, 0.0]),
        (0.081, 0.0): (0, 1, [0.04 * 19 / np.hypot(19, 50), 0.04 * 50 / np.hypot(19, 50)]),
        (0.1, 0.02): (1, 1, [0.0, 0.03]),
        (0.1, 0.04): (1, 2, None),
        (0.1, 0.05): (2, 2, None),
    }
    for place, (reached, after, way) in cases.items():
        shift = np.array([*place, 0.0])
        points = (FEET + shift + random.normal(0, 0.03, (6, 4, 3)) * [1, 1, 0]).reshape(-1, 3)
        holds = ground_of(points, random)
        given = {"rule": Nearest(), "holds": holds, "plan": plan}
        before = begun(planner_of(**given, **changes), step=190.0, clock=190.0, start=FEET + shift, goal=FEET + shift)
        where = BASE + shift
        before = before._replace(base_start=jnp.asarray(where), base_goal=jnp.asarray(where))
        before = before._replace(reached=jnp.asarray(float(reached)))
        found, _, reference = tick(given, before, 190, FEET + shift, place=where, **changes)
        assert found.reached == after
        swayed_to = where + swayed(plan.sway, 190 / 800)
        np.testing.assert_allclose(reference.base_position, swayed_to, atol=1e-12)
        assert np.linalg.norm(swayed_to - where) > 0.01
        if way is None:
            assert_swings(found, before, None)
            continue
        # LF has stood for as long as the others on the average, and swings five eighths of the way ahead
        planned = where + FEET - BASE + 5 / 8 * np.array([*way, 0.0])
        may = reaches(points, where + np.array([*way, 0])) & (np.arange(len(points)) < len(points) - 1)
        best = by_loops.nearest(points, may, planned)[LF]
        np.testing.assert_allclose(found.goal, only(LF, points[best], FEET + shift))
        # the base's next move begins on its way, without the sway, and at the gait's time
        np.testing.assert_allclose(found.base_start, where, atol=1e-12)
        assert found.base_begun == 190


def test_the_way_leads_to_one_way_point_after_the_other():
    """By a stride at most, and nowhere after the last; a point counts as reached from half a stride away."""
    points = (0.1, 0.0), (0.1, 0.05), (0.1, 0.05), (-0.2, 0.05)
    random, stride, found_by = np.random.default_rng(6), 0.05, jax.jit(functools.partial(next_way, points))
    seen = set()
    for _ in range(60):
        before = int(random.integers(5))
        base = np.array([*np.asarray(points[min(before, 3)]) + random.normal(0, 0.03, 2), 0.3])
        after, way = before, np.zeros(2)
        if before < 4 and np.linalg.norm(points[before] - base[:2]) <= stride / 2:
            after += 1
        if after < 4:
            way = points[after] - base[:2]
            way *= min(stride / np.linalg.norm(way), 1)
        found, ahead = found_by(float(before), base, np.array([0.03, -0.04, 0.0]))
        np.testing.assert_allclose(ahead, [*way, 0.0], atol=1e-12)
        assert found == after
        seen.add((after - before, after, np.linalg.norm(way) < 0.049))
    assert len(seen) > 8


def test_beside_their_way_feet_are_planned_where_the_base_will_be():
    """The limb that lifts off has stood as long as the others on the average: 5/8 of the way of four moves."""
    random = np.random.default_rng(8)
    planner = planner_of(rule=LIGHT, holds=ground_of(FEET, random), way_points=((0.1, 0.0),))
    goal = FEET + random.normal(0, 0.02, FEET.shape)
    way, base = np.array([0.03, 0.01, 0.0]), BASE + 0.02
    memory = begun(planner, goal=goal, clock=190.0, step=190.0)._replace(reached=jnp.zeros(()))

    @jax.jit
    def planned(memory, body):
        now, situation = planner.schedule(memory, jnp.asarray(190)), situation_of(PLAN, memory, body, jnp.asarray(way))
        return planner.next_swings(memory, now, situation, body, jnp.asarray(base), (jnp.zeros(3), jnp.asarray(way)))

    lifts, wait, found = planned(nested(memory), body_of())
    np.testing.assert_array_equal(lifts, np.arange(4) == LF)
    assert wait[LF] == 10
    place = base + FEET - BASE + 5 / 8 * way
    np.testing.assert_allclose(found.planned, np.column_stack([place[:, :2], goal[:, 2]]), atol=1e-12)


LANDING = 50  # steps of a landing of 0.05 s, and one more
STOPS = {  # what differs in the body and the recovery, at which step, whether the gait stops and LF lands
    "nothing": ({}, {}, 300, False, False),
    "shift": ({}, {"shift": 0.01}, 300, True, True),
    "not in the first step": ({}, {"shift": 0.01}, 0, False, False),
    "margin": ({}, {"margin": 100.0}, 300, True, True),
    "pull that grows": ({"pulled": True}, {"utilization": 0.5}, 300, True, True),
    "pull that grows, beyond the lead": ({"pulled": True}, {"utilization": 0.5, "lead_time": 0.0}, 300, False, False),
    "limit of a hold": ({"pulled": True, "limits": [1.0, 20.0, 10.0, 1.0]}, {"utilization": 0.7}, 300, True, True),
    "limits that are not used up": (
        {"pulled": True, "limits": [1.0, 20.0, 12.0, 1.0]},
        {"utilization": 0.7},
        300,
        False,
        False,
    ),
    "shortly before a landing": ({}, {"shift": 0.01}, 350, True, False),
    "a landing too late": ({}, {"shift": 0.01}, 348, True, True),
    "before its swing begins": ({}, {"shift": 0.01}, 190, True, False),
}


@pytest.mark.parametrize("with_holds", [False, True])
@pytest.mark.parametrize("name", STOPS)
def test_danger_stops_the_gait_and_brings_the_foot_down_where_it_bears_best(name, with_holds):
    """LF swings from step 200 to 400; the base is 0.02 m beside its reference and moves on.

    The gait has stood still for 30 steps before.
    """
    own, values, step, stops, lands = STOPS[name]
    if "limits" in own and not with_holds:
        stops = lands = False
    random = np.random.default_rng(7)
    recovery = dataclasses.replace(NEVER, landing_time=0.05, rest_time=0.2, take_over=0.25, return_time=0.4, reach=0.02)
    recovery = doubles(dataclasses.replace(recovery, **values))
    given: dict[str, Any] = {"recovery": recovery}
    if with_holds:
        given |= {"rule": LIGHT, "holds": rock(random, FEET + ADVANCE)}
    goal = only(LF, FEET + ADVANCE + [0, 0, 0.01], FEET)
    before = begun(
        planner_of(**given), begun=[200.0, -1600, -1200, -1000], goal=goal, step=step - 20.0, clock=step - 50.0,
        force=np.tile([0, 0, 5.0], (4, 1)), offset=[0.0, 0.004, 0.0], offset_since=step - 130.0,
    )  # fmt: skip
    if with_holds:
        # it lifted off from steep ground
        before = before._replace(left=jnp.asarray(only(LF, [0.6, 0.0, 0.8], UP)))
    force = np.tile([0, 0, 5.0], (4, 1))
    if own:
        # 2 N less in 20 steps: 5 N in the lead time
        force[RH] = [0.0, 0, -3.0]
        before = before._replace(force=before.force.at[RH, 2].set(2.0))
    support = np.array([False, True, True, "limits" not in own])
    if "limits" in own and with_holds:
        # LF is in the air and RF has let go: what pushes them off uses up nothing
        force[[LF, RF]] = [0.0, 0, -5.0]
        rows = jnp.broadcast_to(jnp.array([[0, 0, -1.0], [0, 0, 0]]), (4, 2, 3))
        bound = jnp.column_stack([jnp.array(own["limits"]), jnp.full(4, jnp.inf)])
        before = before._replace(held=Held(jnp.asarray(UP), rows, bound))
    pull = 15 * UP if with_holds else 15.0
    body = body_of(velocity=[0.8, -0.6, 0.2], support=support, foot_force=force, pull=pull)
    place = BASE + np.array([0.0, 0.02, 0.0])
    found, now, reference = tick(given, before, step, body=body, place=place)
    shift = place - reference.base_position
    offset = 0.004 * (1 - 0.25**2 * (3 - 0.5))
    assert found.interruptions == stops and found.running == (not stops)
    assert found.resumes == (step + LANDING + 1 + 200 if stops else 0)
    np.testing.assert_array_equal(found.force, force)
    expected = np.array([0, offset, 0]) + 0.25 * shift if stops else before.offset
    np.testing.assert_allclose(found.offset, expected, atol=1e-12)
    assert found.offset_since == (step - 30 if stops else step - 130)
    if not lands:
        if step > 0:
            assert_swings(found, before, None)
        return
    at = np.asarray(reference.foot_position)
    ground = np.where(now.swing_phase < 0.5, 0, goal[:, 2])
    below = np.column_stack([at[:, :2], ground])
    each = np.asarray(given["holds"].position)[:-1] if with_holds else below[LF] + 0.02 * np.asarray(ways_beside(float))
    worth, may = [], reaches(each, place + 0.05 * np.asarray(body.velocity))[LF]
    for number, point in enumerate(each):
        pull = 15 * UP
        if with_holds:
            pull[LF] = np.asarray(given["holds"].normal[number]) * pull_of(given["holds"], number)
        position = only(LF, point, FEET)
        margin = stops_by_loops(recovery, body._replace(pull=pull), np.arange(4) == LF, position)
        worth.append(margin - 1e-6 * ((point - at[LF]) ** 2).sum() if may[number] else -np.inf)
    assert np.isfinite(worth).any()
    new = {
        "start": at,
        "goal": each[int(np.argmax(worth))],
        "below": ground,
        "begun": step,
        "span": LANDING + 1,
        "rise": 0,
    }
    assert_swings(found, before, LF, **new, touched=before.touched)
    if with_holds:
        # from level ground, as it is above the middle of a swing
        best = int(np.argmax(worth))
        np.testing.assert_array_equal(found.left[LF], UP[LF])
        np.testing.assert_array_equal(found.held.normal[LF], given["holds"].normal[best])
        np.testing.assert_array_equal(found.held.bound[LF], given["holds"].limit_bound[best])
        np.testing.assert_array_equal(found.held.bound[1:], before.held.bound[1:])
    # a gait that stands still goes on when its time has come, and counts as one interruption
    again, *_ = tick(given, found, step + 20, body=body, place=place)
    assert again.interruptions == 1
    safe = given | {"recovery": NEVER}
    for later, runs in ((step + LANDING + 200, 0), (step + LANDING + 201, 1)):
        done, *_ = tick(safe, found._replace(step=jnp.asarray(later - 20.0)), later, place=place)
        assert done.running == runs
