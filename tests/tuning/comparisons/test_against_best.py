"""The verdict of every result: against the best rival that walked, by name and numbers; and what is known before."""

import json
import math
import re

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from tuning.comparisons import judge, of_draw, of_schedule, paired
from tuning.comparisons.of_draw import verdict
from tuning.comparisons.of_ensemble import shown
from tuning.comparisons.side_by_side import AtOneStep
from tuning.comparisons.verdicts import Walked, against_best, best_rival, explained, in_words, named
from tuning.pages import judge as judge_page
from tuning.pages.contents import at_own_step
from tuning.problem.ensemble import Ensemble, Worst
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Search
from tuning.problem.spaces import space
from tuning.results.judged import Judged
from tuning.results.scheduled import Scheduled
from tuning.searches.retuned_pd import ON_A_GRID

RETUNED = "pd with its own kp and kd searched (retuned_pd, kp 16.95, kd 0.996)"
JOINT = {"kp": 16.95, "kd": 0.996}
OURS = Walked(0.7607)


@pytest.mark.parametrize(
    ("rivals", "said"),
    [
        # the page of such a search opened with "55.2 % below pd"
        ({"retuned_pd": Walked(0.69), "config": Walked(0.98), "pd": Walked(1.0)},
         f"10.2 % more than the best rival that walked, {RETUNED}: 0.69"),
        ({"retuned_pd": Walked(0.9), "config": Walked(0.8), "pd": Walked(1.0)},
         "4.9 % less than the best rival that walked, the config's gains: 0.8"),
        # one that breaks a limit is the best of those alone that do
        ({"retuned_pd": Walked(0.5, keeps=False), "pd": Walked(1.0)},
         "23.9 % less than the best rival that walked, pd as the config has it: 1"),
        ({"retuned_pd": Walked(0.5, keeps=False), "pd": Walked(1.0, keeps=False)},
         f"52.1 % more than the best rival that walked, {RETUNED}: 0.5, which breaks a limit"),
        ({"retuned_pd": Walked(math.nan), "pd": Walked(0.7608)},
         "the same as the best rival that walked, pd as the config has it: 0.7608"),
        ({"pd": Walked(0.7607 / 1.00049)}, "the same as the best rival that walked, pd as the config has it: 0.7603"),
        ({"pd": Walked(0.7607 / 1.00051)},
         "0.1 % more than the best rival that walked, pd as the config has it: 0.7603"),
        ({"pd": Walked(0.7607 / 0.99949)},
         "0.1 % less than the best rival that walked, pd as the config has it: 0.7611"),
        ({"pd": Walked(0.0)}, "beside the best rival that walked, pd as the config has it: 0"),
        ({"pd": Walked(-0.5)}, "beside the best rival that walked, pd as the config has it: -0.5"),
    ],
)  # fmt: skip
def test_the_verdict_names_the_best_rival_with_numbers(rivals, said):
    found = against_best("tuned gains", {"tuned": OURS, **rivals}, "objective", joint=JOINT)
    assert found == f"tuned gains: objective 0.7607, {said}"


def test_of_scores_that_are_better_the_larger_the_best_rival_has_the_largest():
    """A bound has no per cent."""
    walked = {"mine": Walked(8.0), "config": Walked(2.0), "pd": Walked(4.0)}
    said = "mine: bears 8 N, 100.0 % more than the best rival that walked, pd as the config has it: 4 N"
    assert against_best("mine", walked, "bears", "N", larger_is_better=True) == said
    walked["pd"] = Walked(60.0, bound="more than 60 N")
    said = "mine: bears 8 N, beside the best rival that walked, pd as the config has it: more than 60 N"
    assert against_best("mine", walked, "bears", "N", larger_is_better=True) == said
    assert best_rival(walked) == "config" and best_rival({"mine": Walked(8.0)}) is None


def test_walks_that_failed_are_no_rivals_and_have_no_numbers():
    none = against_best("tuned gains", {"tuned": OURS, "pd": Walked(math.nan)}, "objective")
    assert none == "tuned gains: objective 0.7607; no rival held"
    assert against_best("tuned gains", {"tuned": OURS}, "objective") == "tuned gains: objective 0.7607"
    lost = against_best("tuned gains", {"tuned": Walked(math.nan), "pd": Walked(2.0)}, "force variation", "N")
    assert lost == (
        "tuned gains: the walk failed; the best rival that walked is pd as the config has it: force variation 2 N"
    )


def test_the_per_cent_is_that_of_the_numbers_beside_it_and_the_change_at_one_time_step_a_line_of_its_own():
    """47.07 N at 1 ms are 48.44 N at pd's 0.5 ms: a reader divides the numbers that the sentence shows."""
    walked = {"best": Walked(47.07), "retuned_pd": Walked(38.2), "pd": Walked(100.0)}
    found = against_best("best", walked, "force variation", "N", JOINT)
    ours, change, theirs = (float(text) for text in re.findall(r"(\d+\.\d+) [N%]", found))
    assert (ours, theirs) == (47.07, 38.2) and change == pytest.approx(100 * (ours / theirs - 1), abs=0.05)
    level = AtOneStep(5e-4, 48.44 / 38.2 - 1)
    assert at_own_step(level, "the best", "force variation") == [
        "retuned_pd walks at a time step of 0.0005 s, which its kp and kd need; the best at that step: 26.8 % more "
        "force variation than it"
    ]
    assert at_own_step(None, "the best", "force variation") == []


