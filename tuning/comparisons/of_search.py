"""Gains that a search found beside pd, pd retuned and the scenario's own: walks, the map around them, their tests."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import PD
from mjx_climb.inputs.gait_values import own_gait
from tuning.background import Begin, Callback, Stage, Work, background, ignore, silent
from tuning.comparisons import maps, margins, verdicts, verification
from tuning.comparisons.side_by_side import (
    LEVEL,
    VARIATION,
    AtOneStep,
    Compared,
    Values,
    beside_retuned,
    gains_of,
    planned,
    retuned,
    rivals,
    walks_together,
)
from tuning.comparisons.worth import Worth, best_without, between, give_joint_gains
from tuning.gains.gains_file import Whole
from tuning.methods import method_of
from tuning.numbers import failed
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.objectives import Goal
from tuning.problem.search import OWN_METHOD, Search
from tuning.problem.spaces import INTEGRAL, JOINT, searches_gait
from tuning.results.tuned import Tuned
from tuning.searches import retuned_pd
from tuning.searches.tune import start_of


class Begun(NamedTuple):
    """The rivals of a search, independent of its result: works that may begin before it."""

    retuned: Work[Tuned | None]  # pd retuned
    planned: Work[Tuned | None] | None  # load transfer by plan, where it is a rival
    walks: Mapping[str, Work[mc.Trajectory]]  # pd, config
    over: Work[xr.Dataset | None] | None  # the map; None where it depends on the result
    on_hardware: Mapping[str, Work[xr.Dataset]]  # pd, config: the first walks on worse hardware


def begin(problem: Problem, search: Search, start: Begin, *, seeds: int = 1, out: Path | None = None) -> Begun:
    """Begin the rivals of a search from so many seeds.

    `out` holds the rounds of the search that retunes pd until the result is there.
    """
    scenario, law, engine = problem.scenario, problem.law, problem.engine
    # one map serves all results: they differ in the gains that it sweeps alone
    on_the_map = law is None and not search.pins and {*problem.space.gains} <= {"stiffness", "damping"}
    plan = planned(problem, search, seeds, out)
    return Begun(
        start(retuned(problem, search, seeds, out)),
        None if plan is None else start(plan),
        walks_together(problem, {"pd": (under_pd(scenario), None), "config": (scenario, law)}, start),
        start(lambda report: verification.map_around(problem, report)) if on_the_map else None,
        {
            "pd": start(lambda report: margins.on_the_grid(scenario, margins.pd_of(scenario), engine, report)),
            "config": start(lambda report: margins.on_the_grid(scenario, Whole(law, {}), engine, report)),
        },
    )


def load_tests(problem: Problem, search: Search, start: Begin) -> None:
    """Begin to load the executable of a result's tests, which takes long, where the search does not use it."""
    if search.method == OWN_METHOD or not method_of(search.method).gradients:
        start(lambda _: verification.slopes_at(problem, start_of(problem)))


@dataclasses.dataclass(frozen=True)
class TuneComparison:
    """A result beside the scenario's own gains and pd, walked in double precision, and its tests."""

    walks: Mapping[str, mc.Trajectory]  # pd, config, tuned, retuned_pd, and load transfer by plan, searched or not
    over: xr.Dataset | None  # the map around it
    hardware: margins.Found  # on worse hardware
    checked: verification.Verification
    rows: Compared  # tuned, retuned_pd, load transfer by plan, config, pd
    broken: Mapping[str, list[str]]  # limits that these break, in words
    worth: Worth | None  # of a force sensor: the result against pd retuned
    verdict: str  # the result against the best of the others
    level: AtOneStep | None = None  # where pd retuned walks at a time step of its own


