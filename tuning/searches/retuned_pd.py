"""pd with joint gains of its own for the same goal, and a law that plans: rivals without a force sensor."""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb.control import PD, PlannedTransfer
from mjx_climb.inputs.gait_values import GAIT, gait_of
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError
from tuning.gains.gains_file import applied, by_name
from tuning.methods import parts
from tuning.methods.rounds import Callback
from tuning.problem import spaces
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.readings import reads_forces
from tuning.problem.search import OWN_METHOD, Search
from tuning.problem.spaces import JOINT, default_bounds, follows
from tuning.results.tuned import Tuned
from tuning.searches import tune

NAME = "retuned_pd"  # in tables and files
PLANNED = "planned_transfer"
UNSEARCHED = "planned_unsearched"  # see `by_plan`
_COARSE = (12, 9)  # values of kp and kd
FINE = (24, 18)
_SEEN = mc.MetricTable(mc.METRICS[name] for name in ("force_variation", "peak_utilization", "diverged"))
LEAST = Objective(  # force variation in N while the grips hold
    (Term("force_variation", 1.0, 1.0, 1.0),), (Limit("peak_utilization", 1.0, 1.0, 0.0, "limit of the grips"),)
)
ROUNDS, POINTS = 2, 12  # of `least`: grids, of so many values of kp and of kd the first
HALVINGS = 2  # of the time step at most, for joint gains that it cannot follow
ON_A_GRID = "on a grid alone"
_ROUNDING = 1e-9


class Rival(NamedTuple):
    """A law without a force sensor, whose gains were searched, and perhaps the gait, by the keys of a scenario."""

    joint: Mapping[str, float]
    value: float  # of the goal
    lacks: str = ""  # restriction of the search; "" where all bounds were searched
    feasible: bool = True  # it keeps all limits
    step: float | None = None  # s, the time step of a comparison, where it is not the scenario's
    name: str = "pd"
    beside: str = ""  # another one with the same joint gains, in words


def search(
    problem: Problem,
    settings: Search,
    *,
    seeds: int = 1,
    out: str | os.PathLike[str] | None = None,
    progress: Callback | None = None,
    law: mc.Law | None = None,
) -> Tuned | None:
    """Search kp and kd of pd, or the gains of a `law` without a force sensor, as a law's gains were searched.

    Goal, walks, method and rounds are the same, and the gait.
    The time step is one that all kp and kd can follow, see `time_step_for`; where the law's own kp and kd were
    searched, it is the one of theirs. The best of `seeds` searches counts, as with a law's. `out` keeps each finished
    round in a folder of its own.
    None where the search was of pd itself.

    Raises:
        KeyboardInterrupt: the user stopped it; with `out` it goes on from there.
    """
    if problem.law is None and problem.scenario.control.controller == "pd":
        return None
    changed: dict[str, Any] = {"space": "isotropic", "inertia": False, "joint_gains": True}
    changed["also"] = tuple(name for name in settings.also if name in GAIT)
    changed["bounds"] = {name: span for name, span in settings.bounds.items() if name in JOINT or name in GAIT}
    changed |= {"pins": gait_of(settings.pins), "frozen": ()}
    if settings.method == OWN_METHOD and problem.own_method is None:  # of a result that was loaded
        changed |= {"method": "cmaes" if changed["also"] else "gradient", "starts": None, "iterations": None}
    settings, scenario = settings.model_copy(update=changed), under_pd(problem.scenario)
    space = spaces.space(scenario, settings, law)
    if JOINT.keys().isdisjoint(problem.space.gains):
        scenario = scenario.with_overrides({"time_step": time_step_for(problem.scenario, _highest(space))})
    rival = dataclasses.replace(problem, scenario=scenario, space=space, law=law)
    own = None if out is None else Path(out) / parts.FOLDER / (NAME if law is None else PLANNED)
    found = tune.from_seeds(rival, settings, seeds, out=own, progress=progress)
    if found.interrupted:
        raise KeyboardInterrupt
    return found


def can_plan(problem: Problem) -> bool:
    """Tell whether load transfer by plan is a rival: forces are read, and loads can be handed over.

    That takes a time on all feet, or a duty that is searched.
    """
    gait = problem.scenario.gait
    on_all_feet = "gait.duty" in problem.space.gains or len(gait.places) * (1 - gait.duty) < 1 - _ROUNDING
    return on_all_feet and reads_forces(problem)


def by_plan(problem: Problem) -> mc.Law | None:
    """Return load transfer by plan with its default gains, a rival on kp and kd of pd; None where no forces are read.

    It walks where a search of its own would take longer than what it is compared with.
    """
    return PlannedTransfer() if reads_forces(problem) else None


