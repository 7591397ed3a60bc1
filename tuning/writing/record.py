"""Whose result a folder holds: it belongs to one run's settings, and its files appear together or not at all.

`settings.json` has a command's settings, which knows its own folder again by them, and the files of the
result. Versions and machine do not count: the same command replaces its own result after an update.
"""

import contextlib
import dataclasses
import glob
import hashlib
import json
import os
import shutil
import stat
import uuid
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel

import mjx_climb as mc
from mjx_climb.execution.cache import may_be_anothers
from mjx_climb.execution.contents import Unidentifiable
from mjx_climb.files.dataset import OutputError, check_folder
from mjx_climb.files.locks import alone, is_held, refused
from mjx_climb.files.writing import write_in_place
from mjx_climb.reading import leaving, read_found
from tuning.methods import parts
from tuning.problem.evaluation import Problem
from tuning.results.result import RESULTS, SETTINGS, WITHOUT_PARTS

_OF_THE_MACHINE = ("versions", "platform", "batch_size")  # of an identity: how it is computed
_OWN_ALONE = 0o755  # mode of a folder that is being written: no other user writes there, whatever the umask

Settings = Mapping[str, Any]


class Record(NamedTuple):
    """The content of a folder's settings.json."""

    settings: Settings | None  # of the command; None where Python wrote the result
    files: tuple[str, ...] = ()  # of the result, by their paths in the folder; none before there is one
    whole: bool = False  # nothing of the result is missing


def settings_of(problem: Problem, command: str, **asked: Any) -> dict[str, Any]:
    """Return all that a command's result depends on, as plain JSON values, without versions and machine."""
    try:
        known = parts.identity_of(problem, {})
    except Unidentifiable as error:  # a law of the user's own that holds a lock, for example: known by its text alone
        bare = Problem(problem.scenario, engine=problem.engine, ensemble=problem.ensemble)
        known = {**parts.identity_of(bare, {}), "law": repr(problem.law), "unidentified": str(error)}
    text = json.dumps({"command": command, **without_machine(known), **asked}, default=_plain)
    found: dict[str, Any] = json.loads(text)
    return found


def _plain(value: Any) -> Any:
    """Return settings as a mapping, and an array, a gain of a file, as lists of numbers."""
    return value.model_dump(mode="json") if isinstance(value, BaseModel) else value.tolist()


def without_machine(identity: Settings) -> dict[str, Any]:
    """Return an identity of walks without the keys that differ between machines."""
    return {name: value for name, value in identity.items() if name not in _OF_THE_MACHINE}


def read(folder: Path) -> Record | None:
    """Return the record of a folder, None without one; one that is damaged has neither settings nor files."""
    try:
        found = json.loads(read_found(folder / SETTINGS))
        settings, files, whole = found["settings"], found["files"], found["whole"] is True
        if not isinstance(settings, dict | None) or not isinstance(files, list):
            raise TypeError
        return Record(settings, tuple(map(str, files)), whole)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return Record(None)


def check_names(folder: Path, record: Record | None) -> None:
    """Raise OutputError where a record names files that are not in a folder: they would be removed, or replaced."""
    if record is not None and (outside := leaving(folder, record.files)) is not None:
        got = f"{outside!r}, which leaves it (correct {SETTINGS} or the link, or choose another folder)"
        raise OutputError(f"{folder}: expected results with files in this folder, got {got}")


def begin(folder: Path, settings: Settings) -> frozenset[Path]:
    """Write whose folder it is where nothing says so yet; return the paths in it and above it that were there."""
    there = frozenset(each for each in (*folder.glob("*"), folder, *folder.parents) if each.exists())
    if read(folder) is None:
        _write(folder, Record(settings))
    return there


def give_up(folder: Path, there: Collection[Path]) -> None:
    """Remove the files written since `begin` if they only say whose folder it is: no work was done."""
    new = [path for path in folder.glob("[!.]*") if path not in there]
    files = {file.name for path in new for file in (path, *path.rglob("*")) if not file.is_dir()}
    if files <= {SETTINGS, parts.IDENTITY}:
        for path in new:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        with contextlib.suppress(OSError):  # another command is in it
            for each in (each for each in (folder, *folder.parents) if each not in there):
                each.rmdir()


