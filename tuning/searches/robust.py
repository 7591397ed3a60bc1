"""Robust tuning: gains for an ensemble of walks, judged on a draw that the search never saw."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array

import mjx_climb as mc
from mjx_climb.compilation.cache import enable_cache
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.files import dataset
from mjx_climb.rollouts.given import AnyGains
from mjx_climb.rollouts.rollout import given_in
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import FAILURES, PREFIX
from tuning.problem import ensemble as ensembles
from tuning.problem import objectives
from tuning.problem import search as search_settings
from tuning.problem.ensemble import Ensemble, Worst
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Limit, Metrics, Score
from tuning.problem.search import WEIGHTS, Search
from tuning.searches import tune
from tuning.searches.result import Result

ROBUST_WEIGHTS = {**WEIGHTS, "peak_pull_force": 1.0}
JUDGED_SHARE = 0.05  # of the members of the unseen draw: "the worst 5 %"
FRESH_SEED = 1_000_003  # added to the ensemble's own for the draw that judges
CHUNK = 128  # members at a time


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
        """Judge metrics (members, B) and return scores (B,)."""
        value: Array | float = 0.0
        smooth: Array | float = 0.0
        penalty: Array | float = 0.0
        total, lost = 0.0, metrics["diverged"].any(0)
        feasible = ~lost
        for term in self.terms:
            ratios = self._ratios(metrics[term.metric], term, term.mean, term.worst)
            name = PREFIX + term.metric if PREFIX + term.metric in metrics else term.metric
            soft = (
                ratios
                if name == term.metric
                else self._ratios(metrics[name], term, term.smooth_mean, term.smooth_worst)
            )
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
        smooth = baseline.get(PREFIX + metric, baseline[metric])
        worst = [ensembles.worst_mean(v, ensemble.worst.share, larger_is_better=larger) for v in (smooth, smooth)]
        worst[0] = ensembles.worst_mean(baseline[metric], ensemble.worst.share, larger_is_better=larger)
        numbers = [float(v) for v in (baseline[metric].mean(), worst[0], smooth.mean(), worst[1])]
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


def pd_of(
    scenario: mc.Scenario,
    numbers: mc.Parameters,
    *,
    engine: str = DEFAULT_ENGINE,
    metrics: mc.MetricTable = mc.METRICS,
) -> dict[str, np.ndarray]:
    """Return what a search sees of pd in the walks that `numbers` (with leading batch axes) holds; see `_walked`."""
    pd = scenario.with_overrides({"control.controller": "pd", "control.reading": "virtual_model"})
    ones = np.ones(6)
    return _walked(pd, mc.Gains(ones, ones, ones), numbers, engine, metrics)


def _walked(
    scenario: mc.Scenario,
    gains: AnyGains,
    numbers: mc.Parameters,
    engine: str,
    metrics: mc.MetricTable,
    law: mc.Law | None = None,
) -> dict[str, np.ndarray]:
    """Return metrics and their smooth companions with nothing torn off, in float32, with the batch axes."""
    enable_cache()
    gains, numbers = jax.tree.map(lambda value: np.asarray(value, np.float32), (gains, numbers))
    walks = math.prod(given_in(scenario, law, gains, numbers, np.float32).shape)
    in_pieces = mc.pieces_pay(engine)
    simulate = jax.jit(
        mc.simulator(scenario, metrics=metrics, law=law, engine=engine, smooth=True, in_pieces=in_pieces),
        compiler_options=mc.compiler_options(walks, in_pieces=in_pieces),
    )
    return {name: np.asarray(value) for name, value in simulate(gains, numbers).items()}


def search(
    scenario: mc.Scenario,
    ensemble: Ensemble,
    settings: Search | None = None,
    *,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
    out: Path | None = None,
    progress: Callable[[tune.Progress], None] | None = None,
    **changes: Any,
) -> Result:
    """Search the gains that do best over an ensemble; `tuning.tune.tune` with its walks and the robust objective.

    Where no weights are given, those of a plain search and the peak pulling force count alike.
    """
    settings = settled(settings, changes)
    problem = problem_of(scenario, ensemble, settings, metrics=metrics, law=law, engine=engine)
    return tune.run(problem, settings, out=out, progress=progress)


def settled(settings: Search | None, changes: Mapping[str, Any]) -> Search:
    """Return settings with some keys replaced; without any, those of a robust search.

    Raises:
        ConfigError: settings that make no sense.
    """
    if settings is None:
        changes = {"weights": ROBUST_WEIGHTS, **changes}
    return tune.changed(settings, changes)


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
    table, numbers = tune.complete(metrics), ensembles.draw(scenario, ensemble)
    search_settings.check_metrics(settings, table)
    walked = pd_of(scenario, numbers, engine=engine, metrics=table)
    pd = {name: value.reshape(-1) for name, value in walked.items()}
    target = objective(scenario, settings, ensemble, pd, table)
    return tune.problem_of(scenario, settings, target, numbers, engine, law=law, metrics=table)


def judge(
    scenario: mc.Scenario,
    gains: Mapping[str, AnyGains],
    ensemble: Ensemble,
    *,
    members: int = 128,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Walk several gains, and pd, through a fresh draw.

    Nothing is torn off, so that every walk counts to its end; where the peak pulling force passes the holding limit a
    gripper would have let go, see `failed`.

    Arguments:
        scenario: what walks where, under an admittance law.
        gains: by name.
        ensemble: drawn again with another seed.
        members: walks of each.
        metrics: what the walks are judged by, as `mjx_climb.METRICS + (mine,)`.
        law: whose gains they are, where it is not the scenario's.
        engine: the dynamics.
        progress: called with walks done and in all.

    Returns:
        Every metric of every walk, dimensions (`gains`, `member`): the names, and `pd` last; with what was drawn.
    """
    fresh = ensemble.model_copy(update={"members": members, "seed": ensemble.seed + FRESH_SEED})
    numbers = ensembles.draw(scenario, fresh)
    table = tune.complete(metrics)
    whole = [given_in(scenario, law, g, None, np.float64).law for g in gains.values()]
    stacked = {name: np.stack([getattr(each, name) for each in whole]) for name in whole[0].GAINS}
    total, parts = members * (len(gains) + 1), []
    for start in range(0, members, CHUNK):
        rows = {n: v[start : start + CHUNK] if v.shape[:1] == (members,) else v for n, v in vars(numbers).items()}
        part = mc.Parameters(**rows)
        walked = _walked(scenario, stacked, part, engine, table, law)
        both = walked, pd_of(scenario, part, engine=engine, metrics=table)
        parts.append({name: np.concatenate([v[name] for v in both], axis=1) for name in table.names})
        if progress is not None:
            progress(min(start + CHUNK, members) * (len(gains) + 1), total)
    data: dict[str, Any] = {
        metric.name: (
            ("gains", "member"),
            np.concatenate([part[metric.name] for part in parts]).T,
            dataset.metric_attributes(metric),
        )
        for metric in table
    }
    drawn = {
        "cargo_mass": (numbers.cargo_mass, "kg", "mass of the cargo"),
        "contact_stiffness": (numbers.contact_stiffness, "N/m", "contact stiffness"),
        "mass_scale": (numbers.mass_scale, "1", "scale of the robot's masses and inertias"),
        "gravity": (np.linalg.norm(numbers.gravity, axis=-1), "m/s^2", "gravity"),
        "largest_push": (np.linalg.norm(numbers.push_force, axis=-1).max(-1, initial=0.0), "N", "largest push"),
    }
    for name, (values, units, text) in drawn.items():
        values = np.broadcast_to(np.reshape(values, -1), members)
        data[name] = ("member", values, {"units": units, "long_name": text})
    attrs: dict[str, Any] = {"title": "gains judged on a draw that no search saw", **dataset.provenance(scenario)}
    attrs["ensemble"] = fresh.to_yaml()
    attrs["holding_limit"] = np.inf if scenario.contact.holding_limit is None else scenario.contact.holding_limit
    return xr.Dataset(data, {"gains": [*gains, "pd"], "member": np.arange(members)}, attrs)


