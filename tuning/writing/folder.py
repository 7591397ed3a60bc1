"""The folder of a result: its files are drawn and written, and appear there together."""

import contextlib
import dataclasses
import re
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.reading import leaving
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.viz import plots
from tuning.background import Stage, silent
from tuning.pages import page
from tuning.pages.contents import Contents, Files, Picture, Written
from tuning.pages.page import NOWHERE, Origin, Page, Part
from tuning.pages.section import Section
from tuning.results.config_file import write_config
from tuning.results.result import SETTINGS
from tuning.writing.record import Settings, at_home, whole


def write(
    made: Contents,
    folder: Path,
    call: str,
    *,
    origin: Origin | None = None,
    figures: Collection[str] = ("png",),
    sections: Sequence[Section] = (),
    stage: Stage = silent,
    settings: Settings | None = None,
    finished: bool = True,
) -> Written:
    """Write a result, in place of an earlier one, and return its lines for a reader, with the names of the files.

    Arguments:
        made: the contents.
        folder: where to; it is made.
        call: the function that made the result.
        origin: of the report.
        figures: formats of the pictures, of `mjx_climb.viz.plots.FORMATS`; reports hold them as PNG anyway.
        sections: of the user's own, for the report.
        stage: opened for each longer work, see `tuning.background.Stage`.
        settings: of a command, which knows its folder again by them.
        finished: whether unfinished work that is kept there is removed.

    Raises:
        OutputError: a file cannot be written.
    """
    problem, told = made.problem, made.written
    with whole(folder, settings, finished=finished) as place:
        copied = write_config(
            problem.scenario, place, problem.law, problem.metrics, problem.own_objective, problem.own_method
        )
        where = origin or Origin("the scenario", call, made.again or call)
        asked = made.files(copied, place, where.asked) if callable(made.files) else made.files
        files = {name: _naming(each, copied) if isinstance(each, xr.Dataset) else each for name, each in asked.items()}
        names = fill(place, files, made.page, where, figures, stage, sections)
    copied = at_home(copied, place, folder)
    walks = {
        name: dataclasses.replace(walk, scenario=_beside(walk.scenario, copied)) for name, walk in told.walks.items()
    }
    data = None if told.data is None else _naming(told.data, copied)
    return dataclasses.replace(told, files=names, walks=walks, data=data)


def fill(
    place: Path,
    files: Files,
    report: Callable[[Origin], Page] | None = None,
    origin: Origin = NOWHERE,
    figures: Collection[str] = ("png",),
    stage: Stage = silent,
    sections: Sequence[Section] = (),
) -> str:
    """Write files, pictures and the page into a folder, which may hold a config.yaml, and return their names.

    A page holds pictures as PNG; without one there are the formats of `figures` alone.

    Raises:
        ConfigError: a section has a file of the result's names, or its picture fails.
        OutputError: a file cannot be written.
    """
    pictures, every, names = {}, dict(files), list[str]()
    formats, kept = sorted({*figures} | ({"png"} if report is not None else set())), place / "config.yaml"
    for section in sections:
        own = {**section.files, **section.pictures}
        if taken := (every.keys() | {page.NAME, "config.yaml", SETTINGS}) & own.keys():
            raise ConfigError(f"section {section.heading}", "", "other files than those of the result", min(taken))
        if (outside := leaving(place, own)) is not None:
            raise ConfigError("", f"section {section.heading}", "files in the result's folder", f"{outside!r}")
        every |= own
    drawing = any(isinstance(content, Picture) for content in every.values())
    with stage("drawing", compiles=False) if drawing else contextlib.nullcontext():
        for name, content in every.items():
            if isinstance(content, str):
                names.append(dataset.write_text_atomically(place / name, content).name)
            elif isinstance(content, Picture):
                names += [path.name for path in plots.save_figure(content.draw(), place / name, formats)]
                if name in files:
                    pictures[content.caption] = place / f"{name}.png"
            else:
                names.append(dataset.save(content, place / name).name)
    if report is not None:
        with stage("report", compiles=False):
            config = without_folders(kept.read_text(encoding="utf-8")) if kept.is_file() else ""
            made = report(origin._replace(config=config, pictures=pictures))
            made = dataclasses.replace(made, own=[_part(section, place) for section in sections])
            names.insert(0, page.write(made, place).name)
    return ", ".join([*names, kept.name] if kept.is_file() else names)


def _part(section: Section, place: Path) -> Part:
    pictures = {picture.caption: place / f"{name}.png" for name, picture in section.pictures.items()}
    return Part(section.heading, section.sentences, section.tables, pictures)


_NAMING_FILES = ("robot", "ground", "contact", "gait", "hardware", "disturbance", "own")  # sections


def _beside(scenario: mc.Scenario, copied: mc.Scenario) -> mc.Scenario:
    """Return a scenario that names the copies of its files, as that of the folder does."""
    return scenario.model_copy(update={name: getattr(copied, name) for name in _NAMING_FILES})


def _naming(data: xr.Dataset, copied: mc.Scenario) -> xr.Dataset:
    """Return data of a scenario that names the copies of its files; as they are where they tell of no scenario."""
    if "scenario" not in data.attrs:
        return data
    return data.assign_attrs(scenario=_beside(dataset.scenario_of(data), copied).to_yaml())


def without_folders(text: str) -> str:
    """Return a text without the folders of absolute paths: these belong to one machine."""
    return re.sub(r"(?<![\w.:/-])(?:~|[A-Za-z]:)?[/\\](?:[^/\\\n'\"=]+[/\\])*(?=[^/\\\s])", "", text)
