"""Pictures of searches: how one converged, its way over the map, fronts, schedules, ensembles, margins."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import ArrayLike

from mjx_climb.viz import plots
from mjx_climb.viz.plots import key
from tuning.comparisons import margins
from tuning.comparisons.judge import WORST_SHARE
from tuning.gains.gains_file import by_name
from tuning.numbers import axis_values, has_axes
from tuning.pages.explorer import SCALES, axes_of
from tuning.problem import ensemble
from tuning.problem.spaces import kind_of
from tuning.results.front import knee
from tuning.results.tuned import Tuned

CROWD = 100  # points of a round; more would hide the map
_COLORS = {"config": plots.VERMILLION, "paper": plots.VERMILLION, "pd": "0.6", "retuned pd": plots.BLACK}
_LOADS = (plots.BLUE, plots.ORANGE, plots.GREEN, plots.PURPLE, plots.SKY, plots.VERMILLION)
_UNITS = {"stiffness": "K [N/m, N m/rad]", "damping": "D [N s/m, N m s]", "inertia": "M [kg, kg m$^2$]"}
_DASHES = {"tuned": "-", "config": ":", "retuned_pd": "--"}
_ROOM = 1.6  # of the largest force variation of pd on any hardware: above it curves leave the picture
_WIDE = 4  # range of that from which on the axis is logarithmic
_TORN, _DIVERGED = "X", "^"


def _scaled(variable: xr.DataArray) -> tuple[float, str]:
    """Return the factor by which people read a metric, and the label of its axis."""
    factor, unit = SCALES.get(variable.attrs["units"], (1.0, variable.attrs["units"]))
    return factor, variable.attrs["long_name"] + ("" if unit == "1" else f" [{unit}]")


def _plain_numbers(axis: Axis, *, few: bool) -> None:
    """Write the numbers of a logarithmic axis as 200, not as a power, and more of them where there are few decades."""
    if few:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")


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


_PARTS = {  # which of six axes are drawn as one; their names in a space, colour, and the mark of the result
    "translations": (slice(0, 3), ("translation", "x", "y", "z"), "0.1", "*"),
    "rotations": (slice(3, 6), ("rotation", "rx", "ry", "rz"), plots.PURPLE, "P"),
}


@plots.style()
def plot_path(found: Tuned, walks: xr.Dataset) -> Figure:
    """Draw the way of every start over a map with an `objective` (`tuning.comparisons.maps`), and its stability limit.

    The map and its limit are of gains that are the same on all axes. Where a search told axes apart, translations and
    rotations go their own ways, the geometric means of theirs, and the result has a mark for each axis.
    """
    axes, tuned, control = axes_of(walks), by_name(found.gains), found.scenario.control
    coordinates, theta = found.data["coordinate"].values.astype(str), found.data["theta"].values
    apart = any(name != kind_of(name) for name in coordinates)
    means = {"tuned": [_mean(tuned[gain]) for gain in axes]}
    if not found.law:
        means["config"] = [_mean(getattr(control, gain)) for gain in axes]
    title = "map and limit: the same gains on all axes" if apart else None
    marks = {} if apart else {name: (x, y) for name, (x, y) in means.items()}
    figure = plots.plot_map(walks, "objective", marks, baseline=1.0, title=title)
    descending = np.isin(found.data["phase"].values.astype(str), ["descent", "axes tied", "axes free"])
    starts, leading, others = found.data["row"].values, best_of_crowds(found.data), ~descending & ~crowded(found.data)
    panel = figure.axes[0]
    handles: list[Artist] = []
    for legend in figure.legends:
        handles += [handle for handle in legend.legend_handles if handle is not None]
        legend.remove()
    for part, (six, names, color, marker) in (_PARTS if apart else {"": _PARTS["translations"]}).items():
        result, ways = [axis_values(tuned[gain])[six] for gain in axes], []
        for gain, values in zip(axes, result, strict=True):
            searched = theta[:, np.isin(coordinates, [gain, *(f"{gain}.{name}" for name in names)])]
            ways.append(np.exp(searched.mean(1)) if searched.size else np.full(len(theta), _mean(values)))
        line: dict[str, Any] = {"color": color, "linewidth": 0.7}
        dots: dict[str, Any] = {"color": color, "marker": ".", "markersize": 2, "linestyle": "none"}
        for points in [*(descending & (starts == row) for row in np.unique(starts[descending])), leading]:
            panel.plot(ways[0][points], ways[1][points], "-", **line, zorder=3)
        panel.plot(ways[0][others], ways[1][others], **dots, zorder=3)
        for text, drawn in (("descents", descending.any()), ("best of each round", leading.size)):
            handles += [key(f"{text}, {part}" if part else text, **line)] if drawn else []
        last = _mark(panel, result, marker, color, f"tuned, {part}") if apart else key("other points", **dots)
        handles.append(last)
    if apart and "config" in means:
        handles.append(_mark(panel, means["config"], "o", "0.1", "config"))
    plots.legend_below(figure, handles, 3)
    return figure


def crowded(history: xr.Dataset) -> np.ndarray:
    """Return which points (N,) were judged beside so many that they would hide the map."""
    return np.asarray(np.bincount(history["round"].values)[history["round"].values] > CROWD)


def best_of_crowds(history: xr.Dataset) -> np.ndarray:
    """Return the indices of the points with the least value plus penalty of each crowded round, one after the other."""
    merit, rounds = (history["value"] + history["penalty"]).values, history["round"].values
    places = np.flatnonzero(crowded(history) & np.isfinite(merit))
    order = places[np.lexsort((merit[places], rounds[places]))]
    return np.asarray(order[np.unique(rounds[order], return_index=True)[1]])


def _mark(panel: Axes, points: Sequence[ArrayLike], marker: str, color: str, label: str) -> Artist:
    """Mark points (x, y) and return the handle of the legend."""
    look: dict[str, Any] = {"ls": "none", "mfc": "white", "mec": color, "mew": 0.9, "ms": 9 if marker == "*" else 6}
    return panel.plot(*points, marker=marker, **look, zorder=4, label=label, gid=label)[0]


def _mean(gain: ArrayLike) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(gain))))


@plots.style()
def plot_judged(judged: xr.Dataset, metrics: Sequence[str] = ("force_variation", "peak_pull_force")) -> Figure:
    """Draw which share of the unseen walks stays below a value, a curve for each set of gains.

    A dot marks the mean, a diamond the mean of the worst 5 %. A gripper lets go beyond the vertical line.
    """
    figure = Figure(figsize=(plots.COLUMN, 0.35 + 1.75 * len(metrics)), layout="constrained")
    others = itertools.cycle((plots.BLUE, plots.GREEN, plots.PURPLE))
    colors = {
        name: _COLORS.get(name, other) for name, other in zip(judged["gains"].values.tolist(), others, strict=False)
    }
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
    handles = [key(name, color=color) for name, color in colors.items()]
    for label, mark in (("mean", "o"), ("worst 5 %", "D")):
        handles.append(key(label, color="0.3", marker=mark, ms=4, ls=""))
    plots.legend(figure, handles)
    return figure


@plots.style()
def plot_laws(table: xr.Dataset) -> Figure:
    """Draw differences from the baseline in per cent of it, with their intervals: a panel a metric, a row a law.

    Dots are means, diamonds means of the worst 5 %; grey where the interval holds 0.
    """
    base = table.attrs["baseline"]
    names = [name for name in table["gains"].values.tolist() if name != base]
    others = table.sel(gains=names)  # one without an interval, or which is 0 with all gains, shows nothing
    drawn = others["low"].notnull() & ((others["value"] != 0) | (others["difference"] != 0))
    metrics = [name for name in table["metric"].values.tolist() if bool(drawn.sel(metric=name).any())]
    columns = min(3, len(metrics))
    rows = -(-len(metrics) // columns)
    figure = Figure(figsize=(2 * plots.COLUMN, rows * (0.55 + 0.2 * len(names)) + 0.4), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for panel, metric in itertools.zip_longest(panels.flat, metrics):
        if metric is None:
            panel.set_visible(False)
            continue
        panel.axvline(0, color="0.6", linewidth=0.8)
        for statistic, marker, shift in (("mean", "o", -0.13), ("worst", "D", 0.13)):
            own = table.sel(metric=metric, statistic=statistic)
            per = 100 / (abs(float(own["value"].sel(gains=base))) or 1.0)  # of no lost walks: per cent of all
            for place, name in enumerate(names):
                middle, low, high = (per * float(own[key].sel(gains=name)) for key in ("difference", "low", "high"))
                better = (middle < 0) != bool(own["larger_is_better"])
                color = (plots.BLUE if better else plots.VERMILLION) if bool(own["real"].sel(gains=name)) else "0.7"
                panel.plot([low, high], [place + shift] * 2, color=color, linewidth=1.2)
                panel.plot(middle, place + shift, marker, color=color, ms=3.5)
        panel.set(title=metric.replace("_", " "), ylim=(len(names) - 0.5, -0.5))
        panel.set_yticks(range(len(names)), names)
    for panel in panels[-1]:
        panel.set_xlabel("difference from\nretuned pd [%]")
    marks = [key(text, color="0.3", marker=mark, ms=4, ls="") for text, mark in (("mean", "o"), ("worst 5 %", "D"))]
    lines = (("better", plots.BLUE), ("worse", plots.VERMILLION), ("not real", "0.7"))
    plots.legend_below(figure, [*marks, *(key(text, color=color) for text, color in lines)], 5)
    return figure


@plots.style()
def plot_front(front: xr.Dataset) -> Figure:
    """Draw a Pareto front, all that was walked on the way, its knee, the config's gains, pd, and the front of pd."""
    metrics = front.attrs["against"], front.attrs["better"]
    (x_factor, x_label), (y_factor, y_label) = (_scaled(front[name]) for name in metrics)

    def places(kind: str = "") -> np.ndarray:
        """Return the points (N, 2) of a kind as they are drawn."""
        return np.transpose([front[f"{kind}{name}"].values for name in metrics]) * [x_factor, y_factor]

    on, references = places(), places("reference_")
    figure = Figure(figsize=(plots.COLUMN, 2.7), layout="constrained")
    panel = figure.subplots()
    walked = places("walked_")[front["held"].values.astype(bool)]
    panel.plot(*walked.T, ".", color="0.75", ms=2.5, label="walked", zorder=1)
    panel.plot(*on.T, "-o", color=plots.BLUE, ms=2.5, label="front")
    panel.plot(*places("without_").T, "--.", color=plots.BLACK, ms=3, lw=0.8, label="pd over kp, kd")
    bend = on[knee(*(front[name].values for name in metrics))]
    panel.plot(*bend, "*", color=plots.ORANGE, ms=9, mec="black", mew=0.5, ls="", label="knee")
    named = dict(zip(front["reference"].values.tolist(), references, strict=True))
    for name, marker in (("config", "D"), ("pd", "s")):
        panel.plot(*named[name], marker, color=_COLORS[name], mec="black", mew=0.5, ms=5, ls="", label=name)
    shown = np.concatenate([on, references, places("without_")])
    shown = shown[np.isfinite(shown).all(1)]
    panel.set(xlabel=x_label, ylabel=y_label)
    for axis, low, high in zip("xy", shown.min(0), shown.max(0), strict=True):
        if low > 0 and high / low > 8:
            room = (low / high) ** 0.08
            panel.set(**{f"{axis}scale": "log", f"{axis}lim": (low * room, high / room)})
        else:
            room = 0.1 * (high - low) or 0.1 * abs(high)
            panel.set(**{f"{axis}lim": (low - room, high + room)})
    panel.legend(fontsize=6.5)
    return figure


