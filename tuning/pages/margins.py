"""Margins of gains: table, plain data, picture."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_climb.viz import plots
from mjx_climb.viz.plots import key
from tuning.comparisons import margins
from tuning.comparisons.linear_margins import Stable
from tuning.numbers import to_json
from tuning.pages.contents import Picture
from tuning.pages.page import Table
from tuning.pages.pictures import COLORS, plain_numbers

_ROOM = 1.6  # of the largest force variation of pd on any hardware: above it curves leave the picture
_WIDE = 4  # range of that from which on the axis is logarithmic
_TORN, _DIVERGED = "X", "^"


def margins_table(found: margins.Found, stable: Mapping[str, Stable]) -> Table:
    """Return margins beside the scenario's hardware, by walks and of the linearised loop."""
    rows = []
    for name, margin in found.margins.items():
        loop = margin.in_words(stable[name].up_to, stable[name].tried)
        reached = map(margin.in_words, (margin.holds, margin.better))
        rows.append([margin.title, margin.with_unit(margin.own), *reached, loop])
    columns = ["", "hardware", "holds up to", f"better than {found.rival} up to", "linearised: stable up to"]
    return Table("Margins", columns, [("", rows)], 1)


def files(found: margins.Found, stable: Mapping[str, Stable], warnings: Sequence[str], given: str) -> dict[str, Any]:
    """Return the margins as JSON, all walks, and the picture; `given` is the name of the given gains."""
    text = to_json(summary(found, stable, warnings)) + "\n"
    picture = Picture("Force variation on worse hardware.", lambda: plot_margins(found, given))
    return {"margins.json": text, "margins.nc": found.walks, "margins": picture}


def summary(found: margins.Found, stable: Mapping[str, Stable], warnings: Sequence[str]) -> dict[str, Any]:
    """Return margins as plain data in SI, with the hardware that a factor of two asks for as `needed`."""
    each = {
        name: dataclasses.asdict(margin) | {"needed": margin.needed, "stable": stable[name]._asdict()}
        for name, margin in found.margins.items()
    }
    return {"own_hardware": {"holds": found.holds, "better": found.better}, "margins": each, "warnings": warnings}


@plots.style()
def plot_margins(found: margins.Found, given: str = "given gains") -> Figure:
    """Draw force variation over each quantity; a curve ends where a gripper is torn off, or the walk diverges.

    Dotted lines are the scenario's hardware, and hardware worse by a factor of 2; `given` is the name of the given
    gains.
    """
    others = iter((plots.BLUE, plots.GREEN, plots.PURPLE, plots.ORANGE))
    colors = {name: COLORS.get(name) or next(others) for name in found.walks["gains"].values.tolist()}
    dots: dict[str, Any] = {"color": "0.5", "linewidth": 0.7, "linestyle": ":"}
    columns = min(2, len(found.margins))
    rows = -(-len(found.margins) // columns)
    figure = Figure(figsize=(columns * plots.COLUMN, 0.4 + 2 * rows), layout="constrained")
    for panel, each in itertools.zip_longest(figure.subplots(rows, columns, squeeze=False).flat, found.margins.items()):
        if each is None:
            panel.set_visible(False)
            continue
        name, margin = each
        factor = 1e3 if margin.unit == "s" else 1.0
        _draw_variation(panel, found.walks.sel(quantity=name), factor, colors)
        if margin.unit == "x":
            panel.set_xscale("log")
            plain_numbers(panel.xaxis, few=True)
        unit = {"x": "", "1": "", "s": " [ms]"}.get(margin.unit, f" [{margin.unit}]")
        panel.set_xlabel(margin.title + unit)
        for value in {margin.own, margin.needed}:
            panel.axvline(value * factor, **dots, zorder=0)
    handles = [
        *(key(given if name == "given" else name, color=color) for name, color in colors.items()),
        key("gripper torn off", color=plots.RED, marker=_TORN, ms=5, linestyle="none"),
        key("diverged", color=plots.RED, marker=_DIVERGED, ms=5, linestyle="none"),
        key("hardware, and a factor of 2", **dots),
    ]
    plots.legend_below(figure, handles, len(handles))
    return figure


def _draw_variation(panel: Axes, walks: xr.Dataset, unit: float, colors: Mapping[str, str]) -> None:
    """Draw the force variation of each set of gains up to the first walk that fails."""
    values, variation = walks["value"].values * unit, walks["force_variation"]
    sound = walks["detached_at"].isnull() & ~walks["diverged"]
    reference = variation.where(sound).sel(gains="pd")
    top = _ROOM * float(reference.max()) if reference.notnull().any() else float(variation.max())
    for name, color in colors.items():
        line = variation.sel(gains=name).values
        end = int(np.argmin([*sound.sel(gains=name).values, False]))  # the first walk that fails
        panel.plot(values[: end + 1], line[: end + 1], color=color)
        if end < len(values):
            marker = _TORN if np.isfinite(walks["detached_at"].sel(gains=name).values[end]) else _DIVERGED
            place = min(np.nan_to_num(line[end], nan=top), top)
            panel.plot(values[end], place, marker, color=plots.RED, mec=color, mew=0.8, ms=6, clip_on=False, zorder=4)
    low = float(variation.where(sound).min())
    logarithmic = low > 0 and reference.max() > _WIDE * reference.min()
    if logarithmic:
        panel.set_yscale("log")
        plain_numbers(panel.yaxis, few=False)
    panel.set(ylabel="force variation [N]", ylim=(0.8 * low if logarithmic else 0, top), xlim=(values[0], values[-1]))
