"""Pictures of a search: how it converged, and its way over the map of stiffness and damping."""

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from mjx_climb import plots
from tuning.gains.gains_file import by_name
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

    Gains that differ between the axes appear as their geometric means.
    """
    names = [str(name) for name in found.history["coordinate"].values]
    theta = found.history["theta"].values
    ways = {}
    x, y = (str(name) for name in walks["diverged"].dims)
    for kind in (x, y):
        columns = [i for i, name in enumerate(names) if name.split(".")[0] == kind]
        ways[kind] = np.exp(theta[:, columns].mean(1))
    control = found.scenario.control

    def mean(gain: ArrayLike) -> float:
        return float(np.exp(np.mean(np.log(gain))))

    tuned = by_name(found.gains)
    marks = {"tuned": (mean(tuned[x]), mean(tuned[y]))}
    if found.law is None:
        marks["config"] = mean(getattr(control, x)), mean(getattr(control, y))
    with plots.style():
        figure = plots.plot_map(walks, "objective", marks, baseline=1.0, x=x, y=y)
        panel = figure.axes[0]
        phases = found.history["phase"].values.astype(str)
        descending = np.isin(phases, ["descent", "axes tied", "axes free"])
        for row in np.unique(found.history["row"].values[descending]):
            way = descending & (found.history["row"].values == row)
            panel.plot(ways[x][way], ways[y][way], "-", color="0.1", linewidth=0.7, zorder=3)
        panel.plot(ways[x][~descending], ways[y][~descending], ".", color="0.1", markersize=2, zorder=3)
        handles: list[Artist] = [handle for handle in figure.legends[0].legend_handles if handle is not None]
        handles.append(Line2D([], [], color="0.1", linewidth=0.7, label="descents"))
        handles.append(Line2D([], [], color="0.1", marker=".", markersize=2, linestyle="none", label="other points"))
        figure.legends[0].remove()
        plots.legend_below(figure, handles if descending.any() else [*handles[:-2], handles[-1]], 3)
    return figure
