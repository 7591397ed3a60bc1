"""Log and simulation on one picture: a column of panels for each limb."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from mjx_climb.viz.plots.styling import AXIS_COLORS, BLACK, BLUE, COLUMN, GREY, VERMILLION, key, legend_below, style
from tuning.identification.model.replay import Error, Replay
from tuning.identification.readers.log import Signal

_THIN, _WIDE = 0.7, 1.8  # points
_MOST = 4000  # points of a line


@style()
def plot_replay(replay: Replay) -> Figure:
    """Draw joint angles as they were commanded, logged and simulated, and foot forces where they were logged.

    Below each joint stands log less simulation, and its root mean square over the panel.
    """
    robot, signals, walk = replay.walk.robot, replay.log.signals, replay.walk
    forces = any(f"{limb}.force.{axis}" in signals for limb in robot.limbs for axis in "xyz")
    ratios = [*(2.0, 1.0) * robot.joints, *([2.0] if forces else [])]
    size = (2 * COLUMN, 0.6 + 0.62 * sum(ratios))
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(h_pad=0.02, w_pad=0.02))
    panels = figure.subplots(len(ratios), len(robot.limbs), sharex=True, squeeze=False, height_ratios=ratios)
    for column, limb in enumerate(robot.limbs):
        panels[0, column].set_title(limb)
        panels[-1, column].set_xlabel("time [s]")
        for row, joint in enumerate(robot.joint_names):
            name, (panel, missed) = f"{limb}.{joint}", panels[2 * row : 2 * row + 2, column]
            simulated = Signal(walk.time, walk.joint_angles[:, column, row])
            if (command := signals.get(f"{name}.command")) is not None:
                _line(panel, command, color=GREY, linewidth=_WIDE, drawstyle="steps-post")
            logged, error = (each.get(f"{name}.position") for each in (signals, replay.errors))
            if isinstance(logged, Signal):
                _line(panel, logged, color=BLACK, linewidth=_THIN)
                off = logged.value - np.interp(logged.time, simulated.time, simulated.value)
                _line(missed, Signal(logged.time, 1e3 * off), color=VERMILLION, linewidth=_THIN)
            _line(panel, simulated, color=BLUE, linewidth=_THIN)
            missed.axhline(0, color=GREY, linewidth=0.5, zorder=0)
            words = f"{1e3 * error.rms:.3g} mrad" if isinstance(error, Error) else "not logged"
            missed.set_title(words, loc="right", fontsize=6.5, pad=1.5)
        for axis, color in zip("xyz" if forces else "", AXIS_COLORS, strict=False):
            if (force := signals.get(f"{limb}.force.{axis}")) is not None:
                _line(panels[-1, column], force, color=color, linewidth=_WIDE, alpha=0.35)
            of_foot = Signal(walk.time, walk.foot_force[:, column, "xyz".index(axis)])
            _line(panels[-1, column], of_foot, color=color, linewidth=_THIN)
    labels = [label for joint in robot.joint_names for label in (f"{joint} [rad]", "[mrad]")]
    _label(panels[:, 0], [*labels, *(["foot force [N]"] if forces else [])])
    figure.align_ylabels(panels[:, 0])
    handles = [
        key("commanded", color=GREY, linewidth=_WIDE),
        key("logged", color=BLACK),
        key("simulated", color=BLUE),
        key("logged - simulated, and its rms", color=VERMILLION),
    ]
    if forces:
        handles += [key(f"force {axis}", color=color) for axis, color in zip("xyz", AXIS_COLORS, strict=True)]
        handles.append(key("logged forces: broad", color=GREY, linewidth=_WIDE))
    legend_below(figure, handles, len(handles))
    return figure


def _line(panel: Axes, signal: Signal, **look: Any) -> None:
    every = max(len(signal.time) // _MOST, 1)
    panel.plot(signal.time[::every], np.asarray(signal.value)[::every], **look)


def _label(panels: Iterable[Axes], labels: Iterable[str]) -> None:
    for panel, label in zip(panels, labels, strict=True):
        panel.set_ylabel(label)