def walked_on_grid(
    scenario: mc.Scenario, counts: tuple[int, int] = _COARSE, parameters: mc.Parameters | None = None, **how: Any
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Simulate pd with kp and kd on a grid within the bounds of a search, and with the scenario's own.

    Walks with joint gains that the time step cannot follow count as diverged: they shake as no robot would.
    `parameters` (P) walk in place of the scenario's, all of them with each; `how` as of `mc.rollout_metrics`.

    Returns:
        kp and kd, (N,) each, and the metrics of their walks, (N) or (N, P).
    """
    pd = under_pd(scenario)
    bounds, own = default_bounds(pd, PD()), {"kp": pd.control.kp, "kd": pd.control.kd}
    axes = [np.append(np.geomspace(*bounds[name], count), own[name]) for name, count in zip(own, counts, strict=True)]
    gains = dict(zip(own, (values.ravel() for values in np.meshgrid(*axes)), strict=True))
    each = gains if parameters is None else {name: values[:, None] for name, values in gains.items()}
    found = mc.rollout_metrics(pd, each, parameters, unsteady=True, **how)
    walks = {name: np.asarray(value) for name, value in found.items()}
    steady = _followed(pd, gains).reshape(-1, *[1] * (walks["diverged"].ndim - 1))
    return gains, walks | {"diverged": walks["diverged"].astype(bool) | ~steady}


def _followed(scenario: mc.Scenario, joint: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return which of some joint gains (N,) each the time step can follow: with them all that are no higher in both."""
    pairs = np.stack([joint[name] for name in JOINT], 1)
    known = np.zeros(len(pairs), bool)
    for place in np.argsort(-pairs.prod(1)):
        if not known[place] and follows(scenario, dict(zip(JOINT, pairs[place], strict=True))):
            known |= (pairs <= pairs[place]).all(1)
    return known


def least(scenario: mc.Scenario, *, halvings: int = HALVINGS, engine: str = DEFAULT_ENGINE) -> Rival | None:
    """Search kp and kd with which pd has the least force variation and holds, None where it never does.

    By the tuner's grid over all of the bounds, then closer about the best: a sweep, which looks for the same among the
    gains of a law, is compared with it. The time step is halved so many times at most for kp and kd that it cannot
    follow; those that it then cannot are left out, which `Rival.lacks` says.
    """
    settings, pd = Search(method="grid", joint_gains=True, starts=POINTS, iterations=ROUNDS), under_pd(scenario)
    space = spaces.space(pd, settings)
    pd = pd.with_overrides({"time_step": time_step_for(scenario, _highest(space), halvings)})
    found = tune.run(Problem(pd, space, LEAST, engine=engine, metrics=_SEEN), settings)
    return rival_of(found) if found.feasible else None


def time_step_for(scenario: mc.Scenario, joint: Mapping[str, float], halvings: int = HALVINGS) -> float:
    """Return a time step, s, that joint gains can follow: the scenario's, halved up to so many times.

    It is the scenario's own where a law looks one time step ahead, and would be another one at another step.
    """
    control, step = scenario.control, scenario.time_step
    if control.reading == "measured_pose" and not scenario.hardware.control_period:
        return step
    for _ in range(halvings):
        try:
            shorter = scenario.with_overrides({"time_step": step / 2})
        except ConfigError:  # a delay of more time steps than are kept
            break
        if follows(scenario.with_overrides({"time_step": step}), joint):
            break
        step = shorter.time_step
    return step


def shared_step(scenario: mc.Scenario, searches: Iterable[Tuned]) -> float:
    """Return a time step, s, that the joint gains of all results of `search` can follow."""
    return min(time_step_for(scenario, joint_of(each)) for each in searches)


def walker(scenario: mc.Scenario, joint: Mapping[str, float]) -> mc.Scenario:
    """Return the scenario with pd in place of its law, with joint gains and a time step that they can follow."""
    return applied(under_pd(scenario), joint).with_overrides({"time_step": time_step_for(scenario, joint)})


def joint_of(found: Tuned) -> dict[str, float]:
    """Return kp and kd, and the gait where it was searched: pd has no other gains."""
    gains = by_name(found.gains)
    return {name: float(gains[name]) for name in (*JOINT, *GAIT) if name in gains}


def rival_of(retuned: Tuned, step: float | None = None) -> Rival:
    """Return the result of `search` as a rival, at a time step of both."""
    lacks = _lacks(retuned.scenario, _highest(spaces.space(retuned.scenario, retuned.search)))
    name = "pd" if retuned.law is None else type(retuned.law).__name__
    return Rival(joint_of(retuned), retuned.value, lacks, retuned.feasible, step, name)


def _lacks(scenario: mc.Scenario, highest: Mapping[str, float]) -> str:
    return "" if follows(scenario, highest) else f"within what a time step of {scenario.time_step:g} s can follow"


def _highest(space: spaces.Space) -> dict[str, float]:
    return {name: high for name, high in zip(space.names, np.exp(space.upper), strict=True) if name in JOINT}
