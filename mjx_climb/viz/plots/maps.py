"""Maps of a metric over two gains."""

import itertools
import math
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

from mjx_climb.files.dataset import larger_is_better
from mjx_climb.viz.plots.styling import BLACK, COLUMN, GREY, HELD, LIMB_COLORS, RED, SAME, key, legend_below, style
from mjx_climb.walk.metrics import FAILURES

_LEAST_SPAN = 0.05  # of a scale, relative to its values
_FOUND = ("best", "tuned")  # marks that are stars
_MARKERS = ("o", "D", "^", "s", "P", "v")
_HATCHES = {"gripper torn off": "/////", "diverged": "xxxxx"}

Marks = Mapping[str, tuple[float, float]]  # points (x, y) by their name in the legend


@style()
def plot_map(
    dataset: xr.Dataset, metric: str, marks: Marks | None = None, *, baseline: float | None = None,
    title: str | None = None,
) -> Figure:  # fmt: skip
    """Draw a metric over two gains, both on logarithmic axes; brighter is better.

    Arguments:
        dataset: a grid of metrics over two gains, as of `dataset.sweep_dataset`; the first one of the metric's
            dimensions runs along the horizontal axis.
        metric: the variable to draw.
        marks: points (x, y) by their name in the legend, as of the paper's gains.
        baseline: value of pd, a line on the colour bar.
        title: above the figure.

    Walks that failed are hatched, by lines where a gripper was torn off (`detached_at` set), however the
    walk ended, and crosswise where it `diverged` with all of them; NaN is grey. Where the dataset has a
    `spectral_radius` (largest eigenvalue of one step), a red line is the limit of stability.
    """
    figure = Figure(figsize=(COLUMN, 2.9), layout="constrained")
    handles, bar = _Grid(dataset, metric, marks).draw(figure.subplots(), metric, baseline)
    bar.set_label(_label(dataset[metric], metric))
    legend_below(figure, handles, 3)
    if title:
        figure.suptitle(title, fontsize=8.5)
    return figure


@style()
def plot_maps(
    dataset: xr.Dataset, metrics: Sequence[str], marks: Marks | None = None, *,
    baselines: Mapping[str, float] | None = None, columns: int = 2, title: str | None = None,
) -> Figure:  # fmt: skip
    """Draw a sheet of maps, one per metric, with one legend.

    `baselines` are by metric; all other arguments are those of `plot_map`.
    """
    if not metrics:
        raise ValueError("expected at least one metric to draw")
    rows, columns = math.ceil(len(metrics) / columns), min(columns, len(metrics))
    # room for labels by measure: no layout is computed
    width, height = COLUMN * columns, 0.5 + 2.3 * rows
    (left, right, beside), (bottom, top, between) = (0.62, 0.5, 0.55), (0.75, 0.45, 0.35)
    room = {
        "left": left / width, "right": 1 - right / width, "bottom": bottom / height, "top": 1 - top / height,
        "wspace": beside / ((width - left - right - (columns - 1) * beside) / columns),
        "hspace": between / ((height - bottom - top - (rows - 1) * between) / rows),
    }  # fmt: skip
    figure = Figure(figsize=(width, height))
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True, gridspec_kw=room)
    grid, handles = _Grid(dataset, metrics[0], marks), {}
    for metric, panel in zip(metrics, axes.flat, strict=False):
        found, _ = grid.draw(panel, metric, (baselines or {}).get(metric))
        panel.set_title(_label(dataset[metric], metric), y=1.0)  # where it is anyway, without a search for it
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


