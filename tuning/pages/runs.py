"""The results below a folder, from the files in their folders: a page over them."""

import contextlib
import html
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from mjx_climb.files.dataset import check_folder, write_text_atomically
from mjx_climb.reading import read_found
from mjx_climb.scenario.messages import printable
from tuning.numbers import number
from tuning.pages.page import ENVIRONMENT
from tuning.pages.page import NAME as REPORT
from tuning.results.result import RESULTS, SETTINGS

NAME = "runs.html"
_LONGEST = 40  # characters of a value
_VERDICT = '<p class="verdict">'
_DAMAGED = f"{SETTINGS} is damaged"
_COMMAND, _SCENARIO = "command", "scenario."


class Run(NamedTuple):
    """A result, or unfinished work."""

    folder: Path
    name: str  # of the folder below the one that was asked for
    command: str  # as its settings call it; the result's file where nothing says so
    when: datetime  # it was last written
    whole: bool
    settings: Mapping[str, Any]  # by their keys, those that differ from others'
    verdict: str

    @property
    def differs(self) -> str:
        """The settings that differ, in words."""
        each = (f"{key.removeprefix(_SCENARIO)} {_short(value)}" for key, value in self.settings.items())
        return printable(", ".join(each))

    @property
    def said(self) -> str:
        """The verdict, and whether it is not finished."""
        return "; ".join(filter(None, ["" if self.whole else "not finished", self.verdict]))

    @property
    def plain(self) -> dict[str, Any]:
        """All about it, for JSON."""
        told = {**self._asdict(), "folder": str(self.folder), "when": self.when.isoformat(timespec="seconds")}
        return told | {"settings": dict(self.settings)}


def below(folder: Path, check: Callable[[], None] = lambda: None) -> list[Run]:
    """Return the results in a folder and below it, the newest first; `check` is called at each folder, to end it."""
    found = []
    for place, folders, files in os.walk(folder):
        check()
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        marker = next((name for name in RESULTS if name in files), None)
        if marker is None and SETTINGS not in files:
            continue
        with contextlib.suppress(OSError):  # removed just now, or not for this user
            found.append(_run(Path(place), folder, SETTINGS if SETTINGS in files else marker, marker))
    found.sort(key=lambda run: (run.when, run.name), reverse=True)
    return _differing(found)


def _run(where: Path, above: Path, written: str | None, marker: str | None) -> Run:
    """Return the result in a folder; `written` is the file that is as old as the result, `marker` that of its kind."""
    seconds = os.stat(where / str(written)).st_mtime
    try:
        when = datetime.fromtimestamp(seconds)
    except (OverflowError, ValueError, OSError):  # of a damaged disk or archive
        when = datetime.fromtimestamp(0)
    record = _read(where / SETTINGS)
    settings, said = record.get("settings"), verdict(where)
    if written == SETTINGS and not ("settings" in record and isinstance(settings, dict | None)):
        settings, said = {}, said or _DAMAGED
    known, whole = dict(_flat(settings or {})), record.get("whole", True) is True
    command = str(known.pop(_COMMAND, marker or "unknown"))
    name, command, said = map(printable, (os.path.relpath(where, above), command, said))
    return Run(where, name, command, when, whole, known, said)


def _differing(runs: Sequence[Run]) -> list[Run]:
    """Return runs with those settings alone that differ: of the scenario among all, others within a command's own."""
    kept = []
    for run in runs:
        alike = [other for other in runs if other.command == run.command]

        def differs(key: str, run: Run = run, alike: Sequence[Run] = alike) -> bool:
            others = [other for other in runs if other.settings] if key.startswith(_SCENARIO) else alike
            return any(other.settings.get(key) != run.settings[key] for other in others)

        kept.append(run._replace(settings={key: value for key, value in run.settings.items() if differs(key)}))
    return kept


def verdict(folder: Path) -> str:
    """Return the verdict of a result in a sentence, "" where its folder has none."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        _, _, after = read_found(folder / REPORT).partition(_VERDICT)
        text, end, _ = after.partition("</p>")
        if end:
            return html.unescape(text).strip()
    metrics = _read(folder / "metrics.json")
    limb, at, variation = (metrics.get(name) for name in ("detached_limb", "detached_at", "force_variation"))
    if "force_variation" in metrics:
        at, variation = (number(value) if _real(value) else str(value) for value in (at, variation))
        lost = f"limb {limb} let go at {at} s" if limb else "held all the way"
        if (stands := metrics.get("stands_at")) is not None:
            lost = f"stands from {number(stands) if _real(stands) else stands} s for want of a grip"
        lost = "diverged" if metrics.get("diverged") else lost
        # of a walk that flew off there is none
        return lost if metrics["force_variation"] is None else f"{lost}: force variation {variation} N"
    warnings = _read(folder / "margins.json").get("warnings")
    return "; ".join(map(str, warnings)) if isinstance(warnings, list) else ""


def write(runs: Sequence[Run], folder: Path, out: Path) -> Path:
    """Write a page over runs into a folder, with links to their own pages, and return its path.

    Raises:
        OutputError: it cannot be written.
    """
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    pages = {run.name: run.folder / REPORT for run in runs if (run.folder / REPORT).is_file()}
    links = {name: quote(os.fsencode(os.path.relpath(page, out))) for name, page in pages.items()}
    text = ENVIRONMENT.get_template("runs.html.jinja").render(runs=runs, folder=folder, links=links)
    return write_text_atomically(out / NAME, text)


def _read(file: Path) -> dict[str, Any]:
    """Return the mapping of a JSON file, an empty one where it cannot be read."""
    try:
        found = json.loads(read_found(file))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and _shallow(found) else {}


def _shallow(value: Any, levels: int = 50) -> bool:
    """Return whether a value of JSON nests no deeper than any result's does: functions here call themselves."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return levels > 0 and all(_shallow(each, levels - 1) for each in inner)


def _flat(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield settings by their whole keys."""
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def _short(value: Any) -> str:
    text = " ".join(map(_short, value)) if isinstance(value, list) else f"{value:g}" if _real(value) else str(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def _real(value: Any) -> bool:
    """Return whether a value of JSON is a number that a float can be: an integer there has any length."""
    return isinstance(value, float) or (type(value) is int and abs(value) < sys.float_info.max)
