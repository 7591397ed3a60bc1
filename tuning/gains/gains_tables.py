"""Gains as plain JSON and CSV, every number with its axis and unit."""

import csv
import io
import json
from typing import Any

import mjx_climb as mc
from mjx_climb.files.dataset import COORDINATES, SIX
from tuning.gains.ros2_control import six

# of translations and of rotations
UNITS = {name: tuple(COORDINATES[name][0].split(", ")) for name in mc.Gains.AXES}
JOINT_UNITS = {name: COORDINATES[name][0] for name in ("kp", "kd")}
COLUMNS = ("gain", "axis", "value", "unit")


def rows(gains: mc.Gains) -> list[tuple[str, str, float, str]]:
    """Return one row per number: gain, axis ("joints" for kp and kd), value, unit."""
    table = [
        (name, axis, float(value), UNITS[name][axis.startswith("r")])
        for name, values in zip(UNITS, six(gains), strict=True)
        for axis, value in zip(SIX, values, strict=True)
    ]
    joint = {name: getattr(gains, name) for name in JOINT_UNITS}
    return table + [(name, "joints", float(v), JOINT_UNITS[name]) for name, v in joint.items() if v is not None]


def write_csv(gains: mc.Gains) -> str:
    """Return the gains as CSV in long form: a header, then `rows`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([COLUMNS, *rows(gains)])
    return text.getvalue()


def write_json(gains: mc.Gains) -> str:
    """Return the gains as JSON: each gain with its unit and a value for each axis."""
    tree: dict[str, dict[str, dict[str, Any]]] = {}
    for name, axis, value, unit in rows(gains):
        entry = tree.setdefault(name, {"units": {}, "values": {}})
        entry["units"][axis], entry["values"][axis] = unit, value
    return json.dumps(tree, indent=2) + "\n"
