"""Vectors, rotations and quaternions with their components on the leading axis.

A vector is `(3, ...)`, a rotation matrix `(3, 3, ...)` (row, column), a quaternion `(4, ...)` in the order wxyz.
Trailing axes (limbs, batch) stay contiguous and broadcast, so every function here is elementwise over them.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float


def dot(a: Float[Array | np.ndarray, "n *#rest"], b: Float[Array, "n *#rest"]) -> Float[Array, "*_"]:
    """Return the scalar product over the leading axis, of any length."""
    product = a[0] * b[0]
    for i in range(1, a.shape[0]):
        product = product + a[i] * b[i]
    return product


def chosen(mask: np.ndarray, one: Array, other: Array) -> Array:
    """Return `one` where a constant mask is true, else `other`; an array that none of it asks for is left out.

    XLA:CPU ends the process at a kernel of which it has simplified such an array away.
    """
    if mask.all():
        return one
    return jnp.where(mask, one, other) if mask.any() else other


def cross(a: Float[Array | np.ndarray, "3 *#rest"], b: Float[Array | np.ndarray, "3 *#rest"]) -> Float[Array, "3 *_"]:
    """Return the vector product over the leading axis."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def norm(a: Float[Array | np.ndarray, "n *rest"]) -> Float[Array, "*rest"]:
    """Return the Euclidean length over the leading axis, with derivative zero at the zero vector."""
    square = jnp.sum(a * a, axis=0)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def rotate(matrix: Float[Array, "m n *#rest"], vector: Float[Array | np.ndarray, "n *#rest"]) -> Float[Array, "m *_"]:
    """Return `matrix @ vector`."""
    return matrix[:, 0] * vector[0] + matrix[:, 1] * vector[1] + matrix[:, 2] * vector[2]


def rotate_back(
    matrix: Float[Array | np.ndarray, "n 3 *#rest"], vector: Float[Array, "n *#rest"]
) -> Float[Array, "3 *_"]:
    """Return `matrix.T @ vector`."""
    return jnp.stack([dot(matrix[:, i], vector) for i in range(3)])


def compose(
    first: Float[Array, "3 3 *#rest"], second: Float[Array | np.ndarray, "3 3 *#rest"]
) -> Float[Array, "3 3 *_"]:
    """Return the matrix product `first @ second`."""
    return jnp.stack([rotate(first, second[:, j]) for j in range(3)], axis=1)


def rotation_about_z(angle: Float[Array | np.ndarray, "*rest"]) -> Float[Array, "3 3 *rest"]:
    """Return the rotation matrix about z, `(3, 3, ...)`, for an angle in rad."""
    c, s, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
    return jnp.stack([jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.stack([zero, zero, zero + 1])])


def quaternion_to_matrix(quaternion: Float[Array, "4 *rest"]) -> Float[Array, "3 3 *rest"]:
    """Return the rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = quaternion
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def quaternion_multiply(a: Float[Array, "4 *#rest"], b: Float[Array | np.ndarray, "4 *#rest"]) -> Float[Array, "4 *_"]:
    """Return the Hamilton product of two quaternions wxyz."""
    return jnp.stack(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


def quaternion_conjugate(quaternion: Float[Array, "4 *rest"]) -> Float[Array, "4 *rest"]:
    """Return the inverse of a unit quaternion wxyz."""
    return jnp.concatenate([quaternion[:1], -quaternion[1:]])


def quaternion_normalize(quaternion: Float[Array, "4 *rest"]) -> Float[Array, "4 *rest"]:
    """Return the quaternion scaled to unit length."""
    return quaternion / jnp.sqrt(jnp.sum(quaternion * quaternion, axis=0))


def quaternion_from_rotation_vector(vector: Float[Array, "3 *rest"]) -> Float[Array, "4 *rest"]:
    """Return the quaternion wxyz of a rotation vector in rad, smooth through zero."""
    square = jnp.sum(vector * vector, axis=0)
    small = square < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    # sin(a/2)/a to seventh order in a: exact to rounding below a = 1e-3
    scale = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, jnp.sin(angle / 2) / angle)
    real = jnp.where(small, 1 - square / 8 + square**2 / 384, jnp.cos(angle / 2))
    return jnp.concatenate([real[None], scale * vector])


def quaternion_about_z(angle: Float[Array | np.ndarray, "*rest"]) -> Float[Array, "4 *rest"]:
    """Return the quaternion wxyz of a rotation about z by an angle in rad."""
    zero = jnp.zeros_like(angle)
    return jnp.stack([jnp.cos(angle / 2), zero, zero, jnp.sin(angle / 2)])
