"""A gait that waits: no limb lifts off while another should hold and does not; feet try again, then other holds."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.gait.footholds.footholds import SAME
from mjx_climb.gait.footholds.nearest import Nearest
from mjx_climb.gait.recovery import RecoveringGait
from mjx_climb.gait.schedule import settled_phase
from mjx_climb.gait.swing import rest_to_rest
from mjx_climb.gait.waiting import Waiting, WaitingGait, Waits
from mjx_climb.ground import holds
from mjx_climb.physics.contact.contact import Grip
from mjx_climb.physics.contact.uncertain import UncertainGripper
from mjx_climb.physics.kinematics import Feet
from tests.gait.test_planner_decisions import (
    BASE,
    CYCLE,
    FEET,
    NEVER,
    PERIOD,
    PLAN,
    SWING,
    body_of,
    doubles,
    planner_of,
    reaches,
)

LF, LH, RH, RF = range(4)
STEPS = 4000
# a hold below each foot and some around it, without limits
AROUND = np.array([[0.0, 0, 0], [0.03, 0, 0], [0.0, 0.05, 0], [-0.02, 0.08, 0]])
ROCK = holds.of((FEET[:, None] + AROUND).reshape(-1, 3))


@functools.lru_cache
def walked(kind="planned", period=PERIOD, recovers=False):
    """Return a walk of feet that are where they should be, of which a script has which landings hold."""
    rule = Nearest() if kind == "holds" else None
    own = planner_of(rule, doubles(ROCK) if kind == "holds" else None)
    own = type(own)(**{**vars(own), "period": period})

    def walk(script, waiting):
        gait = WaitingGait.of(own, waiting)
        around = RecoveringGait.of(gait, NEVER) if recovers else gait

        def step(carry, number):
            memory, landings, before, point = carry
            now = around.schedule(memory, number)
            lands = now.closed & ~before
            holding = now.closed & jnp.where(before, script_at(landings), script_at(landings + lands))
            body = body_of(grip_point=point)._replace(support=holding, feet=point)

            def decided():
                _, reference = around.reference(memory, now, number, BASE, point)
                return around.look_ahead(memory, now, number, reference, body)

            memory = jax.lax.cond(number % period == 0, decided, lambda: memory)
            now = around.schedule(memory, number)
            closed = now.closed
            holding &= closed
            memory, reference = around.reference(memory, now, number, BASE, point)
            landings = landings + (closed & ~before)
            point = jnp.where((closed & ~before)[:, None], memory.goal, point)
            none, zero = jnp.zeros_like(closed), jnp.zeros_like(point)
            grip = Grip(zero, zero, point, holding, closed, none, none, closed & ~before & ~holding, none * 0.0)
            memory = around.after_contacts(memory, now, number, grip)
            seen = closed, holding, memory.goal, around.stands(memory, grip), reference.base_position
            return (memory, landings, closed, point), seen

        def script_at(landings):
            return script[jnp.arange(4), jnp.minimum(landings, script.shape[1] - 1).astype(int)]

        start = around.init()[0], jnp.zeros(4), jnp.ones(4, bool), jnp.asarray(FEET)
        return jax.lax.scan(step, start, jnp.arange(STEPS))[1]

    return jax.jit(walk)


def walk(script, kind="planned", **how):
    own = doubles(Waiting(**{name: how.pop(name) for name in ("retries", "other_holds") if name in how}))
    return [np.asarray(each) for each in walked(kind, **how)(jnp.asarray(script), own)]


def lift_offs(closed, limb):
    return np.flatnonzero(closed[:-1, limb] & ~closed[1:, limb]) + 1


ALL_HOLD = np.ones((4, 12), bool)


def failing(limb, *landings):
    """A script in which these landings of a limb fail; its first place is the stance."""
    script = ALL_HOLD.copy()
    script[limb, list(landings)] = False
    return script


# one program for all of a gait that recovers
either = pytest.mark.parametrize("recovers", [False, pytest.param(True, marks=pytest.mark.slow)])


@either
def test_feet_that_hold_are_not_waited_for(recovers):
    """Limbs lift off as in the periodic gait, to the step."""
    closed, *_, stands, _ = walk(ALL_HOLD, recovers=recovers)
    for limb in range(4):
        want = np.arange(float(PLAN.swing_offset[limb]), STEPS, CYCLE)
        np.testing.assert_array_equal(lift_offs(closed, limb), want[want > 0])
    assert not stands.any()


@either
def test_the_next_limb_waits_for_a_foot_that_fails(recovers):
    """LH fails once at 200: it swings again from 220 to 420, the base stands still, and LF goes after it."""
    closed, _, goal, stands, base = walk(failing(LH, 1), recovers=recovers)
    swing = int(SWING)
    assert lift_offs(closed, LH)[0] == swing + PERIOD and lift_offs(closed, LF)[0] == 2 * swing + PERIOD
    np.testing.assert_array_equal(goal[2 * swing + PERIOD, LH], goal[swing, LH])
    np.testing.assert_array_equal(base[swing + 1 : 2 * swing + PERIOD], base[swing + 1][None].repeat(swing + 19, 0))
    assert not stands.any()


@pytest.mark.parametrize("kind", ["planned", "holds"])
def test_a_foot_tries_its_hold_again_then_others_then_the_robot_stands(kind):
    """Of a hold two landings, of two others too; each is farther from the first, within reach, and nobody else's."""
    closed, _, goal, stands, _ = walk(failing(LH, *range(1, 12)), kind)
    landed = np.flatnonzero(~closed[:-1, LH] & closed[1:, LH]) + 1
    places = goal[landed, LH]
    assert len(landed) == 6
    away = np.linalg.norm(places - places[0], axis=1)
    assert (away[::2] == away[1::2]).all() and 0 < away[2] < away[4]
    if kind == "holds":
        for place in places:
            assert np.linalg.norm(np.asarray(ROCK.position) - place, axis=1).min() < 1e-12
    else:
        assert away[4] <= 0.03
    assert stands[landed[-1] + PERIOD :, LH].all() and not stands[: landed[-1], LH].any() and not stands[:, LF].any()
    assert not any(lift_offs(closed, limb).size for limb in (LF, RH, RF))