def another(folder: Path, settings: Settings | None) -> str:
    """Return in words whose result, or unfinished work, a folder holds; nothing where it is free or these settings'."""
    record, there = read(folder), [name for name in RESULTS if (folder / name).exists()]
    if record is None:
        return f"a result without {SETTINGS} ({there[0]})" if there else ""
    if record.settings == settings:
        return ""
    kind = "the result" if record.files or there else "unfinished work"
    if record.settings is None or settings is None:
        return f"{kind} of unknown settings"
    return f"{kind} of another run, which differs in {', '.join(parts.differences(record.settings, settings))}"


def check(folder: Path, settings: Settings | None) -> None:
    """Raise OutputError where a folder holds another run's result, or its unfinished work."""
    if got := another(folder, settings):
        raise OutputError(
            f"{folder}: expected a folder of this run alone, got {got} (remove it, or choose another --out)"
        )


def check_own(folder: Path, result: str) -> None:
    """Check, before a long computation, that a folder can be written to and holds no other command's result.

    Commands write files of the same names: config.yaml would be another's than the report's beside it.

    Raises:
        OutputError: it cannot, or does.
    """
    check_folder(folder)
    recover(folder)
    check_names(folder, read(folder))
    kept = (parts.FOLDER,) if result in WITHOUT_PARTS else ()
    there = next((name for name in (*kept, *RESULTS) if (folder / name).exists()), result)
    if there != result:
        raise OutputError(
            f"{folder}: expected a folder without another command's result, got {there} in it (choose another folder)"
        )


def own_folder(base: Path, settings: Settings, *, varied: bool = False) -> Path:
    """Return a folder that belongs to some settings: `base`, or where that is another run's, one with their digest.

    `varied`: the name does not tell all settings, so that it takes the digest at once.
    """
    by_digest = base.with_name(f"{base.name}-{_digest(settings)}")
    taken = varied or by_digest.exists() or another(base, settings)
    return by_digest if taken else base


def _digest(settings: Settings | None) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:6]


class InUse(OutputError):
    """A folder that another command uses."""


@contextlib.contextmanager
def held(folder: Path, settings: Settings | None, *, shard: bool = False) -> Iterator[None]:
    """Hold a folder for a command until the block ends, or the process does: no other command uses it.

    A folder beside it says so, which `recover` removes where its process was killed. Shards of the same settings hold
    it together.

    Raises:
        InUse: another command has it.
        OutputError: the folder cannot be written.
    """
    target = Path(os.path.realpath(folder))
    there, name = _nearest(target), f"{glob.escape(_prefix(target))}.*.*.part"
    kind = f"{_prefix(target)}.shard_{_digest(settings)}." if shard else f"{_prefix(target)}.alone."
    place = there / f"{kind}{_unique()}.part"
    with contextlib.ExitStack() as until:
        with refused(folder), alone(there):
            place.mkdir(_OWN_ALONE)
            until.enter_context(alone(place))
            until.callback(shutil.rmtree, place, ignore_errors=True)
            for other in (other for above in (target, *target.parents) for other in above.glob(name)):
                beside = other == place or (shard and other.name.startswith(kind))
                if not beside and is_held(other):
                    got = "one that uses it now (wait until it ends, or choose another --out)"
                    raise InUse(f"{folder}: expected a folder that no other command uses, got {got}")
        yield


@contextlib.contextmanager
def whole(folder: Path, settings: Settings | None = None, *, finished: bool = True) -> Iterator[Path]:
    """Give an empty folder, whose files become those of `folder` once the block ends well.

    They take the place of an earlier result's files there; none of these is left where it was another run's. Files that
    are no result's stay. Kept parts are removed where the result is `finished`. Of a process that is killed the folder
    keeps the old result; if it dies while the files move, the next that writes there, or is about to, ends the move.

    Raises:
        OutputError: the folder cannot be written.
    """
    target = Path(os.path.realpath(folder))
    there = _nearest(target)
    place = there / f"{_prefix(target)}.{_unique()}.part"
    recover(folder)
    try:
        with contextlib.ExitStack() as until:
            with refused(folder), alone(there):
                place.mkdir(_OWN_ALONE)
                until.enter_context(alone(place))  # tells `recover` that somebody writes it
            yield place
            files = tuple(sorted(f.relative_to(place).as_posix() for f in place.rglob("*") if not f.is_dir()))
            with refused(folder):
                _write(place, Record(settings, files, finished))
                _move(place, target)
    finally:
        shutil.rmtree(place, ignore_errors=True)


