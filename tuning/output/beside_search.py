"""What a search is compared with, whatever it finds: it may begin before the search."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import xarray as xr

import mjx_climb as mc
from tuning.judged import margins, verification
from tuning.output.ahead import Asked, Begin
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.search import Search
from tuning.problem.spaces import JOINT
from tuning.searches import retuned_pd
from tuning.searches.result import Result
from tuning.searches.tune import start_of

_BY_SLOPES = {"gradient", "lbfgs"}  # methods


class Beside(NamedTuple):
    """What a search is compared with, whatever it finds: works that wait to be asked for, or are under way."""

    retuned: Asked[Result | None]  # pd retuned
    walks: Mapping[str, Asked[mc.Trajectory]]  # pd, config
    over: Asked[xr.Dataset | None] | None  # the map; None where the result bears on it
    on_hardware: Mapping[str, Asked[xr.Dataset]]  # pd, config: the first walks on worse hardware


def beside(problem: Problem, search: Search, begin: Begin, *, out: Path | None = None) -> Beside:
    """Begin what a search is compared with.

    `out` keeps the rounds in which pd is retuned until the result has been written.
    """
    scenario, law = problem.scenario, problem.law
    bears = law is not None or not JOINT.keys().isdisjoint(problem.space.gains)  # the result, on the map
    return Beside(
        begin(
            lambda told: retuned_pd.search(
                problem, search, out=out, progress=lambda now: told(now.rounds, now.rounds_in_all)
            )
        ),
        {
            "pd": begin(lambda _: mc.rollout(under_pd(scenario), engine=problem.engine)),
            "config": begin(lambda _: mc.rollout(scenario, law=law, engine=problem.engine)),
        },
        None if bears else begin(lambda told: verification.map_with(problem, scenario, None, progress=told)),
        {
            "pd": begin(lambda told: margins.on_the_grid(scenario, margins.pd_of(scenario), problem.engine, told)),
            "config": begin(lambda told: margins.on_the_grid(scenario, margins.Walker(law, {}), problem.engine, told)),
        },
    )


def load_tests(problem: Problem, search: Search, begin: Begin) -> None:
    """Begin to walk by the program of a result's tests, long to compile and to load, where the search does not."""
    if search.method not in _BY_SLOPES:
        begin(lambda _: verification.slopes_at(problem, start_of(problem)))
