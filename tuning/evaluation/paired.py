"""Which differences between gains on the same walks are real: intervals by a paired bootstrap over the walks."""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from mjx_climb.files import dataset
from tuning.problem.objectives import Objective, Term
from tuning.searches import judge as judging

RESAMPLES = 4000
LEVEL = 0.95
PREFIX = "compared_"  # of the variables of a table beside walks
STATISTICS = ("mean", "worst")
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
        drawn = counts[:, order]
        kept = np.clip(worst - (np.cumsum(drawn, axis=1) - drawn), 0, drawn)
        found[:, column] = kept @ own[order] / worst
    return found


def resamples(walks: int, count: int = RESAMPLES, seed: int = 0) -> Iterator[np.ndarray]:
    """Yield how often each of some walks is drawn where as many are drawn with replacement: (R, walks) at a time."""
    rng, even = np.random.default_rng(seed), np.full(walks, 1 / walks)
    most = max(1, _AT_ONCE // walks)
    for begin in range(0, count, most):
        yield rng.multinomial(walks, even, size=min(most, count - begin))


def intervals(
    statistics: Mapping[Any, Statistic], walks: int, baseline: int, *, count: int = RESAMPLES, seed: int = 0
) -> dict[Any, np.ndarray]:
    """Return value, difference from the baseline, and its interval's ends, (4, G), of each statistic.

    The same walks are drawn for all gains. The interval has the quantiles of the resamples ("percentile bootstrap").

    Arguments:
        statistics: by any key.
        walks: how many there are.
        baseline: the place of the gains that all are compared with.
        count: how many resamples.
        seed: of the draws.
    """
    found: dict[Any, list[np.ndarray]] = {key: [] for key in statistics}
    for counts in resamples(walks, count, seed):
        for key, statistic in statistics.items():
            values = statistic(counts)
            found[key].append(values - values[:, [baseline]])
    ends = [(1 - LEVEL) / 2, (1 + LEVEL) / 2]
    result = {}
    for key, statistic in statistics.items():
        (value,) = statistic(np.ones((1, walks), int))
        low, high = np.quantile(np.concatenate(found[key]), ends, axis=0)
        result[key] = np.stack([value, value - value[baseline], low, high])
    return result


def compared(
    walks: xr.Dataset, metrics: list[str], baseline: str, goal: Objective, *, count: int = RESAMPLES, seed: int = 0
) -> xr.Dataset:
    """Return mean and worst 5 % of some metrics, and their differences from those of the baseline with intervals.

    `value`, `difference`, `low`, `high` and `real` (the interval does not hold 0) have dimensions (`metric`,
    `statistic`, `gains`). The metrics are the objective, where it has weighted terms, relative to pd on these walks;
    those that are asked for; and `failed`, the share of walks that lose a gripper or diverge. All but the last are of
    the walks in which nothing diverges; gains that diverge in more than half of the walks have none, and are no reason
    to leave a walk out.
    """
    names, diverged = walks["gains"].values.tolist(), walks["diverged"].astype(bool)
    sound = [name for name in names if float(diverged.sel(gains=name).mean()) <= 0.5]
    held = walks.sel(gains=sound).isel(member=~diverged.sel(gains=sound).any("gains").values)
    shape = (len(metrics) + 2, len(STATISTICS), len(names))
    table = np.full((4, *shape), np.nan)
    failed = judging.failed(walks).transpose("gains", "member").values.astype(float)
    whole = {"failed": lambda counts: worst_mean(failed, counts)}
    how: dict[str, Any] = {"count": count, "seed": seed}
    table[:, -1, 0] = intervals(whole, failed.shape[1], names.index(baseline), **how)["failed"]
    if baseline in sound and held.sizes["member"]:
        statistics = _statistics(held, metrics, goal)
        found = intervals(statistics, held.sizes["member"], sound.index(baseline), **how)
        places = [names.index(name) for name in sound]
        for (row, column), values in found.items():
            table[:, row, column, places] = values
    value, difference, low, high = table
    there = np.isfinite(low)
    data = {
        "value": value, "difference": difference, "low": low, "high": high,
        "real": there & ((low > 0) | (high < 0)),
    }  # fmt: skip
    larger = [False, *(dataset.larger_is_better(walks[name]) for name in metrics), False]
    coordinates = {"metric": ["objective", *metrics, "failed"], "statistic": list(STATISTICS), "gains": names}
    dims = ("metric", "statistic", "gains")
    made = xr.Dataset({name: (dims, values) for name, values in data.items()}, coordinates)
    made["larger_is_better"] = ("metric", np.array(larger))
    attrs = {"baseline": baseline, "members": walks.sizes["member"], "members_compared": held.sizes["member"]}
    return made.assign_attrs(**attrs, level=LEVEL, resamples=count, worst_share=judging.WORST_SHARE)


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
    objective = table.sel(metric="objective", statistic="mean")

    def gained(name: str, values: xr.Dataset) -> float:
        """Return by how much gains better a metric, relative; 0 where that is not real, or really more walks fail."""
        own, base = values.sel(gains=name), float(values["value"].sel(gains=table.attrs["baseline"]))
        sign = 1 if bool(own["larger_is_better"]) else -1
        counts = bool(own["real"]) and base and not worse_in(name, "failed")
        return max(sign * float(own["difference"]) / abs(base), 0.0) if counts else 0.0

    def worse_in(name: str, metric: str) -> bool:
        """Tell whether a mean is really worse."""
        own = table.sel(metric=metric, statistic="mean", gains=name)
        return bool(own["real"]) and (float(own["difference"]) > 0) != bool(own["larger_is_better"])

    gains = {name: gained(name, objective) for name in (*laws, *hardware)}
    best, better = max(laws, key=gains.__getitem__), max(hardware, key=gains.__getitem__, default=None)
    if gains[best]:
        said = f"{best} is better than retuned pd, by {gains[best]:.1%} of the objective"
        worse = [metric.replace("_", " ") for metric in _metrics(table) if worse_in(best, metric)]
        said += f", though worse in {', '.join(worse)}" if worse else ""
    else:
        said = "none is better than retuned pd"
    said += f"; {_sensor(table, [name for name in laws if name in reading], gained)}"
    if better is None:
        return Verdict(best if gains[best] else None, said + "; the scenario has no delay, friction or rate to better")
    if gains[better]:
        than = "more" if gains[better] > gains[best] else "less"
        said += f"; {better} would be worth {than} than any of these laws: {gains[better]:.1%} of pd's objective"
    else:
        said += f"; no real gain for pd by {', '.join(hardware)}"
    return Verdict(best if gains[best] else None, said)


def _sensor(table: xr.Dataset, laws: Sequence[str], gained: Callable[[str, xr.Dataset], float]) -> str:
    """Return in words the largest real improvement of each metric by a law that reads forces."""
    if not laws:
        return "no law here reads forces"
    worth, nothing = [], []
    for metric in _metrics(table):
        values = table.sel(metric=metric, statistic="mean")
        law = max(laws, key=lambda name: gained(name, values))
        words, change = metric.replace("_", " "), gained(law, values)
        worth += [f"{change:.1%} of {words} ({law})"] if change else []
        nothing += [] if change else [words]
    if not worth:
        return "the force sensor is worth nothing here"
    return f"the force sensor is worth {', '.join(worth)}" + (f", nothing in {', '.join(nothing)}" if nothing else "")


def _metrics(table: xr.Dataset) -> list[str]:
    """Return the metrics of a table without the objective and the lost walks."""
    return [name for name in table["metric"].values.tolist() if name not in ("objective", "failed")]
