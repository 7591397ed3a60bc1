"""pd with kp and kd of its own: searched as far as a law, and what is said of the two."""

import types
from functools import partial

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import LoadTransfer, PlannedTransfer
from mjx_climb.control.foot_offsets import FootOffsets
from mjx_climb.control.recovering import Recovering
from mjx_climb.inputs.time_step import short_enough
from tuning.comparisons import of_search, side_by_side
from tuning.comparisons.worth import (
    BesidePd,
    Ends,
    OverWalks,
    best_without,
    better_of,
    between,
    give_joint_gains,
    law_without,
    worth_of,
)
from tuning.gains.gains_file import by_name
from tuning.problem import spaces
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Objective, Term
from tuning.problem.search import Search
from tuning.searches import retuned_pd, tune

CASE = mc.load_scenario("case_1_2")
OURS, THEIRS = {"force_variation": 30.0}, {"force_variation": 40.0}
JOINT = {"kp": 17.0, "kd": 1.0}
RIVAL = retuned_pd.Rival(JOINT, 40.0)
DONE = types.SimpleNamespace(interrupted=False)
BESIDE = BesidePd(40.0, RIVAL)  # pd retuned, where load transfer by plan was searched too


@pytest.mark.parametrize(
    ("kp", "kd", "changes", "expected", "enough"),
    [
        (50.0, 0.2, {}, 1e-3, True),
        (17.0, 1.0, {}, 5e-4, True),
        (200.0, 2.0, {}, 2.5e-4, True),
        (200.0, 20.0, {}, 2.5e-4, False),
        (17.0, 1.0, {"control.reading": "measured_pose"}, 1e-3, False),  # another law at another step
        (17.0, 1.0, {"control.reading": "measured_pose", "hardware.control_period": 0.002}, 5e-4, True),
        (17.0, 1.0, {"hardware.force_sensor.delay": 0.4}, 1e-3, False),  # a buffer holds no more samples
    ],
)
def test_a_time_step_is_shortened_for_joint_gains(kp, kd, changes, expected, enough):
    scenario, joint = CASE.with_overrides(changes), {"kp": kp, "kd": kd}
    assert retuned_pd.time_step_for(scenario, joint) == expected
    walked = retuned_pd.walker(scenario, joint)
    assert (walked.control.controller, walked.control.kp, walked.control.kd) == ("pd", kp, kd)
    assert short_enough(walked) == enough


def _valley(walked, kp, kd):
    """A narrow valley along kd = 0.06 kp, with its bottom at JOINT and grippers torn off beyond it."""
    along, across = np.log(kp / JOINT["kp"]), np.log(kd / kp * 17.0)
    values = 40 + along**2 + 10 * across**2
    used = np.where(across > 0.5, 2.0, 0.5)
    return {"force_variation": values, "peak_utilization": used, "diverged": across < -3}


def walking(monkeypatch, **other):
    """Have walks go down the valley, with other metrics as functions of the gains."""

    def walk(simulation, gains, *_, **__):
        joint = {name: by_name(gains)[name] for name in JOINT}
        return _valley(simulation, **joint) | {name: values(joint) for name, values in other.items()}

    monkeypatch.setattr(mc.Simulation, "metrics", walk)


def test_pd_is_searched_over_all_its_bounds_and_refined(monkeypatch):
    """By the tuner's grid of 12 by 12, refined once in as many walks, at a time step that every one can follow."""
    calls = []

    def walk(simulation, gains, *_, **__):
        kp, kd = (by_name(gains)[name] for name in JOINT)
        calls.append((simulation.scenario.time_step, kp.size, kd.min(), kd.max()))
        return _valley(simulation, kp, kd)

    monkeypatch.setattr(mc.Simulation, "metrics", walk)
    found = retuned_pd.least(CASE)
    assert calls[0] == (2.5e-4, 145, pytest.approx(0.02), pytest.approx(2.0))
    assert [call[:2] for call in calls] == [(2.5e-4, 145)] * 2
    assert _valley(None, **found.joint)["force_variation"] < 40.05  # 40.4 with the first grid alone
    assert not found.lacks
    walking(monkeypatch, diverged=lambda gains: gains["kp"] > 0)
    assert retuned_pd.least(CASE) is None


def test_kp_and_kd_that_no_time_step_follows_are_not_found(monkeypatch):
    """Where a quarter of the step is too long for the bounds it is said, and nobody is told to walk so."""
    walking(monkeypatch, force_variation=lambda gains: 1 / gains["kd"])
    scenario = CASE.with_overrides({"control.kd": 1.0, "control.kp": 200.0})  # kd up to 10
    found = retuned_pd.least(scenario)
    assert short_enough(retuned_pd.walker(scenario, found.joint))
    assert found.lacks == "within what a time step of 0.00025 s can follow"


