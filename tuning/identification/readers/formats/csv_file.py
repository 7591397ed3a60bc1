"""Tables as text: one line of names, then numbers; an empty cell where nothing was recorded."""

import csv
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from mjx_climb.files.writing import write_text_atomically
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.readers.named import Columns, by_names
from tuning.identification.readers.table import Recording, Table

SUFFIXES = (".csv", ".tsv")
_LISTED = re.compile(r"[\[({](.*)[\])}]", re.DOTALL)  # a list in a cell, as programs print it
_ENTRY = re.compile(r"""'([^']*)'|"([^"]*)"|([^\s,;\[\](){}'"]+)""")
_TYPED = re.compile(r"np\.[a-z_]+\d*\(([^()]*)\)")  # np.float64(0.1), as NumPy 2 prints the entries of a list
_DECIMAL_COMMA = re.compile(r"([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)")
_MISSING = ("", "nan", "none", "null", "[]")
_TRUTH = {"true": "1", "false": "0"}
_MOST = 10_000  # numbers in one cell
_DATE = re.compile(
    r"(\d{4})[-/](\d\d)[-/](\d\d)[T ](\d\d):(\d\d):(\d\d)(?:[.,](\d+))?\s*(?:Z|UTC|([+-]\d\d):?(\d\d))?", re.IGNORECASE
)
_SECONDS = re.compile(r"(.*?)(?:secs?|seconds|s)", re.IGNORECASE)
_PARTS = {  # of a second, in a column beside the whole ones
    1e-9: ("nanosec", "nanosecs", "nanoseconds", "nsec", "nsecs", "nanos", "ns"),
    1e-6: ("usec", "usecs", "microsec", "microseconds", "us"),
    1e-3: ("msec", "msecs", "millisec", "milliseconds", "millis", "ms"),
}


def write_csv(path: str | os.PathLike[str], columns: Mapping[str, Sequence[float] | np.ndarray]) -> Path:
    """Write columns of one length, `time` (s) and signals by their names (SI), and return the path; NaN: an empty cell.

    Raises:
        OutputError: the file cannot be written.
    """
    return write_text_atomically(path, csv_of(columns))


def csv_of(columns: Mapping[str, Sequence[float] | np.ndarray]) -> str:
    """Return the text of such a file."""
    table = np.column_stack([np.asarray(values, float) for values in columns.values()]).tolist()
    rows = [",".join("" if value != value else repr(value) for value in row) for row in table]
    return "\n".join([",".join(columns), *rows]) + "\n"


def read(path: Path) -> Recording:
    """Return the columns of a CSV file; a cell that packs a list gives columns `name.0`, `name.1` ...

    Columns that are named by others (`name0`, `position0`) are there by these names too. Dates, and seconds with
    parts of a second in a column beside them, are times. Between semicolons or tabs 0,5 is a number too.

    Raises:
        ConfigError: no table, no line of names, rows of another length than the names, or a text where the column
            holds numbers.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            file.seek(0)
            between = max(",;\t", key=first.count)
            rows = list(csv.reader(file, delimiter=between, skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or "another file"
        raise ConfigError(str(path), "", "a table of text", reason.lower()) from None
    if len(rows) < 3:
        raise ConfigError(str(path), "", "a line of names and two samples or more", f"{len(rows)} lines")
    names = [name.strip() for name in rows[0]]
    if (value := _value_in(names)) is not None:
        raise ConfigError(str(path), "line 1", "the names of the columns (time, ...)", f"the number {value}")
    repeated = [name for name, count in Counter(filter(None, names)).items() if count > 1]
    if repeated:
        raise ConfigError(str(path), min(repeated), "one column of this name", "several")
    for number, row in enumerate(rows[1:], 2):
        if row and len(row) != len(names):
            raise ConfigError(str(path), f"line {number}", f"{len(names)} cells as in line 1", str(len(row)))
    lines = [number for number, row in enumerate(rows[1:], 2) if row]
    fields: Columns = {}
    dates: Columns = {}
    words: dict[str, Sequence[str]] = {}
    uneven: dict[str, ConfigError] = {}
    for name, column in zip(names, zip(*(rows[line - 1] for line in lines), strict=True), strict=True):
        # a number of the row, or the comma at the end of each line
        if not name:
            continue
        cells = [_TRUTH.get(cell.lower(), cell) for cell in map(str.strip, column)]
        if between != ",":
            cells = [_DECIMAL_COMMA.sub(r"\1.\2", cell) if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]
        place = f"{path}: {name}"
        filled = [cell for cell in cells if cell.lower() not in _MISSING]
        if filled and all(map(_DATE.fullmatch, filled)):
            dates[name] = np.array([_seconds(cell) for cell in cells])
        elif filled and _is_list(filled[0]):
            packed, said = _unpacked(place, cells, lines)
            uneven |= {f"{name}.{number}": said for number in range(len(packed)) if said is not None}
            columns = {f"{name}.{number}": entries for number, entries in enumerate(packed)}
            if all(_is_number(cell) for column in columns.values() for cell in column if cell):
                fields |= {each: _numbers(place, column, lines) for each, column in columns.items()}
            else:
                words |= columns
        elif filled and not any(map(_is_number, filled)):
            words[name] = ["" if cell.lower() in _MISSING else cell for cell in cells]
        else:
            fields[name] = _numbers(place, cells, lines)
    named, used = by_names(fields, words)
    for name in uneven.keys() & (fields.keys() - used):
        raise uneven[name]
    unnamed = fields.keys() - {*names}
    times = dict(_pairs(fields)) | dates | fields
    said_words = frozenset(word for column in words.values() for word in column)
    table = Table("", times, fields | named, unnamed=unnamed, renamed=used, words=said_words)
    return Recording({"": table}, str(path))


def _value_in(names: Sequence[str]) -> str | None:
    """Return a value that stands in a line of names, None for none; names may be whole numbers, but not all."""
    values = [name for name in names if _is_number(name) or _DATE.fullmatch(name)]
    if values and len(values) == len([name for name in names if name]):
        return values[0]
    return next((value for value in values if not value.isdecimal() and any(map(str.isdecimal, value))), None)


def _pairs(fields: Columns) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the times of two columns, whole seconds and parts of a second, as `sec+nanosec`, s."""
    small = {name.lower(): name for name in fields}
    for name, whole in fields.items():
        if (found := _SECONDS.fullmatch(name)) is None or not np.array_equal(whole, np.floor(whole), equal_nan=True):
            continue
        for size, units in _PARTS.items():
            for other in (small[key] for unit in units if (key := found[1].lower() + unit) in small):
                part = size * fields[other]
                if other != name and ((part >= 0) & (part < 1) | np.isnan(part)).all():
                    yield f"{name}+{other}", whole + part


