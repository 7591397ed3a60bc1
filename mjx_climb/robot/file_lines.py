"""Where something stands in a robot's file, or in one that it includes."""

import re
from pathlib import Path
from typing import NamedTuple

from mjx_climb.mujoco_import import mujoco

_INCLUDE = re.compile(r"<include\s[^>]*?file\s*=\s*[\"']([^\"']+)[\"'][^>]*?(?:/>|>\s*</include\s*>)")
_ROOT = re.compile(r"<\?.*?\?>|</?\s*mujoco(?:include)?\b[^>]*>", re.DOTALL)
_NUMBER = re.compile(r"[Ll]ine (?:number=)?(\d+)")
_ELEMENTS = r"<\s*(?:body|joint|freejoint|link|geom|site)\s[^<>]*?"  # what is looked for first


class _Line(NamedTuple):
    file: str
    number: int
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.number}"


def line_of(file: str, name: str) -> str:
    """Return a file, and after a colon the line in which it, or one that it includes, first names an element so."""
    lines = _lines(Path(file), set())
    text = "\n".join(line.text for line in lines)
    named = rf"name\s*=\s*[\"']{re.escape(name)}[\"']"
    found = re.search(_ELEMENTS + rf"({named})", text) or re.search(rf"({named})", text)
    return str(lines[text.count("\n", 0, found.start(1))]) if found else file


def line_with(file: str, text: str) -> str:
    """Return a file, and after a colon the line in which it, or one it includes, first has a text between quotes."""
    quoted = (f'"{text}"', f"'{text}'")
    return next((str(line) for line in _lines(Path(file), set()) if any(q in line.text for q in quoted)), file)


def line_in(file: str, reason: str) -> str | None:
    """Return the line that MuJoCo's reason is about; None where it tells none.

    It tells 0 of what stands in an included file: the reason is then asked for again with all in one file.
    """
    if not (found := _NUMBER.search(reason)):
        return None
    if int(found[1]):
        return f"{file}:{found[1]}"
    lines = _lines(Path(file), set())
    try:
        mujoco.MjSpec.from_string("\n".join(line.text for line in lines)).compile()
    except (ValueError, OSError, mujoco.FatalError) as error:
        again = " ".join(str(error).split())
        found = _NUMBER.search(again)
        if found and again.split("Element")[0] == reason.split("Element")[0] and 0 < int(found[1]) <= len(lines):
            return str(lines[int(found[1]) - 1])
    return None


def repeated(file: str) -> str:
    """Return a URDF, and after a colon the line in which a name of a link or joint comes a second time."""
    text = "\n".join(line.text for line in _lines(Path(file), set()))
    seen: set[tuple[str, ...]] = set()
    for found in re.finditer(r"<\s*(link|joint)\s[^<>]*?\bname\s*=\s*[\"']([^\"']*)[\"']", text):
        if found.groups() in seen:
            return f"{file}:{text.count(chr(10), 0, found.start(2)) + 1}"
        seen.add(found.groups())
    return file


def _lines(file: Path, above: set[Path]) -> list[_Line]:
    """Return the lines of a file, those of the ones that it includes in their places; `above` are those around it."""
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    if above:
        text = _ROOT.sub(lambda root: "\n" * root[0].count("\n"), text)
    found: list[_Line] = []
    at = 0
    for include in _INCLUDE.finditer(text):
        found += _numbered(file, text, at, include.start())
        other = file.parent / include[1]
        if other not in above | {file}:
            found += _lines(other, above | {file})
        at = include.end()
    return found + _numbered(file, text, at, len(text))


def _numbered(file: Path, text: str, start: int, stop: int) -> list[_Line]:
    first = 1 + text.count("\n", 0, start)
    return [_Line(str(file), first + n, line) for n, line in enumerate(text[start:stop].split("\n"))]
