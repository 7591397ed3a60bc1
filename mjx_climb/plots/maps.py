"""Maps of a metric over two gains."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

from mjx_climb.files.dataset import larger_is_better
from mjx_climb.plots.colors import BLACK, GREY, HELD, LIMB_COLORS, RED, SAME
from mjx_climb.plots.styling import COLUMN, legend_below, styled
from mjx_climb.walk.metrics import FAILURES

_LEAST_SPAN = 0.05  # of a scale, relative to its values
_MARKERS = ("*", "o", "D", "^", "s", "P", "v")
_TORN, _DIVERGED = "/////", "xxxxx"  # hatches


@styled
def plot_map(
    dataset: xr.Dataset,
    metric: str,
    marks: Mapping[str, tuple[float, float]] | None = None,
    *,
    baseline: float | None = None,
    baseline_name: str = "pd",
    x: str = "stiffness",
    y: str = "damping",
    title: str | None = None,
) -> Figure:
    """Draw a metric over two gains, both on logarithmic axes; brighter is better.

    Arguments:
        dataset: a grid of metrics over `x` and `y`, as of `dataset.sweep_dataset`.
        metric: the variable to draw.
        marks: points (x, y) by their name in the legend, as of the paper's gains.
        baseline: value of another controller, a line on the colour bar.
        baseline_name: what stands at that line.
        x: the dimension along the horizontal axis.
        y: the dimension along the vertical axis.
        title: above the figure.

    Walks that failed are hatched, by lines where a gripper was torn off (`detached_at` set), whatever became of the
    walk, and crosswise where it `diverged` with all of them; what is not a number is grey. Where the dataset has a
    `spectral_radius` (largest eigenvalue of one step), a red line is the limit of stability.
    """
    figure = Figure(figsize=(COLUMN, 2.9), layout="constrained")
    handles, label, bar = _draw_map(
        figure,
        figure.subplots(),
        dataset,
        metric,
        marks or {},
        baseline,
        baseline_name,
        stability_lines(dataset, x, y),
        x,
        y,
    )
    bar.set_label(label)
    legend_below(figure, handles, 3)
    if title:
        figure.suptitle(title, fontsize=8.5)
    return figure


@styled
def plot_maps(
    dataset: xr.Dataset,
    metrics: Sequence[str],
    marks: Mapping[str, tuple[float, float]] | None = None,
    *,
    baselines: Mapping[str, float] | None = None,
    baseline_name: str = "pd",
    x: str = "stiffness",
    y: str = "damping",
    columns: int = 2,
    title: str | None = None,
) -> Figure:
    """Draw a sheet of maps, one per metric, with one legend.

    `baselines` are by metric; all other arguments are those of `plot_map`.
    """
    if not metrics:
        raise ValueError("expected at least one metric to draw")
    rows, columns = math.ceil(len(metrics) / columns), min(columns, len(metrics))
    figure, axes = _sheet(rows, columns)
    handles, limit = {}, stability_lines(dataset, x, y)
    for metric, panel in zip(metrics, axes.flat, strict=False):
        value = (baselines or {}).get(metric)
        found, label, _ = _draw_map(figure, panel, dataset, metric, marks or {}, value, baseline_name, limit, x, y)
        panel.set_title(label, y=1.0)  # where it is anyway, without a search for it
        handles.update({handle.get_label(): handle for handle in found})
    for number, panel in enumerate(axes.flat):
        if number >= len(metrics):
            panel.remove()
        elif number + columns < len(metrics):
            panel.set_xlabel("")
        else:
            panel.tick_params(axis="x", labelbottom=True)
        if number % columns:
            panel.set_ylabel("")
        panel.minorticks_off()
    if handles:
        figure.legend(handles=list(handles.values()), loc="lower center", ncols=3 * columns, columnspacing=1.2)
    if title:
        figure.suptitle(title, fontsize=8.5)
    return figure


def _sheet(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels (rows, columns), with room for labels by measure: no layout is worked out."""
    width, height = COLUMN * columns, 0.5 + 2.3 * rows
    left, right, beside = 0.62, 0.5, 0.55
    bottom, top, between = 0.75, 0.45, 0.35
    cell_width = (width - left - right - (columns - 1) * beside) / columns
    cell_height = (height - bottom - top - (rows - 1) * between) / rows
    figure = Figure(figsize=(width, height))
    axes = figure.subplots(
        rows, columns, squeeze=False, sharex=True, sharey=True,
        gridspec_kw={
            "left": left / width, "right": 1 - right / width, "bottom": bottom / height, "top": 1 - top / height,
            "wspace": beside / cell_width, "hspace": between / cell_height,
        },
    )  # fmt: skip
    return figure, axes


