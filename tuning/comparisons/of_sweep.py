"""A sweep beside pd, pd retuned and the scenario's own gains: walks, its limit of stability, time histories."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.execution import devices
from mjx_climb.walk.metrics import failed as walks_failed
from tuning.background import Begin, Stage, Work, background, ignore, silent
from tuning.comparisons import stability_limit, verdicts
from tuning.comparisons.remedies import remedies
from tuning.comparisons.side_by_side import (
    LEVEL,
    VARIATION,
    AtOneStep,
    Compared,
    Values,
    Walker,
    beside_retuned,
    gains_of,
    walks_together,
)
from tuning.comparisons.worth import Worth, better_of, between, give_joint_gains
from tuning.numbers import failed
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.variations import is_path
from tuning.results.swept import HISTORIES, MOST_CELLS, Swept, best_cell, coarser_grid
from tuning.searches import retuned_pd
from tuning.searches import sweep as sweeps
from tuning.searches.sweep import Axes

GIVEN = "gains file"  # the name of a walk with gains that are not the config's
# inertia, damping and stiffness of cases 1.1, 1.2 and 2
PAPER = {(1.0, 1e4, 4e5), (1.0, 5e3, 5e4), (1.0, 5e3, 2e4)}


class Walked(NamedTuple):
    """A walk in double precision, and its metrics."""

    walk: mc.Trajectory
    metrics: Values


class Begun(NamedTuple):
    """The rivals of a grid, as works that go on before it is compared with them."""

    rival: Work[retuned_pd.Rival | None]  # pd retuned
    limit: Work[xr.DataArray]  # of stability
    alone: Work[dict[str, Walked]] | None = None  # `walk_alone`, which the grid's result decides about


def begin(problem: Problem, walked: Problem, axes: Axes, start: Begin) -> Begun:
    """Begin what does not depend on the result of a grid with `axes` as of `tuning.sweep`, whose gains `walked` has."""
    limit = start(lambda _: stability_limit.over_axes(walked.scenario, axes, law=walked.law, engine=problem.engine))
    return Begun(start(lambda _: retuned_pd.least(problem.scenario, halvings=1, engine=problem.engine)), limit)


def walk_alone(found: Swept) -> dict[str, Walked]:
    """Simulate the best of a grid, gains that were given beside it, the scenario's own and pd, by name."""
    return _walked(found.problem, _walkers(found))


def own_name(problem: Problem) -> str:
    """Return the name of the walk with the scenario's own gains: "paper" where they are the paper's, else "config"."""
    control = problem.scenario.control
    papers = problem.law is None and (control.inertia, control.damping, control.stiffness) in PAPER
    return "paper" if papers else "config"


@dataclasses.dataclass(frozen=True)
class SweepComparison:
    """The best walk of a grid beside the scenario's own gains and pd, walked in double precision."""

    data: xr.Dataset  # the grid, with the limit of stability
    best: xr.Dataset | None  # its cell, None where all failed
    # best, pd retuned, load transfer by plan, gains file, config (or paper), pd: as far as there are such
    walks: Mapping[str, mc.Trajectory]
    rows: Compared  # gains and metrics of these
    failed: int  # walks of the grid
    at_edge: list[str]  # gains whose end of the axis the best cell lies on
    worth: Worth | None  # of a force sensor: the best against the better rival without one
    verdict: str  # the best against the best of the others
    level: AtOneStep | None  # where pd retuned walks at a time step of its own
    histories: xr.Dataset  # a grid with time histories: this one, or a coarser one of a large one
    remedies: Sequence[str] = ()  # where all failed: changes that keep the grippers of the config's walk shut
    drawn: Any = None  # result of `draw`


def compare(
    found: Swept,
    stage: Stage = silent,
    _: object = None,
    begun: Begun | None = None,
    *,
    draw: Callable[[xr.Dataset, Compared], Any] = ignore,
) -> SweepComparison:
    """Simulate the rivals of a grid, and compute its limit of stability.

    Arguments:
        found: the grid.
        stage: opened for each longer work.
        begun: the result of `begin`, where it was begun before the grid walked.
        draw: called with the grid and the rows that it can be drawn with, while pd retuned walks.
    """
    problem, walked, own, best = found.problem, found.walked, own_name(found.problem), best_cell(found.data)
    axes = {name: found.data[name].values for name in found.axes}
    large = found.data["diverged"].size > HISTORIES
    with background() as beside:
        others = begun or begin(problem, walked, axes, beside)
        walking_again = beside(lambda _: with_histories(found.data, walked, best)) if large else None
        with stage("walks alone"):
            alone = walk_alone(found) if others.alone is None else others.alone(ignore)

        def walk_retuned() -> tuple[retuned_pd.Rival | None, dict[str, Walked], AtOneStep | None]:
            rival = others.rival(ignore)
            if best is not None and (rival is None or (rival.lacks and best[VARIATION] < rival.value)):
                rival = retuned_pd.least(problem.scenario, engine=problem.engine)  # a verdict takes all of pd's bounds
            if rival is None:
                return None, {}, None
            rivals = beside_retuned(problem, rival.joint, _walkers(found).get("best"))
            own_step = rivals[retuned_pd.NAME][0].time_step
            level = None if own_step == problem.scenario.time_step else AtOneStep(own_step, np.nan)
            return rival, _walked(problem, rivals), level

        retuned = beside(lambda _: walk_retuned())
        with stage("stability limit"):
            data = found.data.assign(spectral_radius=stability_limit.on_map(others.limit(ignore), found.data))
        drawn = draw(data, _rows(alone, own, found.axes))
        with stage("pd retuned"):
            rival, rivals, level = retuned(ignore)
        histories = found.data
        if walking_again is not None:
            with stage("histories"):
                histories = walking_again(ignore)
    every = alone | rivals
    rows = _rows(every, own, found.axes)
    at_step = rivals[LEVEL].metrics if LEVEL in rivals else None
    worth, level, said = conclusions(found, best, rows, rival, level, at_step)
    walks = {name: every[name].walk for name in rows}
    remedied = []
    if best is None:
        with stage("what would help", compiles=False):
            remedied = _help(walks, walked.law)
    failures = int(walks_failed(data).sum())
    return SweepComparison(
        data, best, walks, rows, failures, at_edge(found, best), worth, said, level, histories, remedied, drawn
    )