@plots.style()
def plot_schedule(table: xr.Dataset) -> Figure:
    """Draw the gains over gravity, a line for each cargo, and the force variation that they leave of pd's.

    Solid lines of gains are translations, dotted ones rotations where they differ; gains that differ within either
    appear as their geometric mean, arrays and gains of 0 or less not at all. Below, solid lines are the tuned gains,
    dotted ones the config's, dashed ones pd retuned. Hollow marks break a limit.
    """
    gravity, searched = table["gravity"].values, table.attrs["searched"].split()
    kinds = [kind for kind in searched if has_axes(table[kind][0, 0]) and (table[kind].values > 0).all()]
    colors = dict(zip(table["cargo"].values, itertools.cycle(_LOADS), strict=False))
    figure = Figure(figsize=(plots.COLUMN, 0.5 + 1.3 * (len(kinds) + 1)), layout="constrained")
    *panels, below = figure.subplots(len(kinds) + 1, 1, sharex=True, squeeze=False).ravel()

    for load, color in colors.items():
        point, curves = table.sel(cargo=load), []  # panel, values, dash, and whether a curve's points are marked
        feasible = point["feasible"].values.astype(bool)
        for panel, kind in zip(panels, kinds, strict=True):
            logs = np.log(point[kind].values.reshape(gravity.size, -1))
            parts = [part.mean(1) for part in (logs[:, :3], logs[:, 3:]) if part.size]
            curves.append((panel, np.exp(parts[0]), "-", True))
            if not np.allclose(parts[0], parts[-1]):
                curves.append((panel, np.exp(parts[-1]), ":", True))
            panel.set_ylabel(_UNITS.get(kind, f"{kind} [{table[kind].attrs['units']}]"))
        held = (point["detached_limb"] < 0) & ~point["diverged"].astype(bool)
        variation = point["force_variation"].where(held)
        left = 100 * variation / variation.sel(walk="pd")
        curves += [(below, left.sel(walk=walk).values, dash, walk == "tuned") for walk, dash in _DASHES.items()]
        for panel, values, dash, marked in curves:
            panel.plot(gravity, values, dash, color=color)
            for some, fill in ((feasible, color), (~feasible, "white")) if marked else ():
                panel.plot(gravity[some], values[some], "o", color=color, ms=3, mfc=fill)
    for panel in panels:  # a decade at least: less would make mountains of what does not matter
        panel.set_yscale("log")
        low, high = panel.get_ylim()
        room = max(np.sqrt(10 * low / high), 1.0)
        panel.set_ylim(low / room, high * room)
        _plain_numbers(panel.yaxis, few=high * room**2 / low < 1e3)
    below.axhline(100, color="0.6", linewidth=0.8)
    below.set(ylabel="force variation\n[% of pd]", xscale="log", xlabel="gravity [G]")
    if gravity.max() < 100 * gravity.min():  # so few decades would have a number at each of their tenths
        below.set_xlim(gravity.min() / 1.5, gravity.max() * 1.5)
        _plain_numbers(below.xaxis, few=True)
    walks = [key(walk.replace("_", " "), color="0.3", ls=dash) for walk, dash in _DASHES.items()]
    plots.legend_below(figure, walks, 3)
    plots.legend(figure, [key(f"{load:g} kg", color=color) for load, color in colors.items()], "cargo")
    return figure


