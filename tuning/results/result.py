"""The result of every search: data, gains, the problem that was searched, and how all of it is written."""

import dataclasses
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.inputs.resolve import AnyGains, with_gains
from tuning.background import Stage, silent
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search

if TYPE_CHECKING:
    from tuning.pages.page import Origin


@dataclasses.dataclass(frozen=True)
class Written:
    """What a result was compared with, what its tests said, and what was written."""

    files: str = ""  # their names
    walks: Mapping[str, mc.Trajectory] = dataclasses.field(default_factory=dict)  # in double precision
    # gains (None for a controller without) and metrics of these
    compared: Mapping[str, tuple[Mapping[str, Any] | None, Mapping[str, Any]]] = dataclasses.field(default_factory=dict)
    data: xr.Dataset | None = None  # the grid with its limit of stability, the map, or the walks of the fresh draw
    summed: xr.Dataset | None = None  # mean and worst of that draw, see `tuning.comparisons.judge.summary`
    outcome: list[str] = dataclasses.field(default_factory=list)  # in lines
    summary: str = ""  # all of it, JSON

    def moved(self, place: Path, home: Path) -> "Written":
        """Return the same, of files that were moved: scenarios name the copies of their files in the new folder."""
        from tuning.writing.record import at_home, walks_at_home

        data = self.data
        if data is not None and str(place) in data.attrs.get("scenario", ""):
            data = data.assign_attrs(scenario=at_home(dataset.scenario_of(data), place, home).to_yaml())
        return dataclasses.replace(self, walks=walks_at_home(self.walks, place, home), data=data)


@dataclasses.dataclass(frozen=True)
class Result:
    """What was found, and for what; its kinds say what else is known of it."""

    FILE: ClassVar[str]  # of the data; by it the folder of a result is known
    KIND: ClassVar[str]  # the command; a function of this name in `tuning/writing/contents.py` gives what it writes

    data: xr.Dataset
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

    def write(
        self,
        folder: str | os.PathLike[str],
        *,
        origin: "Origin | None" = None,
        figures: Collection[str] = ("png",),
        stage: Stage = silent,
        compared: Any = None,
        settings: Mapping[str, Any] | None = None,
    ) -> Written:
        """Compare, test and draw the result, and write what its command writes.

        The files appear together at the end, in place of those of an earlier result there.

        Arguments:
            folder: where to; it is made. What the search kept there with `out=folder` is removed.
            origin: what the report says of where it comes from.
            figures: formats of the pictures, of `mjx_climb.viz.plots.FORMATS`; reports hold them as PNG anyway.
            stage: opened for each longer work, see `tuning.background.Stage`; nothing is printed.
            compared: what `tuning.comparisons.begun` gave, where it was begun before the search.
            settings: what a command was asked for, by which it knows its folder again.

        Raises:
            ConfigError: over an ensemble, some gains diverge in each member.
            OutputError: a file cannot be written, or the folder holds another command's result.
        """
        from tuning.writing.folder import Folder, check_own
        from tuning.writing.record import whole

        home = Path(folder)
        check_own(home, self.FILE)
        with whole(home, settings) as place:
            written = Folder(place, self.FILE, origin, figures, stage, home).write(self, compared)
        return written.moved(place, home)

    def write_found(
        self, folder: Path, origin: "Origin | None" = None, settings: Mapping[str, Any] | None = None
    ) -> None:
        """Write what was asked, gains and data, without walking anything; `settings` as of `write`."""
        from tuning.writing.folder import Folder, check_own
        from tuning.writing.record import whole

        check_own(folder, self.FILE)
        with whole(folder, settings, finished=False) as place:
            Folder(place, self.FILE, origin, kept=folder).found(self)

    def comment(self, name: str) -> str:
        """Return what the file of its gains says of a result for the scenario `name`."""
        return f"mjx-climb {self.KIND} {name}"