class _Grid:
    """Walks over two gains, and the layers that all their maps share."""

    def __init__(self, dataset: xr.Dataset, metric: str, marks: Marks | None):
        self.dataset, self.marks = dataset, marks or {}
        self.axes = axes = _axes(dataset, metric)  # horizontal, vertical
        self.limit, self.edges = stability_lines(dataset, *axes), []
        self.torn, self.failed = _torn_off(dataset, *axes), failed_walks(dataset, *axes)
        for gains in (dataset[name].values.astype(float) for name in axes):
            if not (np.isfinite(gains).all() and (gains > 0).all()):
                raise ValueError("a map needs gains above 0: its axes are logarithmic")
            logs = np.log(gains)  # the edges of the cells are half-way between their gains
            half = np.diff(logs) / 2 if logs.size > 1 else np.array([0.5])
            self.edges.append(np.exp([logs[0] - half[0], *(logs[:-1] + half), logs[-1] + half[-1]]))

    def draw(self, panel: Axes, metric: str, baseline: float | None) -> tuple[list[Artist], Colorbar]:
        """Draw the map of a metric with its colour bar; return the handles of its legend, and the bar."""
        if {*self.axes} != {*_axes(self.dataset, metric)}:
            raise ValueError(f"{metric}: expected dimensions {' and '.join(self.axes)}")
        variable, failed, edges = self.dataset[metric], self.failed, self.edges
        values = comparable(self.dataset, metric).transpose(*self.axes[::-1]).values.astype(float)
        known, larger = np.unique(values[np.isfinite(values)]), larger_is_better(variable)
        norm, extend = color_scale(values, failed, baseline, larger)
        colormap = ListedColormap([SAME]) if known.size == 1 else mpl.colormaps["viridis" if larger else "viridis_r"]
        if flags := variable.attrs.get("flag_meanings", "").split():
            codes = np.asarray(variable.attrs["flag_values"], float)
            norm, extend = BoundaryNorm([*(codes - 0.5), codes[-1] + 0.5], len(codes)), "neither"
            colormap = ListedColormap(["0.9", *LIMB_COLORS][: len(flags)])
        panel.set_facecolor(GREY)
        mesh = panel.pcolormesh(
            *edges, np.ma.masked_invalid(values), cmap=colormap, norm=norm, linewidth=0,
            rasterized=values.size > 1e4,
        )  # fmt: skip
        x_label, y_label = (_label(self.dataset[name], name) for name in self.axes)
        panel.set(xscale="log", yscale="log", xlabel=x_label, ylabel=y_label)

        shades = colormap(norm(np.nan_to_num(values, nan=norm.vmin or 0.0)))[..., :3] @ [0.299, 0.587, 0.114]
        empty, handles = np.isnan(values), []
        for name, cells in (("gripper torn off", self.torn), ("diverged", failed & ~self.torn)):
            handles += _hatch(panel, edges, cells, (shades < 0.4) & ~empty, name)
        held = empty & ~failed & (metric == "detached_at")
        if held.any():
            panel.pcolormesh(*edges, np.ma.masked_where(~held, held), cmap=ListedColormap([HELD]), linewidth=0)
            handles.append(Patch(facecolor=HELD, label="held all the way"))
        if (empty & ~held).any():
            handles.append(Patch(facecolor=GREY, label="no value"))
        handles += self._mark(panel)
        bar = panel.figure.colorbar(mesh, ax=panel, extend=extend, fraction=0.05, pad=0.02, aspect=25)
        _name_values(bar, variable, panel, baseline)
        return handles, bar

    def _mark(self, panel: Axes) -> list[Artist]:
        """Draw the marks and the limit of stability; return the handles of their legend."""
        handles: list[Artist] = []
        others = itertools.cycle(_MARKERS)
        for name, (x, y) in self.marks.items():
            marker, size = ("*", 9) if name in _FOUND else (next(others), 6)
            handles += panel.plot(x, y, marker, mfc="white", mec=BLACK, mew=0.9, ms=size, zorder=4, label=name)
        for line in self.limit:
            panel.plot(*line.T, color=RED, linewidth=1.0, zorder=3, gid="stability limit")
        if self.limit:
            handles.append(key("stability limit", color=RED, linewidth=1.0))
        for number, (axis, edges) in enumerate(zip("xy", self.edges, strict=True)):
            places, low, high = [mark[number] for mark in self.marks.values()], edges.min(), edges.max()
            beside = [at / 1.5 for at in places if at < low] + [at * 1.5 for at in places if at > high]
            panel.set(**{f"{axis}lim": (min([low, *beside]), max([high, *beside]))})  # a mark beside the grid too
        return handles


