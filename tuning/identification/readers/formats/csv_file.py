"""Tables as text: one line of names, then numbers; an empty cell where nothing was recorded."""

import csv
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mjx_climb.files.writing import write_text_atomically
from mjx_climb.scenario.messages import ConfigError, config_error
from tuning.identification.readers.table import Recording, Table

SUFFIXES = (".csv", ".tsv")
_LISTED = re.compile(r"[\[({]\s*(.*?)\s*[\])}]", re.DOTALL)  # a list in a cell, as programs print it
_MISSING = ("", "nan", "none", "null")
_MOST = 10_000  # numbers in one cell


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

    Raises:
        ConfigError: no table, rows of another length than the names, or a text where the column holds numbers.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            file.seek(0)
            rows = list(csv.reader(file, delimiter=max(",;\t", key=first.count)))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or "another file"
        raise config_error(str(path), "", "a table of text", reason.lower()) from None
    if len(rows) < 3:
        raise config_error(str(path), "", "a line of names and two samples or more", f"{len(rows)} lines")
    names = [name.strip() for name in rows[0]]
    if repeated := {name for name in names if names.count(name) > 1}:
        raise config_error(str(path), min(repeated), "one column of this name", "several")
    for number, row in enumerate(rows[1:], 2):
        if row and len(row) != len(names):
            raise config_error(str(path), f"line {number}", f"{len(names)} cells as in line 1", str(len(row)))
    lines = [number for number, row in enumerate(rows[1:], 2) if row]
    fields: dict[str, np.ndarray] = {}
    for name, cells in zip(names, zip(*(rows[line - 1] for line in lines), strict=True), strict=True):
        fields |= _column(f"{path}: {name}", name, cells, lines)
    return Recording({"": Table("", fields, fields, unnamed=fields.keys() - {*names})}, str(path))


def _column(place: str, name: str, cells: Sequence[str], lines: Sequence[int]) -> dict[str, np.ndarray]:
    """Return the numbers of a column, or of each place in the lists of its cells; {} for a column of words."""
    cells = [cell.strip() for cell in cells]
    filled = [cell for cell in cells if cell.lower() not in _MISSING]
    if filled and (found := _LISTED.search(filled[0])):
        width = len(re.split(r"[\s,;]+", found[1]))
        packed = np.full((len(cells), min(width, _MOST)), np.nan)
        for row, (cell, line) in enumerate(zip(cells, lines, strict=True)):
            if cell.lower() not in _MISSING:
                packed[row] = _list(f"{place}, line {line}", cell, width)
        return {f"{name}.{place}": values for place, values in enumerate(packed.T)}
    if filled and not _is_number(filled[0]):
        return {}
    values = np.full(len(cells), np.nan)
    for row, (cell, line) in enumerate(zip(cells, lines, strict=True)):
        if cell.lower() not in _MISSING:
            values[row] = _number(f"{place}, line {line}", cell)
    return {name: values}


def _is_number(cell: str) -> bool:
    try:
        return float(cell) is not None
    except ValueError:
        return False


def _number(place: str, cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        raise ConfigError(f"{place}: expected a number or an empty cell, got {cell[:40]!r}") from None


def _list(place: str, cell: str, width: int) -> list[float]:
    found = _LISTED.search(cell)
    values = [] if found is None else [_number(place, part) for part in re.split(r"[\s,;]+", found[1]) if part]
    if len(values) != width:
        raise ConfigError(f"{place}: expected a list of {width} numbers as in the first cell, got {len(values)}")
    return values
