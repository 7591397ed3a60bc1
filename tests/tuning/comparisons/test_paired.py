"""Intervals of differences between gains on the same walks: against plain resampling and against the normal law."""

import math
import re

import numpy as np
import pytest
import scipy.stats
import xarray as xr

from tuning.comparisons import judge, of_draw, paired
from tuning.problem import ensemble
from tuning.problem.ensemble import Worst
from tuning.problem.objectives import Objective, Term

NAMES = ["mine", "other", "retuned_pd", "half the friction", "pd"]


@pytest.mark.parametrize("larger", [False, True])
@pytest.mark.parametrize("share", [0.05, 0.3, 1.0])
def test_statistics_are_those_of_the_walks_drawn_again(share, larger):
    rng = np.random.default_rng(0)
    values, drawn = rng.normal(size=(3, 37)), rng.integers(0, 37, (50, 37))
    values[1] = np.round(values[1])  # equal ones
    counts = np.stack([np.bincount(row, minlength=37) for row in drawn])
    found = paired.worst_mean(values, counts, share, larger_is_better=larger)
    wanted = [[ensemble.worst_mean(own[row], share, larger_is_better=larger) for own in values] for row in drawn]
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


def test_resamples_are_as_many_walks_drawn_alike(monkeypatch):
    whole = np.concatenate(list(paired.resamples(40, 3000, seed=1)))
    assert whole.shape == (3000, 40) and (whole.sum(1) == 40).all()
    assert whole.mean(0) == pytest.approx(1, abs=5 * np.sqrt(39 / 40 / 3000))
    assert whole.var() == pytest.approx(39 / 40, rel=0.02)
    monkeypatch.setattr(paired, "AT_ONCE", 400)
    np.testing.assert_array_equal(np.concatenate(list(paired.resamples(40, 3000, seed=1))), whole)
    assert [len(some) for some in paired.resamples(40, 25)] == [10, 10, 5]


def test_the_interval_of_normal_differences_is_the_analytic_one():
    """What both walks have in common, thirty times as large, does not widen it."""
    rng = np.random.default_rng(3)
    common, difference = 30 * rng.normal(size=500), 0.2 + rng.normal(size=500)
    values = np.stack([common + difference, common])[:, None]
    found = paired.intervals({"mean": lambda counts: paired.worst_mean(values, counts)}, 500, 1, count=20_000)["mean"]
    error = difference.std(ddof=1) / np.sqrt(500)
    np.testing.assert_allclose([found.value[0], found.difference[0]], [values[0].mean(), difference.mean()], rtol=1e-12)
    # a quantile of 20,000 is off by some 0.02 of the error
    np.testing.assert_allclose(
        (np.array([found.low[0], found.high[0]]) - found.difference[0]) / error, [-1.96, 1.96], atol=0.08
    )
    assert found.difference[1] == found.low[1] == found.high[1] == 0
    needed = 500 * ((1.96 + 0.84) * error / found.difference[0]) ** 2
    assert found.walks_needed[0] == pytest.approx(needed, rel=0.1)


@pytest.mark.parametrize("walks", [4, 12])
def test_few_walks_scatter_by_the_variance_of_one_known_by_the_others(walks):
    """The error that interval and number of walks rest on is that of the mean, with one degree of freedom taken."""
    values = np.concatenate([np.random.default_rng(5).normal(size=(1, 1, walks)), np.zeros((1, 1, walks))])
    found = paired.intervals({"": lambda counts: paired.worst_mean(values, counts)}, walks, 1, count=20_000)[""]
    half, needed = (found.high - found.low)[0] / 2, np.sqrt(found.walks_needed[0] / walks) * abs(found.difference[0])
    # half is a multiple of the error, and as many walks are needed as lessen that multiple and 0.84 to the difference
    assert (needed - half) / paired.POWER_QUANTILE == pytest.approx(values[0].std(ddof=1) / np.sqrt(walks), rel=0.02)


def test_intervals_of_many_rows_hold_at_once():
    """Of independent rows each is as wide as the quantile of the largest of so many normal numbers asks for."""
    rng = np.random.default_rng(4)
    values = np.concatenate([rng.normal(size=(20, 1, 400)), np.zeros((1, 1, 400))])
    found = paired.intervals({"mean": lambda counts: paired.worst_mean(values, counts)}, 400, 20, count=20_000)["mean"]
    half = (found.high - found.low)[:20] / 2 / (values[:20, 0].std(axis=1, ddof=1) / 20)
    np.testing.assert_allclose(half, scipy.stats.norm.ppf((1 + 0.95 ** (1 / 20)) / 2), atol=0.06)


