"""What is concluded from walks that were made up: of a grid, of a search, of one over an ensemble, of several laws."""

import dataclasses
import types

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import LoadTransfer, PlannedTransfer
from tuning.comparisons import maps, of_ensemble, of_laws, of_search, of_sweep, verification
from tuning.comparisons import worth as worths
from tuning.comparisons.side_by_side import AtOneStep
from tuning.problem import spaces
from tuning.problem.ensemble import Ensemble, Worst
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Search
from tuning.results.judged import Comparison
from tuning.results.swept import Swept, best_cell, coarser_grid
from tuning.results.tuned import ENDS, Robust, Tuned
from tuning.searches.retuned_pd import Rival
from tuning.searches.sweep import Grid

CASE = mc.load_scenario("case_1_2")
PULL = Limit("peak_pull_force", 12.0, 12.0, 0.1, "holding limit")
GOAL = Objective((Term("force_variation", 1.0, 100.0, 100.0),), (PULL,))
PROBLEM = Problem(CASE, spaces.space(CASE, Search(space="isotropic")), GOAL)
JOINT = {"kp": 17.0, "kd": 1.0}
RIVAL = Rival(JOINT, 40.0)
HELD = {"diverged": False, "detached_limb": None, "detached_at": None, "stands_at": None}


def walk(variation, **changes):
    return dict.fromkeys(mc.METRICS.names, 1.0) | HELD | {"force_variation": variation} | changes


# ---------------------------------------------------------------------------------------------------------- of a grid


def grid(variation, lost=()):
    """A grid of two stiffnesses and three dampings, its walks lost in some cells."""
    shape = ("stiffness", "damping")
    limb = np.full((2, 3), -1)
    for cell in lost:
        limb[cell] = 2
    data = {"force_variation": np.array(variation, float), "diverged": np.zeros((2, 3), bool), "detached_limb": limb}
    made = xr.Dataset({n: (shape, v) for n, v in data.items()}, {"stiffness": [1e3, 2e3], "damping": [5.0, 7.25, 9.0]})
    made["force_variation"].attrs["larger_is_better"] = 0
    return Swept(made, Problem(CASE))


VALUES = [[50, 30, 60], [20, 35, 45]]


def rows(best=30.0, retuned=40.0, **changes):
    gains = {"stiffness": 1e3, "damping": 7.25}
    return {
        "best": (gains, walk(best)), "retuned_pd": (None, walk(retuned)), "paper": ({}, walk(80.0, **changes)),
        "pd": (None, walk(100.0)),
    }  # fmt: skip


def test_the_best_cell_is_the_least_of_those_that_hold_and_beside_its_rivals():
    found = grid(VALUES, lost=[(1, 0)])
    best = best_cell(found.data)
    assert (best["stiffness"].item(), best["damping"].item()) == (1e3, 7.25)
    own = rows()
    worth, level, said = of_sweep.conclusions(found, best, own, RIVAL, None, None)
    assert said == (
        "best of 6 walks, stiffness 1000 and damping 7.25: force variation 30 N, 25.0 % less than the best rival that "
        "walked, pd with its own kp and kd searched (retuned_pd, kp 17, kd 1): 40 N"
    )
    assert worth.changes == {"force_variation": pytest.approx(-0.25)} and level is None
    assert "better:" not in worth.in_words  # but for what the verdict is on
    assert own["retuned_pd"][0] == JOINT
    behind, _, _ = of_sweep.conclusions(found, best, rows(best=50.0), RIVAL, None, None)
    assert behind.in_words.startswith("the force sensor does not pay on this grid: 25.0 % more force variation")
    assert of_sweep.at_edge(found, best) == ["stiffness"]
    assert of_sweep.at_edge(grid(VALUES), best_cell(grid(VALUES).data)) == ["stiffness", "damping"]
    assert of_sweep.at_edge(found, None) == []


