"""The grasp map of the standing feet: sharing a wrench among them, and the rigid part of their displacements.

With levers r to the feet, G_i = [1; r_i x] takes a force to its wrench, and G_i^T a twist (t, theta) to the motion
t + theta x r_i of a foot.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.physics.spatial import skew, solve_symmetric

_REGULARIZATION = 8.0  # in units of rounding: feet on a line cannot take any wrench
_SOFTNESS = 0.1  # of a limit on pulls, in units of a weight: where feet have to pull harder, they share it
_SWEEPS = 12  # of Gauss-Seidel through the limbs, which leave less than 0.001 of the largest force


def weighted_grasp(lever: Array, weight: Array) -> Array:
    """Return `sum weight G G^T` (6, 6) of levers (limb, 3) m and weights (limb,)."""
    one = jnp.eye(3, dtype=lever.dtype)
    first = skew((weight[:, None] * lever).sum(0))
    squares = (weight[:, None] * lever).T @ lever
    matrix = jnp.block([[weight.sum() * one, -first], [first, jnp.trace(squares) * one - squares]])
    rounding = float(jnp.finfo(lever.dtype).eps)
    return matrix + _REGULARIZATION * rounding * jnp.eye(6, dtype=lever.dtype)


def net_wrench(lever: Array, force: Array) -> Array:
    """Return the wrench (6,) of forces (limb, 3) about the point where the levers begin."""
    return jnp.concatenate([force.sum(0), jnp.cross(lever, force).sum(0)])


def moved_rigidly(lever: Array, twist: Array) -> Array:
    """Return the motion (limb, 3) of feet under a twist (6,): translation and rotation vector."""
    return twist[:3] + jnp.cross(twist[3:], lever)


def least_forces(wrench: Array, lever: Array, weight: Array) -> Array:
    """Return the forces (limb, 3) N of least `sum |F|^2 / weight` that make up a wrench w: `W G^T (G W G^T)^-1 w`."""
    twist = solve_symmetric(weighted_grasp(lever, weight), wrench[:, None])[:, 0]
    return weight[:, None] * moved_rigidly(lever, twist)


def rigid_twist(lever: Array, displacement: Array, weight: Array) -> Array:
    """Return the twist (6,) that is nearest to displacements (limb, 3), by least squares with weights (limb,)."""
    moments = net_wrench(lever, weight[:, None] * displacement)
    return jnp.asarray(solve_symmetric(weighted_grasp(lever, weight), moments[:, None])[:, 0])


def rigid_part(lever: Array, displacement: Array, weight: Array) -> Array:
    """Return the rigid motion (limb, 3) that is nearest to displacements, by least squares with weights (limb,)."""
    return moved_rigidly(lever, rigid_twist(lever, displacement, weight))


class Sharing(NamedTuple):
    """The forces of least `sum |F|^2 / weight` that make up a wrench, and how they change."""

    dual: Array  # (6, 1 + limb): F = weight G^T dual, of the wrench, and by each push on a foot
    vertical: Array  # (limb,) N, along the ground's normal
    change: Array  # (limb, limb): of the vertical forces, by pushes on the feet that leave the wrench as it is
    lever: Array  # (limb, 3) m
    weight: Array  # (limb,)


def sharing(wrench: Array, lever: Array, weight: Array) -> Sharing:
    """Return how feet at levers (limb, 3) m share a wrench (6,), with weights (limb,)."""
    normal = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0], wrench.dtype), lever.shape)
    pushes = weight[:, None] * jnp.concatenate([normal, jnp.cross(lever, normal)], axis=1)  # (limb, 6): W G^T's z
    dual = solve_symmetric(weighted_grasp(lever, weight), jnp.concatenate([wrench[None], pushes]).T)
    change = weight[:, None] * jnp.eye(len(weight), dtype=wrench.dtype) - pushes @ dual[:, 1:]
    return Sharing(dual, pushes @ dual[:, 0], change, lever, weight)


def pushed_up(share: Sharing, push: Array) -> Array:
    """Return the forces (limb, 3) N with pushes (limb,) on the feet that leave the wrench as it is."""
    motion = moved_rigidly(share.lever, share.dual[:, 0] - share.dual[:, 1:] @ push)
    return share.weight[:, None] * (motion + push[:, None] * jnp.array([0.0, 0.0, 1.0], push.dtype))


def distributed(wrench: Array, lever: Array, weight: Array, pull_limit: Array) -> Array:
    """Return the foot forces (limb, 3) N that make up a wrench (6,) N, N m.

    They minimise `sum |F|^2 / weight` with `sum G F` as the wrench, where a foot's pull on the ground, `-F_z`, is
    softly kept below `pull_limit` N. A foot of weight 0 bears nothing. (A quadratic program: its dual in the limits on
    pulls is solved by projected Gauss-Seidel, which keeps the wrench in each iteration.)

    Arguments:
        wrench: about the point where the levers begin, in any axes with z along the ground's normal.
        lever: (limb, 3) m, to the feet.
        weight: (limb,) 0 to 1.
        pull_limit: () N.
    """
    share, limbs = sharing(wrench, lever, weight), range(len(weight))
    # a sweep solves `(change + softness) multiplier = missing` row by row, scaled by its diagonal
    scale = 1 / (jnp.stack([share.change[limb, limb] for limb in limbs]) + _SOFTNESS)
    missing, rows = -scale * (pull_limit + share.vertical), -scale[:, None] * share.change
    multiplier = [jnp.zeros_like(pull_limit)] * len(weight)
    for _ in range(_SWEEPS):
        for limb in limbs:
            others = sum(rows[limb, other] * multiplier[other] for other in limbs if other != limb)
            multiplier[limb] = jnp.maximum(missing[limb] + others, 0.0)
    return pushed_up(share, jnp.stack(multiplier))
