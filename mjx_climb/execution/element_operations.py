"""Operations on elements, each written once or not at all: the frames of a robot are full of zeros and ones.

Operations that XLA would leave out must be found here too (`SHORTCUTS`): XLA stops the process at a kernel with a
parameter that nothing reads any more.
"""

import functools
import itertools
import operator
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import cast

import jax
import numpy as np
from jax import lax
from jax.extend import core
from numpy.typing import DTypeLike

from mjx_climb.execution.devices import host
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
from mjx_climb.execution.jax_internals import carried_out
from mjx_climb.execution.jax_types import Parameters
from mjx_climb.execution.limbs import Axis, LimbAxes

MOST_OPERATIONS = 50_000  # a walk has some 4,000, or 9,000 without lanes; compilers take minutes for more than this
_IN_ANY_ORDER = frozenset({"add", "max", "min", "and", "or"})  # but for rounding


class Operations:
    """Operations on elements. Each is written once: asked for again, it gives the same result."""

    def __init__(
        self, writer: Writer, limbs: LimbAxes, before: Mapping[Hashable, tuple[object, Number]] | None = None
    ) -> None:
        self.writer, self.limbs = writer, limbs
        # an operation and its operands: these, so that their ids stay their own, and the result
        self.done: dict[Hashable, tuple[object, Number]] = dict(before or {})

    def each(self, primitive: core.Primitive, parameters: Parameters, *arrays: Elements) -> Elements:
        """Return an elementwise operation on arrays that broadcast to each other.

        Where an axis of one of them runs over the lanes, the operation is written once for all its elements.
        """
        shape = np.broadcast_shapes(*(np.shape(array) for array in arrays))
        wide = [np.broadcast_to(array, shape) for array in arrays]
        axis = next((axis for axis in range(len(shape)) if any(self.runs_over_lanes(a, axis) for a in wide)), None)
        if axis is None:
            each = zip(*(array.reshape(-1) for array in wide), strict=True)
            return as_array((self.element(primitive, parameters, *operands) for operands in each), shape)

        def of_all_lanes(*rows: np.ndarray) -> Iterable[Number]:  # an element for each lane of each operand
            if not any(isinstance(element, OfLane) for row in rows for element in row):
                return [self.element(primitive, parameters, *operands) for operands in zip(*rows, strict=True)]
            operands = [self.packed(row) for row in rows]
            made = self.alike(primitive, parameters, *operands)
            for row, operand in zip(rows, operands, strict=True):
                if made is operand:  # an operation that changes nothing
                    return row
            return [self.of_lane(made, lane) for lane in range(self.writer.lanes)]

        return self._of_rows(map(of_all_lanes, *(self._rows(array, axis) for array in wide)), shape, axis)

    def runs_over_lanes(self, array: Elements, axis: int) -> bool:
        """Return whether the elements along an axis are the lanes' parts of one value, somewhere in an array.

        In any order: another one than theirs takes an exchange, once.
        """
        if known(array) or self.writer.lanes == 1 or array.shape[axis] != self.writer.lanes:
            return False
        for row in np.moveaxis(array, axis, -1).reshape(-1, self.writer.lanes):
            values = {id(element.value) if isinstance(element, OfLane) else None for element in row}
            if len(values) == 1 and None not in values and len({element.lane for element in row}) == len(row):
                return True
        return False

    def of_lane(self, value: Shared, lane: int) -> Number:
        """Return a lane's number, the same object each time."""
        return value if isinstance(value, np.generic) else value.parts.setdefault(lane, OfLane(value, lane))

    def taken_apart(self, values: Iterable[Shared], shape: Sequence[int], axis: Axis) -> Elements:
        """Return values as the elements of an array: each is one, or with `axis` those of all lanes along it."""
        if axis is None:
            return as_array(values, shape)
        each = ([self.of_lane(value, lane) for lane in range(self.writer.lanes)] for value in values)
        return self._of_rows(each, shape, axis)

    def put_together(self, array: Elements, dtype: DTypeLike, axis: Axis) -> list[Shared]:
        """Return the elements of an array as numbers of all lanes in a precision; see `taken_apart`."""
        if axis is None:
            return [self.typed(self.same_for_all(element), dtype) for element in objects(array).reshape(-1)]
        return [self.typed(self.packed(row), dtype) for row in self._rows(array, axis)]

    def _rows(self, array: Elements, axis: int) -> Elements:
        """Return the elements of an array in rows along an axis that runs over the lanes."""
        return np.moveaxis(objects(array), axis, -1).reshape(-1, self.writer.lanes)

    def _of_rows(self, rows: Iterable[Iterable[Number]], shape: Sequence[int], axis: int) -> Elements:
        others = [size for number, size in enumerate(shape) if number != axis]
        return np.moveaxis(as_array(itertools.chain.from_iterable(rows), (*others, self.writer.lanes)), -1, axis)

    def packed(self, elements: Sequence[Number] | np.ndarray) -> Shared:
        """Return a value that gives each lane the element of its place; elements that are all one stay that."""
        first = elements[0]
        if all(element is first for element in elements) and not isinstance(first, OfLane):
            return cast(Shared, first)
        if (value := _in_order(elements)) is not None:
            return value
        names = tuple(_name_of(element) for element in elements)
        if isinstance(first, np.generic) and len(set(names)) == 1:
            return first

        def made() -> Value:
            sources = {id(element.value): element.value for element in elements if isinstance(element, OfLane)}
            lanes = [element.lane for element in elements if isinstance(element, OfLane)]
            if len(sources) == 1 and len(lanes) == len(elements):
                return self.writer.of_lanes(next(iter(sources.values())), lanes)
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
        name, lanes = ("for all", id(element.value), element.lane), [element.lane] * self.writer.lanes
        return cast(Value, self._once(name, element, lambda: self.writer.of_lanes(element.value, lanes)))

    def together(self, combine: core.Primitive, parts: Sequence[Elements]) -> Elements:
        """Return arrays combined one after the other; those of the lanes by steps in which lanes change partners."""
        lanes = self.writer.lanes
        if len(parts) == lanes > 1 and not lanes & (lanes - 1) and combine.name in _IN_ANY_ORDER:
            values = [_in_order(row) for row in zip(*(part.reshape(-1) for part in parts), strict=True)]
            if values and all(values):
                return as_array((self.total(combine, cast(Value, value)) for value in values), parts[0].shape)
        return functools.reduce(functools.partial(self.each, combine, {}), parts)

    def total(self, combine: core.Primitive, value: Value) -> Value:
        """Return a value reduced over all lanes."""
        writer, over_lanes = self.writer, self.writer.over_lanes
        name = combine.name, "over lanes", id(value)
        total = cast(Value | None, self._once(name, value, lambda: cast(Value, over_lanes(combine, value))))

        def with_partners(value: Value, distance: int) -> Value:
            partners, name = [n ^ distance for n in range(writer.lanes)], (combine.name, id(value), distance)
            both = self._once(
                name, value, lambda: writer.operation(combine, {}, [value, writer.of_lanes(value, partners)])
            )
            return cast(Value, both)

        distances = (1 << n for n in range((writer.lanes - 1).bit_length()))
        return functools.reduce(with_partners, distances, value) if total is None else total

    def element(self, primitive: core.Primitive, parameters: Parameters, *operands: Number) -> Number:
        """Return an elementwise operation on single elements."""
        if primitive.name in SHORTCUTS and (result := SHORTCUTS[primitive.name](*operands)) is not None:
            return result
        lanes = {operand.lane for operand in operands if isinstance(operand, OfLane)}
        if len(lanes) == 1:  # the other lanes may be asked for the same, and have done it then
            values = [operand.value if isinstance(operand, OfLane) else operand for operand in operands]
            return self.of_lane(self.alike(primitive, parameters, *values), *lanes)
        return self.alike(primitive, parameters, *map(self.same_for_all, operands))

    def alike(self, primitive: core.Primitive, parameters: Parameters, *operands: Shared) -> Shared:
        """Return an elementwise operation that each lane does with its own part."""
        if primitive.name in SHORTCUTS and (result := SHORTCUTS[primitive.name](*operands)) is not None:
            return cast(Shared, result)
        if all(isinstance(operand, np.generic) for operand in operands):
            [number] = computed_now(primitive, parameters, cast(Sequence[np.generic], operands))[0].reshape(1)
            return cast(np.generic, number)
        name = (primitive.name, str(parameters), *map(_name_of, operands))
        made = self._once(name, operands, lambda: self.writer.operation(primitive, parameters, operands))
        return cast(Value, made)

    def choice(self, which: Elements, cases: Sequence[Elements], shape: Sequence[int]) -> Elements:
        """Return arrays of a shape chosen by whole numbers `which`, that of the nearest where there is none for one."""
        if len(cases) == 1:
            return cases[0]
        if which.dtype != bool:
            ends = [self.typed_like(which, end) for end in (0, len(cases) - 1)]
            which = self.converted(self.each(lax.clamp_p, {}, ends[0], which, ends[1]), np.int32)
        return self.each(lax.select_n_p, {}, np.broadcast_to(which, shape), *cases)

    def typed_like(self, array: Elements, number: int) -> np.ndarray:
        """Return a whole number in the type of an array that has elements."""
        return np.asarray(number, array.reshape(-1)[0].dtype)

    def typed(self, number: Shared, dtype: DTypeLike) -> Shared:
        """Return a number in a precision, as it is where it has that."""
        if number.dtype == dtype:
            return number
        return cast(Shared, self.converted(as_array([number], ()), dtype)[()])

    def converted(self, array: Elements, dtype: DTypeLike) -> Elements:
        """Return an array in a precision, as it is where it has that."""
        if known(array):
            return array.astype(dtype)
        parameters = {"new_dtype": np.dtype(dtype), "weak_type": False, "sharding": None}
        types = {element.dtype for element in array.reshape(-1)}
        return array if types == {np.dtype(dtype)} else self.each(lax.convert_element_type_p, parameters, array)

    def _once(self, name: Hashable, operands: object, make: Callable[[], Number]) -> Number:
        if name not in self.done:
            if len(self.done) >= MOST_OPERATIONS:
                raise Unsupported(f"a program of more than {MOST_OPERATIONS} operations on single numbers")
            self.done[name] = operands, make()
        return self.done[name][1]