@pytest.mark.parametrize(("own", "base", "both"), [(4, 0, 0), (6, 0, 3), (5, 1, 0), (30, 9, 40), (0, 12, 1), (0, 0, 5)])
def test_lost_walks_are_told_apart_as_by_mcnemars_exact_test(own, base, both):
    walks = 128
    failed = np.zeros((2, walks), bool)
    failed[0, :own] = failed[1, own : own + base] = failed[:, own + base : own + base + both] = True
    found = paired.lost(failed[:, None], 1)
    exact = scipy.stats.binomtest(own, own + base).pvalue if own + base else 1.0
    assert (found.low[0] > 0 or found.high[0] < 0) == (exact < 0.05)
    assert found.low[0] < found.difference[0] < found.high[0] or own * base == 0 < own + base
    assert found.difference[0] == (own - base) / walks and found.low[0] < found.high[0]
    assert found.low[1] == found.high[1] == 0


def seeded(rng, seeds, luck, walks=400):
    """Values (G, K, M) of a law with luck in its search, pd with as much, and pd's searches walked once more."""
    own = luck * rng.normal(size=(2, seeds, 1)) + 0.3 * rng.normal(size=(2, seeds, walks))
    return np.concatenate([own, own[1:] - 0.1 + 0.01 * rng.normal(size=own[1:].shape)])


def of_seeds(values, **how):
    how = {"searches": [0, 1, 1], "count": 4000} | how
    return paired.intervals({"mean": lambda counts: paired.worst_mean(values, counts)}, values.shape[2], 1, **how)[
        "mean"
    ]


def lucky(rng, deviations, seeds):
    """Values (G, K, M) about 10 whose means over the walks scatter among the seeds by exactly these, (G,)."""
    offsets = rng.normal(size=(len(deviations), seeds))
    offsets = (offsets - offsets.mean(1, keepdims=True)) / offsets.std(1, ddof=1, keepdims=True)
    return 10 + np.array(deviations)[:, None, None] * offsets[..., None] + 1e-6 * rng.normal(size=(1, 1, 400))


def test_an_interval_is_that_of_a_search_once_more():
    """Where luck is all that there is, and one law alone has it, the interval is Student's."""
    found = of_seeds(lucky(np.random.default_rng(6), [1.0, 0.0], 8), searches=[0, 1], count=20_000)
    half = scipy.stats.t.ppf(0.975, 7) / np.sqrt(8)
    np.testing.assert_allclose([found.low[0], found.high[0]], [-half, half], rtol=0.06)


def test_an_interval_of_several_searches_holds_at_96_percent():
    """Two laws scatter alike, so that Student's variance has the freedom of both."""
    found = of_seeds(lucky(np.random.default_rng(6), [1.0, 1.0], 8), searches=[0, 1], count=20_000)
    half = scipy.stats.t.ppf(0.98, 14) * np.sqrt(2 / 8)
    np.testing.assert_allclose([found.low[0], found.high[0]] - found.difference[0], [-half, half], rtol=0.02)


def test_hardware_that_walks_with_the_same_searches_has_no_part_in_their_luck():
    values = seeded(np.random.default_rng(6), 8, 5.0)
    found = of_seeds(values)
    assert found.high[2] - found.low[2] < 0.1 * (found.high[0] - found.low[0])
    assert found.low[2] < -0.1 < found.high[2]


def test_a_search_that_scatters_little_by_chance_counts_as_the_others_do():
    found = of_seeds(lucky(np.random.default_rng(9), [0.01, 1.0, 1.0], 3), searches=[0, 1, 2])
    assert (found.high - found.low)[0] == pytest.approx((found.high - found.low)[2], rel=1e-6)
    assert found.low[0] < -1.96 * np.sqrt(2 / 3)


def test_a_law_that_scatters_in_other_metrics_scatters_in_this_one_too():
    """Three searches of an erratic law end close together in one of six metrics."""
    rng, deviations = np.random.default_rng(1), np.full((6, 5), 0.01)
    deviations[:, 1] = [1e-4, 0.1, 0.1, 0.1, 0.1, 0.1]
    values = np.stack([lucky(rng, own, 3) for own in deviations])
    statistics = {key: (lambda counts, own=own: paired.worst_mean(own, counts)) for key, own in enumerate(values)}
    found = paired.intervals(statistics, 400, 0, count=2000)
    width = np.stack([each.high - each.low for each in found.values()])
    assert width[0, 1] > 1.5 * width[0, 2]


