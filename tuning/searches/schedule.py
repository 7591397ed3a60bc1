"""A gain schedule: which gains to load under which gravity and with which cargo: `tuning.schedule`.

All operating points are tuned side by side in one batch, each under its own gravity and cargo and against its own pd.
Then every point tries the gains of all others, takes them where they are better, and goes on from there.
"""

import dataclasses
import functools
import os
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.parameter_types import GAIN_UNITS
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.values import G
from tuning.gains.gains_file import by_name
from tuning.gains.gains_tables import axes_of, labelled
from tuning.methods import Request, Task
from tuning.methods.gradient import again
from tuning.methods.rounds import Callback, Rounds, follow
from tuning.problem import objectives
from tuning.problem.evaluation import Evaluation, Problem, pd_of, under_pd
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Schedule, Search
from tuning.problem.spaces import refuse_gait, to_gains64
from tuning.results.scheduled import Scheduled
from tuning.searches import retuned_pd, tune

CANDIDATES = 24  # random points per operating point
ITERATIONS = (10, 8)  # of the two descents
_VARIED = ("gravity", "disturbance.cargo.mass")
_SHARED = ("metric", "weight", "margin", "reason", "larger_is_better")  # of terms and limits, by all operating points
_Row = TypeVar("_Row", Term, Limit)


def schedule(
    scenario: mc.Scenario,
    search: Search | None = None,
    *,
    gravity: Sequence[float] | None = None,
    cargo: Sequence[float] | None = None,
    out: str | os.PathLike[str] | None = None,
    progress: Callback | None = None,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    **settings: Any,
) -> Scheduled:
    """Tune gains for every pair of gravity and cargo.

    `tuning.write(tuning.schedule(scenario, out="results/mine"), "results/mine")` is `mjx-climb tune --over`.

    Arguments:
        scenario: robot, gait and ground; its gravity gives the direction alone, its cargo the window of time alone.
        search: space, bounds, weights, limits and seed (the method is not used).
        gravity: G, ascending; the default of this and the next as of `tuning.problem.search.Schedule`.
        cargo: kg, ascending.
        law, metrics, engine, out, progress, settings: as of `tuning.tune`.

    Raises:
        ConfigError: operating points that are not in order, or pd has no value of a metric that is weighed.
        OutputError: `out` cannot be written, or holds an unfinished search for something else.
    """
    given = {"gravity": gravity, "cargo": cargo}
    asked = Schedule().changed({name: tuple(values) for name, values in given.items() if values is not None})
    walks: dict[str, Any] = {"law": law, "metrics": metrics, "engine": engine}
    points = operating_points(scenario, (search or Search()).changed(settings), asked, **walks)
    return run(points, out=out, progress=progress)


@dataclasses.dataclass(frozen=True)
class OperatingPoints:
    """The problems that are tuned side by side, P pairs of gravity and cargo, the cargo running fastest."""

    problem: Problem  # of all of them, a row each: gravity (P, 3), cargo (P,)
    search: Search
    asked: Schedule
    goals: list[Objective]  # (P,) each relative to pd there

    def at(self, places: np.ndarray) -> Problem:
        """Return the problem whose rows are at some of the points."""
        own = self.problem.parameters or own_parameters(self.problem.scenario)
        rows = {path: own.at(path)[places] for path in _VARIED}
        objective = _rows([self.goals[place] for place in places])
        return dataclasses.replace(self.problem, parameters=own.replace(rows), objective=objective)


