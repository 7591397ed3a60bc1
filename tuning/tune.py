"""The search from Python: `from tuning.tune import tune`, and what a search method of one's own is made of."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from tuning.output.tuned import Tuned
from tuning.problem.objectives import Judge
from tuning.problem.search import Search
from tuning.searches import tune as searches
from tuning.searches.methods import Method, Points, Request, Task
from tuning.searches.tune import Progress

__all__ = ["Method", "Progress", "Request", "Task", "Tuned", "tune"]


def tune(
    scenario: mc.Scenario,
    search: Search | None = None,
    *,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[Progress], None] | None = None,
    method: str | Method | Callable[[Task], Points] | None = None,
    law: mc.Law | None = None,
    objective: Judge | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    numbers: mc.Parameters | None = None,
    engine: str = DEFAULT_ENGINE,
    **settings: Any,
) -> Tuned:
    """Search gains as `tuning.searches.tune.tune` does, whose arguments these are, and return what can be written.

    `tune(scenario, space="diagonal", out="results/mine").write("results/mine")` is `mjx-climb tune`.
    """
    search, own_method = searches.settled(search, method, settings)
    problem = searches.problem_of(scenario, search, objective, numbers, engine, law=law, metrics=metrics)
    found = searches.run(problem, search, own_method, out=None if out is None else Path(out), progress=progress)
    return Tuned(**vars(found), problem=problem)