def test_two_modes_of_luck_are_not_taken_for_a_difference():
    """All searches of two laws end alike in one metric by chance, in another mode each: the other metrics tell."""
    rng, modes = np.random.default_rng(2), np.random.default_rng(2).integers(0, 2, (6, 2, 3))
    modes[0] = [[0, 0, 0], [1, 1, 1]]
    values = 1 + 0.1 * modes[..., None] + 0.05 * rng.normal(size=(6, 2, 3, 128))
    statistics = {key: (lambda counts, own=own: paired.worst_mean(own, counts)) for key, own in enumerate(values)}
    assert paired.intervals(statistics, 128, 0, count=2000)[0].low[1] < 0


def test_walks_too_rare_to_be_seen_are_allowed_for():
    """Laws whose core makes up for a spike in one walk of a hundred: one of them has met none in 128 walks."""
    rng = np.random.default_rng(3)
    values = 1 + 0.1 * rng.normal(size=(3, 1, 128))
    values[1:] -= 0.2
    values[2, 0, 5] += 20.0
    found = paired.intervals({"": lambda counts: paired.worst_mean(values, counts)}, 128, 0, count=2000)[""]
    assert found.high[1] > 0 and found.walks_needed[1] > 128
    calm = paired.intervals({"": lambda counts: paired.worst_mean(values[:2], counts)}, 128, 0, count=2000)[""]
    assert calm.high[1] < 0


def test_a_share_of_the_worst_has_the_freedom_of_so_many_walks():
    """Ten of 200 walks make a mean of the worst: its interval is wider than the quantiles of resamples are."""
    values = np.random.default_rng(4).normal(size=(2, 1, 200))
    worst = {"": lambda counts: paired.worst_mean(values, counts, 0.05)}
    wide = paired.intervals(worst, 200, 1, shares={"": 0.05}, count=4000)[""]
    narrow = paired.intervals(worst, 200, 1, count=4000)[""]
    ratio = scipy.stats.t.ppf(0.975, 9) / scipy.stats.t.ppf(0.975, 199)
    assert (wide.high - wide.low)[0] / (narrow.high - narrow.low)[0] == pytest.approx(ratio, rel=0.06)


@pytest.mark.slow
def test_seeds_cover_what_other_seeds_give():
    """Of intervals for equal laws 19 in 20 hold 0, with three seeds and as much luck as scatter among the walks."""
    inside = [
        (found := of_seeds(seeded(np.random.default_rng((7, number)), 3, 0.03)[:2], searches=[0, 1], count=400)).low[0]
        < 0 < found.high[0]
        for number in range(200)
    ]  # fmt: skip
    assert sum(inside) >= scipy.stats.binom.ppf(0.005, 200, 0.95)


def test_seeds_that_differ_by_their_walks_alone_count_once():
    """Eight searches of two laws without luck: the error is that of 8 times 400 walks, not of these and of seeds."""
    values = np.random.default_rng(3).normal(size=(2, 8, 400))
    found = of_seeds(values, searches=[0, 1])
    half = (found.high - found.low)[0] / 2 / np.sqrt(2 / values[0].size)
    assert 1.96 < half < 2.4


def test_statistics_that_share_their_luck_cost_little():
    """Six copies of a statistic say no more than one, and make little less sure."""
    values = 10 + np.random.default_rng(3).normal(size=(5, 3, 1)) * np.ones(128)
    mean, how = lambda counts: paired.worst_mean(values, counts), {"walks": 128, "baseline": 0, "count": 2000}
    one, six = paired.intervals({0: mean}, **how)[0], paired.intervals(dict.fromkeys(range(6), mean), **how)[0]
    np.testing.assert_allclose(six.high - six.low, one.high - one.low, rtol=0.2)


def test_gains_without_luck_say_nothing_about_that_of_others():
    """pd that was not searched ends alike from all seeds."""
    values = 10 + np.random.default_rng(4).normal(size=(6, 3, 1)) + 1e-3 * np.random.default_rng(5).normal(size=128)
    values[5] = 10.0 + 1e-3 * np.random.default_rng(6).normal(size=128)
    with_pd, without = of_seeds(values, searches=range(6)), of_seeds(values[:5], searches=range(5))
    assert (with_pd.high - with_pd.low)[0] > 0.95 * (without.high - without.low)[0]


