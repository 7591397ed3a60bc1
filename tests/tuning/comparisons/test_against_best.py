"""The verdict of every result: against the best rival that walked, by name and numbers; and what is known before."""

import math

import numpy as np
import pytest
import xarray as xr

from tuning.comparisons import judge, paired
from tuning.comparisons.verdicts import Walked, against_best, explained, in_words
from tuning.pages.judge import verdict
from tuning.problem.ensemble import Worst
from tuning.problem.objectives import Objective, Term

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
        ({"pd": Walked(0.0)}, "beside the best rival that walked, pd as the config has it: 0"),
    ],
)  # fmt: skip
def test_the_verdict_names_the_best_rival_with_numbers(rivals, said):
    found = against_best("tuned gains", {"tuned": OURS, **rivals}, "objective", joint=JOINT)
    assert found == f"tuned gains: objective 0.7607, {said}"


def test_walks_that_failed_are_no_rivals_and_have_no_numbers():
    none = against_best("tuned gains", {"tuned": OURS, "pd": Walked(math.nan)}, "objective")
    assert none == "tuned gains: objective 0.7607; no rival held"
    lost = against_best("tuned gains", {"tuned": Walked(math.nan), "pd": Walked(2.0)}, "force variation", "N")
    assert lost == (
        "tuned gains: the walk failed; the best rival that walked is pd as the config has it: force variation 2 N"
    )


def test_where_pd_needs_a_shorter_time_step_the_change_is_that_of_one_time_step():
    """47.09 N at 1 ms are 48.45 N at pd's 0.5 ms: the number is one, and the change is told at one step."""
    walked = {"best": Walked(47.09), "retuned_pd": Walked(38.2), "pd": Walked(100.0)}
    found = against_best("best", walked, "force variation", "N", JOINT, (5e-4, 0.268))
    assert found.startswith(
        "best: force variation 47.09 N, 26.8 % more, both at a time step of 0.0005 s, than the best"
    )
    walked["config"] = Walked(30.0)
    assert "57.0 % more than" in against_best("best", walked, "force variation", "N", JOINT, (5e-4, 0.268))


def test_a_word_that_nobody_knows_is_explained():
    assert in_words("retuned_pd", JOINT | {"gait.duty": 0.8}).endswith("kp 16.95, kd 0.996, duty 0.8)")
    assert explained(["tuned", "retuned_pd"]) == "; retuned_pd: pd with its own kp and kd searched"
    assert explained(["tuned"]) == "" and in_words("mine") == "mine"


@pytest.mark.parametrize("walks", [1, 32, 49, 50, 199, 200])
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
        "the objective": np.isfinite(low.sel(metric="objective", statistic="mean").item()),
        f"the worst {judge.WORST_SHARE:.0%}": np.isfinite(low.sel(metric="force_variation", statistic="worst").item()),
    }
    said = " ".join(paired.without_interval(walks, goal.worst))
    assert {words: words not in said for words in there} == there
    assert paired.without_interval(32, Worst(share=0.2)) == [
        "32 test walks give no interval of the objective (from 50 on) and of the worst 5% (from 200 on)"
    ]
    assert paired.without_interval(50, Worst(share=0.2), tails=False) == []


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