def _in_order(elements: Sequence[Number] | np.ndarray) -> Value | None:
    """Return the value whose lanes have these elements, in their order; None where there is none."""
    first = elements[0]
    if not isinstance(first, OfLane):
        return None
    value = first.value
    whole = all(isinstance(e, OfLane) and e.value is value and e.lane == n for n, e in enumerate(elements))
    return value if whole else None


def computed_now(
    primitive: core.Primitive, parameters: Parameters, given: Sequence[Elements | np.generic]
) -> list[np.ndarray]:
    """Return the results of an operation on numbers alone: by NumPy where it has them, else on the CPU.

    XLA would compile a program for each operation and shape.
    """
    with np.errstate(all="ignore"):
        found = _BY_NUMPY[primitive.name](parameters, *given) if primitive.name in _BY_NUMPY else None
    if found is not None:
        return [*map(np.asarray, found)]
    with jax.ensure_compile_time_eval(), jax.default_device(host()):
        return [*map(np.asarray, carried_out(primitive, parameters, given))]


ByNumPy = Callable[..., Sequence[object] | None]  # of the parameters and numbers: the results, None: those of XLA


def _each(function: Callable[..., object], kinds: str = "biuf") -> ByNumPy:
    """Return an elementwise operation, for numbers of some kinds."""
    return lambda p, *x: [function(*x)] if x[-1].dtype.kind in kinds else None


