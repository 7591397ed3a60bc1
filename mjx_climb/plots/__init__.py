"""Pictures of walks and of sweeps, for a column of a paper; colour-blind safe, SI units on every axis.

Names are imported when they are first used: colours and what happened in a walk are known without matplotlib.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjx_climb.plots.colors import (
        AXIS_COLORS,
        BLACK,
        BLUE,
        CARGO,
        GREEN,
        GREY,
        LIMB_COLORS,
        ORANGE,
        PURPLE,
        PUSH,
        RED,
        SERIES,
        SKY,
        VERMILLION,
    )
    from mjx_climb.plots.feet import plot_feet
    from mjx_climb.plots.maps import color_scale, comparable, failed_walks, plot_map, plot_maps, stability_lines
    from mjx_climb.plots.saving import FORMATS, save_figure
    from mjx_climb.plots.styling import COLUMN, legend, legend_below, over_style, style
    from mjx_climb.plots.time_panels import thin
    from mjx_climb.plots.walk_events import detachments, disturbances, grip_changes, largest_foot_force
    from mjx_climb.plots.walks import plot_comparison, plot_walk

_PUBLIC = {
    "colors": (
        "AXIS_COLORS",
        "BLACK",
        "BLUE",
        "CARGO",
        "GREEN",
        "GREY",
        "LIMB_COLORS",
        "ORANGE",
        "PURPLE",
        "PUSH",
        "RED",
        "SERIES",
        "SKY",
        "VERMILLION",
    ),
    "feet": ("plot_feet",),
    "maps": (
        "color_scale",
        "comparable",
        "failed_walks",
        "plot_map",
        "plot_maps",
        "stability_lines",
    ),
    "saving": ("FORMATS", "save_figure"),
    "styling": (
        "COLUMN",
        "legend",
        "legend_below",
        "over_style",
        "style",
    ),
    "time_panels": ("thin",),
    "walk_events": (
        "detachments",
        "disturbances",
        "grip_changes",
        "largest_foot_force",
    ),
    "walks": (
        "plot_comparison",
        "plot_walk",
    ),
}
_HOME = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = [
    "AXIS_COLORS",
    "BLACK",
    "BLUE",
    "CARGO",
    "COLUMN",
    "FORMATS",
    "GREEN",
    "GREY",
    "LIMB_COLORS",
    "ORANGE",
    "PURPLE",
    "PUSH",
    "RED",
    "SERIES",
    "SKY",
    "VERMILLION",
    "color_scale",
    "comparable",
    "detachments",
    "disturbances",
    "failed_walks",
    "grip_changes",
    "largest_foot_force",
    "legend",
    "legend_below",
    "over_style",
    "plot_comparison",
    "plot_feet",
    "plot_map",
    "plot_maps",
    "plot_walk",
    "save_figure",
    "stability_lines",
    "style",
    "thin",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
