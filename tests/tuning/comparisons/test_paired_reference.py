"""Intervals of differences against a second program: loops over resamples, statistics and gains."""

import math

import numpy as np
import pytest
import scipy.stats
import xarray as xr

from tuning.comparisons import paired
from tuning.problem.ensemble import Worst
from tuning.problem.objectives import Objective, Term


def mean_of(values, weights, share=1.0, larger=False):
    """The mean over the worst share of walks (M,), each of which counts by its weight."""
    if share == 1:
        return float(np.dot(values, weights)) / len(values)
    left = worst = max(1, math.ceil(share * len(values) - 1e-9))
    total = 0.0
    for place in np.argsort(values if larger else -values):
        counts = min(weights[place], left)
        total, left = total + counts * values[place], left - counts
        if left <= 0:
            break
    return total / worst


class Row:
    """A statistic (G, K) of values (G, K, M) by the weights of walks."""

    def __init__(self, values, share=1.0, larger=False):
        self.values, self.share, self.larger = values, share, larger

    def __call__(self, weights):
        return [[mean_of(own, weights, self.share, self.larger) for own in gains] for gains in self.values]


def every(rows, weights):
    return np.array([row(weights) for row in rows])


def variance_of_mean(values):
    return 0.0 if len(values) < 2 else sum((v - np.mean(values)) ** 2 for v in values) / (len(values) - 1) / len(values)


class Luck:
    """The luck of searches: who has some, and how far it scatters."""

    def __init__(self, each, base, searches):
        self.places = range(each.shape[1])
        self.base, self.freedom = base, max(each.shape[2] - 1, 1)
        self.hangs = [searches[g] == searches[base] for g in self.places]  # on the baseline's searches
        searched = [g == base or not self.hangs[g] for g in self.places]
        self.level = each.mean(-1)
        self.lucky = np.array(
            [[searched[g] and np.ptp(row[g]) > 0 and variance_of_mean(row[g]) > 1e-24 * np.mean(row[g]) ** 2
              for g in self.places] for row in each]
        )  # fmt: skip
        self.gains = int(self.lucky.any(0).sum())
        residuals = [
            np.concatenate([(own - own.mean()) / math.sqrt(variance_of_mean(own)) if lucky else 0 * own
                            for own, lucky in zip(row, luckies, strict=True)])
            for row, luckies in zip(each, self.lucky, strict=True)
        ]  # fmt: skip
        self.residuals = np.array([row / (np.linalg.norm(row) or 1.0) for row in residuals])
        self.independent = self._independent()

    def _independent(self):
        freedom, rows = self.freedom * self.gains, np.flatnonzero(self.lucky.any(1))
        if not rows.size:
            return 1.0
        together = 0.0
        for one in range(len(self.residuals)):
            for other in range(len(self.residuals)):
                square = float(self.residuals[one] @ self.residuals[other]) ** 2
                if one != other:
                    together += min(max((square * freedom - 1) / max(freedom - 1, 1), 0.0), 1.0)
        return rows.size**2 / (rows.size + together)

    def pooled(self, variances):
        """Variances (P, G), their freedom, and which are that of all."""
        relative = np.where(self.lucky, variances / np.where(self.lucky, self.level**2, 1), 0)
        mean = [np.mean(row[own]) if own.any() else 0.0 for row, own in zip(relative, self.lucky, strict=True)]
        scale = [
            np.mean([relative[p, g] / (mean[p] or 1) for p in np.flatnonzero(self.lucky[:, g])])
            if self.lucky[:, g].any() else 0.0 for g in self.places
        ]  # fmt: skip
        others, of_scale = max(self.gains - 1, 1), self.freedom * self.independent
        alike_gains = []
        for g in self.places:
            rest = (sum(scale) - scale[g]) / others
            chance = scipy.stats.f.sf(scale[g] / rest, of_scale, of_scale * others) if rest > 0 else 1.0
            alike_gains.append(chance >= 0.1)
        lent = self.lucky & alike_gains
        alike = np.array([np.mean(row[own]) if own.any() else 0.0 for row, own in zip(relative, lent, strict=True)])
        if self.lucky.any():
            alike = np.maximum(alike, np.median(alike[self.lucky.any(1)]))
        value, freedom = np.array(variances, float), np.full(variances.shape, float(self.freedom))
        for p, g in zip(*np.nonzero(self.lucky), strict=True):
            own = max(relative[p, g], scale[g] * mean[p], alike[p])
            value[p, g] = (alike[p] if lent[p, g] else own) * self.level[p, g] ** 2
            if lent[p, g]:
                freedom[p, g] *= lent[p].sum()
        return value, freedom, lent

    def apart(self, values):
        """Values (P, G, K) of which those on the baseline's searches are less the baseline's."""
        mine = [self.hangs[g] and g != self.base for g in self.places]
        found = values.copy()
        found[:, mine] -= values[:, [self.base]]
        return found

    def difference(self, apart):
        found = apart.mean(-1)
        found = np.array([[v if self.hangs[g] else v - row[self.base] for g, v in enumerate(row)] for row in found])
        found[:, self.base] = 0
        return found

    def of_difference(self, variances):
        found = [[v + (0 if self.hangs[g] else row[self.base]) for g, v in enumerate(row)] for row in variances]
        found = np.array(found)
        found[:, self.base] = 0
        return found

    def squares_over_freedom(self, value, freedom, lent):
        found = self.of_difference(value**2 / freedom)
        for p, g in np.ndindex(value.shape):
            if lent[p, g] and lent[p, self.base] and not self.hangs[g]:  # one variance, counted once
                found[p, g] = (value[p, g] + value[p, self.base]) ** 2 / freedom[p, g]
        return found


