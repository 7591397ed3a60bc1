"""Which differences between gains on the same walks are real: intervals that hold for all of them at once."""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import betaincinv

from mjx_climb.files import dataset
from tuning.comparisons import judge as judging
from tuning.problem.objectives import Objective, Term

RESAMPLES = 4000
LEVEL = 0.95
PREFIX = "compared_"  # of the variables of a table beside walks
STATISTICS = ("mean", "worst")
FEWEST_WORST = 10  # walks among the worst for which a bootstrap can say how far they scatter
POWER_QUANTILE = 0.8416  # of the normal distribution at 80 %
_MARGIN = 16  # walks beyond twice the worst, of which hardly a resample draws too few
_ROUNDING = 1e-12  # of a value: what is no further from another is equal
_AT_ONCE = 4_000_000  # numbers of walks, of some resamples

# statistics (R, G) of G gains, by how often each of M walks was drawn in R resamples (R, M)
Statistic = Callable[[np.ndarray], np.ndarray]


def worst_mean(
    values: np.ndarray, counts: np.ndarray, share: float = 1.0, *, larger_is_better: bool = False
) -> np.ndarray:
    """Return the mean over the worst share of walks in each resample, of all of them where the share is 1: (R, G).

    Arguments:
        values: (G, M) of each walk.
        counts: (R, M) how often it was drawn.
        share: of the walks, as of `tuning.problem.ensemble.worst_mean`.
        larger_is_better: whether the least values are the worst.
    """
    if share == 1:
        return np.asarray(counts @ values.T / values.shape[1])
    worst = max(1, math.ceil(share * values.shape[1] - 1e-9))
    found = np.empty((len(counts), len(values)))
    for column, own in enumerate(values):
        order = np.argsort(own if larger_is_better else -own)
        # those drawn lie among the first few, unless a resample drew hardly any of these
        first = order[: 2 * worst + _MARGIN]
        reached = counts[:, first].sum(axis=1) >= worst
        for rows, those in ((reached, first), (~reached, order)):
            drawn = counts[np.ix_(rows, those)]
            kept = np.clip(worst - (np.cumsum(drawn, axis=1) - drawn), 0, drawn)
            found[rows, column] = kept @ own[those] / worst
    return found


