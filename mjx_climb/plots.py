"""Pictures of walks and of sweeps, for a column of a paper; colour-blind safe, SI units on every axis."""

import functools
import io
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

from mjx_climb.files.dataset import AXES, JOINTS, larger_is_better, write_bytes_atomically
from mjx_climb.rollouts.trajectory import Trajectory
from mjx_climb.scenario.model import HeightMap
from mjx_climb.walk.metrics import FAILURES

COLUMN = 3.5  # inch, width of a column

# Okabe & Ito, "Color Universal Design", 2008
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
LIMB_COLORS = (BLUE, ORANGE, GREEN, PURPLE)
AXIS_COLORS = (VERMILLION, SKY, BLACK)
# colour and width: the baseline is a broad band, so that what runs on top of it does not hide it
SERIES = (("0.65", 1.8), (VERMILLION, 0.8), (BLUE, 0.8), (GREEN, 0.8), (ORANGE, 0.8), (PURPLE, 0.8))
RED = "#D00000"  # what must not be passed: a torn gripper, on maps the baseline and the limit of stability
CARGO, PUSH = "#F6F0E1", "#DCE9F4"
GREY = "#BDBDBD"


_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 7.5,
    "axes.labelsize": 7.5,
    "axes.titlesize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "lines.linewidth": 0.8,
    "axes.titlelocation": "left",
    "hatch.linewidth": 0.6,
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": True,
    "svg.hashsalt": "mjx_climb",
    "pdf.fonttype": 42,  # TrueType: publishers refuse Type 3
}


_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def style() -> AbstractContextManager[None]:
    """Return a context in which matplotlib draws in this module's style: `with plots.style(): ...`."""
    return mpl.rc_context(_STYLE)


def _styled(draw: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Run a drawing function in this module's style and leave matplotlib's own as it was."""

    @functools.wraps(draw)
    def styled(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with style():
            return draw(*args, **kwargs)

    return styled


@_styled
def save_figure(figure: Figure, path_stem: str | os.PathLike[str], *, dpi: int = 300) -> tuple[Path, Path, Path]:
    """Write a figure to `path_stem`.png, .svg and .pdf and return the paths.

    Raises:
        OutputError: a file cannot be written.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine(None)  # it is laid out now; each format would do it again, and draw twice
    paths = []
    for kind, metadata in (("png", None), ("svg", {"Date": None}), ("pdf", {"CreationDate": None})):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=metadata)
        paths.append(write_bytes_atomically(f"{os.fspath(path_stem)}.{kind}", buffer.getvalue()))
    return paths[0], paths[1], paths[2]


# ------------------------------------------------------------------------------------------------------------
# Lines over time