@plots.style()
def plot_margins(found: margins.Found, given: str = "given gains") -> Figure:
    """Draw force variation over each quantity; a curve ends where a gripper is torn off, or the walk diverges.

    Dotted lines are the scenario's hardware, and twice as much of it (half of the joint gains); `given` is what the
    given gains are called.
    """
    others = iter((plots.BLUE, plots.GREEN, plots.PURPLE, plots.ORANGE))
    colors = {name: _COLORS.get(name) or next(others) for name in found.walks["gains"].values.tolist()}
    dots: dict[str, Any] = {"color": "0.5", "linewidth": 0.7, "linestyle": ":"}
    figure = Figure(figsize=(2 * plots.COLUMN, 4.4), layout="constrained")
    for panel, (name, margin) in zip(figure.subplots(2, 2).flat, found.margins.items(), strict=True):
        quantity = margins.QUANTITIES[name]
        unit, words = (1.0, "") if quantity.scales else (1e3, " [ms]")
        _draw_variation(panel, found.walks.sel(quantity=name), unit, colors)
        if quantity.scales:
            panel.set_xscale("log")
            _plain_numbers(panel.xaxis, few=True)
        panel.set_xlabel(quantity.title + words)
        for value in {margin.own, margins.needed(name, margin.own)}:
            panel.axvline(value * unit, **dots, zorder=0)
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
        _plain_numbers(panel.yaxis, few=False)
    panel.set(ylabel="force variation [N]", ylim=(0.8 * low if logarithmic else 0, top), xlim=(values[0], values[-1]))
