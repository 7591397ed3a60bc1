"""Pictures over many walks: gains judged on an ensemble, a Pareto front, a gain schedule."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from mjx_climb import plots
from tuning.problem import ensemble
from tuning.searches.judge import WORST_SHARE
from tuning.searches.pareto import knee

SCALES = {"m": (1e3, "mm"), "rad": (180 / np.pi, "deg")}
_COLORS = {"config": plots.VERMILLION, "paper": plots.VERMILLION, "pd": "0.6"}
_LOADS = (plots.BLUE, plots.ORANGE, plots.GREEN, plots.PURPLE, plots.SKY, plots.VERMILLION)
_UNITS = {"stiffness": "K [N/m, N m/rad]", "damping": "D [N s/m, N m s]", "inertia": "M [kg, kg m$^2$]"}
_DASHES = {"tuned": "-", "config": ":", "retuned_pd": "--"}


def _scaled(variable: xr.DataArray) -> tuple[float, str]:
    """Return the factor by which people read a metric, and the label of its axis."""
    factor, unit = SCALES.get(variable.attrs["units"], (1.0, variable.attrs["units"]))
    return factor, variable.attrs["long_name"] + ("" if unit == "1" else f" [{unit}]")


@plots.style()
def plot_judged(judged: xr.Dataset, metrics: Sequence[str] = ("force_variation", "peak_pull_force")) -> Figure:
    """Draw which share of the unseen walks stays below a value, a curve for each set of gains.

    A dot marks the mean, a diamond the mean of the worst 5 %. A gripper lets go beyond the
    vertical line.
    """
    figure = Figure(figsize=(plots.COLUMN, 0.35 + 1.75 * len(metrics)), layout="constrained")
    names = judged["gains"].values.tolist()
    others = (plots.BLUE, plots.GREEN, plots.PURPLE)
    colors = {name: _COLORS.get(name, others[number % 3]) for number, name in enumerate(names)}
    share = 100 * (np.arange(judged.sizes["member"]) + 1) / judged.sizes["member"]
    for panel, metric in zip(figure.subplots(len(metrics), 1, squeeze=False)[:, 0], metrics, strict=True):
        factor, label = _scaled(judged[metric])
        for name, color in colors.items():
            values = judged[metric].sel(gains=name).values.astype(float)
            values = np.sort(values[np.isfinite(values)]) * factor
            panel.step(values, share[: values.size], where="post", color=color, linewidth=1.2)
            for mark, at in (("o", values.mean()), ("D", ensemble.worst_mean(values, WORST_SHARE))):
                panel.plot(at, np.interp(at, values, share[: values.size]), mark, color=color, ms=4)
        panel.set(xlabel=label, ylabel="share of walks [%]", ylim=(0, 103))
        limit = judged.attrs.get("holding_limit", np.inf)
        if metric == "peak_pull_force" and limit < panel.get_xlim()[1]:
            panel.axvline(limit, color=plots.RED, linewidth=0.8)
    handles = [Line2D([], [], color=color, label=name) for name, color in colors.items()]
    marks = {"mean": "o", "worst 5 %": "D"}
    handles += [Line2D([], [], color="0.3", marker=mark, ms=4, ls="", label=label) for label, mark in marks.items()]
    plots.legend(figure, handles)
    return figure


@plots.style()
def plot_front(front: xr.Dataset) -> Figure:
    """Draw a Pareto front, all that was walked on the way, its knee, the config's gains, pd, and the front of pd."""
    x, y = front.attrs["against"], front.attrs["better"]
    (x_factor, x_label), (y_factor, y_label) = _scaled(front[x]), _scaled(front[y])

    def places(kind: str = "") -> tuple[np.ndarray, np.ndarray]:
        """Return the points of a kind as they are drawn, x and y."""
        return front[f"{kind}{x}"].values * x_factor, front[f"{kind}{y}"].values * y_factor

    held, references = front["held"].values.astype(bool), np.transpose(places("reference_"))
    figure = Figure(figsize=(plots.COLUMN, 2.7), layout="constrained")
    panel = figure.subplots()
    walked = np.transpose(places("walked_"))[held]
    panel.plot(*walked.T, ".", color="0.75", ms=2.5, label="walked", zorder=1)
    panel.plot(*places(), "-o", color=plots.BLUE, ms=2.5, label="front")
    panel.plot(*places("without_"), "--.", color=plots.BLACK, ms=3, lw=0.8, label="pd over kp, kd")
    bend = np.transpose(places())[knee(front[x].values, front[y].values)]
    panel.plot(*bend, "*", color=plots.ORANGE, ms=9, mec="black", mew=0.5, ls="", label="knee")
    named = dict(zip(front["reference"].values.tolist(), references, strict=True))
    for name, marker in (("config", "D"), ("pd", "s")):
        panel.plot(*named[name], marker, color=_COLORS[name], mec="black", mew=0.5, ms=5, ls="", label=name)
    shown = np.concatenate([np.transpose(places()), references[np.isfinite(references).all(1)]])
    for scale, limits, values in (
        (panel.set_xscale, panel.set_xlim, shown[:, 0]),
        (panel.set_yscale, panel.set_ylim, shown[:, 1]),
    ):
        low, high = values.min(), values.max()
        if low > 0 and high / low > 8:
            scale("log")
            room = (low / high) ** 0.08
            limits(low * room, high / room)
        else:
            room = 0.1 * (high - low) or 0.1 * abs(high)
            limits(low - room, high + room)
    panel.set(xlabel=x_label, ylabel=y_label)
    panel.legend(fontsize=6.5)
    return figure