@pytest.mark.parametrize(("planned", "than", "known"), [(35.0, "PlannedTransfer", True), (45.0, "pd", False)])
def test_beside_a_grid_the_better_of_pd_and_the_plan_on_its_joint_gains_is_the_rival(planned, than, known):
    found, own = grid(VALUES, lost=[(1, 0)]), rows() | {"planned_unsearched": (None, walk(planned))}
    worth, _, said = of_sweep.conclusions(found, best_cell(found.data), own, RIVAL, None, None)
    assert worth.changes["force_variation"] == pytest.approx(30 / min(planned, 40.0) - 1)
    assert f"less force variation than {than} with kp 17, kd 1, which needs none" in worth.in_words
    assert ("planned_unsearched" in own) == ("planned_unsearched" in said) == known


def test_the_change_at_one_time_step_is_that_of_the_walk_at_that_step():
    found = grid(VALUES, lost=[(1, 0)])
    level = AtOneStep(5e-4, np.nan)
    worth, level, _ = of_sweep.conclusions(found, best_cell(found.data), rows(), RIVAL, level, walk(44.0))
    assert level == AtOneStep(5e-4, pytest.approx(0.1))
    assert worth.in_words.startswith("no verdict on the force sensor on this grid, since a time step of 0.0005 s turns")


def test_a_coarser_grid_has_nearly_as_many_cells_as_it_may():
    data = xr.Dataset({"diverged": (("a", "b"), np.zeros((40, 60), bool))}, {"a": np.arange(40), "b": np.arange(60)})
    for most in (100, 1000, 2000):
        assert 0.85 * most <= coarser_grid(data, None, most)["diverged"].size <= most


def test_where_no_walk_holds_there_is_no_worth_and_pd_retuned_has_its_gains():
    found = grid(VALUES, lost=[(n, m) for n in range(2) for m in range(3)])
    assert best_cell(found.data) is None
    own = {name: each for name, each in rows().items() if name != "best"}
    worth, _, said = of_sweep.conclusions(found, None, own, RIVAL, None, None)
    assert worth is None and own["retuned_pd"][0] == JOINT
    assert said == "none of the 6 walks held: every one lost a gripper or diverged"


def test_without_pd_retuned_the_best_is_beside_the_others_that_hold():
    found = grid(VALUES)
    own = {name: each for name, each in rows(detached_limb="LF", detached_at=1.0).items() if name != "retuned_pd"}
    worth, _, said = of_sweep.conclusions(found, best_cell(found.data), own, None, None, None)
    assert worth is None and said.endswith(
        "70.0 % less than the best rival that walked, pd as the config has it: 100 N"
    )


@pytest.mark.parametrize(
    ("changes", "name"),
    [({}, "paper"), ({"control.stiffness": 3e4}, "config"), ({"control.damping": 1e4}, "config"),
     ({"control.inertia": 2.0}, "config"), ({"control.stiffness": 4e5, "control.damping": 1e4}, "paper"),
     ({"control.stiffness": 2e4}, "paper"), ({"control.stiffness": 4e5}, "config")],
)  # fmt: skip
def test_the_scenarios_own_gains_are_the_papers_where_all_three_are(changes, name):
    assert of_sweep.own_name(Problem(CASE.with_overrides(changes))) == name


def test_another_law_has_gains_of_its_own():
    assert of_sweep.own_name(Problem(CASE, law=LoadTransfer())) == "config"


@pytest.mark.parametrize("lost", [{"diverged": True}, {"detached_limb": "LF", "detached_at": 1.0}, {"stands_at": 0.5}])
def test_a_walk_that_failed_has_no_variation(lost):
    assert np.isnan(of_sweep.variation_of(walk(30.0, **lost))) and of_sweep.variation_of(walk(30.0)) == 30.0
    scores = of_search.scores_of(GOAL, walk(30.0, **lost))
    assert np.isnan(scores["objective"]) and np.isnan(scores["force_variation"])


# -------------------------------------------------------------------------------------------------------- of a search


def tuned(value, gains, kind=Tuned, law=None, ends=None, feasible=True, scenario=CASE, **more):
    data = {"value": [value], "penalty": [0.0], "feasible": [feasible], "phase": ["population"]}
    made = xr.Dataset({name: ("point", each) for name, each in data.items()}, attrs={"interrupted": 0})
    made = made.assign_attrs({} if ends is None else {ENDS: ends})
    problem = dataclasses.replace(PROBLEM, law=law, scenario=scenario)
    return kind(made, problem, Search(space="isotropic", joint_gains=True), gains=gains, **more)


