"""The search from Python, and what a search method of one's own is made of.

`from tuning.tune import tune`; the module itself may be called as well, so that `tuning.tune(...)` is the same.
"""

import os
import sys
import types
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
    """Search the gains of a control law.

    `tune(scenario, space="diagonal", out="results/mine").write("results/mine")` is `mjx-climb tune`.

    Arguments:
        scenario: what walks where.
        law: whose gains are searched; its own are the first start. The scenario's where None.
        search: the settings; `settings` are keys of `tuning.problem.search.Search` in place of it or to change it, as
            in `tune(scenario, method="gradient", space="diagonal")`.
        method: the name of a shipped one; or one of your own, as a function that yields a `Request` of points and
            receives what they are worth, or a `Method` that knows its rounds besides; see
            `tuning.searches.methods.task`. It must ask for the same when it is told the same.
        objective: a pure function of the metrics in place of the weighted terms, see
            `tuning.problem.objectives.Objective`.
        metrics: what the walks are judged by, as `mjx_climb.METRICS + (mine,)`; weights, limits and the objective may
            name them. The shipped ones must be among them.
        numbers: parameters in place of the scenario's; with leading axes (members, 1), an ensemble over which the
            score is the mean.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        out: a folder that keeps each finished round, so that an interrupted search goes on from there. The rounds
            stay until `finished_parts.clear(out)`.
        progress: called after each round.

    Returns:
        The best gains and all that was judged; `write(folder)` writes them. Ctrl-C ends the search with the best so far
        (`interrupted`).

    Raises:
        ConfigError: settings that make no sense for the scenario, or a method that asks for no points of the space.
        OutputError: the folder cannot be written, or holds an unfinished search for something else.
        Unidentifiable: with `out`, an objective or method that cannot be told from another; see
            `mjx_climb.compilation.contents`.
    """
    wanted, own_method = searches.settled(search, method, settings)
    wanted = searches.for_this_machine(scenario, wanted, (search, method, settings.get("method")), engine, law)
    problem = searches.problem_of(scenario, wanted, objective, numbers, engine, law=law, metrics=metrics)
    found = searches.run(problem, wanted, own_method, out=None if out is None else Path(out), progress=progress)
    return Tuned(**vars(found), problem=problem)


class _Called(types.ModuleType):
    """A module that is called as the function of its name."""

    def __call__(self, *args: Any, **how: Any) -> Tuned:
        return tune(*args, **how)


sys.modules[__name__].__class__ = _Called