def multiple(deviations, variances, freedom, there, level):
    """The multiples (P, G) of standard errors that hold a share of the deviations of all rows at once."""
    least = []
    for deviation, variance in zip(deviations, variances, strict=True):
        chances = [1.0]
        for place in zip(*np.nonzero(there), strict=True):
            size = abs(deviation[place]) / math.sqrt(variance[place] if variance[place] > 0 else 1.0)
            chances.append(2 * scipy.stats.t.sf(size, freedom[place]))
        least.append(min(chances))
    least.sort()
    # the first of n is the (n + 1)th part
    at = min(max((1 - level) * (len(least) + 1) - 1, 0.0), len(least) - 1.0)
    low = math.floor(at)
    chance = least[low] + (at - low) * (least[min(low + 1, len(least) - 1)] - least[low])
    return np.array([[scipy.stats.t.isf(chance / 2, own) for own in row] for row in freedom])


def reference(rows, walks, base, searches, count, seed):
    """The fields of `paired.Interval`, (P, G) each, in the order of the rows."""
    each = every(rows, np.ones(walks, int))
    luck, seeds = Luck(each, base, searches), each.shape[-1]
    draws = np.random.default_rng(seed).multinomial(walks, np.full(walks, 1 / walks), size=count)
    moved = np.array([luck.apart(every(rows, drawn) - each) for drawn in draws])
    known = walks / (walks - 1)
    by_walks = np.array([luck.difference(one) for one in moved]).var(axis=0) * known
    mean_variance = np.vectorize(variance_of_mean, signature="(k)->()")
    among = mean_variance(moved).mean(axis=0) * known
    value, freedom, lent = luck.pooled(mean_variance(luck.apart(each)))
    own = np.maximum(value - among, 0)
    by_luck = luck.of_difference(own)
    of_walks = np.array([[max(walks * row.share, 2) - 1.0] for row in rows])
    parts = by_walks**2 / of_walks + luck.squares_over_freedom(value, freedom, lent)
    of_both = np.divide((by_walks + by_luck) ** 2, parts, out=np.full(parts.shape, np.inf), where=parts > 0)
    level = np.abs(each.mean(-1)).max(1, keepdims=True)
    there = by_walks + by_luck > (1e-12 * level) ** 2
    rng = np.random.default_rng((seed, 1))
    walked = by_walks * rng.chisquare(of_walks, (count, *by_walks.shape)) / of_walks
    of_walks_alone = np.where(there, np.broadcast_to(of_walks, there.shape), np.inf)
    alone = multiple([luck.difference(one) for one in moved], walked, of_walks_alone, there, 0.95)
    common = rng.normal(size=(count, luck.residuals.shape[1], *each.shape[1:]))
    single = rng.normal(size=moved.shape)
    alone_part = 1 / (1 + luck.freedom * luck.gains)
    theirs = np.empty(walked.shape)
    for r in range(count):
        for p in range(len(rows)):
            shared = 1 - alone_part if luck.lucky[p].any() else 0.0
            together = sum(
                residual * each_draw for residual, each_draw in zip(luck.residuals[p], common[r], strict=True)
            )
            normal = math.sqrt(shared) * together + math.sqrt(1 - shared) * single[r, p]
            moved[r, p] += np.sqrt(own[p] * seeds)[:, None] * normal
        theirs[r] = walked[r] + luck.of_difference(np.maximum(luck.pooled(mean_variance(moved[r]))[0] - among, 0))
    at = 0.96 if luck.gains > 1 else 0.95
    most = multiple([luck.difference(one) for one in moved], theirs, of_both, there, at)
    means = each.mean(-1)
    difference = means - means[:, [base]]
    half = np.maximum(most * np.sqrt(by_walks + by_luck), alone * np.sqrt(by_walks))
    unseen = unseen_of(rows, walks, base, difference)
    half = np.where(there, np.maximum(half, unseen[:, None]), half)
    needs = [np.full(half.shape, np.inf), np.full(half.shape, np.inf)]
    for p, g in np.ndindex(half.shape):
        allowed = (difference[p, g] / (most[p, g] + 0.8416)) ** 2
        for needed, size, part, rest in zip(
            needs, (walks, seeds), (by_walks[p, g], by_luck[p, g]), (by_luck[p, g], by_walks[p, g]), strict=True
        ):
            if allowed > rest:
                needed[p, g] = size * part / (allowed - rest)
        if g != base and difference[p, g]:
            needs[0][p, g] = max(needs[0][p, g], walks * unseen[p] / abs(difference[p, g]))
    return means, difference, difference - half, difference + half, *needs


