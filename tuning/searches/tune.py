"""The search for the gains of a law: `tuning.tune`, and over an ensemble of walks `tuning.robust`."""

import contextlib
import dataclasses
import functools
import itertools
import math
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.control import law_of
from mjx_climb.execution.batch_axes import batch_shape
from mjx_climb.files.dataset import PACKAGES
from mjx_climb.inputs.gait_values import own_gait
from mjx_climb.inputs.own_objects import in_one_line, load, reference_to
from mjx_climb.inputs.resolve import by_name
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError
from tuning.methods import Method, Points, Request, Task, cmaes, method_of
from tuning.methods.method import own_points
from tuning.methods.parts import FOLDER, identity_of
from tuning.methods.rounds import Callback, Progress, Rounds, follow, settled
from tuning.problem import ensemble as ensembles
from tuning.problem import evaluation, known, objectives, spaces
from tuning.problem import search as search_settings
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Goal, OwnObjective
from tuning.problem.search import METHODS, OWN_METHOD, ROBUST_WEIGHTS, Judge, Search
from tuning.problem.spaces import JOINT, to_gains64
from tuning.results.tuned import CHECKED, Robust, Tuned, from_rounds, of_seeds

FINALISTS = 8  # points at least that are checked, the scenario's own gains among them
MOST = 32  # of them, where a GPU walks hundreds in a round: to find so many apart among all points takes seconds
NEAR = 0.02  # root mean square difference, relative to the bounds' widths, below which two points are one finalist

OwnMethod = str | Method | type[Method] | Callable[[Task], Points]  # a method, or the name of one


def tune(
    scenario: mc.Scenario,
    search: Search | None = None,
    *,
    seeds: int = 1,
    out: str | os.PathLike[str] | None = None,
    progress: Callback | None = None,
    method: OwnMethod | None = None,
    law: mc.Law | None = None,
    objective: OwnObjective | str | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    parameters: mc.Parameters | None = None,
    ensemble: Ensemble | None = None,
    engine: str = DEFAULT_ENGINE,
    **settings: Any,
) -> Tuned:
    """Search the gains of a control law.

    `tuning.write(tuning.tune(scenario, space="diagonal", out="results/mine"), "results/mine")` is `mjx-climb tune`.

    Arguments:
        scenario: robot, gait and ground.
        law: whose gains are searched; its own are the first start. The scenario's where None.
        search: the settings; `settings` are keys of `tuning.problem.search.Search` in place of it or to change it.
        seeds: how many searches, from the seed of the settings on; the best counts.
        method: the name of a shipped one, `optuna:SAMPLER`, or FILE.py:NAME; or one of your own, as a
            `tuning.methods.Method`, or a function that yields a `Request` of points and receives their evaluation.
            It must ask for the same when it is given the same.
        objective: a pure function of the metrics in place of the weighted terms, see `tuning.problem.objectives`; or
            FILE.py:NAME of one.
        metrics: of the walks, as `mjx_climb.METRICS + (mine,)`; weights, limits and the objective may name them.
        parameters: in place of the scenario's; with leading axes (members, 1), an ensemble over which the score is the
            mean.
        ensemble: over which the gains are searched, see `robust`.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        out: a folder that keeps each finished round, so that an interrupted search goes on from there; until the
            result is written there, or `tuning.methods.parts.clear(out)`.
        progress: called after each round.

    Returns:
        The best gains and all points that were evaluated. Ctrl-C ends the search with the best so far (`interrupted`).

    Raises:
        ConfigError: settings that make no sense for the scenario, or a method that asks for no points of the space.
        OutputError: the folder cannot be written, or holds an unfinished search for something else.
        Unidentifiable: with `out`, an objective or method that cannot be told from another; see
            `mjx_climb.execution.contents`.
    """
    over = (search or Search()).changed(settings) if ensemble is None else over_ensemble(search, settings, ensemble)
    wanted, space, own = prepare(scenario, over, (search, method, settings.get("method")), method, law)
    goal: OwnObjective | None = None
    if ensemble is None:
        scenario, goal = own_objective(scenario, objective)
    elif objective is not None:
        raise ConfigError("", "objective", "none with an ensemble, whose members are scored by weights")
    walks: dict[str, Any] = {"law": law, "metrics": metrics, "engine": engine, "own_method": own}
    problem = problem_of(scenario, wanted, goal, ensemble=ensemble, space=space, **walks)
    if parameters is not None:
        problem = dataclasses.replace(problem, parameters=parameters, members=math.prod(batch_shape(parameters)))
    return from_seeds(problem, wanted, seeds, out=out, progress=progress)


