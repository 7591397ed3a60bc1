"""A proposal gets joint gains and a cycle with which it holds, and what it lacks is said."""

import re

import numpy as np
import pytest

import mjx_climb as mc
from tuning.comparisons import first_walks
from tuning.comparisons.first_walks import expected, heavy_load, on_ceiling, slow_enough, with_joint_gains

HASTY = mc.load_scenario("case_1_2").with_overrides({"gait.cycle": 0.4, "disturbance.cargo.mass": 0.0})


@pytest.mark.nightly
def test_the_fastest_cycle_that_holds():
    """It holds, and the one that is twice as fast does not."""
    scenario, holds, how, *_ = slow_enough(HASTY.with_overrides({"contact.holding_limit": 5.0}))
    assert holds and scenario.gait.cycle > 0.4 and scenario.duration == 2 * scenario.gait.cycle
    assert f"at a cycle of {scenario.gait.cycle:g} s, which it does not at {scenario.gait.cycle / 2:g} s" in how
    assert not mc.rollout(scenario).detached.any()
    assert mc.rollout(scenario.with_overrides({"gait.cycle": scenario.gait.cycle / 2})).detached.any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "why"),
    [
        (
            {"gravity": [0, 0, 1.62], "contact.holding_limit": 0.5},
            "would pull .*, contact.holding_limit is 0.5 N",
        ),
        ({"gravity": [0, 0, -9.81], "control.kp": 0.2, "control.kd": 0.02}, "strays .* control.kp and torque limits"),
    ],
)
def test_what_holds_at_no_cycle_says_why(change, why):
    scenario, holds, how, *_ = slow_enough(HASTY.with_overrides(change))
    assert not holds and scenario.gait.cycle == 0.4
    assert how.startswith("does not walk at any cycle from 0.4 to 1.6 s: ")
    assert re.search(why, how), how


def short(**changes):
    return mc.load_scenario("case_1_2").with_overrides(
        {"duration": 0.3, "gait.cycle": 0.6, "disturbance.cargo.mass": 0.0, **changes}
    )


def walking(monkeypatch, metrics):
    """Have walks with metrics by kp and kd (N,) each, and what is asked of them; return those that were asked."""
    asked = []

    def walk(scenario, gains, parameters, **how):
        kp, kd = (np.asarray(parameters.at(f"control.{name}"), float) for name in ("kp", "kd"))
        found = dict.fromkeys([*mc.METRICS.names, "missed_grips", "unheld_gap", *first_walks.GAP], 0.0)
        own = {"cycle": np.asarray(parameters.at("gait.cycle")), "up": np.asarray(parameters.at("gravity"))[..., 2] > 0}
        asked.append(own | {"duration": scenario.duration})
        found |= {"detached_limb": -1.0} | metrics(kp, kd, how | own)
        return {name: np.broadcast_to(value, kp.shape) for name, value in found.items()}

    monkeypatch.setattr(first_walks, "rollout_metrics", walk)
    return asked


@pytest.mark.parametrize("bad", [{"base_deviation": 0.03}, {"missed_grips": 1}, {"diverged": True}, {}], ids=str)
def test_joint_gains_are_of_those_that_reach_the_ground_and_keep_the_base(bad, monkeypatch):
    """The force varies least at kp 80, where the base strays more than a tenth of its height, or a grip is missed."""

    def metrics(kp, kd, _):
        there = (kp > 60) & (kp < 120)
        both = {"base_deviation": 0.001, "missed_grips": 0, "diverged": False}
        found = {name: np.where(there, bad.get(name, value), value) for name, value in both.items()}
        return found | {"force_variation": 10 + np.log(kp / 80) ** 2 + np.log(kd / 0.2) ** 2}

    walking(monkeypatch, metrics)
    found, how = with_joint_gains(short(**{"control.kp": 40.0, "control.kd": 0.2}))
    assert (60 < found.control.kp < 120) == (not bad) and found.control.kp > 40 and found.control.kd == 0.2
    assert how.endswith("% less than with kp 40 and kd 0.2, HubRobo's in proportion")


@pytest.mark.parametrize(
    ("metrics", "holds", "said"),
    [
        ({"peak_pull_force": 3.21}, True, "holds there too: the largest pull is 3.21 N"),
        ({"base_deviation": 0.2}, False, "its base strays 0.2 m there, with grips that never let go too"),
        ({"diverged": True}, False, "diverges there, with grips that never let go too"),
        ({"peak_pull_force": 3.21, "peak_utilization": 1.6}, False, "RH lets go there; contact.holding_limit=3.3 "),
        ({"missed_grips": 2.0, "peak_utilization": 1.6}, False, "it does not reach the ground there"),
    ],
    ids=str,
)  # fmt: skip
def test_a_walk_on_a_ceiling_holds_strays_or_lets_go(metrics, holds, said, monkeypatch):
    """The base may hang half as far as the feet are from it; a grip lets go where those that hold use too much."""
    walking(monkeypatch, lambda kp, kd, how: metrics | ({} if how["smooth"] else {"detached_limb": 2.0}))
    found, how = on_ceiling(short(**{"contact.holding_limit": 2.0}))
    assert found == holds and said in how