def test_where_luck_is_what_hides_a_difference_seeds_would_tell():
    values = seeded(np.random.default_rng(8), 3, 0.5)
    found = of_seeds(values)
    assert np.isinf(found.walks_needed[0]) and 3 < found.seeds_needed[0] < np.inf


def test_lost_walks_are_of_the_mean_over_the_searches():
    """A law that loses every walk after two of three searches may lose them all, and is not known to lose any."""
    failed = np.zeros((2, 3, 100), bool)
    failed[0, :2] = True
    found = paired.lost(failed, 1)
    assert found.value[0] == pytest.approx(2 / 3) and found.low[0] < 0 and found.high[0] == 1
    failed[0, 2, :90] = True
    assert paired.lost(failed, 1).low[0] > 0


def test_more_gains_make_lost_walks_harder_to_tell_apart():
    failed = np.zeros((2, 1, 100), bool)
    failed[0, :, :7] = True
    assert paired.lost(failed, 1).low[0] > 0
    assert paired.lost(failed[[0, 1, 1, 1, 1, 1, 1]], 1).low[0] < 0


def walks(members=240, **columns):
    """Walks of `NAMES`, each metric its own level with what all have in common."""
    rng, data = np.random.default_rng(5), {}
    levels = {
        "force_variation": [80, 99.8, 100, 90, 130],
        "peak_pull_force": [2, 2, 2, 1, 3],
        "travel": [2, 1, 1, 1, 1],
    }
    for name, level in (levels | columns).items():
        common = 1 + 0.3 * rng.normal(size=members)
        own = 0.05 * rng.normal(size=(len(NAMES), members))
        values = np.asarray(level, float)[:, None] * np.clip(common + own, 0.2, None)
        data[name] = (("gains", "member"), values, {"larger_is_better": int(name == "travel"), "units": "N"})
    data["peak_utilization"] = (("gains", "member"), data["peak_pull_force"][1] / 15)
    data["diverged"] = (("gains", "member"), np.zeros((len(NAMES), members), bool))
    return xr.Dataset(data, {"gains": NAMES, "member": np.arange(members)})


GOAL = Objective((Term("force_variation", 3.0, 1.0, 1.0), Term("travel", 1.0, 1.0, 1.0, True)), (), worst=Worst())
METRICS = ["force_variation", "peak_pull_force", "travel"]


def compared(data, baseline="retuned_pd", **how):
    return paired.compared(data, METRICS, baseline, GOAL, count=1000, **how)


def test_a_table_has_what_judge_says_and_which_differences_are_real():
    data = walks()
    table, summed = compared(data), judge.summary(data)
    for name in METRICS:
        np.testing.assert_allclose(table["value"].sel(metric=name), summed[name], rtol=1e-12)
    np.testing.assert_allclose(
        table["value"].sel(metric="objective", statistic="mean"), judge.scores(data, GOAL), rtol=1e-6
    )
    mean = table.sel(statistic="mean")
    assert mean["real"].sel(metric="force_variation").values.tolist() == [True, False, False, True, True]
    assert mean["real"].sel(metric="travel").values.tolist() == [True, False, False, False, False]
    assert not mean["real"].sel(metric="failed").any()
    xr.testing.assert_identical(compared(data), table)  # seeded
    assert not compared(data, seed=1).equals(table)


def test_what_is_lost_counts_and_what_diverges_is_left_out():
    data = walks()
    data["peak_utilization"][0, :20] = 16 / 15
    data["diverged"][1, :3] = True
    data["diverged"][3, :200] = True  # left out, and no reason to leave these walks out
    for name in METRICS:
        data[name][1, :3] = np.nan
    table = compared(data)
    failed = table.sel(metric="failed", statistic="mean")
    assert failed["value"].values.tolist() == pytest.approx([20 / 240, 3 / 240, 0, 200 / 240, 0])
    assert failed["real"].values.tolist() == [True, False, False, True, False]
    assert table.attrs["members_compared"] == 237
    own = table["value"].sel(metric="force_variation", statistic="mean")
    assert own.sel(gains="mine").item() == pytest.approx(data["force_variation"].sel(gains="mine")[3:].mean().item())
    assert np.isnan(own.sel(gains="half the friction"))
    np.testing.assert_allclose(judge.summary(data)["force_variation"].sel(statistic="mean"), own, rtol=1e-12)