def unseen_of(rows, walks, base, difference):
    """How far one walk, or any of them, moves a row whose part is that of walks that are seen in 95 draws of 100."""
    part, found = 1 - 0.05 ** (1 / walks), []
    for row, own in zip(rows, difference, strict=True):
        farthest = 0.0
        for walk in range(walks):
            weights = np.full(walks, 1 - part)
            weights[walk] += walks * part
            means = np.mean(row(weights), axis=1)
            farthest = max(farthest, *np.abs(means - means[base] - own))
        found.append(farthest)
    return np.array(found)


def scattered(seed, gains, seeds, walks, luck, noise=0.3):
    """Values (G, K, M) with walks in common, and searches whose luck scatters by `luck` (G,)."""
    rng = np.random.default_rng(seed)
    own = np.array(luck)[:, None, None] * rng.normal(size=(gains, seeds, 1))
    walked = noise * (rng.normal(size=walks) + 0.5 * rng.normal(size=(gains, seeds, walks)))
    return 10 + 0.1 * np.arange(gains)[:, None, None] + own + walked


WALKS, COUNT = 24, 40
CASES = {
    "one search each": ([scattered(1, 4, 1, WALKS, [0, 0, 0, 0]), scattered(2, 4, 1, WALKS, [0, 0, 0, 0])], 2, None),
    "searches with luck": ([scattered(n, 4, 3, WALKS, [0.5, 0.4, 0.6, 0.5]) for n in (3, 4, 5)], 1, None),
    "an erratic law": ([scattered(n, 4, 3, WALKS, [0.2, 0.3, 40.0, 0.2]) for n in (6, 7)], 0, None),
    "an erratic baseline": ([scattered(n, 4, 4, WALKS, [40.0, 0.3, 0.3, 0.2]) for n in (6, 7)], 0, None),
    "hardware on the searches of the baseline": (
        [scattered(n, 4, 3, WALKS, [0.5, 0.5, 0.5, 0.5]) for n in (8, 9)], 1, [0, 1, 1, 3],
    ),
    "one law alone has luck": ([scattered(n, 3, 3, WALKS, [0.5, 0, 0]) for n in (10, 11)], 1, [0, 1, 1]),
    "luck that all statistics share": ([scattered(12, 3, 3, WALKS, [0.5, 0.5, 0.5], noise=0.02)] * 3, 0, None),
    "luck within that of the walks": ([scattered(n, 3, 3, WALKS, [0.01, 0.01, 0.01]) for n in (13, 14)], 0, None),
}  # fmt: skip


def made(name):
    values, base, searches = CASES[name]
    if name == "one law alone has luck":  # a grid ends alike from all seeds
        values = [np.where(np.arange(3)[:, None, None] > 0, own[:, :1], own) for own in values]
    if name == "luck that all statistics share":
        values = [values[0], 2 * values[1], values[2] ** 2]
    if name == "one search each":  # gains of which one is the baseline again
        values = [np.concatenate([own[:3], own[2:3]]) for own in values]
    hows = [(1.0, False), (0.25, False), (0.25, True)]
    return [Row(own, *how) for own, how in zip(values, hows, strict=False)], base, searches