def robust(
    scenario: mc.Scenario,
    ensemble: Ensemble,
    search: Search | None = None,
    *,
    judges: int = Judge().members,
    **how: Any,
) -> Robust:
    """Search the gains that do best over an ensemble: `tuning.tune`, whose arguments `how` has, with its walks.

    Where no weights are given, those of a plain search and the peak pulling force count alike. `judges` is how many
    walks of a fresh draw test the result.
    `tuning.write(tuning.robust(scenario, ensemble, out="results/mine"), "results/mine")` is
    `mjx-climb tune --ensemble`.
    """
    found = tune(scenario, search, ensemble=ensemble, **how)
    assert isinstance(found, Robust)
    return dataclasses.replace(found, judges=judges)


def over_ensemble(settings: Search | None, changes: Mapping[str, Any], ensemble: Ensemble) -> Search:
    """Return settings with some keys replaced; without any, those of a robust search.

    The joint loop is searched where the ensemble has hardware and the settings do not say.
    """
    settings = (settings or Search(weights=ROBUST_WEIGHTS)).changed(dict(changes))
    silent = settings.joint_gains is None and ensemble.hardware is not None
    return settings.model_copy(update={"joint_gains": True}) if silent else settings


class Prepared(NamedTuple):
    """The settings of a search, resolved before anything walks."""

    search: Search  # with the method that is used
    space: spaces.Space
    method: Method | None  # of the user's own


def prepare(
    scenario: mc.Scenario,
    search: Search,
    chosen: Iterable[object] = (),
    method: OwnMethod | None = None,
    law: mc.Law | None = None,
) -> Prepared:
    """Return settings with the method that is best here, where none of `chosen` (None: not given) says how to search.

    Raises:
        ConfigError: settings that make no sense for the scenario, or a method that cannot search their space.
    """
    space = spaces.space(scenario, search, law)
    if all(given is None for given in chosen):
        search = _for_this_machine(search, space)
    search, own = own_method(search, scenario, method)
    check_method(search, own, space)
    return Prepared(search, space, own)


def own_method(search: Search, scenario: mc.Scenario, given: OwnMethod | None = None) -> tuple[Search, Method | None]:
    """Return the settings, and the method of the user's own where they or `given` name one; None of a shipped one.

    Raises:
        ConfigError: there is no such method, or the settings say `own` and the scenario's `own.method` names none.
    """
    search = search.changed({"method": given}) if isinstance(given, str) else search
    named = search.method if given is None else given
    if named == OWN_METHOD:
        own = None if scenario.own is None else scenario.own.method
        if own is None:
            raise ConfigError("", "method", f"own.method in the scenario, or tune(method=...), with {OWN_METHOD}")
        named = reference_to(own, "own.method", "scenario")
    if isinstance(named, str) and named.partition(":")[0] in METHODS:
        return search, None
    return search.model_copy(update={"method": OWN_METHOD}), method_of(named)


def own_objective(
    scenario: mc.Scenario, given: OwnObjective | str | None = None
) -> tuple[mc.Scenario, OwnObjective | None]:
    """Return a scenario that names no objective, and the user's own: `given`, FILE.py:NAME, or the scenario's.

    Raises:
        ConfigError: there is no such objective.
    """
    own, named = None if scenario.own is None else scenario.own.objective, given
    if own is not None:
        named = reference_to(own, "own.objective", "scenario") if given is None else given
        scenario = scenario.with_own(objective=None)
    if not isinstance(named, str):
        return scenario, named
    found, file, name = load(named, "function")
    if not callable(found) and not isinstance(found, Goal):
        raise ConfigError(file, "", f"{name} to be a function of the metrics", f"{found!r}")
    return scenario, found


def check_method(search: Search, own: Method | None, space: spaces.Space) -> None:
    """Refuse by a ConfigError, before anything walks, a method that cannot search a space or is not installed."""
    with in_one_line("method") if own is not None else contextlib.nullcontext():
        (own or method_of(search.method)).check(space, search)


