"""Many walks of one program, cut into parts that are kept on disk, and into shards that other processes walk.

A shard walks a run of the rows and leaves it as parts in a folder of its own; `joined` puts the rows of all shards
together. On a CPU each row has the bits that it has in one process. `tuning.merge` makes of them what was cut.
"""

import dataclasses
import fnmatch
import importlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.files.dataset import OutputError, write_text_atomically
from mjx_climb.scenario.messages import ConfigError
from tuning.gains.own_section import taken
from tuning.searches import parts as finished_parts
from tuning.searches.parts import Parts

if TYPE_CHECKING:
    from tuning.searches.judge import Judged
    from tuning.searches.sweep import Swept

FILE = "shard.json"
SHARD = "{shard}"  # in the command that walks a shard
Counted = Callable[[int, int], None]  # rows done, rows in all


@dataclasses.dataclass(frozen=True)
class Shard:
    """One of several equal runs of rows."""

    number: int  # from 1
    count: int

    def __post_init__(self) -> None:
        """Refuse a number that is none from 1 to the count.

        Raises:
            ConfigError: it is none.
        """
        if not 1 <= self.number <= self.count:
            raise ConfigError(f"shard: expected a number from 1 to how many there are, got {self}")

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
        """Return what a row is, in words."""

    def write_asked(self, folder: Path) -> None:
        """Write what a merge needs beside the identity to make the same work again."""


class Kept(NamedTuple):
    """A shard in its folder."""

    folder: Path
    shard: Shard
    identity: Mapping[str, Any]
    about: Mapping[str, Any]  # what else is said of it


def parts_of(work: Work, rows: range) -> list[range]:
    """Return the parts in which some of the rows walk: those of all rows, as far as they are among them."""
    parts = [range(begin, begin + work.size) for begin in range(0, work.rows, work.size)]
    cut = [range(max(part.start, rows.start), min(part.stop, rows.stop)) for part in parts]
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
            work: what walks.
            out: the folder, or that below which a shard has one of its own; nothing is kept where None.
            shard: which one, from 1, and how many there are.
            about: for those who merge shards: `again`, the command or call that walks one, with `SHARD` where it names
                which, and what else the report is to say.

        Raises:
            ConfigError: no such shard, or more shards than rows.
            OutputError: the folder cannot be written, or `out` holds parts, or shards, of something else.
        """
        self._work, self.shard = work, None if shard is None else Shard(*shard)
        self.rows = range(work.rows) if self.shard is None else self.shard.rows(work.rows)
        self._cut = parts_of(work, self.rows)
        if self.shard is None or out is None:
            self.folder = None if out is None else Path(out)
            self._parts = Parts(self.folder, work.identity)
        else:
            self.folder = self.shard.folder(Path(out))
            self._parts = self._claim(self.shard, Path(out), self.folder, about)

    def _claim(self, shard: Shard, out: Path, folder: Path, about: Mapping[str, str]) -> Parts:
        if shard.count > self._work.rows:
            limit = f"expected at most {self._work.rows} shards, one walk each"
            raise ConfigError(f"shard {shard}: {limit}, got {shard.count}")
        for other in _folders_in(out):
            if not other.name.endswith(f"-of-{shard.count}"):
                raise OutputError(
                    f"{out}: expected shards of {shard.count}, got {other.name} (remove it, or choose another --out)"
                )
        parts = Parts(folder, lambda: {**self._work.identity(), "shard": [shard.number, shard.count]})
        self._work.write_asked(folder)
        write_text_atomically(folder / FILE, json.dumps({**about}, indent=1) + "\n")
        return parts

    @property
    def there(self) -> int:
        """How many of the rows are kept already."""
        return sum(len(part) for number, part in enumerate(self._cut) if self._parts.load(number) is not None)

    def walk(self, progress: Counted | None = None) -> dict[str, np.ndarray]:
        """Return the arrays of the rows; parts that are there are not walked again.

        `progress` is called with the rows that are there already first, then after each part.
        """
        found = [self._parts.load(number) for number in range(len(self._cut))]
        done = sum(len(part) for part, arrays in zip(self._cut, found, strict=True) if arrays is not None)
        if progress is not None:
            progress(done, len(self.rows))
        for number, part in enumerate(self._cut):
            if found[number] is not None:
                continue
            arrays = found[number] = _walk_part(self._work, part)
            self._parts.save(number, arrays)  # before it is counted as done
            done += len(part)
            if progress is not None:
                progress(done, len(self.rows))
        return _concatenated([arrays for arrays in found if arrays is not None])


def walk_shard(work: Work, shard: tuple[int, int], out: str | os.PathLike[str], progress: Counted | None) -> Path:
    """Simulate a shard of some work for `merge`, and return its own folder below `out`.

    Raises:
        ConfigError, OutputError: as of `Rows`.
    """
    again = f"the same call of tuning.{work.identity()['kind']}_shard for {SHARD}"
    rows = Rows(work, out, shard, {"again": again})
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


def merge(
    folders: Sequence[str | os.PathLike[str]],
    *,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
) -> "Swept | Judged":
    """Return what shards in some folders were part of, as `sweep` or `judge` return it: on CPUs bit by bit.

    `merge([folder]).write(folder)` is `mjx-climb merge`.

    Arguments:
        folders: those of the shards, or one that holds them all; nothing in them is changed.
        law: the user's own, where the shards had one whose file they do not name.
        metrics: those of the shards, likewise.

    Raises:
        ConfigError: no shards there, shards of different things, of another law, other metrics or versions, or not all
            of them: in one line which are missing and what would finish them.
    """
    return merged(find([Path(folder) for folder in folders]), law, mc.MetricTable(metrics))


def merged(found: Sequence["Kept"], law: mc.Law | None, metrics: mc.MetricTable) -> "Swept | Judged":
    """Return what shards that `find` found were part of; `merge` with its errors."""
    config = found[0].folder / "config.yaml"
    own = taken(mc.load_scenario(config), law, metrics, str(config))
    kind = importlib.import_module(f"tuning.searches.{found[0].identity['kind']}")
    work = kind.read_asked(found[0], *own)
    result: Swept | Judged = work.result(joined(work, found))
    return result


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
        kept = Parts(
            begun[number].folder if number in begun else None, begun[number].identity if number in begun else {}
        )
        loaded = [kept.load(at) for at in range(len(parts))]
        missing = [part for part, arrays in zip(parts, loaded, strict=True) if arrays is None]
        if missing:
            lacking.append(_lack(work, shard, missing, number in begun))
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
