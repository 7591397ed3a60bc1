"""Gains as labelled arrays, and as plain JSON and CSV: every number with its axis and unit."""

import csv
import io
import json
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance
from mjx_climb.files.dataset import SIX
from mjx_climb.gait.periodic import PeriodicGait
from mjx_climb.inputs.gait_values import GAIT
from mjx_climb.parameter_types import GAIN_UNITS
from tuning.gains.interfaces import INTERFACES
from tuning.gains.ros2_control import six

AXES = {3: "three", 6: "six"}  # the dimension of a gain of so many axes
_OF_GAIT = {f"gait.{name}": (field.unit, field.long_name) for name, field in PeriodicGait.VALUES.items()}
JOINT_UNITS = {name: GAIN_UNITS[name][0] for name in ("kp", "kd", "ki")}


Variable = tuple[tuple[str, ...], np.ndarray, dict[str, str]]  # dimensions, values and attributes, as xarray takes them


def labels(law: mc.Law | None = None) -> dict[str, tuple[str, str]]:
    """Return unit and long name of every gain; where rotations have another unit, it follows after a comma."""
    own = {} if law is None else law.GAINS
    known = {name: GAIN_UNITS[name] for name in (*mc.Gains.AXES, *JOINT_UNITS)}
    known |= {key: _OF_GAIT[key] for key in GAIT}
    return known | {n: (field.unit, field.long_name or n.replace("_", " ")) for n, field in own.items()}


def labelled(
    gains: Mapping[str, np.ndarray], leading: tuple[str, ...], law: mc.Law | None = None
) -> dict[str, Variable]:
    """Return gains (*leading, ...) as variables: of three or six axes, or with dimensions of their own, `gain_0`."""
    known, variables = labels(law), {}
    for name, values in gains.items():
        shape = values.shape[len(leading) :]
        axes = (
            (AXES[shape[0]],)
            if len(shape) == 1 and shape[0] in AXES
            else tuple(f"{name}_{n}" for n in range(len(shape)))
        )
        unit, text = known[name]
        variables[name] = (*leading, *axes), values, {"units": unit, "long_name": text}
    return variables


def axes_of(variables: Mapping[str, Variable]) -> dict[str, list[str]]:
    """Return the coordinates of the axes that some gains have."""
    used = {dimensions[-1] for dimensions, *_ in variables.values()}
    return {name: list(SIX[:length]) for length, name in AXES.items() if name in used}


def _rows(gains: mc.Gains, law: type[mc.Law], gait: Mapping[str, Any]) -> list[tuple[str, str, float, str]]:
    """Return one row per number: gain, axis ("joints" for kp and kd, "gait" for the gait's keys), value, unit."""
    axes = SIX[: INTERFACES[law].axes]
    table = [
        (name, axis, float(value), GAIN_UNITS[name][0].split(", ")[axis.startswith("r")])
        for name, values in zip(mc.Gains.AXES, six(gains), strict=True)
        for axis, value in zip(axes, values, strict=False)
    ]
    joint = {name: getattr(gains, name) for name in JOINT_UNITS}
    table += [(name, "joints", float(v), JOINT_UNITS[name]) for name, v in joint.items() if v is not None]
    return table + [(key, "gait", float(v), _OF_GAIT[key][0]) for key, v in gait.items()]


def write_csv(
    gains: mc.Gains, law: type[mc.Law] = VirtualModelAdmittance, gait: Mapping[str, Any] = MappingProxyType({})
) -> str:
    """Return the gains of a law as CSV in long form, below a comment on the law's input."""
    text = io.StringIO()
    own = INTERFACES[law]
    text.write(f"# {law.__name__}: {own.equation}\n# driven by {own.driven_by}\n# {own.moves}\n")
    csv.writer(text, lineterminator="\n").writerows([("gain", "axis", "value", "unit"), *_rows(gains, law, gait)])
    return text.getvalue()


def write_json(
    gains: mc.Gains, law: type[mc.Law] = VirtualModelAdmittance, gait: Mapping[str, Any] = MappingProxyType({})
) -> str:
    """Return the gains of a law as JSON: the law's input, and each gain with its units and values by axis."""
    own = INTERFACES[law]
    said = {"name": law.__name__, "equation": own.equation, "driven_by": own.driven_by, "moves": own.moves}
    tree: dict[str, dict[str, Any]] = {"law": said}
    for name, axis, value, unit in _rows(gains, law, gait):
        entry = tree.setdefault(name, {"units": {}, "values": {}})
        entry["units"][axis], entry["values"][axis] = unit, value
    return json.dumps(tree, indent=2) + "\n"
