"""A picture of margins: force variation over what makes hardware worse, a curve for each set of gains."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from mjx_climb import plots
from tuning.judged.margins import QUANTITIES, Found, needed

_ROOM = 1.6  # of the largest force variation of pd: above it curves leave the picture
_WIDE = 4  # range of that from which on the axis is logarithmic
_COLORS = {"pd": "0.6", "retuned pd": plots.BLACK, "config": plots.VERMILLION}
_OTHERS = (plots.BLUE, plots.GREEN, plots.PURPLE, plots.ORANGE)
_TORN, _DIVERGED = "X", "^"


def plot_margins(found: Found, given: str = "given gains") -> Figure:
    """Draw force variation over each quantity; a curve ends where a gripper is torn off, or the walk diverges.

    Dotted lines are the scenario's hardware, and twice as much of it (half of the joint gains).

    Arguments:
        found: as `tuning.judged.margins.find` gives it.
        given: what the given gains are called.
    """
    walks = found.walks
    names = [str(name) for name in walks["gains"].values]
    others = iter(_OTHERS)
    colors = {name: _COLORS.get(name) or next(others) for name in names}
    with plots.style():
        figure = Figure(figsize=(2 * plots.COLUMN, 4.4), layout="constrained")
        for panel, (name, margin) in zip(figure.subplots(2, 2).flat, found.margins.items(), strict=True):
            _draw(panel, walks.sel(quantity=name), name, colors)
            for value in {margin.own, needed(name, margin.own)}:
                panel.axvline(value * _scale(name), color="0.5", linewidth=0.7, linestyle=":", zorder=0)
        handles = [Line2D([], [], color=colors[n], label=given if n == "given" else n) for n in names]
        for marker, label in ((_TORN, "gripper torn off"), (_DIVERGED, "diverged")):
            handles.append(Line2D([], [], color=plots.RED, marker=marker, ms=5, linestyle="none", label=label))
        handles.append(Line2D([], [], color="0.5", linewidth=0.7, linestyle=":", label="hardware, and a factor of 2"))
        plots.legend_below(figure, handles, len(handles))
    return figure


def _scale(quantity: str) -> float:
    return 1.0 if QUANTITIES[quantity].scales else 1e3


def _draw(panel: Axes, walks: xr.Dataset, quantity: str, colors: dict[str, str]) -> None:
    values = walks["value"].values * _scale(quantity)
    sound = walks["detached_at"].isnull() & ~walks["diverged"]
    reference = walks["force_variation"].where(sound).sel(gains="pd")
    top = _ROOM * float(reference.max()) if reference.notnull().any() else float(walks["force_variation"].max())
    for name, color in colors.items():
        some, held = walks.sel(gains=name), sound.sel(gains=name).values
        end = int(np.argmin([*held, False]))
        variation = some["force_variation"].values
        panel.plot(values[: end + 1], variation[: end + 1], color=color)
        if end < len(values):
            torn = np.isfinite(some["detached_at"].values[end])
            panel.plot(values[end], min(np.nan_to_num(variation[end], nan=top), top), _TORN if torn else _DIVERGED,
                       color=plots.RED, mec=color, mew=0.8, ms=6, clip_on=False, zorder=4)  # fmt: skip
    low = float(walks["force_variation"].where(sound).min())
    if low > 0 and reference.max() > _WIDE * reference.min():
        panel.set_yscale("log")
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panel.yaxis.set_minor_formatter(NullFormatter())
        panel.set_ylim(0.8 * low, top)
    else:
        panel.set_ylim(0, top)
    if QUANTITIES[quantity].scales:
        panel.set_xscale("log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
    panel.set_xlim(values[0], values[-1])
    unit = "" if QUANTITIES[quantity].scales else " [ms]"
    panel.set_xlabel(QUANTITIES[quantity].title + unit)
    panel.set_ylabel("force variation [N]")