OURS = {"stiffness": 2e3, "damping": 50.0}
FINE = CASE.with_overrides({"time_step": 1.25e-4})  # which all kp and kd can follow
PD = tuned(0.4, JOINT, ends=[0.4] * 4, scenario=FINE)
PLAN = tuned(0.35, {"kp": 20.0, "kd": 1.0}, law=PlannedTransfer(), ends=[0.35] * 4, scenario=FINE)


def searched(value=0.3, **how):
    return tuned(value, OURS, ends=[value] * 4, **how)


def test_a_search_is_beside_its_rivals_in_their_order_with_their_gains():
    walked = {
        "pd": (None, walk(100.0)), "config": ({"stiffness": 1.0}, walk(60.0)), "retuned_pd": (None, walk(40.0)),
        "tuned": (OURS, walk(30.0, peak_pull_force=11.0)),
    }  # fmt: skip
    rows, _, worth, said, apart = of_search.conclusions(searched(), walked, (PD, None), None)
    assert list(rows) == ["tuned", "retuned_pd", "config", "pd"] and rows["retuned_pd"][0] == JOINT
    assert worth.changes == pytest.approx({"objective": -0.25, "force_variation": -0.25}) and apart is None
    assert "worse: peak pull force +1000 %" in worth.in_words
    assert said == (
        "tuned gains (stiffness 2000, damping 50): objective 0.3, 25.0 % less than the best rival that walked, pd with "
        "its own kp and kd searched (retuned_pd, kp 17, kd 1): 0.4"
    )
    # a rival beyond a limit is the best of those alone that are
    walked["retuned_pd"] = None, walk(40.0, peak_pull_force=12.5)
    _, broken, _, said, _ = of_search.conclusions(searched(), walked, (PD, None), None)
    assert said.endswith("50.0 % less than the best rival that walked, the config's gains: 0.6")
    pull = "peak pull force 12.5, limit 12 (holding limit)"
    assert broken == {"tuned": [], "retuned_pd": [pull], "config": [], "pd": []}


def test_of_a_search_the_step_of_pd_may_turn_the_verdict_round():
    walked = {"tuned": (OURS, walk(30.0)), "retuned_pd": (None, walk(40.0))}
    _, _, worth, _, apart = of_search.conclusions(searched(), walked, (PD, None), (5e-4, walk(42.0)))
    assert apart == AtOneStep(5e-4, pytest.approx(0.05))
    assert worth.in_words.startswith("no verdict on the force sensor, since a time step of 0.0005 s turns it round")


def test_of_a_search_without_pd_retuned_nothing_is_said_of_the_sensor():
    walked = {"tuned": (OURS, walk(30.0)), "config": ({}, walk(60.0)), "pd": (None, walk(100.0))}
    rows, _, worth, said, apart = of_search.conclusions(searched(), walked, (None, None), None)
    assert worth is None and apart is None and list(rows) == ["tuned", "config", "pd"]
    assert said.endswith("50.0 % less than the best rival that walked, the config's gains: 0.6")


@pytest.mark.parametrize(("planned", "than"), [(35.0, "PlannedTransfer"), (45.0, "pd")])
def test_of_a_search_the_better_of_pd_and_the_plan_is_the_rival(planned, than):
    walked = {
        "tuned": (OURS, walk(30.0)), "retuned_pd": (None, walk(40.0)), "planned_transfer": ({}, walk(planned)),
        "pd": (None, walk(100.0)),
    }  # fmt: skip
    rows, _, worth, _, _ = of_search.conclusions(searched(), walked, (PD, PLAN), None)
    assert list(rows) == ["tuned", "retuned_pd", "planned_transfer", "pd"]
    assert worth.changes["objective"] == pytest.approx(30 / min(planned, 40.0) - 1)
    assert f"less objective and {100 * (1 - 30 / min(planned, 40.0)):.1f} % less force variation than {than} with" in (
        worth.in_words
    )
    # at the time step of pd alone the gains are worse, which is nothing to a plan that walks at their own
    rows, _, worth, _, apart = of_search.conclusions(searched(), walked, (PD, PLAN), (5e-4, walk(42.0)))
    assert apart == AtOneStep(5e-4, pytest.approx(0.05))
    assert ("turns it round" in worth.in_words) is (than == "pd")


