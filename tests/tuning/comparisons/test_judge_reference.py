"""Walks of a draw summed up: against loops over gains, members and limits, at random walks."""

import math

import numpy as np
import pytest
import xarray as xr

from mjx_climb.scenario.messages import ConfigError
from tuning.comparisons import judge
from tuning.problem.ensemble import Worst
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import LOST

NAMES, MEMBERS = ["mine", "other", "wild", "pd"], 23
LARGER = {"force_variation": 0, "travel": 1, "base_deviation": 0, "peak_utilization": 0, "missed_grips": 0}
LIMITS = (
    Limit("base_deviation", 0.5, 2.0, 0.02, "as asked"),
    Limit("travel", 1.2, 1.2, 0.02, "as asked", larger_is_better=True),
)


def drawn(seed, *, stands=True, diverging=0.1):
    rng = np.random.default_rng(seed)
    columns = {name: rng.uniform(0.2, 1.1, (4, MEMBERS)) for name in LARGER}
    columns["travel"] += 0.9
    columns["missed_grips"] = rng.integers(0, 3, (4, MEMBERS)) * (rng.uniform(size=(4, MEMBERS)) < 0.2)
    columns["diverged"] = rng.uniform(size=(4, MEMBERS)) < diverging
    columns["diverged"][2] |= np.arange(MEMBERS) < 13
    for name in ("force_variation", "travel"):
        columns[name] = np.where(columns["diverged"], np.nan, columns[name])
    if stands:
        columns["stands_at"] = np.where(rng.uniform(size=(4, MEMBERS)) < 0.1, 1.5, np.nan)
    data = {
        name: (("gains", "member"), each, {"larger_is_better": LARGER[name]} if name in LARGER else {})
        for name, each in columns.items()
    }
    return xr.Dataset(data, {"gains": NAMES}, {"title": "walks"})


def cells(walks):
    """The metrics of each walk by gains and member."""
    return {
        name: [{str(key): walks[key].values[g, m].item() for key in walks.data_vars} for m in range(MEMBERS)]
        for g, name in enumerate(NAMES)
    }


def fails(walk):
    return bool(walk["peak_utilization"] > 1 or walk["diverged"] or walk.get("stands_at", math.nan) >= 0)


def mean_of_worst(values, share, larger):
    ordered = sorted(values, reverse=not larger)
    return np.mean(ordered[: max(1, math.ceil(share * len(ordered) - 1e-9))])


def sound(each):
    """Gains that are compared, and the members in which none of them diverges."""
    names = [name for name, own in each.items() if sum(walk["diverged"] for walk in own) / MEMBERS <= 0.5]
    return names, [m for m in range(MEMBERS) if not any(each[name][m]["diverged"] for name in names)]


@pytest.mark.parametrize("seed", range(4))
def test_a_summary_is_that_of_loops(seed):
    walks = drawn(seed, stands=seed % 2 == 0)
    each = cells(walks)
    names, members = sound(each)
    assert names == ["mine", "other", "pd"] and 0 < len(members) < MEMBERS
    share = [0.05, 0.3][seed % 2]
    found = judge.summary(walks, share)
    assert found.attrs == {"title": "walks", "worst_share": share, "members_compared": len(members)}
    for metric in ("force_variation", "travel", "base_deviation"):
        for name in NAMES:
            own = found[metric].sel(gains=name)
            values = [each[name][m][metric] for m in members]
            wanted = [np.mean(values), mean_of_worst(values, share, LARGER[metric])] if name in names else [np.nan] * 2
            np.testing.assert_allclose(own.sel(statistic=["mean", "worst"]), wanted, rtol=1e-12)
    assert "diverged" not in found and "stands_at" not in found
    for name in NAMES:
        lost = [fails(walk) for walk in each[name]]
        assert found["failed"].sel(gains=name) == np.mean(lost)
        assert judge.failed(walks).sel(gains=name).values.tolist() == lost
        missed = np.mean([walk["missed_grips"] for walk in each[name]])
        assert found["missed"].sel(gains=name).item() == pytest.approx(missed)
    told = judge.plain(found, ["travel"])
    assert [*told] == NAMES and told["other"]["failed"] == found["failed"].sel(gains="other")
    own = found["travel"].sel(gains="other")
    assert told["other"]["mean"] == {"travel": own.sel(statistic="mean")}
    assert told["other"]["worst"] == {"travel": own.sel(statistic="worst")}


def test_gains_are_kept_of_which_half_of_the_walks_hold_and_of_every_search():
    """Half of the walks may diverge, one more may not, in any of the searches."""
    diverged = np.zeros((4, 2, 10), bool)
    diverged[0, 0, :5], diverged[1, 1, :6], diverged[2, 1, 8] = True, True, True
    walks = xr.Dataset({"diverged": (("gains", "seed", "member"), diverged)}, {"gains": NAMES, "member": range(10)})
    kept = judge.held(walks)
    assert kept["gains"].values.tolist() == ["mine", "wild", "pd"]
    assert kept["member"].values.tolist() == [5, 6, 7, 9]


def test_nothing_is_summed_up_where_every_member_diverges_for_some_gains():
    walks = drawn(0, diverging=0.0).isel(gains=[0, 1, 3], member=slice(4))
    walks["diverged"][:] = [[True, True, False, False], [False, False, True, True], [False] * 4]
    with pytest.raises(
        ConfigError, match="ensemble: expected a member of the draw in which nothing diverges, got none"
    ):
        judge.summary(walks)


