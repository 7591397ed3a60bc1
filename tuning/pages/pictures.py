"""Colours, labels and axes of the pictures of several kinds of results."""

import xarray as xr
from matplotlib.axis import Axis
from matplotlib.ticker import LogLocator

from mjx_climb.viz import plots
from tuning.pages.explorer import SCALES

COLORS = {"config": plots.VERMILLION, "paper": plots.VERMILLION, "pd": "0.6", "retuned pd": plots.BLACK}


def scaled(variable: xr.DataArray) -> tuple[float, str]:
    """Return the factor from SI to the unit that people read, and the label of its axis."""
    factor, unit = SCALES.get(variable.attrs["units"], (1.0, variable.attrs["units"]))
    return factor, variable.attrs["long_name"] + ("" if unit == "1" else f" [{unit}]")


def plain_numbers(axis: Axis, *, few: bool) -> None:
    """Write the numbers of a logarithmic axis as 200, not as a power, and more of them where there are few decades."""
    if few:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")