@pytest.mark.parametrize(("planned", "than"), [(35.0, "PlannedTransfer"), (45.0, "pd")])
def test_of_a_search_a_plan_that_was_not_searched_is_a_rival_on_the_joint_gains_of_pd(planned, than):
    walked = {"tuned": (OURS, walk(30.0)), "retuned_pd": (None, walk(40.0)), "pd": (None, walk(100.0))}
    walked["planned_unsearched"] = None, walk(planned)
    rows, _, worth, _, _ = of_search.conclusions(searched(), walked, (PD, None), None)
    assert rows.get("planned_unsearched", ({}, 0))[0] == (JOINT if planned < 40.0 else {})
    assert worth.changes["objective"] == pytest.approx(30 / min(planned, 40.0) - 1)
    assert f"less force variation than {than} with kp 17, kd 1" in worth.in_words
    # on the joint gains of pd it has the time step of pd, so that ours are beside it there
    _, _, worth, _, apart = of_search.conclusions(searched(), walked, (PD, None), (5e-4, walk(42.0)))
    assert apart.change == pytest.approx(42 / min(planned, 40.0) - 1) and "turns it round" in worth.in_words
    walked["planned_unsearched"] = None, walk(planned, peak_pull_force=12.5)  # it breaks a limit
    rows, _, worth, _, _ = of_search.conclusions(searched(), walked, (PD, None), None)
    assert "than pd with" in worth.in_words and "planned_unsearched" not in rows


def test_the_joint_gains_of_pd_retuned_are_those_of_its_walk_where_that_tells_them():
    """The plan on them has a searched gait too."""
    own = {"kp": 18.0, "gait.duty": 0.8}
    walked = {"tuned": (OURS, walk(30.0)), "retuned_pd": (own, walk(40.0)), "planned_unsearched": ({}, walk(35.0))}
    rows, *_ = of_search.conclusions(searched(), walked, (PD, None), None)
    assert rows["retuned_pd"][0] == rows["planned_unsearched"][0] == {"kp": 18.0, "kd": 1.0, "gait.duty": 0.8}


@pytest.mark.parametrize(("ki", "also"), [(0.0, ()), (2.0, ()), (0.0, ("gait.duty",)), (2.0, ("gait.duty",))])
def test_the_gains_of_a_walk_are_those_of_its_law_its_joints_and_a_gait_that_was_searched(ki, also):
    """pd has none of its own: its joint gains are told where the gait is."""
    case = CASE.with_overrides({"control.ki": ki, "control.kp": 40.0, "gait.duty": 0.8})
    problem = Problem(case, spaces.space(case, Search(also=also)), GOAL)
    joint = {"kp": 40.0, "kd": case.control.kd} | ({"ki": ki} if ki else {})
    keys = ("stride", "step_height", "cycle", "duty", "settling", "height", "sway", "landing_speed")
    gait = {f"gait.{key}": getattr(case.gait, key) for key in keys if also}
    mine, laws = {"mine": 1.0}, {"mine": 1.0, **joint, **gait}
    own = {name: getattr(case.control, name) for name in mc.Gains.AXES} | joint | gait
    pd = case.with_overrides({"control.controller": "pd"})
    for scenario, law, gains, expected in (
        (case, None, None, own), (case, PlannedTransfer(), mine, laws), (pd, None, None, gait and joint | gait),
    ):  # fmt: skip
        told = of_search.with_joint_gains(types.SimpleNamespace(scenario=scenario, law=law, gains=gains), problem)
        assert told == (expected or None)


@pytest.mark.parametrize(
    ("settings", "shared"),
    [({}, True), ({"inertia": True}, False), ({"pins": {"inertia": 2.0}}, False), ({"also": ("gait.cycle",)}, False),
     ({"joint_gains": True}, False)],
)  # fmt: skip
def test_a_map_is_begun_before_its_search_where_results_differ_in_the_gains_of_its_axes_alone(settings, shared):
    search = Search.make({"space": "isotropic", **settings})
    problem = Problem(CASE, spaces.space(CASE, search), GOAL)
    assert (of_search.begin(problem, search, lambda work: work).over is not None) == shared