def _draw_map(
    figure: Figure,
    panel: Axes,
    dataset: xr.Dataset,
    metric: str,
    marks: Mapping[str, tuple[float, float]],
    baseline: float | None,
    baseline_name: str,
    limit: Sequence[np.ndarray],
    x: str,
    y: str,
) -> tuple[list[Artist], str, Colorbar]:
    """Draw one map with its colour bar; return the handles of its legend, what its colours stand for, and the bar."""
    variable = _grid(dataset, metric, x, y)
    failed = failed_walks(dataset, x, y)
    values = comparable(dataset, metric).transpose(y, x).values.astype(float)
    x_edges, y_edges = (_log_edges(dataset[name].values) for name in (x, y))
    flags = variable.attrs.get("flag_meanings", "").split()
    known = np.unique(values[np.isfinite(values)])
    colormap: Colormap
    norm: Normalize
    if flags:
        codes = np.asarray(variable.attrs["flag_values"], float)
        colors = ["0.9", *LIMB_COLORS][: len(flags)]
        colormap, norm, extend = (
            ListedColormap(colors),
            BoundaryNorm([*(codes - 0.5), codes[-1] + 0.5], len(codes)),
            "neither",
        )
    else:
        larger = larger_is_better(variable)
        colormap = mpl.colormaps["viridis" if larger else "viridis_r"] if known.size != 1 else ListedColormap([SAME])
        norm, extend = color_scale(values, failed, baseline, larger)
    panel.set_facecolor(GREY)
    mesh = panel.pcolormesh(
        x_edges,
        y_edges,
        np.ma.masked_invalid(values),
        cmap=colormap,
        norm=norm,
        linewidth=0,
        rasterized=values.size > 1e4,
    )
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel(_label(dataset[x], x))
    panel.set_ylabel(_label(dataset[y], y))

    handles: list[Artist] = []
    if failed.any():
        shades = colormap(norm(np.nan_to_num(values, nan=norm.vmin or 0.0)))[..., :3] @ [0.299, 0.587, 0.114]
        dark = (shades < 0.4) & np.isfinite(values)
        torn = torn_off(dataset, x, y)
        for kind, hatch, name in ((torn, _TORN, "gripper torn off"), (failed & ~torn, _DIVERGED, "diverged")):
            hatched: dict[str, Any] = {"facecolor": "none", "hatch": hatch, "linewidth": 0}
            for chosen, color in ((kind & ~dark, "0.15"), (kind & dark, "0.85")):
                cells = [
                    Path([(x_edges[i], y_edges[j]), (x_edges[end], y_edges[j]), (x_edges[end], y_edges[j + 1]),
                          (x_edges[i], y_edges[j + 1]), (x_edges[i], y_edges[j])], closed=True)
                    for j, i, end in _runs(chosen)
                ]  # fmt: skip
                if cells:  # one shape: each would be hatched by itself
                    whole = PathPatch(Path.make_compound_path(*cells), **hatched, edgecolor=color, gid=name)
                    panel.add_artist(whole)
            if kind.any():
                handles.append(Patch(**hatched | {"facecolor": "white"}, edgecolor="0.15", label=name))
    empty = np.isnan(values)
    if metric == "detached_at" and (held := empty & ~failed).any():
        panel.pcolormesh(x_edges, y_edges, np.ma.masked_where(~held, held), cmap=ListedColormap([HELD]), linewidth=0)
        handles.append(Patch(facecolor=HELD, label="held all the way"))
        empty &= failed
    if empty.any():
        handles.append(Patch(facecolor=GREY, label="no value"))
    for number, (name, (at_x, at_y)) in enumerate(marks.items()):
        marker = _MARKERS[number % len(_MARKERS)]
        look: dict[str, Any] = {
            "marker": marker,
            "linestyle": "none",
            "markerfacecolor": "white",
            "markeredgecolor": BLACK,
            "markeredgewidth": 0.9,
            "markersize": 9 if marker == "*" else 6,
        }
        panel.plot([at_x], [at_y], **look, zorder=4, label=name)
        handles.append(Line2D([], [], **look, label=name))
    for line in limit:
        panel.plot(*line.T, color=RED, linewidth=1.0, zorder=3, gid="stability limit")
    if limit:
        handles.append(Line2D([], [], color=RED, linewidth=1.0, label="stability limit"))
    # a mark beside the grid is shown too
    panel.set_xlim(*_span(x_edges, [mark[0] for mark in marks.values()]))
    panel.set_ylim(*_span(y_edges, [mark[1] for mark in marks.values()]))

    bar = figure.colorbar(mesh, ax=panel, extend=extend, fraction=0.05, pad=0.02, aspect=25)
    bar.outline.set_linewidth(0.6)
    if flags:
        bar.set_ticks(codes.tolist(), labels=flags)
        bar.ax.minorticks_off()
    elif known.size == 1:
        bar.set_ticks([])
        text = f"all cells: {known[0]:.4g}"
        panel.annotate(text, (0.5, 0.5), xycoords="axes fraction", ha="center", gid="constant")
    elif (
        isinstance(norm, LogNorm) and mesh.get_clim()[1] < 1e3 * mesh.get_clim()[0]
    ):  # so few decades want ticks between them
        bar.locator = LogLocator(subs=(1, 2, 5))
        bar.formatter = LogFormatterSciNotation(minor_thresholds=(math.inf, math.inf))
        bar.minorformatter = NullFormatter()
        bar.update_ticks()
    if baseline is not None and not flags and known.size != 1:
        _mark_on_bar(bar, float(baseline), baseline_name)
    return handles, _label(variable, metric), bar


