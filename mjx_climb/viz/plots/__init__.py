"""Pictures of walks and of sweeps, for a column of a paper; colour-blind safe, SI units on every axis."""

from mjx_climb.viz.plots.events import detachments, disturbances, grip_changes, largest_foot_force, thin
from mjx_climb.viz.plots.holds import plot_holds
from mjx_climb.viz.plots.maps import color_scale, comparable, failed_walks, plot_map, plot_maps, stability_lines
from mjx_climb.viz.plots.styling import (
    BLACK,
    BLUE,
    CARGO,
    COLUMN,
    FORMATS,
    GREEN,
    ORANGE,
    PURPLE,
    PUSH,
    RED,
    SERIES,
    SKY,
    VERMILLION,
    key,
    legend,
    legend_below,
    over_style,
    save_figure,
    style,
)
from mjx_climb.viz.plots.walks import plot_comparison, plot_feet, plot_walk

__all__ = [
    "BLACK", "BLUE", "CARGO", "COLUMN", "FORMATS", "GREEN", "ORANGE", "PURPLE", "PUSH", "RED", "SERIES", "SKY",
    "VERMILLION", "color_scale", "comparable", "detachments", "disturbances", "failed_walks", "grip_changes", "key",
    "largest_foot_force", "legend", "legend_below", "over_style", "plot_comparison", "plot_feet", "plot_holds",
    "plot_map", "plot_maps", "plot_walk", "save_figure", "stability_lines", "style", "thin",
]  # fmt: skip
