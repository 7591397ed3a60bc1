"""The folder of a result: the one place that knows what it holds, and that writes it."""

import dataclasses
import re
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import xarray as xr

from mjx_climb.control import law_of
from mjx_climb.files import dataset
from tuning.background import Stage, silent
from tuning.gains import gains_file
from tuning.methods import parts
from tuning.pages import page
from tuning.pages.page import Origin, Page
from tuning.results.config_file import write_config
from tuning.results.result import Result, Written
from tuning.writing.record import RESULTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_Found = TypeVar("_Found", bound=Result)
Pictures = Mapping[str, tuple[str, "Callable[[], Figure]"]]  # by name: caption, and what draws it

_WITHOUT_PARTS = ("trajectory.nc", "margins.json", "reproduce.json", "excitation.csv", "replay.json")


class Contents(NamedTuple):
    """What a kind of result leaves in its folder beside what was asked for, its gains and its data."""

    written: Written
    files: Mapping[str, str | xr.Dataset] = MappingProxyType({})  # by name
    pictures: Pictures = MappingProxyType({})
    page: Callable[[Origin], Page] | None = None
    again: str = ""  # the command or call that repeats it in the folder


@dataclasses.dataclass
class Folder:
    """A folder that a result is written to, and what has been written there; OutputError where it cannot be.

    The files may be written elsewhere first, to appear together: see `tuning.writing.record.whole`.
    """

    path: Path
    result: str  # the file by which it is known
    origin: Origin | None = None  # this and the rest are as of `Result.write`
    figures: Collection[str] = ("png",)
    stage: Stage = silent
    kept: Path | None = None  # where rounds are kept, and where the files will be; `path` where None

    def __post_init__(self) -> None:
        self.kept = self.kept or self.path
        check_own(self.kept, self.result)
        self._pictures: dict[str, Path] = {}  # PNG by caption
        self._files: list[str] = []

    def write(self, found: Result, begun: Any = None) -> Written:
        """Write a result as its kind declares it, and say what was written."""
        from tuning.writing import contents as results  # which imports matplotlib

        made: Contents = getattr(results, found.KIND)(found, self, begun)
        return dataclasses.replace(made.written, files=self.fill(made, f"tuning.{found.KIND}(...)"))

    def fill(self, made: Contents, call: str) -> str:
        """Write what is declared, the page last, and return the names of the files; `call` made it.

        The folder has its config.yaml already.
        """
        for name, content in made.files.items():
            self.add(name, content)
        self.draw(made.pictures)
        if made.page is not None:
            with self.stage("report", compiles=False):
                origin = self.origin or Origin("the scenario", call, made.again or call)
                config = without_folders((self.path / "config.yaml").read_text(encoding="utf-8"))
                named = page.write(made.page(origin._replace(config=config, pictures=self._pictures)), self.path).name
                self._files.insert(0, named)
        return ", ".join(dict.fromkeys([*self._files, "config.yaml"]))

    def found(self, found: _Found) -> _Found:
        """Write what was asked for, gains and data; return the result of the scenario with its files copied here."""
        problem = found.problem
        scenario = write_config(problem.scenario, self.path, problem.law, problem.metrics, problem.own_objective)
        if found.gains is not None and found.search is not None:
            name = "from Python" if self.origin is None else self.origin.name
            gains, law = gains_file.completed(scenario, found.gains), problem.law or law_of(scenario)
            gains_file.save(gains, self.path / "gains.yaml", found.comment(name), law)
            self._files.append("gains.yaml")
        data = found.data.assign_attrs(scenario=scenario.to_yaml())
        self.add(self.result, data)
        for name, settings in (("search.yaml", found.search), ("ensemble.yaml", found.ensemble)):
            if settings is not None:
                self.add(name, settings.to_yaml())
        return dataclasses.replace(found, data=data, problem=dataclasses.replace(problem, scenario=scenario))

    def add(self, name: str, content: str | xr.Dataset) -> None:
        """Write a text or a dataset."""
        if isinstance(content, str):
            dataset.write_text_atomically(self.path / name, content)
        else:
            dataset.save(content, self.path / name)
        self._files.append(name)

    def draw(self, pictures: Pictures) -> None:
        """Draw pictures into files of all formats that are wanted."""
        if not pictures:
            return
        from mjx_climb.viz import plots  # which imports matplotlib

        with self.stage("drawing", compiles=False):
            for name, (caption, picture) in pictures.items():
                plots.save_figure(picture(), self.path / name, {"png", *self.figures})
                self._pictures[caption] = self.path / f"{name}.png"
                self._files.append(f"{name}.png")


def check_own(folder: Path, result: str) -> None:
    """Check, before a long computation, that a folder can be written to and holds no other command's result.

    Commands write files of the same names: config.yaml would be another's than the report's beside it.

    Raises:
        OutputError: it cannot, or does.
    """
    dataset.check_folder(folder)
    kept = (parts.FOLDER,) if result in _WITHOUT_PARTS else ()
    there = next((name for name in (*kept, *RESULTS) if (folder / name).exists()), result)
    if there != result:
        raise dataset.OutputError(
            f"{folder}: expected a folder without another command's result, got {there} in it (choose another folder)"
        )


def without_folders(text: str) -> str:
    """Return a text in which absolute paths have lost their folders: these belong to one machine."""
    return re.sub(r"(?<![\w.:/-])(?:~|[A-Za-z]:)?[/\\](?:[^/\\\n'\"=]+[/\\])*(?=[^/\\\s])", "", text)
