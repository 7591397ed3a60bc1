"""The search over an ensemble of walks: `tuning.robust`, its objective, and what a draw that it never saw says."""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import PREFIX
from tuning.problem import ensemble as ensembles
from tuning.problem import objectives
from tuning.problem import search as search_settings
from tuning.problem.ensemble import Ensemble, Worst
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.objectives import Limit, Metrics, Score
from tuning.problem.search import ROBUST_WEIGHTS, Search
from tuning.searches import tune
from tuning.searches.judge import MEMBERS
from tuning.searches.result import Robust
from tuning.searches.rounds import Callback


def robust(
    scenario: mc.Scenario,
    ensemble: Ensemble,
    search: Search | None = None,
    *,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    judges: int = MEMBERS,
    out: str | os.PathLike[str] | None = None,
    progress: Callback | None = None,
    **settings: Any,
) -> Robust:
    """Search the gains that do best over an ensemble: `tuning.tune`, whose arguments these are, with its walks.

    Where no weights are given, those of a plain search and the peak pulling force count alike. `judges` is how many
    walks of a fresh draw test the result. `robust(scenario, ensemble, out="results/mine").write("results/mine")` is
    `mjx-climb tune --ensemble`.
    """
    wanted = settled(search, settings, ensemble)
    wanted = tune.for_this_machine(scenario, wanted, (search, settings.get("method")), engine, law)
    problem = problem_of(scenario, ensemble, wanted, law=law, metrics=metrics, engine=engine)
    found = tune.run(problem, wanted, out=out, progress=progress)
    assert isinstance(found, Robust)
    return dataclasses.replace(found, judges=judges)


class RobustTerm(NamedTuple):
    """A metric to better: its mean and the mean of its worst members, each relative to that of pd."""

    metric: str
    weight: float
    larger_is_better: bool
    mean: float
    worst: float
    smooth_mean: float
    smooth_worst: float


@dataclasses.dataclass(frozen=True)
class RobustObjective:
    """The score of points over all members of an ensemble, 1 for pd.

    `value` is the weighted mean over the terms of (1 - w) mean / pd's mean + w worst / pd's worst, where `worst` is the
    mean over the worst members. Limits hold for every member; the penalty is that of the worst members.
    """

    terms: tuple[RobustTerm, ...]
    limits: tuple[Limit, ...]  # of every member
    worst: Worst
    margin: float | None  # relative; no term's mean or worst may be above pd's times 1 - margin; None: they may

    def score(self, metrics: Metrics) -> Score:
        """Return the scores (B,) of metrics (members, B)."""
        value: Array | float = 0.0
        smooth: Array | float = 0.0
        penalty: Array | float = 0.0
        total, lost = 0.0, metrics["diverged"].any(0)
        feasible = ~lost
        for term in self.terms:
            ratios = soft = self.ratios(metrics[term.metric], term)
            if (name := PREFIX + term.metric) in metrics:
                soft = self._ratios(metrics[name], term, term.smooth_mean, term.smooth_worst)
            value += term.weight * self._mixed(*ratios)
            smooth += term.weight * self._mixed(*soft)
            total += term.weight
            if self.margin is not None:
                for ratio in ratios:
                    penalty += objectives.penalty_of(ratio - 1 + self.margin)
                    feasible &= ratio <= 1
        for limit in self.limits:
            slack = objectives.violation(limit, metrics[limit.metric])
            penalty += self._worst(objectives.penalty_of(slack + limit.margin))
            feasible &= (slack <= 0).all(0)
        mean = jnp.asarray(value / total)
        whole = jnp.broadcast_to(jnp.asarray(penalty, mean.dtype), mean.shape)
        score = Score(mean, smooth / total + whole, whole, feasible & jnp.isfinite(mean))
        return objectives.worthless(score, lost)

    def ratios(self, values: Array | np.ndarray, term: RobustTerm) -> tuple[Array, Array]:
        """Return mean and worst of a metric (members, ...), relative to pd's: above 1 is worse."""
        return self._ratios(jnp.asarray(values), term, term.mean, term.worst)

    def _worst(self, values: Array, *, larger_is_better: bool = False) -> Array:
        return jnp.asarray(ensembles.worst_mean(values, self.worst.share, larger_is_better=larger_is_better, numpy=jnp))

    def _ratios(self, values: Array, term: RobustTerm, mean: float, worst: float) -> tuple[Array, Array]:
        """Return mean and worst relative to pd's, smaller is better."""
        larger = term.larger_is_better
        of_mean, of_worst = values.mean(0) / mean, self._worst(values, larger_is_better=larger) / worst
        return (2 - of_mean, 2 - of_worst) if larger else (of_mean, of_worst)

    def _mixed(self, mean: Array, worst: Array) -> Array:
        return (1 - self.worst.weight) * mean + self.worst.weight * worst


