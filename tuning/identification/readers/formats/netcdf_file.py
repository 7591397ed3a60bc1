"""Walks as `mjx-climb run` writes them, and other labelled arrays over time."""

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mjx_climb.files import dataset
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.readers.table import Recording, Table

if TYPE_CHECKING:
    import xarray as xr

SUFFIXES = (".nc",)
_JOINT = {"joint_targets": "command", "joint_angles": "position", "joint_rates": "velocity", "joint_torque": "effort"}
_BASE = {f"base_{what}": what for what in ("position", "orientation", "linear_velocity", "angular_velocity")}


def read(path: Path) -> Recording:
    """Return the variables of a netCDF file over its dimension `time`, by the names of signals where it is a walk.

    Raises:
        ConfigError: no netCDF4 file, or nothing over time in it.
    """
    data = dataset.load(path)
    if "time" not in data.variables:
        raise ConfigError(str(path), "", "variables over time", "none")
    fields: dict[str, np.ndarray] = {}
    unnamed = set()
    for name, variable in data.data_vars.items():
        if variable.dims[:1] != ("time",) or variable.dtype.kind not in "fiub":
            continue
        labels = [[str(label) for label in data[dim].values] for dim in variable.dims[1:]]
        values = variable.values.reshape(len(variable), -1).astype(float)
        for place, column in zip(itertools.product(*labels), values.T, strict=True):
            fields[signal := _signal(str(name), place)] = column
            if not data.coords.keys() >= {*variable.dims[1:]}:
                unnamed.add(signal)
    time = {"time": data["time"].values.astype(float)}
    return Recording({"": Table("", time, fields, unnamed=unnamed)}, str(path), _late(data, str(path)))


def _late(data: "xr.Dataset", source: str) -> tuple[str, ...]:
    """Return the note on the commands of a walk: they were recorded behind the bus, not before."""
    delay = dataset.scenario_of(data).hardware.command_delay if "scenario" in data.attrs else 0.0
    sent = f"commands are those that reached the servos, {delay:g} s after they were sent"
    cure = "a scenario that sends them again takes hardware.command_delay=0"
    return (f"{source}: {sent} ({cure})",) if delay else ()


def _signal(variable: str, place: tuple[str, ...]) -> str:
    """Return the name of the signal that a walk's variable holds at a place, the variable's own for another."""
    match variable, place:
        case _, (limb, joint) if variable in _JOINT:
            return f"{limb}.{joint}.{_JOINT[variable]}"
        case "foot_force", (limb, axis):
            return f"{limb}.force.{axis}"
        case "support", (limb,):
            return f"{limb}.support"
        case "push", (axis,):
            return f"base.moment.{axis[1:]}" if axis[0] == "r" else f"base.force.{axis}"
        case _, (axis,) if variable in _BASE:
            return f"base.{_BASE[variable]}.{axis}"
    return ".".join((variable, *place))
