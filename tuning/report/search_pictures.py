"""Pictures of a search: how it converged, and its way over the map of stiffness and damping."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from mjx_climb import plots
from tuning.gains.gains_file import by_name
from tuning.report.numbers import axis_values
from tuning.searches.result import Result


def plot_convergence(found: Result) -> Figure:
    """Draw the objective over the env-steps spent: every feasible point, the best so far, and gradient norms."""
    history = found.history
    spent = history["env_steps"].values / 1e6
    value = np.where(history["feasible"], history["value"], np.nan)
    norm = history["gradient_norm"].values
    with plots.style():
        sloped = np.isfinite(norm).any()
        figure = Figure(figsize=(plots.COLUMN, 3.2 if sloped else 2.2), layout="constrained")
        axes = figure.subplots(1 + sloped, 1, sharex=True, squeeze=False)[:, 0]
        axes[0].plot(spent, value, ".", color="0.65", markersize=2.5, label="judged, keeps every limit")
        if np.isfinite(value).any():
            best = np.fmin.accumulate(value)
            axes[0].plot(spent, best, color=plots.BLUE, label="best so far")
            low = np.nanmin(value)
            axes[0].set_ylim(low - 0.03, min(np.nanmax(value), max(1.1, low + 0.5)) + 0.03)
        axes[0].axhline(1.0, color=plots.RED, linewidth=0.8, label="pd")
        axes[0].set_ylabel("objective")
        plots.legend(figure, axes[0].get_legend_handles_labels()[0])
        if sloped:
            axes[1].semilogy(spent, norm, ".", color=plots.BLUE, markersize=2.5)
            axes[1].set_ylabel("norm of\nthe gradient")
        axes[-1].set_xlabel("env-steps spent [million]")
    return figure


def plot_path(found: Result, walks: xr.Dataset) -> Figure:
    """Draw the way of every start over a map with an `objective`, see `tuning.judged.maps`, and the limit of stability.

    The map and its limit are of gains that are the same on all axes. Where a search told axes apart, translations and
    rotations go their own ways, the geometric means of theirs, and the result has a mark for each axis.
    """
    x, y = (str(name) for name in walks["diverged"].dims)
    tuned, control = by_name(found.gains), found.scenario.control
    apart = any("." in str(name) for name in found.history["coordinate"].values)
    config = None if found.law else [np.array([_mean(getattr(control, name))]) for name in (x, y)]
    marks = {} if apart else {"tuned": (_mean(tuned[x]), _mean(tuned[y]))}
    if config and not apart:
        marks["config"] = config[0].item(), config[1].item()
    title = "map and limit: the same gains on all axes" if apart else None
    with plots.style():
        figure = plots.plot_map(walks, "objective", marks, baseline=1.0, x=x, y=y, title=title)
        handles: list[Artist] = []
        for legend in figure.legends:
            handles += [handle for handle in legend.legend_handles if handle is not None]
            legend.remove()
        for axes, look in _AXES.items() if apart else {"": _AXES["translations"]}.items():
            handles += _draw_ways(figure.axes[0], found, (x, y), axes, look)
        if config and apart:
            handles.append(_mark(figure.axes[0], config, "o", "0.1", "config"))
        plots.legend_below(figure, handles, 3)
    return figure


_CROWD = 100  # points of a round


class _Look(NamedTuple):
    """How the ways of some axes are drawn."""

    color: str
    marker: str  # of the result
    axes: slice  # of six
    coordinates: tuple[str, ...]  # what follows the gain in the names of a space


_AXES = {
    "translations": _Look("0.1", "*", slice(0, 3), ("translation", "x", "y", "z")),
    "rotations": _Look(plots.PURPLE, "P", slice(3, 6), ("rotation", "rx", "ry", "rz")),
}


def _draw_ways(panel: Axes, found: Result, gains: tuple[str, str], axes: str, look: _Look) -> list[Artist]:
    """Draw descents and other points, of some axes also the result; return the handles of the legend."""
    history, tuned = found.history, by_name(found.gains)
    names = [str(name) for name in history["coordinate"].values]
    ways = []
    for gain in gains:
        columns = [i for i, name in enumerate(names) if name in (gain, *(f"{gain}.{c}" for c in look.coordinates))]
        own = axis_values(tuned[gain])[look.axes]
        searched = np.exp(history["theta"].values[:, columns].mean(1)) if columns else None
        ways.append(np.full(history.sizes["point"], _mean(own)) if searched is None else searched)
    descending = np.isin(history["phase"].values.astype(str), ["descent", "axes tied", "axes free"])
    handles: list[Artist] = []
    for row in np.unique(history["row"].values[descending]):
        way = descending & (history["row"].values == row)
        panel.plot(ways[0][way], ways[1][way], "-", color=look.color, linewidth=0.7, zorder=3)
    leading = _best_of_crowds(history)
    panel.plot(ways[0][leading], ways[1][leading], "-", color=look.color, linewidth=0.7, zorder=3)
    for drawn, text in ((descending.any(), "descents"), (len(leading), "best of each round")):
        if drawn:
            text = f"{text}, {axes}" if axes else text
            handles.append(Line2D([], [], color=look.color, linewidth=0.7, label=text))
    dots: dict[str, Any] = {"color": look.color, "marker": ".", "markersize": 2, "linestyle": "none"}
    others = ~descending & ~_crowded(history)
    panel.plot(ways[0][others], ways[1][others], **dots, zorder=3)
    handles.append(Line2D([], [], **dots, label="other points"))
    if axes:
        points = [axis_values(tuned[gain])[look.axes] for gain in gains]
        handles[-1:] = [_mark(panel, points, look.marker, look.color, f"tuned, {axes}")]
    return handles


def _crowded(history: xr.Dataset) -> np.ndarray:
    """Return which points (N,) were judged beside so many that they would hide the map."""
    sizes = np.bincount(history["round"].values)
    return np.asarray(sizes[history["round"].values] > _CROWD)


def _best_of_crowds(history: xr.Dataset) -> np.ndarray:
    """Return the indices of the points with the least value plus penalty of each crowded round, one after the other."""
    merit = (history["value"] + history["penalty"]).values
    places = np.flatnonzero(_crowded(history) & np.isfinite(merit))
    order = places[np.lexsort((merit[places], history["round"].values[places]))]
    _, first = np.unique(history["round"].values[order], return_index=True)
    return np.asarray(order[first])


def _mark(panel: Axes, points: Sequence[np.ndarray], marker: str, color: str, label: str) -> Artist:
    """Mark points (x, y) and return the handle of the legend."""
    look: dict[str, Any] = {
        "marker": marker, "linestyle": "none", "markerfacecolor": "white", "markeredgecolor": color,
        "markeredgewidth": 0.9, "markersize": 9 if marker == "*" else 6,
    }  # fmt: skip
    panel.plot(*points, **look, zorder=4, gid=label)
    return Line2D([], [], **look, label=label)


def _mean(gain: ArrayLike) -> float:
    return float(np.exp(np.mean(np.log(gain))))
