"""Rotations, quaternions and small symmetric matrices, as far as JAX does not have them.

A vector is (3,), a rotation matrix (3, 3), a quaternion (4,) in the order wxyz. Functions whose shapes begin with dots
work over any leading axes and for NumPy's arrays, which stay NumPy's.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from mjx_climb.arrays import AnyArray, namespace


def norm(vector: Float[AnyArray, "... n"], at_zero: float = 0.0) -> Float[AnyArray, "..."]:
    """Return the Euclidean length, with derivative zero at the zero vector, where it is `at_zero` (1 in a divisor)."""
    xp = namespace(vector)
    square = (vector * vector).sum(-1)
    positive = square > 0
    # the square root's own derivative at zero is infinite, and infinite times zero is NaN
    return xp.where(positive, xp.sqrt(xp.where(positive, square, 1.0)), at_zero)


def skew(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the matrix of `cross(vector, .)`."""
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def symmetric(matrix: Float[AnyArray, "n n"]) -> Float[Array, "n n"]:
    """Return a matrix that is symmetric but for rounding with its lower triangle above the diagonal too.

    Nothing then depends on the upper one, and it is left out where a function is written element by element.
    """
    return jnp.where(np.tri(len(matrix), dtype=bool), matrix, matrix.T)


def turn_about_z(rotation: Float[AnyArray, "... 3 3"], angle: Float[AnyArray, "..."]) -> Float[AnyArray, "... 3 3"]:
    """Return rotations, each followed by a turn about its own z axis by an angle in rad."""
    xp = namespace(rotation, angle)
    c, s = xp.cos(angle)[..., None], xp.sin(angle)[..., None]
    x, y, z = rotation[..., 0], rotation[..., 1], rotation[..., 2]
    return xp.stack(xp.broadcast_arrays(c * x + s * y, c * y - s * x, z), axis=-1)


def quaternion_to_matrix(quaternion: Float[AnyArray, "4"]) -> Float[AnyArray, "3 3"]:
    """Return the rotation matrix of a unit quaternion, of JAX or of NumPy."""
    w, x, y, z = quaternion
    elements = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return namespace(quaternion).stack(elements).reshape(3, 3)


def quaternion_multiply(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "4"]:
    """Return the Hamilton product of two quaternions."""
    real = a[0] * b[0] - jnp.dot(a[1:], b[1:])
    vector = a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])
    return jnp.concatenate([real[None], vector])


def quaternion_conjugate(quaternion: Float[Array, "4"]) -> Float[Array, "4"]:
    """Return the inverse of a unit quaternion."""
    return jnp.concatenate([quaternion[:1], -quaternion[1:]])


def quaternion_normalize(quaternion: Float[Array, "4"]) -> Float[Array, "4"]:
    """Return the quaternion scaled to unit length."""
    return quaternion / jnp.sqrt(jnp.dot(quaternion, quaternion))


def quaternion_from_rotation_vector(vector: Float[Array, "3"]) -> Float[Array, "4"]:
    """Return the quaternion of a rotation vector in rad, smooth through zero."""
    square = jnp.dot(vector, vector)
    small = square < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    # sin(a/2)/a to seventh order in a: exact to rounding below a = 1e-3
    scale = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, jnp.sin(angle / 2) / angle)
    real = jnp.where(small, 1 - square / 8 + square**2 / 384, jnp.cos(angle / 2))
    return jnp.concatenate([real[None], scale * vector])


def inverse_3x3(matrix: Float[AnyArray, "3 3"]) -> Float[Array, "3 3"]:
    """Return the inverse of a symmetric matrix, by cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = matrix
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    inverse: Array = jnp.stack([aa, ab, ac, ab, bb, bc, ac, bc, cc]).reshape(3, 3) * (1 / (a * aa + b * ab + c * ac))
    return inverse


def solve_symmetric(
    matrix: Float[AnyArray, "... n n"], right: Float[AnyArray, "... n k"]
) -> Float[AnyArray, "... n k"]:
    """Return the solution of symmetric positive definite systems, by `L D L^T` written out element by element.

    XLA calls a library for `jnp.linalg.solve`, which takes longer than these few operations (docs/studies/speed.md).
    """
    size = matrix.shape[-1]
    lower: dict[tuple[int, int], AnyArray] = {}  # by row and column
    scaled: dict[tuple[int, int], AnyArray] = {}  # D L^T
    inverse: list[AnyArray] = []
    rows: list[AnyArray] = []
    for row in range(size):
        rows.append(right[..., row, :] - sum(lower[row, k] * rows[k] for k in range(row)))
        for column in range(row, size):
            value = matrix[..., row, column, None] - sum(lower[column, k] * scaled[k, row] for k in range(row))
            if column == row:
                inverse.append(1 / value)
            else:
                scaled[row, column], lower[column, row] = value, value * inverse[row]
    for row in reversed(range(size)):
        rows[row] = rows[row] * inverse[row] - sum(lower[k, row] * rows[k] for k in range(row + 1, size))
    return namespace(matrix, right).stack(rows, axis=-2)
