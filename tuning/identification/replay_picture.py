"""Log and simulation on one picture: a column of panels for each limb."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from mjx_climb.plots.styling import AXIS_COLORS, BLACK, BLUE, COLUMN, GREY, key, legend_below, style
from mjx_climb.robot.constants import load_robot
from tuning.identification.log import Signal
from tuning.identification.replay import Replay

_THIN, _WIDE = 0.7, 1.8  # points
_MOST = 4000  # points of a line


@style()
def plot_replay(replay: Replay) -> Figure:
    """Draw joint angles as they were commanded, logged and simulated, and foot forces where they were logged.

    Each joint panel says how far the simulation is from the log (root mean square).
    """
    robot, signals, walk = load_robot(replay.scenario.robot), replay.log.signals, replay.walk
    forces = any(f"{limb}.force.{axis}" in signals for limb in robot.limbs for axis in "xyz")
    rows = robot.joints + forces
    size = (2 * COLUMN, 0.6 + 1.15 * rows)
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(h_pad=0.02, w_pad=0.02))
    panels = figure.subplots(rows, len(robot.limbs), sharex=True, squeeze=False)
    for column, limb in enumerate(robot.limbs):
        panels[0, column].set_title(limb)
        panels[-1, column].set_xlabel("time [s]")
        for row, joint in enumerate(robot.joint_names):
            name, panel = f"{limb}.{joint}", panels[row, column]
            if (command := signals.get(f"{name}.command")) is not None:
                _line(panel, command, color=GREY, linewidth=_WIDE, drawstyle="steps-post")
            if (logged := signals.get(f"{name}.position")) is not None:
                _line(panel, logged, color=BLACK, linewidth=_THIN)
            _line(panel, Signal(walk.time, walk.joint_angles[:, column, row]), color=BLUE, linewidth=_THIN)
            error = replay.errors.get(f"{name}.position")
            words = "not logged" if error is None else f"{1e3 * error.rms:.3g} mrad"
            panel.annotate(words, (0.98, 0.95), xycoords="axes fraction", ha="right", va="top", fontsize=6.5)
        for axis, color in zip("xyz" if forces else "", AXIS_COLORS, strict=False):
            if (force := signals.get(f"{limb}.force.{axis}")) is not None:
                _line(panels[-1, column], force, color=color, linewidth=_WIDE, alpha=0.35)
            simulated = Signal(walk.time, walk.foot_force[:, column, "xyz".index(axis)])
            _line(panels[-1, column], simulated, color=color, linewidth=_THIN)
    _label(panels[:, 0], [*(f"{joint} [rad]" for joint in robot.joint_names), *(["foot force [N]"] if forces else [])])
    figure.align_ylabels(panels[:, 0])
    handles = [
        key("commanded", color=GREY, linewidth=_WIDE),
        key("logged", color=BLACK),
        key("simulated", color=BLUE),
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
