"""A result put to the test: walked alone in double precision, and its neighbours as the search walks."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.inputs.gait_values import GAIT, TIMES
from mjx_climb.walk.metrics import FAILURES
from tuning.comparisons import maps, margins, stability_limit
from tuning.comparisons.margins import Margin
from tuning.methods.gradient import CANDIDATES
from tuning.problem import objectives
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Goal
from tuning.problem.spaces import Space, kind_of
from tuning.results.tuned import Tuned
from tuning.searches.shards import Rows
from tuning.searches.sweep import Grid, default_batch_size

STEP = 0.2  # relative change of a gain
PLATEAU, CLIFF = (
    0.01,
    0.1,
)  # change of the objective, relative to pd's, below which it is flat, above which it breaks off
UNRESPONSIVE = 1e-3  # largest relative change of any metric
GRID = 12  # cells along each axis of the map


@dataclasses.dataclass(frozen=True)
class Verification:
    """Results of the tests; by coordinate of the space, of arrays as a whole, where there is one number per gain."""

    metrics: dict[str, Any]  # of the walk alone, float64, hard detachment
    value: float  # of that walk
    search_value: float
    broken_limits: list[str]  # in words
    binding_limits: list[str]  # kept with hardly any room
    less: dict[str, float | None]  # change of the value with a gain 20 % less; None: infeasible or diverged
    more: dict[str, float | None]
    shape: dict[str, str]  # plateau, slope or cliff
    slopes: dict[str, float]  # of the value per natural logarithm of a gain; none for times of the gait
    grid_value: float | None  # best of an isotropic grid
    grid_gains: dict[str, float] | None
    spectral_radius: float  # of the closed loop in its worst stance; above 1 a small disturbance grows
    margins: dict[str, Margin]  # by quantity of hardware; empty where nobody looked for them
    warnings: list[str]

    @property
    def passed(self) -> bool:
        """Whether the walk alone keeps every limit."""
        return not self.broken_limits


def map_of(found: Tuned, *, progress: Callable[[int, int], None] | None = None) -> xr.Dataset | None:
    """Return the metrics over an isotropic grid of two gains, with the objective as `objective`; None with one gain.

    They are stiffness and damping, where the law has them and they were searched, or else the first two that were; the
    others are those of the result. A variable `spectral_radius` tells where the closed loop is unstable.

    Arguments:
        found: the result of a search; one that was loaded has no goal, see `tuning.searches.tune.problem_of`.
        progress: called with walks done and in all.
    """
    return map_around(found.walked, progress)


def map_around(problem: Problem, progress: Callable[[int, int], None] | None = None) -> xr.Dataset | None:
    """Return a map as `map_of` does; gains that it does not sweep are as scenario and law of the problem have them."""
    box = axes_of(problem.space, problem.law)
    if not box:
        return None
    walked = dataclasses.replace(problem, dtype=np.float32)
    grid = Grid(walked, None, walked, box, default_batch_size(GRID**2, problem.scenario.steps))
    walks = grid.result(Rows(grid).walk(progress)).data
    return maps.with_stability(maps.judged_by(walks, problem), problem.scenario, law=problem.law, engine=problem.engine)


def axes_of(space: Space, law: mc.Law | None) -> dict[str, np.ndarray]:
    """Return the two gains of a map, each with its values; none where there are no two that a grid can have."""
    of_kinds = {kind: np.array([kind_of(name) == kind for name in space.names]) for kind in space.gains}
    # a map has positive gains that are the same on all axes
    drawn = [
        kind
        for kind, own in of_kinds.items()
        if kind not in GAIT and not (space.of_arrays | (space.units > 0))[own].any()
    ]
    box: dict[str, np.ndarray] = {}
    for kind in drawn[:2]:
        low, high = np.exp([space.lower[of_kinds[kind]].min(), space.upper[of_kinds[kind]].max()])
        box[kind] = np.geomspace(low, high, GRID)
    if len(box) < 2 or (law is None and set(box) != {"stiffness", "damping"}):
        return {}
    return box


class Tests(NamedTuple):
    """The walks close to a result."""

    around: Evaluation  # of the result, and with each part of the space in turn 20 % less, then more
    slopes: np.ndarray  # (parts,) of the value, true extremes; NaN along times of the gait
    radius: float  # of the closed loop in its worst stance


def tests(found: Tuned) -> Tests:
    """Walk with gains close to those of a result."""
    problem, walked = found.problem, found.walked
    space = problem.space
    nudged = [space.scaled(found.theta, factor, part) for factor in (1 - STEP, 1 + STEP) for part in space.parts]
    points: Any = np.array([found.theta, *nudged])
    of_gait = np.isin(space.names, list(GAIT))
    points = np.where(of_gait, space.clip(points), points)  # beyond its bounds it may be none
    # as many robots as searches have: they walk by programs that were compiled for it
    around = problem.evaluate(np.resize(points, (max(len(points), CANDIDATES), space.size)))
    around = jax.tree.map(lambda values: values[: len(points)], around)
    slopes = slopes_at(problem, found.theta, _rows_of_last_descent(found))
    radius = stability_limit.spectral_radius(walked.scenario, {}, law=walked.law, engine=walked.engine)
    return Tests(around, slopes, float(radius))


def _rows_of_last_descent(found: Tuned) -> int:
    """Return how many points a search walked side by side when it last took derivatives, 1 where it took none."""
    rounds = found.data["round"].values
    descended = rounds[np.isfinite(found.data["gradient_norm"].values)]
    return int((rounds == descended.max(initial=-1)).sum()) or 1


def slopes_at(problem: Problem, theta: np.ndarray, rows: int = 1) -> np.ndarray:
    """Return the slopes (parts,) of the value at a point, true extremes, by a search's program for so many `rows`.

    They are by the natural logarithm of a gain, or of the size of an array.
    """
    space = problem.space
    slopes, smooth = np.full(space.size, np.nan), space.smooth
    if smooth.any():
        slopes[smooth] = problem.evaluate(np.tile(theta, (rows, 1)), np.eye(space.size)[smooth]).sharp[0]
    slopes = np.where(space.units > 0, theta * slopes, slopes)
    return np.array([slopes[own].sum() for own in space.parts.values()])


def verify(
    found: Tuned,
    *,
    metrics: Mapping[str, Any] | None = None,
    walks: xr.Dataset | None = None,
    hardware: margins.Found | None = None,
    tested: Tests | None = None,
) -> Verification:
    """Test a result.

    Arguments:
        found: as of `map_of`.
        metrics: of its walk alone in float64, where the caller has them already.
        walks: the result of `map_of`, for the agreement with a grid.
        hardware: the margins of the result, of `tuning.comparisons.margins.find`.
        tested: the result of `tests` for it.
    """
    objective, names = found.problem.objective, list(found.problem.space.parts)
    if metrics is None:
        walked = found.walked
        metrics = mc.metrics(mc.rollout(walked.scenario, law=walked.law, engine=walked.engine), walked.metrics)
    around, slopes, radius = tested or tests(found)
    judged = around.feasible | ~around.feasible[0]  # where the result breaks a limit itself, its neighbours may too
    change = np.where(judged, around.value, np.nan)[1:].reshape(2, -1) - float(around.value[0])
    relative = change / (abs(found.of_pd) or 1.0)
    cliff = ~np.isfinite(change).all(0) | (relative.max(0) > CLIFF)
    shape = np.select([cliff, np.abs(relative).max(0) < PLATEAU], ["cliff", "plateau"], "slope").tolist()
    less, more = ({n: float(v) if np.isfinite(v) else None for n, v in zip(names, row, strict=True)} for row in change)
    best = None if walks is None else maps.best_cell(walks)
    checked = Verification(
        metrics=dict(metrics),
        value=float(maps.score_of(objective, metrics).value),
        search_value=found.value,
        broken_limits=broken_limits(objective, metrics),
        binding_limits=binding_limits(objective, metrics),
        less=less,
        more=more,
        shape=dict(zip(names, shape, strict=True)),
        slopes={n: float(v) for n, v in zip(names, slopes, strict=True) if n not in TIMES},
        grid_value=None if best is None else float(best["objective"]),
        grid_gains=None if best is None else {str(n): float(best[n]) for n in best.coords if not best[n].ndim},
        spectral_radius=radius,
        margins={} if hardware is None else hardware.margins,
        warnings=[],
    )
    lines = _warnings(found, around, checked) + ([] if hardware is None else margins.warnings(hardware))
    return dataclasses.replace(checked, warnings=lines)


def broken_limits(objective: Goal, metrics: Mapping[str, Any]) -> list[str]:
    """Return in words which limits a walk breaks, by its metrics as `mjx_climb.metrics` gives them."""
    if metrics["diverged"]:
        return ["the walk diverged"]
    limb = metrics["detached_limb"]
    torn = [] if limb is None else [f"limb {limb} let go at {metrics['detached_at']:.3f} s"]
    return torn + _limits_in_words(objective, metrics, lambda over, _: over > 0)


def binding_limits(objective: Goal, metrics: Mapping[str, Any]) -> list[str]:
    """Return in words which limits hold a walk where it is: it keeps them, but lies where their penalty begins."""
    if metrics["diverged"]:
        return []
    return _limits_in_words(objective, metrics, lambda over, margin: -objectives.BINDING * margin <= over <= 0)


def _limits_in_words(objective: Goal, metrics: Mapping[str, Any], which: Callable[[float, float], bool]) -> list[str]:
    """Return those limits which `which` tells by how far they are passed, and by their margins."""
    return [
        f"{mc.METRICS.in_words(limit.metric)} {value:.4g}, limit {limit.value:.4g} ({limit.reason})"
        for limit in objective.limits
        if (value := metrics[limit.metric]) is not None
        and which(float(objectives.violation(limit, value)), limit.margin)
    ]


def _warnings(found: Tuned, around: Evaluation, checked: Verification) -> list[str]:
    problem, space, lines = found.problem, found.problem.space, []
    if not found.feasible:
        lines.append("no point of the search keeps every limit: these gains are the nearest to it")
    for name in space.on_bound(found.theta):
        wider = "" if name == "gait.duty" else f": widen bounds.{name}"  # limbs in turn cannot stand less
        lines.append(f"{name} lies on a bound{wider}")
    moved = np.zeros(len(space.parts))
    for name in problem.metrics.names:
        values = around.metrics[name].astype(float)
        if name not in FAILURES and np.isfinite(values[0]) and values[0]:
            moved = np.fmax(moved, np.abs(values[1:] / values[0] - 1).reshape(2, -1).max(0))
    for name, much in zip(space.parts, moved, strict=True):
        if much < UNRESPONSIVE:
            lines.append(f"{name}: no metric responds to it here (less than {UNRESPONSIVE:.1%} for {STEP:.0%})")
    cliffs = [
        f"{name} ({_cliff(problem.objective, around, row, len(space.parts))})"
        for row, name in enumerate(space.parts, 1)
        if checked.shape[name] == "cliff"
    ]
    if cliffs:
        lines.append(f"cliff within {STEP:.0%} of {', '.join(cliffs)}")
    if checked.grid_value is not None and checked.grid_value < found.value - 1e-4:
        where = ", ".join(f"{name} {value:.4g}" for name, value in (checked.grid_gains or {}).items())
        lines.append(f"a coarse grid found better: {checked.grid_value:.4f} at {where}")
    if (radius := checked.spectral_radius) > 1 + stability_limit.ROUNDING:
        lines.append(f"the closed loop is unstable in a stance of the gait: a disturbance grows by {radius:.6f} a step")
    if abs(checked.value - found.value) > 0.01:
        lines.append(f"alone in float64 the objective is {checked.value:.4f}, in the search {found.value:.4f}")
    return lines


def _cliff(goal: Goal, around: Evaluation, less: int, more: int) -> str:
    """Return the failures on both sides of a gain in words: rows `less` and `more` further on."""
    sides = []
    for side, row in (("less", less), ("more", less + more)):
        value, jump = around.value[row], float(around.value[row] - around.value[0])
        broken = [
            mc.METRICS.in_words(limit.metric)
            for limit in goal.limits
            if np.max(objectives.violation(limit, around.metrics[limit.metric][row])) > 0
        ]
        if not np.isfinite(value):
            sides.append(f"{side}: the walk diverges")
        elif broken:
            sides.append(f"{side}: {' and '.join(broken)} beyond the limit")
        elif jump > CLIFF:
            sides.append(f"{side}: objective {jump:+.2f}")
    return ", ".join(sides)