def thin(time: np.ndarray, values: np.ndarray, points: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Return about `points` samples of a line that look like all of it: both extremes of every stretch."""
    if time.size <= points:
        return time, values
    size = math.ceil(2 * time.size / points)
    fill = -time.size % size
    rows = np.arange(time.size + fill).clip(max=time.size - 1).reshape(-1, size)
    stretches = values[rows]
    low = np.where(np.isfinite(stretches), stretches, np.inf).argmin(1)
    high = np.where(np.isfinite(stretches), stretches, -np.inf).argmax(1)
    first = np.arange(len(rows))
    kept = np.unique(np.concatenate([[0, time.size - 1], rows[first, low], rows[first, high]]))
    return time[kept], values[kept]


def _whole(trajectory: Trajectory) -> int:
    """Return how many rows there are before the state stops being finite."""
    finite = np.isfinite(trajectory.base_position).all(1) & np.isfinite(trajectory.joint_rates).all((1, 2))
    finite &= np.isfinite(trajectory.foot_force).all((1, 2))
    return int(finite.size if finite.all() else finite.argmin())


def _draw(axes: Axes, trajectory: Trajectory, values: np.ndarray, **style: Any) -> None:
    """Draw one line over time, up to where the state stopped being finite.

    What comes after a failure may be thousands of times larger: the axes reach at most two spans beyond what
    was before.
    """
    rows = _whole(trajectory)
    if not rows:
        return
    time, drawn = thin(trajectory.time[:rows], values[:rows])
    before = drawn[(time <= _failure_time(trajectory)) & np.isfinite(drawn)]
    if not before.size:  # a margin that is not defined, as the TSM without gravity
        return
    low, high = before.min(), before.max()
    low, high = max(np.nanmin(drawn), 3 * low - 2 * high), min(np.nanmax(drawn), 3 * high - 2 * low)
    # unlike plot, add_artist leaves the limits alone
    axes.add_artist(Line2D(time, drawn, solid_joinstyle="round", **style))
    axes.update_datalim([(time[0], low), (time[-1], high)])
    axes.autoscale_view(scalex=False)


def _failure_time(trajectory: Trajectory) -> float:
    """Return when a gripper was torn off or, failing that, the state grew without bound, s; else infinity."""
    rows = _whole(trajectory)
    if torn := detachments(trajectory):
        return torn[0][0]
    # a state that overflows has grown from step to step for a while before
    return math.inf if rows == trajectory.time.size else 0.5 * float(trajectory.time[rows])


def largest_foot_force(trajectory: Trajectory) -> np.ndarray:
    """Return the largest foot force over time, (T,) N."""
    return np.asarray(_norm(trajectory.foot_force).max(1))


def _norm(vectors: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):  # a walk that diverges
        return np.asarray(np.linalg.norm(vectors, axis=-1))


def detachments(trajectory: Trajectory) -> list[tuple[float, str]]:
    """Return when (s) and which limbs were torn off, in order of time."""
    torn = trajectory.torn_off & ~trajectory.detached
    rows, limbs = np.nonzero(torn[: _whole(trajectory)])
    return [(float(trajectory.time[row]), trajectory.limbs[limb]) for row, limb in zip(rows, limbs, strict=True)]


def _grip_changes(trajectory: Trajectory) -> np.ndarray:
    """Return the times at which a gripper opens or shuts, s; not those at which it is torn off."""
    support = trajectory.support | trajectory.detached | trajectory.torn_off
    return np.asarray(trajectory.time[1:][(support[1:] != support[:-1]).any(1)])


def _windows(trajectory: Trajectory) -> list[tuple[float, float, str, str]]:
    """Return the disturbances as (start s, stop s, label, colour)."""
    disturbance, end = trajectory.scenario.disturbance, _end(trajectory)
    windows: list[tuple[float, float | None, str, str]] = []
    if disturbance.cargo.mass > 0:
        cargo = disturbance.cargo
        windows.append((cargo.start, cargo.stop, f"cargo {cargo.mass:g} kg", CARGO))
    for push in disturbance.pushes:
        parts = [_component(push.force, "N"), _component(push.moment, "N m")]
        windows.append((push.start, push.stop, ", ".join(filter(None, parts)) or "push", PUSH))
    cut = [(start, end if stop is None else min(stop, end), label, color) for start, stop, label, color in windows]
    return [window for window in cut if window[0] < window[1]]


def _component(vector: Sequence[float], unit: str) -> str:
    """Return a vector in few characters: its component along an axis, or its length."""
    used = [axis for axis in range(3) if vector[axis]]
    if not used:
        return ""
    if len(used) == 1:
        return f"{vector[used[0]]:+g} {unit} {AXES[used[0]]}".replace("-", "\N{MINUS SIGN}")
    return f"{math.hypot(*vector):.3g} {unit}"


def _end(trajectory: Trajectory) -> float:
    """Return where the time axis ends, s: with the walk, or soon after it diverged."""
    end = float(trajectory.time[-1]) + trajectory.scenario.time_step
    rows = _whole(trajectory)
    return end if rows == trajectory.time.size else min(end, 1.1 * float(trajectory.time[rows]))


def _panels(heights: Sequence[float], end: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a tall figure of panels over one time axis that runs to `end`."""
    layout = ConstrainedLayoutEngine(h_pad=0.02, w_pad=0.02, hspace=0.0)
    figure = Figure(figsize=(COLUMN, height), layout=layout)
    axes = list(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))
    axes[0].set_xlim(0, end)
    axes[-1].set_xlabel("time [s]")
    for panel in axes:
        panel.grid(axis="y", color="0.9", linewidth=0.4)
        panel.set_axisbelow(True)
        panel.locator_params(axis="y", nbins=4)
    figure.align_ylabels(axes)
    return figure, axes


