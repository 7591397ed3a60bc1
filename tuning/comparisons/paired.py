"""Which differences between gains on the same walks are real: intervals that hold for all of them at once."""

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts are imported when they are first used
import xarray as xr

from mjx_climb.files import dataset
from tuning.comparisons import judge as judging
from tuning.comparisons import verdicts
from tuning.numbers import number
from tuning.problem.ensemble import Worst
from tuning.problem.objectives import Objective, Term

RESAMPLES = 4000
LEVEL = 0.95
# of several searches: one that scatters by more than the others may pass for one that does not, and the bootstrap takes
# the variances that follow for true ones, which costs up to 1 % (`tests/tuning/comparisons/test_verdicts.py`)
_LEVEL_OF_SEVERAL = 0.96
PREFIX = "compared_"  # of the variables of a table beside walks
STATISTICS = ("mean", "worst")
DIMS = ("gains", "seed", "member")  # of walks
FEWEST_WALKS = 64  # that tell how far a mean of them scatters
FEWEST_WORST = 10  # walks among the worst, likewise
FEWEST_SEEDS = 3  # searches that tell how far they scatter
LOST_MOST = 0.05  # share of walks by which a better law may lose more than the baseline, at the end of its interval
POWER_QUANTILE = 0.8416  # of the normal distribution at 80 %
_MARGIN = 16  # walks beyond twice the worst: hardly a resample draws too few of these
_UNLIKE = 0.1  # chance, below which the luck of gains is seen to be larger than that of the others
_ROUNDING = 1e-12  # of a value: closer ones are equal
AT_ONCE = 4_000_000  # numbers of walks, of some resamples

# statistics (R, G, K) of G gains from K seeds, by how often each of M walks was drawn in R resamples (R, M)
Statistic = Callable[[np.ndarray], np.ndarray]


def worst_mean(
    values: np.ndarray, counts: np.ndarray, share: float = 1.0, *, larger_is_better: bool = False
) -> np.ndarray:
    """Return the mean over the worst share of walks in each resample, of all of them where the share is 1: (R, ...).

    Arguments:
        values: (..., M) of each walk.
        counts: (R, M) how often it was drawn.
        share: of the walks, as of `tuning.problem.ensemble.worst_mean`.
        larger_is_better: whether the least values are the worst.
    """
    flat = values.reshape(-1, values.shape[-1])
    shape = (len(counts), *values.shape[:-1])
    if share == 1:
        return np.asarray(counts @ flat.T / flat.shape[1]).reshape(shape)
    worst = max(1, math.ceil(share * flat.shape[1] - 1e-9))
    found = np.empty((len(counts), len(flat)))
    for column, own in enumerate(flat):
        order = np.argsort(own if larger_is_better else -own)
        # those drawn lie among the first few, unless a resample drew hardly any of these
        first = order[: 2 * worst + _MARGIN]
        reached = counts[:, first].sum(axis=1) >= worst
        for rows, those in ((reached, first), (~reached, order)):
            drawn = counts[np.ix_(rows, those)]
            kept = np.clip(worst - (np.cumsum(drawn, axis=1) - drawn), 0, drawn)
            found[rows, column] = kept @ own[those] / worst
    return found.reshape(shape)