def _runs(chosen: np.ndarray) -> list[tuple[int, int, int]]:
    """Return the row, the first column and the one after the last of all that are chosen side by side."""
    padded = np.pad(chosen.astype(int), ((0, 0), (1, 1)))
    steps = np.diff(padded, axis=1)
    rows, starts = np.nonzero(steps == 1)
    ends = np.nonzero(steps == -1)[1]
    return list(zip(rows.tolist(), starts.tolist(), ends.tolist(), strict=True))


def stability_lines(dataset: xr.Dataset, x: str = "stiffness", y: str = "damping") -> list[np.ndarray]:
    """Return the limit of stability over two gains, lines of points (N, 2): where the `spectral_radius` passes 1.

    None where the dataset has no such variable, or all is on one side; rows and columns without values are left out.
    """
    if "spectral_radius" not in dataset:
        return []
    radius = _grid(dataset, "spectral_radius", x, y).dropna(x, how="all").dropna(y, how="all")
    excess = np.clip((radius.values - 1) * 1e3, -1, 1)  # beyond the limit it grows without bounds
    if min(excess.shape) < 2 or not (excess > 0).any() or not (excess <= 0).any():
        return []
    lines = Figure().subplots().contour(np.log(radius[x]), np.log(radius[y]), excess, [0.0]).allsegs[0]
    return [np.exp(line) for line in lines if len(line) > 1]