def failed(judged: xr.Dataset) -> xr.DataArray:
    """Return which walks would lose a gripper, or diverge, dimensions (`gains`, `member`)."""
    lost: xr.DataArray = judged["peak_pull_force"] > judged.attrs["holding_limit"]
    return lost | judged["diverged"].astype(bool)


def summary(judged: xr.Dataset, share: float = JUDGED_SHARE) -> xr.Dataset:
    """Return mean and worst of every metric, dimensions (`statistic`, `gains`), and the share of walks that failed.

    Both are over the members in which nothing diverged; the worst is the mean over the worst `share` of them, for each
    metric by itself. `failed` is the share of all members.

    Raises:
        ValueError: some gains diverge in each member.
    """
    held = judged.isel(member=~judged["diverged"].astype(bool).any("gains").values)
    if not held.sizes["member"]:
        raise ValueError("expected a member of the draw in which nothing diverges, got none")
    data: dict[str, Any] = {}
    for name in [str(n) for n, v in judged.data_vars.items() if "larger_is_better" in v.attrs and n not in FAILURES]:
        values = held[name].transpose("member", "gains").values.astype(float)
        worst = ensembles.worst_mean(values, share, larger_is_better=dataset.larger_is_better(judged[name]))
        data[name] = (("statistic", "gains"), np.stack([values.mean(0), worst]), judged[name].attrs)
    about = {"units": "1", "long_name": "share of walks that lose a gripper or diverge"}
    data["failed"] = ("gains", failed(judged).mean("member").values, about)
    attrs = {**judged.attrs, "worst_share": share, "members_compared": held.sizes["member"]}
    return xr.Dataset(data, {"statistic": ["mean", "worst"], "gains": judged["gains"].values}, attrs)