def test_no_joint_gains_of_a_grid_are_those_that_the_time_step_cannot_follow(monkeypatch):
    """In a walk that shakes a force may hardly vary: nobody can walk so, and no law is compared with it."""
    calls = []

    def walk(scenario, gains, parameters=None, **_):
        calls.append(gains["kd"].shape)
        shape = np.broadcast_shapes(gains["kd"].shape, () if parameters is None else (3,))
        return {"force_variation": 1 / gains["kd"] * np.ones(shape), "diverged": np.zeros(shape, bool)}

    monkeypatch.setattr(mc, "rollout_metrics", walk)
    for parameters, shape in ((None, ()), (object(), (3,))):
        joint, walks = retuned_pd.walked_on_grid(CASE, (3, 4), parameters)
        assert calls[-1] == (20, 1)[: 1 + len(shape)] and walks["diverged"].shape == (20, *shape)
        alone = [
            CASE.with_overrides({"control.kp": kp, "control.kd": kd}) for kp, kd in zip(*joint.values(), strict=True)
        ]
        steady = np.array([short_enough(one) for one in alone])
        assert 0 < steady.sum() < 20
        np.testing.assert_array_equal(walks["diverged"].reshape(20, -1).any(1), ~steady)
        np.testing.assert_array_equal(walks["diverged"].reshape(20, -1).all(1), ~steady)


@pytest.mark.nightly
def test_a_further_search_of_pd_finds_nothing_better():
    """A dense grid about the best, and one over all bounds: at most 1 % less force variation."""
    scenario = CASE.with_overrides({"duration": 0.3, "disturbance.cargo.start": 0.1})
    found = retuned_pd.least(scenario)
    pd = retuned_pd.walker(scenario, found.joint).with_overrides({"time_step": 2.5e-4})
    table = mc.MetricTable(mc.METRICS[name] for name in ("force_variation", "detached_limb", "diverged"))
    near = [np.geomspace(0.8, 1.25, 12) * found.joint[name] for name in ("kp", "kd")]
    wide = [np.geomspace(10, 200, 12), np.geomspace(0.02, 2, 12)]
    points = np.concatenate([np.stack(np.meshgrid(*axes), -1).reshape(-1, 2) for axes in (near, wide)])
    points = np.vstack([points.clip([10, 0.02], [200, 2]), list(found.joint.values())])
    walks = mc.rollout_metrics(pd, {"kp": points[:, 0], "kd": points[:, 1]}, metrics=table)
    holds = (walks["detached_limb"] < 0) & ~walks["diverged"].astype(bool)
    assert holds[-1] and holds.sum() > 100
    assert walks["force_variation"][holds].min() >= 0.99 * walks["force_variation"][-1]


def test_of_a_lead_over_pd_a_sensor_is_worth_what_the_plan_leaves():
    """30 beside 40 of the plan and 50 of pd: 40 % less than pd, half of which needs the sensor."""
    plan = RIVAL._replace(name="PlannedTransfer")
    found = worth_of(OURS, THEIRS, plan, pd=BesidePd(50.0, RIVAL)).in_words
    assert found == (
        "the force sensor pays: 25.0 % less force variation than PlannedTransfer with kp 17, kd 1, which needs none; "
        "40.0 % less force variation than pd with kp 17, kd 1, of which the force sensor is worth 20.0 %"
    )
    more = worth_of({"min_tsm": 3.0}, {"min_tsm": 2.5}, plan, larger=True, pd=BesidePd(2.0, RIVAL)).in_words
    assert more.endswith("50.0 % more min tsm than pd with kp 17, kd 1, of which the force sensor is worth 25.0 %")


