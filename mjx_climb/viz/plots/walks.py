"""Walks drawn: one with all that it does over time, several over one another, and the way of the feet."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from mjx_climb.files.dataset import AXES
from mjx_climb.ground import holds_of
from mjx_climb.ground.height_map import relief
from mjx_climb.scenario.model import HeightMap
from mjx_climb.terrain import foothold_heights, footholds
from mjx_climb.trajectory import Trajectory
from mjx_climb.viz.plots import events
from mjx_climb.viz.plots.holds import draw_holds
from mjx_climb.viz.plots.styling import AXIS_COLORS, BLACK, COLUMN, GREY, LIMB_COLORS, RED, SERIES, key, legend, style

_SMALL: dict[str, Any] = {"textcoords": "offset points", "fontsize": 6.5}  # words within a panel


class _Panel(NamedTuple):
    """One quantity of a walk over time, for one panel."""

    label: str
    lines: np.ndarray  # (T, N), or (T,) of a length or a margin: then the axis begins at zero
    colors: Sequence[str] = (BLACK,)
    height: float = 1.0
    width: float = 0.8  # of lines, points


@style()
def plot_walk(trajectory: Trajectory) -> Figure:
    """Draw one walk over time: forces, torques, base, margins and support, on one time axis.

    Disturbances are shaded and named, changes of grip are thin vertical lines, and the first torn gripper is a red
    cross. A panel whose quantity the walk does not have is left out: the TSM without gravity, the shift of the base
    without a law that shifts it.
    """
    limbs, shift = limb_colors(trajectory), 1e3 * trajectory.base_displacement[:, :3]
    shift = shift if shift.any() else np.full_like(shift, np.nan)
    every = [
        _Panel("largest foot\nforce [N]", events.largest_foot_force(trajectory), height=1.4),
        _Panel("largest joint\ntorque [N m]", np.abs(trajectory.joint_torque).max(2), limbs, width=0.6),
        _Panel("base off\nref. [mm]", 1e3 * (trajectory.base_position - trajectory.base_reference), AXIS_COLORS),
        _Panel("shift $\\Delta x$\n[mm]", shift, AXIS_COLORS),
        _Panel("TSM [m]", trajectory.tsm),
        _Panel("GIA margin\n[m/s$^2$]", trajectory.gia_margin),
    ]
    panels = every[:3] + _of_any_walk([every[3:]])[0]
    heights = [*(panel.height for panel in panels), 0.9]
    figure, axes = _over_time(heights, events.end_of(trajectory), 0.5 + 0.77 * len(heights))
    _draw_lines(axes, trajectory, panels)
    of_base = axes[2]
    of_base.legend(
        handles=[key(name, color=color) for name, color in zip(AXES, AXIS_COLORS, strict=True)], loc="upper left",
        ncols=3, handlelength=1.0, columnspacing=0.7, handletextpad=0.3, borderaxespad=0.1, fontsize=6.5,
    )  # fmt: skip
    low, high = of_base.get_ylim()
    of_base.set_ylim(low, high + 0.3 * (high - low))
    _mark_holding_limit(axes[0], trajectory.scenario.value("contact.holding_limit"))
    _draw_gait(axes[-1], trajectory)
    _mark_events(axes, trajectory)
    if (rows := events.finite_rows(trajectory)) < trajectory.time.size:  # there is no state any more
        gone = trajectory.time[rows], events.end_of(trajectory)
        for place in axes:
            place.axvspan(*gone, color=GREY, linewidth=0, zorder=0.2, gid="diverged")
    _mark_failure(axes, trajectory, panels)
    legend(figure, [key(name, color=color, linewidth=1.2) for name, color in zip(trajectory.limbs, limbs, strict=True)])
    return figure


@style()
def plot_comparison(
    trajectories: Mapping[str, Trajectory], title: str | None = None, *, per_limb: bool = False
) -> Figure:
    """Draw several walks over one another, as the paper does for the baseline and the proposed controller.

    A panel whose quantity no walk has, as the TSM without gravity, is left out.

    Arguments:
        trajectories: walks by their name in the legend, the baseline first; grip changes and disturbances are
            the baseline's.
        title: above the figure.
        per_limb: adds a panel per limb with its largest joint torque.
    """
    if not trajectories:
        raise ValueError("expected at least one walk to compare")
    first, *_ = trajectories.values()
    panels = _of_any_walk([_compared(walk, per_limb=per_limb) for walk in trajectories.values()])
    heights = [panel.height for panel in panels[0]]
    figure, axes = _over_time(heights, max(map(events.end_of, trajectories.values())), 0.7 + 0.95 * len(heights))
    level, handles = 0, []
    for number, ((name, walk), own) in enumerate(zip(trajectories.items(), panels, strict=True)):
        color, width = SERIES[number % len(SERIES)]
        _draw_lines(axes, walk, own, color=color, linewidth=width, zorder=2 + 0.1 * number)
        level += _mark_failure(axes, walk, own, color if number else "0.3", level)
        handles.append(key(name, color=color, linewidth=max(1.2, width)))
    _mark_events(axes, first)
    legend(figure, handles, title)
    return figure


def _compared(walk: Trajectory, *, per_limb: bool) -> list[_Panel]:
    """Return the panels of a comparison, for one walk."""
    torque = np.abs(walk.joint_torque).max(2)
    of_limbs = [_Panel(f"{limb} largest\ntorque [N m]", torque[:, i]) for i, limb in enumerate(walk.limbs) if per_limb]
    return [
        _Panel("largest foot\nforce [N]", events.largest_foot_force(walk), height=1.2),
        _Panel("largest joint\ntorque [N m]", torque.max(1)),
        *of_limbs,
        _Panel("TSM [m]", walk.tsm),
        _Panel("GIA margin\n[m/s$^2$]", walk.gia_margin),
        _Panel("base off its\nreference [mm]", 1e3 * events.lengths(walk.base_position - walk.base_reference)),
    ]


def _of_any_walk(walks: Sequence[Sequence[_Panel]]) -> list[list[_Panel]]:
    """The panels of walks, without quantities that no walk has; all of walks that have none."""
    known = [any(np.isfinite(panel.lines).any() for panel in alike) for alike in zip(*walks, strict=True)]
    return [list(itertools.compress(own, known)) if any(known) else [*own] for own in walks]


def limb_colors(trajectory: Trajectory) -> list[str]:
    """Return a colour for each limb."""
    return [LIMB_COLORS[number % len(LIMB_COLORS)] for number in range(len(trajectory.limbs))]


def _over_time(heights: Sequence[float], end: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a tall figure of panels over one time axis that runs to `end`."""
    figure = Figure(figsize=(COLUMN, height), layout=ConstrainedLayoutEngine(h_pad=0.02, w_pad=0.02, hspace=0.0))
    axes = list(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))
    axes[0].set_xlim(0, end)
    axes[-1].set_xlabel("time [s]")
    for panel in axes:
        panel.grid(axis="y", color="0.9", linewidth=0.4)
        panel.set_axisbelow(True)
        panel.locator_params(axis="y", nbins=4)
        # in line, beyond the longest numbers; to have them found would take a third of the time of all drawing
        panel.yaxis.set_label_coords(-0.16, 0.5)
        if panel is not axes[-1]:
            panel.xaxis.set_label_coords(0.5, 0.0)
    return figure, axes


