"""Many walks of one program, cut into parts that are kept on disk, and into shards that other processes walk.

A shard walks a run of the rows and leaves it as parts in a folder of its own; `joined` puts the rows of all shards
together. On a CPU each row has the bits that it has in one process.
"""

import dataclasses
import fnmatch
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjx_climb.compilation import devices
from mjx_climb.files.dataset import OutputError, write_text_atomically
from mjx_climb.scenario.messages import ConfigError
from tuning.searches import finished_parts
from tuning.searches.finished_parts import Parts

FILE = "shard.json"
SHARD = "{shard}"  # in the command that walks a shard
Told = Callable[[int, int], None]  # rows done, rows in all


@dataclasses.dataclass(frozen=True)
class Shard:
    """One of several equal runs of rows."""

    number: int  # from 1
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def rows(self, in_all: int) -> range:
        """Return the rows of this shard."""
        return range((self.number - 1) * in_all // self.count, self.number * in_all // self.count)

    def folder(self, out: Path) -> Path:
        """Return where below a folder this shard is kept; names in the order of the shards."""
        return out / f"shard-{self.number:0{len(str(self.count))}d}-of-{self.count}"


def made(number: int, count: int) -> Shard:
    """Return a shard.

    Raises:
        ConfigError: no number from 1 to the count.
    """
    if not 1 <= number <= count:
        raise ConfigError(f"shard: expected a number from 1 to how many there are, got {number}/{count}")
    return Shard(number, count)


class Work(Protocol):
    """Walks that are told apart by their row alone."""

    @property
    def rows(self) -> int:
        """How many there are."""

    @property
    def size(self) -> int:
        """How many walk at a time."""

    @property
    def in_pieces(self) -> bool:
        """Whether steps are compiled in pieces, as `mjx_climb.compilation.devices` asks."""

    def identity(self) -> dict[str, Any]:
        """Return all that determines the numbers of a row, bit by bit, as plain JSON values; `kind` among them."""

    def walk(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return arrays whose first axis is that of some rows."""

    def name(self, row: int) -> str:
        """Return what a row is, in words."""


class Kept(NamedTuple):
    """A shard in its folder."""

    folder: Path
    shard: Shard
    identity: Mapping[str, Any]
    about: Mapping[str, Any]  # what else was told of it


def even(rows: int, size: int) -> int:
    """Return the size, `size` at most, of equal parts of so many rows."""
    return math.ceil(rows / math.ceil(rows / size))


def parts_of(work: Work, rows: range) -> list[range]:
    """Return the parts in which some of the rows walk: those of all rows, as far as they are among them."""
    parts = [range(begin, begin + work.size) for begin in range(0, work.rows, work.size)]
    cut = [range(max(part.start, rows.start), min(part.stop, rows.stop)) for part in parts]
    return [part for part in cut if part]


def walk(work: Work, kept: Parts | None, progress: Told | None, shard: Shard | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of all rows, or of those of a shard; `kept` parts are not walked again.

    `progress` is told of the rows that are there already first, then after each part.
    """
    rows = range(work.rows) if shard is None else shard.rows(work.rows)
    parts = parts_of(work, rows)
    found = [None if kept is None else kept.load(number) for number in range(len(parts))]
    done = sum(len(part) for part, arrays in zip(parts, found, strict=True) if arrays is not None)
    if progress is not None:
        progress(done, len(rows))
    for number, part in enumerate(parts):
        if found[number] is not None:
            continue
        arrays = _walk_part(work, part)
        found[number] = arrays
        if kept is not None:
            kept.save(number, arrays)
        done += len(part)
        if progress is not None:
            progress(done, len(rows))
    return _concatenated([arrays for arrays in found if arrays is not None])


def _walk_part(work: Work, part: range) -> dict[str, np.ndarray]:
    """Return the arrays of a part, or of the piece of one that a shard has."""
    begin = part.start // work.size * work.size
    own = range(part.start - begin, part.stop - begin)
    # the last part is filled up with its last row: every part has the shape that was compiled
    filled = own.stop == work.rows - begin and not own.start
    walking = range(work.size) if filled else devices.walking_with(own, work.size, in_pieces=work.in_pieces)
    last = min(work.size, work.rows - begin) - 1
    arrays = work.walk(begin + np.minimum(np.array(walking), last))
    return {name: values[own.start - walking.start : own.stop - walking.start] for name, values in arrays.items()}


def there(work: Work, kept: Parts, rows: range) -> int:
    """Return how many of some rows are kept already."""
    return sum(len(part) for number, part in enumerate(parts_of(work, rows)) if kept.load(number) is not None)


def claim(work: Work, out: Path, shard: Shard) -> Parts:
    """Prepare the folder of a shard below `out` and return its parts.

    Raises:
        ConfigError: more shards than rows.
        OutputError: the folder cannot be written, or `out` holds shards of another number or of something else.
    """
    if shard.count > work.rows:
        raise ConfigError(f"shard {shard}: expected at most {work.rows} shards, one walk each, got {shard.count}")
    for other in _folders_in(out):
        if not other.name.endswith(f"-of-{shard.count}"):
            raise OutputError(
                f"{out}: expected shards of {shard.count}, got {other.name} (remove it, or choose another --out)"
            )
    folder = shard.folder(out)
    return Parts(folder, {**work.identity(), "shard": [shard.number, shard.count]})


def tell(out: Path, shard: Shard, about: Mapping[str, Any]) -> None:
    """Leave in the folder of a shard what those who merge it need beside its identity, as plain JSON values.

    `again` is the command, or the call, that walks a shard, with `SHARD` where it names which.

    Raises:
        OutputError: the folder cannot be written.
    """
    write_text_atomically(shard.folder(out) / FILE, json.dumps(about, indent=1) + "\n")


def find(folders: Sequence[Path]) -> list[Kept]:
    """Return the shards in some folders, each a shard's own or one that holds shards, in their order.

    Raises:
        ConfigError: none there, one given twice, or shards of different things.
    """
    found: list[Kept] = []
    for folder in folders:
        own = [folder] if os.path.isfile(folder / FILE) else _folders_in(folder)
        if not own:
            raise ConfigError(f"{folder}: expected a shard's folder, or one that holds shards, got none")
        found += map(_read, own)
    first = found[0]
    for other in found[1:]:
        if other.shard.count != first.shard.count:
            raise ConfigError(
                f"{other.folder}: expected a shard of {first.shard.count} as {first.folder}, got {other.shard}"
            )
        if differs := finished_parts.differences(_without_shard(first), _without_shard(other)):
            raise ConfigError(
                f"{other.folder}: expected a shard of the same as {first.folder}, got one that differs in "
                f"{', '.join(differs)}"
            )
    by_number: dict[int, Kept] = {}
    for each in found:
        if (twin := by_number.setdefault(each.shard.number, each)) is not each:
            raise ConfigError(f"{each.folder}: expected each shard once, got {each.shard} in {twin.folder} as well")
    return [by_number[number] for number in sorted(by_number)]


def home(found: Sequence[Kept]) -> Path | None:
    """Return the folder that holds all these shards, None where they lie in several."""
    folders = {each.folder.absolute().parent: each.folder.parent for each in found}
    return next(iter(folders.values())) if len(folders) == 1 else None


def joined(work: Work, found: Sequence[Kept]) -> dict[str, np.ndarray]:
    """Return the arrays of all rows from the shards that `find` found.

    Raises:
        ConfigError: they are shards of something else than `work`, made elsewhere than here for example, or not whole.
    """
    begun = {each.shard.number: each for each in found}
    count = found[0].shard.count
    # a merge may run on another kind of machine: it walks nothing of the shards
    own = {**work.identity(), "platform": found[0].identity.get("platform")}
    if differs := finished_parts.differences(_without_shard(found[0]), json.loads(json.dumps(own))):
        raise ConfigError(
            f"{found[0].folder}: expected a shard of what is merged here, got one that differs in {', '.join(differs)}"
        )
    whole: list[dict[str, np.ndarray]] = []
    lacking: list[str] = []
    for number in range(1, count + 1):
        shard = Shard(number, count)
        parts = parts_of(work, shard.rows(work.rows))
        kept = None if number not in begun else Parts(begun[number].folder, begun[number].identity)
        loaded = [None if kept is None else kept.load(at) for at in range(len(parts))]
        missing = [part for part, arrays in zip(parts, loaded, strict=True) if arrays is None]
        if missing:
            lacking.append(_lack(work, shard, missing, kept is not None))
        whole += [arrays for arrays in loaded if arrays is not None]
    if lacking:
        raise ConfigError(f"{home(found) or found[0].folder}: {'; '.join(lacking)}; {_remedy(found, lacking)}")
    return _concatenated(whole)


def _lack(work: Work, shard: Shard, missing: Sequence[range], begun: bool) -> str:
    """Return in words which rows of a shard are missing."""
    rows = sum(map(len, missing))
    runs = [missing[0]]
    for part in missing[1:]:
        runs[-1:] = [range(runs[-1].start, part.stop)] if part.start == runs[-1].stop else [runs[-1], part]
    named = ", ".join(f"{work.name(run[0])} to {work.name(run[-1])}" for run in runs)
    state = "lacks" if begun else "is not there: it lacks"
    return f"shard {shard} {state} {rows} of {len(shard.rows(work.rows))} walks ({named})"


def _remedy(found: Sequence[Kept], lacking: Sequence[str]) -> str:
    numbers = [text.split()[1] for text in lacking]
    command = str(found[0].about["again"]).replace(SHARD, numbers[0])
    others = f", and likewise {', '.join(numbers[1:])}" if numbers[1:] else ""
    return f"to finish it: {command}{others}"


def _folders_in(folder: Path) -> list[Path]:
    try:
        names = sorted(os.listdir(folder))
    except (OSError, ValueError):  # ValueError: a null byte
        return []
    return [folder / name for name in names if fnmatch.fnmatch(name, "shard-*-of-*")]


def _read(folder: Path) -> Kept:
    try:
        identity = finished_parts.identity_in(folder / finished_parts.FOLDER) or {}
        about = json.loads((folder / FILE).read_text())
        if not all(isinstance(about[name], str) for name in ("again", *about)):
            raise TypeError
        return Kept(folder, Shard(*identity["shard"]), identity, about)
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        raise ConfigError(f"{folder}: expected the folder of a shard, got one that is damaged or empty") from None


def _without_shard(kept: Kept) -> dict[str, Any]:
    return {name: value for name, value in kept.identity.items() if name != "shard"}


def _concatenated(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([arrays[name] for arrays in parts]) for name in parts[0]}
