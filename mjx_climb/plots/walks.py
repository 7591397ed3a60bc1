"""Walks over time: one with all that it does, or several over one another."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mjx_climb.files.dataset import AXES
from mjx_climb.plots.events import end_of, largest_foot_force, lengths
from mjx_climb.plots.styling import AXIS_COLORS, BLACK, SERIES, legend, style
from mjx_climb.plots.time_panels import (
    SMALL,
    draw_gait,
    draw_line,
    limb_colors,
    mark_events,
    mark_failure,
    panels_over_time,
    shade_divergence,
)
from mjx_climb.robot.constants import load_robot
from mjx_climb.rollouts.trajectory import Trajectory

_DASHED = (0, (2, 1.5))


class _Panel(NamedTuple):
    """What one panel shows."""

    label: str
    lines: np.ndarray  # (T, N)
    colors: Sequence[str] = (BLACK,)
    height: float = 1.0
    width: float = 0.8  # of lines, points
    from_zero: bool = False  # as lengths and margins do

    def furthest(self) -> np.ndarray:
        """Return for each row the value that is furthest from zero, (T,): it carries the mark of a failure."""
        index = np.abs(np.nan_to_num(self.lines)).argmax(1)
        return np.take_along_axis(self.lines, index[:, None], 1)[:, 0]


@style()
def plot_walk(trajectory: Trajectory) -> Figure:
    """Draw one walk over time: forces, torques, base, margins and support, on one time axis.

    Disturbances are shaded and named, changes of grip are thin vertical lines, and the first torn
    gripper is a red cross.
    """
    joints, limbs = load_robot(trajectory.scenario.robot).joint_names, limb_colors(trajectory)
    reference = 1e3 * (trajectory.base_reference - trajectory.base_reference[0])
    base = 1e3 * (trajectory.base_position - trajectory.base_reference[0])
    error = 1e3 * (trajectory.base_position - trajectory.base_reference)
    panels = [
        _Panel("largest foot\nforce [N]", largest_foot_force(trajectory)[:, None], height=1.4, from_zero=True),
        *(
            _Panel(f"{joint} $\\tau$\n[N m]", trajectory.joint_torque[:, :, number], limbs, width=0.6)
            for number, joint in enumerate(joints)
        ),
        _Panel("base\n[mm]", base, AXIS_COLORS, height=1.2),
        _Panel("base off\nref. [mm]", error, AXIS_COLORS),
    ]
    if np.any(trajectory.base_displacement):
        shift = 1e3 * trajectory.base_displacement
        panels.append(_Panel("shift $\\Delta x$\n[mm]", shift[:, :3], AXIS_COLORS))
        panels.append(_Panel("turn $\\Delta x$\n[mrad]", shift[:, 3:], AXIS_COLORS))
    panels.append(_Panel("TSM [m]", trajectory.tsm[:, None], from_zero=True))
    panels.append(_Panel("GIA margin\n[m/s$^2$]", trajectory.gia_margin[:, None], from_zero=True))

    heights = [*(panel.height for panel in panels), 0.9]
    figure, axes = panels_over_time(heights, end_of(trajectory), 0.5 + 0.77 * len(heights))
    for place, panel in zip(axes, panels, strict=False):
        for values, color in zip(panel.lines.T, panel.colors, strict=True):
            draw_line(place, trajectory, values, color=color, linewidth=panel.width)
        if panel.from_zero:
            place.set_ylim(bottom=0)
        place.set_ylabel(panel.label)
    for values, color in zip(reference.T, AXIS_COLORS, strict=True):
        draw_line(axes[1 + len(joints)], trajectory, values, color=color, linestyle=_DASHED)
    _legend_of_axes(axes[1 + len(joints)])
    _mark_holding_limit(axes[0], trajectory.scenario.contact.holding_limit)
    draw_gait(axes[-1], trajectory)
    mark_events(axes, trajectory)
    shade_divergence(axes, trajectory)
    mark_failure(axes[:-1], trajectory, [panel.furthest() for panel in panels])
    names = zip(trajectory.limbs, limbs, strict=True)
    legend(figure, [Line2D([], [], color=color, label=limb, linewidth=1.2) for limb, color in names])
    return figure


def _legend_of_axes(panel: Axes) -> None:
    """Name the three axes and the reference in a panel, above what it shows."""
    handles = [Line2D([], [], color=color, label=name) for name, color in zip(AXES, AXIS_COLORS, strict=True)]
    panel.legend(
        handles=[*handles, Line2D([], [], color="0.3", linestyle=_DASHED, label="reference")], loc="upper left",
        ncols=4, handlelength=1.0, columnspacing=0.7, handletextpad=0.3, borderaxespad=0.1, fontsize=6.5,
    )  # fmt: skip
    _leave_headroom(panel, 0.3)


def _leave_headroom(panel: Axes, share: float) -> None:
    low, high = panel.get_ylim()
    panel.set_ylim(low, high + share * (high - low))


def _mark_holding_limit(panel: Axes, limit: float | None) -> None:
    """Draw the holding limit where it is within reach of the forces, else say where it is."""
    if limit is None:
        return
    near = limit < 2.5 * panel.get_ylim()[1]
    if near:
        panel.axhline(limit, color=BLACK, linestyle=":", linewidth=0.8)
        panel.set_ylim(top=max(panel.get_ylim()[1], 1.08 * limit))
    else:
        _leave_headroom(panel, 0.2)
    words = "holding limit" if near else f"holding limit {limit:g} N \N{UPWARDS ARROW}"
    place = (1, limit if near else panel.get_ylim()[1])
    panel.annotate(
        words, place, xycoords=panel.get_yaxis_transform(), xytext=(-2, -2), ha="right", va="top",
        gid="holding limit", **SMALL,
    )  # fmt: skip


@style()
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
    end = max(end_of(trajectory) for trajectory in trajectories.values())
    count = len(_compared(first, per_limb=per_limb))
    figure, axes = panels_over_time([1.2] + [1.0] * (count - 1), end, 0.7 + 0.95 * count)
    level, handles = 0, []
    for number, (name, trajectory) in enumerate(trajectories.items()):
        color, width = SERIES[number % len(SERIES)]
        lines = _compared(trajectory, per_limb=per_limb)
        for panel, (label, values) in zip(axes, lines.items(), strict=True):
            draw_line(panel, trajectory, values, color=color, linewidth=width, zorder=2 + 0.1 * number)
            panel.set_ylabel(label)
        level += mark_failure(axes, trajectory, [*lines.values()], "0.3" if number == 0 else color, level)
        handles.append(Line2D([], [], color=color, linewidth=max(1.2, width), label=name))
    for panel in axes:
        panel.set_ylim(bottom=0)
    mark_events(axes, first)
    legend(figure, handles, title)
    return figure


def _compared(trajectory: Trajectory, *, per_limb: bool) -> dict[str, np.ndarray]:
    """Return the lines (T,) of a walk by the label of their panel."""
    torque = np.abs(trajectory.joint_torque).max(2)
    each = {f"{limb} largest\ntorque [N m]": torque[:, number] for number, limb in enumerate(trajectory.limbs)}
    return {
        "largest foot\nforce [N]": largest_foot_force(trajectory),
        "largest joint\ntorque [N m]": torque.max(1),
        **(each if per_limb else {}),
        "TSM [m]": trajectory.tsm,
        "GIA margin\n[m/s$^2$]": trajectory.gia_margin,
        "base off its\nreference [mm]": 1e3 * lengths(trajectory.base_position - trajectory.base_reference),
    }