def scheduled(force, limb, strays=None):
    """A schedule of three points, by the walks' force variation and the limbs that let go; `strays` breaks a limit."""
    dims, names = ("walk", "gravity", "cargo"), ("force_variation", "base_deviation", "detached_limb", "detached_at")
    table = mc.MetricTable([mc.METRICS[name] for name in (*names, "diverged")])
    limbs = [limb.get(name, [-1] * 3) for name in force]
    columns = {
        "force_variation": [*force.values()],
        "detached_limb": limbs,
        "diverged": np.zeros((len(force), 3), bool),
    }
    columns["detached_at"] = np.where(np.array(limbs) < 0, np.nan, 0.1)
    columns["base_deviation"] = [(strays or {}).get(name, [0.0] * 3) for name in force]
    data = {name: (dims, np.reshape(each, (len(force), 3, 1))) for name, each in columns.items()}
    of_points = {name: np.reshape(force[walk], (3, 1)) / 100 for name, walk in
                 (("value", "tuned"), ("retuned_value", "retuned_pd"))}  # fmt: skip
    term = Term("force_variation", 1.0, (100.0, 100.0, 100.0), (100.0, 100.0, 100.0))
    goal = Objective((term,), (Limit("base_deviation", 0.1, 0.1, 0.02, "as asked"),))
    problem = Problem(mc.load_scenario("case_1_2"), metrics=table, objective=goal)
    data |= {name: (dims[1:], each) for name, each in of_points.items()}
    return Scheduled(xr.Dataset(data, {"walk": [*force]}), problem)


def test_gains_tuned_for_each_point_stand_beside_the_best_rival_of_all_points():
    """Where the tuned gains fail nothing is compared; a rival that fails elsewhere is none."""
    force = {"tuned": [40.0, 60.0, 1.0], "config": [90.0, 30.0, 1.0], "retuned_pd": [50.0, 70.0, 1.0]}
    force |= {"pd": [100.0] * 3}
    found = scheduled(force, {"tuned": [-1, -1, 2], "config": [-1, 0, -1]}, {"retuned_pd": [0.0, 0.0, 0.2]})
    assert of_schedule.compare(found).verdict == (
        "gains tuned for each point, which break a limit at 1: mean objective at 2 of 3 operating points 0.5, "
        "16.7 % less than the best rival that walked, pd with its own kp and kd searched (retuned_pd): 0.6"
    )

    lost = scheduled(force, {"tuned": [0, 1, 2], "config": [-1, 0, -1]})
    assert of_schedule.compare(lost).verdict == (
        "gains tuned for each point, which break a limit at 3: the walk failed; the best rival that walked is pd with "
        "its own kp and kd searched (retuned_pd): mean objective at 3 of 3 operating points 0.4033"
    )


def test_a_plan_is_a_rival_of_a_schedule_at_the_points_where_it_keeps_the_limits():
    force = {"tuned": [50.0, 60.0, 90.0], "retuned_pd": [60.0, 70.0, 80.0], "planned_unsearched": [40.0, 50.0, 85.0]}
    force |= {"pd": [100.0] * 3}
    worth, verdict = of_schedule.compare(scheduled(force, {}, {"planned_unsearched": [0.2, 0.0, 0.0]}))
    assert worth == (
        f"no verdict on the force sensor, since pd was searched {ON_A_GRID}: less objective at 1 of 3 operating "
        "points, 0.833 to 1.200 times the least of pd with kp and kd for each and of load transfer by plan on these "
        "(planned_unsearched)"
    )
    assert verdict == (
        "gains tuned for each point: mean objective at 3 operating points 0.6667, 4.8 % less than the best rival that "
        "walked, pd with its own kp and kd searched (retuned_pd): 0.7"
    )


def test_a_word_that_nobody_knows_is_explained():
    assert in_words("retuned_pd", JOINT | {"gait.duty": 0.8}).endswith("kp 16.95, kd 0.996, duty 0.8)")
    assert explained(["tuned", "retuned_pd"]) == "; retuned_pd: pd with its own kp and kd searched"
    assert explained(["tuned"]) == "" and in_words("mine") == "mine"
    assert "planned_unsearched: load transfer by plan, without a force sensor" in explained(["planned_unsearched"])
    assert in_words("planned_unsearched").startswith("load transfer by plan, not searched, on kp and kd of pd (")


