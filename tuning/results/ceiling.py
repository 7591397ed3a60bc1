"""The result of `tuning.ceiling`: how far control laws are from the best joint targets that were found."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tuning.problem.ceiling import Ceiling
from tuning.problem.plans import Walked
from tuning.results.result import Result

FIRST = "blind, first"  # the search of the blind plan from all starts
CLAIRVOYANT, BLIND, PD, RETUNED = "clairvoyant", "blind", "pd", "retuned_pd"
LEVEL = 0.95  # of intervals


class Worth(NamedTuple):
    """A mean over the members and its interval, in shares of pd's objective; of one member without an interval."""

    mean: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Bounded(Result):
    """Contestants on the same walks, from the best joint targets that were found to pd.

    `data` holds along `contestant` and `member` the objective `value` (the mean over the members is 1 for pd),
    `feasible`, and all metrics, nothing torn off. Along `plan` the joint targets (plan, member, time, limb, joint) of
    the plans among the contestants. Along `descent` each search: the contestant, its start, the s between knots,
    `value`, `merit` (value plus penalty) before and after it, and `slope`, the norm of the derivatives at its end
    relative to that at its begin. Along `contestant` and `instant` the largest foot force and the base's offset in the
    walk of the first member. Of an ensemble along `tested` and `fresh` the scores of the blind plan and the laws in
    walks of a fresh draw: `unseen_value`, relative to pd in these, `unseen_feasible` and `unseen_` before each metric.
    With a front along `point` the weight of the second metric, `front_share`, and both metrics of the clairvoyant plans
    that weigh these two alone, `front` (point, 2, member).

    `first` has the command of the first member's walk as each contestant, by name, to look at it; a result that is read
    has none.
    """

    FILE = "ceiling.nc"
    KIND = "ceiling"

    asked: Ceiling = dataclasses.field(default_factory=Ceiling)
    first: Mapping[str, Walked] = dataclasses.field(default_factory=dict)

    @property
    def contestants(self) -> list[str]:
        """The names, from the clairvoyant plan to pd."""
        return [str(name) for name in self.data["contestant"].values]

    @property
    def plans(self) -> list[str]:
        """The names of the plans among the contestants."""
        return [str(name) for name in self.data["plan"].values]

    def values(self, name: str) -> np.ndarray:
        """Return the objective of a contestant in each member's walk, (member,)."""
        return np.asarray(self.data["value"].sel(contestant=name).values, float)

    @functools.cached_property
    def means(self) -> dict[str, float]:
        """The mean objective of each contestant."""
        return {name: float(self.values(name).mean()) for name in self.contestants}

    @functools.cached_property
    def best_law(self) -> str:
        """The law of the least mean objective among those that keep every limit, or of all where none does."""
        laws = [name for name in self.contestants if name not in self.plans]
        keeps = [name for name in laws if bool(self.data["feasible"].sel(contestant=name).all())]
        return min(keeps or laws, key=self.means.__getitem__)

    @property
    def sensor(self) -> Worth:
        """The largest worth of a sensor, as far as the search got: blind less clairvoyant objective."""
        return mean_and_interval(self.values(BLIND) - self.values(CLAIRVOYANT))

    def share(self, name: str) -> float:
        """Return which share of that a contestant has, 1; above 1 or below 0 where it lies outside; NaN of nothing."""
        gain = self.means[BLIND] - self.means[CLAIRVOYANT]
        return (self.means[BLIND] - self.means[name]) / gain if gain > 0 else np.nan

    @property
    def tested(self) -> dict[str, np.ndarray]:
        """The objective of the blind plan and of the laws in walks of a fresh draw, (fresh,) each; empty without."""
        names = self.data["tested"].values if "tested" in self.data else ()
        return {str(name): np.asarray(self.data["unseen_value"].sel(tested=name).values, float) for name in names}

    @property
    def spread(self) -> float:
        """By how much the second best start of the blind plan ended above the best one at the coarsest knots, relative.

        NaN where there is one start.
        """
        of_first = self.data["descent_contestant"].values == FIRST
        coarsest = self.data["descent_knots"].values == max(self.asked.knots)
        ends = np.sort(self.data["descent_merit"].values[of_first & coarsest])
        return float(ends[1] / ends[0] - 1) if len(ends) > 1 and np.isfinite(ends[:2]).all() else np.nan

    @property
    def left(self) -> float:
        """By how much the second search of the blind plan bettered the first, relative: how far from its end it is."""
        finest = self.data["descent_knots"].values == min(self.asked.knots)
        merit, of = self.data["descent_merit"].values, self.data["descent_contestant"].values
        first, second = (merit[finest & (of == name)].min() for name in (FIRST, BLIND))
        return float(1 - second / first)


def mean_and_interval(values: np.ndarray) -> Worth:
    """Return the mean of some values and its interval by Student's t."""
    from scipy import stats

    mean = float(values.mean())
    if len(values) < 2:
        return Worth(mean, np.nan, np.nan)
    half = float(stats.t.ppf(0.5 + LEVEL / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return Worth(mean, mean - half, mean + half)
