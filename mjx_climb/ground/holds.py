"""Graspable points of a ground: where a gripper can hold, how the surface lies there, and how much it bears."""

import numpy as np
from jax import Array

from mjx_climb.component import Component, parameter

_ANY = (-np.inf, np.inf)


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