def from_seeds(
    problem: Problem, search: Search, seeds: int, *, out: str | os.PathLike[str] | None, progress: Callback | None
) -> Tuned:
    """Search a problem from several seeds and return the best; arguments, result and errors as of `tune`.

    `progress` counts the rounds of all seeds; those of further seeds are kept in folders of their own below `out`.
    """
    found, rounds = list[Tuned](), itertools.count(1)

    def told(now: Progress) -> None:
        if progress is not None:
            phase = f"seed {search.seed + len(found)}, {now.phase}" if seeds > 1 else now.phase
            progress(now._replace(rounds=next(rounds), rounds_in_all=seeds * now.rounds_in_all, phase=phase))

    while len(found) < seeds and not (found and found[-1].interrupted):
        own = search.model_copy(update={"seed": search.seed + len(found)})
        kept = Path(out) / FOLDER / f"seed-{own.seed}" if found and out is not None else out
        found.append(run(of_search(problem, own, len(found)), own, out=kept, progress=told))
    return of_seeds(found) if len(found) > 1 else found[0]


def of_search(problem: Problem, search: Search, number: int) -> Problem:
    """Return the problem of the search of this number, from 0 on: each draws walks of its own from an ensemble."""
    if number == 0 or problem.ensemble is None:
        return problem
    return redrawn(problem, search, ensembles.of_search(problem.ensemble, number))


def redrawn(problem: Problem, search: Search, ensemble: Ensemble) -> Problem:
    """Return a problem over the walks of another ensemble, which pd walks first; its own ensemble stays named."""
    walks: dict[str, Any] = {"law": problem.law, "metrics": problem.metrics, "engine": problem.engine}
    walks |= {"own_method": problem.own_method, "space": problem.space}
    found = problem_of(problem.scenario, search, problem.own_objective, ensemble=ensemble, **walks)
    return dataclasses.replace(found, ensemble=problem.ensemble)


def run(
    problem: Problem,
    search: Search,
    *,
    patience: int | None = None,
    out: str | os.PathLike[str] | None = None,
    progress: Callback | None = None,
) -> Tuned:
    """Search a problem from start to end; further arguments, result and errors as of `tune`.

    Over an ensemble the best points and the start walk once more at the end, through a draw that no point was chosen
    by: the best there is the result, so that no search ends at gains that are good on its own walks alone.

    Arguments:
        patience: evaluations without a better point after which the search has converged and ends, see
            `tuning.methods.rounds.settled`; the method's own end where None.
    """
    start = start_of(problem)
    task, method = Task(problem, search, start, known.others(problem, start)), problem.own_method
    points = method_of(search.method).run(task) if method is None else own_points(method, task)
    method = method or method_of(search.method)
    more = {} if patience is None else {"patience": patience}
    own, interrupted = functools.partial(search_identity, problem, search, **more), False
    first: Request | None = None
    checks = problem.ensemble is not None and not isinstance(problem.own_objective, Goal)
    in_all = method.rounds(task)
    with Rounds(in_all + checks if in_all else 0, out, own, progress) as rounds:

        def evaluate(request: Request) -> Evaluation:
            nonlocal first
            first = first or request
            return rounds.evaluate(problem, request)

        def enough() -> bool:
            return patience is not None and settled(rounds.evaluated["value"] + rounds.evaluated["penalty"], patience)

        try:
            ended = follow(points, evaluate, enough) or rounds.done < in_all
            if checks and first is not None:
                assert problem.ensemble is not None
                apart = redrawn(problem, search, ensembles.fresh(problem.ensemble, ensembles.Use.CHECK))
                asked = finalists(problem.space, first, rounds.evaluated, start)
                rounds.in_all = in_all and rounds.done + len(asked)
                for request in asked:
                    rounds.evaluate(apart, request)
        except KeyboardInterrupt:
            if not rounds.done:
                raise
            interrupted = True
    found = from_rounds(problem, search, rounds.evaluated, interrupted=interrupted)
    if patience is not None:
        found.data.attrs["converged"] = int(not interrupted and ended)
    return found


def finalists(
    space: spaces.Space, first: Request, evaluated: Mapping[str, np.ndarray], start: np.ndarray
) -> list[Request]:
    """Return the start and the best of other points that lie apart, in rounds as the first: no new program is compiled.

    Neighbours fare alike: where the best breaks a limit on other walks, so do those beside it.
    """
    theta, merit = evaluated["theta"], evaluated["value"] + evaluated["penalty"]
    ranked = theta[np.argsort(np.where(np.isfinite(merit), merit, np.inf), kind="stable")]
    ranked, chosen, size = ranked[(ranked != start).any(1)], [start], len(first.theta)
    rounds = math.ceil(FINALISTS / size)
    while len(ranked) and len(chosen) < min(rounds * size, MOST):
        chosen.append(ranked[0])
        away = ((ranked - ranked[0]) / (space.upper - space.lower)) ** 2
        ranked = ranked[away.mean(1) > NEAR**2]
    points = np.resize(chosen, (rounds, size, start.size))
    return [Request(each, first.directions, CHECKED) for each in points]