@plots.style()
def plot_schedule(table: xr.Dataset) -> Figure:
    """Draw the gains over gravity, a line for each cargo, and the force variation that they leave of pd's.

    Solid lines are translations, dashed ones rotations where they differ; gains that differ within either appear as
    their geometric mean. Hollow marks break a limit.
    """
    gravity, kinds = table["gravity"].values, table.attrs["searched"].split()
    colors = {load: _LOADS[number % len(_LOADS)] for number, load in enumerate(table["cargo"].values)}
    figure = Figure(figsize=(plots.COLUMN, 0.5 + 1.3 * (len(kinds) + 1)), layout="constrained")
    *panels, below = figure.subplots(len(kinds) + 1, 1, sharex=True)
    for load, color in colors.items():
        point = table.sel(cargo=load)
        feasible = point["feasible"].values.astype(bool)
        for panel, kind in zip(panels, kinds, strict=True):
            for part, dash in zip(_translation_and_rotation(point[kind].values), "-:", strict=False):
                _line(panel, gravity, part, feasible, color=color, linestyle=dash)
            panel.set_ylabel(_UNITS.get(kind, f"{kind} [{table[kind].attrs['units']}]"))
        variation = point["force_variation"]
        for walk, dash in _DASHES.items():
            left = 100 * (variation.sel(walk=walk) / variation.sel(walk="pd")).values
            _line(below, gravity, left, feasible if walk == "tuned" else None, color=color, linestyle=dash)
    for panel in panels:
        _log_scale(panel)
    below.axhline(100, color="0.6", linewidth=0.8)
    below.set(ylabel="force variation\n[% of pd]", xscale="log", xlabel="gravity [G]")
    walks = [Line2D([], [], color="0.3", ls=dash, label=walk.replace("_", " ")) for walk, dash in _DASHES.items()]
    below.legend(handles=walks, fontsize=6.5)
    loads = [Line2D([], [], color=color, label=f"{load:g} kg") for load, color in colors.items()]
    plots.legend(figure, loads, "cargo")
    return figure


def _translation_and_rotation(gain: np.ndarray) -> list[np.ndarray]:
    """Return the geometric means of a gain (n, axes) or (n) over translations, and over rotations where they differ."""
    logs = np.log(gain.reshape(len(gain), -1))
    both = [part.mean(1) for part in (logs[:, :3], logs[:, 3:]) if part.size]
    return [np.exp(part) for part in both[: 1 + (not np.allclose(both[0], both[-1]))]]


def _log_scale(panel: Axes) -> None:
    """Make the y axis logarithmic, a decade at least: less would make mountains of what does not matter."""
    panel.set_yscale("log")
    low, high = panel.get_ylim()
    room = max(np.sqrt(10 * low / high), 1.0)
    panel.set_ylim(low / room, high * room)
    if high * room**2 / low < 1e3:
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panel.yaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_minor_formatter("")


def _line(
    panel: Axes, x: np.ndarray, y: np.ndarray, feasible: np.ndarray | None, *, color: str, linestyle: str
) -> None:
    panel.plot(x, y, linestyle, color=color)
    if feasible is not None:
        panel.plot(x[feasible], y[feasible], "o", color=color, ms=3)
        panel.plot(x[~feasible], y[~feasible], "o", color=color, ms=3, mfc="white")
