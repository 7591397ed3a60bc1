"""One search from start to end: rounds of points are judged, kept on disk, and told to the method.

A method is a generator: it yields the points that it wants judged and receives what they are worth. It is
deterministic, so a search that was killed goes on by running its method again from the start on the rounds that its
folder holds, without walking them: the result is that of an undisturbed search, bit by bit, whatever the method keeps
in mind.
"""

import math
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb.compilation.options import kernel_pays
from mjx_climb.control import law_of
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.files import scenario_files
from mjx_climb.files.dataset import PACKAGES, OutputError
from mjx_climb.quantities.batches import batch_shape
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import PREFIX
from tuning.problem import evaluation, objectives, spaces
from tuning.problem import search as search_settings
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Goal, Judge
from tuning.problem.search import OWN_METHOD, Search
from tuning.searches import identity, result
from tuning.searches.finished_parts import Parts, saved_beside
from tuning.searches.methods import METHODS, Method, Points, Request, Task
from tuning.searches.methods.task import as_method, check_request
from tuning.searches.result import Result


class Progress(NamedTuple):
    """How far a search has come."""

    rounds: int
    rounds_in_all: int  # 0 where the method does not say
    phase: str
    best: float  # value of the best feasible point, NaN while there is none
    gradient_norm: float  # at the best point of the last round, NaN without gradients
    alive: int
    batch: int
    env_steps: int
    walked: bool  # False for a round that was found on disk
    seconds: float  # that the round took