def _draw_lines(axes: Sequence[Axes], trajectory: Trajectory, panels: Sequence[_Panel], **look: Any) -> None:
    """Draw all lines of a walk up to where its state stopped being finite; `look` is in place of the panels' own.

    Values after a failure may be thousands of times larger: the axes reach at most two spans beyond those before.
    """
    rows, failed = events.finite_rows(trajectory), events.failure_time(trajectory)
    for place, panel in zip(axes, panels, strict=False):
        place.set_ylabel(panel.label)
        place.autoscale(axis="y")  # for this walk too
        for values, color in zip(np.atleast_2d(panel.lines.T), panel.colors, strict=True):
            time, drawn = events.thin(trajectory.time[:rows], values[:rows])
            before = drawn[(time <= failed) & np.isfinite(drawn)]
            if not before.size:  # a margin that is not defined, as the TSM without gravity
                continue
            low, high = before.min(), before.max()
            low, high = max(np.nanmin(drawn), 3 * low - 2 * high), min(np.nanmax(drawn), 3 * high - 2 * low)
            own = {"color": color, "linewidth": panel.width, **look}
            # unlike plot, add_artist leaves the limits alone
            place.add_artist(Line2D(time, drawn, solid_joinstyle="round", **own))
            place.update_datalim([(time[0], low), (time[-1], high)])
            place.autoscale_view(scalex=False)
        if panel.lines.ndim == 1:
            place.set_ylim(bottom=0)