def test_the_map_around_a_result_has_its_other_gains(monkeypatch):
    """Its inertia was that of the config."""
    asked = []
    monkeypatch.setattr(Grid, "result", lambda self, _: asked.append(self) or types.SimpleNamespace(data=None))
    monkeypatch.setattr(Grid, "walk", lambda self, rows: {"row": rows})
    monkeypatch.setattr(maps, "judged_by", lambda *_: None)
    monkeypatch.setattr(maps, "with_stability", lambda _, scenario, **how: (scenario, how["law"]))
    found = tuned(0.3, mc.Gains(2.5, 50.0, 2e3, kp=np.asarray(20.0)))
    scenario, law = verification.map_of(found)
    assert law is None and scenario is asked[0].walked.scenario and asked[0].walked.dtype is np.float32
    assert set(np.ravel(scenario.control.inertia)) == {2.5} and scenario.control.kp == 20.0
    assert {*asked[0].axes} == {"stiffness", "damping"} and asked[0].rows == 144


# ----------------------------------------------------------------------------------------------------- of an ensemble

NAMES = ["robust", "retuned_pd", "planned_transfer", "config", "pd"]


def draw(level, pull=(1.0,) * 5, members=200, scatter=0.02, names=NAMES):
    """Walks of gains through a draw, each with its own level beside what all have in common."""
    rng, data = np.random.default_rng(0), {}
    common = 1 + 0.2 * rng.standard_normal(members)
    for name in (*of_ensemble.SHOWN, "peak_utilization"):
        own = level if name == "force_variation" else pull if name == "peak_pull_force" else np.ones(len(names))
        noise = scatter * rng.standard_normal((len(names), members)) if name == "force_variation" else 0.0
        common_part = common if name == "force_variation" else 1.0
        values = np.asarray(own, float)[: len(names), None] * (common_part + noise) * np.ones(members)
        attrs = {"larger_is_better": int(mc.METRICS[name].larger_is_better), "units": "N"}
        data[name] = (("gains", "member"), values, attrs)
    data["peak_utilization"] = (("gains", "member"), np.full((len(names), members), 0.5))
    data["diverged"] = (("gains", "member"), np.zeros((len(names), members), bool))
    data["detached_limb"] = (("gains", "member"), np.full((len(names), members), -1))
    return xr.Dataset(data, {"gains": names, "member": np.arange(members)})


def robust(**how):
    goal = dataclasses.replace(GOAL, worst=Worst())
    found = tuned(0.3, OURS, kind=Robust, ends=[0.3] * 4, ensemble=Ensemble(members=8), judges=200, **how)
    return dataclasses.replace(found, problem=dataclasses.replace(found.problem, objective=goal))


def test_over_an_ensemble_gains_are_beside_the_best_of_their_rivals():
    walks = draw([30, 40, 90, 60, 100])
    seen = walks.isel(gains=[0])
    found = of_ensemble.conclusions(robust(), walks, seen, (PD, None), 5e-4)
    assert found.joint == JOINT and found.worth.changes["objective"] == pytest.approx(-0.25, abs=0.01)
    assert "both at a time step of 0.0005 s" in found.worth.in_words
    assert found.verdict.startswith("robust gains (stiffness 2000, damping 50): objective over 200 unseen walks 0.")
    assert "retuned_pd, kp 17, kd 1" in found.verdict and "do not tell" not in found.verdict
    assert found.binding == []
    close = of_ensemble.conclusions(robust(), draw([40, 40, 90, 60, 100], scatter=0.3), seen, (PD, None), None)
    assert close.verdict.endswith("; 200 walks do not tell them from retuned_pd")