def test_of_a_contact_without_one_limit_the_use_of_the_grips_is_told(monkeypatch):
    """Above a ceiling and at every cycle."""

    def metrics(kp, kd, how):
        return {"peak_pull_force": 3.21, "peak_utilization": 1.6} | ({} if how["smooth"] else {"detached_limb": 2.0})

    walking(monkeypatch, metrics)
    scenario = short(**{"contact": {"kind": "polyhedron"}})
    pull = "a grip that held would pull 3.21 N, 1.6 times its limit"
    assert on_ceiling(scenario) == (False, f"limb RH lets go there; {pull}")
    assert slow_enough(scenario).how.endswith(f"limb RH lets go; {pull}")


@pytest.mark.parametrize(
    ("pull", "needed"), [(32.1, "33"), (0.321, "0.33"), (3.31, "3.4"), (99.4, "100"), (120.1, "130")]
)
def test_the_limit_that_would_hold_has_two_digits_and_no_less(pull, needed, monkeypatch):
    walking(monkeypatch, lambda kp, kd, how: {"peak_pull_force": pull, "peak_utilization": 1.01})
    assert f"contact.holding_limit={needed} would hold" in on_ceiling(short(**{"contact.holding_limit": 0.2}))[1]


@pytest.mark.parametrize(
    ("fast", "cycle", "said"),
    [
        (0.5, 0.6, "holds for 1.2 s at a cycle of 0.6 s"),
        (1.0, 1.2, "holds for 2.4 s at a cycle of 1.2 s, which it does not at 0.6 s"),
        (2.0, 2.4, "holds for 2.4 s at a cycle of 2.4 s, which it does not at 1.2 s"),
    ],
)
@pytest.mark.parametrize(
    "lost", [{"peak_utilization": 1.01}, {"missed_grips": 1.0}, {"base_deviation": 0.056}], ids=str
)
def test_the_first_cycle_that_holds_of_its_own_and_slower_ones_is_taken(fast, cycle, said, lost, monkeypatch):
    sound = {"peak_utilization": 1.0, "missed_grips": 0.0, "base_deviation": 0.054}

    def metrics(kp, kd, how):
        each = {name: np.where(how["cycle"] > fast, value, lost.get(name, value)) for name, value in sound.items()}
        return each | {"peak_foot_force": 10 * how["cycle"], "peak_pull_force": how["cycle"] + how["up"]}

    asked, done = walking(monkeypatch, metrics), []
    found = slow_enough(short(), done.append)
    assert (found.scenario.gait.cycle, found.scenario.duration, found.holds) == (cycle, 2 * cycle, True)
    assert found.how == said and found.peak_foot_force == pytest.approx(10 * cycle)
    assert done == ([1] if fast < 0.6 else [1, 2])
    walks = len(asked)
    assert asked[0]["duration"] == 1.2
    holds, how = on_ceiling(found.scenario, hung=found.hung)
    assert (holds, how) == on_ceiling(found.scenario) == (True, f"holds there too: the largest pull is {cycle + 1} N")
    # one more for the slowest, whose two cycles are longer than the walk that it was found by
    assert len(asked) == walks + (2 if fast == 2.0 else 1)
    assert asked[-1]["up"].all() and asked[-1]["duration"] == 2 * cycle


@pytest.mark.parametrize(
    ("metrics", "broken", "why"),
    [
        ({"peak_utilization": 1.6, "peak_pull_force": 3.21}, {"detached_limb": 2.0},
         "limb RH lets go; a grip that held would pull 3.21 N, 1.6 times its limit, contact.holding_limit is 2 N"),
        ({"missed_grips": 1.0}, {"missed_grips": 3.0}, "3.0 grips miss the ground"),
        ({"base_deviation": 0.2}, {"missed_grips": 2.0}, "2.0 grips miss the ground"),
        ({"diverged": True}, {}, "diverges, with grips that never let go too: see stance, joint limits and control"),
        ({"base_deviation": 0.2}, {}, "its base strays 0.2 m, with grips that never let go too: see control.kp"),
    ],
)  # fmt: skip
def test_where_no_cycle_holds_the_slowest_says_why(metrics, broken, why, monkeypatch):
    walking(monkeypatch, lambda kp, kd, how: metrics | ({} if how["smooth"] else broken))
    found = slow_enough(short(**{"contact.holding_limit": 2.0}))
    assert not found.holds and found.scenario.gait.cycle == 0.6 and np.isnan(found.peak_foot_force)
    assert found.how.startswith("does not walk at any cycle from 0.6 to 2.4 s: ") and why in found.how


