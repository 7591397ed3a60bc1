"""What a search minimises: weighted metrics relative to pd's, and smooth penalties for constraints.

Three numbers per point. `value` is what is reported and ranked: the weighted mean of the metrics, each relative to
its value under pd (1 for pd itself), with true extremes. `descent` is what gradients follow: the same with smooth
extremes, plus the penalty. `feasible` says whether every constraint holds.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jax import Array

import mjx_climb as mc
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import PREFIX
from tuning.problem.search import Search

Metrics = Mapping[str, Array]

_PENALTY = 100.0
_BEND = 0.1
_MARGIN = 0.02  # relative: where the penalty of a limit begins, inside it
PD_MARGIN = 0.005
BINDING = 1.25  # margins of a limit: as near to it, it is what holds a search there


class Score(NamedTuple):
    """What points are worth, (...) each."""

    value: Array | np.ndarray
    descent: Array | np.ndarray
    penalty: Array | np.ndarray  # with true extremes
    feasible: Array | np.ndarray  # bool


class Term(NamedTuple):
    """A metric to better, relative to its value under pd: one for all points, or one for each row of a batch."""

    metric: str
    weight: float
    baseline: float | tuple[float, ...]
    smooth_baseline: float | tuple[float, ...]
    larger_is_better: bool = False


class Limit(NamedTuple):
    """A metric that may not pass a value, or one for each row; a penalty begins `margin` (of `scale`) before it."""

    metric: str
    value: float | tuple[float, ...]
    scale: float | tuple[float, ...]
    margin: float
    reason: str
    larger_is_better: bool = False


@runtime_checkable
class Goal(Protocol):
    """What points are scored by."""

    @property
    def limits(self) -> tuple[Limit, ...]:
        """What no metric may pass."""

    def score(self, metrics: Metrics) -> Score:
        """Return what points are worth by their metrics."""


OwnObjective = Callable[[Metrics], Array] | Goal  # what a user may give: a function in place of the terms, or all of it


@dataclasses.dataclass(frozen=True)
class Objective:
    """Terms and limits, or the user's own function in place of the terms.

    `function` maps a mapping of metrics (those of the walks and their smooth companions, arrays of any shape) to an
    array of that shape, by operations of jax.numpy.
    """

    terms: tuple[Term, ...]
    limits: tuple[Limit, ...]
    function: Callable[[Metrics], Array] | None = None

    def score(self, metrics: Metrics) -> Score:
        """Score points by their metrics; NaN and infeasible where the walk diverged."""
        if self.function is not None:
            value = smooth = self.function(metrics)
        else:
            value, smooth = self._weighted(metrics, smooth=False), self._weighted(metrics, smooth=True)
        slacks = [violation(limit, metrics[limit.metric]) for limit in self.limits]
        pairs = zip(self.limits, slacks, strict=True)
        penalty = sum((penalty_of(slack + limit.margin) for limit, slack in pairs), jnp.zeros_like(value))
        feasible = jnp.isfinite(value)
        for slack in slacks:
            feasible &= slack <= 0
        return worthless(Score(value, smooth + penalty, penalty, feasible), metrics["diverged"])

    def _weighted(self, metrics: Metrics, *, smooth: bool) -> Array:
        total: Array | float = 0.0
        weights = 0.0
        for term in self.terms:
            name = PREFIX + term.metric if smooth and PREFIX + term.metric in metrics else term.metric
            baseline = term.baseline if name == term.metric else term.smooth_baseline
            ratio = metrics[name] / _by_row(baseline)
            total += term.weight * (2 - ratio if term.larger_is_better else ratio)
            weights += term.weight
        return jnp.asarray(total / weights)


NO_OBJECTIVE = Objective((), ())


def worthless(score: Score, lost: Array) -> Score:
    """Return a score, with its derivatives, NaN and infeasible where `lost` (...) is true."""
    number = jnp.where(lost, jnp.nan, jnp.ones_like(score.value))
    value, descent, penalty = (jnp.asarray(part * number) for part in score[:3])
    return Score(value, descent, penalty, score.feasible & ~lost)


def penalty_of(over: Array | np.ndarray) -> Array:
    """Return 0 inside, a parabola just outside, a straight line of slope 10 far outside."""
    over = jnp.maximum(over, 0.0)
    return _PENALTY * over**2 / (1 + over / _BEND)


def violation(limit: Limit, value: Array | np.ndarray) -> Array | np.ndarray:
    """Return by how much a limit is passed, relative to its scale; negative inside."""
    over = value - _by_row(limit.value)
    return (-over if limit.larger_is_better else over) / _by_row(limit.scale)


def in_words(limit: Limit) -> str:
    """Return "base deviation at most 0.005 (set by the user)"."""
    value = np.asarray(limit.value)
    text = f"{value:.4g}" if value.ndim == 0 else f"{value.min():.4g} to {value.max():.4g}"
    end = "least" if limit.larger_is_better else "most"
    return f"{mc.METRICS.in_words(limit.metric)} at {end} {text} ({limit.reason})"


def _by_row(value: float | tuple[float, ...]) -> float | np.ndarray:
    return np.asarray(value) if isinstance(value, tuple) else value


def objective(
    scenario: mc.Scenario,
    search: Search,
    baseline: Mapping[str, float],
    function: Callable[[Metrics], Array] | None = None,
    metrics: mc.MetricTable = mc.METRICS,
) -> Objective:
    """Return the objective that the settings ask for.

    Arguments:
        scenario: gives the holding limit.
        search: weights and limits.
        baseline: metrics of pd with their smooth companions, see `tuning.problem.evaluation.baseline`.
        function: the user's own in place of the weighted terms.
        metrics: what may be weighed and limited.

    Raises:
        ConfigError: pd diverges, or has no value of a metric that is weighed.
    """
    terms = []
    for metric, weight in search.weights.items():
        if not weight or function is not None:
            continue
        smooth = baseline.get(PREFIX + metric, baseline[metric])
        has_none = not (np.isfinite([baseline[metric], smooth]).all() and baseline[metric] and smooth)
        if baseline["diverged"] or has_none:
            got = "a walk that diverges" if baseline["diverged"] else f"{baseline[metric]:g}"
            raise ConfigError(f"weights.{metric}: expected a metric that pd has here, got {got} under pd")
        terms.append(Term(metric, weight, baseline[metric], smooth, metrics[metric].larger_is_better))
    limits: list[Limit] = []

    def limit(metric: str, value: float, margin: float, reason: str) -> None:
        about = metrics[metric]
        scale = about.scale or abs(value) or 1.0
        limits.append(Limit(metric, float(value), max(scale, abs(value)), margin, reason, about.larger_is_better))

    standard = {"joint_limit_margin": (0.0, "joint limits")}
    if scenario.contact.holding_limit is not None:
        standard["peak_pull_force"] = (scenario.contact.holding_limit, "holding limit of the grippers")
    if np.isfinite(baseline["base_deviation"]):
        factor = search.deviation_factor
        standard["base_deviation"] = (factor * baseline["base_deviation"], f"{factor:g} times pd's")
    for metric, (value, reason) in standard.items():
        if metric not in search.limits:
            limit(metric, value, _MARGIN, reason)
    for metric, value in search.limits.items():
        limit(metric, value, _MARGIN, "set by the user")
    if search.no_worse_than_pd:
        for term in terms:
            if term.metric not in search.limits:
                limit(term.metric, baseline[term.metric], PD_MARGIN, "no worse than pd")
    return Objective(tuple(terms), tuple(limits), function)