def _mark_holding_limit(panel: Axes, limit: float | None) -> None:
    """Draw the holding limit where it is within reach of the forces, else say where it is."""
    if limit is None:
        return
    _, top = panel.get_ylim()
    words, near = "holding limit", limit < 2.5 * top
    if near:
        panel.axhline(limit, color=BLACK, linestyle=":", linewidth=0.8)
        panel.set_ylim(top=max(top, 1.08 * limit))
    else:
        words += f" {limit:g} N \N{UPWARDS ARROW}"
        panel.set_ylim(top=1.2 * top)
    panel.annotate(
        words, (1, limit if near else 1.2 * top), xycoords=panel.get_yaxis_transform(), xytext=(-2, -2), ha="right",
        va="top", gid="holding limit", **_SMALL,
    )  # fmt: skip


def _draw_gait(panel: Axes, trajectory: Trajectory) -> None:
    """Draw per limb when its gripper is shut and holds, and a red cross where it is torn off."""
    time = np.append(trajectory.time, events.end_of(trajectory))
    support = trajectory.support[: events.finite_rows(trajectory)]
    panel.grid(False)
    for number, color in enumerate(limb_colors(trajectory)):
        edges = np.flatnonzero(np.diff(support[:, number].astype(int), prepend=0, append=0))
        bars = [(time[a], time[b] - time[a]) for a, b in edges.reshape(-1, 2)]
        panel.broken_barh(bars, (number - 0.35, 0.7), facecolors=color, linewidth=0, gid="support")
    for instant, limb in events.detachments(trajectory):
        _draw_cross(panel, instant, trajectory.limbs.index(limb))
    panel.set_yticks(range(len(trajectory.limbs)), trajectory.limbs)
    panel.set_ylim(len(trajectory.limbs) - 0.5, -0.5)
    panel.tick_params(axis="y", length=0)
    panel.set_ylabel("support")


def _mark_events(axes: Sequence[Axes], trajectory: Trajectory) -> None:
    """Shade disturbances and mark changes of grip in every panel; name the disturbances above the first.

    Each name stands on a line of its own where the words of another are in its way.
    """
    first, end = axes[0], axes[0].get_xlim()[1]
    letter = 3.9 / (0.8 * 72 * COLUMN) * end  # s, that a letter of the labels takes of the panel
    placed: list[tuple[int, float, float]] = []  # line, middle and half the width of each so far, s
    for start, stop, label, color in events.disturbances(trajectory):
        for panel in axes:
            panel.axvspan(start, stop, color=color, linewidth=0, zorder=0, gid="disturbance")
        middle, half = (start + stop) / 2, 0.5 * letter * (len(label) + 1)
        busy = {line for line, other, width in placed if abs(other - middle) < half + width}
        level = next(line for line in itertools.count() if line not in busy)
        placed.append((level, middle, half))
        first.annotate(
            label, (middle, 1), xycoords=first.get_xaxis_transform(), xytext=(0, 2 + 8 * level), ha="center",
            va="bottom", gid="disturbance label", **_SMALL,
        )  # fmt: skip
    for panel, change in itertools.product(axes, events.grip_changes(trajectory)):
        panel.axvline(change, color="0.7", linewidth=0.4, linestyle=(0, (4, 2)), zorder=0.5, gid="grip change")


