"""Walks side by side: their gains and metrics by name, which metrics differ, all of them at one time step."""

from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import mjx_climb as mc
from mjx_climb import METRICS, Gains, MetricTable, Trajectory
from mjx_climb.control import PlannedTransfer
from tuning.background import Begin, Stage, Work
from tuning.gains.gains_file import by_name
from tuning.methods.rounds import counted
from tuning.numbers import change, failed, is_number, number
from tuning.problem.evaluation import Problem, walk_of_any
from tuning.problem.search import Search
from tuning.results.tuned import Tuned
from tuning.searches import retuned_pd

VARIATION = "force_variation"
LEVEL = "at the time step of pd retuned"  # the name of a walk
Values = Mapping[str, Any]
Compared = Mapping[str, tuple[Values | None, Values]]  # gains (None for a controller without) and metrics by name
Walker = tuple[mc.Scenario, mc.Law | None]


class AtOneStep(NamedTuple):
    """Gains beside pd retuned, both at the time step that its kp and kd need, which is not the scenario's."""

    step: float  # s
    change: float  # relative, of the goal of the search; NaN where there is no walk of ours


def gains_of(walk: Trajectory) -> dict[str, Any] | None:
    """Return the gains of a walk as they were given, None where its controller has none."""
    if walk.law:
        return by_name(walk.gains)
    control = walk.scenario.control
    return None if control.controller == "pd" else {name: getattr(control, name) for name in Gains.AXES}


def differences(
    metrics: Values, baseline: Values, about: MetricTable = METRICS, but: Container[str] = ()
) -> tuple[list[str], list[str]]:
    """Return which metrics are worse than under the baseline, as "base deviation +414 %", and which are better.

    All but some, where they differ by more than 2 %; none where either walk failed.
    """
    found: tuple[list[str], list[str]] = [], []  # worse, better
    for name, value in metrics.items() if not (failed(metrics) or failed(baseline)) else ():
        base = baseline[name]
        if name not in but and is_number(value) and is_number(base) and abs(value - base) > 0.02 * abs(base):
            text = f"{change(value, base)} %" if base > 0 else f"{number(base)} to {number(value)}"
            better = (value > base) == about[name].larger_is_better
            found[better].append(f"{about.in_words(name)} {text}")
    return found


def one_walk(scenario: mc.Scenario, law: mc.Law | None, engine: str) -> Work[mc.Trajectory]:
    """Return a work that simulates one robot under the scenario's law, or another."""
    return lambda _: mc.rollout(scenario, law=law, engine=engine)


def walks_together(problem: Problem, walkers: Mapping[str, Walker], begin: Begin) -> dict[str, Work[mc.Trajectory]]:
    """Begin the walks of some robots beside a problem's law, by as few compiled programs as there can be.

    Pd, base admittance and load transfer by plan share one, see `walk_of_any`.
    """
    control, plan = problem.scenario.control, retuned_pd.by_plan(problem)
    shared = problem.law is None and (control.controller, control.reading) == ("base_admittance", "virtual_model")

    def walking(scenario: mc.Scenario, law: mc.Law | None) -> Work[mc.Trajectory]:
        if shared and isinstance(law, PlannedTransfer | None):
            return lambda _: walk_of_any(scenario, law, problem.engine, beside=plan)
        return one_walk(scenario, law, problem.engine)

    return {name: begin(walking(*walker)) for name, walker in walkers.items()}


def beside_retuned(problem: Problem, joint: Mapping[str, float], ours: Walker | None) -> dict[str, Walker]:
    """Return the rivals with joint gains of pd, at as short a time step as these need, and as `LEVEL` ours at it.

    They are pd and `retuned_pd.by_plan`. `LEVEL` tells how much of a difference comes from the step; there is none
    where that step is the scenario's.
    """
    scenario = problem.scenario
    alone, plan = retuned_pd.walker(scenario, joint), retuned_pd.by_plan(problem)
    found: dict[str, Walker] = {retuned_pd.NAME: (alone, None)}
    found |= {} if plan is None else {retuned_pd.UNSEARCHED: (alone, plan)}
    if ours is not None and alone.time_step != scenario.time_step:
        own, law = ours
        found[LEVEL] = own.with_overrides({"time_step": alone.time_step}), law
    return found


def planned(problem: Problem, search: Search, seeds: int, out: Path | None) -> Work[Tuned | None] | None:
    """Return a work that searches `PlannedTransfer` as the gains were searched; None where it is no rival."""
    return retuned(problem, search, seeds, out, PlannedTransfer()) if retuned_pd.can_plan(problem) else None


def retuned(
    problem: Problem, search: Search, seeds: int, out: Path | None, law: mc.Law | None = None
) -> Work[Tuned | None]:
    """Return a work that searches kp and kd of pd, or a `law`, as the gains were searched; `out` keeps its rounds."""
    return lambda report: retuned_pd.search(problem, search, seeds=seeds, out=out, law=law, progress=counted(report))


def rivals(pd: Work[Tuned | None], plan: Work[Tuned | None] | None, stage: Stage) -> tuple[Tuned | None, Tuned | None]:
    """Return pd retuned, and load transfer by plan where it is a rival, each searched in a stage of its own."""
    with stage("retuned pd", unit="rounds") as told:
        retuned = pd(told)
    if plan is None:
        return retuned, None
    with stage("load transfer by plan", unit="rounds") as told:
        return retuned, plan(told)
