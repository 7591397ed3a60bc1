"""Panels over one axis of time: lines, shaded disturbances, marks of failure, the gait."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from mjx_climb.plots.events import detachments, disturbances, end_of, failure_time, finite_rows, grip_changes
from mjx_climb.plots.styling import COLUMN, GREY, LIMB_COLORS, RED
from mjx_climb.rollouts.trajectory import Trajectory

SMALL: dict[str, Any] = {"textcoords": "offset points", "fontsize": 6.5}  # words within a panel


def panels_over_time(heights: Sequence[float], end: float, height: float) -> tuple[Figure, list[Axes]]:
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
        # in line, beyond the longest numbers; to have them found would take a third of the time of all drawing
        panel.yaxis.set_label_coords(-0.16, 0.5)
        if panel is not axes[-1]:
            panel.xaxis.set_label_coords(0.5, 0.0)
    return figure, axes


def draw_line(panel: Axes, trajectory: Trajectory, values: np.ndarray, **style: Any) -> None:
    """Draw one line over time, up to where the state stopped being finite.

    What comes after a failure may be thousands of times larger: the axes reach at most two spans beyond what
    was before.
    """
    rows = finite_rows(trajectory)
    if not rows:
        return
    time, drawn = thin(trajectory.time[:rows], values[:rows])
    before = drawn[(time <= failure_time(trajectory)) & np.isfinite(drawn)]
    if not before.size:  # a margin that is not defined, as the TSM without gravity
        return
    low, high = before.min(), before.max()
    low, high = max(np.nanmin(drawn), 3 * low - 2 * high), min(np.nanmax(drawn), 3 * high - 2 * low)
    # unlike plot, add_artist leaves the limits alone
    panel.add_artist(Line2D(time, drawn, solid_joinstyle="round", **style))
    panel.update_datalim([(time[0], low), (time[-1], high)])
    panel.autoscale_view(scalex=False)


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
    chosen = np.unique(np.concatenate([[0, time.size - 1], rows[first, low], rows[first, high]]))
    return time[chosen], values[chosen]


def mark_events(axes: Sequence[Axes], trajectory: Trajectory) -> None:
    """Shade disturbances and mark changes of grip in every panel; name the disturbances above the first."""
    first, windows = axes[0], disturbances(trajectory)
    for (start, stop, label, color), level in zip(windows, _levels(first, windows), strict=True):
        for panel in axes:
            panel.axvspan(start, stop, color=color, linewidth=0, zorder=0, gid="disturbance")
        place = ((start + stop) / 2, 1)
        first.annotate(
            label, place, xycoords=first.get_xaxis_transform(), xytext=(0, 2 + 8 * level), ha="center", va="bottom",
            gid="disturbance label", **SMALL,
        )  # fmt: skip
    for panel in axes:
        for change in grip_changes(trajectory):
            panel.axvline(change, color="0.7", linewidth=0.4, linestyle=(0, (4, 2)), zorder=0.5, gid="grip change")


def _levels(panel: Axes, windows: Sequence[tuple[float, float, str, str]]) -> list[int]:
    """Return the line on which each disturbance is named: its own where the words of another are in its way."""
    start, end = panel.get_xlim()
    letter = 3.9 / (0.8 * 72 * COLUMN) * (end - start)  # s, that a letter of the labels takes of the panel
    placed: list[tuple[int, float, float]] = []  # line, middle and half the width of each so far, s
    for first, last, label, _ in windows:
        middle, half = (first + last) / 2, 0.5 * letter * (len(label) + 1)
        busy = {line for line, other, width in placed if abs(other - middle) < half + width}
        placed.append((next(line for line in range(len(windows)) if line not in busy), middle, half))
    return [line for line, *_ in placed]


def mark_failure(
    axes: Sequence[Axes], trajectory: Trajectory, lines: Sequence[np.ndarray], color: str = RED, level: int = 0
) -> bool:
    """Mark the first torn gripper by a red cross on the line (T,) of every panel.

    What failed when stands in the first panel, `level` lines below its top. False where nothing failed.
    """
    failures = []  # instants, s, and words
    if torn := detachments(trajectory):
        instant, limb = torn[0]
        row = int(np.searchsorted(trajectory.time, instant))
        for panel, values in zip(axes, lines, strict=True):
            panel.axvline(instant, color=RED, linewidth=0.5, zorder=1.5)
            draw_cross(panel, instant, values[row])
        failures.append((instant, f"{limb} torn off, {instant:.2f} s"))
    if (rows := finite_rows(trajectory)) < trajectory.time.size:
        instant = float(trajectory.time[rows])
        failures.append((instant, f"diverged, {instant:.2f} s"))
    if not failures:
        return False
    at, first = failures[0][0], axes[0]
    late = at > 0.5 * first.get_xlim()[1]
    first.annotate(
        "\n".join(words for _, words in failures), (at, 1), xycoords=first.get_xaxis_transform(),
        xytext=(-4 if late else 4, -3 - 17 * level), ha="right" if late else "left", va="top", color=color,
        bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 0.8}, zorder=6, gid="failure", **SMALL,
    )  # fmt: skip
    return True


def draw_cross(panel: Axes, x: float, y: float) -> None:
    """Mark a torn gripper."""
    panel.plot([x], [y], "x", color=RED, markersize=5, markeredgewidth=1.3, zorder=5, clip_on=False, gid="detachment")


def shade_divergence(axes: Sequence[Axes], trajectory: Trajectory) -> None:
    """Grey out the time in which there is no state any more."""
    if (rows := finite_rows(trajectory)) < trajectory.time.size:
        for panel in axes:
            span = trajectory.time[rows], end_of(trajectory)
            panel.axvspan(*span, color=GREY, linewidth=0, zorder=0.2, gid="diverged")


def draw_gait(panel: Axes, trajectory: Trajectory) -> None:
    """Draw per limb when its gripper is shut and holds, and a red cross where it is torn off."""
    time = np.append(trajectory.time, end_of(trajectory))
    support = trajectory.support[: finite_rows(trajectory)]
    panel.grid(False)
    for number, color in enumerate(limb_colors(trajectory)):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], support[:, number], [False]]).astype(int)))
        bars = [(time[a], time[b] - time[a]) for a, b in edges.reshape(-1, 2)]
        panel.broken_barh(bars, (number - 0.35, 0.7), facecolors=color, linewidth=0, gid="support")
    for instant, limb in detachments(trajectory):
        draw_cross(panel, instant, trajectory.limbs.index(limb))
    panel.set_yticks(range(len(trajectory.limbs)), trajectory.limbs)
    panel.set_ylim(len(trajectory.limbs) - 0.5, -0.5)
    panel.tick_params(axis="y", length=0)
    panel.set_ylabel("support")


def limb_colors(trajectory: Trajectory) -> list[str]:
    """Return a colour for each limb."""
    return [LIMB_COLORS[number % len(LIMB_COLORS)] for number in range(len(trajectory.limbs))]
