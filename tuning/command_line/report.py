"""Metrics in words, tables and JSON."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from tuning.report.numbers import axis_values, change, gain, number, to_json, unit, words

if TYPE_CHECKING:
    import mjx_climb as mc
    from tuning.report import page
    from tuning.report.comparison import Compared

__all__ = ["change", "gain", "number", "to_json", "unit", "words"]

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
    from tuning.report.comparison import gain_units

    gains = {name: held for name, (held, _) in walks.items()}
    metrics = {name: values for name, (_, values) in walks.items()}
    compared = [name for name in walks if name != baseline and width >= 38 + 19 * (len(walks) - 1)]
    table = plain_table(
        "metric", "unit", *(t for name in walks for t in [name, f"vs {baseline} %"][: 1 + (name in compared)])
    )

    def add(key: str, text: str, values: dict[str, str], changes: dict[str, str], *, last: bool = False) -> None:
        cells = [t for name in walks for t in [values[name], changes.get(name, "")][: 1 + (name in compared)]]
        table.add_row(key, text, *cells, end_section=last)

    units = gain_units(walks, law)
    for key, (text, _) in units.items():
        add(key, text, {name: gain(gains[name], key) for name in walks}, {}, last=key == list(units)[-1])
    for key, base in metrics[baseline].items():
        changes = {name: change(metrics[name][key], base) for name in compared}
        add(words(key, about), unit(key, about), {name: number(metrics[name][key]) for name in walks}, changes)
    return table


def gains_table(walks: "Compared", law: "mc.Law | None" = None) -> Table:
    """Return the gains of walks, axis by axis where the axes differ; `law` is the user's own, if any."""
    from tuning.report.comparison import gain_units

    table = plain_table("metric", *(name for name in walks if walks[name][0] is not None))
    table.columns[0].header = "gain"
    held = {name: gains for name, (gains, _) in walks.items() if gains is not None}
    for key in gain_units(walks, law):
        six = {name: axis_values(gains.get(key)) for name, gains in held.items()}
        if all(len(np.unique(values)) == 1 for values in six.values()):
            table.add_row(key, *(_number(values[0]) for values in six.values()))
            continue
        for axis, label in enumerate(("x", "y", "z", "rx", "ry", "rz")):
            table.add_row(f"{key} {label}", *(_number(values[axis]) for values in six.values()), end_section=axis == 5)
    for key in ("kp", "kd"):
        if any(key not in gains for gains in held.values()):
            continue
        table.add_row(key, *(_number(gains[key]) for gains in held.values()))
    return table


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.4g}"
