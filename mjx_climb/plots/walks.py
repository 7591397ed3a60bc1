"""Walks over time: one with all that it does, or several over one another."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mjx_climb.files.dataset import AXES
from mjx_climb.plots.colors import AXIS_COLORS, BLACK, SERIES
from mjx_climb.plots.styling import leave_headroom, legend, legend_inside, styled
from mjx_climb.plots.time_panels import (
    draw_gait,
    draw_line,
    limb_colors,
    mark_events,
    mark_failure,
    panels_over_time,
    shade_divergence,
)
from mjx_climb.plots.walk_events import end_of, largest_foot_force, lengths
from mjx_climb.robot.constants import load_robot
from mjx_climb.rollouts.trajectory import Trajectory


@styled
def plot_walk(trajectory: Trajectory) -> Figure:
    """Draw one walk over time: forces, torques, base, margins and support, on one time axis.

    Disturbances are shaded and named, changes of grip are thin vertical lines, and the first torn
    gripper is a red cross.
    """
    shifted = bool(np.any(trajectory.base_displacement))
    joints = load_robot(trajectory.scenario.robot).joint_names
    names = [
        "force",
        *joints,
        "base",
        "error",
        *(["shift", "turn"] if shifted else []),
        "tsm",
        "gia",
        "support",
    ]
    heights = {"force": 1.4, "base": 1.2, "support": 0.9}
    figure, axes = panels_over_time(
        [heights.get(name, 1.0) for name in names], end_of(trajectory), 0.5 + 0.77 * len(names)
    )
    panels = dict(zip(names, axes, strict=True))
    lines = {}  # per panel, the line that carries the mark of a detachment

    lines["force"] = largest_foot_force(trajectory)
    draw_line(panels["force"], trajectory, lines["force"], color=BLACK)
    panels["force"].set_ylim(bottom=0)
    _mark_holding_limit(panels["force"], trajectory.scenario.contact.holding_limit)
    panels["force"].set_ylabel("largest foot\nforce [N]")

    for number, joint in enumerate(joints):
        for limb, color in enumerate(limb_colors(trajectory)):
            draw_line(
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
        draw_line(panels["base"], trajectory, 1e3 * (position - start[axis]), color=color)
        draw_line(panels["base"], trajectory, 1e3 * (reference - start[axis]), color=color, linestyle=(0, (2, 1.5)))
        draw_line(panels["error"], trajectory, 1e3 * (position - reference), color=color)
    dashed = Line2D([], [], color="0.3", linestyle=(0, (2, 1.5)), label="reference")
    legend_inside(panels["base"], AXES, AXIS_COLORS, [dashed])
    lines["base"] = 1e3 * (trajectory.base_position[:, 0] - start[0])
    lines["error"] = 1e3 * _furthest(trajectory.base_position - trajectory.base_reference)
    panels["base"].set_ylabel("base\n[mm]")
    panels["error"].set_ylabel("base off\nref. [mm]")
    leave_headroom(panels["base"])

    if shifted:
        for name, first, text in (
            ("shift", 0, "shift $\\Delta x$\n[mm]"),
            ("turn", 3, "turn $\\Delta x$\n[mrad]"),
        ):
            for axis, color in enumerate(AXIS_COLORS):
                draw_line(panels[name], trajectory, 1e3 * trajectory.base_displacement[:, first + axis], color=color)
            lines[name] = 1e3 * _furthest(trajectory.base_displacement[:, first : first + 3])
            panels[name].set_ylabel(text)

    for name, values, text in (
        ("tsm", trajectory.tsm, "TSM [m]"),
        ("gia", trajectory.gia_margin, "GIA margin\n[m/s$^2$]"),
    ):
        draw_line(panels[name], trajectory, values, color=BLACK)
        lines[name] = values
        panels[name].set_ylim(bottom=0)
        panels[name].set_ylabel(text)

    draw_gait(panels["support"], trajectory)
    mark_events(axes, trajectory)
    shade_divergence(axes, trajectory)
    mark_failure(axes[:-1], trajectory, [lines[name] for name in names[:-1]])
    limbs = zip(trajectory.limbs, limb_colors(trajectory), strict=True)
    legend(figure, [Line2D([], [], color=color, label=limb, linewidth=1.2) for limb, color in limbs])
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
        leave_headroom(panel, 0.2)
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


@styled
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
    end = max(end_of(trajectory) for trajectory in trajectories.values())
    figure, axes = panels_over_time([1.2 if name == "force" else 1.0 for name in names], end, 0.7 + 0.95 * len(names))
    level, handles = 0, []
    for number, (name, trajectory) in enumerate(trajectories.items()):
        color, width = SERIES[number % len(SERIES)]
        torque = np.abs(trajectory.joint_torque).max(2)
        lines = {
            "force": largest_foot_force(trajectory),
            "torque": torque.max(1),
            "tsm": trajectory.tsm,
            "gia": trajectory.gia_margin,
            "deviation": 1e3 * lengths(trajectory.base_position - trajectory.base_reference),
            **{limb: torque[:, column] for column, limb in enumerate(trajectory.limbs)},
        }
        for panel, key in zip(axes, names, strict=True):
            draw_line(panel, trajectory, lines[key], color=color, linewidth=width, zorder=2 + 0.1 * number)
        level += mark_failure(axes, trajectory, [lines[key] for key in names], "0.3" if number == 0 else color, level)
        handles.append(Line2D([], [], color=color, linewidth=max(1.2, width), label=name))
    for panel, key in zip(axes, names, strict=True):
        panel.set_ylim(bottom=0)
        panel.set_ylabel(labels[key])
    mark_events(axes, first)
    legend(figure, handles, title)
    return figure