def test_a_foot_that_holds_elsewhere_lets_the_gait_go_on():
    closed, _, goal, stands, _ = walk(failing(LH, 1, 2, 3), "holds")
    assert not stands.any() and lift_offs(closed, LF).size and lift_offs(closed, RF).size
    assert np.ptp(goal[: int(6 * SWING), LH, 0]) > 0


@pytest.mark.parametrize("period", [PERIOD, pytest.param(70, marks=pytest.mark.slow)])
def test_no_limb_lifts_off_while_another_does_not_hold(period):
    """Random failures of a third of all landings, ticks with and without the touchdowns; a foot that failed may."""
    for seed in range(12):
        script = np.random.default_rng(seed).random((4, 40)) > 0.3
        script[:, 0] = True
        closed, holding, *_ = walk(script, retries=3, other_holds=3, period=period)
        lifts = closed[:-1] & ~closed[1:]
        for number, limb in np.argwhere(lifts & holding[:-1]):
            # in that step, in which a foot may land too
            assert (holding | ~closed)[number].all() and holding[number + 1][np.arange(4) != limb].all()
        assert lifts.sum() > 8 and (~closed).sum(1).max() == 1


# --- decisions, one by one


@functools.cache
def deciding(kind):
    """Return the memory of a gait that waits, and its decision at a tick in one program for all memories and bodies."""
    own = planner_of(Nearest() if kind == "holds" else None, doubles(ROCK) if kind == "holds" else None)

    def decided(memory, body, waiting):
        gait = WaitingGait.of(own, waiting)
        return gait.lift_off(memory, gait.schedule(memory, memory.step), body.base_position, body)

    memory = WaitingGait.of(own, doubles(Waiting())).init()[0]
    return memory._replace(start=jnp.asarray(FEET), goal=jnp.asarray(FEET), below=jnp.zeros(4)), jax.jit(decided)


def at(memory, step, **changes):
    """Return the memory at a step, which is the gait's own time too."""
    return memory._replace(step=jnp.asarray(float(step)), clock=jnp.asarray(float(step)), **changes)


def candidates(kind, first):
    """Return the points that a foot may try, (n, 3) m: holds, or eight around its first foothold, ever farther."""
    if kind == "holds":
        return np.asarray(ROCK.position)
    number = np.arange(1, 9)
    angle = number * np.pi * (3 - np.sqrt(5))
    return first + 0.03 * (number / 8)[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)


def tried_again(kind, waits, goal, body, limb, retries, others):
    """Return the tries of a foot that failed, where it goes next, and whether it stands instead."""
    tries, place = waits.tries[limb] + 1, np.asarray(goal[limb])
    first = place if waits.tries[limb] == 0 else np.asarray(waits.first[limb])
    if tries % (retries + 1):
        return tries, first, place, False
    points = candidates(kind, first)
    away = ((points - first) ** 2).sum(1)
    taken = (((points[:, None] - np.delete(np.asarray(goal), limb, 0)) ** 2).sum(2) <= SAME**2).any(1)
    beyond = away > ((place - first) ** 2).sum() + SAME**2
    may = beyond & ~taken & reaches(points, np.asarray(body.base_position), np.asarray(body.base_rotation))[limb]
    if not may.any() or tries >= (retries + 1) * (others + 1):
        return tries, first, place, True
    return tries, first, points[np.where(may, away, np.inf).argmin()], False


