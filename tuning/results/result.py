"""The base of all results: data, gains, and the problem that was searched."""

import dataclasses
import functools
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import mjx_climb as mc
from mjx_climb.inputs.resolve import AnyGains, with_gains
from mjx_climb.scenario.kinds import named_in
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search

if TYPE_CHECKING:
    import xarray as xr

# marker files of folders in which nothing is kept
WITHOUT_PARTS = (
    "trajectory.nc", "margins.json", "pushes.json", "reproduce.json", "excitation.csv", "replay.json"
)  # fmt: skip
_DATA = named_in(Path(__file__).parent, r'^    FILE = "([\w.]+)"$')
SETTINGS = "settings.json"  # of the command
# of all; tune --ensemble writes judged.nc too, so that this comes last
RESULTS = (*WITHOUT_PARTS, "result.json", *sorted(_DATA, key=lambda name: name == "judged.nc"))


@dataclasses.dataclass(frozen=True)
class Result:
    """The result of a computation, and its problem; its kinds have further fields."""

    FILE: ClassVar[str]  # of the data; by it the folder of a result is known
    KIND: ClassVar[str]  # the function of `tuning` that gives it

    data: "xr.Dataset"
    problem: Problem
    search: Search | None = None  # its settings, where gains were searched
    ensemble: Ensemble | None = None  # as its user gave it, where there was one
    gains: AnyGains | None = None  # those to use, where it says

    @property
    def scenario(self) -> mc.Scenario:
        """The scenario."""
        return self.problem.scenario

    @property
    def law(self) -> mc.Law | None:
        """The law, where another than the scenario's walked; with the gains found, where there are such."""
        law = self.problem.law
        return law if law is None or self.gains is None else with_gains(law, self.gains)

    @functools.cached_property
    def walked(self) -> Problem:
        """The problem with the gains in place of the scenario's or the law's own."""
        return self.problem.with_gains(self.gains)

    def comment(self, name: str) -> str:
        """Return the comment in the gains file of a result for the scenario `name`."""
        return f"mjx-climb {self.KIND} {name}"