@pytest.mark.parametrize("name", CASES)
def test_intervals_are_those_of_a_second_program(name):
    rows, base, searches = made(name)
    statistics = {
        key: lambda counts, own=own: paired.worst_mean(own.values, counts, own.share, larger_is_better=own.larger)
        for key, own in enumerate(rows)
    }
    shares = {key: row.share for key, row in enumerate(rows) if row.share < 1}
    how = {"searches": searches, "shares": shares, "count": COUNT, "seed": 5}
    found = paired.intervals(statistics, WALKS, base, **how)
    whole = reference(rows, WALKS, base, range(len(rows[0].values)) if searches is None else searches, COUNT, 5)
    others = np.arange(len(rows[0].values)) != base
    for place, field in enumerate(paired.Interval._fields):
        own = np.array([getattr(found[key], field) for key in found])
        np.testing.assert_allclose(own[:, others], whole[place][:, others], rtol=1e-7, atol=1e-12, err_msg=field)
    assert all((each.low[base], each.high[base], each.difference[base]) == (0, 0, 0) for each in found.values())


def test_luck_is_pooled_as_by_a_second_program():
    """Of statistics that share their luck more or less, and gains that scatter alike or by more than the others."""
    lent = []
    for number in range(60):
        rng = np.random.default_rng(number)
        common = rng.normal(size=(1, 4, 3)) * rng.uniform(0, 1.5)
        each = 10 + rng.choice([0.3, 1.0, 3.0], (1, 4, 1)) * (common + rng.normal(size=(3, 4, 3)))
        each[number % 3, 3], each[:, 1] = 10.0, each[:, 1] + 10
        found = paired._Luck.of(each, 0, np.array([True, False, False, number % 2 == 0]))
        wanted = Luck(each, 0, [0, 1, 2, 0 if number % 2 == 0 else 3])
        assert found.independent == pytest.approx(wanted.independent, rel=1e-9)
        variances = 0.3 * rng.uniform(0.1, 3, each.shape[:2])
        own, theirs = found.pooled(variances), wanted.pooled(variances)
        for one, other in zip(own, theirs, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9)
        np.testing.assert_allclose(found.of_sums(own), wanted.squares_over_freedom(*theirs), rtol=1e-9)
        np.testing.assert_allclose(found.of_differences(variances), wanted.of_difference(variances), rtol=1e-9)
        lent.append(own.lent)
    assert 0.2 < np.mean(lent) < 0.8


def lost_reference(failed, base):
    """Shares (G,), differences and ends of their intervals: the exact ones of the walks, no less than the seeds'."""
    gains, seeds, walks = failed.shape
    tail, found = 0.025 / max(gains - 1, 1), []
    for own in failed:
        alone = sum((one & ~other).sum() for one, other in zip(own, failed[base], strict=True)) / seeds
        theirs = sum((other & ~one).sum() for one, other in zip(own, failed[base], strict=True)) / seeds
        share, of_base = own.mean(), failed[base].mean()
        if own is failed[base] or np.shares_memory(own, failed[base]):
            found.append((share, 0.0, 0.0, 0.0))
            continue
        if alone + theirs == 0:  # of all walks, at most so many lie where none was met
            low, high = -(1 - tail ** (1 / walks)), 1 - tail ** (1 / walks)
        else:
            least = scipy.stats.beta.ppf(tail, alone, theirs + 1) if alone else 0.0
            most = scipy.stats.beta.ppf(1 - tail, alone + 1, theirs) if theirs else 1.0
            low, high = ((2 * end - 1) * (alone + theirs) / walks for end in (least, most))
        if seeds > 1:
            each = own.mean(1) - failed[base].mean(1)
            half = scipy.stats.t.ppf(1 - tail, seeds - 1) * scipy.stats.sem(each)
            low, high = min(low, each.mean() - half), max(high, each.mean() + half)
        found.append((share, share - of_base, max(low, -1.0), min(high, 1.0)))
    return np.array(found).T


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("base", [0, 2])
def test_lost_walks_are_those_of_a_second_program(seeds, base):
    for number in range(6):
        rng = np.random.default_rng(number)
        chances = rng.choice([0.0, 0.02, 0.3, 0.97], (5, seeds, 1))
        failed = rng.uniform(size=(5, seeds, 40)) < chances
        failed[4] = failed[base]  # hardware that loses the very same walks
        found = paired.lost(failed, base)
        np.testing.assert_allclose(found[:4], lost_reference(failed, base), rtol=1e-9, atol=1e-12)
        assert np.isnan(found.walks_needed).all() and np.isnan(found.seeds_needed).all()


