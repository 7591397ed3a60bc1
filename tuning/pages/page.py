"""A report as one HTML page: its parts, and how it becomes a file."""

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
from tuning.pages.table import Table as Table

NAME = "report.html"
HERE = Path(__file__).parent
ROWS = 5  # of the table on the first screen, each of one metric of all that walked
MAIN = ("objective", "force variation", "peak foot force", "peak pull force", "cost of transport", "base deviation")
ENVIRONMENT = jinja2.Environment(
    loader=jinja2.FileSystemLoader(HERE), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
    lstrip_blocks=True,
)  # fmt: skip
ENVIRONMENT.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}  # keeps the order of keys
ENVIRONMENT.filters["plain"] = plain
ENVIRONMENT.filters["sentence"] = lambda line: f"{line[:1].upper()}{line[1:]}".removesuffix(".") + "."
ENVIRONMENT.filters["base64"] = lambda file: base64.b64encode(file.read_bytes()).decode()


class Part(NamedTuple):
    """A part that is folded away under one heading."""

    heading: str
    sentences: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Mapping[str, Path] = {}  # PNG files by their captions


class Findings(NamedTuple):
    """The verdict on a result and the lines around it: a terminal ends with the verdict, a page begins with it.

    The lines beside the verdict stand open on the page, the notes are folded away.
    """

    verdict: str
    beside: Sequence[str] = ()
    notes: Sequence[str] = ()

    @classmethod
    def of(cls, verdict: str, lines: Sequence[str], *beside: str) -> "Findings":
        """Findings with the warnings among the lines beside the verdict, behind `beside`."""
        warnings = [line for line in lines if line.startswith("warning")]
        return cls(verdict, [*filter(None, beside), *warnings], [line for line in lines if line not in warnings])

    @property
    def lines(self) -> list[str]:
        """All lines in the order of a terminal: the verdict last."""
        return [*self.notes, *self.beside, self.verdict]


class Origin(NamedTuple):
    """Where a page comes from."""

    name: str  # of the config
    asked: str  # the command, as it was typed
    again: str  # the command that repeats it, in the folder of the report
    config: str = ""  # the scenario in full
    pictures: Mapping[str, Path] = {}  # PNG files in that folder, by their captions


NOWHERE = Origin("", "", "")


@dataclasses.dataclass(frozen=True)
class Page:
    """The parts of a report in their order; `page.html.jinja` lays it out."""

    title: str  # {} stands for the name of the config
    findings: Findings
    scenario: mc.Scenario
    explorers: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)  # by heading
    tables: Sequence[Table] = ()
    opened: Sequence[Table] = ()  # whole on the first screen
    main: Sequence[str] = MAIN  # the rows of the first table that stand on the first screen
    prose: Mapping[str, Sequence[str]] = dataclasses.field(default_factory=dict)  # sentences below the tables
    own: Sequence[Part] = ()  # sections of the user's
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # beside the versions: seed, precision, ...
    origin: Origin = NOWHERE

    def at(self, origin: Origin) -> "Page":
        """The page with its origin."""
        return dataclasses.replace(self, title=self.title.replace("{}", origin.name), origin=origin)

    @property
    def brief(self) -> Table | None:
        """The first table on the first screen: the rows of its main metrics, or its first; None without one.

        A row without a name of its own belongs to the metric above it.
        """
        if not self.tables:
            return None
        table, blocks, last = self.tables[0], list[tuple[str, list[Sequence[str]]]](), ""
        for _, rows in table.sections:
            for row in rows:
                if not blocks or (row[0] and row[0] != last):
                    blocks.append((row[0], []))
                    last = row[0]
                blocks[-1][1].append(row)
        first = dict(reversed(blocks))
        chosen = [first[name] for name in self.main if name in first] or [rows for _, rows in blocks]
        return table._replace(sections=[("", [row for rows in chosen[:ROWS] for row in rows])])

    @property
    def first_pictures(self) -> dict[str, Path]:
        """The picture of the first screen by its caption, where nothing interactive stands there."""
        return {} if self.explorers else dict([*self.origin.pictures.items()][:1])

    @property
    def parts(self) -> list[Part]:
        """The parts below the first screen, as far as there are any."""
        notes = self.findings.notes
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
