"""A study's table by several processes: a job's rows are written as it ends, so that a cut run leaves a table."""

import csv
import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, TypeVar

Job = TypeVar("Job")
Row = tuple[Any, ...]


def table(
    out: str, columns: Sequence[str], rows_of: Callable[[Job], list[Row]], jobs: Iterable[Job], workers: int
) -> list[Row]:
    """Write the CSV file `out`, rows in the order in which jobs end; the rows."""
    rows: list[Row] = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context) as pool, Path(out).open("w", newline="", encoding="utf-8") as file:
        write = csv.writer(file, lineterminator="\n")
        write.writerow(columns)
        for each in as_completed([pool.submit(rows_of, job) for job in jobs]):
            rows += each.result()
            write.writerows([f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in each.result())
            file.flush()
    return rows
