"""The Pareto front of two metrics: what one costs in terms of the other, with the gains that get it.

By the epsilon constraint: each row of a batch betters one metric under its own limit on the other, by the gradient.
Rows start from the best point that any row has visited within their limit, so neighbours help each other. Whatever
was walked on the way is a candidate; the front is what nothing else beats in both metrics.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.files import dataset
from mjx_climb.rollouts.given import AnyGains
from mjx_climb.scenario.messages import ConfigError
from tuning.gains.gains_file import by_name
from tuning.gains.labels import axes_of, labelled
from tuning.problem import objectives
from tuning.problem.evaluation import Evaluation, Problem, under_pd
from tuning.problem.objectives import Limit, Objective
from tuning.problem.search import Search
from tuning.problem.spaces import as_gains, to_gains64
from tuning.searches import retuned_pd, tune
from tuning.searches.judged_rounds import Rounds, Told
from tuning.searches.methods import Task, gradient

CANDIDATES = 64  # random points, the scenario's own gains among them
STAGES = 3  # descents; between them every row starts again from the best point within its limit
ITERATIONS = 6  # of a descent
POINTS = 12  # limits along the front
BETTER, AGAINST = "force_variation", "base_deviation"
_Archive = dict[str, list[np.ndarray]]
_MARGIN = 0.002  # relative: where the penalty of a row's limit begins, inside it


class Trade(NamedTuple):
    """What is traded for what."""

    problem: Problem  # its objective is `better` alone
    search: Search  # settings as they were asked for
    better: str  # the metric that each row betters
    against: str  # the metric that each row limits


def front(
    scenario: mc.Scenario,
    settings: Search | None = None,
    *,
    better: str = BETTER,
    against: str = AGAINST,
    points: int = POINTS,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    out: Path | None = None,
    progress: Told | None = None,
    **changes: Any,
) -> xr.Dataset:
    """Search the Pareto front of two metrics.

    Arguments:
        scenario: what walks where; its own gains are among the first points.
        settings: space, bounds, limits and seed (weights and method are not used); `changes` replace keys of it.
        better: the metric that each row betters.
        against: the metric that each row limits.
        points: how many limits, evenly spaced in the logarithm, from the least that is found to where `better` is
            best, within the settings' own limit on `against`.
        law: whose gains are searched, the scenario's where None.
        metrics: what the walks are judged by, as `mjx_climb.METRICS + (mine,)`.
        engine: the dynamics.
        out: a folder that keeps finished rounds, so that an interrupted search goes on.
        progress: called after each round.

    Returns:
        Along `point` both metrics of all that was walked in the search, nothing torn off. Along `front` the
        gains on the front (those of six axes along `six`, of three along `three`) and all their metrics, in float64
        with grippers that tear off. Along `reference` the metrics of the law's own gains (`config`) and of `pd`,
        likewise. Along `without` the front of pd over kp and kd, which needs no force sensor, from a grid of them
        (`without_kp`, `without_kd`, and both metrics).

    Raises:
        ConfigError: no walk meets the constraints, or a metric that cannot be weighed.
    """
    settings = tune.changed(settings, changes)
    asked = trade(scenario, settings, better=better, against=against, law=law, metrics=metrics, engine=engine)
    return run(asked, points, out=out, progress=progress)


def trade(
    scenario: mc.Scenario,
    settings: Search,
    *,
    better: str = BETTER,
    against: str = AGAINST,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
) -> Trade:
    """Return what `front` searches; pd walks first.

    Raises:
        ConfigError: a metric that cannot be weighed, or one against itself.
    """
    if better == against:
        raise ConfigError(f"against: expected another metric than {better}")
    problem = tune.problem_of(scenario, bettering(better, settings), engine=engine, law=law, metrics=metrics)
    return Trade(problem, settings, better, against)


def run(asked: Trade, points: int = POINTS, *, out: Path | None = None, progress: Told | None = None) -> xr.Dataset:
    """Search a front; arguments and result as of `front`."""
    problem, _, better, against = asked
    settings = bettering(better, asked.search)
    table = problem.metrics
    space, plain = problem.space, problem.objective
    assert isinstance(plain, Objective)
    rng = np.random.default_rng(settings.seed)
    identity = {**tune.search_identity(problem, settings), "front": [better, against, points]}
    stages = [space.ties] + [np.eye(space.size) if len(space.ties) < space.size else space.ties] * (STAGES - 1)
    rounds = Rounds(1 + STAGES * ITERATIONS, progress, out, identity)
    archive: _Archive = {"theta": [], "x": [], "y": [], "held": []}

    def keep(theta: np.ndarray, found: Evaluation) -> None:
        others = [_slack(limit, found) <= 0 for limit in plain.limits if limit.metric != against]
        held = np.all([found.alive, *others], axis=0)
        for name, values in zip(archive, (theta, found.metrics[against], found.metrics[better], held), strict=True):
            archive[name].append(np.asarray(values))

    start = np.concatenate([tune.start_of(problem)[None], space.draw_tied(rng, CANDIDATES - 1)])
    keep(start, rounds.evaluate(problem, start, "random points"))
    signs = _sign(table[against]), _sign(table[better])
    limits = _limits(archive, signs, against, plain.limits, points)
    larger = table[against].larger_is_better
    ceiling = Limit(against, tuple(limits), tuple(np.abs(limits)), _MARGIN, "the row's own", larger)
    kept = tuple(limit for limit in plain.limits if limit.metric != against)
    rows = dataclasses.replace(problem, objective=dataclasses.replace(plain, limits=(*kept, ceiling)))
    task = Task(rows, settings, start[0])
    for number, ties in enumerate(stages):
        theta = _best_within(archive, limits, signs)
        phase = f"descent {number + 1} of {STAGES}"
        visited = rounds.descend(
            rows, gradient.descend(task, theta, ties, ITERATIONS, rng, phase, np.full(len(theta), 0.5 * 0.6**number))
        )
        for step in visited:
            keep(step.theta, step.found)
    return _dataset(asked, archive, limits, rounds.env_steps)


def bettering(metric: str, settings: Search) -> Search:
    """Return settings that weigh one metric alone, relative to pd's."""
    return tune.changed(settings, {"weights": {metric: 1.0}, "no_worse_than_pd": False})


