"""Gains as plain JSON and CSV, every number with its axis and unit."""

import csv
import io
import json
from collections.abc import Iterable
from typing import Any

import numpy as np

import mjx_climb as mc
from mjx_climb.files.dataset import SIX
from tuning.gains.ros2_control import six

UNITS = {  # of translations, of rotations
    "inertia": ("kg", "kg m^2"),
    "damping": ("N s/m", "N m s/rad"),
    "stiffness": ("N/m", "N m/rad"),
}
JOINT_UNITS = {"kp": "N m/rad", "kd": "N m s/rad"}
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


def read_csv(text: str) -> mc.Gains:
    """Return the gains that `write_csv` wrote."""
    table = list(csv.DictReader(io.StringIO(text)))
    return _gains([(row["gain"], row["axis"], float(row["value"])) for row in table])


def read_json(text: str) -> mc.Gains:
    """Return the gains that `write_json` wrote."""
    tree = json.loads(text)
    return _gains([(name, axis, value) for name, entry in tree.items() for axis, value in entry["values"].items()])


def _gains(table: Iterable[tuple[str, str, float]]) -> mc.Gains:
    values = {(name, axis): value for name, axis, value in table}
    gains: dict[str, Any] = {name: np.array([values[name, axis] for axis in SIX]) for name in UNITS}
    return mc.Gains(**gains | {name: values[name, "joints"] for name in JOINT_UNITS if (name, "joints") in values})
