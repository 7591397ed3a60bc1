"""Metrics in words, tables and JSON."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from tuning.report.numbers import number, to_json, unit, words

if TYPE_CHECKING:
    import mjx_climb as mc
    from tuning.problem.evaluation import Problem
    from tuning.report import page
    from tuning.report.comparison import Compared
    from tuning.searches.result import Written

__all__ = ["number", "to_json", "unit", "words"]

WIDTH = 100  # of tables in a file


def console(file: TextIO | None = None, *, stderr: bool = False) -> Console:
    """Return where people read: plain text of a fixed width unless it is a terminal."""
    made = Console(file=file, stderr=stderr, highlight=False, markup=False, emoji=False)
    if not made.is_terminal:
        made.width = WIDTH
    return made


def verdict(trajectory: "mc.Trajectory", metrics: Mapping[str, Any]) -> str:
    """Return in one line how the walk went."""
    failures = []
    if metrics["detached_limb"] is not None:
        failures.append(f"limb {metrics['detached_limb']} let go at {metrics['detached_at']:.3f} s")
    if metrics["diverged"]:
        rows = [trajectory.base_position, trajectory.joint_rates, trajectory.foot_force, trajectory.joint_torque]
        finite = np.all([np.isfinite(values).reshape(len(values), -1).all(1) for values in rows], axis=0)
        at = trajectory.time[np.argmin(finite)] if not finite.all() else trajectory.time[-1]
        failures.append(f"diverged at {at:.3f} s")
    if failures:
        return ", ".join(failures)
    if missed := metrics.get("missed_grips"):
        return f"every grip held, but {missed} missed the ground"
    return "held all the way"


def plain_table(*columns: str) -> Table:
    """Return an empty table: words to the left, numbers to the right."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True, padding=(0, 1))
    for name in columns:
        left = name in ("", "metric", "unit")
        table.add_column(name, justify="left" if left else "right", no_wrap=True)
    return table


def from_page(made: "page.Table") -> Table:
    """Return a table of a report for the terminal."""
    table = plain_table(*made.columns)
    for place, column in enumerate(table.columns):
        column.justify = "left" if place < made.words else "right"
    for _, rows in made.sections:
        for row in rows:
            table.add_row(*row, end_section=row is rows[-1])
    return table


def walk_table(metrics: Mapping[str, Any], about: "mc.MetricTable | None" = None) -> Table:
    """Return the table of one walk."""
    table = plain_table("metric", "value", "unit")
    for name, value in metrics.items():
        table.add_row(words(name, about), number(value), unit(name, about))
    return table


def comparison_table(
    walks: "Compared", baseline: str, width: int, about: "mc.MetricTable | None" = None, law: "mc.Law | None" = None
) -> Table:
    """Return walks side by side, each with its change against the baseline where `width` characters have room.

    Arguments:
        walks: by name, gains (None for a controller without) and metrics; the baseline is one of them.
        width: of the terminal.
        about: the metrics themselves; the shipped ones where None.
        law: the user's own, for the units of its gains.
    """
    from mjx_climb import METRICS
    from tuning.report import comparison

    columns: list[tuple[str, str | None]] = []
    for name in walks:
        columns.append((name, None))
        if name != baseline and width >= 38 + 19 * (len(walks) - 1):
            columns.append((name, baseline))
    return from_page(comparison.table(walks, "", about or METRICS, law, columns))


def tables_of(written: "Written", problem: "Problem", width: int, *, gains: bool = False) -> "list[str | Table]":
    """Return what is printed of a result: walks side by side or what a fresh draw says, and the outcome in lines.

    Arguments:
        written: what was compared, and said.
        problem: law and metrics.
        width: of the terminal.
        gains: with a table of the gains, axis by axis.
    """
    from tuning.report import comparison
    from tuning.report.pages import judged_table

    metrics, law = problem.metrics, problem.law
    if written.summed is not None:
        return [from_page(judged_table(written.summed, metrics)), *written.outcome]
    tables = [comparison_table(written.compared, "pd", width, metrics, law)]
    if gains:
        tables.append(from_page(comparison.gains_table(written.compared, law)))
    return [*tables, *written.outcome]