def _seconds(cell: str) -> float:
    """Return the time since 1970 of a date, s, in UTC where it names no zone; NaN for no date."""
    if (found := _DATE.fullmatch(cell)) is None:
        return np.nan
    *date, part, hours, minutes = found.groups()
    try:
        year, month, day, hour, minute, second = map(int, date)
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
    except ValueError:
        return np.nan
    east = 60 * (60 * int(hours) + int(hours[0] + minutes)) if hours else 0
    return whole - east + float(f"0.{part or 0}")


def _is_list(cell: str) -> bool:
    if _LISTED.search(cell):
        return True
    numbers, words = re.split(r"[\s;]+", cell), re.split(r"[\s;,]+", cell)
    return (len(numbers) > 1 and all(map(_is_number, numbers))) or (len(words) > 1 and not any(map(_is_number, words)))


def _unpacked(place: str, cells: Sequence[str], lines: Sequence[int]) -> tuple[list[list[str]], ConfigError | None]:
    """Return the columns of a list's entries, "" for none, and the fault of lists of several lengths."""
    found = [_entries(cell) if cell.lower() not in _MISSING else [] for cell in cells]
    width = max(map(len, found))
    if width > _MOST:
        raise ConfigError("", place, f"lists of {_MOST} numbers at most", width)
    said, first = None, next((len(each) for each in found if each), 0)
    for entries, line in zip(found, lines, strict=True):
        if entries and len(entries) != first:
            expected = f"a list of {first} numbers as in the first cell"
            said = ConfigError("", f"{place}, line {line}", expected, len(entries))
            break
    return [[row[n] if n < len(row) else "" for row in found] for n in range(width)], said


def _entries(cell: str) -> list[str]:
    found = _LISTED.search(cell)
    inner = _TYPED.sub(r"\1", cell if found is None else found[1])
    inner = inner[inner.find("[") + 1 :]  # array('d', [0.1, 0.2])
    return [next(filter(None, each.groups()), "").strip() for each in _ENTRY.finditer(inner)]


def _numbers(place: str, cells: Sequence[str], lines: Sequence[int]) -> np.ndarray:
    """Return the numbers of cells, NaN for an empty one."""
    try:
        return np.array([float(cell or "nan") for cell in cells])
    except ValueError:
        values = np.full(len(cells), np.nan)
    for row, (cell, line) in enumerate(zip(cells, lines, strict=True)):
        if cell.lower() not in _MISSING:
            try:
                values[row] = float(cell)
            except ValueError:
                raise ConfigError(f"{place}, line {line}", "", "a number or an empty cell", f"{cell[:40]!r}") from None
    return values


def _is_number(cell: str) -> bool:
    try:
        return float(cell) is not None
    except ValueError:
        return False