@pytest.mark.parametrize("kind", ["planned", pytest.param("holds", marks=pytest.mark.slow)])
def test_each_foot_that_failed_is_sent_where_loops_send_it(kind):
    """Two feet failed, of which one swings and one has tried all; a base that leans; another foot on a hold nearby."""
    begun, decided = deciding(kind)
    own, told = doubles(Waiting(retries=1, other_holds=2)), []
    for seed in range(12):
        random = np.random.default_rng(seed)
        angle, shift = random.normal(0, 0.2), random.normal(0, 0.03, 3)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        first = np.asarray(ROCK.position)[4 * np.arange(4) + random.integers(0, 2, 4)]
        goal = (
            first.copy()
            if kind == "planned"
            else np.asarray(ROCK.position)[4 * np.arange(4) + random.integers(0, 3, 4)]
        )
        goal[RF] = candidates(kind, first[LF])[1 if kind == "planned" else 1 + seed % 3]  # on what LF might go to
        feet, aim = goal + random.normal(0, 0.01, (4, 3)), random.normal(0, 0.008, (4, 3))
        tries = random.integers(0, 6, 4).astype(float)
        waits = Waits(np.array([True, True, True, False]), tries, first, aim, np.array([False, False, True, False]))
        body = body_of(feet=feet, grip_point=feet + 0.001, base_position=BASE + shift, base_rotation=turn)
        body = body._replace(support=jnp.array([False, False, False, True]))
        memory = at(begun, 100, goal=jnp.asarray(goal), waits=jax.tree.map(jnp.asarray, waits))
        if seed % 4 == 3:
            memory = memory._replace(begun=memory.begun.at[LH].set(50.0))  # in the air
        found = decided(memory, body, own)
        again = [LF] if seed % 4 == 3 else [LF, LH]
        for limb in range(4):
            if limb not in again:
                for name in ("goal", "begun"):
                    np.testing.assert_array_equal(getattr(found, name)[limb], getattr(memory, name)[limb])
                np.testing.assert_array_equal(found.waits.aim[limb], aim[limb])
                assert (found.waits.tries[limb], found.waits.stands[limb]) == (tries[limb], waits.stands[limb])
                continue
            count, place, to, stands = tried_again(kind, waits, goal, body, limb, 1, 2)
            told.append((stands, count % 2 == 0))
            assert (found.waits.tries[limb], found.waits.stands[limb]) == (count, stands)
            assert found.waits.failed[limb] == stands
            np.testing.assert_array_equal(found.waits.first[limb], place)
            off = aim[limb] + goal[limb] - feet[limb]
            off *= min(0.02 / np.linalg.norm(off), 1.0)
            np.testing.assert_allclose(found.waits.aim[limb], off, atol=1e-12)
            np.testing.assert_allclose(found.goal[limb], goal[limb] if stands else to, atol=1e-12)
            swung = (memory.start[limb], memory.begun[limb]) if stands else (feet[limb] + 0.001, 100.0)
            np.testing.assert_array_equal(found.start[limb], swung[0])
            assert found.begun[limb] == swung[1]
            if not stands:
                assert (found.below[limb], found.span[limb]) == (feet[limb, 2] + 0.001, SWING)
    assert len({*told}) == 3 and told.count((False, True)) > 2


LIFTS = {  # what differs in the memory, in its waits and in the body, and whether LF lifts off at 200
    "all hold": ({}, {}, {}, True),
    "one does not": ({}, {}, {"support": np.arange(4) != RF}, False),
    "one swings": ({RH: 50.0}, {}, {"support": np.arange(4) != RH}, True),
    "one that tries again swings": ({RH: 50.0}, {"tries": [0.0, 0, 1, 0]}, {"support": np.arange(4) != RH}, False),
    "one that tried again holds": ({}, {"tries": [0.0, 0, 1, 0]}, {}, True),
    "the gait stands still": ({}, {}, {"running": 0.0}, False),
}


