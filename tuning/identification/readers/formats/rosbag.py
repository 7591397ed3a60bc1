"""Recordings of ROS 2: MCAP, sqlite, and folders with `metadata.yaml`, by `rosbags` and without ROS."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_climb.scenario.messages import ConfigError
from tuning.identification.readers.table import Recording, Table

SUFFIXES = (".mcap", ".db3", "")  # "": a folder
_LARGEST = 65_536  # bytes of a message: beyond are pictures and point clouds
_LONGEST = 256  # numbers of a list
_NAMES = ("name", "names", "joint_names", "interface_names")


def read(path: Path) -> Recording:
    """Return the numbers in the messages of a recording, by topic.

    Raises:
        ConfigError: no recording of ROS 2, or a damaged one.
    """
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.rosbag2 import ReaderError
    from rosbags.typesys import Stores, get_typestore

    expected = "a recording of ROS 2 (a folder with metadata.yaml, .mcap or .db3)"
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            return _read(reader, str(path))
    except (AnyReaderError, ReaderError, OSError) as error:
        reason = str(getattr(error, "strerror", None) or error).rstrip(".")
        raise ConfigError(str(path), "", expected, f"'{reason}'{_cure(reason, path)}") from None
    except Exception as error:  # of a damaged file rosbags raises its decoders' errors
        reason = f"{type(error).__name__}: {error}"
        raise ConfigError(str(path), "", f"{expected} that is whole", f"{reason}{_cure(reason, path)}") from None


def _cure(reason: str, path: Path) -> str:
    """Return the remedy for a recording that is not read, "" where none is known."""
    stored = [file for suffix in ("mcap", "db3") for file in sorted(path.glob(f"*.{suffix}"))] or [path]
    file = stored[-1]  # a recorder that is killed leaves the last one of several cut
    cures = {
        "File end magic is invalid": f"the recorder did not end it: mcap recover {file} -o whole.mcap",
        "database disk image is malformed": f"sqlite3 {file} .recover | sqlite3 whole.db3",
        "Storage plugin": f"name {file} itself, or write storage_identifier: mcap, or sqlite3, in metadata.yaml",
        "Expected metadata file": f"name the .mcap or .db3 in it, as {file}, or ros2 bag reindex {path}",
    }
    return next((f" ({cure})" for words, cure in cures.items() if words in reason), "")


def _read(reader: Any, source: str) -> Recording:
    known, start = reader.typestore.fielddefs, reader.start_time
    unknown = sorted({each.topic for each in reader.connections if each.msgtype not in known})
    stamps: dict[str, list[tuple[int, int]]] = {}
    rows: dict[str, list[dict[str, float]]] = {}
    unnamed: dict[str, set[str]] = {}
    frames: dict[str, str] = {}
    for connection, time, raw in reader.messages([each for each in reader.connections if each.msgtype in known]):
        if len(raw) > _LARGEST:
            continue
        message, topic = reader.deserialize(raw, connection.msgtype), connection.topic
        header = getattr(message, "header", None)
        stamp = 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
        frames[topic] = "" if header is None else header.frame_id
        stamps.setdefault(topic, []).append((time, stamp))
        numbers = [*_numbers(message, "", {})]
        rows.setdefault(topic, []).append({place: value for place, value, _ in numbers})
        unnamed.setdefault(topic, set()).update(place for place, _, named in numbers if not named)
    tables = {
        topic: Table(topic, _times(stamps[topic], start), _columns(rows[topic]), frames[topic], unnamed[topic])
        for topic in rows
    }
    said = f"{source}: {', '.join(unknown)}: not read, the recording does not say what its messages hold"
    return Recording(tables, source, (said,) if unknown else ())


def _times(stamps: Sequence[tuple[int, int]], start: int) -> dict[str, np.ndarray]:
    """Return when messages were recorded, and as their headers say where any does, s from `start`; stamps are in ns."""
    log, header = zip(*stamps, strict=True)
    found = {"header": header, "log": log} if any(header) else {"log": log}
    return {name: 1e-9 * np.array([stamp - start for stamp in each], float) for name, each in found.items()}


def _columns(rows: Sequence[Mapping[str, float]]) -> dict[str, np.ndarray]:
    columns = {name: np.full(len(rows), np.nan) for name in dict.fromkeys(name for row in rows for name in row)}
    for place, row in enumerate(rows):
        for name, value in row.items():
            columns[name][place] = value
    return columns


def _numbers(
    message: Any, path: str, names: Mapping[int, Sequence[str]], named: bool = True
) -> Iterator[tuple[str, float, bool]]:
    """Yield the numbers in a message by their paths, and whether these say by names, not numbers, which entry it is.

    `names` are those of lists, by their length.
    """
    fields = vars(message)
    own = [fields[name] for name in _NAMES if isinstance(fields.get(name), list)]
    names = {**names, **{len(value): value for value in own if len({*value}) == len(value)}} if own else names
    for name, value in fields.items():
        place = f"{path}.{name}" if path else name
        if isinstance(value, float):
            yield place, value, named
        elif name != "header":
            yield from _entries(value, place, names, named)


def _entries(
    value: Any, path: str, names: Mapping[int, Sequence[str]], named: bool
) -> Iterator[tuple[str, float, bool]]:
    if isinstance(value, bool | int | float | np.number):
        yield path, float(value), named
    elif isinstance(value, list | tuple | np.ndarray) and len(value) <= _LONGEST:
        if isinstance(value, np.ndarray):
            value = value.tolist()
        for label, entry in zip(names.get(len(value), range(len(value))), value, strict=True):
            label = getattr(entry, "child_frame_id", label)
            yield from _entries(entry, f"{path}.{label}", names, named and isinstance(label, str))
    elif hasattr(value, "__msgtype__"):
        yield from _numbers(value, path, names, named)
