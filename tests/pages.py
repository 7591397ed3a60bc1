"""The commands of a page, carried out one after the other in one folder, beside the output that the page shows.

A block of `sh` may be followed by one of `text`, which shows what the last of its commands printed, or of `yaml`, the
file that this command wrote. Lines may be left out there, and long ones are wrapped; times are none of it, they go to
standard error. A page whose figures depend on the processor says "differ by up to N %": numbers may be off by so much,
and those with a sign or a per cent sign by so many points.

    python -m tests.pages docs/start/tutorial.md --write

carries a page out and rewrites its blocks by what was printed. With --folder what was printed there before is taken, so
that a long page goes on where it was interrupted. Blocks that have no output yet get theirs by hand the first time.
"""

import argparse
import difflib
import json
import re
import shlex
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from tests import shell

FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
WIDTH = 112  # columns of a box
ERROR = "mjx-climb: error:"
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
Arguments = list[str]


class Example(NamedTuple):
    """The commands of a block, and where in the page stands what the last of them printed or wrote."""

    commands: list[Arguments]
    shown: str | None  # None: nothing
    place: tuple[int, int]  # of what is shown, characters of the page
    of_file: bool  # it is the file of `--out`


def fences(text: str, *languages: str) -> list[str]:
    """Return the blocks of some languages."""
    return [body for language, body in FENCE.findall(text) if language in languages]


def commands(text: str) -> list[Arguments]:
    """Return the arguments of the lines that call the program."""
    lines = (line.strip() for line in text.replace("\\\n", " ").splitlines())
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("mjx-climb ")]


def examples(page: str) -> Iterator[Example]:
    """Return the examples of a page, in their order."""
    blocks = list(FENCE.finditer(page))
    for block, after in zip(blocks, [*blocks[1:], None], strict=True):
        if block[1] == "sh" and (calls := commands(block[2])):
            kind = after[1] if after else ""
            of_file = kind == "yaml" and "--out" in calls[-1]
            shows = after is not None and (kind == "text" or of_file)
            yield Example(calls, after[2] if shows else None, after.span(2) if shows else (0, 0), of_file)


def carried_out(
    page: str, folder: Path, wanted: Callable[[Arguments], bool] = lambda _: True
) -> Iterator[tuple[Example, list[str]]]:
    """Carry out the examples of a page that hold wanted commands alone; return each with the lines that came of it.

    The folder has the configs of a checkout, and what was printed there before.

    Raises:
        AssertionError: a command ended with another code than 0, or 2 where the page shows an error.
    """
    if not (folder / "configs").exists():
        (folder / "configs").symlink_to(shell.ROOT / "configs")
    kept = folder / "printed.json"
    known: dict[str, str] = json.loads(kept.read_text()) if kept.exists() else {}
    for example in examples(page):
        if not all(map(wanted, example.commands)):
            continue
        refused = example.shown is not None and example.shown.startswith(ERROR)
        for number, arguments in enumerate(example.commands, 1):
            command = shlex.join(arguments)
            if command not in known:
                code = 2 if refused and number == len(example.commands) else 0
                known[command] = "\n".join(shell.finish(*arguments, code=code, folder=folder))
                kept.write_text(json.dumps(known, indent=1))
            lines = known[command].splitlines()
        if example.of_file:
            lines = (folder / arguments[arguments.index("--out") + 1]).read_text().splitlines()
        yield example, lines


def tolerance(page: str) -> float:
    """Return by how much numbers may differ from those of a page, as a share."""
    said = re.search(r"differ\s+by\s+up\s+to\s+(\d+)\s+%", page)
    return float(said[1]) / 100 if said else 0.0


def difference(shown: str, printed: list[str], share: float) -> str:
    """Return what a page shows and was not printed, in its order; an empty text where all of it was."""
    words, at = _words(shown), 0
    for line in map(_words, printed):
        if line and _masked(words[at : at + len(line)]) == _masked(line):
            for here, there in zip(words[at : at + len(line)], line, strict=True):
                if not _alike(here, there, share):
                    return f"{here!r} for {there!r} in: {' '.join(line)}"
            at += len(line)
    return " ".join(words[at : at + 20])


def rewritten(shown: str, printed: list[str]) -> str:
    """Return the lines that a page shows as they were printed: those that begin alike, in their order."""
    if not (page := shown.splitlines()):
        return ""
    both = difflib.SequenceMatcher(None, [*map(_beginning, page)], [*map(_beginning, printed)], autojunk=False)
    places = [place for block in both.get_matching_blocks() for place in range(block.b, block.b + block.size)]
    lines: list[str] = []
    for line in (printed[place].rstrip() for place in places):
        lines += _wrapped(line) if len(line) > WIDTH else [line]
    return "\n".join([*lines, ""])


def _wrapped(line: str) -> list[str]:
    return textwrap.wrap(line, WIDTH, subsequent_indent="# " if line.startswith("# ") else "", break_on_hyphens=False)


def _words(text: str) -> list[str]:
    """Return words, without the signs at which a line of a comment begins."""
    return [word for word in re.sub("─+", "─", text).split() if word != "#"]


def _masked(words: list[str]) -> list[str]:
    return [NUMBER.sub("#", word) for word in words]


def _beginning(line: str) -> tuple[str, ...]:
    return tuple(_masked(_words(line))[:2])


def _alike(here: str, there: str, share: float) -> bool:
    """Return whether the numbers of two words are alike; words in which a number stands for a name have the same."""
    for one, other in zip(NUMBER.findall(here), NUMBER.findall(there), strict=True):
        points = one[0] in "+-" or here.endswith("%")
        largest = 100.0 if points else max(abs(float(one)), abs(float(other)))
        if one != other and abs(float(one) - float(other)) > share * largest:
            return False
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description="Carry out the commands of a page.")
    parser.add_argument("page", type=Path)
    parser.add_argument("--write", action="store_true", help="rewrite its blocks by what is printed")
    parser.add_argument("--folder", type=Path, help="where, a temporary folder by default")
    given = parser.parse_args()
    page, changes = given.page.read_text("utf-8"), []
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        for example, printed in carried_out(page, folder):
            if example.shown is not None:
                print(difference(example.shown, printed, tolerance(page)) or "as shown:", *example.commands[-1])
                changes.append((example.place, rewritten(example.shown, printed)))
    if given.write:
        for (begin, end), text in reversed(changes):
            page = page[:begin] + text + page[end:]
        given.page.write_text(page, "utf-8")


if __name__ == "__main__":
    main()
