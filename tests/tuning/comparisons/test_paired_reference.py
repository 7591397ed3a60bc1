"""Intervals of differences against a second program: loops over resamples, statistics and gains, from the docstrings."""

import math

import numpy as np
import pytest
import scipy.stats

from tuning.comparisons import paired


def mean_of(values, drawn, share, larger):
    """The mean over the worst share of walks (M,), each as often as it was drawn."""
    again = sorted(np.repeat(values, drawn), reverse=not larger)
    return float(np.mean(again[: max(1, math.ceil(share * len(values) - 1e-9))]))


def every(rows, drawn):
    """The statistics (P, G, K), whose rows are (values (G, K, M), share, larger)."""
    found = [[[mean_of(own, drawn, *how) for own in gains] for gains in values] for values, *how in rows]
    return np.array(found)


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
    at = (1 - level) * (len(least) + 1) - 1  # the first of n is the (n + 1)th part
    low = min(max(math.floor(at), 0), len(least) - 1)
    chance = least[low] + (min(at, len(least) - 1) - low) * (least[min(low + 1, len(least) - 1)] - least[low])
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
    of_walks = np.array([[max(walks * share, 2) - 1.0] for _, share, _ in rows])
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
            together = sum(residual * each_draw for residual, each_draw in zip(luck.residuals[p], common[r], strict=True))
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
    for (values, share, larger), row in zip(rows, difference, strict=True):
        farthest = 0.0
        for walk in range(walks):
            weights = np.full(walks, 1 - part)
            weights[walk] += walks * part
            means = np.mean([[weighted(own, weights, share, larger) for own in gains] for gains in values], axis=1)
            farthest = max(farthest, *np.abs(means - means[base] - row))
        found.append(farthest)
    return np.array(found)


def weighted(values, weights, share, larger):
    """The mean over the worst share of walks, each of which counts by its weight."""
    left = worst = len(values) if share == 1 else max(1, math.ceil(share * len(values) - 1e-9))
    total = 0.0
    for place in np.argsort(values if larger else -values):
        counts = min(weights[place], left)
        total, left = total + counts * values[place], left - counts
    return total / worst


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
    "luck hardly beyond that of the walks": ([scattered(n, 3, 3, WALKS, [0.01, 0.01, 0.01]) for n in (13, 14)], 0, None),
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
    return [(own, *how) for own, how in zip(values, hows, strict=False)], base, searches


@pytest.mark.parametrize("name", CASES)
def test_intervals_are_those_of_a_second_program(name):
    rows, base, searches = made(name)
    statistics = {
        key: lambda counts, own=own: paired.worst_mean(own[0], counts, own[1], larger_is_better=own[2])
        for key, own in enumerate(rows)
    }
    shares = {key: share for key, (_, share, _) in enumerate(rows) if share < 1}
    how = {"searches": searches, "shares": shares, "count": COUNT, "seed": 5}
    found = paired.intervals(statistics, WALKS, base, **how)
    whole = reference(rows, WALKS, base, range(len(rows[0][0])) if searches is None else searches, COUNT, 5)
    others = np.arange(len(rows[0][0])) != base
    for place, field in enumerate(paired.Interval._fields):
        own = np.array([getattr(found[key], field) for key in found])
        np.testing.assert_allclose(own[:, others], whole[place][:, others], rtol=1e-7, atol=1e-12, err_msg=field)
    assert all((each.low[base], each.high[base], each.difference[base]) == (0, 0, 0) for each in found.values())


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
