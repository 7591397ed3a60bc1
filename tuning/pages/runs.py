"""The results below a folder, from what their folders hold: a page over them."""

import html
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from mjx_climb.files.dataset import check_folder, write_text_atomically
from tuning.numbers import number
from tuning.pages.page import ENVIRONMENT
from tuning.pages.page import NAME as REPORT
from tuning.results.result import RESULTS

SETTINGS = "settings.json"
NAME = "runs.html"
_LONGEST = 40  # characters of a value
_VERDICT = re.compile(r'<p class="verdict">(.*?)</p>', re.DOTALL)
_COMMAND, _SCENARIO = "command", "scenario."


class Run(NamedTuple):
    """A result, or unfinished work."""

    folder: Path
    name: str  # of the folder below the one that was asked for
    command: str  # as its settings call it; the result's file where nothing says so
    when: datetime  # it was last written
    whole: bool
    settings: Mapping[str, Any]  # by their keys, those in which it differs from others
    verdict: str

    @property
    def differs(self) -> str:
        """The settings in which it differs, in words."""
        return ", ".join(f"{key.removeprefix(_SCENARIO)} {_short(value)}" for key, value in self.settings.items())

    @property
    def said(self) -> str:
        """The verdict, and whether it is not finished."""
        return "; ".join(filter(None, ["" if self.whole else "not finished", self.verdict]))

    @property
    def plain(self) -> dict[str, Any]:
        """What is known of it, for JSON."""
        told = {**self._asdict(), "folder": str(self.folder), "when": self.when.isoformat(timespec="seconds")}
        return told | {"settings": dict(self.settings)}


def below(folder: Path) -> list[Run]:
    """Return the results in a folder and below it, the newest first."""
    found = []
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        marker = next((name for name in RESULTS if name in files), None)
        if marker is None and SETTINGS not in files:
            continue
        where = Path(place)
        record = _read(where / SETTINGS)
        settings = record.get("settings") or {}
        written = where / (SETTINGS if SETTINGS in files else marker or "")
        when = datetime.fromtimestamp(written.stat().st_mtime)
        known = dict(_flat(settings))
        command = str(known.pop(_COMMAND, marker))
        name = os.path.relpath(where, folder)
        whole = record.get("whole", True) is True
        found.append(Run(where, name, command, when, whole, known, verdict(where)))
    found.sort(key=lambda run: (run.when, run.name), reverse=True)
    return _differing(found)


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
    try:
        found = _VERDICT.search((folder / REPORT).read_text("utf-8"))
        if found:
            return html.unescape(found[1]).strip()
    except (OSError, UnicodeDecodeError):
        pass
    metrics = _read(folder / "metrics.json")
    if "force_variation" in metrics:
        limb, at = metrics.get("detached_limb"), metrics.get("detached_at")
        lost = f"limb {limb} let go at {number(at)} s" if limb else "held all the way"
        lost = "diverged" if metrics.get("diverged") else lost
        return f"{lost}: force variation {number(metrics['force_variation'])} N"
    if warnings := _read(folder / "margins.json").get("warnings"):
        return "; ".join(map(str, warnings))
    return ""


def write(runs: Sequence[Run], folder: Path, out: Path) -> Path:
    """Write a page over runs into a folder, with links to their own pages, and return its path.

    Raises:
        OutputError: it cannot be written.
    """
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    links = {run.name: os.path.relpath(run.folder / REPORT, out) for run in runs if (run.folder / REPORT).is_file()}
    text = ENVIRONMENT.get_template("runs.html.jinja").render(runs=runs, folder=folder, links=links)
    return write_text_atomically(out / NAME, text)


def _read(file: Path) -> dict[str, Any]:
    """Return the mapping of a JSON file, an empty one where it cannot be read."""
    try:
        found = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


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
    return isinstance(value, int | float) and not isinstance(value, bool)