def run(
    problem: Problem,
    search: Search,
    method: Method | None = None,
    *,
    out: Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Result:
    """Search a problem from start to end; what `tuning.tune` says of its arguments holds here.

    Raises:
        ConfigError: a method that asks for no points of the space.
        OutputError: the folder cannot be written, or holds an unfinished search for something else.
    """
    task = Task(problem, search, start_of(problem))
    kept = None if out is None else Parts(out, search_identity(problem, search, method))
    chosen = method or METHODS[search.method]
    rounds_in_all, points = chosen.rounds(task), chosen.run(task)
    arrays: dict[str, list[np.ndarray]] = {}
    spent, number, interrupted = 0, 0, False
    with saved_beside(kept) as save:
        try:
            request = next(points)
            while True:
                check_request(request, task)
                begin = time.perf_counter()
                stored = None if kept is None else kept.load(number)
                found = None if stored is None else restored(stored, request.theta, out)
                if found is None:
                    found = problem.evaluate(request.theta, request.directions)
                    save(number, stored_arrays(found, request.theta))
                spent += problem.env_steps(len(request.theta), request.tangents)
                _append(arrays, request, found, number, spent)
                number += 1
                if progress is not None:
                    took = time.perf_counter() - begin
                    progress(_progress(arrays, found, request, number, rounds_in_all, spent, stored is None, took))
                request = points.send(found)
        except StopIteration:
            pass
        except KeyboardInterrupt:
            if not arrays:
                raise
            interrupted = True
    joined = {name: np.concatenate(values) for name, values in arrays.items()}
    return result.from_history(problem, search, joined, interrupted=interrupted)


def settled(
    search: Search | None, method: str | Method | Callable[[Task], Points] | None, settings: Mapping[str, Any]
) -> tuple[Search, Method | None]:
    """Return the settings of a search, and the method where it is no shipped one.

    Raises:
        ConfigError: settings that make no sense, or a method that is none.
    """
    own = None if method is None or isinstance(method, str) else as_method(method)
    named = {} if method is None else {"method": OWN_METHOD if own else method}
    search = changed(search, {**settings, **named})
    if own is None and search.method == OWN_METHOD:
        raise ConfigError(f"method: expected the method itself where the settings say {OWN_METHOD}: tune(method=...)")
    return search, own


def for_this_machine(
    scenario: mc.Scenario,
    search: Search,
    chosen: Iterable[object] = (),
    engine: str = DEFAULT_ENGINE,
    law: mc.Law | None = None,
) -> Search:
    """Return settings with the method that is best here, where nobody has chosen one.

    Where a GPU's kernel walks thousands in the time of one, many points judged by their values go deeper, and sooner,
    than a few that follow their slopes. `chosen` is what the user gave that says how to search, settings and a method,
    each None where it was not given.
    """
    if any(given is not None for given in chosen):
        return search
    many = kernel_pays(engine, np.dtype(search.precision)) and spaces.space(scenario, search, law).size > 1
    return search.model_copy(update={"method": "cmaes"}) if many else search


def changed(search: Search | None, settings: Mapping[str, Any]) -> Search:
    """Return settings with some keys replaced, validated."""
    from tuning.problem.search import make

    if not settings:
        return search or Search()
    return make({**({} if search is None else search.model_dump()), **settings})


def problem_of(
    scenario: mc.Scenario,
    search: Search,
    function: Judge | None = None,
    numbers: mc.Parameters | None = None,
    engine: str = DEFAULT_ENGINE,
    *,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
) -> Problem:
    """Return what the settings ask to search: space, objective relative to pd, and walks.

    Raises:
        ConfigError: settings that make no sense for the scenario or the metrics.
    """
    if function is None and scenario.own is not None and scenario.own.objective is not None:
        name = scenario.own.objective.name
        raise ConfigError(f"own.objective: expected {name} again, in tuning.tune.tune(objective=...), got none")
    table = complete(metrics)
    search_settings.check_metrics(search, table)
    space = spaces.space(scenario, search, law)
    target: Goal
    if isinstance(function, Goal):
        target = function
    else:
        target = objectives.objective(scenario, search, evaluation.baseline(scenario, engine, table), function, table)
    members = 1 if numbers is None else math.prod(batch_shape(numbers))
    dtype = np.dtype(search.precision).type
    return Problem(scenario, space, target, numbers, members, dtype, engine, metrics=table, law=law, judge=function)


def complete(metrics: Iterable[mc.Metric]) -> mc.MetricTable:
    """Return metrics as a table with the shipped ones in it, by which searches know what failed.

    Raises:
        ConfigError: one of the shipped ones is missing or replaced.
    """
    table = mc.MetricTable(metrics)
    for metric in mc.METRICS:
        if metric not in table:
            raise ConfigError(f"metrics: expected the shipped {metric.name} among them, as in METRICS + (mine,)")
    return table


def start_of(problem: Problem) -> np.ndarray:
    """Return the law's own gains, and the scenario's of the joint loop, as a point of the space."""
    control = problem.scenario.control
    own = spaces.own_values(problem.scenario, problem.law or law_of(problem.scenario))
    return problem.space.from_gains({**own, "kp": control.kp, "kd": max(control.kd, 1e-12)})


def _append(arrays: dict[str, list[np.ndarray]], request: Request, found: Evaluation, number: int, spent: int) -> None:
    count = len(request.theta)
    columns = {
        "theta": np.asarray(request.theta, float),
        "value": found.value,
        "descent": found.descent,
        "penalty": found.penalty,
        "feasible": found.feasible,
        "gradient_norm": np.linalg.norm(found.gradient, axis=1) if request.tangents else np.full(count, np.nan),
        "round": np.full(count, number),
        "row": np.arange(count),
        "phase": np.full(count, request.phase),
        "env_steps": np.full(count, spent),
        **{name: found.metrics[name] for name in found.metrics if not name.startswith(PREFIX)},
    }
    for name, values in columns.items():
        arrays.setdefault(name, []).append(values)


def _progress(
    arrays: Mapping[str, list[np.ndarray]],
    found: Evaluation,
    request: Request,
    number: int,
    rounds: int,
    spent: int,
    walked: bool,
    took: float,
) -> Progress:
    feasible = [np.where(f, v, np.nan) for f, v in zip(arrays["feasible"], arrays["value"], strict=True)]
    every = np.concatenate(feasible)
    best = float(np.nanmin(every)) if np.isfinite(every).any() else float("nan")
    norm = float(arrays["gradient_norm"][-1][np.argmin(found.merit)])
    alive = int(found.alive.sum())
    return Progress(number, rounds, request.phase, best, norm, alive, len(request.theta), spent, walked, took)


def stored_arrays(found: Evaluation, theta: np.ndarray) -> dict[str, np.ndarray]:
    """Return a judged batch as named arrays, for `finished_parts`."""
    fields = {name: getattr(found, name) for name in Evaluation._fields if name != "metrics"}
    return {"theta": theta, **fields, **{f"metric_{name}": value for name, value in found.metrics.items()}}


def restored(stored: dict[str, np.ndarray], theta: np.ndarray, out: Path | None) -> Evaluation:
    """Return what `stored_arrays` gave for a batch.

    Raises:
        OutputError: it is of other points than `theta`.
    """
    if not np.array_equal(stored["theta"], theta):
        raise OutputError(f"{out}: expected the rounds of this search, got others (remove {out}/parts to start again)")
    metrics = {name.removeprefix("metric_"): value for name, value in stored.items() if name.startswith("metric_")}
    fields: dict[str, Any] = {name: stored[name] for name in Evaluation._fields if name != "metrics"}
    return Evaluation(**fields, metrics=metrics)


def search_identity(problem: Problem, search: Search, method: Method | None = None) -> dict[str, Any]:
    """Return all that determines a search, bit by bit."""
    packages = {**PACKAGES, "optax": "optax", "cmaes": "cmaes", "optuna": "optuna"}
    return {
        "scenario": scenario_files.identity(problem.scenario),
        "law": None if problem.law is None else identity.identity(problem.law, "law"),
        "search": search.to_yaml(),
        "method": None if method is None else identity.identity(method, "method"),
        "objective": None if problem.judge is None else identity.identity(problem.judge, "objective"),
        "numbers": None if problem.numbers is None else identity.identity(problem.numbers, "numbers"),
        "metrics": identity.of_metrics(problem.metrics),
        "engine": problem.engine,
        **identity.of_surroundings(problem.scenario, packages),
    }
