"""What every search leaves in its folder: scenario, settings, gains, all that was judged, and how it draws."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TypeVar

from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb import plots
from mjx_climb.files import dataset
from tuning.gains import gains_file
from tuning.output.folder import check_own, made_from, write_config
from tuning.output.stages import Stage
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search
from tuning.searches.result import Result

Found = TypeVar("Found", bound=Result)


def write_asked(problem: Problem, search: Search, folder: Path, result: str) -> mc.Scenario:
    """Write what was asked, config.yaml and search.yaml; return the scenario as `write_config` does.

    `result` is the file by which the search's folder is known, see `tuning.output.folder.check_own`.

    Raises:
        OutputError: a file cannot be written.
    """
    check_own(folder, result)
    written = write_config(problem.scenario, folder, problem.law, problem.metrics, problem.judge)
    dataset.write_text_atomically(folder / "search.yaml", search.to_yaml())
    return written


def write_gains(found: Found, folder: Path, comment: str, problem: Problem) -> Found:
    """Write what was asked, the gains that were found and all that was judged, without walking anything.

    Arguments:
        found: the result.
        folder: where to.
        comment: in the file of the gains.
        problem: what was searched.

    Returns:
        The result, of the scenario with the files that it names copied to the folder.

    Raises:
        OutputError: a file cannot be written.
    """
    scenario = write_asked(problem, found.search, folder, "search.nc")
    written = dataclasses.replace(found, scenario=scenario, history=made_from(found.history, scenario))
    gains_file.save(found.gains, folder / "gains.yaml", comment, problem.law)
    written.save(folder / "search.nc")
    return written


def draw(
    pictures: Mapping[str, Callable[[], Figure]], folder: Path, formats: Collection[str], stage: Stage
) -> dict[str, Path]:
    """Draw pictures into files of some formats, and return the PNG of each by its name.

    Raises:
        OutputError: a file cannot be written.
    """
    with stage("drawing", compiles=False):
        for name, picture in pictures.items():
            plots.save_figure(picture(), folder / name, formats)
    return {name: folder / f"{name}.png" for name in pictures}