@pytest.mark.parametrize("walks", [1, 63, 64, 199, 200])
def test_what_has_no_interval_is_known_before_anything_walks(walks):
    """The rule that is told before is the one that withholds the interval."""
    rng = np.random.default_rng(0)
    names = ["mine", "retuned_pd", "pd"]
    values = rng.uniform(1, 2, (3, walks))
    data = {
        "force_variation": (("gains", "member"), values, {"larger_is_better": 0}),
        "peak_utilization": (("gains", "member"), values / 10, {"larger_is_better": 0}),
        "diverged": (("gains", "member"), np.zeros(values.shape, bool)),
    }
    drawn = xr.Dataset(data, {"gains": names})
    goal = Objective((Term("force_variation", 1.0, 1.0, 1.0),), (), worst=Worst(share=0.2))
    table = paired.compared(drawn, ["force_variation"], "retuned_pd", goal, count=200)
    low = table["low"].sel(gains="mine")
    there = {
        "any mean": np.isfinite(low.sel(metric="force_variation", statistic="mean").item()),
        "the objective": np.isfinite(low.sel(metric="objective", statistic="mean").item()),
        f"the worst {judge.WORST_SHARE:.0%}": np.isfinite(low.sel(metric="force_variation", statistic="worst").item()),
    }
    said = " ".join(paired.without_interval(walks, goal.worst))
    assert {words: words not in said for words in there} == there
    assert paired.without_interval(32, Worst(share=0.2)) == [
        "32 test walks give no interval of any mean (from 64 on) and of the objective (from 64 on)"
        " and of the worst 5% (from 200 on)"
    ]
    assert paired.without_interval(64, Worst(share=0.2), tails=False) == []
    assert paired.without_interval(4, None, tails=False) == ["4 test walks give no interval of any mean (from 64 on)"]
    assert paired.without_interval(64, None, tails=False, seeds=3) == []
    assert paired.without_interval(64, None, tails=False, seeds=2) == [
        "2 searches tell no law from another (from 3 seeds on)"
    ]


def test_gains_that_are_evaluated_stand_beside_the_best_of_those_that_lose_no_more_walks():
    values = [[40.0, 30.0, 50.0, 100.0]] * 2
    names = {"statistic": ["mean", "worst"], "gains": ["mine", "retuned_pd", "config", "pd"]}
    data = {"force_variation": (("statistic", "gains"), values), "failed": ("gains", [0.1, 0.2, 0.1, 0.0])}
    summed = xr.Dataset(data, names)
    best = "20.0 % less than the best rival that walked, the config's gains: 50 N"
    assert verdict(summed) == f"mine: mean force variation 40 N, {best}"
    alone = "33.3 % more than the best rival that walked, pd with its own kp and kd searched (retuned_pd): 30 N"
    assert verdict(summed.sel(gains=["mine", "retuned_pd"])) == (
        f"mine: mean force variation 40 N, {alone}, which loses more walks"
    )


@pytest.mark.parametrize(("members", "claimed"), [(63, False), (64, True)])
def test_differences_on_the_walks_of_a_draw_are_data(members, claimed):
    """From retuned pd where it walked; of too few walks there is no interval, and nothing is claimed."""
    rng, names = np.random.default_rng(0), ["mine", "config", "retuned_pd", "pd"]
    levels = np.array([[40.0], [90.0], [60.0], [100.0]])
    columns = {name: levels + rng.normal(size=(4, members)) for name in shown(mc.METRICS)}
    columns["peak_utilization"] = np.where(np.arange(members) < [[2], [0], [0], [0]], 2.0, 0.1)
    columns["diverged"] = np.zeros((4, members), bool)
    about = {name: {"larger_is_better": int(mc.METRICS[name].larger_is_better)} for name in columns}
    data = {name: (("gains", "member"), each, about[name]) for name, each in columns.items()}
    scenario = mc.load_scenario("case_1_2")
    found = Judged(xr.Dataset(data, {"gains": names}), Problem(scenario), ensemble=Ensemble(members=members))
    told = json.loads(judge_page.contents(found, of_draw.compare(found), "").written.summary)
    assert told.keys() == {"gains", "differences", "verdict"} and [*told["gains"]] == names
    own = told["gains"]["mine"]
    assert own["failed"] == 2 and own["mean"]["force_variation"] == pytest.approx(40, abs=2) and "worst" in own
    assert told["verdict"].startswith("mine: mean force variation ")
    rows = {(row["gains"], row["metric"], row["statistic"]): row for row in told["differences"]}
    row = rows["mine", "force_variation", "mean"]
    assert [*row] == ["gains", "baseline", "metric", "statistic", "difference", "low", "high", "claimed"]
    assert row["baseline"] == "retuned_pd" and row["difference"] == pytest.approx(-20, abs=2)
    assert row["claimed"] is claimed and (row["low"] is not None) is claimed
    assert rows["pd", "force_variation", "worst"]["low"] is None


def test_the_gains_stand_in_the_verdict_where_each_is_one_number():
    scenario = mc.load_scenario("case_1_2")
    problem = Problem(scenario, space=space(scenario, Search()))
    assert named("tuned gains", mc.Gains(1.0, 94.52, np.full(6, 1904.0)), problem) == (
        "tuned gains (damping 94.52, stiffness 1904)"
    )
    assert named("tuned gains", mc.Gains(1.0, 94.52, np.repeat([1904.0, 9.0], 3)), problem) == "tuned gains"