def test_a_verdict_only_where_pd_was_searched_as_well():
    worth = partial(worth_of, pd=BESIDE)
    alone = worth_of(OURS, THEIRS, RIVAL).in_words
    assert alone.startswith(
        "no verdict on the force sensor, since of the laws without one pd alone was searched: 25.0 % less"
    )
    assert worth(OURS, THEIRS, RIVAL).in_words == (
        "the force sensor pays: 25.0 % less force variation than pd with kp 17, kd 1, which needs none"
    )
    assert worth(OURS, THEIRS, RIVAL._replace(lacks="on a grid alone")).in_words.startswith(
        "no verdict on the force sensor, since pd was searched on a grid alone: 25.0 % less"
    )
    two = worth({"objective": 0.6} | OURS, {"objective": 0.8} | THEIRS, RIVAL)
    assert two.changes == pytest.approx({"objective": -0.25, "force_variation": -0.25})
    assert two.in_words.startswith("the force sensor pays: 25.0 % less objective and 25.0 % less force variation than")
    mixed = worth({"objective": 0.6} | THEIRS, {"objective": 0.8} | OURS, RIVAL).in_words
    assert mixed.startswith("the force sensor pays: 25.0 % less objective, though 33.3 % more force variation than pd")
    both = worth({"objective": 0.8} | THEIRS, {"objective": 0.6} | OURS, RIVAL._replace(feasible=False)).in_words
    assert both == (
        "the force sensor does not pay: 33.3 % more objective and 33.3 % more force variation than pd with kp 17, "
        "kd 1, which needs none (and breaks a limit)"
    )
    behind = worth(THEIRS, OURS, RIVAL._replace(lacks="on a grid alone"), place=" on this grid").in_words
    assert behind.startswith("the force sensor does not pay on this grid: 33.3 % more force variation")
    over = OverWalks(64, -0.3, -0.2, 20.0)
    known = worth(OURS, THEIRS, RIVAL, over=over).in_words
    assert known.startswith(
        "the force sensor pays: 25.0 % less force variation (95 % interval -30.0 to -20.0 %) than pd with"
    )
    unknown = worth(OURS, THEIRS, RIVAL, over=over._replace(high=0.1, needed=200.2)).in_words
    assert unknown.startswith(
        "64 walks cannot tell what the force sensor is worth (201 would, if the difference is what it seems): 25.0 % "
    )
    few = worth(OURS, THEIRS, RIVAL, over=OverWalks(4, np.nan, np.nan, np.nan)).in_words
    assert few.startswith("4 walks cannot tell what the force sensor is worth: 25.0 % less force variation than pd")
    others = ["peak pull force +71.0 %"], ["travel +3.0 %"]
    told = worth(OURS, THEIRS, RIVAL._replace(step=5e-4), others=others).in_words
    assert told.endswith(", both at a time step of 0.0005 s; worse: peak pull force +71.0 %; better: travel +3.0 %")
    assert worth({"min_tsm": 3.0}, {"min_tsm": 2.0}, RIVAL, larger=True).in_words.startswith("the force sensor pays")
    lost = worth({"force_variation": np.nan}, THEIRS, RIVAL).in_words
    assert "not to be compared" in lost and lost.endswith("a walk failed")


UNKNOWN = "it cannot be told what the force sensor is worth, since"


@pytest.mark.parametrize(
    ("ours", "theirs", "said"),
    [
        ([30.0], [40.0], f"{UNKNOWN} one search of each tells no law from another (from 4 seeds on): 25.0 % less"),
        ([30.0] * 3, [40.0] * 3, f"{UNKNOWN} 3 searches of each tell no law from another (from 4 seeds on): 25.0 %"),
        ([30.0, 31.0, 30.0, 39.0], [40.0] * 4, "the force sensor pays: 25.0 % less"),
        ([30.0, 31.0, 30.0, 40.0], [40.0] * 4, f"{UNKNOWN} the 4 searches of each do not all agree: 25.0 %"),
        ([30.0, 31.0, 30.0, 41.0], [40.0] * 4, f"{UNKNOWN} the 4 searches of each do not all agree: 25.0 %"),
        ([30.0, 31.0, 30.0, np.inf], [40.0] * 4, f"{UNKNOWN} the 4 searches of each do not all agree: 25.0 %"),
    ],
)
def test_one_search_makes_no_verdict_and_several_that_agree_do(ours, theirs, said):
    """As equal laws would make one in 35 of: all of four searches end below all of four others."""
    assert worth_of(OURS, THEIRS, RIVAL, pd=BESIDE, ends=Ends(ours, theirs)).in_words.startswith(said)