@pytest.mark.parametrize(("level", "than"), [([30, 40, 35, 60, 100], "PlannedTransfer"), ([30, 40, 45, 60, 100], "pd")])
def test_over_an_ensemble_the_plan_is_the_rival_where_it_is_better(level, than):
    walks = draw(level)
    found = of_ensemble.conclusions(robust(), walks, walks.isel(gains=[0]), (PD, PLAN), None)
    assert found.worth.changes["objective"] == pytest.approx(30 / min(level[1:3]) - 1, abs=0.01)
    assert f"than {than} with" in found.worth.in_words and "the force sensor pays" in found.worth.in_words


@pytest.mark.parametrize(("level", "than"), [([30, 40, 35, 60, 100], "PlannedTransfer"), ([30, 40, 45, 60, 100], "pd")])
def test_over_an_ensemble_a_plan_that_was_not_searched_is_a_rival_too(level, than):
    walks = draw(level, names=["robust", "retuned_pd", "planned_unsearched", "config", "pd"])
    found = of_ensemble.conclusions(robust(), walks, walks.isel(gains=[0]), (PD, None), None)
    assert found.worth.changes["objective"] == pytest.approx(30 / min(level[1:3]) - 1, abs=0.01)
    assert f"than {than} with" in found.worth.in_words and "the force sensor pays" not in found.worth.in_words
    assert ("planned_unsearched" in found.walks["gains"]) == (than == "PlannedTransfer")


def test_over_an_ensemble_rivals_that_break_a_limit_in_more_walks_come_last():
    """Of several limits that which is broken in the most walks."""
    names = ["robust", "retuned_pd", "config", "pd"]
    walks, result = draw([30, 40, 60, 100], names=names), robust()
    goal = dataclasses.replace(result.problem.objective, limits=(Limit("base_deviation", 2.0, 2.0, 0.1, "as"), PULL))
    result = dataclasses.replace(result, problem=dataclasses.replace(result.problem, objective=goal))
    walks["peak_pull_force"][1, :20] = 13.0
    found = of_ensemble.conclusions(result, walks, walks.isel(gains=[0]), (PD, None), None)
    assert "the config's gains" in found.verdict
    np.testing.assert_allclose(found.summed["broken"].sel(gains="retuned_pd"), [0.0, 0.1])
    walks["peak_pull_force"][0, :20] = 13.0
    found = of_ensemble.conclusions(result, walks, walks.isel(gains=[0]), (PD, None), None)
    assert "retuned_pd" in found.verdict


def test_over_an_ensemble_limits_that_bind_are_those_of_the_searchs_own_draw():
    walks = draw([30, 40, 90, 60, 100])
    seen = walks.isel(gains=[0]).copy(deep=True)
    seen["peak_pull_force"][0, 3] = 11.9
    found = of_ensemble.conclusions(robust(), walks, seen, (PD, None), None)
    assert len(found.binding) == 1 and "peak pull force" in found.binding[0]
    assert of_ensemble.conclusions(robust(), walks, seen, (None, None), None).worth is None


def test_a_table_shows_the_main_metrics_and_the_users_own():
    table = types.SimpleNamespace(names=(*mc.METRICS.names, "mine"))
    assert of_ensemble.shown(table, ("travel",)) == ["travel", "mine"]


# ------------------------------------------------------------------------------------------------------------ of laws


def laws(values, reading, outside=(), members=120):
    """Laws by the objective at which their searches ended, and how they walk in a draw that no search saw."""
    names = [*values, "retuned_pd", "pd"]
    level = [*(100 * value for value in values.values()), 50.0, 100.0]
    walks = draw(level, members=members, names=names)
    both = walks.map(lambda each: xr.concat([each] * 4, "seed").transpose("gains", "seed", "member"), keep_attrs=True)
    ends = [*values.values(), 0.5, np.nan]
    data = both.assign(search_value=(("gains", "seed"), np.repeat(np.array(ends)[:, None], 4, 1)))
    data = data.assign_coords(seed=range(4))
    each = {name: (tuned(value, OURS, feasible=name not in outside),) * 4 for name, value in values.items()}
    laws_by = {True: None, False: mc.control.PD()}
    each = {
        name: tuple(dataclasses.replace(one, problem=dataclasses.replace(one.problem, law=laws_by[name in reading]))
                    for one in own)
        for name, own in each.items()
    }  # fmt: skip
    goal = dataclasses.replace(GOAL, limits=())
    return Comparison(data, dataclasses.replace(PROBLEM, objective=goal), searched=each | {"retuned_pd": (PD,) * 4})