def _mark_on_bar(bar: Colorbar, value: float, name: str) -> None:
    """Draw a line across a colour bar, or an arrow at the end beyond which the value lies."""
    low, high = np.asarray(bar.mappable.get_clim(), float)
    arrow = " \N{UPWARDS ARROW}" if value > high else " \N{DOWNWARDS ARROW}" if value < low else ""
    place = min(max(value, low), high)
    bar.ax.axhline(place, color=RED, linewidth=1.4, gid="baseline")
    bar.ax.annotate(
        name + arrow,
        (0, place),
        xycoords=bar.ax.get_yaxis_transform(),
        xytext=(-2, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=6.5,
        color=RED,
        bbox={"facecolor": "white", "linewidth": 0, "pad": 0.6},
        zorder=6,
    )


def comparable(dataset: xr.Dataset, metric: str) -> xr.DataArray:
    """Return a metric of walks, NaN for those that diverged: their values until then compare with no other's."""
    variable = dataset[metric]
    if "diverged" not in dataset or metric in FAILURES or "larger_is_better" not in variable.attrs:
        return variable
    return variable.where(~dataset["diverged"].astype(bool))


def _grid(dataset: xr.Dataset, name: str, x: str, y: str) -> xr.DataArray:
    """Return a variable as (y, x).

    Raises:
        ValueError: no such variable, or other dimensions.
    """
    if name not in dataset:
        raise ValueError(f"{name}: expected one of {', '.join(map(str, dataset.data_vars))}")
    if set(dataset[name].dims) != {x, y}:
        raise ValueError(f"{name}: expected dimensions {x} and {y}, got {', '.join(map(str, dataset[name].dims))}")
    return dataset[name].transpose(y, x)


def torn_off(dataset: xr.Dataset, x: str, y: str) -> np.ndarray:
    """Return which walks lost a gripper, (y, x), be it that they diverged later."""
    torn = np.zeros((dataset.sizes[y], dataset.sizes[x]), bool)
    if "detached_at" in dataset:
        torn |= np.isfinite(_grid(dataset, "detached_at", x, y).values)
    if "detached_limb" in dataset:
        torn |= _grid(dataset, "detached_limb", x, y).values >= 0
    return torn


def failed_walks(dataset: xr.Dataset, x: str, y: str) -> np.ndarray:
    """Return which walks failed, (y, x): a gripper was torn off, or the state stopped being finite."""
    failed = torn_off(dataset, x, y)
    if "diverged" in dataset:
        failed |= _grid(dataset, "diverged", x, y).values.astype(bool)
    return failed


def _log_edges(centers: np.ndarray) -> np.ndarray:
    """Return the edges of cells around positive, ordered `centers`, half-way on a logarithmic scale."""
    if not (np.isfinite(centers).all() and (centers > 0).all()):
        raise ValueError("a map needs gains above 0: its axes are logarithmic")
    logs = np.log(np.asarray(centers, float))
    if logs.size == 1:
        return np.asarray(np.exp(logs[0] + np.array([-0.5, 0.5])))
    middle = (logs[1:] + logs[:-1]) / 2
    return np.asarray(np.exp(np.concatenate([[2 * logs[0] - middle[0]], middle, [2 * logs[-1] - middle[-1]]])))


def _span(edges: np.ndarray, marks: Sequence[float]) -> tuple[float, float]:
    """Return the limits that show all cells, and the marks beside them with a margin."""
    low, high = edges.min(), edges.max()
    return (
        min([low, *(mark / 1.5 for mark in marks if mark < low)]),
        max([high, *(mark * 1.5 for mark in marks if mark > high)]),
    )


def color_scale(
    values: np.ndarray, failed: np.ndarray, baseline: float | None, larger_is_better: bool = False
) -> tuple[Normalize, str]:
    """Return a scale from the 2nd to the 98th percentile, and which ends of it are passed.

    It is of the walks that held (of all, where fewer than four did), takes in a baseline that is near, goes beyond it
    to the worse side at most three times as far as to the better one, spans 5 % of its values at least, and is
    logarithmic where it spans more than a factor of 30.
    """
    finite = values[np.isfinite(values)]
    held = values[np.isfinite(values) & ~failed]
    if finite.size == 0:
        return Normalize(0, 1), "neither"
    low, high = np.percentile(held if held.size >= 4 else finite, [2, 98])
    if baseline is not None and np.isfinite(baseline):
        reach = 0.5 * (high - low)
        low, high = (min(low, baseline), high) if baseline > low - reach else (low, high)
        high = max(high, baseline) if baseline < high + reach else high
        if low < baseline < high:  # colours for what is better, and for how little is worse
            low, high = (
                (max(low, baseline - 3 * (high - baseline)), high)
                if larger_is_better
                else (low, min(high, baseline + 3 * (baseline - low)))
            )
    room = (_LEAST_SPAN * (max(abs(low), abs(high)) or 1.0) - (high - low)) / 2
    if room > 0:  # else a change that does not matter would use all colours
        low, high = low - room, high + room
    ends = (finite.min() < low - 1e-9 * abs(low), finite.max() > high + 1e-9 * abs(high))
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[ends]
    return (LogNorm if low > 0 and high > 30 * low else Normalize)(low, high), extend


def _label(variable: xr.DataArray, name: str) -> str:
    """Return "long name [unit]"; numbers without a unit stand alone."""
    unit = variable.attrs.get("units", "1")
    text = variable.attrs.get("long_name", name.replace("_", " "))
    return text if unit in ("1", "") else f"{text} [{unit.replace('^2', '$^2$')}]"
