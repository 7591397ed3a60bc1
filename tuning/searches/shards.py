"""Many walks of one program, cut into parts that are kept on disk, and into shards that other processes walk.

A shard walks a run of the rows and leaves it as parts in a folder of its own; `joined` puts the rows of all shards
together. On a CPU each row has the bits that it has in one process. `tuning.merge` joins them.
"""

import dataclasses
import fnmatch
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjx_climb import execution
from mjx_climb.files.dataset import OutputError, write_text_atomically
from mjx_climb.reading import read_found
from mjx_climb.scenario.messages import ConfigError
from tuning.methods import parts as finished_parts
from tuning.methods.parts import Parts

FILE = "shard.json"
SHARD = "{shard}"  # in the command that walks a shard
Counted = Callable[[int, int], None]  # rows done, rows in all


@dataclasses.dataclass(frozen=True)
class Shard:
    """One of several equal runs of rows; ConfigError where its number is none from 1 to the count."""

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise ConfigError("", "shard", "a number from 1 to how many there are", self)

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def rows(self, in_all: int) -> range:
        """Return the rows of this shard."""
        return range((self.number - 1) * in_all // self.count, self.number * in_all // self.count)

    def folder(self, out: Path) -> Path:
        """Return where below a folder this shard is kept; names in the order of the shards."""
        return out / f"shard-{self.number:0{len(str(self.count))}d}-of-{self.count}"


class Work(Protocol):
    """Walks that are told apart by their row alone."""

    @property
    def rows(self) -> int:
        """How many there are."""

    @property
    def size(self) -> int:
        """How many walk at a time."""

    def identity(self) -> dict[str, Any]:
        """Return all that determines the numbers of a row, bit by bit, as plain JSON values; `kind` among them."""

    def walk(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return arrays whose first axis is that of some rows."""

    def name(self, row: int) -> str:
        """Return the description of a row."""

    def write_asked(self, folder: Path) -> None:
        """Write the files that `read_asked` of its module makes the same work of for a merge, beside the identity."""


class Kept(NamedTuple):
    """A shard in its folder."""

    folder: Path
    shard: Shard
    identity: Mapping[str, Any]
    about: Mapping[str, Any]  # further facts

    @property
    def work(self) -> dict[str, Any]:
        """The identity of the work that it is a shard of."""
        return {name: value for name, value in self.identity.items() if name != "shard"}


def parts_of(work: Work, rows: range) -> list[range]:
    """Return the parts of some rows: those of all rows, as far as they are among them."""
    begins = range(0, work.rows, work.size)
    cut = [range(max(begin, rows.start), min(begin + work.size, rows.stop)) for begin in begins]
    return [part for part in cut if part]


class Rows:
    """The rows of a work that one process walks, all or a shard's; a folder keeps each part that is finished."""

    def __init__(
        self,
        work: Work,
        out: str | os.PathLike[str] | None = None,
        shard: tuple[int, int] | None = None,
        about: Mapping[str, str] = MappingProxyType({}),
    ):
        """Claim the folder.

        Arguments:
            work: the walks.
            out: the folder, or that below which a shard has one of its own; nothing is kept where None.
            shard: which one, from 1, and how many there are.
            about: for those who merge shards: `again`, the command or call that walks one, with `SHARD` where it names
                which, and further facts for the report.

        Raises:
            ConfigError: no such shard, or more shards than rows.
            OutputError: the folder cannot be written, or `out` holds parts, or shards, of something else.
        """
        self._work, self.shard = work, None if shard is None else Shard(*shard)
        self.rows = range(work.rows) if self.shard is None else self.shard.rows(work.rows)
        self._cut, self.folder = parts_of(work, self.rows), None if out is None else Path(out)
        if self.shard is None or self.folder is None:
            self._parts = Parts(self.folder, work.identity)
            return
        number, count = self.shard.number, self.shard.count
        if count > work.rows:
            raise ConfigError("", f"shard {self.shard}", f"at most {work.rows} shards, one walk each", count)
        for other in _folders_in(self.folder):
            if not other.name.endswith(f"-of-{count}"):
                got = f"{other.name} (remove it, or choose another --out)"
                raise OutputError(f"{self.folder}: expected shards of {count}, got {got}")
        self.folder = self.shard.folder(self.folder)
        self._parts = Parts(self.folder, lambda: {**work.identity(), "shard": [number, count]})
        work.write_asked(self.folder)
        write_text_atomically(self.folder / FILE, json.dumps({**about}, indent=1) + "\n")

    @property
    def there(self) -> int:
        """How many of the rows are kept already."""
        return sum(len(part) for number, part in enumerate(self._cut) if self._parts.load(number) is not None)

    def walk(self, progress: Counted | None = None) -> dict[str, np.ndarray]:
        """Return the arrays of the rows; parts that are there are not walked again.

        `progress` is called with the rows that are there already first, then after each part.
        """
        found = [self._parts.load(number) for number in range(len(self._cut))]
        lacking = [number for number, arrays in enumerate(found) if arrays is None]
        done = len(self.rows) - sum(len(self._cut[number]) for number in lacking)
        if progress is not None:
            progress(done, len(self.rows))
        for number in lacking:
            arrays = found[number] = _walk_part(self._work, self._cut[number])
            self._parts.save(number, arrays)  # before it is counted as done
            done += len(self._cut[number])
            if progress is not None:
                progress(done, len(self.rows))
        return _concatenated([arrays for arrays in found if arrays is not None])


def walk_shard(work: Work, shard: tuple[int, int], out: str | os.PathLike[str], progress: Counted | None) -> Path:
    """Simulate a shard of some work for `merge`, and return its own folder below `out`; errors as of `Rows`."""
    rows = Rows(work, out, shard, {"again": f"the same call of tuning.{work.identity()['kind']}_shard for {SHARD}"})
    rows.walk(progress)
    return Path(rows.folder or out)


def _walk_part(work: Work, part: range) -> dict[str, np.ndarray]:
    """Return the arrays of a part, or of the piece of one that a shard has."""
    begin = part.start // work.size * work.size
    own = range(part.start - begin, part.stop - begin)
    # the last part is filled up with its last row: every part has the shape that was compiled
    filled = own.stop == work.rows - begin and not own.start
    walking = range(work.size) if filled else execution.walking_with(own, work.size)
    last = min(work.size, work.rows - begin) - 1
    arrays = work.walk(begin + np.minimum(np.array(walking), last))
    return {name: values[own.start - walking.start : own.stop - walking.start] for name, values in arrays.items()}


def find(folders: Sequence[Path]) -> list[Kept]:
    """Return the shards in some folders, each a shard's own or one that holds shards, in their order.

    Raises:
        ConfigError: none there, one given twice, or shards of different things.
    """
    found: list[Kept] = []
    for folder in folders:
        own = [folder] if os.path.isfile(folder / FILE) else _folders_in(folder)
        if not own:
            raise ConfigError(folder, "", "a shard's folder, or one that holds shards", "none")
        found += map(_read, own)
    first, by_number = found[0], dict[int, Kept]()
    for each in found:
        if each.shard.count != first.shard.count:
            raise ConfigError(each.folder, "", f"a shard of {first.shard.count} as {first.folder}", each.shard)
        if differs := finished_parts.differences(first.work, each.work):
            got = f"one that differs in {', '.join(differs)}"
            raise ConfigError(each.folder, "", f"a shard of the same as {first.folder}", got)
    for each in found:
        if (twin := by_number.setdefault(each.shard.number, each)) is not each:
            raise ConfigError(each.folder, "", "each shard once", f"{each.shard} in {twin.folder} as well")
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
    first, begun = found[0], {each.shard.number: each for each in found}
    # a merge may run on another kind of machine: it walks nothing of the shards
    own = json.loads(json.dumps({**work.identity(), "platform": first.identity.get("platform")}))
    if differs := finished_parts.differences(first.work, own):
        got = f"one that differs in {', '.join(differs)}"
        raise ConfigError(first.folder, "", "a shard of what is merged here", got)
    whole: list[dict[str, np.ndarray]] = []
    lacking: dict[str, str] = {}  # by shard, in words
    for number in range(1, first.shard.count + 1):
        shard, kept = Shard(number, first.shard.count), begun.get(number)
        parts = parts_of(work, shard.rows(work.rows))
        there = Parts(None, {}) if kept is None else Parts(kept.folder, kept.identity)
        loaded = [there.load(at) for at in range(len(parts))]
        whole += [arrays for arrays in loaded if arrays is not None]
        runs: list[range] = []  # of missing rows
        for part in (part for part, arrays in zip(parts, loaded, strict=True) if arrays is None):
            begins = runs.pop().start if runs and runs[-1].stop == part.start else part.start
            runs.append(range(begins, part.stop))
        if runs:
            state = "is not there: it lacks" if kept is None else "lacks"
            count = f"{sum(map(len, runs))} of {len(shard.rows(work.rows))} walks"
            named = ", ".join(f"{work.name(run[0])} to {work.name(run[-1])}" for run in runs)
            lacking[str(shard)] = f"shard {shard} {state} {count} ({named})"
    if lacking:
        one, *more = lacking
        others = f", and likewise {', '.join(more)}" if more else ""
        remedy = f"to finish it: {str(first.about['again']).replace(SHARD, one)}{others}"
        raise ConfigError(home(found) or first.folder, reason="; ".join([*lacking.values(), remedy]))
    return _concatenated(whole)


def _folders_in(folder: Path) -> list[Path]:
    try:
        return [folder / name for name in sorted(os.listdir(folder)) if fnmatch.fnmatch(name, "shard-*-of-*")]
    except (OSError, ValueError):  # ValueError: a null byte
        return []


def _read(folder: Path) -> Kept:
    try:
        identity = finished_parts.identity_in(folder / finished_parts.FOLDER) or {}
        about = json.loads(read_found(folder / FILE))
        if not all(isinstance(about[name], str) for name in ("again", *about)):
            raise TypeError
        return Kept(folder, Shard(*identity["shard"]), identity, about)
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        raise ConfigError(folder, "", "the folder of a shard", "one that is damaged or empty") from None


def _concatenated(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([arrays[name] for arrays in parts]) for name in parts[0]}
