"""The Pareto front of two metrics: the price of one in the other, with the gains for it: `tuning.pareto`.

By the epsilon constraint: each row of a batch betters one metric under its own limit on the other, by the gradient.
Rows start from the best point that any row has visited within their limit, so neighbours help each other. All
walks on the way are candidates; the front is those that no other beats in both metrics.
"""

import dataclasses
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import failed
from tuning.gains.gains_file import by_name
from tuning.gains.gains_tables import axes_of, labelled
from tuning.methods import Request, Task
from tuning.methods.gradient import again
from tuning.methods.rounds import Callback, Rounds, follow
from tuning.problem import objectives
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.objectives import Limit, Objective
from tuning.problem.search import Pareto, Search
from tuning.problem.spaces import refuse_gait, to_gains64
from tuning.results.front import Front, gains_of, sign
from tuning.searches import retuned_pd, tune

CANDIDATES = 64  # random points, the scenario's own gains among them
STAGES = 3  # descents; between them every row starts again from the best point within its limit
ITERATIONS = 6  # of a descent
_MARGIN = 0.002  # relative: where the penalty of a row's limit begins, inside it


def pareto(
    scenario: mc.Scenario,
    search: Search | None = None,
    *,
    better: str | None = None,
    against: str | None = None,
    points: int | None = None,
    out: str | os.PathLike[str] | None = None,
    progress: Callback | None = None,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    **settings: Any,
) -> Front:
    """Search the Pareto front of two metrics.

    `tuning.write(tuning.pareto(scenario, out="results/mine"), "results/mine")` is `mjx-climb tune --against`.

    Arguments:
        scenario: robot, gait and ground; its own gains are among the first points.
        search: space, bounds, limits and seed (weights and method are not used).
        better: the metric that each row betters; the default of this and the next two as of
            `tuning.problem.search.Pareto`.
        against: the metric that each row limits.
        points: how many limits, evenly spaced in the logarithm, from the least that is found to where `better` is
            best, within the settings' own limit on `against`.
        law, metrics, engine, out, progress, settings: as of `tuning.tune`.

    Raises:
        ConfigError: no walk meets the constraints, a metric that cannot be weighed, or one against itself.
        OutputError: `out` cannot be written, or holds an unfinished search for something else.
    """
    given = {"better": better, "against": against, "points": points}
    asked = Pareto().changed({name: value for name, value in given.items() if value is not None})
    walks: dict[str, Any] = {"law": law, "metrics": metrics, "engine": engine}
    settled = (search or Search()).changed(settings)
    return run(problem_of(scenario, settled, asked, **walks), settled, asked, out=out, progress=progress)


def problem_of(scenario: mc.Scenario, search: Search, asked: Pareto, **walks: Any) -> Problem:
    """Return the problem that weighs the metric to better alone; `walks`, `space`, errors as of `tune.problem_of`."""
    refuse_gait(search)
    return tune.problem_of(scenario, _bettering(search, asked), **walks)


def _bettering(search: Search, asked: Pareto) -> Search:
    return search.changed({"weights": {asked.better: 1.0}, "no_worse_than_pd": False})