@pytest.mark.parametrize("name", LIFTS)
def test_a_limb_lifts_off_where_those_hold_that_should(name):
    swings, own, body, lifts = LIFTS[name]
    begun, decided = deciding("planned")
    memory = at(begun, 190, running=jnp.asarray(body.get("running", 1.0)))
    for limb, since in swings.items():
        memory = memory._replace(begun=memory.begun.at[limb].set(since))
    memory = memory._replace(waits=memory.waits._replace(**{key: jnp.asarray(value) for key, value in own.items()}))
    support = jnp.asarray(body.get("support", np.ones(4, bool)))
    found = decided(memory, body_of()._replace(support=support), doubles(Waiting()))
    assert (found.begun[LF] == 200) == lifts and found.running == memory.running
    np.testing.assert_array_equal(found.begun[1:], memory.begun[1:])


AFTER = {  # begun of RF, tries of RF, which of LF, LH and RH hold, and whether the gait's time stands still
    "all hold": (-500.0, 0.0, [1, 1, 1], False),
    "one does not": (-500.0, 0.0, [1, 0, 1], True),
    "one swings": (50.0, 0.0, [1, 1, 1], False),
    "one tries again": (50.0, 1.0, [1, 1, 1], True),
    "one tried, and holds": (-500.0, 1.0, [1, 1, 1], False),
    "one lands as another lifts off": (-99.0, 0.0, [1, 1, 1], True),
    "one lands later": (-98.0, 0.0, [1, 1, 1], False),
}


@pytest.mark.parametrize("name", AFTER)
def test_what_a_gait_that_waits_remembers_of_contacts(name):
    """LF holds after failing; LH has failed or fails anew; RH is to lift off at 101, after step 100."""
    since, tries, holds, stops = AFTER[name]
    gait, one = WaitingGait.of(planner_of(), doubles(Waiting())), jnp.ones((4, 3))
    before = Waits(
        jnp.array([True, False, False, True]), jnp.array([2.0, 3.0, 0.0, tries]), one, 0.01 * one,
        jnp.array([True, True, False, True]),
    )  # fmt: skip
    memory = at(deciding("planned")[0], 90, waits=before, begun=jnp.array([-1400.0, -1600.0, 101.0, since]))
    now, zero = gait.schedule(memory, jnp.asarray(100)), jnp.zeros((4, 3))
    closed = np.array([True, True, True, name not in ("one swings", "one tries again") and "lands" not in name])
    np.testing.assert_array_equal(now.closed, closed)
    support = np.array([*map(bool, holds), bool(closed[3])])
    for missed, detached in ((True, False), (False, True), (False, False)):
        flags = [jnp.arange(4) == LH if flag else jnp.zeros(4, bool) for flag in (missed, detached)]
        grip = Grip(zero, zero, zero, jnp.asarray(support), now.closed, flags[1], flags[1], flags[0], zero[:, 0])
        found = gait.after_contacts(memory, now, jnp.asarray(100), grip)
        assert found.step == 90 + stops
        np.testing.assert_array_equal(found.begun, memory.begun + np.array([0, 0, stops, 0]))
        lacks = closed & ~support
        np.testing.assert_array_equal(found.waits.failed, lacks & (missed or detached))
        np.testing.assert_array_equal(found.waits.tries, np.where(closed & support, 0.0, before.tries))
        np.testing.assert_array_equal(found.waits.aim[:, 0], np.where(closed & support, 0.0, 0.01))
        np.testing.assert_array_equal(found.waits.stands, lacks & np.asarray(before.stands))
        np.testing.assert_array_equal(gait.stands(found, grip), found.waits.stands)
    # a foot that failed stays so until it holds or swings
    again = gait.after_contacts(
        memory._replace(waits=before._replace(failed=jnp.ones(4, bool))), now, jnp.asarray(100), grip
    )
    np.testing.assert_array_equal(again.waits.failed, lacks)


def test_a_foot_that_tries_again_comes_down_beside_its_foothold():
    """By its aim, as far as it is on its way."""
    gait = WaitingGait.of(planner_of(), doubles(Waiting()))
    memory, aim = deciding("planned")[0], np.random.default_rng(0).normal(0, 0.01, (4, 3))
    memory = at(memory, 90, begun=jnp.array([20.0, -60.0, -1200.0, -1000.0]))
    now, step = gait.schedule(memory, jnp.asarray(100)), jnp.asarray(100)
    plain = gait.reference(memory, now, step, BASE, FEET)[1]
    beside = memory._replace(waits=memory.waits._replace(aim=jnp.asarray(aim)))
    found = gait.reference(beside, now, step, BASE, FEET)[1]
    share = rest_to_rest(np.array([80 / 160, 1.0, 0, 0]))
    np.testing.assert_allclose(rest_to_rest(settled_phase(PLAN, now)), share)
    np.testing.assert_allclose(found.foot_position, plain.foot_position + share[:, None] * aim, atol=1e-15)