BASE = r"pd with its own kp and kd searched \(retuned_pd\)"


def said(data, sensor="what a sensor is worth", outside=()):
    return paired.verdict(compared(data), ["mine", "other"], sensor, ["half the friction"], outside)


def test_the_sentence_says_which_law_and_what_sensor_and_hardware_are_worth():
    found = said(walks())
    size = r"\d+\.\d% \(\d+\.\d to \d+\.\d%\)"
    law, sensor, hardware = found.in_words.split("; ")
    told = re.fullmatch(f"mine is better than {BASE}, by {size} of the objective, (.*) beside (.*)", law)
    own, base = map(float, told.groups())
    by = float(re.search(r"by (\d+\.\d)%", law)[1])
    assert found.best == "mine" and 100 * (1 - own / base) == pytest.approx(by, abs=0.1)
    assert sensor == "what a sensor is worth"
    assert re.fullmatch(
        f"half the friction would better pd by {size} of its objective, less than by the best of these laws", hardware
    )
    assert said(walks(), "").in_words == f"{law}; {hardware}"


def test_a_sensor_is_worth_no_more_than_what_the_best_law_without_one_leaves():
    """Of a gain of 30 % over pd that another law has to 10 % without a sensor, the sensor is worth 20 % of pd."""
    data, pd = walks(force_variation=[70, 90, 100, 100, 100], travel=[1] * 5), 2.0
    table = compared(data.sel(gains=["mine", "other", "pd"]), baseline="other")
    values = table["value"].sel(metric="objective", statistic="mean")
    mine, other = (float(values.sel(gains=name)) for name in ("mine", "other"))
    found = paired.sensor_in_words(table, "mine", pd)
    size, low, high = map(float, re.search(r"worth (.+)% \((.+) to (.+)%\)", found).groups())
    assert size == pytest.approx(100 * (other - mine) / pd, abs=0.06) and low < size < high
    assert found.startswith("of the lead over pd a force sensor is worth ")
    assert "mine beside other, the best law that reads no forces, " in found
    level = compared(walks(force_variation=[90, 90, 100, 100, 100], travel=[1] * 5), baseline="other")
    assert paired.sensor_in_words(level, "mine", pd, what="reading joint efforts").startswith(
        "240 walks show no worth of reading joint efforts: mine beside other, the best law that reads no forces: "
    )


def test_the_sentence_says_so_where_no_law_is_better():
    level = {"travel": [1, 1, 1, 1, 1], "force_variation": [100.0, 120, 100, 70, 130]}
    found = said(walks(**level))
    assert found.best is None
    assert re.match(f"mine cannot be told apart from {BASE} in the objective with 240 walks", found.in_words)
    assert re.search(r"half the friction would better pd by 2\d\.\d% \(.* to .*%\) of its objective", found.in_words)
    nothing = said(walks(**level | {"force_variation": [100] * 5}))
    assert nothing.in_words.endswith("240 walks show no gain for pd by half the friction")
    worse = said(walks(**level | {"force_variation": [120, 130, 100, 100, 100]})).in_words
    assert re.match(
        f"none is better than {BASE}: the nearest, mine, has 1\\d\\.\\d% more objective, 1\\.\\d+ beside 0\\.9\\d+; ",
        worse,
    )


def test_what_cannot_be_told_says_how_many_walks_would():
    """As many as shrink the interval to what is left of the difference: by the root of their number."""
    data = walks(force_variation=[99.2, 130, 100, 100, 100], travel=[1, 1, 1, 1, 1])
    table = compared(data)
    own = table.sel(metric="objective", statistic="mean", gains="mine")
    half = float(own["high"] - own["low"]) / 2
    needed = float(own["walks_needed"])
    assert needed > 240 * (half / float(own["difference"])) ** 2 > 240
    assert f"({math.ceil(needed):,} walks would, if the difference is what it seems)" in said(data).in_words


def test_few_walks_say_nothing_about_the_worst_of_them():
    table = compared(walks(members=100))
    assert not table["real"].sel(statistic="worst").any()
    assert np.isnan(table["low"].sel(statistic="worst")).all()
    assert np.isfinite(table["value"].sel(statistic="worst", metric="travel")).all()
    assert table["real"].sel(metric="force_variation", statistic="mean").any() and table.attrs["lacks"] == ""