@pytest.mark.parametrize("weighs_lost", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_limits_are_broken_as_often_as_loops_count(seed, weighs_lost):
    walks, terms = drawn(seed), (Term(LOST, 1.0, 0.1, 0.1),) if weighs_lost else ()
    found, each = judge.broken(walks, Objective(terms, LIMITS)), cells(walks)
    words = ["base deviation at most 0.5 (as asked)", "travel at least 1.2 (as asked)"]
    assert found["limit"].values.tolist() == words and found.attrs["units"] == "1"
    for name in NAMES:
        for limit, text in zip(LIMITS, words, strict=True):
            count = 0
            for walk in each[name]:
                over = walk[limit.metric] - limit.value
                kept = (over >= 0 if limit.larger_is_better else over <= 0) or (weighs_lost and fails(walk))
                count += walk["diverged"] or not kept
            assert found.sel(gains=name, limit=text).item() == pytest.approx(count / MEMBERS)
    assert judge.broken(walks, Objective((), ())).shape == (0, 4)


@pytest.mark.parametrize("worst", [None, Worst(share=0.25, weight=0.4)])
def test_scores_of_a_draw_are_relative_to_pd_on_the_same_walks(worst):
    walks = drawn(5, diverging=0.0).isel(gains=[0, 1, 3])
    walks["diverged"][:] = False
    goal = Objective((Term("base_deviation", 3.0, 9.0, 9.0), Term("peak_utilization", 1.0, 9.0, 9.0)), (), worst=worst)
    goal = Objective((*goal.terms, Term("travel", 2.0, 9.0, 9.0, larger_is_better=True)), (), worst=worst)
    walks["travel"] = walks["travel"].fillna(1.5)
    terms, pd = judge.terms_on(walks, goal), walks.sel(gains="pd")
    share = 1.0 if worst is None else worst.share
    for term in terms:
        values = pd[term.metric].values
        bad = mean_of_worst(values, share, term.larger_is_better)
        np.testing.assert_allclose(term[2:4], values.mean())
        np.testing.assert_allclose(term[5:], bad)
    if worst is None:  # each member has a score
        return
    found = judge.scores(walks, goal)
    for name in walks["gains"].values.tolist():
        total = 0.0
        for term in terms:
            values = walks[term.metric].sel(gains=name).values
            ratio = values.mean() / term.baseline
            bad = mean_of_worst(values, share, term.larger_is_better) / term.worst
            ratio, bad = (2 - each if term.larger_is_better else each for each in (ratio, bad))
            total += term.weight * (0.6 * ratio + 0.4 * bad) / 6
        assert found.sel(gains=name).item() == pytest.approx(total, rel=1e-5)
    assert found.sel(gains="pd").item() == pytest.approx(1.0, rel=1e-6)


GOAL = Objective((Term("force_variation", 1.0, 10.0, 10.0, worst=20.0),), LIMITS, worst=Worst(share=0.5), margin=0.01)
BOUND = {"base_deviation": "base deviation at most 0.5 (as asked)", "travel": "travel at least 1.2 (as asked)"}


@pytest.mark.parametrize(("columns", "goal", "said"), [
    # a limit of scale 2 holds from 1.25 of 2 % of it on, in its worst member alone
    ({"base_deviation": [0.1, 0.451]}, GOAL, [BOUND["base_deviation"]]),
    ({"base_deviation": [0.449, 0.1]}, GOAL, []),
    ({"base_deviation": [0.5, 0.1]}, GOAL, [BOUND["base_deviation"]]),
    ({"base_deviation": [0.51, 0.1]}, GOAL, []),
    ({"travel": [1.229, 2.0]}, GOAL, [BOUND["travel"]]),
    ({"travel": [1.231, 2.0]}, GOAL, []),
    ({"travel": [1.2, 2.0], "diverged": [0, 1]}, GOAL, []),
    # no worse than pd: mean 10 and worst 20 hold from 1.25 % on
    ({"force_variation": [0.0, 19.8]}, GOAL, ["mean of force variation no worse than pd's",
                                              "mean of the worst 50% of force variation no worse than pd's"]),
    ({"force_variation": [1.0, 18.8]}, GOAL, ["mean of force variation no worse than pd's"]),
    ({"force_variation": [0.1, 19.6]}, GOAL, []),
    ({"force_variation": [0.3, 19.9]}, GOAL, ["mean of the worst 50% of force variation no worse than pd's"]),
    ({"force_variation": [0.3, 19.9]}, Objective(GOAL.terms, LIMITS, worst=GOAL.worst), []),
])  # fmt: skip
def test_limits_that_hold_gains_where_they_are(columns, goal, said):
    free = {"base_deviation": [0.1, 0.1], "travel": [2.0, 2.0], "force_variation": [1.0, 2.0], "diverged": [0, 0]}
    seen = xr.Dataset(
        {name: (("gains", "member"), [each]) for name, each in (free | columns).items()}, {"gains": ["a"]}
    )
    assert judge.binding(seen, goal, "a") == said


def test_failed_walks_and_lost_sensors_in_words():
    names = {"gains": ["mine", "pd"]}
    summed = xr.Dataset({"failed": ("gains", [0.0, 0.03]), "missed": ("gains", [0.0, 0.0])}, names)
    assert judge.failed_in_words(summed) == "would lose a gripper, or diverge: mine 0%, pd 3%"
    assert judge.failed_in_words(summed.drop_vars("missed")) == "would lose a gripper, or diverge: mine 0%, pd 3%"
    summed["missed"][1] = 0.125
    assert judge.failed_in_words(summed) == (
        "would lose a gripper, or diverge: mine 0%, pd 3%; missed grips of a walk: mine 0, pd 0.12"
    )
    assert judge.lost_in_words(summed) == []
    assert judge.lost_in_words(summed.assign_attrs({judge.LOST_SENSORS: "mine ran"})) == ["warning: mine ran"]