def _name_values(bar: Colorbar, variable: xr.DataArray, panel: Axes, baseline: float | None) -> None:
    """Name values on a colour bar, and the baseline, or, where all cells are equal, the one value on the map.

    The baseline is a red line, with an arrow at the end beyond which it lies.
    """
    known: np.ndarray = np.unique(np.ma.asarray(bar.mappable.get_array()).compressed())
    low, high = np.asarray(bar.mappable.get_clim(), float)
    if flags := variable.attrs.get("flag_meanings", "").split():
        bar.set_ticks(np.asarray(variable.attrs["flag_values"], float).tolist(), labels=flags)
        bar.ax.minorticks_off()
        return
    if known.size == 1:
        bar.set_ticks([])
        panel.text(0.5, 0.5, f"all cells: {known[0]:.4g}", transform=panel.transAxes, ha="center", gid="constant")
        return
    if isinstance(bar.norm, LogNorm) and high < 1e3 * low:  # so few decades want ticks between them
        bar.locator = LogLocator(subs=(1, 2, 5))
        bar.formatter = LogFormatterSciNotation(minor_thresholds=(math.inf, math.inf))
        bar.minorformatter = NullFormatter()
        bar.update_ticks()
    if baseline is not None:
        arrow = " \N{UPWARDS ARROW}" if baseline > high else " \N{DOWNWARDS ARROW}" if baseline < low else ""
        place = min(max(float(baseline), low), high)
        bar.ax.axhline(place, color=RED, linewidth=1.4, gid="baseline")
        bar.ax.annotate(
            f"pd{arrow}", (0, place), xycoords=bar.ax.get_yaxis_transform(), xytext=(-2, 0),
            textcoords="offset points", ha="right", va="center", fontsize=6.5, color=RED,
            bbox={"facecolor": "white", "linewidth": 0, "pad": 0.6}, zorder=6,
        )  # fmt: skip


def _hatch(panel: Axes, edges: Sequence[np.ndarray], cells: np.ndarray, dark: np.ndarray, name: str) -> list[Artist]:
    """Hatch cells (y, x), in light lines where they are dark, and return the handle of the legend if there are any."""
    if not cells.any():
        return []
    x, y = edges
    for part, color in ((cells & ~dark, "0.15"), (cells & dark, "0.85")):
        if part.any():  # one shape, of all cells that lie side by side: each would be hatched by itself
            steps = np.diff(np.pad(part.astype(int), ((0, 0), (1, 1))), axis=1)
            (rows, starts), (_, ends) = np.nonzero(steps == 1), np.nonzero(steps == -1)
            corners = [(x[starts], y[rows]), (x[ends], y[rows]), (x[ends], y[rows + 1]), (x[starts], y[rows + 1])]
            path = Path.make_compound_path_from_polys(np.moveaxis(np.array([*corners, corners[0]]), -1, 0))
            panel.add_artist(
                PathPatch(path, facecolor="none", edgecolor=color, hatch=_HATCHES[name], linewidth=0, gid=name)
            )
    return [Patch(facecolor="white", edgecolor="0.15", hatch=_HATCHES[name], linewidth=0, label=name)]


def stability_lines(dataset: xr.Dataset, x: str = "stiffness", y: str = "damping") -> list[np.ndarray]:
    """Return the limit of stability over two gains, lines of points (N, 2): where the `spectral_radius` passes 1.

    None where the dataset has no such variable, or all is on one side; rows and columns without values are left out.
    """
    if "spectral_radius" not in dataset:
        return []
    radius = dataset["spectral_radius"].transpose(y, x).dropna(x, how="all").dropna(y, how="all")
    excess = np.clip((radius.values - 1) * 1e3, -1, 1)  # beyond the limit it grows without bounds
    if min(excess.shape) < 2 or not (excess > 0).any() or not (excess <= 0).any():
        return []
    lines = Figure().subplots().contour(np.log(radius[x]), np.log(radius[y]), excess, [0.0]).allsegs[0]
    return [np.exp(line) for line in lines if len(line) > 1]