def _converted(p: Parameters, x: Elements) -> Sequence[object] | None:
    new = np.dtype(p["new_dtype"])
    return None if x.dtype.kind == "f" and new.kind in "iu" else [x.astype(new)]  # beyond the ends they differ


def _counted(p: Parameters) -> Sequence[object]:
    shape = [p["shape"][p["dimension"]] if axis == p["dimension"] else 1 for axis in range(len(p["shape"]))]
    return [np.broadcast_to(np.arange(shape[p["dimension"]], dtype=p["dtype"]).reshape(shape), p["shape"])]


def _padded(p: Parameters, x: Elements, value: Elements) -> Sequence[object]:
    sizes, places, inside = [], [], []
    for size, (low, high, between) in zip(x.shape, p["padding_config"], strict=True):
        sizes.append(low + size + max(size - 1, 0) * between + high)
        place = low + np.arange(size) * (between + 1)
        inside.append(np.flatnonzero((place >= 0) & (place < sizes[-1])))
        places.append(place[inside[-1]])
    result = np.full(sizes, value, x.dtype)
    result[np.ix_(*places)] = x[np.ix_(*inside)]
    return [result]


def _reduced(function: np.ufunc, kinds: str) -> ByNumPy:
    return lambda p, x: [function.reduce(x, tuple(p["axes"]), x.dtype)] if x.size and x.dtype.kind in kinds else None


