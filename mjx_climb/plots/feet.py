"""The way of the feet over the ground, from the side and from above."""

import math
from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from mjx_climb.plots.events import detachments, failure_time, finite_rows
from mjx_climb.plots.styling import BLACK, COLUMN, GREY, RED, legend, style
from mjx_climb.plots.time_panels import draw_cross, limb_colors
from mjx_climb.quantities.ground import foothold_heights, footholds, relief
from mjx_climb.rollouts.trajectory import Trajectory
from mjx_climb.scenario.model import HeightMap


@style()
def plot_feet(trajectory: Trajectory) -> Figure:
    """Draw the way of feet and base from the side and from above, with the ground: its footholds and its height map.

    Bars and rings are the footholds that the gait plans; a red cross is where a gripper was torn off, and soon after
    that the picture ends.
    """
    scenario, limbs = trajectory.scenario, [*zip(trajectory.limbs, limb_colors(trajectory), strict=True)]
    rows = min(finite_rows(trajectory), int(np.searchsorted(trajectory.time, failure_time(trajectory) + 0.1)))
    along = _along(trajectory)
    planned = along(_planned(trajectory))
    feet, base = along(trajectory.foot_position[:rows]), along(trajectory.base_position[:rows])
    low, high = planned.min((0, 1)) - 50, planned.max((0, 1)) + 50
    # a robot that falls leaves the picture
    top = 1e3 * (trajectory.base_reference[:, 2].max() + scenario.gait.step_height)
    bottom = planned[..., 2].min() - 0.1 * top
    width = COLUMN - (1.3 if scenario.ground.map is not None else 0.6)  # inch, of a panel
    tall, flat = (width * size / (high[0] - low[0]) for size in (high[1] - low[1], top - bottom))

    layout = ConstrainedLayoutEngine(h_pad=0.02, w_pad=0.02, hspace=0.03)
    figure = Figure(figsize=(COLUMN, 0.9 + flat + tall), layout=layout)
    side, above = figure.subplots(2, 1, sharex=True, height_ratios=[flat, tall])
    if scenario.ground.map is not None:
        _draw_relief(figure, above, scenario.ground.map, along)
    side.axhline(0, color=GREY, linewidth=0.6, zorder=0.5)
    for number, (name, color) in enumerate(limbs):
        path, holds = feet[:: max(rows // 1500, 1), number], planned[number]
        far = name.startswith("R")  # in line with a left one
        side.plot(path[:, 0], path[:, 2], color=color, linestyle=(0, (3, 1.5)) if far else "-", zorder=3)
        above.plot(path[:, 0], path[:, 1], color=color, zorder=3)
        for ahead, _, height in holds:
            side.plot([ahead - 12, ahead + 12], [height] * 2, color=color, linewidth=2.5, alpha=0.45, gid="foothold")
        above.plot(holds[:, 0], holds[:, 1], "o", markersize=7, mec=color, mfc="none", gid="foothold")
    for panel, axis in ((side, 2), (above, 1)):
        panel.plot(base[:, 0], base[:, axis], color=BLACK, linewidth=0.8, zorder=3)
        for instant, name in detachments(trajectory):
            if (row := int(np.searchsorted(trajectory.time, instant))) < rows:
                torn = feet[row, trajectory.limbs.index(name)]
                draw_cross(panel, torn[0], torn[axis])
        panel.grid(color="0.9", linewidth=0.4)
        panel.set_axisbelow(True)
        panel.set_aspect("equal", adjustable="box")
    for instant, name in detachments(trajectory)[:1]:
        words = f"{name} torn off, {instant:.2f} s"
        side.annotate(words, (0.02, 0.95), xycoords="axes fraction", va="top", color=RED, fontsize=6.5, gid="failure")
    side.set(ylim=(bottom, top), ylabel="height [mm]")
    above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), ylabel="to the left [mm]", xlabel="ahead [mm]")
    names = [*limbs, ("base", BLACK)]
    legend(figure, [Line2D([], [], color=color, label=name, linewidth=1.2) for name, color in names])
    return figure


def _along(trajectory: Trajectory) -> Callable[[np.ndarray], np.ndarray]:
    """Return what turns points (..., 2 or 3) m into mm ahead, to the left and above, from where the base starts."""
    heading, start = trajectory.scenario.gait.heading, trajectory.base_reference[0, :2]
    turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    return lambda points: 1e3 * np.concatenate([(points[..., :2] - start) @ turn, points[..., 2:]], axis=-1)


def _planned(trajectory: Trajectory) -> np.ndarray:
    """Return the footholds that the gait plans, (limb, N, 3) m."""
    places, heights = footholds(trajectory.scenario), foothold_heights(trajectory.scenario)
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
    bar = figure.colorbar(mesh, ax=panel, pad=0.02, aspect=25)
    bar.set_label("ground [mm]")
    bar.outline.set_linewidth(0.6)