def _mark_failure(
    axes: Sequence[Axes], trajectory: Trajectory, panels: Sequence[_Panel], color: str = RED, level: int = 0
) -> bool:
    """Mark the first torn gripper by a red cross on the line of every panel that is furthest from zero.

    Failure and time are written in the first panel, `level` lines below its top. False without a failure.
    """
    failures, first = [], axes[0]  # instants, s, and words
    for instant, limb in events.detachments(trajectory)[:1]:
        failures.append((instant, f"{limb} torn off, {instant:.2f} s"))
        row = int(np.searchsorted(trajectory.time, instant))
        for place, panel in zip(axes, panels, strict=False):
            place.axvline(instant, color=RED, linewidth=0.5, zorder=1.5)
            values = np.atleast_1d(panel.lines[row])
            _draw_cross(place, instant, values[np.abs(np.nan_to_num(values)).argmax()])
    if (rows := events.finite_rows(trajectory)) < trajectory.time.size:
        instant = float(trajectory.time[rows])
        failures.append((instant, f"diverged, {instant:.2f} s"))
    if failures:
        at = failures[0][0]
        late = at > 0.5 * first.get_xlim()[1]
        first.annotate(
            "\n".join(words for _, words in failures), (at, 1), xycoords=first.get_xaxis_transform(),
            xytext=(-4 if late else 4, -3 - 17 * level), ha="right" if late else "left", va="top", color=color,
            bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 0.8}, zorder=6, gid="failure", **_SMALL,
        )  # fmt: skip
    return bool(failures)


def _draw_cross(panel: Axes, x: float, y: float) -> None:
    """Mark a torn gripper."""
    panel.plot([x], [y], "x", color=RED, markersize=5, markeredgewidth=1.3, zorder=5, clip_on=False, gid="detachment")