def run(
    problem: Problem,
    search: Search,
    asked: Pareto,
    *,
    out: str | os.PathLike[str] | None = None,
    progress: Callback | None = None,
) -> Front:
    """Search the front of a problem of `problem_of`; arguments, result and errors as of `pareto`."""
    space, plain, rng = problem.space, problem.objective, np.random.default_rng(search.seed)
    assert isinstance(plain, Objective)
    settings, start = _bettering(search, asked), tune.start_of(problem)
    drawn = np.concatenate([start[None], space.draw_tied(rng, CANDIDATES - 1)])
    others = tuple(limit for limit in plain.limits if limit.metric != asked.against)
    about, front = problem.metrics[asked.against], [asked.better, asked.against, asked.points]
    in_all = 1 + STAGES * ITERATIONS
    with Rounds(in_all, out, lambda: tune.search_identity(problem, settings, front=front), progress) as rounds:
        rounds.evaluate(problem, Request(drawn, None, "random points"))
        limits = _limits(problem, asked, _walked(problem, asked, rounds))
        values, scales = tuple(limits), tuple(np.abs(limits))
        ceiling = Limit(asked.against, values, scales, _MARGIN, "the row's own", about.larger_is_better)
        rows = dataclasses.replace(problem, objective=dataclasses.replace(plain, limits=(*others, ceiling)))
        for number in range(STAGES):
            walked = _walked(problem, asked, rounds)  # from the best within each limit, else the closest to it
            inside = walked.x <= sign(about) * limits[:, None]
            best = np.where(inside, walked.y, np.inf).argmin(1)
            theta = walked.theta[np.where(inside.any(1), best, walked.x.argmin())]
            moves = again(Task(rows, settings, start), theta, ITERATIONS, number, STAGES, rng)
            follow(moves, lambda request: rounds.evaluate(rows, request))
    data = front_dataset(problem, asked, _walked(problem, asked, rounds), sign(about) * limits[-1])
    data = data.assign_attrs(search=settings.to_yaml(), env_steps=rounds.env_steps)
    found = Front(data, problem, search, asked=asked)
    return dataclasses.replace(found, gains=gains_of(data, found.knee)) if data.sizes["front"] else found


