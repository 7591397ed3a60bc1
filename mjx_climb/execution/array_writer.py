"""Elements written as operations of JAX's on whole rows: the contents of a CPU's regions.

Sine, cosine and the angle of a vector have operations of their own in single precision, which a CPU carries out on
whole vectors: XLA:CPU calls the C library for these, once for each robot, half of the time of a step in regions. Up to
a thousand radians the errors are below 1.6 units in the last place for sine and cosine (near their zeros below 1e-7),
for the angle below 2.8; the library's are below 1.

References:
    S. L. Moshier, Cephes Mathematical Library, 1992: the coefficients (sinf.c, atanf.c), and pi / 2 in three parts.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core
from jax.interpreters import ad, batching, mlir

from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.elements import Elements, Number, Value, Writer, known
from mjx_climb.execution.jax_internals import carried_out
from mjx_climb.execution.jax_types import Parameters


class ArrayWriter(Writer):
    """Numbers are arrays (lanes, *batch), with 1 in place of an axis on which they do not depend."""

    def __init__(self, lanes: int, batch: tuple[int, ...]) -> None:
        self.lanes, self.batch = lanes, batch
        self._widened: dict[tuple[int, tuple[int, ...]], tuple[Value, Array]] = {}
        self._parts: dict[int, tuple[Value, Sequence[Number]]] = {}  # the parts of a value

    def value(self, rows: Array) -> Value:
        """Return numbers (lanes or 1, *batch or 1) as a value."""
        return Value(rows, np.dtype(rows.dtype))

    def rows(self, number: Number, shape: tuple[int, ...]) -> Array:
        """Return a number as an array of a shape."""
        if not isinstance(number, Value):
            return lax.broadcast(jnp.asarray(number), shape)
        content: Array = number.content
        if content.shape == shape:
            return content
        key = id(number), shape
        if key not in self._widened:
            self._widened[key] = number, lax.broadcast_in_dim(content, shape, tuple(range(len(shape))))
        return self._widened[key][1]

    def operation(self, primitive: core.Primitive, parameters: Parameters, operands: Sequence[Number]) -> Value:
        shape = _common_shape(operands)
        # places of operands that must have the shape of the result; others may be single numbers
        whole = {"select_n": range(1, len(operands)), "clamp": [1], "add_any": [0, 1]}.get(primitive.name, ())
        rows = [
            self.rows(number, shape) if isinstance(number, Value) or place in whole else number
            for place, number in enumerate(operands)
        ]
        single = (
            in_single(primitive.name, cast(list[Array], rows)) if all(isinstance(o, Value) for o in operands) else None
        )
        return self.value(carried_out(primitive, parameters, rows)[0] if single is None else single)

    def each_its_own(self, numbers: Sequence[Number]) -> Value:
        if all(isinstance(number, np.generic) for number in numbers):
            return self.value(cast(Array, np.array(numbers).reshape(-1, *[1] * len(self.batch))))
        shape = (1, *_common_shape(numbers)[1:])
        rows = [self.rows(self._lane(number, lane), shape) for lane, number in enumerate(numbers)]
        made = self.value(lax.concatenate(rows, 0))
        self._parts[id(made)] = made, numbers
        return made

    def of_lanes(self, value: Value, lanes: Sequence[int]) -> Value:
        if len(value.content) == 1:
            return value
        if id(value) in self._parts:  # XLA would see through it, and leave parts of it unread
            _, numbers = self._parts[id(value)]
            return self.each_its_own([self._lane(numbers[lane], lane) for lane in lanes])
        if len(set(lanes)) == 1:
            return self.value(lax.slice_in_dim(value.content, lanes[0], lanes[0] + 1))
        return self.value(lax.concatenate([lax.slice_in_dim(value.content, lane, lane + 1) for lane in lanes], 0))

    def over_lanes(self, combine: core.Primitive, value: Value) -> Value:
        parts = self._parts[id(value)][1] if id(value) in self._parts else [value] * self.lanes
        mine, ones = map(self._lane, parts, range(self.lanes)), (1,) * (1 + len(self.batch))
        rows = [n.content if isinstance(n, Value) else lax.broadcast(jnp.asarray(n), ones) for n in mine]
        return self.value(functools.reduce(combine.bind, rows))

    def _lane(self, number: Number, lane: int) -> Number:
        """Return one lane's number, broadcast to all lanes."""
        if not isinstance(number, Value) or len(number.content) == 1:
            return number
        return self.value(lax.slice_in_dim(number.content, lane, lane + 1))

    # --- from arrays and to arrays

    def elements(
        self, do: Operations, array: Array, own: Sequence[int], axis: int | None, has: Sequence[bool]
    ) -> Elements:
        """Return an array (*own, *batch) as elements; `axis` runs over the lanes, `has` are its batch axes."""
        if not isinstance(array, jax.core.Tracer):
            return np.asarray(array)
        batch = tuple(size if h else 1 for size, h in zip(self.batch, has, strict=True))
        array, lanes = lax.reshape(array, (*own, *batch)), 1 if axis is None else self.lanes

        def row(place: tuple[int, ...]) -> Value:
            starts = [*place, *[0] * len(batch)]
            limits = [*(n + (lanes if a == axis else 1) for a, n in enumerate(place)), *batch]
            return self.value(lax.reshape(lax.slice(array, starts, limits), (lanes, *batch)))

        places = np.ndindex(*(1 if a == axis else size for a, size in enumerate(own)))
        return do.taken_apart(map(row, places), own, axis)

    def array(
        self, do: Operations, elements: Elements, aval: jax.ShapeDtypeStruct, axis: int | None, has: Sequence[bool]
    ) -> Array:
        """Return elements as an array (*own, *batch) of the batch axes that it `has`."""
        own = tuple(aval.shape)
        batch = tuple(size if h else 1 for size, h in zip(self.batch, has, strict=True))
        after = tuple(size for size, h in zip(self.batch, has, strict=True) if h)
        if not elements.size:
            return jnp.zeros((*own, *after), aval.dtype)
        if known(elements):
            return jnp.broadcast_to(jnp.asarray(elements, aval.dtype).reshape(*own, *[1] * len(after)), (*own, *after))
        numbers = do.put_together(elements, aval.dtype, axis)
        if axis is None:
            rows = [self.rows(number, (1, *batch)) for number in numbers]
            return lax.reshape(lax.concatenate(rows, 0), (*own, *after))
        rows = [lax.expand_dims(self.rows(number, (self.lanes, *batch)), (1,)) for number in numbers]
        others = [size for number, size in enumerate(own) if number != axis]
        return jnp.moveaxis(lax.reshape(lax.concatenate(rows, 1), (self.lanes, *others, *after)), 0, axis)