def operating_points(scenario: mc.Scenario, search: Search, asked: Schedule, **walks: Any) -> OperatingPoints:
    """Return the problem of `schedule`, with its errors; pd walks first. `walks`: law, metrics, engine, `space`."""
    refuse_gait(search)
    problem = tune.without_goal(scenario, search, **walks)
    down = np.asarray(scenario.gravity, float)
    length = np.linalg.norm(down)
    down = down / length if length > 0 else np.array([0.0, 0.0, -1.0])
    level, load = (values.ravel() for values in np.meshgrid(asked.gravity, asked.cargo, indexing="ij"))
    parameters = own_parameters(scenario).replace(
        {"gravity": G * level[:, None] * down, "disturbance.cargo.mass": load}
    )
    pd = pd_of(scenario, parameters, engine=problem.engine, metrics=problem.metrics)
    at_each = [{name: float(values[place]) for name, values in pd.items()} for place in range(load.size)]
    goals = [_objective_at(problem, search, there) for there in at_each]
    problem = dataclasses.replace(problem, parameters=parameters, objective=_rows(goals))
    return OperatingPoints(problem, search, asked, goals)


def run(
    points: OperatingPoints, *, out: str | os.PathLike[str] | None = None, progress: Callback | None = None
) -> Scheduled:
    """Tune the gains of all operating points; arguments, result and errors as of `schedule`."""
    problem, search, count = points.problem, points.search, len(points.goals)
    rng, own, here = np.random.default_rng(search.seed), tune.start_of(problem), np.arange(count)
    best, merit = np.tile(own, (count, 1)), np.full(count, np.inf)
    asked = [list(points.asked.gravity), list(points.asked.cargo)]
    plain = dataclasses.replace(problem, parameters=None)  # the operating points say which they are
    in_all = 1 + sum(ITERATIONS) + len(ITERATIONS)
    identity = functools.partial(tune.search_identity, plain, search, operating_points=asked)
    with Rounds(in_all, out, identity, progress) as rounds:

        def evaluate(request: Request, places: np.ndarray) -> Evaluation:
            """Evaluate points at some operating points, and keep the best of each."""
            found = rounds.evaluate(points.at(places), request)
            ranks = np.where(found.feasible, found.value, 1e3 + found.merit)
            for row, place in enumerate(places):
                if ranks[row] < merit[place]:
                    best[place], merit[place] = request.theta[row], ranks[row]
            return found

        drawn = np.concatenate([own[None], problem.space.draw_tied(rng, CANDIDATES - 1)])
        evaluate(Request(np.tile(drawn, (count, 1)), None, "random points"), np.repeat(here, CANDIDATES))
        for number, iterations in enumerate(ITERATIONS):
            moves = again(Task(points.at(here), search, own), best.copy(), iterations, number, len(ITERATIONS), rng)
            follow(moves, lambda request: evaluate(request, here))
            whose = Request(best[np.tile(here, count)], None, "gains of the neighbours")
            crossed = evaluate(whose, np.repeat(here, count))
    transfer = np.where(crossed.feasible, crossed.value, np.nan).reshape(count, count)
    return Scheduled(_dataset(points, best, merit, transfer).assign_attrs(env_steps=rounds.env_steps), problem, search)


def _objective_at(problem: Problem, search: Search, baseline: dict[str, float]) -> Objective:
    """Return the objective of one operating point relative to pd there."""
    goal = objectives.objective(search, baseline, metrics=problem.metrics)
    limits = list(goal.limits)
    for place, own in enumerate(limits):
        if own.metric == "base_deviation" and own.metric not in search.limits:
            # at least a millimetre: without cargo or weight pd hardly sags
            limits[place] = own._replace(value=max(own.value, 1e-3), scale=max(own.scale, 1e-3))
    return dataclasses.replace(goal, limits=tuple(limits))


def _rows(rows: Sequence[Objective]) -> Objective:
    """Return one objective for a batch whose rows have their own."""

    def joined(items: Sequence[_Row]) -> _Row:
        own: dict[str, Any] = {name: tuple(getattr(item, name) for item in items) for name in items[0]._fields}
        return items[0]._replace(**{name: values for name, values in own.items() if name not in _SHARED})

    terms = tuple(map(joined, zip(*(row.terms for row in rows), strict=True)))
    return Objective(terms, tuple(map(joined, zip(*(row.limits for row in rows), strict=True))))