@style()
def plot_feet(trajectory: Trajectory) -> Figure:
    """Draw the way of feet and base from the side and from above on the ground: footholds, height map, points to hold.

    Bars and rings are the footholds that the periodic gait plans; a red cross is where a gripper was torn off, and soon
    after that the picture ends. Points that can be held have the colour of their holding limit.
    """
    scenario, along = trajectory.scenario, _along(trajectory)
    end = np.searchsorted(trajectory.time, events.failure_time(trajectory) + 0.1)
    rows = min(events.finite_rows(trajectory), int(end))
    planned = along(_planned(trajectory))
    feet, base = along(trajectory.foot_position[:rows]), along(trajectory.base_position[:rows])
    low, high = planned.min((0, 1)) - 50, planned.max((0, 1)) + 50
    # a robot that falls leaves the picture
    top = 1e3 * (trajectory.base_reference[:, 2].max() + scenario.gait.step_height)
    bottom = planned[..., 2].min() - 0.1 * top
    holds = holds_of(scenario.ground)
    with_bar = scenario.ground.map is not None or holds is not None
    width = COLUMN - (1.3 if with_bar else 0.6)  # inch, of a panel
    tall, flat = (width * size / (high[0] - low[0]) for size in (high[1] - low[1], top - bottom))

    layout = ConstrainedLayoutEngine(h_pad=0.02, w_pad=0.02, hspace=0.03)
    figure = Figure(figsize=(COLUMN, 0.9 + flat + tall), layout=layout)
    side, above = figure.subplots(2, 1, sharex=True, height_ratios=[flat, tall])
    if scenario.ground.map is not None:
        _draw_relief(figure, above, scenario.ground.map, along)
    if holds is not None:
        draw_holds(figure, above, holds, along, (0, 1))
        draw_holds(None, side, holds, along, (0, 2))
    side.axhline(0, color=GREY, linewidth=0.6, zorder=0.5)
    limbs = [*zip(trajectory.limbs, limb_colors(trajectory), strict=True)]
    for (name, color), path, places in zip(limbs, feet.swapaxes(0, 1), planned, strict=True):
        path = path[:: max(rows // 1500, 1)]
        far = name.startswith("R")  # in line with a left one
        side.plot(path[:, 0], path[:, 2], color=color, linestyle=(0, (3, 1.5)) if far else "-", zorder=3)
        above.plot(path[:, 0], path[:, 1], color=color, zorder=3)
        for ahead, _, height in places:
            side.plot([ahead - 12, ahead + 12], [height] * 2, color=color, linewidth=2.5, alpha=0.45, gid="foothold")
        above.plot(places[:, 0], places[:, 1], "o", markersize=7, mec=color, mfc="none", gid="foothold")
    torn = [(*event, int(np.searchsorted(trajectory.time, event[0]))) for event in events.detachments(trajectory)]
    for panel, axis in ((side, 2), (above, 1)):
        panel.plot(base[:, 0], base[:, axis], color=BLACK, linewidth=0.8, zorder=3)
        for _, name, row in torn:
            if row < rows:
                _draw_cross(panel, *feet[row, trajectory.limbs.index(name), [0, axis]])
        panel.grid(color="0.9", linewidth=0.4)
        panel.set_axisbelow(True)
        panel.set_aspect("equal", adjustable="box")
    for instant, name, _ in torn[:1]:
        words = f"{name} torn off, {instant:.2f} s"
        side.annotate(words, (0.02, 0.95), xycoords="axes fraction", va="top", color=RED, fontsize=6.5, gid="failure")
    side.set(ylim=(bottom, top), ylabel="height [mm]")
    above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), ylabel="to the left [mm]", xlabel="ahead [mm]")
    legend(figure, [key(name, color=color, linewidth=1.2) for name, color in [*limbs, ("base", BLACK)]])
    return figure


def _along(trajectory: Trajectory) -> Callable[[np.ndarray], np.ndarray]:
    """Return the map of points (..., 2 or 3) m to mm ahead, to the left and above, from where the base starts."""
    heading, start = trajectory.scenario.gait.heading, trajectory.base_reference[0, :2]
    turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    return lambda points: 1e3 * np.concatenate([(points[..., :2] - start) @ turn, points[..., 2:]], axis=-1)


def _planned(trajectory: Trajectory) -> np.ndarray:
    """Return the footholds that the gait plans, (limb, N, 3) m."""
    scenario, robot = trajectory.scenario, trajectory.robot
    places, heights = footholds(scenario, robot), foothold_heights(scenario, robot)
    missing = places.shape[1] - heights.shape[1]
    if missing > 0:  # the last height goes on; without any the ground is at zero
        heights = np.pad(heights, ((0, 0), (0, missing)), mode="edge" if heights.size else "constant")
    return np.concatenate([places, heights[:, : places.shape[1], None]], axis=-1)


def _draw_relief(figure: Figure, panel: Axes, ground: HeightMap, along: Callable[[np.ndarray], np.ndarray]) -> None:
    """Draw a height map from above, with a colour bar."""
    x, y, heights = relief(ground)
    corners = along(np.stack(np.meshgrid(x, y), -1))
    mesh = panel.pcolormesh(
        corners[..., 0], corners[..., 1], 1e3 * heights, cmap="Greys_r", shading="gouraud", rasterized=True, zorder=0,
        gid="relief",
    )  # fmt: skip
    figure.colorbar(mesh, ax=panel, pad=0.02, aspect=25, label="ground [mm]")
