"""The folder of a result: the one place that knows what it holds, and that writes it."""

import contextlib
import dataclasses
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset, scenario_files
from tuning.background import Stage, silent
from tuning.gains import gains_file
from tuning.gains.own_section import section
from tuning.report import page
from tuning.report.page import Origin
from tuning.searches import parts
from tuning.searches.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_Found = TypeVar("_Found", bound=Result)

# by which a result is known; tune --ensemble writes judged.nc too, so that this comes last
RESULTS = (
    "search.nc", "front.nc", "schedule.nc", "sweep.nc", "trajectory.nc", "margins.json", "reproduce.json", "judged.nc",
)  # fmt: skip
_WITHOUT_PARTS = ("trajectory.nc", "margins.json", "reproduce.json")


class Folder:
    """A folder that a result is written to, and what has been written there.

    Every method that writes raises OutputError where it cannot.
    """

    def __init__(
        self,
        path: Path,
        result: str,
        origin: Origin | None = None,
        figures: Collection[str] = ("png",),
        stage: Stage = silent,
    ):
        """Make the folder; `result` is the file by which it is known, the others are as of `Result.write`.

        Raises:
            OutputError: it cannot be written to, or holds another command's result.
        """
        check_own(path, result)
        self.path, self.stage = path, stage
        self.name = "from Python" if origin is None else origin.name
        self.pictures: dict[str, Path] = {}  # PNG by caption
        self._result, self._origin, self._figures, self._files = result, origin, figures, list[str]()

    def found(self, found: _Found) -> _Found:
        """Write what was asked, gains and data; return the result of the scenario with its files copied here."""
        problem = found.problem
        scenario = write_config(problem.scenario, self.path, problem.law, problem.metrics, problem.own_objective)
        found = dataclasses.replace(found, problem=dataclasses.replace(problem, scenario=scenario))
        settings = {"search.yaml": found.search, "ensemble.yaml": found.ensemble}
        if found.gains is not None and found.search is not None:
            gains_file.save(found.gains, self.path / "gains.yaml", found.comment(self.name), problem.law)
            self._files.append("gains.yaml")
        found = dataclasses.replace(found, data=made_from(found.data, scenario))
        self.data(found.data)
        for name, each in settings.items():
            if each is not None:
                self.text(name, each.to_yaml())
        return found

    def data(self, data: xr.Dataset, name: str | None = None) -> None:
        """Write a dataset: that of the result where no name is given."""
        name = name or self._result
        dataset.save(data, self.path / name)
        self._files.append(name)

    def text(self, name: str, text: str) -> None:
        """Write a text."""
        dataset.write_text_atomically(self.path / name, text)
        self._files.append(name)

    def draw(self, pictures: Mapping[str, tuple[str, Callable[[], "Figure"]]]) -> None:
        """Draw pictures, each with its caption and by what makes it, into files of all formats that are wanted."""
        from mjx_climb import plots  # which imports matplotlib

        with self.stage("drawing", compiles=False):
            for name, (caption, picture) in pictures.items():
                plots.save_figure(picture(), self.path / name, {"png", *self._figures})
                self.pictures[caption] = self.path / f"{name}.png"
                self._files.append(f"{name}.png")

    def origin(self, call: str, again: str | None = None) -> Origin:
        """Return where the report comes from, with the folder's config.yaml; where None was given, from `call`."""
        origin = self._origin or Origin("the scenario", call, again or call)
        return origin._replace(config=without_folders((self.path / "config.yaml").read_text(encoding="utf-8")))

    @contextlib.contextmanager
    def report(self, *, compiles: bool = False) -> Iterator[Callable[[page.Page], None]]:
        """Give what writes the report, in a stage of its own."""
        with self.stage("report", compiles=compiles):
            yield lambda made: self._files.insert(0, page.write(made, self.path).name)

    def finished(self) -> str:
        """Remove the parts that the search kept, and return the names of all files."""
        parts.clear(self.path)
        return ", ".join(dict.fromkeys([*self._files, "config.yaml"]))


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


def write_config(
    scenario: mc.Scenario,
    folder: Path,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = (),
    objective: Any = None,
) -> mc.Scenario:
    """Write config.yaml, and return the scenario with the files that it names copied to the folder.

    `law`, `metrics` and `objective` are the user's own, where there are any: config.yaml names them.

    Raises:
        OutputError: a file cannot be written.
    """
    own = section(law, metrics, objective)
    written = scenario_files.copied(scenario if own is None else scenario.with_overrides({"own": own}), folder)
    dataset.write_text_atomically(folder / "config.yaml", scenario_files.portable_yaml(written, folder))
    return written if own is None else written.with_overrides({"own": None})


def made_from(data: xr.Dataset, scenario: mc.Scenario) -> xr.Dataset:
    """Return a dataset that names as its own a scenario whose files were copied."""
    return data.assign_attrs(scenario=scenario.to_yaml())


def without_folders(text: str) -> str:
    """Return a text in which absolute paths have lost their folders: these belong to one machine."""
    return re.sub(r"(?<![\w.:/-])(?:~|[A-Za-z]:)?[/\\](?:[^/\\\n'\"=]+[/\\])*(?=[^/\\\s])", "", text)
