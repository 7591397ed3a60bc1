"""Elements written as operations of JAX's on whole rows: what the regions of a CPU consist of."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.elements import Elements, Number, Value, Writer, known
from mjx_climb.execution.trigonometry import in_single


class ArrayWriter(Writer):
    """Numbers are arrays (lanes, *batch), with 1 in place of an axis on which they do not depend."""

    def __init__(self, lanes: int, batch: tuple[int, ...]) -> None:
        self.lanes, self.batch = lanes, batch
        self._widened: dict[tuple[int, tuple[int, ...]], tuple[Value, Array]] = {}
        self._parts: dict[int, tuple[Value, Sequence[Number]]] = {}  # what a value was put together from

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

    def operation(self, primitive: core.Primitive, parameters: Mapping[str, Any], operands: Sequence[Number]) -> Value:
        shape = self._common_shape(operands)
        # places of operands that must have the shape of the result; others may be single numbers
        whole = {"select_n": range(1, len(operands)), "clamp": [1], "add_any": [0, 1]}.get(primitive.name, ())
        rows = [
            self.rows(number, shape) if isinstance(number, Value) or place in whole else number
            for place, number in enumerate(operands)
        ]
        single = in_single(primitive.name, rows) if all(isinstance(o, Value) for o in operands) else None
        made: Array = primitive.bind(*rows, **primitive.get_bind_params(dict(parameters))) if single is None else single
        return self.value(made)

    def each_its_own(self, numbers: Sequence[Number]) -> Value:
        if all(isinstance(number, np.generic) for number in numbers):
            return self.value(cast(Array, np.array(numbers).reshape(-1, *[1] * len(self.batch))))
        shape = (1, *self._common_shape(numbers)[1:])
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
        if len(value.content) == 1:
            raise AssertionError("a value of which all lanes have the same is not combined over them")
        parts = self._parts[id(value)][1] if id(value) in self._parts else [value] * self.lanes
        mine, ones = map(self._lane, parts, range(self.lanes)), (1,) * (1 + len(self.batch))
        rows = [n.content if isinstance(n, Value) else lax.broadcast(jnp.asarray(n), ones) for n in mine]
        return self.value(functools.reduce(combine.bind, rows))

    def _lane(self, number: Number, lane: int) -> Number:
        """Return what a lane has of a number, as one that all lanes have."""
        if not isinstance(number, Value) or len(number.content) == 1:
            return number
        return self.value(lax.slice_in_dim(number.content, lane, lane + 1))

    def _common_shape(self, numbers: Sequence[Number]) -> tuple[int, ...]:
        return np.broadcast_shapes(*(n.content.shape for n in numbers if isinstance(n, Value)))

    # --- from arrays and to arrays

    def elements(
        self, do: Operations, array: Any, own: Sequence[int], axis: int | None, has: Sequence[bool]
    ) -> Elements:
        """Return an array (*own, *batch) as elements; `axis` runs over the lanes, `has` are its batch axes."""
        if not isinstance(array, jax.core.Tracer):
            return np.asarray(array)
        batch = tuple(size if h else 1 for size, h in zip(self.batch, has, strict=True))
        array = lax.reshape(array, (*own, *batch))
        others = [a for a in range(len(own)) if a != axis]
        made = np.empty([own[a] for a in others] + ([self.lanes] if axis is not None else []), object)
        for place in np.ndindex(*(own[a] for a in others)):
            starts, limits = [0] * array.ndim, list(array.shape)
            for a, index in zip(others, place, strict=True):
                starts[a], limits[a] = index, index + 1
            row = lax.reshape(lax.slice(array, starts, limits), (1 if axis is None else self.lanes, *batch))
            value = self.value(row)
            if axis is None:
                made[place] = value
            else:
                for lane in range(self.lanes):
                    made[(*place, lane)] = do.of_lane(value, lane)
        return made if axis is None else np.moveaxis(made, -1, axis)

    def array(self, do: Operations, elements: Elements, aval: Any, axis: int | None, has: Sequence[bool]) -> Array:
        """Return elements as an array (*own, *batch) of the batch axes that it `has`."""
        own = tuple(aval.shape)
        batch = tuple(size if h else 1 for size, h in zip(self.batch, has, strict=True))
        after = tuple(size for size, h in zip(self.batch, has, strict=True) if h)
        if not elements.size:
            return jnp.zeros((*own, *after), aval.dtype)
        if known(elements):
            return jnp.broadcast_to(jnp.asarray(elements, aval.dtype).reshape(*own, *[1] * len(after)), (*own, *after))
        if axis is None:
            numbers = [do.typed(do.same_for_all(element), aval.dtype) for element in elements.reshape(-1)]
            rows = [self.rows(number, (1, *batch)) for number in numbers]
            return lax.reshape(lax.concatenate(rows, 0), (*own, *after))
        lanes_last = np.moveaxis(elements, axis, -1)
        packed = [do.typed(do.packed(row), aval.dtype) for row in lanes_last.reshape(-1, self.lanes)]
        rows = [lax.expand_dims(self.rows(number, (self.lanes, *batch)), (1,)) for number in packed]
        whole = lax.reshape(lax.concatenate(rows, 1), (self.lanes, *lanes_last.shape[:-1], *after))
        return jnp.moveaxis(whole, 0, axis)