def _mark_events(axes: Sequence[Axes], trajectory: Trajectory) -> None:
    """Shade disturbances and mark changes of grip in every panel; name the disturbances above the first."""
    changes = _grip_changes(trajectory)
    for start, stop, label, color in _windows(trajectory):
        for panel in axes:
            panel.axvspan(start, stop, color=color, linewidth=0, zorder=0, gid="disturbance")
        place: dict[str, Any] = {"xy": ((start + stop) / 2, 1), "xycoords": axes[0].get_xaxis_transform()}
        text = axes[0].annotate(
            label, **place, xytext=(0, 2), textcoords="offset points", ha="center", va="bottom", fontsize=6.5
        )
        text.set_gid("disturbance label")
    for panel in axes:
        for change in changes:
            panel.axvline(change, color="0.7", linewidth=0.4, linestyle=(0, (4, 2)), zorder=0.5, gid="grip change")


def _mark_failure(
    axes: Sequence[Axes],
    trajectory: Trajectory,
    lines: Sequence[np.ndarray],
    color: str = RED,
    level: int = 0,
) -> bool:
    """Mark the first torn gripper by a red cross on the line (T,) of every panel.

    What failed when stands in the first panel, `level` lines below its top. False where nothing failed.
    """
    instants, words = [], []
    if torn := detachments(trajectory):
        instant, limb = torn[0]
        row = int(np.searchsorted(trajectory.time, instant))
        for panel, values in zip(axes, lines, strict=True):
            panel.axvline(instant, color=RED, linewidth=0.5, zorder=1.5)
            _cross(panel, instant, values[row])
        instants.append(instant)
        words.append(f"{limb} torn off, {instant:.2f} s")
    if (rows := _whole(trajectory)) < trajectory.time.size:
        instants.append(float(trajectory.time[rows]))
        words.append(f"diverged, {instants[-1]:.2f} s")
    if not words:
        return False
    late = instants[0] > 0.5 * axes[0].get_xlim()[1]
    axes[0].annotate(
        "\n".join(words),
        (instants[0], 1),
        xycoords=axes[0].get_xaxis_transform(),
        xytext=(-4 if late else 4, -3 - 17 * level),
        textcoords="offset points",
        ha="right" if late else "left",
        va="top",
        color=color,
        fontsize=6.5,
        bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 0.8},
        zorder=6,
        gid="failure",
    )
    return True


def _cross(panel: Axes, x: float, y: float) -> None:
    panel.plot([x], [y], "x", color=RED, markersize=5, markeredgewidth=1.3, zorder=5, clip_on=False, gid="detachment")


def _shade_divergence(axes: Sequence[Axes], trajectory: Trajectory) -> None:
    """Grey out the time in which there is no state any more."""
    if (rows := _whole(trajectory)) < trajectory.time.size:
        for panel in axes:
            panel.axvspan(trajectory.time[rows], _end(trajectory), color=GREY, linewidth=0, zorder=0.2, gid="diverged")


def _gait_diagram(panel: Axes, trajectory: Trajectory) -> None:
    """Draw per limb when its gripper is shut and holds, and a red cross where it is torn off."""
    end = _end(trajectory)
    support = trajectory.support[: _whole(trajectory)]
    panel.grid(False)
    for number, color in enumerate(_limb_colors(trajectory)):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], support[:, number], [False]]).astype(int)))
        time = np.append(trajectory.time, end)
        bars = [(time[a], time[b] - time[a]) for a, b in edges.reshape(-1, 2)]
        panel.broken_barh(bars, (number - 0.35, 0.7), facecolors=color, linewidth=0, gid="support")
    for instant, limb in detachments(trajectory):
        _cross(panel, instant, trajectory.limbs.index(limb))
    panel.set_yticks(range(len(trajectory.limbs)), trajectory.limbs)
    panel.set_ylim(len(trajectory.limbs) - 0.5, -0.5)
    panel.tick_params(axis="y", length=0)
    panel.set_ylabel("support")


