"""Tables of points: a header with x, y, z and, where known, nx, ny, nz and limit, then a line for each point."""

import csv
from pathlib import Path

import numpy as np

from mjx_climb.scenario.messages import config_error

SUFFIXES = (".csv",)


def read(path: Path, topic: str | None) -> dict[str, np.ndarray]:
    """The columns of the table by the names in its header."""
    with path.open(encoding="utf-8-sig", newline="") as lines:
        header, *rows = [row for row in csv.reader(lines) if row] or [[]]
    names, values = [name.strip() for name in header], []
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise config_error(str(path), f"row {number}", f"{len(names)} numbers", str(len(row)))
        try:
            values.append([float(cell) for cell in row])
        except ValueError as error:
            raise config_error(str(path), f"row {number}", "numbers", str(error).rpartition(": ")[2]) from None
    table = np.array(values, float).reshape(-1, len(names))
    return dict(zip(names, table.T, strict=True))
