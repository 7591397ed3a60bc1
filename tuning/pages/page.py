"""A report as one HTML page: what stands on it, and how it becomes a file."""

import base64
import dataclasses
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2

import mjx_climb as mc
from mjx_climb.files import dataset
from tuning.numbers import plain

NAME = "report.html"
HERE = Path(__file__).parent
ROWS = 5  # of the table on the first screen
MAIN = ("force variation", "peak foot force", "peak pull force", "cost of transport", "base deviation")
ENVIRONMENT = jinja2.Environment(
    loader=jinja2.FileSystemLoader(HERE), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
    lstrip_blocks=True,
)  # fmt: skip
ENVIRONMENT.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}  # keeps the order of keys
ENVIRONMENT.filters["plain"] = plain
ENVIRONMENT.filters["base64"] = lambda file: base64.b64encode(file.read_bytes()).decode()


class Table(NamedTuple):
    """A table as text; sections are runs of rows with a heading. The first `words` columns are not numbers."""

    caption: str
    columns: Sequence[str]
    sections: Sequence[tuple[str, Sequence[Sequence[str]]]]
    words: int = 2


class Part(NamedTuple):
    """What is folded away under one heading."""

    heading: str
    sentences: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Mapping[str, Path] = {}  # PNG files by their captions


class Origin(NamedTuple):
    """Where a page comes from."""

    name: str  # of the config
    asked: str  # the command, as it was typed
    again: str  # the command that repeats it, in the folder of the report
    config: str = ""  # the scenario in full
    pictures: Mapping[str, Path] = {}  # PNG files in that folder, by their captions


@dataclasses.dataclass(frozen=True)
class Page:
    """What a report says, in the order in which it says it; `page.html.jinja` lays it out."""

    title: str
    origin: Origin
    verdict: str  # one sentence
    scenario: mc.Scenario
    notes: Sequence[str] = ()  # sentences; warnings stand open, others are folded away
    more: Sequence[str] = ()  # notes that come after these
    explorers: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)  # by heading
    tables: Sequence[Table] = ()
    main: Sequence[str] = MAIN  # the rows of the first table that stand on the first screen
    prose: Mapping[str, Sequence[str]] = dataclasses.field(default_factory=dict)  # sentences below the tables
    own: Sequence[Part] = ()  # sections of the user's
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # beside the versions: seed, precision, ...

    @property
    def warnings(self) -> list[str]:
        """The notes that stand below the verdict."""
        return [note for note in self.notes if note.lower().startswith("warning")]

    @property
    def brief(self) -> Table | None:
        """The `ROWS` of the first table on the first screen: the main ones, or its first; None without one."""
        if not self.tables:
            return None
        table = self.tables[0]
        rows = {row[0]: row for _, rows in reversed(table.sections) for row in reversed(rows)}  # the first of each name
        chosen = [rows[name] for name in self.main if name in rows] or [
            row for _, rows in table.sections for row in rows
        ]
        return table._replace(sections=[("", chosen[:ROWS])])

    @property
    def first_pictures(self) -> dict[str, Path]:
        """The picture of the first screen by its caption, where nothing interactive stands there."""
        return {} if self.explorers else dict([*self.origin.pictures.items()][:1])

    @property
    def parts(self) -> list[Part]:
        """What is below the first screen, as far as there is any."""
        notes = [note for note in (*self.notes, *self.more) if note not in self.warnings]
        others = {caption: file for caption, file in self.origin.pictures.items() if caption not in self.first_pictures}
        parts = [
            Part(f"What else was found ({len(notes)})", notes),
            Part("All numbers", tables=self.tables),
            *(Part(heading, sentences) for heading, sentences in self.prose.items()),
            Part(f"Pictures ({len(others)})", pictures=others),
            *self.own,
        ]
        return [part for part in parts if any(part[1:])]


def write(page: Page, folder: Path) -> Path:
    """Write the page into a folder and return its path; a crash leaves the old file or the new one.

    Raises:
        OutputError: the file cannot be written.
    """
    return dataset.write_text_atomically(folder / NAME, render(page))


def render(page: Page) -> str:
    """Return the page as HTML that holds all it needs."""
    import jax

    made = dataset.provenance(page.scenario)
    made.pop("scenario")
    versions = {name.removesuffix("_version"): made.pop(name) for name in list(made) if name.endswith("_version")}
    versions["python"] = platform.python_version()
    device = jax.devices()[0]
    facts = {
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        **{name.replace("_", " "): value for name, value in made.items()},
        "device": f"{len(jax.devices())} x {device.device_kind} ({device.platform})",
        **page.facts,
    }
    return ENVIRONMENT.get_template("page.html.jinja").render(page=page, facts=facts)
