"""Tables of points: a header with x, y, z and, where known, nx, ny, nz and limit, then a line for each point."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjx_climb.ground.table import Table
from mjx_climb.scenario.messages import ConfigError

SUFFIXES = (".csv",)


def read(path: Path, topic: str | None) -> Table:
    """The columns of the table by the names in its header."""
    header, *rows = cells(path) or [(1, [])]
    names = [name.strip() for name in header[1]]
    if rows and len(names) == 1:
        raise ConfigError(str(path), "", "names with commas between them in the first line", names[0])
    return Table(str(path), list(zip(names, numbers(rows, len(names)).T, strict=True)))


def cells(path: Path) -> list[tuple[int, list[str]]]:
    """The rows that are not empty, each with its line in the file."""
    with path.open(encoding="utf-8-sig", newline="") as lines:
        rows = csv.reader(lines)
        return [(rows.line_num, row) for row in rows if row]


def numbers(rows: Sequence[tuple[int, list[str]]], width: int) -> np.ndarray:
    """The numbers of rows, (rows, width).

    Raises:
        ValueError: naming the row, one of another width, or with words.
    """
    values = []
    for line, row in rows:
        if len(row) != width:
            raise ValueError(f"row {line}: expected {width} numbers, got {len(row)}")
        try:
            values.append([float(cell) for cell in row])
        except ValueError as error:
            raise ValueError(f"row {line}: expected numbers, got {str(error).rpartition(': ')[2]}") from None
    return np.array(values, float).reshape(len(values), width)