def _product(p: Parameters, x: Elements, y: Elements) -> Sequence[object]:
    (summed, summed_of_y), (batch, batch_of_y) = p["dimension_numbers"]
    names = dict(zip((*summed_of_y, *batch_of_y), (*summed, *batch), strict=True))
    of_y = [names.get(axis, x.ndim + axis) for axis in range(y.ndim)]
    own = [axis for axis in (*range(x.ndim), *of_y) if axis not in (*summed, *batch)]
    product = np.einsum(x, [*range(x.ndim)], y, of_y, [*batch, *own])
    return [product.astype(p["preferred_element_type"] or product.dtype)]


def _power(p: Parameters, x: Elements) -> Sequence[object] | None:
    return [np.power(x, x.dtype.type(p["y"]))] if x.dtype.kind == "f" else None


# The bits are XLA's but for those of sums, powers and functions, which are so to rounding.
_BY_NUMPY: dict[str, ByNumPy] = {
    **{name: _each(function) for name, function in {
        "abs": np.abs, "add": np.add, "add_any": np.add, "and": np.bitwise_and, "eq": np.equal,
        "ge": np.greater_equal, "gt": np.greater, "le": np.less_equal, "lt": np.less, "max": np.maximum,
        "min": np.minimum, "mul": np.multiply, "ne": np.not_equal, "neg": np.negative, "not": np.bitwise_not,
        "or": np.bitwise_or, "square": np.square, "sub": np.subtract,
    }.items()},
    **{name: _each(function, "f") for name, function in {
        "ceil": np.ceil, "cos": np.cos, "div": np.divide, "exp": np.exp, "floor": np.floor, "log": np.log,
        "sin": np.sin, "sqrt": np.sqrt, "tan": np.tan,
    }.items()},
    "convert_element_type": _converted,
    "dot_general": _product,
    "integer_pow": _power,
    "iota": _counted,
    "pad": _padded,
    "reduce_and": _reduced(np.bitwise_and, "biu"),
    "reduce_max": _reduced(np.maximum, "biu"),
    "reduce_min": _reduced(np.minimum, "biu"),
    "reduce_or": _reduced(np.bitwise_or, "biu"),
    "reduce_sum": _reduced(np.add, "iuf"),
    "rev": lambda p, x: [np.flip(x, tuple(p["dimensions"]))],
    "select_n": lambda p, which, *cases: [np.where(which, *cases[::-1])] if len(cases) == 2 else None,
    "split": lambda p, x: np.split(x, np.cumsum(p["sizes"])[:-1], p["axis"]),
    "unstack": lambda p, x: [*np.moveaxis(x, p["axis"], 0)],
}  # fmt: skip


# --- operations that need not be written

Shortcut = Callable[..., Number | None]  # of the operands: the result, None where the operation must be written


