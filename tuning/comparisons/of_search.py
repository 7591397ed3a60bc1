"""Gains that a search found beside pd, pd retuned and the scenario's own: walks, the map around them, their tests."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import PD
from mjx_climb.inputs.gait_values import GAIT, own_gait
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
    one_walk,
    planned,
    retuned,
)
from tuning.comparisons.worth import BesidePd, Ends, Worth, better_of, between
from tuning.gains.gains_file import replaced
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
    on_the_map = law is None and {*JOINT, INTEGRAL, *GAIT}.isdisjoint(
        problem.space.index
    )  # then one map serves all results
    plan = planned(problem, search, seeds, out)
    return Begun(
        start(retuned(problem, search, seeds, out)),
        None if plan is None else start(plan),
        {"pd": start(one_walk(under_pd(scenario), None, engine)), "config": start(one_walk(scenario, law, engine))},
        start(lambda report: verification.map_with(problem, scenario, None, progress=report)) if on_the_map else None,
        {
            "pd": start(lambda report: margins.on_the_grid(scenario, margins.pd_of(scenario), engine, report)),
            "config": start(lambda report: margins.on_the_grid(scenario, margins.Walker(law, {}), engine, report)),
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
    rows: Compared  # tuned, retuned_pd, load transfer by plan, config, pd
    over: xr.Dataset | None  # the map around it
    hardware: margins.Found  # on worse hardware
    checked: verification.Verification
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
    scenario, problem = found.scenario, found.problem
    ours, engine = (replaced(found.scenario, found.law, found.gains)[0], found.law), problem.engine
    with background() as start:
        tested = start(lambda _: verification.tests(found, problem))  # the longest to compile
        others = begun or begin(problem, found.search, start, seeds=found.seeds, out=out)
        mapped = others.over or start(lambda told: verification.map_of(found, problem, progress=told))
        walking = {**others.walks, "tuned": start(one_walk(*ours, engine))}
        with stage("retuned pd", unit="rounds") as told:
            rival = others.retuned(told)
        plan = None
        if others.planned is not None:
            with stage("load transfer by plan", unit="rounds") as told:
                plan = others.planned(told)
        if plan is not None:
            walking[retuned_pd.PLANNED] = start(one_walk(*replaced(plan.scenario, plan.law, plan.gains), engine))
        rivals = {"config": margins.Walker(problem.law, {})}
        joint, step = {} if rival is None else retuned_pd.joint_of(rival), None
        if rival is not None:
            beside = beside_retuned(problem, joint, ours)
            if plan is not None:
                del beside[retuned_pd.UNSEARCHED]
            walking |= {name: start(one_walk(*walker, engine)) for name, walker in beside.items()}
            if LEVEL in beside:
                step = beside[LEVEL][0].time_step
            else:
                rivals["retuned pd"] = margins.Walker(PD(), joint)

        def find_margins(told: Callback) -> margins.Found:
            walked = {name: asked(ignore) for name, asked in others.on_hardware.items()}  # begun before this
            how: dict[str, Any] = {"law": found.law, "engine": engine}
            return margins.find(scenario, found.gains, others=rivals, walked=walked, progress=told, **how)

        margin, walks, level = start(find_margins), {}, walking.pop(LEVEL, walking["tuned"])
        for name, walk in walking.items():
            with stage(name) as told:
                walks[name] = walk(told)
        own = mc.metrics(walks["tuned"], problem.metrics)
        with stage("map") as told:
            over = mapped(told)
        with stage("margins") as told:
            hardware = margin(told)
        with stage("verification"):
            checked = verification.verify(
                found, problem, metrics=own, walks=over, hardware=hardware, tested=tested(ignore)
            )
        leveled = level(ignore)
    each = {name: (with_joint_gains(walk, problem), mc.metrics(walk, problem.metrics)) for name, walk in walks.items()}
    at_step = None if step is None else (step, mc.metrics(leveled, problem.metrics))
    rows, worth, said, apart = conclusions(found, each, (rival, plan), at_step)
    if retuned_pd.UNSEARCHED not in rows:
        walks.pop(retuned_pd.UNSEARCHED, None)
    return TuneComparison(walks, rows, over, hardware, checked, worth, said, apart)


def conclusions(
    found: Tuned, walked: Compared, rivals: tuple[Tuned | None, Tuned | None], at_step: tuple[float, Values] | None
) -> tuple[Compared, Worth | None, str, AtOneStep | None]:
    """Return the rows of a table, the worth of a force sensor, the verdict, and the change at one time step.

    Arguments:
        found: the result.
        walked: gains and metrics of the walks by name.
        rivals: pd retuned, and load transfer by plan.
        at_step: the time step of pd retuned, s, where it has one of its own, and the metrics of the result there.
    """
    problem, (rival, plan), worth, apart = found.problem, rivals, None, None
    names = ("tuned", retuned_pd.NAME, retuned_pd.PLANNED, retuned_pd.UNSEARCHED, "config", "pd")
    rows = {name: walked[name] for name in names if name in walked}
    joint = {} if rival is None else retuned_pd.joint_of(rival)
    scores = {name: scores_of(problem.objective, metrics) for name, (_, metrics) in rows.items()}
    if rival is not None:
        kept = {
            name: scores[name]["objective"] for name, (_, metrics) in rows.items()
            if name == retuned_pd.NAME or not verification.broken_limits(problem.objective, metrics)
        }  # fmt: skip
        without, better = better_of(retuned_pd.rival_of(rival), kept)
        both, scored = (rows["tuned"][1], rows[without][1]), [scores["tuned"], scores[without]]
        if at_step is not None:
            there = scores_of(problem.objective, at_step[1])
            apart = AtOneStep(at_step[0], there["objective"] / scored[1]["objective"] - 1)
        if plan is None:
            ends = Ends(found.ends, rival.ends) if without == retuned_pd.NAME else None
            worth = between(both, scored, better, problem, level=apart, ends=ends)
        else:
            worth = beside_plan(found, both, scored, (rival, plan), rows[retuned_pd.PLANNED][1], apart)
        joint_gains = joint | {**(rows[retuned_pd.NAME][0] or {})}
        for name in dict.fromkeys((retuned_pd.NAME, without)):
            rows[name] = joint_gains, rows[name][1]
        if without == retuned_pd.NAME:
            rows.pop(retuned_pd.UNSEARCHED, None)
    reached = {
        name: verdicts.Walked(scores[name]["objective"], not verification.broken_limits(problem.objective, metrics))
        for name, (_, metrics) in rows.items()
    }
    said = verdicts.against_best(verdicts.named("tuned gains", found.gains, problem), reached, "objective", joint=joint)
    return rows, worth, said, apart


def beside_plan(
    found: Tuned, both: tuple[Values, Values], scored: list[dict[str, float]], rivals: tuple[Tuned, Tuned],
    by_plan: Values, apart: AtOneStep | None,
) -> Worth:  # fmt: skip
    """Return the worth of a force sensor beside the better of pd retuned and load transfer by plan."""
    ours, pd = scored
    problem, ends = found.problem, [Ends(found.ends, each.ends) for each in rivals]
    planned, (retuned, plan) = scores_of(problem.objective, by_plan), (retuned_pd.rival_of(each) for each in rivals)
    beside = BesidePd(pd["objective"], retuned)
    if not planned["objective"] < pd["objective"]:
        return between(both, scored, retuned, problem, level=apart, pd=beside, ends=ends[0])
    return between((both[0], by_plan), (ours, planned), plan, problem, pd=beside, ends=ends[1])


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