@pytest.mark.parametrize(
    ("planned", "lost", "said"),
    [
        (35.0, False, "the force sensor pays: 14.3 % less objective and 14.3 % less force variation than Planned"
                      "Transfer with kp 17, kd 1, which needs none; 25.0 % less objective than pd with kp 17, kd 1"),
        (41.0, False, "the force sensor pays: 25.0 % less objective and 25.0 % less force variation than pd with"),
        (35.0, True, "the force sensor pays: 25.0 % less objective and 25.0 % less force variation than pd with"),
    ],
)  # fmt: skip
def test_the_rival_is_the_better_of_pd_and_the_plan(planned, lost, said, monkeypatch):
    """One that loses a gripper is none; the ends of the searches are those of the rival."""
    metrics = dict.fromkeys(mc.METRICS.names, 1.0) | {"diverged": False, "detached_limb": None, "stands_at": None}
    walks = {"tuned": metrics | {"force_variation": 30.0}, retuned_pd.NAME: metrics | {"force_variation": 40.0}}
    walks[retuned_pd.PLANNED] = metrics | {"force_variation": planned, "detached_limb": "LF" if lost else None}
    goal = Objective((Term("force_variation", 1.0, 100.0, 100.0),), ())
    scores = {name: of_search.scores_of(goal, each) for name, each in walks.items()}
    monkeypatch.setattr(retuned_pd, "rival_of", lambda found, step: found.rival)
    found = types.SimpleNamespace(ends=[0.3] * 4)
    rivals = [types.SimpleNamespace(rival=RIVAL._replace(name=name), ends=[end] * 4)
              for name, end in (("pd", 0.4), ("PlannedTransfer", 0.35))]  # fmt: skip

    def told():
        best = best_without(found, rivals, {name: each["objective"] for name, each in scores.items()})
        both, scored = ([each[name] for name in ("tuned", best.name)] for each in (walks, scores))
        return between(both, scored, best.rival, Problem(CASE), pd=best.pd, ends=best.ends).in_words

    assert told().startswith(said)
    rivals[0 if lost or planned > 40 else 1].ends[2] = 0.2
    assert "the 4 searches of each do not all agree" in told()


@pytest.mark.parametrize(
    ("law", "what"),
    [(LoadTransfer(), "the force sensor pays"), (Recovering(), "the force sensor with the recovery pays")],
)
def test_what_a_recovery_saves_is_not_put_down_to_the_sensor_alone(law, what):
    """Of a law that steps to recover pd retuned lacks both."""
    problem, ours = Problem(CASE, law=law), {"force_variation": 30.0}
    both = [dict.fromkeys(mc.METRICS.names, 1.0)] * 2
    assert between(both, (ours, {"force_variation": 40.0}), RIVAL, problem, pd=BESIDE).in_words.startswith(f"{what}:")


def test_rivals_share_a_time_step_that_the_joint_gains_of_each_can_follow():
    """pd with the config's kd walks at the config's step; the plan's kd of 1 would diverge there."""
    pd, plan = (types.SimpleNamespace(gains={"kp": 17.0, "kd": kd}) for kd in (0.2, 1.0))
    assert retuned_pd.shared_step(CASE, [pd]) == CASE.time_step
    assert retuned_pd.shared_step(CASE, [pd, plan]) == 5e-4


@pytest.mark.parametrize(("kd", "expected"), [(0.2, None), (1.0, 5e-4)])
def test_what_is_compared_with_pd_walks_at_the_time_step_that_it_needs_too(kd, expected):
    found = side_by_side.beside_retuned(Problem(CASE), {"kp": 17.0, "kd": kd}, (CASE, None))
    steps = {name: scenario.time_step for name, (scenario, _) in found.items()}
    rivals = (retuned_pd.NAME, retuned_pd.UNSEARCHED)
    level = (side_by_side.LEVEL,) if expected else ()
    assert steps == dict.fromkeys((*rivals, *level), expected or CASE.time_step)


def test_load_transfer_by_plan_walks_beside_pd_on_its_joint_gains_where_forces_are_read():
    """With its default gains: the walk of one law more."""
    joint = {"kp": 17.0, "kd": 0.2}
    scenario, law = side_by_side.beside_retuned(Problem(CASE), joint, None)[retuned_pd.UNSEARCHED]
    assert type(law) is PlannedTransfer and (scenario.control.kp, scenario.control.kd) == (17.0, 0.2)
    blind = side_by_side.beside_retuned(Problem(CASE, law=PlannedTransfer()), joint, None)
    assert list(blind) == [retuned_pd.NAME]