def _dataset(points: OperatingPoints, theta: np.ndarray, merit: np.ndarray, transfer: np.ndarray) -> xr.Dataset:
    problem, asked = points.problem, points.asked
    scenario, space, table, law = problem.scenario, problem.space, problem.metrics, problem.law
    shape, here = (len(asked.gravity), len(asked.cargo)), ("gravity", "cargo")
    gains = to_gains64(space, theta)
    pd, (joint, without) = under_pd(scenario), pd_of_each(problem)
    own = {name: np.full(len(theta), float(getattr(scenario.control, name))) for name in joint}  # pd's one program
    walkers: dict[str, tuple[mc.Scenario, AnyGains | None, mc.Law | None]]
    walkers = {"tuned": (scenario, gains, law), "config": (scenario, None, law)}
    plan = retuned_pd.by_plan(problem)
    walkers |= {retuned_pd.NAME: (pd, joint, None)} | (
        {} if plan is None else {retuned_pd.UNSEARCHED: (pd, joint, plan)}
    )
    walkers |= {"pd": (pd, own, None)}
    how: dict[str, Any] = {"metrics": table, "dtype": np.float64, "engine": problem.engine, "unsteady": True}
    metrics = [mc.rollout_metrics(s, g, problem.parameters, law=own, **how) for s, g, own in walkers.values()]
    values = {name: value.reshape(*shape, *value.shape[1:]) for name, value in by_name(gains).items()}
    tuned = labelled(values, here, law)
    data: dict[str, Any] = dict(tuned)
    data["value"] = (here, np.where(merit < 1e3, merit, np.nan).reshape(shape), {"units": "1"})
    data["feasible"] = (here, (merit < 1e3).reshape(shape), {"units": "1"})
    data["transfer"] = ((*here, "gravity_of", "cargo_of"), transfer.reshape(shape * 2), {"units": "1"})
    for name, of_each in (*joint.items(), ("value", without)):
        units = GAIN_UNITS[name][0] if name in joint else "1"
        data[f"retuned_{name}"] = (here, of_each.reshape(shape), {"units": units})
    bounds = [", ".join(space.on_bound(point)) for point in theta]
    data["on_bound"] = (here, np.array(bounds, str).reshape(shape), {"long_name": "gains on a bound"})
    for metric in table:
        values_of = np.stack([m[metric.name].reshape(shape) for m in metrics])
        data[metric.name] = (("walk", *here), values_of, dataset.metric_attributes(metric))
    gravity, cargo = np.asarray(asked.gravity, float), np.asarray(asked.cargo, float)
    coordinates = {
        "gravity": ("gravity", gravity, {"units": "G", "long_name": "gravity"}),
        "cargo": ("cargo", cargo, {"units": "kg", "long_name": "mass of the cargo"}),
        "gravity_of": gravity, "cargo_of": cargo, "walk": list(walkers),
    }  # fmt: skip
    attrs = {"title": "gain schedule", "search": points.search.to_yaml()}
    attrs |= {"space": " ".join(space.names), "gains": " ".join(tuned), "searched": " ".join(space.gains)}
    return xr.Dataset(data, coordinates | axes_of(tuned), {**attrs, **dataset.provenance(scenario)})


def pd_of_each(problem: Problem) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the kp and kd of a grid, (P,) each, with which pd is best at each point, and its objective, 1 for pd."""
    how: dict[str, Any] = {"metrics": problem.metrics, "dtype": problem.dtype, "engine": problem.engine}
    gains, walks = retuned_pd.walked_on_grid(problem.scenario, parameters=problem.parameters, **how)
    with jax.enable_x64(np.dtype(problem.dtype) == np.float64):  # for any setting of JAX
        score = jax.jit(problem.objective.score)(walks)
    value, feasible = np.asarray(score.value), np.asarray(score.feasible)
    ranks = np.where(feasible, value, 1e3 + value + np.asarray(score.penalty))
    best = np.nan_to_num(ranks, nan=np.inf).argmin(0)
    here = best, np.arange(len(best))
    return {name: values[best] for name, values in gains.items()}, np.where(feasible[here], value[here], np.nan)
