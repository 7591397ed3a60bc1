"""Graspability maps: the points that can be held, by how much they bear."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_climb.ground import Holds
from mjx_climb.viz.plots.styling import COLUMN, GREY, style

SCALE = "viridis"  # of limits; darker is weaker


@style()
def plot_holds(holds: Holds) -> Figure:
    """Draw the points that can be held, from above (x, y) and from the side (x, z), in m.

    The colour of a point is the largest pull along its normal that it bears; grey points bear any.
    """
    size = np.ptp(holds.shown().position, axis=0)
    width = COLUMN - 1.3
    tall, flat = (np.clip(width * (side + 0.1) / (size[0] + 0.1), 0.3, 2 * COLUMN) for side in size[1:])
    figure = Figure(figsize=(COLUMN, 0.9 + flat + tall), layout="constrained")
    side, above = figure.subplots(2, 1, sharex=True, height_ratios=[flat, tall])
    for panel, axes, label in ((side, (0, 2), "z [m]"), (above, (0, 1), "y [m]")):
        draw_holds(figure if panel is above else None, panel, holds, lambda points: points, axes)
        panel.set_aspect("equal", adjustable="datalim")
        panel.set_ylabel(label)
    above.set_xlabel("x [m]")
    return figure


def draw_holds(
    figure: Figure | None, panel: Axes, holds: Holds, placed: Callable[[np.ndarray], np.ndarray], axes: tuple[int, int]
) -> None:
    """Draw points that can be held in a panel, with a colour bar where the figure is given.

    Arguments:
        placed: maps points (n, 3) m of the world to the panel's coordinates.
        axes: which of three axes it shows.
    """
    points = holds.shown()
    (x, y), limited = placed(points.position)[:, axes].T, np.isfinite(points.pull)
    look: dict[str, Any] = {"s": 4, "linewidth": 0, "zorder": 1, "rasterized": True, "gid": "holds"}
    panel.scatter(x[~limited], y[~limited], color=GREY, **look)
    if limited.any():
        pull = points.pull[limited]
        drawn = panel.scatter(x[limited], y[limited], c=pull, cmap=SCALE, vmin=0, vmax=pull.max(), **look)
        if figure is not None:
            figure.colorbar(drawn, ax=panel, pad=0.02, aspect=25, label="holding limit [N]")
