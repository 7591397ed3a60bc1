"""One search from start to end: rounds of points are judged, kept on disk, and told to the method.

A method is a generator: it yields the points that it wants judged and receives what they are worth. It is
deterministic, so a search that was killed goes on by running its method again from the start on the rounds that its
folder holds, without walking them: the result is that of an undisturbed search, bit by bit, whatever the method keeps
in mind.
"""

import hashlib
import importlib.metadata
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.files import scenario_files
from mjx_climb.files.dataset import PACKAGES, OutputError
from mjx_climb.quantities.batches import batch_shape
from mjx_climb.robot.constants import model_path
from tuning.problem import evaluation, objectives, spaces
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Goal, Judge
from tuning.problem.search import Search
from tuning.searches import identity, result
from tuning.searches.finished_parts import Parts
from tuning.searches.methods import METHODS, Request, Task
from tuning.searches.result import Result


class Progress(NamedTuple):
    """How far a search has come."""

    rounds: int
    rounds_in_all: int
    phase: str
    best: float  # value of the best feasible point, NaN while there is none
    gradient_norm: float  # at the best point of the last round, NaN without gradients
    alive: int
    batch: int
    env_steps: int
    walked: bool  # False for a round that was found on disk
    seconds: float  # that the round took


def tune(
    scenario: mc.Scenario,
    search: Search | None = None,
    *,
    objective: Judge | None = None,
    numbers: mc.Parameters | None = None,
    engine: str = DEFAULT_ENGINE,
    out: Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    **settings: Any,
) -> Result:
    """Search the gains of a scenario's controller.

    Arguments:
        scenario: what walks where; its own gains are the first start.
        search: the settings; `settings` are keys of `tuning.problem.search.Search` in place of it or to change it, as
            in `tune(scenario, method="gradient", space="diagonal")`.
        objective: a pure function of the metrics in place of the weighted terms, see
            `tuning.problem.objectives.Objective`.
        numbers: parameters in place of the scenario's; with leading axes (members, 1), an ensemble over which the
            score is the mean.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        out: a folder that keeps each finished round, so that an interrupted search goes on from there. The rounds
            stay until `finished_parts.clear(out)`.
        progress: called after each round.

    Returns:
        The best gains and all that was judged. Ctrl-C ends the search with the best so far (`interrupted`).

    Raises:
        ConfigError: settings that make no sense for the scenario.
        OutputError: the folder cannot be written, or holds an unfinished search for something else.
        Unidentifiable: with `out`, an objective that cannot be told from another, see `tuning.searches.identity`.
    """
    search = changed(search, settings)
    problem = problem_of(scenario, search, objective, numbers, engine)
    task = Task(problem, search, start_of(problem))
    method = METHODS[search.method]
    kept = None if out is None else Parts(out, _identity(problem, search, objective))
    rounds_in_all, points = method.rounds(task), method.run(task)
    arrays: dict[str, list[np.ndarray]] = {}
    spent, number, interrupted = 0, 0, False
    try:
        request = next(points)
        while True:
            begin = time.perf_counter()
            stored = None if kept is None else kept.load(number)
            found = None if stored is None else _restored(stored, request.theta, out)
            if found is None:
                found = problem.evaluate(request.theta, request.directions)
                if kept is not None:
                    kept.save(number, _stored(found, request.theta))
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
    return result.from_history(scenario, search, problem.space, joined, interrupted=interrupted)


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
) -> Problem:
    """Return what the settings ask to search: space, objective relative to pd, and walks."""
    space = spaces.space(scenario, search)
    target: Goal
    if isinstance(function, Goal):
        target = function
    else:
        target = objectives.objective(scenario, search, evaluation.baseline(scenario, engine), function)
    members = 1 if numbers is None else math.prod(batch_shape(numbers))
    dtype = np.dtype(search.precision).type
    return Problem(scenario, space, target, numbers, members, dtype, engine)


def start_of(problem: Problem) -> np.ndarray:
    """Return the scenario's own gains as a point of the space."""
    control = problem.scenario.control
    six = {name: np.asarray(getattr(control, name), float) for name in mc.Gains.AXES}
    return problem.space.from_gains(mc.Gains(**six, kp=control.kp, kd=max(control.kd, 1e-12)))


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
        **{name: found.metrics[name] for name in mc.METRICS.names},
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


def _stored(found: Evaluation, theta: np.ndarray) -> dict[str, np.ndarray]:
    fields = {name: getattr(found, name) for name in Evaluation._fields if name != "metrics"}
    return {"theta": theta, **fields, **{f"metric_{name}": value for name, value in found.metrics.items()}}


def _restored(stored: dict[str, np.ndarray], theta: np.ndarray, out: Path | None) -> Evaluation:
    if not np.array_equal(stored["theta"], theta):
        raise OutputError(f"{out}: expected the rounds of this search, got others (remove {out}/parts to start again)")
    metrics = {name.removeprefix("metric_"): value for name, value in stored.items() if name.startswith("metric_")}
    fields: dict[str, Any] = {name: stored[name] for name in Evaluation._fields if name != "metrics"}
    return Evaluation(**fields, metrics=metrics)


def _identity(problem: Problem, search: Search, function: Judge | None) -> dict[str, Any]:
    """Return all that determines a search, bit by bit."""
    versions: dict[str, str | None] = {}
    for name, distribution in {**PACKAGES, "optax": "optax", "cmaes": "cmaes", "optuna": "optuna"}.items():
        try:
            versions[name] = importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    return {
        "scenario": scenario_files.identity(problem.scenario),
        "search": search.to_yaml(),
        "objective": None if function is None else identity.identity(function, "objective"),
        "numbers": None if problem.numbers is None else identity.identity(problem.numbers, "numbers"),
        "engine": problem.engine,
        "platform": jax.default_backend(),
        "robot_model": hashlib.sha256(model_path(problem.scenario.robot).read_bytes()).hexdigest(),
        "versions": versions,
    }