def nondominated(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the indices of the points that no other beats in both, smaller is better, in the order of x."""
    order = np.lexsort((y, x))
    best = np.minimum.accumulate(np.concatenate([[np.inf], y[order][:-1]]))
    return order[y[order] < best]


def knee(x: np.ndarray, y: np.ndarray) -> int:
    """Return the index of the point of a front that lies furthest from the line between its ends."""
    if len(x) < 3:
        return 0
    across, down = (x - x[0]) / (x[-1] - x[0]), (y - y[-1]) / (y[0] - y[-1])
    return int(np.argmin(across + down))


def gains_of(result: xr.Dataset, index: int) -> AnyGains:
    """Return the gains of one point of the front."""
    row = result.isel(front=index)
    return as_gains({name: row[name].values for name in result.attrs["gains"].split()})


def _sign(metric: mc.Metric) -> float:
    return -1.0 if metric.larger_is_better else 1.0


def _slack(limit: Limit, found: Evaluation) -> np.ndarray:
    return np.asarray(objectives.violation(limit, found.metrics[limit.metric]))


def _joined(archive: _Archive, signs: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, and both metrics with the smaller better, infinite where a constraint is broken."""
    theta, x, y, held = (np.concatenate(archive[name]) for name in ("theta", "x", "y", "held"))
    held = held & np.isfinite(x) & np.isfinite(y)
    return theta, np.where(held, signs[0] * x, np.inf), np.where(held, signs[1] * y, np.inf)


def _limits(
    archive: _Archive, signs: tuple[float, float], against: str, own_limits: Sequence[Limit], points: int
) -> np.ndarray:
    """Return the rows' limits (points,) on `against`, in its own sign."""
    _, x, y = _joined(archive, signs)
    widest = [signs[0] * float(np.asarray(limit.value)) for limit in own_limits if limit.metric == against]
    within = np.isfinite(x) & (x <= min(widest, default=np.inf))
    if not within.any():
        raise ConfigError("limits: expected a walk that meets them all, got none of the first points")
    low, high = x[within].min(), x[within][np.argmin(y[within])]
    if widest:
        high = max(high, widest[0])
    if not low < high:
        high = low + 0.1 * abs(low)
    spaced = np.geomspace if low > 0 else np.linspace
    return np.asarray(signs[0] * spaced(low, high, points))


def _best_within(archive: _Archive, limits: np.ndarray, signs: tuple[float, float]) -> np.ndarray:
    """Return for each limit the best point within it (points, n), else the one that comes closest to it."""
    theta, x, y = _joined(archive, signs)
    rows = []
    for limit in signs[0] * limits:
        inside = x <= limit
        rows.append(np.argmin(np.where(inside, y, np.inf)) if inside.any() else np.argmin(x))
    return theta[rows]


def _dataset(asked: Trade, archive: _Archive, limits: np.ndarray, env_steps: int) -> xr.Dataset:
    problem, _, better, against = asked
    scenario, table, law = problem.scenario, problem.metrics, problem.law
    signs = _sign(table[against]), _sign(table[better])
    theta, x, y = _joined(archive, signs)
    candidates = _candidates(x, y, signs[0] * limits[-1])
    gains = to_gains64(problem.space, theta[candidates])
    how: dict[str, Any] = {"metrics": table, "dtype": np.float64, "engine": problem.engine}
    exact = mc.rollout_metrics(scenario, gains, law=law, **how)
    stays = (exact["detached_limb"] < 0) & ~exact["diverged"]
    costs = [np.where(stays, s * exact[name], np.inf) for s, name in zip(signs, (against, better), strict=True)]
    on = nondominated(*costs)
    on = on[np.isfinite(costs[1][on])]
    own = [mc.rollout_metrics(scenario, law=law, **how), mc.rollout_metrics(under_pd(scenario), **how)]
    chosen = {name: values[on] for name, values in by_name(gains).items()}
    gains_on = labelled(chosen, ("front",), law)
    data: dict[str, Any] = dict(gains_on)
    for metric in table:
        name, about = metric.name, dataset.metric_attributes(metric)
        data[name] = ("front", exact[name][on], about)
        data[f"reference_{name}"] = ("reference", np.array([m[name] for m in own]), about)
    data |= _front_of_pd(problem, against, better)
    for name, key in ((against, "x"), (better, "y")):
        about = dataset.metric_attributes(table[name])
        data[f"walked_{name}"] = ("point", np.concatenate(archive[key]), about)
    data["held"] = ("point", np.concatenate(archive["held"]), {"units": "1", "long_name": "all constraints met"})
    data["theta"] = (("point", "coordinate"), theta, {"units": "1", "long_name": "log of the gains"})
    attrs = {"title": "Pareto front of two metrics", "better": better, "against": against, "env_steps": env_steps}
    attrs |= {"gains": " ".join(chosen), "searched": " ".join(problem.space.gains)}
    attrs |= {"search": bettering(better, asked.search).to_yaml(), **dataset.provenance(scenario)}
    coordinates = {"coordinate": list(problem.space.names), "reference": ["config", "pd"]}
    return xr.Dataset(data, coordinates | axes_of(gains_on), attrs)


def _front_of_pd(problem: Problem, against: str, better: str) -> dict[str, Any]:
    """Return the pairs of joint gains under pd that no other beats in both metrics, all limits but the rows' met."""
    table, plain = problem.metrics, problem.objective
    assert isinstance(plain, Objective)
    joint, walks = retuned_pd.walked_on_grid(
        problem.scenario, table, retuned_pd.FINE, dtype=np.float64, engine=problem.engine
    )
    others = [objectives.violation(limit, walks[limit.metric]) <= 0 for limit in plain.limits]
    holds = np.all([walks["detached_limb"] < 0, ~walks["diverged"].astype(bool), *others], axis=0)
    costs = [np.where(holds, _sign(table[name]) * walks[name], np.inf) for name in (against, better)]
    on = nondominated(*costs)
    on = on[np.isfinite(costs[1][on])]
    found = {f"without_{name}": values[on] for name, values in joint.items()}
    labels = {f"without_{name}": {"units": unit} for name, unit in (("kp", "N m/rad"), ("kd", "N m s/rad"))}
    for name in (against, better):
        found[f"without_{name}"] = walks[name][on]
        labels[f"without_{name}"] = dataset.metric_attributes(table[name])
    return {name: ("without", values, labels[name]) for name, values in found.items()}


def without_sensor(result: xr.Dataset, index: int, about: mc.MetricTable = mc.METRICS) -> xr.Dataset | None:
    """Return the point of pd's front that costs no more than a point of the front, None where all cost more."""
    against, better = result.attrs["against"], result.attrs["better"]
    cost = _sign(about[against]) * result[f"without_{against}"].values
    within = np.flatnonzero(cost <= _sign(about[against]) * result[against].values[index])
    if not within.size:
        return None
    values = _sign(about[better]) * result[f"without_{better}"].values[within]
    return result.isel(without=int(within[values.argmin()]))


def _candidates(x: np.ndarray, y: np.ndarray, widest: float) -> np.ndarray:
    """Return the indices of the points that no other beats, within the widest limit where there are such."""
    found = nondominated(x, y)
    found = found[np.isfinite(y[found])]
    within = x[found] <= widest * (1 + 1e-6 * np.sign(widest))
    return np.asarray(found[within] if within.any() else found)
