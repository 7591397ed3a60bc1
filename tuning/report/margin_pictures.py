"""A picture of margins: force variation over what makes hardware worse, a curve for each set of gains."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from mjx_climb import plots
from tuning.evaluation.margins import QUANTITIES, Found, needed

_ROOM = 1.6  # of the largest force variation of pd: above it curves leave the picture
_WIDE = 4  # range of that from which on the axis is logarithmic
_COLORS = {"pd": "0.6", "retuned pd": plots.BLACK, "config": plots.VERMILLION}
_OTHERS = (plots.BLUE, plots.GREEN, plots.PURPLE, plots.ORANGE)
_TORN, _DIVERGED = "X", "^"


@plots.style()
def plot_margins(found: Found, given: str = "given gains") -> Figure:
    """Draw force variation over each quantity; a curve ends where a gripper is torn off, or the walk diverges.

    Dotted lines are the scenario's hardware, and twice as much of it (half of the joint gains).

    Arguments:
        found: as `tuning.evaluation.margins.find` gives it.
        given: what the given gains are called.
    """
    others = iter(_OTHERS)
    colors = {name: _COLORS.get(name) or next(others) for name in found.walks["gains"].values.tolist()}
    figure = Figure(figsize=(2 * plots.COLUMN, 4.4), layout="constrained")
    for panel, (name, margin) in zip(figure.subplots(2, 2).flat, found.margins.items(), strict=True):
        _draw(panel, found.walks.sel(quantity=name), name, colors)
        for value in {margin.own, needed(name, margin.own)}:
            panel.axvline(value * _scale(name), color="0.5", linewidth=0.7, linestyle=":", zorder=0)
    handles = [
        *(Line2D([], [], color=color, label=given if n == "given" else n) for n, color in colors.items()),
        Line2D([], [], color=plots.RED, marker=_TORN, ms=5, linestyle="none", label="gripper torn off"),
        Line2D([], [], color=plots.RED, marker=_DIVERGED, ms=5, linestyle="none", label="diverged"),
        Line2D([], [], color="0.5", linewidth=0.7, linestyle=":", label="hardware, and a factor of 2"),
    ]
    plots.legend_below(figure, handles, len(handles))
    return figure


def _scale(quantity: str) -> float:
    return 1.0 if QUANTITIES[quantity].scales else 1e3


def _draw(panel: Axes, walks: xr.Dataset, quantity: str, colors: dict[str, str]) -> None:
    values = walks["value"].values * _scale(quantity)
    sound = walks["detached_at"].isnull() & ~walks["diverged"]
    variation = walks["force_variation"]
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
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter("")
    panel.set_ylim(0.8 * low if logarithmic else 0, top)
    if QUANTITIES[quantity].scales:
        panel.set_xscale("log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter("")
    panel.set_xlim(values[0], values[-1])
    panel.set_xlabel(QUANTITIES[quantity].title + ("" if QUANTITIES[quantity].scales else " [ms]"))
    panel.set_ylabel("force variation [N]")
