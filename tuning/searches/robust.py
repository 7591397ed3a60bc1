"""Robust tuning: gains for an ensemble of walks, judged on a draw that the search never saw."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array

import mjx_climb as mc
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
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.objectives import Limit, Metrics, Score
from tuning.problem.search import WEIGHTS, Search
from tuning.searches import tune

ROBUST_WEIGHTS = {**WEIGHTS, "peak_pull_force": 1.0}
JUDGED_SHARE = 0.05  # of the members of the unseen draw: "the worst 5 %"
FRESH_SEED = 1_000_003  # added to the ensemble's own for the draw that judges


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
            ratios = self.ratios(metrics[term.metric], term)
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
    """Return what a search sees of pd in the walks that `numbers` (with leading batch axes) holds: in float32."""
    ones = np.ones(6)
    pd = under_pd(scenario)
    return mc.rollout_metrics(
        pd, mc.Gains(ones, ones, ones), numbers, metrics=metrics, dtype=np.float32, engine=engine, smooth=True
    )


def settled(settings: Search | None, changes: Mapping[str, Any], ensemble: Ensemble) -> Search:
    """Return settings with some keys replaced; without any, those of a robust search.

    The joint loop is searched where the ensemble has hardware and the settings do not say.

    Raises:
        ConfigError: settings that make no sense.
    """
    if settings is None:
        changes = {"weights": ROBUST_WEIGHTS, **changes}
    settings = tune.changed(settings, changes)
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
    table, numbers = tune.complete(metrics), ensembles.draw(scenario, ensemble)
    search_settings.check_metrics(settings, table)
    each = pd_of(scenario, numbers, engine=engine, metrics=table)
    pd = {name: value.reshape(-1) for name, value in each.items()}
    target = objective(scenario, settings, ensemble, pd, table)
    return tune.problem_of(scenario, settings, target, numbers, engine, law=law, metrics=table)


def judge(
    scenario: mc.Scenario,
    gains: Mapping[str, AnyGains],
    ensemble: Ensemble,
    *,
    members: int = 128,
    pd: Mapping[str, AnyGains] = MappingProxyType({}),
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
        gains: by name; with those of the joint loop, where they are the scenario's own.
        ensemble: drawn again with another seed.
        members: walks of each.
        pd: further gains of the joint loop under pd, by name: `kp` and `kd`.
        metrics: what the walks are judged by, as `mjx_climb.METRICS + (mine,)`.
        law: whose gains they are, where it is not the scenario's.
        engine: the dynamics.
        progress: called with walks done and in all.

    Returns:
        Every metric of every walk over `gains` (the names, those of `pd`, and `pd` last) and `member`; with what was
        drawn.
    """
    return walked(
        scenario, gains, fresh(ensemble, members), pd=pd, metrics=metrics, law=law, engine=engine, progress=progress
    )


def fresh(ensemble: Ensemble, members: int) -> Ensemble:
    """Return the ensemble whose members no search of the given one has seen."""
    return ensemble.model_copy(update={"members": members, "seed": ensemble.seed + FRESH_SEED})


