"""The objective of a search: weighted metrics relative to pd's, and smooth penalties for constraints.

Three numbers per point. `value` is reported and ranked: the weighted mean of the metrics, each relative to
its value under pd (1 for pd itself), with true extremes. Gradients follow `descent`: the same with smooth
extremes, plus the penalty. `feasible` says whether every constraint holds.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jax import Array

import mjx_climb as mc
from mjx_climb.arrays import AnyArray, namespace
from mjx_climb.inputs.own_objects import in_one_line
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import PREFIX
from tuning.problem.ensemble import Worst, worst_mean
from tuning.problem.search import LOST, Search

Metrics = Mapping[str, Array]

_PENALTY = 100.0
_BEND = 0.1
_MARGIN = 0.02  # relative: where the penalty of a limit begins, inside it
PD_MARGIN = 0.005
BINDING = 1.25  # margins of a limit: as near to it, the limit holds the search there


class Score(NamedTuple):
    """The scores of points, (...) each."""

    value: Array | np.ndarray
    descent: Array | np.ndarray
    penalty: Array | np.ndarray  # with true extremes
    feasible: Array | np.ndarray  # bool


class Term(NamedTuple):
    """A metric to better, relative to its value under pd: one for all points, or one for each row of a batch."""

    metric: str
    weight: float
    baseline: float | tuple[float, ...]  # over an ensemble the mean
    smooth_baseline: float | tuple[float, ...]
    larger_is_better: bool = False
    worst: float = 1.0  # mean of pd's worst members, of an ensemble alone
    smooth_worst: float = 1.0


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
    """The score of points."""

    @property
    def limits(self) -> tuple[Limit, ...]:
        """Limits that no metric may pass."""

    def score(self, metrics: Metrics) -> Score:
        """Return the scores of points by their metrics."""


OwnObjective = Callable[[Metrics], Array] | Goal  # of a user: a function in place of the terms, or all of it


@dataclasses.dataclass(frozen=True)
class Objective:
    """Terms and limits, or the user's own function in place of the terms.

    `function` maps a mapping of metrics (those of the walks and their smooth companions, arrays of any shape) to an
    array of that shape, by operations of jax.numpy.

    With `worst` the metrics are those of an ensemble (members, B), and the scores (B,): of each term the mean and the
    mean over the worst members count, each relative to pd's. Limits hold for every member; the penalty is that of the
    worst members. Where a term is `LOST`, members that lose a gripper count by it and break no limit.
    """

    terms: tuple[Term, ...]
    limits: tuple[Limit, ...]
    function: Callable[[Metrics], Array] | None = None
    worst: Worst | None = None
    margin: float | None = None  # relative; no ratio of a term may be above 1 less this; None: they may
    reference: float = 1.0  # value of pd

    @property
    def weighs_lost(self) -> bool:
        """Whether members that lose a gripper count by their number."""
        return any(term.metric == LOST for term in self.terms)

    @np.errstate(all="ignore")  # of walks that diverged
    def score(self, metrics: Metrics) -> Score:
        """Score points by their metrics, arrays of JAX or NumPy; NaN and infeasible where the walk diverged."""
        if self.weighs_lost:
            metrics = {**metrics, LOST: lost(metrics)}
        ratios = [self.ratios(metrics[term.metric], term) for term in self.terms]
        if self.function is not None:
            value = smooth = self.function(_with_companions(metrics))
        else:
            value, smooth = self._weighted(ratios), self._weighted(self._smooth_ratios(metrics, ratios))
        xp = namespace(value)
        penalty, feasible = xp.zeros_like(value), xp.isfinite(value)
        if self.margin is not None:
            for ratio in itertools.chain.from_iterable(ratios):
                penalty = penalty + penalty_of(ratio - 1 + self.margin)
                feasible = feasible & (ratio <= 1)
        for limit in self.limits:
            slack = violation(limit, metrics[limit.metric])
            if self.weighs_lost:
                # searches walk on without tearing a gripper off: how such a walk ends says nothing
                slack = xp.where(metrics[LOST] > 0, -1.0, slack)
            over, kept = penalty_of(slack + limit.margin), slack <= 0
            penalty = penalty + (over if self.worst is None else worst_mean(over, self.worst.share))
            feasible = feasible & (kept if self.worst is None else kept.all(0))
        diverged = metrics["diverged"] if self.worst is None else metrics["diverged"].any(0)
        number = xp.where(diverged, xp.nan, xp.ones_like(value))  # for derivatives too
        value, descent, penalty = (xp.asarray(part * number) for part in (value, smooth + penalty, penalty))
        return Score(value, descent, penalty, feasible & ~diverged)

    def ratios(self, values: Array, term: Term, *, smooth: bool = False) -> tuple[Array, ...]:
        """Return a metric relative to pd's, above 1 is worse: of an ensemble (members, ...) mean and worst."""
        larger, mean = term.larger_is_better, values if self.worst is None else values.mean(0)
        found = [mean / _by_row(term.smooth_baseline if smooth else term.baseline)]
        if self.worst is not None:
            worst = worst_mean(values, self.worst.share, larger_is_better=larger)
            found.append(worst / (term.smooth_worst if smooth else term.worst))
        return tuple(2 - ratio if larger else ratio for ratio in found)

    def _smooth_ratios(self, metrics: Metrics, ratios: list[tuple[Array, ...]]) -> list[tuple[Array, ...]]:
        """Return the ratios of terms with those of smooth companions in place of their own, where there are some."""
        return [
            self.ratios(metrics[PREFIX + term.metric], term, smooth=True) if PREFIX + term.metric in metrics else own
            for term, own in zip(self.terms, ratios, strict=True)
        ]

    def _weighted(self, ratios: list[tuple[Array, ...]]) -> AnyArray:
        total: AnyArray = 0.0
        for term, (ratio, *worst) in zip(self.terms, ratios, strict=True):
            if self.worst is not None:
                ratio = (1 - self.worst.weight) * ratio + self.worst.weight * worst[0]
            total = total + term.weight * ratio
        return namespace(total).asarray(total / sum(term.weight for term in self.terms))