def resamples(walks: int, count: int = RESAMPLES, seed: int = 0) -> Iterator[np.ndarray]:
    """Yield how often each of some walks is drawn where as many are drawn with replacement: (R, walks) at a time."""
    rng, even = np.random.default_rng(seed), np.full(walks, 1 / walks)
    most = max(1, AT_ONCE // walks)
    for begin in range(0, count, most):
        # as floats, which BLAS adds up
        yield rng.multinomial(walks, even, size=min(most, count - begin)).astype(float)


class Interval(NamedTuple):
    """A statistic of each gains, how far it is from that of a baseline, and the ends of that difference: (G,) each."""

    value: np.ndarray
    difference: np.ndarray
    low: np.ndarray
    high: np.ndarray
    # with so many the interval would leave 0 out in 80 % of draws, if the difference is as found; infinite where no
    # number of walks, or of seeds, would alone
    walks_needed: np.ndarray
    seeds_needed: np.ndarray


def intervals(
    statistics: Mapping[Any, Statistic], walks: int, baseline: int, *,
    searches: Sequence[int] | None = None, shares: Mapping[Any, float] = MappingProxyType({}),
    count: int = RESAMPLES, seed: int = 0,
) -> dict[Any, Interval]:  # fmt: skip
    """Return the intervals of some statistics, which hold for all of them and all gains at once.

    Each is of gains that are searched once more, on new walks. The same walks are drawn for all gains and all their
    seeds. The luck of a search is drawn apart from them, from the normal distribution with the variance among seeds,
    and so are the variances that as many seeds and walks would show, judged as the given ones are (`_Luck`; the
    parametric bootstrap of Krishnamoorthy, Lu and Mathew, "A parametric bootstrap approach for ANOVA with unequal
    variances", 2007). Deviations, in standard errors, become probabilities by Student's distribution (degrees of
    freedom by Welch and Satterthwaite); the least probability among all rows has a quantile, which all intervals have
    in common ("max-t"; Romano and Wolf, "Exact and approximate stepdown methods for multiple hypothesis testing", 2005,
    section 4). No interval is narrower than the change that walks too rare to be seen could make (`_unseen`).

    Arguments:
        statistics: by any key, of G gains and K seeds.
        walks: how many there are.
        baseline: the place of the gains that all are compared with.
        searches: the place of the gains whose searches each has the results of, (G,); its own where None.
        shares: of the walks, those that a statistic is of; all where it has none.
        count: how many resamples.
        seed: of the draws.
    """
    if not statistics:
        return {}

    def every(counts: np.ndarray) -> np.ndarray:
        return np.stack([statistic(counts) for statistic in statistics.values()], axis=1)  # (R, P, G, K)

    def differences(counts: np.ndarray) -> np.ndarray:
        values = every(counts).mean(-1)
        return np.asarray(values - values[..., [baseline]])

    each = every(np.ones((1, walks)))[0]
    value, difference = each.mean(-1), differences(np.ones((1, walks)))[0]
    shared = np.arange(each.shape[1]) == baseline if searches is None else np.equal(searches, searches[baseline])
    luck = _Luck.of(each, baseline, shared)
    moved = luck.apart(np.concatenate([every(counts) for counts in resamples(walks, count, seed)]) - each)
    # as many walks are drawn as there are, and one is known by the others
    again = walks / max(walks - 1, 1)
    by_walks, among = luck.differences(moved).var(axis=0) * again, _of_mean(moved).mean(axis=0) * again
    variances = luck.pooled(_of_mean(luck.apart(each)))
    own = np.maximum(variances.value - among, 0.0)  # seeds scatter by their walks too
    by_luck = luck.of_differences(own)
    of_walks = np.array([[max(walks * shares.get(key, 1.0), 2) - 1] for key in statistics])
    parts = by_walks**2 / of_walks + luck.of_sums(variances)
    freedom = np.where(parts > 0, (by_walks + by_luck) ** 2 / np.where(parts > 0, parts, 1.0), np.inf)
    there = by_walks + by_luck > (_ROUNDING * np.abs(value).max(axis=1, keepdims=True)) ** 2
    rng = np.random.default_rng((seed, 1))
    walked = by_walks * rng.chisquare(of_walks, (len(moved), *by_walks.shape)) / of_walks
    alone = _multiple(luck.differences(moved), walked, np.where(there, of_walks, np.inf), there, LEVEL)
    moved += np.sqrt(own * each.shape[-1])[..., None] * luck.drawn(rng, moved.shape)
    theirs = walked + luck.of_differences(np.maximum(luck.pooled(_of_mean(moved)).value - among, 0.0))
    level = _LEVEL_OF_SEVERAL if luck.lends.any(0).sum() > 1 else LEVEL
    multiple = _multiple(luck.differences(moved), theirs, freedom, there, level)
    unseen = _unseen(differences, difference, walks)
    # where no luck is seen there may be some, so that intervals are no narrower than those of the walks alone
    half = np.maximum(multiple * np.sqrt(by_walks + by_luck), alone * np.sqrt(by_walks))
    half = np.maximum(half, np.where(there, unseen, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        allowed = (difference / (multiple + POWER_QUANTILE)) ** 2
        more_walks, more_seeds = (
            np.where(allowed > rest, size * part / (allowed - rest), np.inf)
            for size, part, rest in ((walks, by_walks, by_luck), (each.shape[-1], by_luck, by_walks))
        )
        # a rarer walk can stay unseen among more of them
        more_walks = np.maximum(more_walks, walks * unseen / np.abs(difference))
    rows = (value, difference, difference - half, difference + half, more_walks, more_seeds)
    return {key: Interval(*(row[place] for row in rows)) for place, key in enumerate(statistics)}


def _multiple(
    deviations: np.ndarray, variances: np.ndarray, freedom: np.ndarray, there: np.ndarray, level: float
) -> np.ndarray:
    """Return the multiples (P, G) of standard errors that hold all deviations (R, P, G) at once at a level.

    Arguments:
        deviations: that other draws would show.
        variances: that these would show, (R, P, G).
        freedom: of each row, (P, G).
        there: which rows deviate.
    """
    size = deviations / np.sqrt(np.where(there & (variances > 0), variances, 1.0))
    # the same for both signs
    chance = 2 * scipy.special.stdtr(freedom, -np.abs(size))
    least = np.quantile(chance[:, there].min(axis=1, initial=1.0), 1 - level, method="weibull")
    return np.asarray(-scipy.special.stdtrit(freedom, least / 2))


def _unseen(differences: Statistic, difference: np.ndarray, walks: int) -> np.ndarray:
    """Return how far walks that are too rare to be seen among so many could move each statistic, (P, 1).

    As often as none of them is seen with a probability of 1 - `LEVEL`, all are taken for the one walk, of those that
    were seen, and for the gains, of those that walked, that move the difference the furthest.
    """
    share = 1 - (1 - LEVEL) ** (1 / walks)
    moved = differences((1 - share) + walks * share * np.eye(walks)) - difference
    return np.asarray(np.abs(moved).max(axis=(0, 2))[:, None])


class _Variances(NamedTuple):
    """Variances (..., P, G) of means over the seeds, estimated for all gains together."""

    value: np.ndarray
    freedom: np.ndarray  # (..., P, G)
    lent: np.ndarray  # (..., P, G) bool: one variance of all these gains, relative to their values


class _Luck(NamedTuple):
    """How far P statistics of G gains scatter, averaged over K seeds, by the luck of their searches.

    Gains scatter alike, relative to their values, unless they are seen not to: then one variance of all, with the
    freedom of all, is known far better than that of each (the pooling of Smyth, "Linear models and empirical Bayes
    methods for assessing differential expression in microarray experiments", 2004, by a test in place of a prior).
    Gains that scatter by far more, over all statistics together, keep a variance of their own. As statistics share
    their luck, they count for that test as so many independent ones as their correlations leave.
    """

    shared: np.ndarray  # (G,) bool, those that have the results of the baseline's searches
    baseline: int
    square: np.ndarray  # (P, G) of the values
    lends: np.ndarray  # (P, G) bool: searched for itself, and its searches differ; a grid has no luck
    freedom: float  # of the variance of one of the gains
    residuals: np.ndarray  # (P, G K) of the seeds, of length 1: their products are the correlations of statistics

    @classmethod
    def of(cls, each: np.ndarray, baseline: int, shared: np.ndarray) -> "_Luck":
        """Return the luck that the values (P, G, K) of each seed show."""
        square, own = each.mean(-1) ** 2, ~shared | (np.arange(each.shape[1]) == baseline)
        variances = _of_mean(each)
        lends = own & (variances > _ROUNDING**2 * square)
        there = np.where(lends, variances, 1.0)
        residuals = np.where(lends[..., None], (each - each.mean(-1, keepdims=True)) / np.sqrt(there)[..., None], 0.0)
        residuals = residuals.reshape(len(each), -1)
        length = np.linalg.norm(residuals, axis=1, keepdims=True)
        freedom = max(each.shape[-1] - 1.0, 1.0)
        return cls(shared, baseline, square, lends, freedom, residuals / np.where(length > 0, length, 1.0))

    @property
    def independent(self) -> float:
        """As how many independent statistics all of them count, by their correlations less those of chance."""
        freedom = self.freedom * self.lends.any(0).sum()
        squares = (self.residuals @ self.residuals.T) ** 2
        chance = np.clip((squares * freedom - 1) / max(freedom - 1, 1.0), 0.0, 1.0)
        count = self.lends.any(1).sum()
        others = chance.sum() - np.trace(chance)
        return float(count**2 / (count + others)) if count else 1.0

    def pooled(self, variances: np.ndarray) -> _Variances:
        """Return variances (..., P, G) estimated for all gains together; gains that scatter by more keep their own."""
        relative = np.where(self.lends, variances / np.where(self.lends, self.square, 1.0), 0.0)
        mean = _mean(relative, self.lends, -1)
        scale = _mean(relative / np.where(mean > 0, mean, 1.0), self.lends, -2)  # (..., 1, G)
        gains, of_scale = self.lends.any(0), self.freedom * self.independent
        others = max(gains.sum() - 1, 1)
        rest = (scale.sum(-1, keepdims=True) - scale) / others
        chance = scipy.special.fdtrc(of_scale, of_scale * others, scale / np.where(rest > 0, rest, 1.0))
        lent = self.lends & ((chance >= _UNLIKE) | (rest <= 0))
        alike = _mean(relative, lent, -1)
        # a statistic in which searches end alike by chance
        if self.lends.any():
            alike = np.maximum(alike, np.median(alike[..., self.lends.any(1), :], axis=-2, keepdims=True))
        own = np.maximum(np.maximum(relative, scale * mean), alike)
        value = np.where(self.lends, np.where(lent, alike, own) * self.square, variances)
        return _Variances(value, self.freedom * np.where(lent, lent.sum(-1, keepdims=True), 1.0), lent)

    def apart(self, values: np.ndarray) -> np.ndarray:
        """Return values (..., G, K), those of gains with the baseline's searches less the baseline's."""
        mine = self.shared & (np.arange(len(self.shared)) != self.baseline)
        return np.where(mine[:, None], values - values[..., [self.baseline], :], values)

    def differences(self, apart: np.ndarray) -> np.ndarray:
        """Return the differences (..., G) from the baseline of means over the seeds, of values as `apart` has them."""
        means = apart.mean(-1)
        found = np.where(self.shared, means, means - means[..., [self.baseline]])
        found[..., self.baseline] = 0.0
        return np.asarray(found)

    def of_differences(self, variances: np.ndarray) -> np.ndarray:
        """Return the variances (..., G) of the differences from the baseline."""
        both = np.where(self.shared, variances, variances + variances[..., [self.baseline]])
        both[..., self.baseline] = 0.0
        return np.asarray(both)

    def of_sums(self, variances: _Variances) -> np.ndarray:
        """Return the squares of the variances of the differences over their freedom: Satterthwaite's sums."""
        value, freedom, lent = variances
        together = lent & lent[..., [self.baseline]] & ~self.shared
        whole = (value + value[..., [self.baseline]]) ** 2 / freedom
        return np.asarray(np.where(together, whole, self.of_differences(value**2 / freedom)))

    def drawn(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Return normal numbers (R, P, G, K) of variance 1, correlated among statistics as the residuals are."""
        alone = 1 / (1 + self.freedom * self.lends.any(0).sum())
        common = np.tensordot(self.residuals, rng.normal(size=(shape[0], self.residuals.shape[1], *shape[2:])), (1, 1))
        there = np.where(self.lends.any(1), 1 - alone, 0.0)[:, None, None]
        return np.asarray(np.sqrt(there) * np.moveaxis(common, 0, 1) + np.sqrt(1 - there) * rng.normal(size=shape))


def _of_mean(values: np.ndarray) -> np.ndarray:
    """Return the variances of the means over the last axis, by the scatter along it; 0 of single values."""
    count = values.shape[-1]
    return np.asarray(values.var(axis=-1, ddof=1) / count if count > 1 else np.zeros(values.shape[:-1]))


def _mean(values: np.ndarray, kept: np.ndarray, axis: int) -> np.ndarray:
    """Return the mean along an axis over values that are kept; 0 where none is."""
    total = np.where(kept, values, 0.0).sum(axis, keepdims=True)
    return np.asarray(total / np.maximum(kept.sum(axis, keepdims=True), 1))


def lost(failed: np.ndarray, baseline: int) -> Interval:
    """Return the interval of the share of walks that fail, the mean over the seeds, which holds for all gains at once.

    Of the walks that fail under one of two gains alone, half fail under each where both are alike: the interval of that
    half is exact (McNemar's test; Clopper and Pearson, 1934), at the level divided by how many gains are compared
    (Bonferroni). Where no walk tells the gains apart, it is the share that so many walks could have missed. It reaches
    over Student's interval of the differences of the seeds.

    Arguments:
        failed: (G, K, M) whether it does, of K seeds.
        baseline: the place of the gains that all are compared with.
    """
    seeds, walks = failed.shape[1:]
    tail = (1 - LEVEL) / 2 / max(len(failed) - 1, 1)
    alone = (failed & ~failed[baseline]).sum(axis=2).mean(axis=1)
    base = (~failed & failed[baseline]).sum(axis=2).mean(axis=1)
    either = alone + base
    # of shape parameters of 0 the quantile is that end itself
    least = np.where(alone > 0, scipy.special.betaincinv(np.where(alone > 0, alone, 1), base + 1, tail), 0.0)
    most = np.where(base > 0, scipy.special.betaincinv(alone + 1, np.where(base > 0, base, 1), 1 - tail), 1.0)
    missed = 1 - tail ** (1 / walks)
    low = np.where(either > 0, (2 * least - 1) * either / walks, -missed)
    high = np.where(either > 0, (2 * most - 1) * either / walks, missed)
    share = failed.mean(axis=(1, 2))
    difference = share - share[baseline]
    if seeds > 1:
        of_seeds = failed.mean(axis=2) - failed.mean(axis=2)[baseline]
        half = -scipy.special.stdtrit(seeds - 1, tail) * of_seeds.std(axis=1, ddof=1) / math.sqrt(seeds)
        low, high = np.minimum(low, difference - half), np.maximum(high, difference + half)
    low[baseline] = high[baseline] = 0.0
    open_ended = np.full(len(failed), np.nan)
    return Interval(share, difference, np.maximum(low, -1.0), np.minimum(high, 1.0), open_ended, open_ended)


def without_interval(walks: int, worst: Worst | None, *, tails: bool = True, seeds: int | None = None) -> list[str]:
    """Return in a line which differences can have no interval, and the number that would give one; none where all have.

    `tails`: whether the worst walks of each metric are compared too; `seeds`: searches of each law, None where gains
    are compared that no search is asked about.
    """
    needed = {"any mean": _fewest(1.0)}
    needed |= {} if worst is None else {"the objective": _fewest(worst.share)}
    needed |= {f"the worst {judging.WORST_SHARE:.0%}": _fewest(judging.WORST_SHARE)} if tails else {}
    lacking = [f"{words} (from {least} on)" for words, least in needed.items() if walks < least]
    said = [f"{walks} test walks give no interval of {' and of '.join(lacking)}"] if lacking else []
    if seeds is not None and seeds < FEWEST_SEEDS:
        searches = "one search tells" if seeds == 1 else f"{seeds} searches tell"
        said.append(f"{searches} no law from another (from {FEWEST_SEEDS} seeds on)")
    return said


def _fewest(share: float) -> int:
    """Return how many walks give an interval of the mean over a share of the worst of them."""
    return FEWEST_WALKS if share == 1 else max(FEWEST_WALKS, math.ceil(FEWEST_WORST / share - 1e-9))


def compared(
    walks: xr.Dataset, metrics: list[str], baseline: str, goal: Objective, *,
    shared: Collection[str] = (), count: int = RESAMPLES, seed: int = 0,
) -> xr.Dataset:  # fmt: skip
    """Return mean and worst 5 % of some metrics, and their differences from those of the baseline with intervals.

    `value`, `difference`, `low`, `high`, `walks_needed`, `seeds_needed` (see `Interval`) and `real` (the interval does
    not hold 0) have dimensions (`metric`, `statistic`, `gains`). The metrics are the objective, where it has weighted
    terms, relative to pd on these walks; those that are asked for; and `failed`, the share of walks that lose a gripper
    or diverge. The intervals hold for all means at once, and for all worst 5 % at once; where walks or searches are too
    few (`without_interval`) there is none, and nothing is `real`. All but the last are of the walks that
    `tuning.comparisons.judge.held` keeps; gains that it leaves out have none.

    Arguments:
        walks: metrics over (`gains`, `member`), or (`gains`, `seed`, `member`) of gains that were searched as often.
        metrics: names of those that are compared.
        baseline: the gains that all are compared with.
        goal: of the searches.
        shared: names of gains that have the results of the baseline's searches.
        count: how many resamples.
        seed: of the draws.
    """
    seeds = walks.sizes.get("seed")
    enough_seeds = seeds is None or seeds >= FEWEST_SEEDS
    walks = walks if "seed" in walks.dims else walks.expand_dims(seed=1, axis=1)
    names, kept = walks["gains"].values.tolist(), judging.held(walks)
    sound = kept["gains"].values.tolist()
    shape = (len(metrics) + 2, len(STATISTICS), len(names))
    table = np.full((len(Interval._fields), *shape), np.nan)
    failed = judging.failed(walks).transpose(*DIMS).values
    table[:, -1, 0] = lost(failed, names.index(baseline))
    members, places = kept.sizes["member"], [names.index(name) for name in sound]
    if baseline in sound and members:
        statistics, base = _statistics(kept, metrics, goal), sound.index(baseline)
        searches = [base if name in (baseline, *shared) else place for place, name in enumerate(sound)]
        how: dict[str, Any] = {"searches": searches, "count": count, "seed": seed}
        for key, statistic in statistics.items():  # values, also of those that have no intervals
            table[0, *key, places] = value = statistic(np.ones((1, members)))[0].mean(1)
            table[1, *key, places] = value - value[base]
        how["shares"] = {(0, 0): _share_of(goal)} | {key: judging.WORST_SHARE for key in statistics if key[1] == 1}
        enough = {key for key in statistics if enough_seeds and members >= _fewest(how["shares"].get(key, 1.0))}
        for column in range(len(STATISTICS)):
            family = {key: own for key, own in statistics.items() if key[1] == column and key in enough}
            for key, found in intervals(family, members, base, **how).items():
                table[:, *key, places] = found
    data = dict(zip(Interval._fields, table, strict=True))
    data["real"] = enough_seeds & ((data["low"] > 0) | (data["high"] < 0))
    larger = [False, *(dataset.larger_is_better(walks[name]) for name in metrics), False]
    coordinates = {"metric": ["objective", *metrics, "failed"], "statistic": list(STATISTICS), "gains": names}
    dims = ("metric", "statistic", "gains")
    made = xr.Dataset({name: (dims, values) for name, values in data.items()}, coordinates)
    made["larger_is_better"] = ("metric", np.array(larger))
    attrs = {"baseline": baseline, "members": walks.sizes["member"], "members_compared": kept.sizes["member"]}
    attrs |= {"seeds": walks.sizes["seed"], "resamples": count}
    attrs["lacks"] = "; ".join(without_interval(members, goal.worst, tails=False, seeds=seeds))
    return made.assign_attrs(**attrs, level=LEVEL, worst_share=judging.WORST_SHARE)


def _share_of(goal: Objective) -> float:
    """Return the share of walks that an objective counts apart as the worst, 1 where it does not."""
    return 1.0 if goal.worst is None else goal.worst.share


def _statistics(kept: xr.Dataset, metrics: list[str], goal: Objective) -> dict[tuple[int, int], Statistic]:
    """Return the statistics of a table by its row and column, the objective's first."""
    rows = {
        str(name): kept[name].transpose(*DIMS).values.astype(float)
        for name in kept.data_vars
        if set(kept[name].dims) == set(DIMS)
    }
    found: dict[tuple[int, int], Statistic] = {}
    if judging.PD in kept["gains"].values and (terms := judging.terms_on(kept.isel(seed=0), goal)):
        found[0, 0] = lambda counts: _objective(rows, counts, goal, terms)
    for row, name in enumerate(metrics, 1):
        for column, share in enumerate((1.0, judging.WORST_SHARE)):
            found[row, column] = _worst_of(rows[name], share, dataset.larger_is_better(kept[name]))
    return found


def _worst_of(values: np.ndarray, share: float, larger: bool) -> Statistic:
    return lambda counts: worst_mean(values, counts, share, larger_is_better=larger)


def _objective(
    rows: Mapping[str, np.ndarray], counts: np.ndarray, goal: Objective, terms: tuple[Term, ...]
) -> np.ndarray:
    """Return the objective of mean and worst of its terms, (R, G, K)."""
    total: np.ndarray | float = 0.0
    for term in terms:
        values, larger = rows[term.metric], term.larger_is_better
        ratio = worst_mean(values, counts) / term.baseline
        if goal.worst is not None:
            worst = worst_mean(values, counts, goal.worst.share, larger_is_better=larger) / term.worst
            ratio = (1 - goal.worst.weight) * ratio + goal.worst.weight * worst
        total = total + term.weight * (2 - ratio if larger else ratio)
    return np.asarray(total / sum(term.weight for term in terms))


def beside(walks: xr.Dataset, table: xr.Dataset) -> xr.Dataset:
    """Return walks with a table of `compared` beside them; `taken` gives it back."""
    attrs = {**walks.attrs, **table.attrs}
    return walks.assign({PREFIX + str(name): values for name, values in table.data_vars.items()}).assign_attrs(attrs)


def taken(data: xr.Dataset) -> xr.Dataset:
    """Return the table that `beside` put beside walks."""
    names = [str(name) for name in data.data_vars if str(name).startswith(PREFIX)]
    table = data[names].rename({name: name.removeprefix(PREFIX) for name in names})
    return table.assign(real=table["real"].astype(bool))


def differences(table: xr.Dataset) -> list[dict[str, Any]]:
    """Return the differences of a table from its baseline as plain rows; `claimed`: the interval leaves 0 out."""
    rows: list[dict[str, Any]] = []
    baseline = table.attrs["baseline"]
    for metric, statistic, gains in itertools.product(*(table[name].values.tolist() for name in table["real"].dims)):
        own = table.sel(metric=metric, statistic=statistic, gains=gains)
        if gains != baseline and np.isfinite(own["difference"]):
            of = {"gains": gains, "baseline": baseline, "metric": metric, "statistic": statistic}
            rows.append(of | {name: float(own[name]) for name in ("difference", "low", "high")})
            rows[-1]["claimed"] = bool(own["real"])
    return rows


class Verdict(NamedTuple):
    """The verdict of a comparison of laws."""

    best: str | None  # the law, None where none is better than the baseline
    in_words: str  # one sentence


def verdict(
    table: xr.Dataset, laws: Sequence[str], sensor: str, hardware: Sequence[str],
    outside: Collection[str] = (), unsettled: Collection[str] = (), joint: Mapping[str, float] | None = None,
) -> Verdict:  # fmt: skip
    """Return which law is better than the baseline, and the worth of a force sensor and of better hardware.

    Arguments:
        table: see `compared`.
        laws: names of those that were tuned beside the baseline.
        sensor: the worth of a force sensor in words, see `sensor_in_words`.
        hardware: names of the baseline's walks with better hardware.
        outside: laws (or the baseline) with a search that found no gains within its limits.
        unsettled: those with a search that had not converged when it ended.
        joint: the gains of the baseline.
    """
    said = _verdict(table, laws, sensor, hardware, outside, verdicts.in_words(table.attrs["baseline"], joint))
    if not unsettled:
        return said
    return said._replace(in_words=f"{said.in_words}; not every search of {', '.join(unsettled)} had converged")


def _verdict(
    table: xr.Dataset, laws: Sequence[str], sensor: str, hardware: Sequence[str], outside: Collection[str], base: str,
) -> Verdict:  # fmt: skip
    if table.attrs["baseline"] in outside:
        return Verdict(None, f"no verdict: a search of {base} found no gains that keep its limits")
    if not (laws := [name for name in laws if name not in outside]):
        return Verdict(None, f"none is better than {base}: of no law all searches found gains that keep the limits")
    if table.attrs["lacks"]:
        return Verdict(None, f"no verdict: {table.attrs['lacks']}{_lost(table, laws)}")
    told = {name: _gain(table, name, "objective") for name in (*laws, *hardware)}
    better = [name for name in laws if told[name].real]
    best = max(better, key=lambda name: told[name].size, default=None)
    if best:
        said = f"{best} is better than {base}, by {told[best]} of the objective, {_beside(table, [best])}"
        worse = [metric.replace("_", " ") for metric in _metrics(table) if _worse(table, best, metric)]
        said += f", though worse in {', '.join(worse)}" if worse else ""
    else:
        said = _none_better(table, laws, told, base)
    said += _lost(table, laws)
    said += f"; {sensor}" if sensor else ""
    if not hardware:
        return Verdict(best, said + "; the scenario has no delay, friction or rate to better")
    most = max(hardware, key=lambda name: told[name].size)
    if not told[most].real:
        return Verdict(best, said + f"; {_walks(table)} show no gain for pd by {', '.join(hardware)}")
    than = ""
    if best:
        over, under = told[most].low > told[best].high, told[most].high < told[best].low
        than = ", more than by any of these laws" if over else ", less than by the best of these laws" if under else ""
    return Verdict(best, said + f"; {most} would better pd by {told[most]} of its objective{than}")


class _Gain(NamedTuple):
    """By how much gains better a metric, as a part of the baseline's, with the ends of its interval."""

    size: float
    low: float
    high: float
    real: bool  # better, and it does not lose more walks

    def __str__(self) -> str:
        return f"{self.size:.1%} ({100 * self.low:.1f} to {100 * self.high:.1f}%)"


def _gain(table: xr.Dataset, name: str, metric: str) -> _Gain:
    own = table.sel(metric=metric, statistic="mean", gains=name)
    base = abs(float(own["value"] - own["difference"]))
    if not base or not np.isfinite(base):
        return _Gain(-math.inf, math.nan, math.nan, False)
    sign = 1 if bool(own["larger_is_better"]) else -1
    size, *ends = (sign * float(own[key]) / base for key in ("difference", "low", "high"))
    return _Gain(size, min(ends), max(ends), bool(own["real"]) and size > 0 and not _loses(table, name))


def _worse(table: xr.Dataset, name: str, metric: str) -> bool:
    """Tell whether a mean is really worse."""
    own = table.sel(metric=metric, statistic="mean", gains=name)
    return bool(own["real"]) and (float(own["difference"]) > 0) != bool(own["larger_is_better"])


def standing(table: xr.Dataset, name: str, metric: str) -> int:
    """Return 1 for gains that are better than the baseline in a mean, -1 for worse ones, 0 where it cannot be told.

    Lost walks count as well: who is worse in the mean and better in lost walks, or the reverse, is not told apart.
    """
    real = table["real"].sel(statistic="mean", gains=name)
    sign = sum(bool(real.sel(metric=each)) * (1 - 2 * _worse(table, name, each)) for each in (metric, "failed"))
    return int(np.sign(min(sign, 0) if _loses(table, name) else sign))


def _loses(table: xr.Dataset, name: str) -> bool:
    """Tell whether gains lose more walks than the baseline, and perhaps more than `LOST_MOST` of all."""
    own = table.sel(metric="failed", statistic="mean", gains=name)
    return bool(own["difference"] > 0 and own["high"] > LOST_MOST)


def _lost(table: xr.Dataset, laws: Sequence[str]) -> str:
    """Return in words the share of walks that laws and baseline lose, "" where none is lost."""
    own = table["value"].sel(metric="failed", statistic="mean", gains=[*laws, table.attrs["baseline"]])
    each = [
        f"{name} {share:.1%}" for name, share in zip(own["gains"].values.tolist(), own.values.tolist(), strict=True)
    ]
    return f"; lost walks: {', '.join(each)}" if (own > 0).any() else ""


def _none_better(table: xr.Dataset, laws: Sequence[str], told: Mapping[str, _Gain], base: str) -> str:
    """Return in words that no law is, or can be told to be, better than the baseline."""
    own = table.sel(metric="objective", statistic="mean", gains=list(laws))
    open_ones = [name for name in laws if not own["real"].sel(gains=name) and not _loses(table, name)]
    if not open_ones:
        nearest = max(laws, key=lambda name: told[name].size)
        size = told[nearest].size
        change = f"{abs(size):.1%} {'less' if size > 0 else 'more'} objective"
        how = f": the nearest, {nearest}, has {change}, {_beside(table, [nearest])}" if np.isfinite(size) else ""
        return f"none is better than {base}{how}"
    said = f"{', '.join(open_ones)} cannot be told apart from {base} in the objective with {_walks(table)}: "
    said += _beside(table, open_ones)
    seeming = [name for name in open_ones if own["difference"].sel(gains=name) < 0]
    if seeming:
        said += f" ({_needed(own.sel(gains=seeming))}, if the difference is what it seems)"
    return said


def _beside(table: xr.Dataset, names: Sequence[str], metric: str = "objective") -> str:
    """Return the means of laws and of the baseline, as "0.81 beside 0.92"."""
    own = table["value"].sel(metric=metric, statistic="mean")
    ours = ", ".join(number(float(own.sel(gains=name))) for name in names)
    return f"{ours} beside {number(float(own.sel(gains=table.attrs['baseline'])))}"


def _needed(own: xr.Dataset) -> str:
    """Return in words how many walks would tell the gains apart that are told apart the soonest, or how many seeds."""
    for name, what in (("walks_needed", "walks"), ("seeds_needed", "seeds")):
        least = float(own[name].min())
        if np.isfinite(least):
            return f"{math.ceil(least):,} {what} would"
    return "more of both would"


def _walks(table: xr.Dataset) -> str:
    walks, seeds = f"{table.attrs['members_compared']} walks", int(table.attrs["seeds"])
    return f"{walks} and {seeds} seeds" if seeds > 1 else walks


def sensor_in_words(
    table: xr.Dataset, name: str, whole: float, joint: Mapping[str, float] | None = None, what: str = "a force sensor",
    metric: str = "objective",
) -> str:  # fmt: skip
    """The worth of measured forces in words: the best law that reads forces beside the best that does not.

    Arguments:
        table: see `compared`; its baseline is the best law that reads no forces.
        name: of the best law that does.
        whole: the metric's mean of pd; all worths are relative to it.
        joint: gains of pd retuned.
        what: the source of the forces, in words.
        metric: by which laws are compared.
    """
    base, own = verdicts.in_words(table.attrs["baseline"], joint), _gain(table, name, metric)
    best = f"{base}, the best law that reads no forces"
    if not own.real:
        return f"{_walks(table)} show no worth of {what}: {name} beside {best}: {_beside(table, [name], metric)}"
    row = table.sel(metric=metric, statistic="mean", gains=name)
    share = abs(float(row["value"] - row["difference"])) / whole
    size, low, high = (share * each for each in own[:3])
    worth = f"{size:.1%} ({100 * low:.1f} to {100 * high:.1f}%)"
    worse = [metric.replace("_", " ") for metric in _metrics(table) if _worse(table, name, metric)]
    end = f", though it is worse in {', '.join(worse)}" if worse else ""
    return f"of the lead over pd {what} is worth {worth}: {name} beside {best}, {_beside(table, [name], metric)}{end}"


def _metrics(table: xr.Dataset) -> list[str]:
    """Return the metrics of a table without the objective and the lost walks."""
    return [name for name in table["metric"].values.tolist() if name not in ("objective", "failed")]
