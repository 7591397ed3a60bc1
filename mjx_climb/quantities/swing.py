"""The shapes of a swing over its phase; written with operators alone, so that arrays of JAX and of numpy do."""

from typing import TypeVar

import numpy as np
from jax import Array

COUNT = 6  # of added shapes for each axis

_Phase = TypeVar("_Phase", Array, np.ndarray)


def rest_to_rest(phase: _Phase) -> _Phase:
    """Return the cubic from 0 to 1 with zero slope at both ends; its curvature is zero in the middle."""
    return phase * phase * (3 - 2 * phase)


def lift(phase: _Phase) -> _Phase:
    """Return the height of a swing, from 0 to 1 in the middle and back to 0, at rest in all three."""
    return rest_to_rest(1 - abs(2 * phase - 1))


def added_shapes(phase: _Phase) -> tuple[list[_Phase], list[_Phase]]:
    """Return the shapes that may be added to a swing: `COUNT` for each horizontal axis, and as many for the height.

    All are zero with zero slope at both ends; those for the height are zero in the middle as well. The first is the
    lift itself: to add it sideways tilts the arc.
    """
    across = 2 * phase - 1
    bump = (1 - across * across) ** 2
    horizontal = [lift(phase)] + [bump * across**k for k in range(COUNT - 1)]
    return horizontal, [across * shape for shape in horizontal]