@pytest.mark.parametrize(
    ("pd", "plan", "better", "beside"),
    [
        (40.0, 35.0, "PlannedTransfer", "pd on these: 40"),
        (40.0, 50.0, "pd", "load transfer by plan on these, not searched: 50"),
        (40.0, 40.0, "pd", "load transfer by plan on these, not searched: 40"),
        (40.0, np.nan, "pd", "load transfer by plan on these, not searched: the walk failed"),
        (np.nan, 50.0, "PlannedTransfer", "pd on these: the walk failed"),
    ],
)
def test_a_sensor_is_worth_what_it_betters_the_better_rival_by(pd, plan, better, beside):
    name, rival = better_of(RIVAL, {retuned_pd.NAME: pd, retuned_pd.UNSEARCHED: plan})
    assert (rival.name, rival.beside) == (better, beside) and rival.joint == JOINT
    assert (name == retuned_pd.UNSEARCHED) == (better != "pd")
    said = worth_of(OURS, {"force_variation": min(each for each in (pd, plan) if each == each)}, rival).in_words
    assert said.endswith(f"less force variation than {better} with kp 17, kd 1, which needs none ({beside})")
    assert said.startswith("no verdict on the force sensor, since of the laws without one pd alone was searched: ")


def test_joint_gains_are_those_of_pd_and_of_the_plan_on_them_alone():
    rows = {
        "tuned": ({"stiffness": 1.0}, 1),
        retuned_pd.NAME: (None, 2),
        retuned_pd.UNSEARCHED: ({}, 3),
        "pd": (None, 4),
    }
    both, alone = dict(rows), dict(rows)
    give_joint_gains(both, JOINT, retuned_pd.UNSEARCHED)
    assert both == rows | {retuned_pd.NAME: (JOINT, 2), retuned_pd.UNSEARCHED: (JOINT, 3)}
    give_joint_gains(alone, JOINT, retuned_pd.NAME)
    assert alone == {name: row for name, row in both.items() if name != retuned_pd.UNSEARCHED}
    without = {"pd": (None, 4)}
    give_joint_gains(without, JOINT, retuned_pd.UNSEARCHED)
    assert without == {"pd": (None, 4)}


def test_of_a_front_of_an_older_file_pd_is_the_one_rival():
    """Newer ones name the law of each point."""
    assert law_without(xr.Dataset()) == retuned_pd.NAME
    assert law_without(xr.Dataset({"without_law": retuned_pd.UNSEARCHED})) == retuned_pd.UNSEARCHED


def test_of_a_law_that_reads_no_forces_pd_is_the_one_rival():
    assert better_of(RIVAL, {retuned_pd.NAME: 40.0, "pd": 30.0}) == (retuned_pd.NAME, RIVAL)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (-0.22, "the force sensor pays: 25.0 % less force variation than pd"),
        (0.1, "no verdict on the force sensor, since a time step of 0.0005 s turns it round: 25.0 % less"),
        (0.0, "no verdict on the force sensor, since a time step of 0.0005 s turns it round: 25.0 % less"),
        (np.nan, "no verdict on the force sensor, since a time step of 0.0005 s turns it round: 25.0 % less"),
    ],
)
def test_nothing_is_claimed_that_one_time_step_of_both_does_not_show(change, said):
    level = side_by_side.AtOneStep(5e-4, change)
    assert worth_of(OURS, THEIRS, RIVAL, level=level, pd=BESIDE).in_words.startswith(said)


@pytest.mark.parametrize(
    ("law", "changes", "also", "searched"),
    [
        (None, {}, (), False),  # one foot is in the air at all times
        (None, {"gait.duty": 0.8}, (), True),
        (None, {}, ("gait.duty",), True),
        (LoadTransfer(), {"gait.duty": 0.8}, (), True),
        (PlannedTransfer(), {"gait.duty": 0.8}, (), False),  # it reads no forces
        (FootOffsets(), {"gait.duty": 0.8}, (), False),
    ],
)
def test_a_plan_is_searched_where_forces_are_read_and_loads_can_be_handed_over(
    law, changes, also, searched, monkeypatch
):
    """As pd is: the same method, rounds and goal, kp and kd too."""
    scenario, asked = CASE.with_overrides(changes), []
    settings = Search(method="cmaes", also=also, starts=6, iterations=2)
    monkeypatch.setattr(tune, "from_seeds", lambda problem, own, *_, **__: asked.append((problem, own)) or DONE)
    problem = Problem(scenario, spaces.space(scenario, settings, law), law=law)
    work = side_by_side.planned(problem, settings, 1, None)
    assert (work is not None) == searched == retuned_pd.can_plan(problem)
    if work is not None:
        assert work(lambda *_: None) is DONE
        ((problem, own),) = asked
        assert type(problem.law) is PlannedTransfer and {"kp", "kd", "load", *also} <= set(problem.space.gains)
        assert (own.method, own.starts, own.iterations) == ("cmaes", 6, 2)