@pytest.mark.parametrize(
    ("values", "reading", "outside", "said"),
    [
        ({"a": 0.3, "b": 0.4}, ["a"], [], ["a beside b, the best law that reads no forces"]),
        ({"a": 0.3, "b": 0.35, "c": 0.4}, ["a", "c"], [], ["a beside b, the best law that reads no forces"]),
        ({"a": 0.3, "b": 0.6, "c": 0.4}, ["a", "c"], [], ["a beside pd with its own kp and kd searched"]),
        ({"a": 0.3, "b": 0.4, "c": 0.45}, ["a", "c"], ["a"], ["c beside b, the best law that reads no forces"]),
        ({"a": 0.3, "b": 0.4}, [], [], ["no law here reads forces"]),
        ({"a": 0.3}, ["a"], [], ["no law beside pd was searched that reads no forces"]),
        ({"a": 0.3, "b": 0.4}, ["a"], ["a"], ["no law beside pd was searched that reads no forces"]),
    ],
)
def test_a_sensor_is_worth_what_the_best_law_with_one_has_over_the_best_without(values, reading, outside, said):
    found = of_laws.compare(laws(values, reading, outside))
    assert found.reading == reading
    assert all(text in found.verdict.in_words for text in said), found.verdict.in_words


def test_the_worth_of_a_sensor_is_of_the_laws_whose_searches_end_at_the_least_mean():
    """Not of that with the best single search; forces may come from the efforts of joints."""
    found = laws({"a": 0.3, "b": 0.4, "c": 0.35}, ["a", "c"])
    ends = found.data["search_value"].copy()
    ends.loc[{"gains": "c"}] = [0.1, 0.5, 0.5, 0.5]
    case = CASE.with_overrides({"hardware.force_sensor.source": "joint_effort"})
    problem = dataclasses.replace(found.problem, scenario=case)
    found = dataclasses.replace(found, data=found.data.assign(search_value=ends), problem=problem)
    said = of_laws.compare(found).verdict.in_words
    assert "reading joint efforts is worth" in said and "a beside b, the best law that reads no forces" in said


def test_laws_results_are_by_their_searches():
    found = laws({"a": 0.3, "b": 0.4}, ["a"], ["b"])
    assert found.laws == ["a", "b"] and found.outside == ["b"] and found.hardware == [] and found.unsettled == []
    near, far = tuned(0.2, OURS, feasible=False), tuned(0.4, OURS)
    own = dataclasses.replace(found, searched={"a": (near, far), "retuned_pd": (PD, PD)})
    assert own.tuned["a"] is far and own.outside == ["a"]
    unsettled = dataclasses.replace(far, data=far.data.assign_attrs(converged=0))
    assert dataclasses.replace(found, searched={"a": (far, unsettled), "b": (far, far)}).unsettled == ["a"]
    walks = found.data.assign_coords(gains=["a", "b", "half the friction", "pd"])
    assert dataclasses.replace(found, data=walks).hardware == ["half the friction"]


def test_the_worth_of_a_sensor_is_unknown_where_one_of_the_values_is():
    values = {"objective": 0.3, "force_variation": 30.0}
    for lost in values:
        found = worths.worth_of(values, {"objective": 0.4, "force_variation": 40.0} | {lost: np.nan}, RIVAL)
        than = "pd with kp 17, kd 1, which needs none"
        assert found.in_words == f"the force sensor: not to be compared with {than}: a walk failed"


@pytest.mark.parametrize(("plan", "name"), [(0.45, "retuned_pd"), (0.35, "planned_unsearched")])
def test_searches_are_compared_where_both_were_made(plan, name):
    """The plan on pd's joint gains was not searched: where it is the rival, ends of searches tell nothing."""
    best = worths.best_without(searched(), (PD, None), {"retuned_pd": 0.4, "planned_unsearched": plan})
    assert best.name == name and best.pd is None
    assert best.ends == (worths.Ends([0.3] * 4, [0.4] * 4) if name == "retuned_pd" else None)