def test_joint_gains_that_nothing_betters_stay_and_those_that_do_not_walk_are_said_to(monkeypatch):
    walking(monkeypatch, lambda kp, kd, how: {"force_variation": 10 + np.log(kp / 40) ** 2 + np.log(kd / 0.2) ** 2})
    own = short(**{"control.kp": 40.0, "control.kd": 0.2})
    assert with_joint_gains(own) == (own, "none of 44 others gives pd less force variation")
    walking(monkeypatch, lambda kp, kd, how: {"diverged": np.isclose(kp, 40), "force_variation": kp})
    assert with_joint_gains(own)[1].endswith("which does not walk with kp 40 and kd 0.2, HubRobo's in proportion")
    walking(monkeypatch, lambda kp, kd, how: {"force_variation": np.where(np.isclose(kp, 40), 40.0, 10.0)})
    assert with_joint_gains(own)[1].startswith("of 45 short walks of pd that of least force variation, 75 % less than")
    walking(monkeypatch, lambda kp, kd, how: {"diverged": True})
    assert with_joint_gains(own) == (own, "no others among those searched keep the base as near to its reference")


@pytest.mark.slow
def test_joint_gains_are_those_of_a_better_pd():
    """Walked by pd itself they give as much less force variation as is said, and the scenario is else as it was."""
    stiff = short(**{"control.kp": 200.0, "control.kd": 0.05})
    batches = []
    found, how = with_joint_gains(stiff, batches.append)
    assert batches == [15, 15, 15]
    assert found == stiff.with_overrides({"control.kp": found.control.kp, "control.kd": found.control.kd})
    endless = {"control.controller": "pd", "contact.holding_limit": None}
    before, after = (mc.metrics(mc.rollout(each.with_overrides(endless)))["force_variation"] for each in (stiff, found))
    less = int(re.search(r"(\d+) % less than with kp 200 and kd 0.05", how)[1])
    assert less > 5 and 100 * (1 - after / before) == pytest.approx(less, abs=2)


def test_long_walks_get_one_grid(monkeypatch):
    """It says how many walks it rests on."""
    monkeypatch.setattr(first_walks, "LONG", 100)
    batches = []
    _, how = with_joint_gains(short(**{"control.kp": 200.0, "control.kd": 0.05}), batches.append)
    assert batches == [15] and how.startswith("of 15 short walks")


def test_the_walks_are_counted_before_they_begin():
    """Fewer where they have many steps, and the time in proportion to steps and joints."""
    (few, brief), (fewer, longer) = (expected(short(**{"time_step": step})) for step in (1e-3, 2e-6))
    assert (few, fewer) == (47, 17)
    assert longer / brief == pytest.approx(500 * 2 / 4)


@pytest.mark.slow
def test_the_limit_that_holds_on_a_ceiling():
    """It holds with the one that is named, and with a tenth less it does not."""
    weak = short(**{"contact.holding_limit": 2.0, "gravity": [0, 0, -9.81]})
    holds, how = on_ceiling(weak)
    assert not holds
    limit = float(re.search(r"limb [LR][FH] lets go there; contact.holding_limit=(\S+) would hold", how)[1])
    assert limit > 2.0
    for share, lost in ((1.0, False), (0.9, True)):
        hung = weak.with_overrides({"gravity": [0, 0, 9.81], "contact.holding_limit": share * limit})
        assert mc.rollout(hung).detached.any() == lost
    holds, how = on_ceiling(weak.with_overrides({"contact.holding_limit": limit}))
    assert holds and how.startswith("holds there too")


@pytest.mark.slow
def test_the_gap_is_named_before_a_stronger_gripper():
    """A robot that sags shuts its grippers off the ceiling: those with a reach miss it, others pull at once."""
    soft = short(**{"control.kp": 8.0, "control.kd": 0.1, "gravity": [0, 0, 1.62], "contact.holding_limit": 1.0})
    for change, then in (
        ({}, "limb [LR][FH] lets go"),
        ({"contact.capture_distance": 0.001}, "grips miss the ground|lets go"),
    ):
        _, holds, how, *_ = slow_enough(soft.with_overrides(change))
        assert not holds
        assert re.search(
            rf"a foot is \S+ mm off the ground when its gripper shuts, .*: raise control.kp, .*{then}", how
        ), how


def test_a_load_of_many_weights_is_told():
    scenario = short()
    weight = 2.2539 * 9.81
    assert heavy_load(scenario, 1.9 * weight) is None and heavy_load(scenario, np.nan) is None
    assert "67 times its weight" in heavy_load(scenario, 67 * weight)