def objective(
    scenario: mc.Scenario,
    search: Search,
    ensemble: Ensemble,
    baseline: Mapping[str, np.ndarray],
    metrics: mc.MetricTable = mc.METRICS,
) -> RobustObjective:
    """Return the robust objective that the settings ask for.

    Arguments:
        scenario: gives the holding limit.
        search: weights and limits.
        ensemble: how the worst members count.
        baseline: metrics (members,) of pd with their smooth companions, see `pd_of`.
        metrics: what may be weighed and limited.

    Raises:
        ConfigError: pd diverges in a member, or has no value of a metric that is weighed.
    """
    terms = []
    for metric, weight in search.weights.items():
        if not weight:
            continue
        larger = metrics[metric].larger_is_better
        numbers = [
            float(value)
            for values in (baseline[metric], baseline.get(PREFIX + metric, baseline[metric]))
            for value in (values.mean(), ensembles.worst_mean(values, ensemble.worst.share, larger_is_better=larger))
        ]
        if np.any(baseline["diverged"]):
            raise ConfigError(f"weights.{metric}: expected a metric that pd has in every member, got one that diverges")
        if not (np.isfinite(numbers).all() and all(numbers)):
            raise ConfigError(
                f"weights.{metric}: expected a metric that pd has in every member, got {numbers[0]:g} in the mean"
            )
        terms.append(RobustTerm(metric, weight, larger, *numbers))
    # every member has the widest limit of pd's: a deviation that one member forces on pd is not asked of another
    widest = {name: float(values.max()) for name, values in baseline.items()}
    plain = objectives.objective(
        scenario, search.model_copy(update={"no_worse_than_pd": False}), widest, metrics=metrics
    )
    margin = objectives.PD_MARGIN if search.no_worse_than_pd else None
    return RobustObjective(tuple(terms), plain.limits, ensemble.worst, margin)


def pd_of(scenario: mc.Scenario, parameters: mc.Parameters, **walks: Any) -> dict[str, np.ndarray]:
    """Return what a search sees of pd in the walks of some parameters (leading batch axes): in float32.

    `walks` are metrics and engine, as of `mjx_climb.rollout_metrics`.
    """
    ones = np.ones(6)
    gains = mc.Gains(ones, ones, ones)
    return mc.rollout_metrics(under_pd(scenario), gains, parameters, dtype=np.float32, smooth=True, **walks)


def settled(settings: Search | None, changes: Mapping[str, Any], ensemble: Ensemble) -> Search:
    """Return settings with some keys replaced; without any, those of a robust search.

    The joint loop is searched where the ensemble has hardware and the settings do not say.

    Raises:
        ConfigError: settings that make no sense.
    """
    own = {} if settings is not None else {"weights": ROBUST_WEIGHTS}
    settings = (settings or Search()).changed({**own, **changes})
    if settings.joint_gains is not None or ensemble.hardware is None:
        return settings
    return settings.model_copy(update={"joint_gains": True})


def problem_of(
    scenario: mc.Scenario,
    ensemble: Ensemble,
    settings: Search,
    *,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
) -> Problem:
    """Return what a search over an ensemble searches; pd walks through the members first.

    Raises:
        ConfigError: see `objective`, and settings that make no sense for the scenario.
    """
    table, drawn = tune.complete(metrics), ensembles.draw(scenario, ensemble)
    search_settings.check_metrics(settings, table)
    each = pd_of(scenario, drawn, engine=engine, metrics=table)
    goal = objective(scenario, settings, ensemble, {name: value.reshape(-1) for name, value in each.items()}, table)
    problem = tune.problem_of(scenario, settings, goal, law=law, metrics=table, engine=engine)
    return dataclasses.replace(
        problem, parameters=drawn, members=ensemble.members, ensemble=ensemble, own_objective=None
    )  # fmt: skip


def broken(walks: xr.Dataset, goal: RobustObjective) -> xr.DataArray:
    """Return the share of walks that break each limit of a search, dimensions (`limit` in words, `gains`).

    A walk that diverged breaks every limit.
    """
    shares, words = [], []
    for limit in goal.limits:
        kept = objectives.violation(limit, walks[limit.metric].values.astype(float)) <= 0
        shares.append((~kept | walks["diverged"].values.astype(bool)).mean(1))
        words.append(objectives.in_words(limit))
    about = {"units": "1", "long_name": "share of walks that break the limit"}
    values = np.reshape(shares, (len(words), walks.sizes["gains"]))
    return xr.DataArray(values, {"limit": words, "gains": walks["gains"].values}, ("limit", "gains"), attrs=about)


def scores(walks: xr.Dataset, goal: RobustObjective) -> xr.DataArray:
    """Return what gains are worth over the walks of a draw, (`gains`): 1 for pd on the same walks."""
    rows = {str(name): walks[name].values for name in walks.data_vars if walks[name].ndim == 2}
    pd = {name: values[-1] for name, values in rows.items()}
    terms = []
    for term in goal.terms:
        worst = ensembles.worst_mean(pd[term.metric], goal.worst.share, larger_is_better=term.larger_is_better)
        mean, worst = float(pd[term.metric].mean()), float(worst)
        terms.append(term._replace(mean=mean, worst=worst, smooth_mean=mean, smooth_worst=worst))
    fresh = dataclasses.replace(goal, terms=tuple(terms))
    value = np.asarray(fresh.score({name: jnp.asarray(values.T) for name, values in rows.items()}).value)
    return xr.DataArray(value, {"gains": walks["gains"].values}, attrs={"units": "1", "long_name": "objective"})


def binding(seen: xr.Dataset, goal: RobustObjective, name: str) -> list[str]:
    """Return in words which limits hold gains where they are: kept in every member, but hardly in one.

    `seen` are the walks of the members that the search walked.
    """
    own = seen.sel(gains=name)
    rows = {str(key): own[key].values.astype(float) for key in seen.data_vars}
    if rows["diverged"].any():
        return []
    held = []
    for limit in goal.limits:
        worst = float(np.max(objectives.violation(limit, rows[limit.metric])))
        if -objectives.BINDING * limit.margin <= worst <= 0:
            held.append(objectives.in_words(limit))
    if goal.margin is None:
        return held
    for term in goal.terms:
        ratios = goal.ratios(rows[term.metric], term)
        for ratio, words in zip(ratios, ("mean", f"mean of the worst {goal.worst.share:.0%}"), strict=True):
            if 1 - objectives.BINDING * goal.margin <= float(ratio) <= 1:
                held.append(f"{words} of {mc.METRICS.in_words(term.metric)} no worse than pd's")
    return held