def recover(folder: Path) -> None:
    """End the work of a killed process of this user's: move a result that was all written, remove one that was not.

    Raises:
        OutputError: the folder cannot be written.
    """
    target = Path(os.path.realpath(folder))
    name = f"{glob.escape(_prefix(target))}.*.part"
    with contextlib.ExitStack() as until, refused(folder):
        left: list[Path] = []
        for each in (each for each in (target, *target.parents[:3]) if any(map(_own, each.glob(name)))):
            with alone(each):  # a folder that is made there is held before this can see it
                for place in filter(_own, each.glob(name)):
                    with contextlib.suppress(BlockingIOError, FileNotFoundError):  # written, or moved, just now
                        until.enter_context(alone(place, wait=False))
                        left.append(place)
        for place in left:
            if (record := read(place)) is not None and record.files:
                _move(place, target)
            shutil.rmtree(place, ignore_errors=True)


def _own(place: Path) -> bool:
    """Return whether a folder is this user's, and no other user may write to it."""
    try:
        about = place.lstat()
    except FileNotFoundError:
        return False
    return stat.S_ISDIR(about.st_mode) and not may_be_anothers(about)


def _nearest(target: Path) -> Path:
    """Return the folder itself, or the first above it that is there."""
    return next(each for each in (target, *target.parents) if each.is_dir())


def _unique() -> str:
    return uuid.uuid4().hex[:12]


def _prefix(target: Path) -> str:
    """Return the first part of the names of folders whose files are on their way to a folder."""
    return f".{target.name}.{hashlib.sha256(os.fsencode(target)).hexdigest()[:8]}"


def _move(place: Path, target: Path) -> None:
    """Move a result that is all there to its folder, in place of an earlier one."""
    record = read(place)
    assert record is not None
    target.parent.mkdir(parents=True, exist_ok=True)
    with alone(target.parent):
        if fresh := not target.is_dir():
            os.rename(place, target)
            target.chmod(target.stat().st_mode | (target / SETTINGS).stat().st_mode & 0o022)  # as the umask has it
    if not fresh:
        with alone(target):
            _replace(place, target, record)
    if record.whole:
        parts.clear(target)


def at_home(scenario: mc.Scenario, place: Path, home: Path) -> mc.Scenario:
    """Return a scenario whose files were moved from one folder to another."""
    return scenario.relative_to(place).beside(home)


def walks_at_home(walks: Mapping[str, mc.Trajectory], place: Path, home: Path) -> dict[str, mc.Trajectory]:
    """Return walks of scenarios whose files were moved from one folder to another."""
    return {
        name: dataclasses.replace(walk, scenario=at_home(walk.scenario, place, home)) for name, walk in walks.items()
    }


def _replace(place: Path, target: Path, record: Record) -> None:
    """Move the files of a result to their folder; until all are there its record says that it is not whole.

    Repeated after it was cut short, it does the rest.
    """
    before = read(target) or Record(None)
    for each in (record, before):
        check_names(target, each)
    own = record.settings is not None and before.settings == record.settings
    if not own:
        _write(target, before._replace(whole=False))
        for name in {*before.files} - {*record.files}:
            (target / name).unlink(missing_ok=True)
    every = record._replace(files=tuple(sorted({*before.files, *record.files}))) if own else record
    _write(target, every._replace(whole=False))
    for name in filter(lambda name: (place / name).exists(), record.files):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(place / name, target / name)
    _write(target, every)


def _write(folder: Path, record: Record) -> None:
    write_in_place(folder / SETTINGS, (json.dumps(record._asdict(), indent=1) + "\n").encode())
