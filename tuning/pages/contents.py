"""The contents of a result's folder, as data, before anything is written."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import xarray as xr

import mjx_climb as mc
from mjx_climb.control import law_of
from tuning.comparisons.side_by_side import AtOneStep, Compared, Values, differences
from tuning.comparisons.verdicts import more_or_less
from tuning.gains import gains_file
from tuning.numbers import presentable, to_json
from tuning.pages.page import Origin, Page, Table
from tuning.problem.evaluation import Problem
from tuning.results.result import Result
from tuning.searches.retuned_pd import NAME

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import


class Picture(NamedTuple):
    """A picture that is drawn when it is written."""

    caption: str
    draw: "Callable[[], Figure]"


Files = Mapping[str, str | xr.Dataset | Picture]  # by name, of pictures without an ending
# of the scenario that names the files in the folder, the folder, and the command
FilesIn = Callable[[mc.Scenario, Path, str], Files]


@dataclasses.dataclass(frozen=True)
class Written:
    """The rivals of a result, its tests, and the files that were written."""

    files: str = ""  # their names
    walks: Mapping[str, mc.Trajectory] = dataclasses.field(default_factory=dict)  # in double precision
    compared: Compared = dataclasses.field(default_factory=dict)  # gains and metrics of these
    data: xr.Dataset | None = None  # the grid with its limit of stability, the map, or the walks of the fresh draw
    summed: xr.Dataset | None = None  # mean and worst of that draw, see `tuning.comparisons.judge.summary`
    outcome: Sequence[str] = ()  # in lines
    summary: str = ""  # all of it, JSON
    tables: Sequence[Table] = ()  # for a terminal, where it is not that of the walks


class Contents(NamedTuple):
    """The files of a folder beside config.yaml, the page, and their summary."""

    written: Written
    problem: Problem  # whose scenario, law, metrics and objective config.yaml names
    files: Files | FilesIn
    page: Callable[[Origin], Page] | None = None
    again: str = ""  # the command or call that repeats it in the folder


def contents_of(
    found: Result, name: str, page: Page, summary: Any, more: Files, *, again: str = "", shown: int = 1, **told: Any
) -> Contents:
    """Return the contents of a result's folder: gains, data, settings, summary and page, with more files.

    Arguments:
        name: of the config.
        page: without its origin.
        summary: plain data.
        again: the command or call that repeats the result in its folder.
        shown: tables of the page that a terminal shows too.
        told: further fields of `Written`.
    """
    text = to_json(summary)
    files = {**files_of(found, name), "summary.json": text + "\n", **more}
    written = Written(outcome=page.findings.lines, summary=text, tables=page.tables[:shown], **told)
    return Contents(written, found.problem, files, page.at, again)


def files_of(found: Result, name: str) -> dict[str, Any]:
    """Return a result's gains, data and settings as files; `name` is that of its config."""
    scenario, files = found.scenario, dict[str, Any]()
    if found.gains is not None:
        gains, law = gains_file.completed(scenario, found.gains), found.problem.law or law_of(scenario)
        files["gains.yaml"] = gains_file.text(gains, found.comment(name), law)
    files[found.FILE] = found.data.assign_attrs(scenario=scenario.to_yaml())
    settings = {"search.yaml": found.search, "ensemble.yaml": found.ensemble}
    return files | {file: own.to_yaml() for file, own in settings.items() if own is not None}


def plain_of(rows: Compared) -> dict[str, dict[str, Any]]:
    """Return gains and metrics of walks as plain data."""
    return {name: {"gains": gains, "metrics": presentable(metrics, None)} for name, (gains, metrics) in rows.items()}


def at_own_step(level: AtOneStep | None, ours: str, what: str) -> list[str]:
    """Return at which time step pd retuned walks where it is not the scenario's, in a line; none where it is."""
    if level is None:
        return []
    there = f"; {ours} at that step: {more_or_less(level.change)} {what} than it" if isfinite(level.change) else ""
    return [f"{NAME} walks at a time step of {level.step:g} s, which its kp and kd need{there}"]


def worse_than_pd(metrics: Values, baseline: Values, about: mc.MetricTable) -> list[str]:
    """Return which metrics are worse than under pd, in a line; none where none is."""
    worse, _ = differences(metrics, baseline, about)
    return [f"worse than pd: {', '.join(worse)}"] if worse else []