def _common_shape(numbers: Sequence[Number]) -> tuple[int, ...]:
    return np.broadcast_shapes(*(n.content.shape for n in numbers if isinstance(n, Value)))


# --- trigonometry in single precision

_HALF_PI = (1.5703125, 4.8375129699707031e-4, 7.5497899548918821e-8)  # products with small whole numbers are exact
_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
_ANGLE = (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1)
_STEEP = math.tan(math.pi / 8)
_LARGEST = np.float32(0.8)  # above pi / 4: of angles so large that nothing is left of them the sine is still one


def in_single(name: str, operands: Sequence[Array]) -> Array | None:
    """Return the result of a primitive in single precision by vector operations, None where there are none."""
    if name not in _SINGLE or any(operand.dtype != np.float32 for operand in operands):
        return None
    result: Array = _SINGLE[name].bind(*operands)
    return result


def _sine(angle: Array, quarters: int = 0) -> Array:
    """Return the sine of an angle and some quarter turns more, by the nearest whole number of them and the rest."""
    turns = lax.round(angle * (2 / math.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    rest = angle
    for part in _HALF_PI:
        rest = rest - turns * part
    rest = lax.clamp(-_LARGEST, rest, _LARGEST)
    turns = turns + quarters if quarters else turns
    square = rest * rest
    sine = _polynomial(_SINE, square) * square * rest + rest
    cosine = _polynomial(_COSINE, square) * square * square - 0.5 * square + 1
    quarter = turns - 4 * jnp.floor(turns / 4)  # 0, 1, 2, 3: whole numbers of any size are exact
    value = lax.select((quarter == 1) | (quarter == 3), cosine, sine)
    return lax.select(quarter >= 2, -value, value)


def _angle(y: Array, x: Array) -> Array:
    """Return the angle of vectors (x, y), in the half plane of y's sign, also of zero's."""
    y, x = jnp.broadcast_arrays(y, x)
    below, behind = (lax.bitcast_convert_type(each, np.int32) < 0 for each in (y, x))
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


def _polynomial(coefficients: tuple[float, ...], x: Array) -> Array:
    """Return a polynomial, its coefficient of the highest power first."""
    value = coefficients[0] * x + coefficients[1]
    for coefficient in coefficients[2:]:
        value = value * x + coefficient
    return value


def _elementwise(name: str, function: Callable[..., Array], *derivatives: Callable[..., Array]) -> core.Primitive:
    """Return a primitive like JAX's own: its derivatives are known, and it is written out where it is compiled."""
    primitive = core.Primitive(name)
    primitive.def_impl(jax.jit(function))
    primitive.def_abstract_eval(lambda *of: of[0].update(shape=np.broadcast_shapes(*(each.shape for each in of))))
    batching.defvectorized(primitive) if len(derivatives) == 1 else batching.defbroadcasting(primitive)
    ad.defjvp(primitive, *derivatives)
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=False))
    return primitive


# by the names of JAX's
_SINGLE: dict[str, core.Primitive] = {
    "sin": _elementwise("sin_single", _sine, lambda rate, angle: rate * _SINGLE["cos"].bind(angle)),
    "cos": _elementwise(
        "cos_single", functools.partial(_sine, quarters=1), lambda rate, angle: -rate * _SINGLE["sin"].bind(angle)
    ),
    "atan2": _elementwise(
        "atan2_single",
        _angle,
        lambda rate, y, x: rate * (x / (x * x + y * y)),
        lambda rate, y, x: rate * (-y / (x * x + y * y)),
    ),
}