def nondominated(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the indices of the points that no other beats in both, smaller is better, in the order of x.

    Points whose y is infinite are none of them.
    """
    order = np.lexsort((y, x))
    best = np.minimum.accumulate(np.concatenate([[np.inf], y[order][:-1]]))
    return order[y[order] < best]


class Walked(NamedTuple):
    """All points that were walked, with the smaller cost the better; infinite where a constraint is broken."""

    theta: np.ndarray  # (N, n)
    values: Mapping[str, np.ndarray]  # of both metrics, (N,), in their own sign
    held: np.ndarray  # (N,) bool, every constraint but that of the rows is met
    x: np.ndarray  # (N,) cost in the metric that is traded away
    y: np.ndarray  # (N,) cost in the metric that is bettered


def _walked(problem: Problem, asked: Pareto, rounds: Rounds) -> Walked:
    found, plain = rounds.evaluated, problem.objective
    others = [limit for limit in plain.limits if limit.metric != asked.against]
    slacks = [np.asarray(objectives.violation(limit, found[limit.metric])) <= 0 for limit in others]
    held = np.all([np.isfinite(found["descent"]), *slacks], axis=0)
    values = {name: found[name] for name in (asked.against, asked.better)}
    fine = held & np.all([np.isfinite(value) for value in values.values()], axis=0)
    x, y = (np.where(fine, sign(problem.metrics[name]) * value, np.inf) for name, value in values.items())
    return Walked(found["theta"], values, held, x, y)


def _limits(problem: Problem, asked: Pareto, walked: Walked) -> np.ndarray:
    """Return the rows' limits (points,) on the metric that is traded away, in its own sign."""
    factor = sign(problem.metrics[asked.against])
    own: Sequence[Limit] = problem.objective.limits
    widest = [factor * float(np.asarray(limit.value)) for limit in own if limit.metric == asked.against]
    within = np.isfinite(walked.x) & (walked.x <= min(widest, default=np.inf))
    if not within.any():
        raise ConfigError("", "limits", "a walk that meets them all", "none of the first points")
    low, high = walked.x[within].min(), walked.x[within][np.argmin(walked.y[within])]
    if widest:
        high = max(high, widest[0])
    if not low < high:
        high = low + 0.1 * abs(low)
    spaced = np.geomspace if low > 0 else np.linspace
    return np.asarray(factor * spaced(low, high, asked.points))


def front_dataset(problem: Problem, asked: Pareto, walked: Walked, widest: float) -> xr.Dataset:
    """Return the front among all that was walked, within the widest ceiling where there are such points."""
    scenario, table, law = problem.scenario, problem.metrics, problem.law
    candidates = nondominated(walked.x, walked.y)
    within = walked.x[candidates] <= widest * (1 + 1e-6 * np.sign(widest))
    gains = to_gains64(problem.space, walked.theta[candidates[within] if within.any() else candidates])
    how: dict[str, Any] = {"metrics": table, "dtype": np.float64, "engine": problem.engine}
    exact = mc.rollout_metrics(scenario, gains, law=law, unsteady=True, **how)
    on = _front(table, asked, exact, ~failed(exact))
    own = [mc.rollout_metrics(scenario, law=law, **how), mc.rollout_metrics(under_pd(scenario), **how)]
    chosen = {name: values[on] for name, values in by_name(gains).items()}
    gains_on = labelled(chosen, ("front",), law)
    data: dict[str, Any] = dict(gains_on)
    for metric in table:
        name, about = metric.name, dataset.metric_attributes(metric)
        data[name] = ("front", exact[name][on], about)
        data[f"reference_{name}"] = ("reference", np.array([m[name] for m in own]), about)
    data |= _front_without(problem, asked)
    for name, values in walked.values.items():
        data[f"walked_{name}"] = ("point", values, dataset.metric_attributes(table[name]))
    data["held"] = ("point", walked.held, {"units": "1", "long_name": "all constraints met"})
    data["theta"] = (("point", "coordinate"), walked.theta, {"units": "1", "long_name": "coordinates of gains"})
    attrs = {"title": "Pareto front of two metrics", "better": asked.better, "against": asked.against}
    attrs |= {"gains": " ".join(chosen), "searched": " ".join(problem.space.gains), **dataset.provenance(scenario)}
    coordinates = {"coordinate": list(problem.space.names), "reference": ["config", "pd"]}
    return xr.Dataset(data, coordinates | axes_of(gains_on), attrs)


def _front(table: mc.MetricTable, asked: Pareto, walks: Mapping[str, np.ndarray], held: np.ndarray) -> np.ndarray:
    """Return the indices of the walks on the front of those that held."""
    return nondominated(*(np.where(held, sign(table[n]) * walks[n], np.inf) for n in (asked.against, asked.better)))


def _front_without(problem: Problem, asked: Pareto) -> dict[str, Any]:
    """Return the walks without a force sensor that no other beats in both metrics, all limits but the rows' met.

    They are pd on a grid of joint gains, and `retuned_pd.by_plan` on those of its front.
    """
    how: dict[str, Any] = {"metrics": problem.metrics, "dtype": np.float64, "engine": problem.engine}

    def front(walks: Mapping[str, np.ndarray]) -> np.ndarray:
        kept = [objectives.violation(limit, walks[limit.metric]) <= 0 for limit in problem.objective.limits]
        return _front(problem.metrics, asked, walks, np.all([~failed(walks), *kept], axis=0))

    joint, walks = retuned_pd.walked_on_grid(problem.scenario, retuned_pd.FINE, **how)
    on = front(walks)
    joint, walks = ({name: each[on] for name, each in own.items()} for own in (joint, walks))
    laws, plan = [retuned_pd.NAME] * len(on), retuned_pd.by_plan(problem)
    if plan is not None and len(on):
        planned = mc.rollout_metrics(under_pd(problem.scenario), joint, law=plan, unsteady=True, **how)
        walks = {name: np.concatenate([each, planned[name]]) for name, each in walks.items()}
        joint, laws = {name: np.tile(each, 2) for name, each in joint.items()}, laws + [retuned_pd.UNSEARCHED] * len(on)
        on = front(walks)
        joint, walks = ({name: each[on] for name, each in own.items()} for own in (joint, walks))
        laws = [laws[place] for place in on]
    found: dict[str, Any] = {
        "without_law": ("without", np.array(laws, str), {"long_name": "law without a force sensor"})
    }
    for (name, values), unit in zip(joint.items(), ("N m/rad", "N m s/rad"), strict=True):
        found[f"without_{name}"] = ("without", values, {"units": unit})
    for name in (asked.against, asked.better):
        found[f"without_{name}"] = ("without", walks[name], dataset.metric_attributes(problem.metrics[name]))
    return found