class Goal(Row):
    """The objective by hand: each metric relative to pd's over the walks and seeds as they are, means and worst."""

    def __init__(self, terms, pd, worst, share):
        self.terms, self.pd, self.worst, self.share = terms, pd, worst, share

    def __call__(self, weights):
        total, even = 0.0, np.ones(len(weights))
        for values, weight, larger in self.terms:
            mean = np.array(Row(values)(weights)) / mean_of(values[self.pd, 0], even)
            bad = np.array(Row(values, self.share, larger)(weights))
            bad = bad / mean_of(values[self.pd, 0], even, self.share, larger)
            both = [2 - ratio if larger else ratio for ratio in (mean, bad)]
            total = total + weight * ((1 - self.worst) * both[0] + self.worst * both[1])
        return total / sum(weight for _, weight, _ in self.terms)


def test_a_table_has_the_intervals_of_a_second_program():
    """Means and the objective at once, worst walks at once; members in which anything diverges are left out."""
    members, names = 203, ["mine", "retuned_pd", "half", "pd", "wild"]
    force = scattered(20, 5, 3, members, [0.3, 0.4, 0.3, 0.0, 0.3])
    travel = scattered(21, 5, 3, members, [0.1, 0.2, 0.1, 0.0, 0.1]) / 5
    used, diverged = np.full(force.shape, 0.2), np.zeros(force.shape, bool)
    used[0, 1, :6], used[2, :, 20:80], used[3, :, 7] = 1.2, 1.3, 1.4
    diverged[1, 2, [4, 9]], diverged[2, 0, 11], diverged[4, 1, :110] = True, True, True
    dims = ("gains", "seed", "member")
    columns = {"force_variation": force, "travel": travel, "peak_utilization": used, "diverged": diverged}
    about = {"travel": {"larger_is_better": 1}}
    data = {name: (dims, each, about.get(name, {"larger_is_better": 0})) for name, each in columns.items()}
    goal = Objective(
        (Term("force_variation", 3.0, 1.0, 1.0), Term("travel", 1.0, 1.0, 1.0, True)),
        (),
        worst=Worst(share=0.4, weight=0.7),
    )
    how = {"shared": ["half"], "count": 16, "seed": 2}
    table = paired.compared(
        xr.Dataset(data, {"gains": names}), ["travel", "force_variation"], "retuned_pd", goal, **how
    )
    kept = np.delete(np.arange(members), [4, 9, 11])
    force, travel = force[:4][..., kept], travel[:4][..., kept]
    terms = [(force, 3.0, False), (travel, 1.0, True)]
    families = {
        "mean": [Goal(terms, 3, goal.worst.weight, goal.worst.share), Row(travel), Row(force)],
        "worst": [Row(travel, 0.05, larger=True), Row(force, 0.05)],
    }
    for statistic, rows in families.items():
        own = table.sel(statistic=statistic, metric=["objective", "travel", "force_variation"][-len(rows) :])
        wanted = reference(rows, 200, 1, [0, 1, 1, 3], 16, 2)
        for field, whole in zip(paired.Interval._fields, wanted, strict=True):
            others = [0, 2, 3]
            found = own[field].isel(gains=others).transpose("metric", "gains").values
            np.testing.assert_allclose(found, whole[:, others], rtol=1e-7, atol=1e-12, err_msg=field)
        low, high = (own[field].isel(gains=slice(4)).values for field in ("low", "high"))
        np.testing.assert_array_equal(own["real"].isel(gains=slice(4)), (low > 0) | (high < 0))
    failed = (used > 1) | diverged
    lost = table.sel(metric="failed", statistic="mean")
    np.testing.assert_allclose(
        [lost[field] for field in paired.Interval._fields[:4]], lost_reference(failed, 1), rtol=1e-9, atol=1e-12
    )
    assert lost["real"].values.tolist() == [False, False, True, False, False]
    assert np.isnan(table["value"].sel(metric="objective", statistic="worst")).all()
    assert np.isnan(table["value"].sel(gains="wild", metric=["objective", "travel"])).all()
    assert table["larger_is_better"].values.tolist() == [False, True, False, False]
    said = {"baseline": "retuned_pd", "members": 203, "members_compared": 200, "seeds": 3, "resamples": 16}
    assert table.attrs == said | {"lacks": "", "level": 0.95, "worst_share": 0.05}
