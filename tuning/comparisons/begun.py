"""What a grid or a search is compared with, independent of what it finds: works that may begin before it."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import xarray as xr

import mjx_climb as mc
from mjx_climb.inputs.gait_values import GAIT
from mjx_climb.inputs.resolve import AnyGains
from tuning.background import Begin, Work
from tuning.comparisons import margins, stability_limit, verification
from tuning.gains.gains_file import replaced
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.search import BY_GRADIENTS, Search
from tuning.problem.spaces import INTEGRAL, JOINT
from tuning.results.tuned import Tuned
from tuning.searches import retuned_pd
from tuning.searches.sweep import Axes
from tuning.searches.tune import start_of

GIVEN = "gains file"  # the name of a walk with gains that are not the config's
# inertia, damping and stiffness of cases 1.1, 1.2 and 2
PAPER = {(1.0, 1e4, 4e5), (1.0, 5e3, 5e4), (1.0, 5e3, 2e4)}


Walker = tuple[mc.Scenario, mc.Law | None]


class OfGrid(NamedTuple):
    """What a grid is compared with."""

    walkers: Mapping[str, Walker]  # by the names of the walks
    walks: Mapping[str, Work[mc.Trajectory]]  # pd, config (or paper), gains file: as far as there are such
    limits: Work[tuple[retuned_pd.Rival | None, xr.DataArray]]  # pd retuned, and the limit of stability


class OfSearch(NamedTuple):
    """What a search is compared with."""

    retuned: Work[Tuned | None]  # pd retuned
    walks: Mapping[str, Work[mc.Trajectory]]  # pd, config
    over: Work[xr.Dataset | None] | None  # the map; None where it depends on the result
    on_hardware: Mapping[str, Work[xr.Dataset]]  # pd, config: the first walks on worse hardware


def of_grid(problem: Problem, gains: AnyGains | None, axes: Axes, begin: Begin) -> OfGrid:
    """Begin what a grid is compared with; `gains` and `axes` are as of `tuning.sweep`."""
    scenario, law, engine = problem.scenario, problem.law, problem.engine
    control = scenario.control
    papers = law is None and (control.inertia, control.damping, control.stiffness) in PAPER
    walkers: dict[str, Walker] = {"pd": (under_pd(scenario), None), "paper" if papers else "config": (scenario, law)}
    simulated, own = (scenario, law) if gains is None else replaced(scenario, law, gains)
    walkers |= {} if gains is None else {GIVEN: (simulated, own)}
    # one after the other: each keeps all cores busy, and side by side they take more than twice as long
    limits = begin(
        lambda _: (
            retuned_pd.least(scenario, halvings=1, engine=engine),
            stability_limit.over_axes(simulated, axes, law=own, engine=engine),
        )
    )
    return OfGrid(walkers, {name: begin(one_walk(*walker, engine)) for name, walker in walkers.items()}, limits)


def of_search(problem: Problem, search: Search, begin: Begin, *, out: Path | None = None) -> OfSearch:
    """Begin what a search is compared with; `out` holds the rounds in which pd is retuned until the result is there."""
    scenario, law, engine = problem.scenario, problem.law, problem.engine
    on_the_map = law is None and {*JOINT, INTEGRAL, *GAIT}.isdisjoint(
        problem.space.index
    )  # then one map serves all results
    return OfSearch(
        begin(retuned(problem, search, out)),
        {"pd": begin(one_walk(under_pd(scenario), None, engine)), "config": begin(one_walk(scenario, law, engine))},
        begin(lambda report: verification.map_with(problem, scenario, None, progress=report)) if on_the_map else None,
        {
            "pd": begin(lambda report: margins.on_the_grid(scenario, margins.pd_of(scenario), engine, report)),
            "config": begin(lambda report: margins.on_the_grid(scenario, margins.Walker(law, {}), engine, report)),
        },
    )


def retuned(problem: Problem, search: Search, out: Path | None) -> Work[Tuned | None]:
    """Return a work that searches kp and kd of pd as the gains were searched; `out` keeps its rounds."""
    return lambda report: retuned_pd.search(
        problem, search, out=out, progress=lambda now: report(now.rounds, now.rounds_in_all)
    )


def load_tests(problem: Problem, search: Search, begin: Begin) -> None:
    """Begin to load the executable of a result's tests, which takes long, where the search does not use it."""
    if search.method not in BY_GRADIENTS:
        begin(lambda _: verification.slopes_at(problem, start_of(problem)))


def one_walk(scenario: mc.Scenario, law: mc.Law | None, engine: str) -> Work[mc.Trajectory]:
    """Return a work that simulates one robot under the scenario's law, or another."""
    return lambda _: mc.rollout(scenario, law=law, engine=engine)


def beside_retuned(
    scenario: mc.Scenario, joint: Mapping[str, float], walkers: Mapping[str, Walker], engine: str, begin: Begin
) -> tuple[Work[mc.Trajectory], float | None, dict[str, Work[mc.Trajectory]]]:
    """Begin the walks by which pd with joint gains of its own is compared with others, all at one time step.

    Returns: its walk; the time step, as short as it needs, and the others' walks at this step by their names: None and
        no walks where it is the scenario's own step.
    """
    alone = retuned_pd.walker(scenario, joint)
    step = None if alone.time_step == scenario.time_step else alone.time_step
    level: dict[str, Work[mc.Trajectory]] = {}
    for name, (own, law) in walkers.items() if step is not None else ():
        level[name] = begin(one_walk(own.with_overrides({"time_step": step}), law, engine))
    return begin(one_walk(alone, None, engine)), step, level