def _limb_colors(trajectory: Trajectory) -> list[str]:
    return [LIMB_COLORS[number % len(LIMB_COLORS)] for number in range(len(trajectory.limbs))]


def _legend(figure: Figure, handles: Sequence[Artist], title: str | None = None) -> None:
    """Put a legend, and a title over it, above the panels, with as many columns as fit."""
    width = 0.055 * max(len(str(handle.get_label())) for handle in handles) + 0.35  # inch
    figure.legend(
        handles=handles,
        title=title,
        title_fontsize=8.5,
        loc="outside upper center",
        ncols=min(len(handles), max(1, int(COLUMN / width))),
        handlelength=1.4,
        columnspacing=1.0,
        handletextpad=0.4,
        borderaxespad=0.2,
    )


def _axes_legend(panel: Axes, names: Sequence[str], colors: Sequence[str], extra: Sequence[Line2D] = ()) -> None:
    handles = [Line2D([], [], color=color, label=name) for name, color in zip(names, colors, strict=True)]
    panel.legend(
        handles=[*handles, *extra],
        loc="upper left",
        ncols=4,
        handlelength=1.0,
        columnspacing=0.7,
        handletextpad=0.3,
        borderaxespad=0.1,
        fontsize=6.5,
    )


def _headroom(panel: Axes, share: float = 0.3) -> None:
    """Leave room above the lines for a legend."""
    low, high = panel.get_ylim()
    panel.set_ylim(low, high + share * (high - low))


@_styled
def plot_walk(trajectory: Trajectory) -> Figure:
    """Draw one walk over time: forces, torques, base, margins and support, on one time axis.

    Disturbances are shaded and named, changes of grip are thin vertical lines, and the first torn
    gripper is a red cross.
    """
    shifted = bool(np.any(trajectory.base_displacement))
    names = [
        "force",
        *JOINTS,
        "base",
        "error",
        *(["shift", "turn"] if shifted else []),
        "tsm",
        "gia",
        "support",
    ]
    heights = {"force": 1.4, "base": 1.2, "support": 0.9}
    figure, axes = _panels([heights.get(name, 1.0) for name in names], _end(trajectory), 0.5 + 0.77 * len(names))
    panels = dict(zip(names, axes, strict=True))
    lines = {}  # per panel, the line that carries the mark of a detachment

    lines["force"] = largest_foot_force(trajectory)
    _draw(panels["force"], trajectory, lines["force"], color=BLACK)
    panels["force"].set_ylim(bottom=0)
    _mark_holding_limit(panels["force"], trajectory.scenario.contact.holding_limit)
    panels["force"].set_ylabel("largest foot\nforce [N]")

    for number, joint in enumerate(JOINTS):
        for limb, color in enumerate(_limb_colors(trajectory)):
            _draw(
                panels[joint],
                trajectory,
                trajectory.joint_torque[:, limb, number],
                color=color,
                linewidth=0.6,
            )
        lines[joint] = _furthest(trajectory.joint_torque[:, :, number])
        panels[joint].set_ylabel(f"{joint} $\\tau$\n[N m]")

    start = trajectory.base_reference[0]
    for axis, color in enumerate(AXIS_COLORS):
        position, reference = trajectory.base_position[:, axis], trajectory.base_reference[:, axis]
        _draw(panels["base"], trajectory, 1e3 * (position - start[axis]), color=color)
        _draw(panels["base"], trajectory, 1e3 * (reference - start[axis]), color=color, linestyle=(0, (2, 1.5)))
        _draw(panels["error"], trajectory, 1e3 * (position - reference), color=color)
    dashed = Line2D([], [], color="0.3", linestyle=(0, (2, 1.5)), label="reference")
    _axes_legend(panels["base"], AXES, AXIS_COLORS, [dashed])
    lines["base"] = 1e3 * (trajectory.base_position[:, 0] - start[0])
    lines["error"] = 1e3 * _furthest(trajectory.base_position - trajectory.base_reference)
    panels["base"].set_ylabel("base\n[mm]")
    panels["error"].set_ylabel("base off\nref. [mm]")
    _headroom(panels["base"])

    if shifted:
        for name, first, text in (
            ("shift", 0, "shift $\\Delta x$\n[mm]"),
            ("turn", 3, "turn $\\Delta x$\n[mrad]"),
        ):
            for axis, color in enumerate(AXIS_COLORS):
                _draw(panels[name], trajectory, 1e3 * trajectory.base_displacement[:, first + axis], color=color)
            lines[name] = 1e3 * _furthest(trajectory.base_displacement[:, first : first + 3])
            panels[name].set_ylabel(text)

    for name, values, text in (
        ("tsm", trajectory.tsm, "TSM [m]"),
        ("gia", trajectory.gia_margin, "GIA margin\n[m/s$^2$]"),
    ):
        _draw(panels[name], trajectory, values, color=BLACK)
        lines[name] = values
        panels[name].set_ylim(bottom=0)
        panels[name].set_ylabel(text)

    _gait_diagram(panels["support"], trajectory)
    _mark_events(axes, trajectory)
    _shade_divergence(axes, trajectory)
    _mark_failure(axes[:-1], trajectory, [lines[name] for name in names[:-1]])
    limbs = zip(trajectory.limbs, _limb_colors(trajectory), strict=True)
    _legend(figure, [Line2D([], [], color=color, label=limb, linewidth=1.2) for limb, color in limbs])
    return figure


