"""The holds on which limbs stand, and the forces that they bear."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.arrays import Tree
from mjx_climb.gait.footholds.footholds import pull_of_grip
from mjx_climb.ground import Holds, pull_within
from mjx_climb.physics.kinematics import UP
from mjx_climb.physics.spatial import norm

_ALONG = 1e-4  # sine of the angle of directions that count as along each other


class Held(NamedTuple):
    """The holds of limbs; they bear forces f of the ground on the foot, world axes, with `rows f <= bound`."""

    normal: Array  # (limb, 3) 1, unit, out of the ground
    rows: Array  # (limb, m, 3)
    bound: Array  # (limb, m) N


def no_holds(holds: Holds | None, feet: Array) -> Held | None:
    """Return the holds of feet (limb, 3) m on level ground without limits; None where there are no holds."""
    if holds is None:
        return None
    rows = holds.limit_bound.shape[1]
    bound = jnp.full_like(feet, jnp.inf, shape=(len(feet), rows))
    return Held(upright(feet), jnp.zeros_like(feet, shape=(len(feet), rows, 3)), bound)


def upright(feet: Array) -> Array:
    """Return the normals (limb, 3) of level ground."""
    return jnp.broadcast_to(jnp.array(UP, feet.dtype), feet.shape)


def pulls_of_holds(held: Held, holding_force: Array) -> Array:
    """Return the pulls that grips on holds bear, (limb, 3) N, each times the hold's normal; `holding_force` () N."""
    most = pull_within(-(held.rows * held.normal[:, None]).sum(2), held.bound)
    return pull_of_grip(most, holding_force)[:, None] * held.normal


def hold_axes(normal: Array, weight: Array) -> Array:
    """Return the axes of a hold as columns (3, 3): up the surface, across it, along the normal (3,).

    Up is against the weight (3,), or where that is along the normal the world's x, else its y.
    """
    length = norm(weight)
    x, y = jnp.eye(3, dtype=normal.dtype)[:2]
    up = y - (y @ normal) * normal
    for way in (x, -weight / jnp.where(length > 0, length, 1.0)):
        along = way - (way @ normal) * normal
        up = jnp.where(norm(along) > _ALONG, along, up)
    up = up / norm(up, at_zero=1.0)
    return jnp.stack([up, jnp.cross(normal, up), normal], axis=1)


def of_some(some: Array, new: Tree, old: Tree) -> Tree:
    """Return trees of arrays with the limbs in front: new for some limbs (limb,), old for the others."""
    each: Tree = jax.tree.map(lambda a, b: jnp.where(some.reshape(-1, *[1] * (b.ndim - 1)), a, b), new, old)
    return each
