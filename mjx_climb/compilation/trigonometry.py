"""Sine, cosine and the angle of a vector in single precision, of operations that a CPU carries out on whole vectors.

XLA:CPU calls the C library for these, once for each robot: half of the time of a step in pieces. Up to a thousand
radians the errors are below 1.6 units in the last place for sine and cosine (near their zeros below 1e-7), for the
angle below 2.8; the library's are below 1.

References:
    S. L. Moshier, Cephes Mathematical Library, 1992: the coefficients (sinf.c, atanf.c), and pi / 2 in three parts.
"""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

_HALF_PI = (1.5703125, 4.8375129699707031e-4, 7.5497899548918821e-8)  # products with small whole numbers are exact
_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
_ANGLE = (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1)
_STEEP = math.tan(math.pi / 8)
_LARGEST = np.float32(0.8)  # above pi / 4: of angles so large that nothing is left of them the sine is still one


def sine(angle: Array) -> Array:
    """Return the sine of an angle in radians."""
    return _of_quarter(*_reduced(angle))


def cosine(angle: Array) -> Array:
    """Return the cosine of an angle in radians."""
    turns, rest = _reduced(angle)
    return _of_quarter(turns + 1, rest)


def angle_of(y: Array, x: Array) -> Array:
    """Return the angle of vectors (x, y) in radians, in the half plane of y's sign, also of zero's."""
    # selections by one comparison each, no absolute values or maxima: their derivatives go wrong at zero and at ties
    below, behind = _negative(y), _negative(x)
    high, wide = jnp.where(below, -y, y), jnp.where(behind, -x, x)
    upright = high > wide
    short, long = jnp.where(upright, wide, high), jnp.where(upright, high, wide)
    steep = short > _STEEP * long
    top, bottom = jnp.where(steep, short - long, short), jnp.where(steep, short + long, long)
    zero = bottom == 0
    slope = jnp.where(zero, 0.0, top) / jnp.where(zero, 1.0, bottom)
    square = slope * slope
    angle = _polynomial(_ANGLE, square) * square * slope + slope
    angle = jnp.where(steep, math.pi / 4 + angle, angle)
    angle = jnp.where(upright, math.pi / 2 - angle, angle)
    angle = jnp.where(behind, math.pi - angle, angle)
    return jnp.where(below, -angle, angle)


# by the names of JAX's primitives
VECTORISED: dict[str, Callable[..., Array]] = {"sin": sine, "cos": cosine, "atan2": angle_of}


def vectorises(name: str, operands: list[Any]) -> bool:
    """Return whether a primitive has a form here for these operands."""
    return name in VECTORISED and all(operand.dtype == np.float32 for operand in operands)


def _reduced(angle: Array) -> tuple[Array, Array]:
    """Return an angle in whole quarter turns and the rest, within pi / 4."""
    turns = lax.round(angle * (2 / math.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    rest = angle
    for part in _HALF_PI:
        rest = rest - turns * part
    return turns, lax.clamp(-_LARGEST, rest, _LARGEST)


def _of_quarter(turns: Array, rest: Array) -> Array:
    """Return the sine of so many quarter turns and a rest within pi / 4."""
    square = rest * rest
    sine = _polynomial(_SINE, square) * square * rest + rest
    cosine = _polynomial(_COSINE, square) * square * square - 0.5 * square + 1
    quarter = turns - 4 * jnp.floor(turns / 4)  # 0, 1, 2, 3: whole numbers of any size are exact
    value = jnp.where((quarter == 1) | (quarter == 3), cosine, sine)
    return jnp.where(quarter >= 2, -value, value)


def _polynomial(coefficients: tuple[float, ...], x: Array) -> Array:
    """Return a polynomial, its coefficient of the highest power first."""
    value = coefficients[0] * x + coefficients[1]
    for coefficient in coefficients[2:]:
        value = value * x + coefficient
    return value


def _negative(x: Array) -> Array:
    return lax.bitcast_convert_type(x, np.int32) < 0