def _walkers(found: Swept) -> dict[str, Walker]:
    """Return who walks beside a grid, but for the rivals that are searched."""
    problem, walked, best = found.problem, found.walked, best_cell(found.data)
    walkers: dict[str, Walker] = {"pd": (under_pd(problem.scenario), None)}
    walkers[own_name(problem)] = problem.scenario, problem.law
    if found.gains is not None:
        walkers[GIVEN] = walked.scenario, walked.law
    if best is not None:
        at_best = walked.with_gains({name: best[name].item() for name in found.axes})
        walkers["best"] = at_best.scenario, at_best.law
    return walkers


def _walked(problem: Problem, walkers: Mapping[str, Walker]) -> dict[str, Walked]:
    """Simulate robots side by side: most of the time goes to the compiler, where each has a program of its own."""
    with ThreadPoolExecutor(devices.usable_cores()) as pool:

        def measured(work: Work[mc.Trajectory]) -> Walked:
            walk = work(ignore)
            return Walked(walk, mc.metrics(walk, problem.metrics))

        def start(work: Work[Any]) -> Work[Any]:
            future = pool.submit(measured, work)
            return lambda _: future.result()

        both: dict[str, Any] = walks_together(problem, walkers, start)
        return {name: each(ignore) for name, each in both.items()}


def _rows(walked: Mapping[str, Walked], own: str, axes: Sequence[str]) -> dict[str, tuple[Values | None, Values]]:
    """Return the gains, and values at paths among the axes of a grid, and the metrics of walks beside it."""
    paths, found = [name for name in axes if is_path(name)], dict[str, tuple[Values | None, Values]]()
    order = ("best", retuned_pd.NAME, retuned_pd.UNSEARCHED, GIVEN, own, "pd")
    for name in (name for name in order if name in walked):
        walk, metrics = walked[name]
        gains, there = gains_of(walk), {path: walk.parameters.at(path) for path in paths}
        found[name] = {**(gains or {}), **there} if there else gains, metrics
    return found


def conclusions(
    found: Swept, best: xr.Dataset | None, rows: dict[str, tuple[Values | None, Values]],
    rival: retuned_pd.Rival | None, level: AtOneStep | None, at_step: Values | None,
) -> tuple[Worth | None, AtOneStep | None, str]:  # fmt: skip
    """Return the worth of a force sensor, the change at one time step, and the verdict on the best cell of a grid.

    Arguments:
        found: the grid.
        best: its best cell, None where all failed.
        rows: gains and metrics of the walks by name; rivals get joint gains, a plan that is no better goes.
        rival: pd retuned.
        level: its time step, where it has one of its own.
        at_step: metrics of the best at that step.
    """
    worth = None
    if rival is not None:
        without, better = better_of(rival, {name: variation_of(metrics) for name, (_, metrics) in rows.items()})
        give_joint_gains(rows, dict(rival.joint), without)
        if best is not None:
            both = rows["best"][1], rows[without][1]
            scored = [{VARIATION: variation_of(each)} for each in both]
            if level is not None and at_step is not None:
                level = level._replace(change=variation_of(at_step) / scored[1][VARIATION] - 1)
            worth = between(both, scored, better, found.problem, place=" on this grid", level=level)
    walks = found.data["diverged"].size
    if best is None:
        return worth, level, f"none of the {walks} walks held: every one lost a gripper or diverged"
    at = " and ".join(f"{axis} {best[axis].item():.4g}" for axis in found.axes)
    each = {name: verdicts.Walked(variation_of(metrics)) for name, (_, metrics) in rows.items()}
    joint = None if rival is None else rival.joint
    said = verdicts.against_best(f"best of {walks} walks, {at}", each, "force variation", "N", joint)
    return worth, level, said


def at_edge(found: Swept, best: xr.Dataset | None) -> list[str]:
    """Return the gains whose end of the axis the best cell lies on."""
    return [] if best is None else [n for n in found.axes if best[n].item() in found.data[n].values[[0, -1]]]


def variation_of(metrics: Values) -> float:
    """Return the force variation of a walk, NaN where it failed."""
    return np.nan if failed(metrics) else float(metrics[VARIATION])


def _help(walks: Mapping[str, mc.Trajectory], law: mc.Law | None) -> list[str]:
    """Return the remedies that would keep the grippers of the config's walk shut, none where they hold."""
    from mjx_climb.viz import plots  # which imports matplotlib

    name = next(name for name in walks if name not in (retuned_pd.NAME, retuned_pd.UNSEARCHED, GIVEN, "pd"))
    torn = plots.detachments(walks[name])
    return [f"{name}: {remedies(walks[name].scenario, torn[0][0], law)}"] if torn else []


def with_histories(grid: xr.Dataset, walked: Problem, best: xr.Dataset | None) -> xr.Dataset:
    """Return a coarser grid of a sweep that has no time histories, with them and the best cell in it."""
    # out of the cells that the page shows
    kept = coarser_grid(coarser_grid(grid, best, MOST_CELLS), best, HISTORIES)
    axes = {str(name): kept[name].values for name in grid["diverged"].dims}
    return sweeps.sweep(walked.scenario, axes, **walked.walks).data