def resamples(walks: int, count: int = RESAMPLES, seed: int = 0) -> Iterator[np.ndarray]:
    """Yield how often each of some walks is drawn where as many are drawn with replacement: (R, walks) at a time."""
    rng, even = np.random.default_rng(seed), np.full(walks, 1 / walks)
    most = max(1, _AT_ONCE // walks)
    for begin in range(0, count, most):
        # as floats, of which BLAS makes sums
        yield rng.multinomial(walks, even, size=min(most, count - begin)).astype(float)


class Interval(NamedTuple):
    """A statistic of each gains, how far it is from that of a baseline, and the ends of that difference: (G,) each."""

    value: np.ndarray
    difference: np.ndarray
    low: np.ndarray
    high: np.ndarray
    # of which the interval would leave 0 out in 80 % of draws, if the difference is what was found
    walks_needed: np.ndarray


def intervals(
    statistics: Mapping[Any, Statistic], walks: int, baseline: int, *, count: int = RESAMPLES, seed: int = 0
) -> dict[Any, Interval]:
    """Return the intervals of some statistics, which hold for all of them and all gains at once.

    The same walks are drawn for all gains. Each difference has the same multiple of its standard error to both sides:
    the quantile, over the resamples, of the largest deviation in standard errors among all rows ("max-t"; Romano and
    Wolf, "Exact and approximate stepdown methods for multiple hypothesis testing", 2005, section 4).

    Arguments:
        statistics: by any key.
        walks: how many there are.
        baseline: the place of the gains that all are compared with.
        count: how many resamples.
        seed: of the draws.
    """
    drawn: dict[Any, list[np.ndarray]] = {key: [] for key in statistics}
    for counts in resamples(walks, count, seed):
        for key, statistic in statistics.items():
            values = statistic(counts)
            drawn[key].append(values - values[:, [baseline]])
    found = {key: statistic(np.ones((1, walks)))[0] for key, statistic in statistics.items()}
    deviations, errors = {}, {}
    for key, parts in drawn.items():
        deviations[key] = np.concatenate(parts) - (found[key] - found[key][baseline])
        # as many walks are drawn as there are, of which one is known by the others
        errors[key] = deviations[key].std(axis=0) * np.sqrt(walks / max(walks - 1, 1))
    largest = np.zeros(count)
    for key, own in deviations.items():
        there = errors[key] > _ROUNDING * np.abs(found[key]).max()
        largest = np.maximum(largest, np.abs(own[:, there] / errors[key][there]).max(axis=1, initial=0.0))
    multiple = np.quantile(largest, LEVEL)
    result = {}
    for key, value in found.items():
        difference, error = value - value[baseline], errors[key]
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = walks * ((multiple + POWER_QUANTILE) * error / difference) ** 2
        low, high = difference - multiple * error, difference + multiple * error
        result[key] = Interval(value, difference, low, high, needed)
    return result


def lost(failed: np.ndarray, baseline: int) -> Interval:
    """Return the interval of the share of walks that fail, by McNemar's exact test, which holds for all gains at once.

    Of the walks that fail under one of two gains alone, half fail under each where both are alike: the interval of that
    half is exact (Clopper and Pearson, 1934), at the level divided by how many gains are compared (Bonferroni). Where
    no walk tells the gains apart, it is what so many walks could have missed.

    Arguments:
        failed: (G, M) whether it does.
        baseline: the place of the gains that all are compared with.
    """
    walks, share = failed.shape[1], failed.mean(axis=1)
    tail = (1 - LEVEL) / 2 / max(len(failed) - 1, 1)
    alone = (failed & ~failed[baseline]).sum(axis=1)
    base = (~failed & failed[baseline]).sum(axis=1)
    either = alone + base
    # of shape parameters of 0 the quantile is that end itself
    least = np.where(alone > 0, betaincinv(np.maximum(alone, 1), base + 1, tail), 0.0)
    most = np.where(base > 0, betaincinv(alone + 1, np.maximum(base, 1), 1 - tail), 1.0)
    missed = 1 - tail ** (1 / walks)
    low = np.where(either > 0, (2 * least - 1) * either / walks, -missed)
    high = np.where(either > 0, (2 * most - 1) * either / walks, missed)
    low[baseline] = high[baseline] = 0.0
    return Interval(share, share - share[baseline], low, high, np.full(len(failed), np.nan))


def compared(
    walks: xr.Dataset, metrics: list[str], baseline: str, goal: Objective, *, count: int = RESAMPLES, seed: int = 0
) -> xr.Dataset:
    """Return mean and worst 5 % of some metrics, and their differences from those of the baseline with intervals.

    `value`, `difference`, `low`, `high`, `walks_needed` (see `Interval`) and `real` (the interval does not hold 0) have
    dimensions (`metric`, `statistic`, `gains`). The metrics are the objective, where it has weighted terms, relative to
    pd on these walks; those that are asked for; and `failed`, the share of walks that lose a gripper or diverge. The
    intervals hold for all means at once, and for all worst 5 % at once, which have none where the worst are fewer than
    `FEWEST_WORST`. All but the last are of the walks in which nothing diverges; gains that diverge in more than half of
    the walks have none, and are no reason to leave a walk out.
    """
    names, diverged = walks["gains"].values.tolist(), walks["diverged"].astype(bool)
    sound = [name for name in names if float(diverged.sel(gains=name).mean()) <= 0.5]
    held = walks.sel(gains=sound).isel(member=~diverged.sel(gains=sound).any("gains").values)
    shape = (len(metrics) + 2, len(STATISTICS), len(names))
    table = np.full((len(Interval._fields), *shape), np.nan)
    failed = judging.failed(walks).transpose("gains", "member").values
    table[:, -1, 0] = lost(failed, names.index(baseline))
    members, places = held.sizes["member"], [names.index(name) for name in sound]
    if baseline in sound and members:
        few = {share: share * members < FEWEST_WORST for share in (judging.WORST_SHARE, _share_of(goal)) if share < 1}
        statistics = _statistics(held, metrics, goal)
        for column in range(len(STATISTICS)):
            family = {key: own for key, own in statistics.items() if key[1] == column}
            for (row, _), found in intervals(family, members, sound.index(baseline), count=count, seed=seed).items():
                table[:, row, column, places] = found
                if few.get(judging.WORST_SHARE if column else _share_of(goal) if row == 0 else 1, False):
                    table[2:, row, column] = np.nan
    data = dict(zip(Interval._fields, table, strict=True))
    data["real"] = (data["low"] > 0) | (data["high"] < 0)
    larger = [False, *(dataset.larger_is_better(walks[name]) for name in metrics), False]
    coordinates = {"metric": ["objective", *metrics, "failed"], "statistic": list(STATISTICS), "gains": names}
    dims = ("metric", "statistic", "gains")
    made = xr.Dataset({name: (dims, values) for name, values in data.items()}, coordinates)
    made["larger_is_better"] = ("metric", np.array(larger))
    attrs = {"baseline": baseline, "members": walks.sizes["member"], "members_compared": held.sizes["member"]}
    return made.assign_attrs(**attrs, level=LEVEL, resamples=count, worst_share=judging.WORST_SHARE)


def _share_of(goal: Objective) -> float:
    """Return the share of walks that an objective counts apart as the worst, 1 where it does not."""
    return 1.0 if goal.worst is None else goal.worst.share


def _statistics(held: xr.Dataset, metrics: list[str], goal: Objective) -> dict[tuple[int, int], Statistic]:
    """Return the statistics of a table by its row and column, the objective's first."""
    rows = {
        str(name): held[name].transpose("gains", "member").values.astype(float)
        for name in held.data_vars
        if held[name].ndim == 2
    }
    found: dict[tuple[int, int], Statistic] = {}
    if judging.PD in held["gains"].values and (terms := judging.terms_on(held, goal)):
        found[0, 0] = lambda counts: _objective(rows, counts, goal, terms)
    for row, name in enumerate(metrics, 1):
        for column, share in enumerate((1.0, judging.WORST_SHARE)):
            found[row, column] = _worst_of(rows[name], share, dataset.larger_is_better(held[name]))
    return found


def _worst_of(values: np.ndarray, share: float, larger: bool) -> Statistic:
    return lambda counts: worst_mean(values, counts, share, larger_is_better=larger)


def _objective(
    rows: Mapping[str, np.ndarray], counts: np.ndarray, goal: Objective, terms: tuple[Term, ...]
) -> np.ndarray:
    """Return what `Objective` makes of mean and worst of its terms, (R, G)."""
    total = np.zeros((len(counts), len(next(iter(rows.values())))))
    for term in terms:
        values, larger = rows[term.metric], term.larger_is_better
        ratio = worst_mean(values, counts) / term.baseline
        if goal.worst is not None:
            worst = worst_mean(values, counts, goal.worst.share, larger_is_better=larger) / term.worst
            ratio = (1 - goal.worst.weight) * ratio + goal.worst.weight * worst
        total += term.weight * (2 - ratio if larger else ratio)
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


class Verdict(NamedTuple):
    """What a comparison of laws says."""

    best: str | None  # the law, None where none is better than the baseline
    in_words: str  # one sentence


def verdict(
    table: xr.Dataset, laws: Sequence[str], reading: Collection[str], hardware: Sequence[str],
    outside: Collection[str] = (),
) -> Verdict:  # fmt: skip
    """Return which law is better than the baseline, what a force sensor is worth, and what hardware would be.

    Arguments:
        table: see `compared`.
        laws: names of those that were tuned beside the baseline.
        reading: those of them that read forces.
        hardware: names of the baseline's walks with better hardware.
        outside: those, of the laws and the baseline, whose search found no gains that keep its limits.
    """
    if table.attrs["baseline"] in outside:
        return Verdict(None, "no verdict: no gains of retuned pd kept the limits of its search")
    if not (laws := [name for name in laws if name not in outside]):
        return Verdict(None, "none is better than retuned pd: no law has gains that kept the limits of its search")
    told = {name: _gain(table, name, "objective") for name in (*laws, *hardware)}
    better = [name for name in laws if told[name].real]
    best = max(better, key=lambda name: told[name].size, default=None)
    if best:
        said = f"{best} is better than retuned pd, by {told[best]} of the objective"
        worse = [metric.replace("_", " ") for metric in _metrics(table) if _worse(table, best, metric)]
        said += f", though worse in {', '.join(worse)}" if worse else ""
    else:
        said = _none_better(table, laws)
    said += f"; {_sensor(table, [name for name in laws if name in reading])}"
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
    real: bool  # better, and no more walks really fail

    def __str__(self) -> str:
        return f"{self.size:.1%} ({100 * self.low:.1f} to {100 * self.high:.1f}%)"


def _gain(table: xr.Dataset, name: str, metric: str) -> _Gain:
    own = table.sel(metric=metric, statistic="mean", gains=name)
    base = abs(float(own["value"] - own["difference"]))
    if not base or not np.isfinite(base):
        return _Gain(-math.inf, math.nan, math.nan, False)
    sign = 1 if bool(own["larger_is_better"]) else -1
    size, *ends = (sign * float(own[key]) / base for key in ("difference", "low", "high"))
    return _Gain(size, min(ends), max(ends), bool(own["real"]) and size > 0 and not _worse(table, name, "failed"))


def _worse(table: xr.Dataset, name: str, metric: str) -> bool:
    """Tell whether a mean is really worse."""
    own = table.sel(metric=metric, statistic="mean", gains=name)
    return bool(own["real"]) and (float(own["difference"]) > 0) != bool(own["larger_is_better"])


def _none_better(table: xr.Dataset, laws: Sequence[str]) -> str:
    """Return in words that no law is, or can be told to be, better than the baseline."""
    own = table.sel(metric="objective", statistic="mean", gains=list(laws))
    open_ones = [name for name in laws if not own["real"].sel(gains=name) and not _worse(table, name, "failed")]
    if not open_ones:
        return "none is better than retuned pd"
    said = f"{', '.join(open_ones)} cannot be told apart from retuned pd in the objective with {_walks(table)}"
    needed = own["walks_needed"].sel(gains=[name for name in open_ones if own["difference"].sel(gains=name) < 0])
    if needed.size and np.isfinite(needed).any():
        most = math.ceil(float(needed.min()))
        said += f" ({most:,} would, if the difference is what it seems)"
    return said


def _walks(table: xr.Dataset) -> str:
    return f"{table.attrs['members_compared']} walks"


def _sensor(table: xr.Dataset, laws: Sequence[str]) -> str:
    """Return in words the largest real improvement of each metric by a law that reads forces."""
    if not laws:
        return "no law here reads forces"
    worth, nothing = [], []
    for metric in _metrics(table):
        gains = {name: _gain(table, name, metric) for name in laws}
        law = max(laws, key=lambda name: (gains[name].real, gains[name].size))
        words = metric.replace("_", " ")
        if gains[law].real:
            worth.append(f"{gains[law]} of {words} ({law})")
        else:
            nothing.append(words)
    if not worth:
        return f"{_walks(table)} show no worth of the force sensor"
    return f"the force sensor is worth {', '.join(worth)}" + (
        f", and {_walks(table)} show none in {', '.join(nothing)}" if nothing else ""
    )


def _metrics(table: xr.Dataset) -> list[str]:
    """Return the metrics of a table without the objective and the lost walks."""
    return [name for name in table["metric"].values.tolist() if name not in ("objective", "failed")]