def compare(found: Tuned, stage: Stage = silent, out: Path | None = None, begun: Begun | None = None) -> TuneComparison:
    """Simulate a result, its rivals and the map around it, and test it.

    Arguments:
        found: the result.
        stage: opened for each longer work.
        out: a folder that keeps the rounds of the search that retunes pd.
        begun: the result of `begin`, where it was begun before the search.
    """
    scenario, problem, engine = found.scenario, found.problem, found.problem.engine
    ours = found.walked.scenario, found.walked.law
    with background() as start:
        tested = start(lambda _: verification.tests(found))  # the longest to compile
        others = begun or begin(problem, found.search, start, seeds=found.seeds, out=out)
        mapped = others.over or start(lambda told: verification.map_of(found, progress=told))
        walking = {**others.walks, **walks_together(problem, {"tuned": ours}, start)}
        rival, plan = rivals(others.retuned, others.planned, stage)
        if plan is not None:
            of_plan = {retuned_pd.PLANNED: (plan.walked.scenario, plan.walked.law)}
            walking |= walks_together(problem, of_plan, start)
        beside_it = {"config": Whole(problem.law, {})}
        joint, step = {} if rival is None else retuned_pd.joint_of(rival), None
        if rival is not None:
            beside = beside_retuned(problem, joint, ours)
            if plan is not None:
                del beside[retuned_pd.UNSEARCHED]
            walking |= walks_together(problem, beside, start)
            if LEVEL in beside:
                step = beside[LEVEL][0].time_step
            else:
                beside_it[margins.RETUNED] = Whole(PD(), joint)

        def find_margins(told: Callback) -> margins.Found:
            walked = {name: asked(ignore) for name, asked in others.on_hardware.items()}  # begun before this
            how: dict[str, Any] = {"law": found.law, "engine": engine, "retuned_step": step}
            return margins.find(scenario, found.gains, others=beside_it, walked=walked, progress=told, **how)

        margin, walks, level = start(find_margins), {}, walking.pop(LEVEL, walking["tuned"])
        for name, walk in walking.items():
            with stage(name) as told:
                walks[name] = walk(told)
        metrics = {name: mc.metrics(walk, problem.metrics) for name, walk in walks.items()}
        with stage("map") as told:
            over = mapped(told)
        with stage("margins") as told:
            hardware = margin(told)
        with stage("verification"):
            checked = verification.verify(
                found, metrics=metrics["tuned"], walks=over, hardware=hardware, tested=tested(ignore)
            )
        at_step = None if step is None else (step, mc.metrics(level(ignore), problem.metrics))
    walked = {name: (with_joint_gains(walk, problem), metrics[name]) for name, walk in walks.items()}
    rows, broken, worth, said, apart = conclusions(found, walked, (rival, plan), at_step)
    if retuned_pd.UNSEARCHED not in rows:
        walks.pop(retuned_pd.UNSEARCHED, None)
    return TuneComparison(walks, over, hardware, checked, rows, broken, worth, said, apart)


def conclusions(
    found: Tuned, walked: Compared, others: tuple[Tuned | None, Tuned | None], at_step: tuple[float, Values] | None
) -> tuple[Compared, Mapping[str, list[str]], Worth | None, str, AtOneStep | None]:
    """Return the rows of a table, limits broken, the worth of a force sensor, the verdict, the change at one time step.

    Arguments:
        found: the result.
        walked: gains and metrics of the walks by name.
        others: pd retuned, and load transfer by plan.
        at_step: the time step of pd retuned, s, where it has one of its own, and the metrics of the result there.
    """
    problem, (rival, plan), worth, apart = found.problem, others, None, None
    names = ("tuned", retuned_pd.NAME, retuned_pd.PLANNED, retuned_pd.UNSEARCHED, "config", "pd")
    rows = {name: walked[name] for name in names if name in walked}
    scores = {name: scores_of(problem.objective, metrics) for name, (_, metrics) in rows.items()}
    broken = {name: verification.broken_limits(problem.objective, metrics) for name, (_, metrics) in rows.items()}
    joint = {} if rival is None else retuned_pd.joint_of(rival)
    if rival is not None:
        sound = {n: each["objective"] for n, each in scores.items() if n != retuned_pd.UNSEARCHED or not broken[n]}
        best = best_without(found, (rival, plan), sound)
        if at_step is not None:
            pd = scores[retuned_pd.NAME if best.name == retuned_pd.PLANNED else best.name]["objective"]
            apart = AtOneStep(at_step[0], scores_of(problem.objective, at_step[1])["objective"] / pd - 1)
        level = None if best.name == retuned_pd.PLANNED else apart
        both, scored = (rows["tuned"][1], rows[best.name][1]), (scores["tuned"], scores[best.name])
        worth = between(both, scored, best.rival, problem, level=level, pd=best.pd, ends=best.ends)
        give_joint_gains(rows, joint | {**(rows[retuned_pd.NAME][0] or {})}, best.name)
    reached = {name: verdicts.Walked(scores[name]["objective"], not broken[name]) for name in rows}
    said = verdicts.against_best(verdicts.named("tuned gains", found.gains, problem), reached, "objective", joint=joint)
    return rows, broken, worth, said, apart


def with_joint_gains(walk: mc.Trajectory, problem: Problem) -> dict[str, Any] | None:
    """Return the gains of a walk, joint loop and searched gait last; None where its controller has none."""
    gains, control = gains_of(walk), walk.scenario.control
    gait = own_gait(walk.scenario) if searches_gait(problem.space) else {}
    if gains is None and gait:
        gains = {}
    joint = {name: getattr(control, name) for name in (*JOINT, *((INTEGRAL,) if control.ki else ()))}
    return None if gains is None else gains | joint | gait


def scores_of(target: Goal, metrics: Values) -> dict[str, float]:
    """Return the scores that gains are compared by."""
    variation = metrics[VARIATION]
    if variation is None or failed(metrics):
        return {"objective": np.nan, VARIATION: np.nan}
    return {"objective": float(maps.score_of(target, metrics).value), VARIATION: float(variation)}
