"""Sine, cosine and the angle of a vector in single precision, of operations that a CPU carries out on whole vectors.

XLA:CPU calls the C library for these, once for each robot: half of the time of a step in regions. Up to a thousand
radians the errors are below 1.6 units in the last place for sine and cosine (near their zeros below 1e-7), for the
angle below 2.8; the library's are below 1.

References:
    S. L. Moshier, Cephes Mathematical Library, 1992: the coefficients (sinf.c, atanf.c), and pi / 2 in three parts.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_HALF_PI = (1.5703125, 4.8375129699707031e-4, 7.5497899548918821e-8)  # products with small whole numbers are exact
_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
_ANGLE = (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1)
_STEEP = math.tan(math.pi / 8)
_LARGEST = np.float32(0.8)  # above pi / 4: of angles so large that nothing is left of them the sine is still one


def in_single(name: str, operands: Sequence[Any]) -> Array | None:
    """Return what a primitive of JAX's gives, by operations on vectors; None where there are none for it."""
    if name not in _SINGLE or any(operand.dtype != np.float32 for operand in operands):
        return None
    result: Array = _SINGLE[name].bind(*operands)
    return result


def _sine(angle: Array) -> Array:
    return _of_quarter(*_reduced(angle))


def _cosine(angle: Array) -> Array:
    turns, rest = _reduced(angle)
    return _of_quarter(turns + 1, rest)


def _angle(y: Array, x: Array) -> Array:
    """Return the angle of vectors (x, y), in the half plane of y's sign, also of zero's."""
    y, x = jnp.broadcast_arrays(y, x)
    below, behind = _negative(y), _negative(x)
    high, wide = jnp.abs(y), jnp.abs(x)
    upright = high > wide
    short, long = lax.select(upright, wide, high), lax.select(upright, high, wide)
    steep = short > _STEEP * long
    top, bottom = lax.select(steep, short - long, short), lax.select(steep, short + long, long)
    slope = top / lax.select(bottom == 0, lax.full_like(bottom, 1), bottom)
    square = slope * slope
    angle = _polynomial(_ANGLE, square) * square * slope + slope
    angle = lax.select(steep, math.pi / 4 + angle, angle)
    angle = lax.select(upright, math.pi / 2 - angle, angle)
    angle = lax.select(behind, math.pi - angle, angle)
    return lax.select(below, -angle, angle)


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
    value = lax.select((quarter == 1) | (quarter == 3), cosine, sine)
    return lax.select(quarter >= 2, -value, value)


def _polynomial(coefficients: tuple[float, ...], x: Array) -> Array:
    """Return a polynomial, its coefficient of the highest power first."""
    value = coefficients[0] * x + coefficients[1]
    for coefficient in coefficients[2:]:
        value = value * x + coefficient
    return value


def _negative(x: Array) -> Array:
    return lax.bitcast_convert_type(x, np.int32) < 0


def _elementwise(name: str, function: Callable[..., Array], *derivatives: Callable[..., Array]) -> Primitive:
    """Return a primitive like JAX's own: its derivatives are known, and it is written out where it is compiled."""
    primitive = Primitive(name)
    primitive.def_impl(jax.jit(function))
    primitive.def_abstract_eval(lambda *of: of[0].update(shape=np.broadcast_shapes(*(each.shape for each in of))))
    batching.defvectorized(primitive) if len(derivatives) == 1 else batching.defbroadcasting(primitive)
    ad.defjvp(primitive, *derivatives)
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=False))
    return primitive


# by the names of JAX's
_SINGLE: dict[str, Primitive] = {
    "sin": _elementwise("sin_single", _sine, lambda rate, angle: rate * _SINGLE["cos"].bind(angle)),
    "cos": _elementwise("cos_single", _cosine, lambda rate, angle: -rate * _SINGLE["sin"].bind(angle)),
    "atan2": _elementwise(
        "atan2_single",
        _angle,
        lambda rate, y, x: rate * (x / (x * x + y * y)),
        lambda rate, y, x: rate * (-y / (x * x + y * y)),
    ),
}
NAMES = frozenset(primitive.name for primitive in _SINGLE.values())
