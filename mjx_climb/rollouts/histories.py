"""Time histories small enough to keep for a batch: the least and the largest value in each stretch of a walk."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_climb.dynamics.spatial import norm
from mjx_climb.rollouts.trajectory import Trajectory

STRETCHES = 200

# name: unit, long name, and the metric that is its largest value
LINES: dict[str, tuple[str, str, str]] = {
    "foot_force_history": ("N", "largest foot force", "peak_foot_force"),
    "base_deviation_history": ("m", "base off its reference", "base_deviation"),
    "joint_torque_history": ("N m", "largest joint torque", "peak_joint_torque"),
}


class Stretches(NamedTuple):
    """How a walk is cut up."""

    number: int
    steps: int  # of one stretch; the last may be shorter


def stretches(steps: int) -> Stretches:
    """Return the stretches of a walk of so many steps: `STRETCHES` of them, or fewer."""
    length = math.ceil(steps / STRETCHES)
    return Stretches(math.ceil(steps / length), length)


def histories(trajectory: Trajectory) -> dict[str, Float[np.ndarray, "extreme stretch"]]:
    """Return `LINES` of one walk, (2, stretches): the least and the largest value in each stretch."""
    return {name: np.asarray(value) for name, value in extremes(lines(trajectory)).items()}


def lines(sample: Any) -> dict[str, Any]:
    """Return `LINES` of a `Sample`, (), or of a `Trajectory`, (time,); by JAX or by NumPy, as its arrays are."""
    return {
        "foot_force_history": norm(sample.foot_force).max(-1),
        "base_deviation_history": norm(sample.base_position - sample.base_reference),
        "joint_torque_history": abs(sample.joint_torque).max((-2, -1)),
    }


def extremes(over_time: Mapping[str, Any]) -> dict[str, Any]:
    """Return the least and the largest value of lines (time,) in each stretch, (2, stretches)."""
    found = {}
    for name, line in over_time.items():
        xp, (steps,) = line.__array_namespace__(), line.shape
        number, length = stretches(steps)
        # the last stretch is filled up with its last value
        rows = xp.concatenate([line, xp.repeat(line[-1:], number * length - steps)]).reshape(number, length)
        found[name] = xp.stack([rows.min(1), rows.max(1)])
    return found