def _name_of(element: Number) -> Hashable:
    """Return a key that is equal for elements that are the same number."""
    return (element.dtype, element.tobytes()) if isinstance(element, np.generic) else id(element)


def _range(dtype: np.dtype) -> tuple[float, float]:
    """Return the least and the largest number of a type."""
    if dtype.kind == "f":
        return -np.inf, np.inf
    return (0, 1) if dtype.kind == "b" else (int(np.iinfo(dtype).min), int(np.iinfo(dtype).max))


def _with(ends: Callable[[np.dtype], tuple[object, object]], *, itself: bool = True) -> Shortcut:
    """Return the shortcut of an operation by its neutral and its absorbing number; `itself`: of two equal ones too."""

    def shortcut(a: Number, b: Number) -> Number | None:
        if itself and a is b:
            return a
        for one, other in ((a, b), (b, a)):
            if isinstance(one, np.generic):
                neutral, absorbing = ends(one.dtype)
                if absorbing is not None and one == absorbing:
                    return one
                if one == neutral:
                    return other
        return None

    return shortcut


def _compared(compare: Callable[[float, float], object]) -> Shortcut:
    """Return the shortcut of a comparison whose result is known: of equals, or from the range of whole numbers."""

    def shortcut(a: Number, b: Number) -> Number | None:
        if a.dtype.kind not in "iub" or b.dtype.kind not in "iub":
            return None
        if a is b:
            return np.bool_(compare(0, 0))
        if compare in (operator.eq, operator.ne):
            return None
        ends = [(int(e), int(e)) if isinstance(e, np.generic) else _range(e.dtype) for e in (a, b)]
        results = {bool(compare(x, y)) for x in ends[0] for y in ends[1]}
        return np.bool_(results.pop()) if len(results) == 1 else None

    return shortcut


def _difference(a: Number, b: Number) -> Number | None:
    if isinstance(b, np.generic) and b == 0:
        return a
    return b.dtype.type(0) if a is b and b.dtype.kind in "iub" else None


def _remainder(a: Number, b: Number) -> Number | None:
    nothing = b.dtype.kind in "iub" and (a is b or (isinstance(b, np.generic) and abs(int(b)) == 1))
    return a.dtype.type(0) if nothing else None


def _shifted(a: Number, b: Number) -> Number | None:
    if isinstance(b, np.generic) and int(b) >= 8 * b.dtype.itemsize:
        return a.dtype.type(0)
    return a if isinstance(b, np.generic) and b == 0 else None


def _choice(which: Number, *cases: Number) -> Number | None:
    """Return the case that is taken whatever the choice, or the one that is known to be taken."""
    if isinstance(which, np.generic) and 0 <= int(which) < len(cases):
        return cases[int(which)]
    return cases[0] if len({_name_of(case) for case in cases}) == 1 else None


# of an operation on numbers of a type: the neutral and the absorbing number
_ENDS: dict[str, Callable[[np.dtype], tuple[object, object]]] = {
    "add": lambda dtype: (0, None),
    "add_any": lambda dtype: (0, None),
    "mul": lambda dtype: (1, 0),
    "and": lambda dtype: (~np.zeros((), dtype), 0),
    "or": lambda dtype: (0, ~np.zeros((), dtype)),
    "max": _range,
    "min": lambda dtype: _range(dtype)[::-1],
}


def neutral(combine: core.Primitive, dtype: np.dtype) -> object:
    """Return the neutral number of an operation: its result for no numbers at all."""
    return _ENDS[combine.name](dtype)[0]


SHORTCUTS: dict[str, Shortcut] = {
    **{name: _with(ends, itself=name not in ("add", "add_any", "mul")) for name, ends in _ENDS.items()},
    "sub": _difference,
    "xor": _difference,
    "rem": _remainder,
    "shift_left": _shifted,
    "shift_right_logical": _shifted,
    "select_n": _choice,
    **{name: _compared(getattr(operator, name)) for name in ("eq", "ne", "lt", "le", "gt", "ge")},
}
