"""Operations on elements, each of which is written once: asked for again, it gives the same result."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, cast

import jax
import numpy as np
from jax import lax
from jax.extend import core

from mjx_climb.execution.devices import host
from mjx_climb.execution.element_shortcuts import SHORTCUTS, name_of
from mjx_climb.execution.elements import (
    Elements,
    Number,
    OfLane,
    Shared,
    Unsupported,
    Value,
    Writer,
    as_array,
    known,
    objects,
)
from mjx_climb.execution.limbs import LimbAxes

MOST_OPERATIONS = 100_000  # a walk has some 4,000, or 9,000 without lanes; compilers take minutes for more than this
_IN_ANY_ORDER = frozenset({"add", "max", "min", "and", "or"})  # but for rounding


class Operations:
    """Operations on elements, each of which is written once: asked for again, it gives the same result."""

    def __init__(
        self, writer: Writer, limbs: LimbAxes, before: Mapping[Hashable, tuple[Any, Number]] | None = None
    ) -> None:
        self.writer, self.limbs = writer, limbs
        # an operation and its operands: these, so that their ids stay their own, and the result
        self.done: dict[Hashable, tuple[Any, Number]] = dict(before or {})

    def inside(self) -> "Operations":
        """Return operations within a loop, which know those before it."""
        return Operations(self.writer, self.limbs, self.done)

    def each(self, primitive: core.Primitive, parameters: Mapping[str, Any], *arrays: Elements) -> Elements:
        """Return an elementwise operation on arrays that broadcast to each other.

        Where an axis of one of them runs over the lanes, the operation is written once for all its elements.
        """
        shape = np.broadcast_shapes(*(np.shape(array) for array in arrays))
        wide = [np.broadcast_to(array, shape) for array in arrays]
        axis = next((axis for axis in range(len(shape)) if any(self.runs_over_lanes(a, axis) for a in wide)), None)
        if axis is None:
            each = zip(*(array.reshape(-1) for array in wide), strict=True)
            return as_array((self.element(primitive, parameters, *operands) for operands in each), shape)
        rows = [np.moveaxis(objects(array), axis, -1).reshape(-1, self.writer.lanes) for array in wide]
        made = [self._of_all_lanes(primitive, parameters, row) for row in zip(*rows, strict=True)]
        result = np.empty((len(made), self.writer.lanes), object)
        for place, elements in enumerate(made):
            result[place] = elements
        others = [size for number, size in enumerate(shape) if number != axis]
        result = np.moveaxis(result.reshape(*others, self.writer.lanes), -1, axis)
        return as_array(result.reshape(-1), result.shape)

    def runs_over_lanes(self, array: Elements, axis: int) -> bool:
        """Return whether the elements along an axis are what the lanes have of one value, somewhere in an array.

        In any order: another one than theirs takes an exchange, once.
        """
        if known(array) or self.writer.lanes == 1 or array.shape[axis] != self.writer.lanes:
            return False
        rows = np.moveaxis(array, axis, -1).reshape(-1, self.writer.lanes)
        return any(_of_every_lane(row) for row in rows)

    def _of_all_lanes(
        self, primitive: core.Primitive, parameters: Mapping[str, Any], rows: Sequence[np.ndarray]
    ) -> list[Number]:
        """Return an operation on operands that each have an element for each lane."""
        if not any(isinstance(element, OfLane) for row in rows for element in row):
            return [self.element(primitive, parameters, *operands) for operands in zip(*rows, strict=True)]
        operands = [self.packed(row) for row in rows]
        made = self._alike(primitive, parameters, *operands)
        if isinstance(made, np.generic):
            return [made] * self.writer.lanes
        for row, operand in zip(rows, operands, strict=True):
            if made is operand:  # an operation that changes nothing
                return list(row)
        return [self.of_lane(made, lane) for lane in range(self.writer.lanes)]

    def of_lane(self, value: Value, lane: int) -> OfLane:
        """Return what a lane has of a value, the same object each time."""
        return cast(OfLane, self._once(("of lane", id(value), lane), value, lambda: OfLane(value, lane)))

    def packed(self, elements: Sequence[Any] | np.ndarray) -> Shared:
        """Return a value of which each lane has the element of its place; elements that are all one stay that."""
        first = elements[0]
        if all(element is first for element in elements) and not isinstance(first, OfLane):
            return cast(Shared, first)
        if (value := _in_order(elements)) is not None:
            return value
        names = tuple(name_of(element) for element in elements)
        if isinstance(first, np.generic) and len(set(names)) == 1:
            return first
        sources = {id(element.value): element.value for element in elements if isinstance(element, OfLane)}

        def made() -> Value:
            if len(sources) == 1 and all(isinstance(element, OfLane) for element in elements):
                [source] = sources.values()
                return self.writer.of_lanes(source, [element.lane for element in elements])
            own = [
                e.value if isinstance(e, OfLane) and e.lane == lane else self.same_for_all(e)
                for lane, e in enumerate(elements)
            ]
            return self.writer.each_its_own(own)

        return cast(Value, self._once(("packed", names), tuple(elements), made))

    def same_for_all(self, element: Number) -> Shared:
        """Return an element as a number that all lanes have."""
        if not isinstance(element, OfLane):
            return element
        value, lane = element.value, element.lane

        def made() -> Value:
            return self.writer.of_lanes(value, [lane] * self.writer.lanes)

        return cast(Value, self._once(("for all", id(value), lane), element, made))

    def together(self, combine: core.Primitive, parts: Sequence[Elements]) -> Elements:
        """Return arrays combined one after the other; those of the lanes by steps in which lanes change partners."""
        lanes, [first, *others] = self.writer.lanes, parts
        rows = list(zip(*(part.reshape(-1) for part in parts), strict=True))
        by_lanes = len(parts) == lanes > 1 and not lanes & (lanes - 1) and combine.name in _IN_ANY_ORDER
        if by_lanes and rows and all(_in_order(row) is not None for row in rows):
            totals = (self._total(combine, cast(Value, _in_order(row))) for row in rows)
            return as_array(totals, first.shape)
        for other in others:
            first = self.each(combine, {}, first, other)
        return first

    def _total(self, combine: core.Primitive, value: Value) -> Value:
        key, over_lanes = (combine.name, "over lanes", id(value)), self.writer.over_lanes
        total: Any = self._once(key, value, lambda: cast(Any, over_lanes(combine, value)))
        if total is not None:
            return cast(Value, total)
        distance = 1
        while distance < self.writer.lanes:
            partners = [lane ^ distance for lane in range(self.writer.lanes)]
            mine = value

            def made(mine: Value = mine, partners: list[int] = partners) -> Value:
                return self.writer.operation(combine, {}, [mine, self.writer.of_lanes(mine, partners)])

            value = cast(Value, self._once((combine.name, "of partners", id(mine), distance), mine, made))
            distance *= 2
        return value

    def element(self, primitive: core.Primitive, parameters: Mapping[str, Any], *operands: Number) -> Number:
        """Return an elementwise operation on single elements."""
        if primitive.name in SHORTCUTS and (result := SHORTCUTS[primitive.name](*operands)) is not None:
            return result
        lanes = {operand.lane for operand in operands if isinstance(operand, OfLane)}
        if len(lanes) == 1:  # the other lanes may be asked for the same, and have done it then
            values = [operand.value if isinstance(operand, OfLane) else operand for operand in operands]
            made = self._alike(primitive, parameters, *values)
            return made if isinstance(made, np.generic) else self.of_lane(made, *lanes)
        return self._alike(primitive, parameters, *map(self.same_for_all, operands))

    def _alike(self, primitive: core.Primitive, parameters: Mapping[str, Any], *operands: Shared) -> Shared:
        """Return an elementwise operation that all lanes do with what they have."""
        if primitive.name in SHORTCUTS and (result := SHORTCUTS[primitive.name](*operands)) is not None:
            return cast(Shared, result)
        if all(isinstance(operand, np.generic) for operand in operands):
            [number] = computed_now(primitive, parameters, operands)[0].reshape(1)
            return cast(np.generic, number)
        name = (primitive.name, str(parameters), *map(name_of, operands))
        made = self._once(name, operands, lambda: self.writer.operation(primitive, parameters, operands))
        return cast(Value, made)

    def typed(self, number: Shared, dtype: Any) -> Shared:
        """Return a number in a precision, as it is where it has that."""
        return cast(Shared, self.converted(as_array([number], ()), dtype)[()])

    def converted(self, array: Elements, dtype: Any) -> Elements:
        """Return an array in a precision, as it is where it has that."""
        if known(array):
            return array.astype(dtype)
        parameters = {"new_dtype": np.dtype(dtype), "weak_type": False, "sharding": None}
        types = {element.dtype for element in array.reshape(-1)}
        return array if types == {np.dtype(dtype)} else self.each(lax.convert_element_type_p, parameters, array)

    def _once(self, name: Hashable, operands: Any, make: Callable[[], Number]) -> Number:
        if name not in self.done:
            if len(self.done) >= MOST_OPERATIONS:
                raise Unsupported(f"a program of more than {MOST_OPERATIONS} operations on single numbers")
            self.done[name] = operands, make()
        return self.done[name][1]


def _in_order(elements: Sequence[Any] | np.ndarray) -> Value | None:
    """Return the value of which elements are what the lanes have, in their order; None where they are not that."""
    first = elements[0]
    if not isinstance(first, OfLane):
        return None
    value = first.value
    whole = all(isinstance(e, OfLane) and e.value is value and e.lane == n for n, e in enumerate(elements))
    return value if whole else None


def _of_every_lane(elements: np.ndarray) -> bool:
    """Return whether elements are what the lanes have of one value, each of another lane."""
    values = {id(e.value) if isinstance(e, OfLane) else None for e in elements}
    return len(values) == 1 and None not in values and len({e.lane for e in elements}) == len(elements)


def computed_now(primitive: core.Primitive, parameters: Mapping[str, Any], given: Sequence[Any]) -> list[np.ndarray]:
    """Return the results of an operation on numbers alone: by NumPy where its bits are XLA's, else on the CPU.

    XLA would compile a program for each operation and shape.
    """
    if primitive.name in _EXACT:
        return [np.asarray(_EXACT[primitive.name](*given))]
    bound = primitive.get_bind_params(dict(parameters))
    with jax.ensure_compile_time_eval(), jax.default_device(host()):
        results: Any = primitive.bind(*given, **bound)
        return [np.asarray(result) for result in (results if primitive.multiple_results else [results])]


_EXACT: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "and": np.bitwise_and,
    "eq": np.equal,
    "ge": np.greater_equal,
    "gt": np.greater,
    "le": np.less_equal,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.bitwise_not,
    "or": np.bitwise_or,
    "sub": np.subtract,
}