def _for_this_machine(search: Search, space: spaces.Space) -> Search:
    """Return settings with the method that is best here.

    Where a GPU's kernel walks thousands in the time of one, many points compared by their values go deeper, and sooner,
    than a few that follow their gradients. Times of the gait have no gradients to follow.
    """
    method = search.method
    few = space.size <= cmaes.CMAES.most
    if few and (not space.smooth.all() or execution.many_at_once(np.dtype(search.precision))):
        method = "cmaes" if space.size > 1 else method if space.smooth.all() else "grid"
    return search.model_copy(update={"method": method})


def problem_of(
    scenario: mc.Scenario,
    search: Search,
    objective: OwnObjective | None = None,
    *,
    ensemble: Ensemble | None = None,
    space: spaces.Space | None = None,
    **walks: Any,
) -> Problem:
    """Return the problem of a search: space, objective relative to pd, and walks; pd walks first.

    `walks` are law, metrics and engine, as of `tune`, and `own_method`; an ensemble is drawn for the scenario. `space`
    is that of the settings, where it is known.

    Raises:
        ConfigError: settings that make no sense for the scenario or the metrics, or pd diverges in a member.
    """
    if objective is None and scenario.own is not None and scenario.own.objective is not None:
        raise ConfigError("", "own.objective", "none but in a plain search", scenario.own.objective.name)
    problem = without_goal(scenario, search, space, over_ensemble=ensemble is not None, **walks)
    problem = dataclasses.replace(problem, own_objective=objective)
    if isinstance(objective, Goal):
        return dataclasses.replace(problem, objective=objective)
    table, engine, worst = problem.metrics, problem.engine, None
    baseline: Mapping[str, Any]
    if ensemble is None:
        baseline = evaluation.baseline(scenario, engine, table)
    else:
        drawn, worst = ensembles.draw(scenario, ensemble), ensemble.worst
        problem = dataclasses.replace(problem, parameters=drawn, members=ensemble.members, ensemble=ensemble)
        each = evaluation.pd_of(scenario, drawn, engine=engine, metrics=table)
        baseline = {name: value.reshape(-1) for name, value in each.items()}
    return dataclasses.replace(problem, objective=objectives.objective(search, baseline, objective, table, worst))


def without_goal(
    scenario: mc.Scenario,
    search: Search,
    space: spaces.Space | None = None,
    *,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    over_ensemble: bool = False,
    **walks: Any,
) -> Problem:
    """Return the problem of a search without an objective yet; `walks` are law and engine, `space` as of `problem_of`.

    Raises:
        ConfigError: settings that make no sense, joint gains of which the time step can follow none, or a shipped
            metric, from which searches know failures, is missing.
    """
    table = mc.MetricTable(metrics)
    if missing := [metric.name for metric in mc.METRICS if metric not in table]:
        raise ConfigError("", "metrics", f"the shipped {missing[0]} among them, as in METRICS + (mine,)")
    search_settings.check_metrics(search, table, over_ensemble=over_ensemble)
    space, dtype = space or spaces.space(scenario, search, walks.get("law")), np.dtype(search.precision).type
    if search.method != OWN_METHOD and method_of(search.method).gradients and not space.smooth.all():
        times = ", ".join(name for name, smooth in zip(space.names, space.smooth, strict=True) if not smooth)
        raise ConfigError("", "method", f"cmaes, grid or optuna to search {times} in whole steps", search.method)
    lowest = by_name(to_gains64(space, space.lower))
    joint = {f"control.{name}": float(value) for name, value in lowest.items() if name in JOINT}
    check_time_step(scenario.with_overrides(joint), "bounds" if joint else "scenario")
    return Problem(scenario, space, dtype=dtype, metrics=table, **walks)


def start_of(problem: Problem) -> np.ndarray:
    """Return the law's own gains, and the scenario's of joint loop and gait, as a point of the space."""
    control = problem.scenario.control
    own = spaces.own_values(problem.scenario, problem.law or law_of(problem.scenario))
    joint = {"kp": control.kp, "kd": max(control.kd, 1e-12), "ki": max(control.ki, 1e-12)}
    return problem.space.from_gains({**own, **own_gait(problem.scenario), **joint})


def search_identity(problem: Problem, search: Search, **more: Any) -> dict[str, Any]:
    """Return all that determines a search, bit by bit, with `more`."""
    packages = {**PACKAGES, "cmaes": "cmaes", "optuna": "optuna"}
    return {**identity_of(problem, packages), "search": search.model_dump(mode="json"), **more}
