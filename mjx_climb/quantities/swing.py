"""The shapes of a swing over its phase; written with operators alone, so that arrays of JAX and of numpy do."""

from typing import TypeVar

import numpy as np
from jax import Array

COUNT = 6  # of added shapes for each axis

_Phase = TypeVar("_Phase", Array, np.ndarray)


def rest_to_rest(phase: _Phase) -> _Phase:
    """Return the cubic from 0 to 1 with zero slope at both ends; its curvature is zero in the middle."""
    risen: _Phase = phase * phase * (3 - 2 * phase)
    return risen


def lift(phase: _Phase) -> _Phase:
    """Return the height of a swing, from 0 to 1 in the middle and back to 0, at rest in all three."""
    return rest_to_rest(1 - abs(2 * phase - 1))


def added_shapes(phase: _Phase) -> tuple[list[_Phase], list[_Phase]]:
    """Return the shapes that may be added to a swing: `COUNT` for each horizontal axis, and as many for the height.

    All are zero with zero slope and curvature at both ends, so that a foot leaves its foothold and comes to the next in
    the direction of the cubic; those for the height are zero in the middle as well.
    """
    across = 2 * phase - 1
    bump = (1 - across * across) ** 3
    horizontal = [bump * across**k if k else bump for k in range(COUNT)]
    return horizontal, [across * shape for shape in horizontal]