def comparable(dataset: xr.Dataset, metric: str) -> xr.DataArray:
    """Return a metric of walks, NaN for those that diverged: their values until then compare with no other's."""
    variable = dataset[metric]
    if "diverged" not in dataset or metric in FAILURES or "larger_is_better" not in variable.attrs:
        return variable
    return variable.where(~dataset["diverged"].astype(bool))


def _axes(dataset: xr.Dataset, metric: str) -> tuple[str, str]:
    """Return the two dimensions of a metric, which must be there and have two."""
    if metric not in dataset:
        raise ValueError(f"{metric}: expected one of {', '.join(map(str, dataset.data_vars))}")
    dims = [str(name) for name in dataset[metric].dims]
    if len(dims) != 2:
        raise ValueError(f"{metric}: expected two dimensions, got {', '.join(dims)}")
    return dims[0], dims[1]


def _torn_off(dataset: xr.Dataset, x: str, y: str) -> np.ndarray:
    """Return which walks lost a gripper, (y, x), be it that they diverged later."""
    torn = np.zeros((dataset.sizes[y], dataset.sizes[x]), bool)
    if "detached_at" in dataset:
        torn |= np.isfinite(dataset["detached_at"].transpose(y, x).values)
    if "detached_limb" in dataset:
        torn |= dataset["detached_limb"].transpose(y, x).values >= 0
    return torn


def failed_walks(dataset: xr.Dataset, x: str, y: str) -> np.ndarray:
    """Return which walks failed, (y, x): a gripper was torn off, or the state stopped being finite."""
    failed = _torn_off(dataset, x, y)
    if "diverged" in dataset:
        failed |= dataset["diverged"].transpose(y, x).values.astype(bool)
    return failed


def color_scale(
    values: np.ndarray, failed: np.ndarray, baseline: float | None, larger_is_better: bool = False
) -> tuple[Normalize, str]:
    """Return a scale from the 2nd to the 98th percentile, and which ends of it are passed.

    It is of the walks that held (of all, where fewer than four did), takes in a baseline that is near, goes beyond it
    to the worse side at most three times as far as to the better one, spans 5 % of its values at least, and is
    logarithmic where it spans more than a factor of 30.
    """
    finite, held = values[np.isfinite(values)], values[np.isfinite(values) & ~failed]
    if finite.size == 0:
        return Normalize(0, 1), "neither"
    low, high = np.percentile(held if held.size >= 4 else finite, [2, 98])
    if baseline is not None and np.isfinite(baseline):
        reach = 0.5 * (high - low)
        low = min(low, baseline) if baseline > low - reach else low
        high = max(high, baseline) if baseline < high + reach else high
        if low < baseline < high and larger_is_better:  # one half of the colours is better, the other worse
            low = max(low, baseline - 3 * (high - baseline))
        elif low < baseline < high:
            high = min(high, baseline + 3 * (baseline - low))
    room = (_LEAST_SPAN * (max(abs(low), abs(high)) or 1.0) - (high - low)) / 2
    if room > 0:  # else a change that does not matter would use all colours
        low, high = low - room, high + room
    below, above = finite.min() < low - 1e-9 * abs(low), finite.max() > high + 1e-9 * abs(high)
    extend = (("neither", "max"), ("min", "both"))[int(below)][int(above)]
    return (LogNorm if low > 0 and high > 30 * low else Normalize)(low, high), extend


def _label(variable: xr.DataArray, name: str) -> str:
    """Return "long name [unit]"; numbers without a unit stand alone."""
    unit = variable.attrs.get("units", "1")
    text = variable.attrs.get("long_name", name.replace("_", " "))
    return text if unit in ("1", "") else f"{text} [{unit.replace('^2', '$^2$')}]"