NO_OBJECTIVE = Objective((), ())


def lost(metrics: Any) -> Any:
    """Return 1.0 for walks that lose a gripper, diverge or stand for want of a grip, else 0.0, as the metrics are.

    A grip is lost where it uses more than its limit, for any contact, hold and drawn limit.
    """
    used = metrics["peak_utilization"]
    stands = metrics["stands_at"] >= 0 if "stands_at" in metrics else False
    return ((used > 1) | (metrics["diverged"] > 0) | stands).astype(used.dtype)


def penalty_of(over: Array | np.ndarray) -> AnyArray:
    """Return 0 inside, a parabola just outside, a straight line of slope 10 far outside."""
    over = namespace(over).maximum(over, 0.0)
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
    search: Search,
    baseline: Mapping[str, Any],
    function: Callable[[Metrics], Array] | None = None,
    metrics: mc.MetricTable = mc.METRICS,
    worst: Worst | None = None,
) -> Objective:
    """Return the objective that the settings ask for.

    Arguments:
        search: weights and limits of `metrics`.
        baseline: metrics of pd with their smooth companions, see `tuning.problem.evaluation.baseline`; over an ensemble
            those of its members, (members,) each.
        function: the user's own in place of the weighted terms.
        worst: how the worst members of an ensemble count, where there is one.

    Raises:
        ConfigError: pd diverges, or has no value of a metric that is weighed; the user's function fails.
    """
    weighed = {} if function is not None else {name: weight for name, weight in search.weights.items() if weight}
    if LOST in weighed:
        baseline = {**baseline, LOST: lost(baseline)}
    terms = tuple(
        _term(name, weight, baseline, worst, larger_is_better=name != LOST and metrics[name].larger_is_better)
        for name, weight in weighed.items()
    )
    # every member has the widest limit of pd's: a deviation that one member forces on pd is not asked of another
    widest, factor = float(np.max(baseline["base_deviation"])), search.deviation_factor
    wanted = [("joint_limit_margin", 0.0, "joint limits")]
    if LOST not in weighed:
        wanted.append(("peak_utilization", 1.0, "limit of the grips"))
    if np.isfinite(widest):
        wanted.append(("base_deviation", factor * widest, f"{factor:g} times pd's"))
    asked = [(*limit, _MARGIN) for limit in wanted if limit[0] not in search.limits]
    asked += [(name, value, "set by the user", _MARGIN) for name, value in search.limits.items()]
    if search.no_worse_than_pd and worst is None:
        own = [term.metric for term in terms if term.metric not in search.limits]
        asked += [(name, float(baseline[name]), "no worse than pd", PD_MARGIN) for name in own]
    limits = []
    for name, value, reason, margin in asked:
        metric, size = metrics[name], abs(value)
        scale = max(metric.scale or size or 1.0, size)
        limits.append(Limit(name, value, scale, margin, reason, metric.larger_is_better))
    ratio_margin = PD_MARGIN if search.no_worse_than_pd and worst is not None else None
    reference = 1.0 if function is None else _of_pd(function, baseline)
    return Objective(terms, tuple(limits), function, worst, ratio_margin, reference)


def _with_companions(metrics: Metrics) -> Metrics:
    """Return metrics with themselves as smooth companions where they have none, as those of a walk alone."""
    return {PREFIX + name: each for name, each in metrics.items()} | {**metrics}


def _of_pd(function: Callable[[Metrics], Array], baseline: Mapping[str, Any]) -> float:
    known = _with_companions({name: jnp.asarray(each) for name, each in baseline.items()})
    with in_one_line("objective"):
        value = function(known)
    shape = np.broadcast_shapes(*map(np.shape, known.values()))
    if not isinstance(value, Array) or value.shape != shape:
        got = f"shape {np.shape(value)}" if isinstance(value, Array) else repr(value)
        raise ConfigError("", "objective", f"an array made of metrics, shape {shape} as theirs", got)
    if not np.isfinite(value).all():
        raise ConfigError("", "objective", "a number of pd's walk", value)
    return float(value.mean())


def _term(
    name: str, weight: float, baseline: Mapping[str, Any], worst: Worst | None, *, larger_is_better: bool
) -> Term:
    both = [baseline[name], baseline.get(PREFIX + name, baseline[name])]
    numbers = both if worst is None else [float(values.mean()) for values in both]
    if worst is not None:
        numbers += [float(worst_mean(values, worst.share, larger_is_better=larger_is_better)) for values in both]
    diverged = np.any(baseline["diverged"])
    if diverged or not (np.isfinite(numbers).all() and all(numbers)):
        where, of = ("here", "under pd") if worst is None else ("in every member", "in the mean")
        got = "a walk that diverges under pd" if diverged else f"{numbers[0]:g} {of}"
        raise ConfigError("", f"weights.{name}", f"a metric that pd has {where}", got)
    fields = ("baseline", "smooth_baseline", "worst", "smooth_worst")
    return Term(name, weight, larger_is_better=larger_is_better, **dict(zip(fields, numbers, strict=False)))
