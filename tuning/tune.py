"""The search from Python: `from tuning.tune import tune`, and what a search method of one's own is made of."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from tuning.output import tuned
from tuning.output.stages import Stage, silent
from tuning.problem.objectives import Judge
from tuning.problem.search import Search
from tuning.searches import finished_parts
from tuning.searches import tune as searches
from tuning.searches.methods import Method, Request, Task
from tuning.searches.result import Result
from tuning.searches.tune import Progress

__all__ = ["Method", "Progress", "Request", "Task", "Tuned", "tune"]


@dataclasses.dataclass(frozen=True)
class Tuned(Result):
    """A result that can be written with its report."""

    objective: Judge | None = None  # the user's own
    engine: str = DEFAULT_ENGINE
    own_law: mc.Law | None = None  # as it was before the search

    def write(self, folder: str | os.PathLike[str], *, stage: Stage = silent) -> tuned.Judged:
        """Walk, test and draw the result, and write what `mjx-climb tune` writes: gains, map, pictures, report.

        Arguments:
            folder: where to; it is made. Rounds that `tune(out=folder)` kept there are removed.
            stage: told what goes on, see `tuning.output.stages`; nothing is printed.

        Returns:
            The walks, their metrics side by side and the outcome of the tests.

        Raises:
            OutputError: a file cannot be written.
        """
        written = tuned.write(
            self, Path(folder), law=self.own_law, function=self.objective, engine=self.engine, stage=stage
        )
        finished_parts.clear(Path(folder))
        return written


def tune(
    scenario: mc.Scenario,
    search: Search | None = None,
    *,
    law: mc.Law | None = None,
    objective: Judge | None = None,
    engine: str = DEFAULT_ENGINE,
    out: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Tuned:
    """Search gains as `tuning.searches.tune.tune` does, whose arguments these are, and return what can be written.

    `tune(scenario, space="diagonal", out="results/mine").write("results/mine")` is `mjx-climb tune`.
    """
    kept = None if out is None else Path(out)
    found = searches.tune(scenario, search, law=law, objective=objective, engine=engine, out=kept, **options)
    return Tuned(**vars(found), objective=objective, engine=engine, own_law=law)