def _mark_holding_limit(panel: Axes, limit: float | None) -> None:
    """Draw the holding limit where it is within reach of the forces, else say where it is."""
    if limit is None:
        return
    near = limit < 2.5 * panel.get_ylim()[1]
    if near:
        panel.axhline(limit, color=BLACK, linestyle=":", linewidth=0.8)
        panel.set_ylim(top=max(panel.get_ylim()[1], 1.08 * limit))
    else:
        _headroom(panel, 0.2)
    panel.annotate(
        "holding limit" if near else f"holding limit {limit:g} N \N{UPWARDS ARROW}",
        (1, limit if near else panel.get_ylim()[1]),
        xycoords=panel.get_yaxis_transform(),
        xytext=(-2, -2),
        textcoords="offset points",
        ha="right",
        va="top",
        fontsize=6.5,
        gid="holding limit",
    )


def _furthest(values: np.ndarray) -> np.ndarray:
    """Return per row the value furthest from zero."""
    index = np.abs(np.nan_to_num(values)).argmax(1)
    return np.take_along_axis(values, index[:, None], 1)[:, 0]


@_styled
def plot_feet(trajectory: Trajectory) -> Figure:
    """Draw the way of feet and base from the side and from above, with the ground: its footholds and its height map.

    Bars and rings are the footholds that the gait plans; a red cross is where a gripper was torn off, and soon after
    that the picture ends.
    """
    from mjx_climb.quantities.ground import foothold_heights, footholds

    scenario, time = trajectory.scenario, trajectory.time
    rows = min(_whole(trajectory), int(np.searchsorted(time, _failure_time(trajectory) + 0.1)))
    heading = scenario.gait.heading
    turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    start = trajectory.base_reference[0, :2]

    def along(points: np.ndarray) -> np.ndarray:
        """Return points (..., 2 or 3) m as mm ahead, to the left and above, from where the base starts."""
        return 1e3 * np.concatenate([(points[..., :2] - start) @ turn, points[..., 2:]], axis=-1)

    planned, heights = footholds(scenario), foothold_heights(scenario)
    if heights.shape[1] < planned.shape[1]:
        last = heights[:, -1:] if heights.size else np.zeros((len(planned), 1))
        heights = np.concatenate([heights, np.repeat(last, planned.shape[1] - heights.shape[1], 1)], 1)
    planned = along(np.concatenate([planned, heights[:, : planned.shape[1], None]], -1))
    feet, base = along(trajectory.foot_position[:rows]), along(trajectory.base_position[:rows])

    layout = ConstrainedLayoutEngine(h_pad=0.02, w_pad=0.02, hspace=0.03)
    low, high = planned.min((0, 1)) - 50, planned.max((0, 1)) + 50
    width = COLUMN - (1.3 if scenario.ground.map is not None else 0.6)  # inch, of a panel
    tall = width * (high[1] - low[1]) / (high[0] - low[0])
    figure = Figure(figsize=(COLUMN, 2.2 + tall), layout=layout)
    side, above = figure.subplots(2, 1, sharex=True, height_ratios=[1.3, tall])
    if scenario.ground.map is not None:
        _draw_relief(figure, above, scenario.ground.map, along)
    side.axhline(0, color=GREY, linewidth=0.6, zorder=0.5)
    for limb, color in enumerate(_limb_colors(trajectory)):
        path = feet[:: max(rows // 1500, 1), limb]
        far = trajectory.limbs[limb].startswith("R")  # in line with a left one
        side.plot(path[:, 0], path[:, 2], color=color, linestyle=(0, (3, 1.5)) if far else "-", zorder=3)
        above.plot(path[:, 0], path[:, 1], color=color, zorder=3)
        for ahead, _, height in planned[limb]:
            side.plot([ahead - 12, ahead + 12], [height] * 2, color=color, linewidth=2.5, alpha=0.45, gid="foothold")
        rings: dict[str, Any] = {"marker": "o", "markersize": 7, "linestyle": "none", "markerfacecolor": "none"}
        above.plot(*planned[limb, :, :2].T, markeredgecolor=color, **rings, gid="foothold")
    for panel, axis in ((side, 2), (above, 1)):
        panel.plot(base[:, 0], base[:, axis], color=BLACK, linewidth=0.8, zorder=3)
        for instant, name in detachments(trajectory):
            if (row := int(np.searchsorted(time, instant))) < rows:
                torn = feet[row, trajectory.limbs.index(name)]
                _cross(panel, torn[0], torn[axis])
        panel.grid(color="0.9", linewidth=0.4)
        panel.set_axisbelow(True)
    if lost := detachments(trajectory)[:1]:
        words = f"{lost[0][1]} torn off, {lost[0][0]:.2f} s"
        side.annotate(words, (0.02, 0.95), xycoords="axes fraction", va="top", color=RED, fontsize=6.5, gid="failure")
    # a robot that falls leaves the picture
    top = 1e3 * (trajectory.base_reference[:, 2].max() + scenario.gait.step_height)
    side.set_ylim(planned[..., 2].min() - 0.1 * top, top)
    above.set_xlim(low[0], high[0])
    above.set_ylim(low[1], high[1])
    above.set_aspect("equal", adjustable="box")
    side.set_ylabel("height [mm]")
    above.set_ylabel("to the left [mm]")
    above.set_xlabel("ahead [mm]")
    limbs = [*zip(trajectory.limbs, _limb_colors(trajectory), strict=True), ("base", BLACK)]
    _legend(figure, [Line2D([], [], color=color, label=name, linewidth=1.2) for name, color in limbs])
    return figure


def _draw_relief(figure: Figure, panel: Axes, ground: HeightMap, along: Callable[[np.ndarray], np.ndarray]) -> None:
    """Draw a height map from above, with a colour bar."""
    from mjx_climb.quantities.ground import relief

    x, y, heights = relief(ground)
    corners = along(np.stack(np.meshgrid(x, y), -1))
    mesh = panel.pcolormesh(
        corners[..., 0], corners[..., 1], 1e3 * heights, cmap="Greys_r", shading="gouraud", rasterized=True, zorder=0,
        gid="relief",
    )  # fmt: skip
    bar = figure.colorbar(mesh, ax=panel, pad=0.02, aspect=25)
    bar.set_label("ground [mm]")
    bar.outline.set_linewidth(0.6)


@_styled
def plot_comparison(
    trajectories: Mapping[str, Trajectory], title: str | None = None, *, per_limb: bool = False
) -> Figure:
    """Draw several walks over one another, as the paper does for the baseline and the proposed controller.

    Arguments:
        trajectories: walks by their name in the legend, the baseline first; grip changes and disturbances are
            the baseline's.
        title: above the figure.
        per_limb: adds a panel per limb with its largest joint torque.
    """
    if not trajectories:
        raise ValueError("expected at least one walk to compare")
    first = next(iter(trajectories.values()))
    names = ["force", "torque", *(first.limbs if per_limb else []), "tsm", "gia", "deviation"]
    labels = {
        "force": "largest foot\nforce [N]",
        "torque": "largest joint\ntorque [N m]",
        "tsm": "TSM [m]",
        "gia": "GIA margin\n[m/s$^2$]",
        "deviation": "base off its\nreference [mm]",
        **{limb: f"{limb} largest\ntorque [N m]" for limb in first.limbs},
    }
    end = max(_end(trajectory) for trajectory in trajectories.values())
    figure, axes = _panels([1.2 if name == "force" else 1.0 for name in names], end, 0.7 + 0.95 * len(names))
    level, handles = 0, []
    for number, (name, trajectory) in enumerate(trajectories.items()):
        color, width = SERIES[number % len(SERIES)]
        torque = np.abs(trajectory.joint_torque).max(2)
        lines = {
            "force": largest_foot_force(trajectory),
            "torque": torque.max(1),
            "tsm": trajectory.tsm,
            "gia": trajectory.gia_margin,
            "deviation": 1e3 * _norm(trajectory.base_position - trajectory.base_reference),
            **{limb: torque[:, column] for column, limb in enumerate(trajectory.limbs)},
        }
        for panel, key in zip(axes, names, strict=True):
            _draw(panel, trajectory, lines[key], color=color, linewidth=width, zorder=2 + 0.1 * number)
        level += _mark_failure(axes, trajectory, [lines[key] for key in names], "0.3" if number == 0 else color, level)
        handles.append(Line2D([], [], color=color, linewidth=max(1.2, width), label=name))
    for panel, key in zip(axes, names, strict=True):
        panel.set_ylim(bottom=0)
        panel.set_ylabel(labels[key])
    _mark_events(axes, first)
    _legend(figure, handles, title)
    return figure


# ------------------------------------------------------------------------------------------------------------
# Maps over two gains

_MARKERS = ("*", "o", "D", "^", "s", "P", "v")


@_styled
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

    Walks that failed, `detached_at` set or `diverged`, are hatched; what is not a number is grey. Where the dataset has
    a `spectral_radius` (largest eigenvalue of one step), a red line is the limit of stability.
    """
    figure = Figure(figsize=(COLUMN, 2.9), layout="constrained")
    handles, label, bar = _draw_map(
        figure, figure.subplots(), dataset, metric, marks or {}, baseline, baseline_name, x, y
    )
    bar.set_label(label)
    _map_legend(figure, handles, 3)
    if title:
        figure.suptitle(title, fontsize=8.5)
    return figure


@_styled
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
    figure = Figure(figsize=(COLUMN * columns, 0.5 + 2.5 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    handles = {}
    for metric, panel in zip(metrics, axes.flat, strict=False):
        value = (baselines or {}).get(metric)
        found, label, _ = _draw_map(figure, panel, dataset, metric, marks or {}, value, baseline_name, x, y)
        panel.set_title(label)
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
    _map_legend(figure, list(handles.values()), 3 * columns)
    if title:
        figure.suptitle(title, fontsize=8.5)
    return figure


def _map_legend(figure: Figure, handles: Sequence[Artist], columns: int) -> None:
    if handles:
        figure.legend(
            handles=handles, loc="outside lower center", ncols=min(columns, len(handles)), columnspacing=1.2,
            handletextpad=0.5, borderaxespad=0.3,
        )  # fmt: skip


def _draw_map(
    figure: Figure,
    panel: Axes,
    dataset: xr.Dataset,
    metric: str,
    marks: Mapping[str, tuple[float, float]],
    baseline: float | None,
    baseline_name: str,
    x: str,
    y: str,
) -> tuple[list[Artist], str, Colorbar]:
    """Draw one map with its colour bar; return the handles of its legend, what its colours stand for, and the bar."""
    variable = _grid(dataset, metric, x, y)
    failed = _failed(dataset, x, y)
    values = comparable(dataset, metric).transpose(y, x).values.astype(float)
    x_edges, y_edges = (_log_edges(dataset[name].values) for name in (x, y))
    flags = variable.attrs.get("flag_meanings", "").split()
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
        colormap = mpl.colormaps["viridis" if larger else "viridis_r"]
        norm, extend = _robust_norm(values, failed, baseline, larger)
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
        hatched: dict[str, Any] = {"facecolor": "none", "hatch": "/////", "linewidth": 0}
        for chosen, color in ((failed & ~dark, "0.15"), (failed & dark, "0.85")):
            cells = [
                Rectangle((x_edges[i], y_edges[j]), x_edges[i + 1] - x_edges[i], y_edges[j + 1] - y_edges[j])
                for j, i in zip(*np.nonzero(chosen), strict=True)
            ]
            if cells:
                panel.add_collection(
                    PatchCollection(cells, **hatched, edgecolor=color, gid="failed walks"), autolim=False
                )
        handles.append(Patch(**hatched | {"facecolor": "white"}, edgecolor="0.15", label="failed walk"))
    if np.isnan(values).any():
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
    if "spectral_radius" in dataset and _draw_stability_limit(panel, _grid(dataset, "spectral_radius", x, y)):
        handles.append(Line2D([], [], color=RED, linewidth=1.0, label="stability limit"))
    # a mark beside the grid is shown too
    panel.set_xlim(*_span(x_edges, [mark[0] for mark in marks.values()]))
    panel.set_ylim(*_span(y_edges, [mark[1] for mark in marks.values()]))

    bar = figure.colorbar(mesh, ax=panel, extend=extend, pad=0.02, aspect=25)
    bar.outline.set_linewidth(0.6)
    if flags:
        bar.set_ticks(codes.tolist(), labels=flags)
        bar.ax.minorticks_off()
    elif (
        isinstance(norm, LogNorm) and mesh.get_clim()[1] < 1e3 * mesh.get_clim()[0]
    ):  # so few decades want ticks between them
        bar.locator = LogLocator(subs=(1, 2, 5))
        bar.formatter = LogFormatterSciNotation(minor_thresholds=(math.inf, math.inf))
        bar.minorformatter = NullFormatter()
        bar.update_ticks()
    if baseline is not None and not flags:
        _mark_on_bar(bar, float(baseline), baseline_name)
    return handles, _label(variable, metric), bar


def _draw_stability_limit(panel: Axes, radius: xr.DataArray) -> bool:
    """Draw where a radius (y, x) passes 1 and return whether it does; rows and columns without values are left out."""
    y, x = radius.dims
    radius = radius.dropna(x, how="all").dropna(y, how="all")
    excess = np.clip((radius.values - 1) * 1e3, -1, 1)  # beyond the limit it grows without bounds
    if min(excess.shape) < 2 or not (excess > 0).any() or not (excess <= 0).any():
        return False
    panel.contour(radius[x], radius[y], excess, [0.0], colors=[RED], linewidths=1.0, zorder=3)
    return True


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


def _failed(dataset: xr.Dataset, x: str, y: str) -> np.ndarray:
    """Return which walks failed, (y, x): a gripper was torn off, or the state stopped being finite."""
    failed = np.zeros((dataset.sizes[y], dataset.sizes[x]), bool)
    if "detached_at" in dataset:
        failed |= np.isfinite(_grid(dataset, "detached_at", x, y).values)
    if "detached_limb" in dataset:
        failed |= _grid(dataset, "detached_limb", x, y).values >= 0
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


def _robust_norm(
    values: np.ndarray, failed: np.ndarray, baseline: float | None, larger_is_better: bool = False
) -> tuple[Normalize, str]:
    """Return a scale from the 2nd to the 98th percentile, and which ends of it are passed.

    It is of the walks that held (of all, where fewer than four did), takes in a baseline that is near, goes beyond it
    to the worse side at most three times as far as to the better one, and is logarithmic where it spans more than a
    factor of 30.
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
    if low == high:
        low, high = low - 0.5 * abs(low or 1), high + 0.5 * abs(high or 1)
    ends = (finite.min() < low - 1e-9 * abs(low), finite.max() > high + 1e-9 * abs(high))
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[ends]
    return (LogNorm if low > 0 and high > 30 * low else Normalize)(low, high), extend


def _label(variable: xr.DataArray, name: str) -> str:
    """Return "long name [unit]"; numbers without a unit stand alone."""
    unit = variable.attrs.get("units", "1")
    text = variable.attrs.get("long_name", name.replace("_", " "))
    return text if unit in ("1", "") else f"{text} [{unit.replace('^2', '$^2$')}]"