def test_what_had_not_converged_is_said():
    table = compared(walks())
    plain = paired.verdict(table, ["mine"], "", [])
    told = paired.verdict(table, ["mine"], "", [], unsettled=["mine", "retuned_pd"])
    assert told.in_words == plain.in_words + "; not every search of mine, retuned_pd had converged"


def test_one_search_that_finds_nothing_leaves_a_law_out():
    """A law diverges after one of its searches: it has no values, and the walks of the others stay."""
    data = walks().expand_dims(seed=3, axis=1).copy(deep=True)
    data["diverged"][0, 1] = True
    table = compared(data)
    assert table.attrs["members_compared"] == 240 and table.attrs["seeds"] == 3
    own = table["value"].sel(metric="force_variation", statistic="mean")
    assert np.isnan(own.sel(gains="mine")) and np.isfinite(own.sel(gains="other"))


def test_a_law_that_loses_walks_is_not_better():
    data = walks()
    data["peak_utilization"][0, :20] = 16 / 15
    assert said(data).best is None


@pytest.mark.parametrize("walked", [1, 2])
def test_a_law_that_loses_walks_after_some_searches_is_not_recommended(walked):
    """It is better in the walks that it ends, and the sentence says how many it loses."""
    data = walks().expand_dims(seed=3, axis=1).copy(deep=True)
    data["peak_utilization"][0, walked:] = 16 / 15
    found = said(data)
    lost = f"mine {(3 - walked) / 3:.1%}, other 0.0%, retuned_pd 0.0%"
    assert found.best is None and f"; lost walks: {lost}; " in found.in_words


def test_one_lost_walk_is_named_and_hinders_no_claim():
    data = walks()
    data["peak_utilization"][0, 7] = 16 / 15
    found = said(data)
    assert found.best == "mine" and "; lost walks: mine 0.4%, other 0.0%, retuned_pd 0.0%; " in found.in_words


@pytest.mark.parametrize("seeds", [1, 2])
def test_few_searches_tell_nothing(seeds):
    data = walks().expand_dims(seed=seeds, axis=1)
    table, found = compared(data), said(data)
    assert np.isnan(table["low"].sel(metric=METRICS)).all() and not table["real"].any()
    says = {1: "one search tells", 2: "2 searches tell"}[seeds]
    assert found.best is None
    assert found.in_words == f"no verdict: {says} no law from another (from 3 seeds on)"


def test_gains_that_break_the_limits_of_their_search_are_not_better():
    """No law is better than a baseline that was not found, and none is recommended that breaks its limits."""
    table = compared(walks())
    baseline = said(walks(), outside=[table.attrs["baseline"]])
    assert baseline.best is None and re.match(f"no verdict: a search of {BASE} found no gains", baseline.in_words)
    assert said(walks(), outside=["mine"]).best != "mine" and "mine" not in said(walks(), outside=["mine"]).in_words
    assert said(walks(), outside=["mine", "other"]).best is None


def test_what_a_law_is_worse_in_is_named():
    assert ", though worse in peak pull force" in said(walks(peak_pull_force=[3, 2, 2, 2, 2])).in_words


def test_a_table_comes_back_from_beside_the_walks():
    data = walks()
    table = compared(data)
    xr.testing.assert_equal(paired.taken(paired.beside(data, table)), table)


def test_gains_that_are_evaluated_say_what_a_sensor_is_worth():
    """Of those that read forces the best, beside the best of the others; with pd alone beside them nothing is told."""
    data = walks(force_variation=[70, 90, 100, 100, 100], travel=[1] * 5).sel(gains=["mine", "other", "pd"])
    read = data.assign_attrs({judge.READING: "mine, config"})
    found = of_draw.sensor_in_words(read, METRICS)
    assert (
        found.startswith("of the lead over pd a force sensor is worth ") and "mine beside other, the best law" in found
    )
    assert 15 < float(re.search(r"worth (.+?)%", found)[1]) < 25
    assert of_draw.sensor_in_words(data, METRICS) == ""
    alone = of_draw.sensor_in_words(read.sel(gains=["mine", "pd"]), METRICS)
    assert alone == "what a force sensor is worth is not told: of the gains that read no forces pd's alone walked"
