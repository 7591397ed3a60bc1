"""Graspable points of a ground: where a gripper can hold, how the surface lies there, and how much it bears."""

from typing import NamedTuple

import numpy as np
from jax import Array

from mjx_climb.arrays import AnyArray, namespace
from mjx_climb.component import Component, parameter

_ANY = (-np.inf, np.inf)
# a pull along the normal has a negative force of the ground on the foot
_PULL = np.array([[0.0, 0.0, -1.0]]), np.array([1.0])


class Shown(NamedTuple):
    """Holds as they are drawn."""

    position: np.ndarray  # (n, 3) m, world
    normal: np.ndarray  # (n, 3) 1
    pull: np.ndarray  # (n,) N, the largest along the normal; infinite: any


class Holds(Component):
    """Points that a gripper can hold, in world axes, padded to a fixed number.

    A hold bears forces f of the ground on the foot with `limit_matrix f <= limit_bound`, in axes of its own: z along
    the normal. A ground without such limits has none of these rows.
    """

    position: Array = parameter("m", shape=(None, 3), bounds=_ANY)
    normal: Array = parameter("1", shape=(None, 3), bounds=_ANY)  # unit, out of the ground
    limit_matrix: Array = parameter("1", shape=(None, None, 3), bounds=_ANY)
    limit_bound: Array = parameter("N", shape=(None, None), bounds=(0.0, np.inf))
    valid: Array = parameter("1", shape=(None,), bounds=(0.0, 1.0))  # 1: a hold, 0: padding

    def pulls(self) -> AnyArray:
        """The largest pull along the normal alone that each hold bears, (n,) N; infinite where it bears any."""
        return pull_within(-self.limit_matrix[..., 2], self.limit_bound)

    def shown(self) -> Shown:
        """The holds without the padding, for pictures."""
        there = np.asarray(self.valid) > 0
        return Shown(*(np.asarray(each)[there] for each in (self.position, self.normal, self.pulls())))


def pull_within(used: AnyArray, bound: AnyArray) -> AnyArray:
    """The largest pull, (...) N, by uses (..., m) of limits (..., m) N a newton; infinite: any."""
    xp = namespace(bound, used)
    most = xp.where(used > 0, bound / xp.where(used > 0, used, 1.0), np.inf)
    return most.min(-1, initial=np.inf)


def of(
    position: np.ndarray,
    normal: np.ndarray | None = None,
    limit: np.ndarray | float | None = None,
    polyhedron: tuple[np.ndarray, np.ndarray] | None = None,
    count: int | None = None,
) -> Holds:
    """Holds as arrays of NumPy in double precision, padded to a number of them.

    Arguments:
        position: (n, 3) m, world.
        normal: (n, 3) 1, of any length above 0; None: up.
        limit: (n,) or () N, infinite for a point that holds any force; None: no point has a limit.
        polyhedron: A (m, 3) and b (m,), a share of the limit, of `A f <= b limit`; None: the pull along the normal.
        count: how many holds there are with the padding; None: n.

    Raises:
        ValueError: more points than the count.
    """
    number = len(position)
    if (room := (number if count is None else count) - number) < 0:
        raise ValueError(f"holds: expected {count} points at most, got {number}")
    normal = np.tile([0.0, 0.0, 1.0], (number, 1)) if normal is None else np.asarray(normal, float)
    matrix, bound = _PULL if polyhedron is None else polyhedron
    rows = len(matrix) if limit is not None else 0
    limits = np.broadcast_to(np.inf if limit is None else limit, number)
    # a share of 0 of a limit that is infinite is 0
    bounds = np.multiply.outer(limits, bound, where=np.asarray(bound) > 0, out=np.zeros((number, len(matrix))))
    # first by the largest part: the square of a small one is 0
    unit = normal / np.abs(normal).max(1, keepdims=True, initial=0)
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    arrays: dict[str, AnyArray] = {
        "position": np.pad(np.asarray(position, float), ((0, room), (0, 0))),
        "normal": np.vstack([unit, np.tile([0.0, 0.0, 1.0], (room, 1))]),
        "limit_matrix": np.pad(np.tile(matrix[:rows], (number, 1, 1)), ((0, room), (0, 0), (0, 0))),
        "limit_bound": np.pad(bounds[:, :rows], ((0, room), (0, 0)), constant_values=1.0),
        "valid": np.repeat([1.0, 0.0], [number, room]),
    }
    return Holds(**arrays)
