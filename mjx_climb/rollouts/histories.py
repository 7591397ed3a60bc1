"""Time histories small enough to keep for a batch: the least and the largest value in each stretch of a walk."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_climb.dynamics.spatial import norm
from mjx_climb.rollouts.trajectory import Trajectory

STRETCHES = 200
_LEAST = "least of "  # before a line's name

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
    return together({name: np.asarray(value) for name, value in extremes(lines(trajectory)).items()})


def lines(sample: Any) -> dict[str, Any]:
    """Return `LINES` of a `Sample`, (), or of a `Trajectory`, (time,); by JAX or by NumPy, as its arrays are."""
    return {
        "foot_force_history": norm(sample.foot_force).max(-1),
        "base_deviation_history": norm(sample.base_position - sample.base_reference),
        "joint_torque_history": abs(sample.joint_torque).max((-2, -1)),
    }


def extremes(over_time: Mapping[str, Any]) -> dict[str, Any]:
    """Return the least and the largest value of lines (time,) in each stretch, (stretches,), for `together`.

    They are results of their own: put together within a compiled program each stretch would be an operation.
    """
    found: dict[str, Any] = {}
    for name, line in over_time.items():
        xp, (steps,) = line.__array_namespace__(), line.shape
        number, length = stretches(steps)
        # the last stretch is filled up with its last value
        rows = xp.concatenate([line, xp.repeat(line[-1:], number * length - steps)]).reshape(number, length)
        found |= {f"{_LEAST}{name}": rows.min(1), name: rows.max(1)}
    return found


def together(found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return results of walks with both `extremes` (..., stretches) of a line in one array, (..., 2, stretches)."""
    return {
        name: np.stack([found[f"{_LEAST}{name}"], value], axis=-2) if name in LINES else value
        for name, value in found.items()
        if not name.startswith(_LEAST)
    }