# --- walks


FAILS = {
    "contact": {"kind": "uncertain", "tested_pull": 12.0, "spread": 0.3, "retry_steps": 30.0, "tries": 2.0,
                "closing_time": 0.02, "capture_distance": 0.004},
    "control.controller": "pd", "gait.cycle": 0.8, "gait.stride": 0.01, "gait.step_height": 0.01, "duration": 1.6,
}  # fmt: skip


@pytest.mark.slow
def test_nobody_lifts_off_after_a_grip_that_fails():
    """All grips fail: LF, which is next, stays; the robot stands, and says so. Without waiting LF lifts off."""
    keys = FAILS | {"contact": FAILS["contact"] | {"tested_pull": 20.0, "spread": 0.0}}
    keys |= {"gait.waiting.retries": 1, "gait.waiting.other_holds": 1}
    walk = mc.rollout(mc.load_scenario("case_1_2", keys))
    others = [limb != "LH" for limb in walk.limbs]
    assert walk.support[:, others].all() and not walk.support[200:, LH].any()
    metrics = mc.metrics(walk)
    assert metrics["detached_at"] is None and metrics["stands_at"] == walk.time[walk.stands[:, LH].argmax()]
    assert walk.standing == {"LH": metrics["stands_at"]}
    goes_on = mc.rollout(mc.load_scenario("case_1_2", keys | {"gait.waiting.waits": False, "duration": 0.3}))
    assert not goes_on.support[250, LF] and not goes_on.stands.any()


@pytest.mark.slow
def test_as_many_walks_arrive_as_hold_in_the_end():
    """16 seeds: none loses a grip; those that do not stand walk on."""
    scenario = mc.load_scenario("case_1_2", FAILS)
    found = mc.rollout_metrics(
        scenario, parameters=mc.parameters(scenario).replace({"contact.seed": np.arange(16.0)}), dtype=np.float64
    )
    assert np.isnan(found["detached_at"]).all() and not found["diverged"].any()
    stands = ~np.isnan(found["stands_at"])
    assert (found["travel"][~stands] > 0.6 * 0.02).all() and (~stands).sum() > 8


@pytest.mark.nightly
def test_tangents_pass_with_the_decisions_frozen():
    """By kd, through grips that fail and feet that try again: those of differences in double precision."""
    simulation = mc.Simulation(mc.load_scenario("case_1_2", FAILS | {"contact.seed": 1, "duration": 1.0}))
    tangents = simulation.jvp({"kd": np.array([0.2])}, {"kd": np.ones((1, 1))}, dtype=np.float64)[1]
    ends = [simulation.metrics({"kd": np.array([0.2 + h])}, dtype=np.float64) for h in (1e-7, -1e-7)]
    for name in ("force_variation", "base_deviation"):
        difference = (ends[0][name] - ends[1][name]) / 2e-7
        np.testing.assert_allclose(tangents[name][0], difference, rtol=1e-3, err_msg=name)


def test_a_foot_whose_grip_fails_waits_where_its_gripper_shut():
    """It is not sent back to its last foothold; tried again 6 mm off the rock the gripper shuts without force."""
    values = {"tested_pull": 15.0, "spread": 0.3, "seed": 5.0, "retry_steps": 2.0, "tries": 9.0, "closing_time": 0.1}
    contact = UncertainGripper(**{name: jnp.asarray(value) for name, value in values.items()})
    contact = contact.compiled_for().set_up(1e-3)
    step = jax.jit(lambda memory, feet, closed: contact.step(memory, feet, None, closed, jnp.zeros(4)))
    memory, before, forces = contact.init(jnp.zeros((4, 3)), jnp.zeros((4, 3, 3))), np.zeros(4, bool), []
    for number in range(30):
        position = jnp.tile(jnp.array([0.05 if number else 0.0, 0.0, 0.006]), (4, 1))
        memory, grip = step(memory, Feet(position, 0 * position, position), jnp.full(4, number > 1))
        holds = np.asarray(grip.support)
        if number == 2:
            failed = ~holds
            np.testing.assert_allclose(np.asarray(grip.grip_point)[failed], [[0.05, 0, 0]] * failed.sum(), atol=1e-12)
        forces += np.abs(np.asarray(grip.foot_force))[holds & ~before].ravel().tolist()
        before = holds
    assert 0 < failed.sum() < 4 and len(forces) == 12 and max(forces) == 0
