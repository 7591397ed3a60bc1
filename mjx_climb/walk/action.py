"""What a robot is told in one step in place of what its control law says; layout of the hot path."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array


class JointTargets(NamedTuple):
    """Where the joint loop should take the joints: no inverse kinematics, no law."""

    angles: Array  # (J, L, B) rad


class BaseShift(NamedTuple):
    """How far the base should be from its reference, along the axes of the reference; the feet as the gait asks."""

    displacement: Array  # (6, B) m, rad: a translation and a rotation vector


Action = JointTargets | BaseShift | None  # None: what the law says


def displacement_of(action: JointTargets | BaseShift, wrench: Array) -> Array:
    """Return by how much an action shifts the base, (6, B) like the wrench: by nothing where it moves the joints."""
    return action.displacement if isinstance(action, BaseShift) else jnp.zeros_like(wrench)
