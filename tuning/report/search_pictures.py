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
from tuning.report.explorer import axes_of
from tuning.report.numbers import axis_values
from tuning.searches.result import Tuned

CROWD = 100  # points of a round; more would hide the map


@plots.style()
def plot_convergence(found: Tuned) -> Figure:
    """Draw the objective over the env-steps spent: every feasible point, the best so far, and gradient norms."""
    history = found.data
    spent = history["env_steps"].values / 1e6
    value = np.where(history["feasible"], history["value"], np.nan)
    norm = history["gradient_norm"].values
    with_gradient = np.isfinite(norm).any()
    figure = Figure(figsize=(plots.COLUMN, 3.2 if with_gradient else 2.2), layout="constrained")
    axes = figure.subplots(1 + with_gradient, 1, sharex=True, squeeze=False)[:, 0]
    axes[0].plot(spent, value, ".", color="0.65", markersize=2.5, label="judged, keeps every limit")
    if np.isfinite(value).any():
        axes[0].plot(spent, np.fmin.accumulate(value), color=plots.BLUE, label="best so far")
        low = np.nanmin(value)
        axes[0].set_ylim(low - 0.03, min(np.nanmax(value), max(1.1, low + 0.5)) + 0.03)
    axes[0].axhline(1.0, color=plots.RED, linewidth=0.8, label="pd")
    axes[0].set_ylabel("objective")
    plots.legend(figure, axes[0].get_legend_handles_labels()[0])
    if with_gradient:
        axes[1].semilogy(spent, norm, ".", color=plots.BLUE, markersize=2.5)
        axes[1].set_ylabel("norm of\nthe gradient")
    axes[-1].set_xlabel("env-steps spent [million]")
    return figure


@plots.style()
def plot_path(found: Tuned, walks: xr.Dataset) -> Figure:
    """Draw the way of every start over a map with an `objective` (`tuning.evaluation.maps`), and its stability limit.

    The map and its limit are of gains that are the same on all axes. Where a search told axes apart, translations and
    rotations go their own ways, the geometric means of theirs, and the result has a mark for each axis.
    """
    x, y = axes_of(walks)
    tuned, control = by_name(found.gains), found.scenario.control
    apart = any("." in str(name) for name in found.data["coordinate"].values)
    config = None if found.law else (_mean(getattr(control, x)), _mean(getattr(control, y)))
    marks = {} if apart else {"tuned": (_mean(tuned[x]), _mean(tuned[y]))}
    if config and not apart:
        marks["config"] = config
    title = "map and limit: the same gains on all axes" if apart else None
    figure = plots.plot_map(walks, "objective", marks, baseline=1.0, title=title)
    handles: list[Artist] = []
    for legend in figure.legends:
        handles += [handle for handle in legend.legend_handles if handle is not None]
        legend.remove()
    for name, look in (_AXES if apart else {"": _AXES["translations"]}).items():
        ways = [_way(found, gain, look) for gain in (x, y)]
        handles += _draw_ways(figure.axes[0], found.data, ways, look, f", {name}" if name else "")
        if apart:
            points = [axis_values(tuned[gain])[look.axes] for gain in (x, y)]
            handles.append(_mark(figure.axes[0], points, look.marker, look.color, f"tuned, {name}"))
    if config and apart:
        handles.append(_mark(figure.axes[0], [[place] for place in config], "o", "0.1", "config"))
    plots.legend_below(figure, handles, 3)
    return figure


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


def _way(found: Tuned, gain: str, look: _Look) -> np.ndarray:
    """Return a gain at every point of a search, (point,): the geometric mean over some axes."""
    wanted = {gain, *(f"{gain}.{coordinate}" for coordinate in look.coordinates)}
    columns = [i for i, name in enumerate(found.data["coordinate"].values) if str(name) in wanted]
    if not columns:
        return np.full(found.data.sizes["point"], _mean(axis_values(by_name(found.gains)[gain])[look.axes]))
    return np.asarray(np.exp(found.data["theta"].values[:, columns].mean(1)))


def _draw_ways(panel: Axes, history: xr.Dataset, ways: Sequence[np.ndarray], look: _Look, words: str) -> list[Artist]:
    """Draw descents, the best of crowded rounds and, unless a result is marked, other points; return the handles."""
    line: dict[str, Any] = {"color": look.color, "linewidth": 0.7}
    dots: dict[str, Any] = {"color": look.color, "marker": ".", "markersize": 2, "linestyle": "none"}
    descending = np.isin(history["phase"].values.astype(str), ["descent", "axes tied", "axes free"])
    starts = history["row"].values
    leading = best_of_crowds(history)
    for points in [*(descending & (starts == row) for row in np.unique(starts[descending])), leading]:
        panel.plot(ways[0][points], ways[1][points], "-", **line, zorder=3)
    others = ~descending & ~crowded(history)
    panel.plot(ways[0][others], ways[1][others], **dots, zorder=3)
    drawn = {"descents": descending.any(), "best of each round": leading.size}
    handles: list[Artist] = [Line2D([], [], **line, label=text + words) for text, any_ in drawn.items() if any_]
    return handles if words else [*handles, Line2D([], [], **dots, label="other points")]


def crowded(history: xr.Dataset) -> np.ndarray:
    """Return which points (N,) were judged beside so many that they would hide the map."""
    return np.asarray(np.bincount(history["round"].values)[history["round"].values] > CROWD)


def best_of_crowds(history: xr.Dataset) -> np.ndarray:
    """Return the indices of the points with the least value plus penalty of each crowded round, one after the other."""
    merit = (history["value"] + history["penalty"]).values
    places = np.flatnonzero(crowded(history) & np.isfinite(merit))
    order = places[np.lexsort((merit[places], history["round"].values[places]))]
    _, first = np.unique(history["round"].values[order], return_index=True)
    return np.asarray(order[first])


def _mark(panel: Axes, points: Sequence[ArrayLike], marker: str, color: str, label: str) -> Artist:
    """Mark points (x, y) and return the handle of the legend."""
    size = 9 if marker == "*" else 6
    look: dict[str, Any] = {"ls": "none", "mfc": "white", "mec": color, "mew": 0.9, "ms": size}
    return panel.plot(*points, marker=marker, **look, zorder=4, label=label, gid=label)[0]


def _mean(gain: ArrayLike) -> float:
    return float(np.exp(np.mean(np.log(gain))))
