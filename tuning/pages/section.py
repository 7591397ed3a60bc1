"""A section of the user's own: one heading of a report with its content, and files that it adds to the folder.

A function of a result and of its comparison (None without one) makes it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import xarray as xr

from mjx_climb.inputs.own_objects import in_one_line, load
from mjx_climb.scenario.messages import ConfigError
from tuning.pages.contents import Picture as Picture
from tuning.pages.page import Table as Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Section(NamedTuple):
    """The content under one heading of a report."""

    heading: str
    sentences: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Mapping[str, Picture] = {}  # by the names of their files, without an ending
    files: Mapping[str, str | xr.Dataset] = {}  # that the folder holds besides


SectionOf = Callable[[Any, Any], Section | None]  # None: nothing of this result


def load_section(text: str) -> SectionOf:
    """Return the function that FILE.py:NAME names.

    Raises:
        ConfigError: in one line, no such file or name, or no function.
    """
    made, file, name = load(text, "section")
    if not callable(made):
        raise ConfigError(file, "", f"{name} to be a function of a result and its comparison", f"{made!r}")
    function: SectionOf = made
    return function


def sections_of(functions: Iterable[SectionOf], found: object, compared: object) -> list[Section]:
    """Return the sections that functions make.

    Raises:
        ConfigError: in one line, a function fails or gives something else; the drawing of a picture later does too.
    """
    sections = []
    for function in functions:
        name = getattr(function, "__name__", type(function).__name__)
        with in_one_line(f"section {name}"):
            section = function(found, compared)
        if section is not None:
            if not isinstance(section, Section):
                raise ConfigError("", f"section {name}", "a tuning.pages.section.Section or None", f"{section!r}")
            drawn = {file: each._replace(draw=_named(name, each)) for file, each in section.pictures.items()}
            sections.append(section._replace(pictures=drawn))
    return sections


def _named(name: str, picture: Picture) -> "Callable[[], Figure]":
    def draw() -> "Figure":
        with in_one_line(f"section {name}"):
            return picture.draw()

    return draw