def walked(
    scenario: mc.Scenario,
    gains: Mapping[str, AnyGains],
    ensemble: Ensemble,
    *,
    pd: Mapping[str, AnyGains] = MappingProxyType({}),
    metrics: Iterable[mc.Metric] = mc.METRICS,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Walk several gains, and pd, through the members of an ensemble; see `judge`."""
    numbers, table = ensembles.draw(scenario, ensemble), tune.complete(metrics)
    without = under_pd(scenario)
    own = {"kp": scenario.control.kp, "kd": scenario.control.kd}
    kinds = [(scenario, law, dict(gains)), (without, None, {**pd, "pd": own})]
    total = ensemble.members * sum(len(some) for *_, some in kinds)
    parts, done = [], 0
    for place, whose, some in kinds:
        if not some:
            continue

        def told(now: int, _: int, before: int = done) -> None:
            if progress is not None:
                progress(before + now, total)

        how: dict[str, Any] = {"metrics": table, "law": whose, "engine": engine}
        batch = stacked(place, whose, list(some.values()))
        found = mc.rollout_metrics(place, batch, numbers, dtype=np.float32, smooth=True, progress=told, **how)
        parts.append(found)
        done += ensemble.members * len(some)
    arrays = {metric.name: np.concatenate([part[metric.name] for part in parts], axis=1) for metric in table}
    return labelled(scenario, [*gains, *pd, "pd"], ensemble, numbers, arrays, table)


def labelled(
    scenario: mc.Scenario,
    names: Sequence[str],
    ensemble: Ensemble,
    numbers: mc.Parameters,
    arrays: Mapping[str, np.ndarray],
    table: mc.MetricTable,
) -> xr.Dataset:
    """Return metrics (members, gains) of walks through an ensemble with what was drawn, as `judge` does."""
    data: dict[str, Any] = {
        metric.name: (("gains", "member"), arrays[metric.name].T, dataset.metric_attributes(metric)) for metric in table
    }
    for name, (values, units, text) in _drawn(numbers, ensemble).items():
        values = np.broadcast_to(np.reshape(values, -1), ensemble.members)
        data[name] = ("member", values, {"units": units, "long_name": text})
    attrs: dict[str, Any] = {"title": "gains judged over an ensemble", **dataset.provenance(scenario)}
    attrs["ensemble"] = ensemble.to_yaml()
    attrs["holding_limit"] = np.inf if scenario.contact.holding_limit is None else scenario.contact.holding_limit
    return xr.Dataset(data, {"gains": list(names), "member": np.arange(ensemble.members)}, attrs)


def stacked(scenario: mc.Scenario, law: mc.Law | None, gains: list[AnyGains]) -> dict[str, np.ndarray]:
    """Return several gains as one batch (n, ...), by name, the joint loop's among them."""
    each = [given_in(scenario, law, one, None, np.float64) for one in gains]
    values = {name: np.stack([getattr(one.law, name) for one in each]) for name in each[0].law.GAINS}
    return values | {name: np.stack([getattr(one.numbers, name) for one in each]) for name in ("kp", "kd")}


def _drawn(numbers: mc.Parameters, ensemble: Ensemble) -> dict[str, tuple[np.ndarray, str, str]]:
    """Return what is told of each member: values, unit and words."""
    drawn = {
        "cargo_mass": (numbers.cargo_mass, "kg", "mass of the cargo"),
        "contact_stiffness": (numbers.contact_stiffness, "N/m", "contact stiffness"),
        "mass_scale": (numbers.mass_scale, "1", "scale of the robot's masses and inertias"),
        "gravity": (np.linalg.norm(numbers.gravity, axis=-1), "m/s^2", "gravity"),
        "largest_push": (np.linalg.norm(numbers.push_force, axis=-1).max(-1, initial=0.0), "N", "largest push"),
    }
    if ensemble.hardware is None:
        return drawn
    return drawn | {
        "force_delay": (numbers.force_delay, "s", "delay of the force sensors"),
        "command_delay": (numbers.command_delay, "s", "delay of the commands"),
        "control_period": (numbers.control_period, "s", "control period"),
        "force_noise": (numbers.force_noise, "N", "noise of the force sensors"),
        "coulomb_friction": (numbers.coulomb_friction, "N m", "dry friction"),
        "armature": (numbers.armature, "kg m^2", "armature"),
    }


def failed(judged: xr.Dataset) -> xr.DataArray:
    """Return which walks would lose a gripper, or diverge, dimensions (`gains`, `member`)."""
    lost: xr.DataArray = judged["peak_pull_force"] > judged.attrs["holding_limit"]
    return lost | judged["diverged"].astype(bool)


def broken(judged: xr.Dataset, goal: RobustObjective) -> xr.DataArray:
    """Return the share of walks that break each limit of a search, dimensions (`limit` in words, `gains`).

    A walk that diverged breaks every limit.
    """
    shares, words = [], []
    for limit in goal.limits:
        kept = objectives.violation(limit, judged[limit.metric].values.astype(float)) <= 0
        shares.append((~kept | judged["diverged"].values.astype(bool)).mean(1))
        words.append(objectives.in_words(limit))
    about = {"units": "1", "long_name": "share of walks that break the limit"}
    values = np.reshape(shares, (len(words), judged.sizes["gains"]))
    return xr.DataArray(values, {"limit": words, "gains": judged["gains"].values}, ("limit", "gains"), attrs=about)


def scores(judged: xr.Dataset, goal: RobustObjective) -> xr.DataArray:
    """Return what gains are worth over the walks of a draw, (`gains`): 1 for pd on the same walks."""
    rows = {str(name): judged[name].values for name in judged.data_vars if judged[name].ndim == 2}
    pd = {name: values[-1] for name, values in rows.items()}
    terms = []
    for term in goal.terms:
        worst = ensembles.worst_mean(pd[term.metric], goal.worst.share, larger_is_better=term.larger_is_better)
        mean, worst = float(pd[term.metric].mean()), float(worst)
        terms.append(term._replace(mean=mean, worst=worst, smooth_mean=mean, smooth_worst=worst))
    fresh = dataclasses.replace(goal, terms=tuple(terms))
    value = np.asarray(fresh.score({name: jnp.asarray(values.T) for name, values in rows.items()}).value)
    return xr.DataArray(value, {"gains": judged["gains"].values}, attrs={"units": "1", "long_name": "objective"})


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


def summary(judged: xr.Dataset, share: float = JUDGED_SHARE) -> xr.Dataset:
    """Return mean and worst of every metric, dimensions (`statistic`, `gains`), and the share of walks that failed.

    Both are over the members in which nothing diverged; the worst is the mean over the worst `share` of them, for each
    metric by itself. `failed` is the share of all members.

    Raises:
        ConfigError: some gains diverge in each member.
    """
    held = judged.isel(member=~judged["diverged"].astype(bool).any("gains").values)
    if not held.sizes["member"]:
        raise ConfigError("ensemble: expected a member of the draw in which nothing diverges, got none")
    data: dict[str, Any] = {}
    for name in [str(n) for n, v in judged.data_vars.items() if "larger_is_better" in v.attrs and n not in FAILURES]:
        values = held[name].transpose("member", "gains").values.astype(float)
        worst = ensembles.worst_mean(values, share, larger_is_better=dataset.larger_is_better(judged[name]))
        data[name] = (("statistic", "gains"), np.stack([values.mean(0), worst]), judged[name].attrs)
    about = {"units": "1", "long_name": "share of walks that lose a gripper or diverge"}
    data["failed"] = ("gains", failed(judged).mean("member").values, about)
    attrs = {**judged.attrs, "worst_share": share, "members_compared": held.sizes["member"]}
    return xr.Dataset(data, {"statistic": ["mean", "worst"], "gains": judged["gains"].values}, attrs)
