"""A traced function carried out element by element, each operation once: what a GPU kernel consists of.

Everything that is known is listed: elementwise operations here, moves in `element_moves`, the rest in `element_rules`.
What is not listed, or has parameters that nobody has thought of, raises `Unsupported`.
"""

import math
import operator
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from mjx_climb.execution.devices import host
from mjx_climb.execution.element_moves import MOVES
from mjx_climb.execution.elements import Element, Elements, Key, Number, OfLane, Value, as_array, known, objects
from mjx_climb.execution.jax_internals import inner_program
from mjx_climb.execution.limbs import LimbAxes
from mjx_climb.execution.unsupported import Unsupported, refuse_unknown
from mjx_climb.execution.writer import Writer

MOST_ELEMENTS = 1000  # of one equation in a region: what has more is an array to XLA as well
MOST_OPERATIONS = 100_000  # a walk has some 4,000, or 9,000 without lanes; compilers take minutes for more than this
_DECIDED_ELSEWHERE = frozenset({"weak_type", "new_dtype", "y", "rounding_method"})  # by the operation itself

# each result element depends on one element of each operand
ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh bitcast_convert_type cbrt ceil clamp clz "
    "convert_element_type cos cosh div eq erf_inv exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p "
    "log2 logistic lt max min mul ne neg nextafter not one_minus_square or population_count pow rem round rsqrt "
    "select_n shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub tan "
    "tanh xor".split()
)


def can_write(equation: core.JaxprEqn) -> bool:
    """Return whether a region writes an equation as elements: nothing that loops, is large, or calls a library."""
    from mjx_climb.execution.element_rules import RULES

    name, atoms = equation.primitive.name, (*equation.invars, *equation.outvars)
    avals = [cast(Any, atom.aval) for atom in atoms]
    if equation.effects or name in ("scan", "cond") or any(_is_strange(aval.dtype) for aval in avals):
        return False
    if name not in MOVES and name not in RULES and name not in ELEMENTWISE and name != "iota":
        return False
    return sum(aval.size for aval in avals) <= MOST_ELEMENTS and _products(equation) <= MOST_ELEMENTS


def _is_strange(dtype: Any) -> bool:
    return bool(jnp.issubdtype(dtype, jax.dtypes.extended) or jnp.issubdtype(dtype, jnp.complexfloating))


def _products(equation: core.JaxprEqn) -> int:
    """Return how many products a product of matrices has, zero of anything else."""
    if equation.primitive.name != "dot_general":
        return 0
    (left, _), _ = equation.params["dimension_numbers"]
    terms = math.prod(cast(Any, equation.invars[0].aval).shape[axis] for axis in left)
    return int(terms * cast(Any, equation.outvars[0].aval).size)


class Operations:
    """Operations on elements, each of which is written once: asked for again, it gives the same result."""

    def __init__(
        self, writer: Writer, limbs: LimbAxes, before: "Mapping[Hashable, tuple[Any, Number]] | None" = None
    ) -> None:
        self.writer, self.limbs = writer, limbs
        # an operation and its operands: these, so that their ids stay their own, and the result
        self.done: dict[Hashable, tuple[Any, Number]] = dict(before or {})

    def inside(self) -> "Operations":
        """Return operations within a loop, which know those before it."""
        return Operations(self.writer, self.limbs, self.done)

    def results(self, jaxpr: core.Jaxpr, constants: Sequence[Any], arguments: Sequence[Elements]) -> list[Elements]:
        """Return the results of a jaxpr for arrays of elements."""
        values = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
        values |= dict(zip(jaxpr.invars, arguments, strict=True))

        def read(atom: core.Var | core.Literal) -> Elements:
            aval: Any = atom.aval
            return np.asarray(atom.val, aval.dtype) if isinstance(atom, core.Literal) else values[atom]

        for equation in jaxpr.eqns:
            try:
                results = self._equation(equation, [read(atom) for atom in equation.invars])
            except Unsupported as error:
                error.equation = error.equation or equation
                raise
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def closed(self, jaxpr: core.ClosedJaxpr, given: Sequence[Elements]) -> list[Elements]:
        """Return the results of a jaxpr with its constants."""
        return self.results(jaxpr.jaxpr, jaxpr.consts, given)

    def _equation(self, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
        from mjx_climb.execution.element_rules import RULES

        name, parameters = equation.primitive.name, equation.params
        if equation.effects:
            raise Unsupported(f"the operation {name}, which has effects,")
        if any(jnp.issubdtype(cast(Any, v.aval).dtype, jnp.complexfloating) for v in equation.outvars):
            raise Unsupported(f"the operation {name} on complex numbers")
        if (inner := inner_program(equation)) is not None:
            return self.closed(inner, given)
        if name in MOVES:
            move, understood = MOVES[name]
            refuse_unknown(name, parameters, understood)
            return move(given, parameters)
        if name in RULES and (name.startswith("random") or not all(map(known, given))):
            rule, understood = RULES[name]
            refuse_unknown(name, parameters, understood)
            return rule(self, equation, given)
        if all(map(known, given)):
            return _computed_now(equation.primitive, parameters, given)
        if name not in ELEMENTWISE:
            raise Unsupported(f"the operation {name}")
        refuse_unknown(name, parameters, _DECIDED_ELSEWHERE)
        if name == "bitcast_convert_type" and cast(Any, equation.outvars[0].aval).shape != given[0].shape:
            raise Unsupported("the operation bitcast_convert_type between numbers of different sizes")
        return [self.each(equation.primitive, parameters, *given)]

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
        return as_array(iter(result.reshape(-1)), result.shape)

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
    ) -> list[Element]:
        """Return an operation on operands that each have an element for each lane."""
        every = [element for row in rows for element in row]
        if any(isinstance(element, Key) for element in every) or not any(isinstance(e, OfLane) for e in every):
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

    def packed(self, elements: "Sequence[Any] | np.ndarray") -> "np.generic | Value":
        """Return a value of which each lane has the element of its place; elements that are all one stay that."""
        first = elements[0]
        if all(element is first for element in elements) and not isinstance(first, OfLane):
            return cast("np.generic | Value", first)
        if (value := _in_order(elements)) is not None:
            return value
        names = tuple(_name(element) for element in elements)
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

    def same_for_all(self, element: Number) -> "np.generic | Value":
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

    def element(self, primitive: core.Primitive, parameters: Mapping[str, Any], *operands: Element) -> Element:
        """Return an elementwise operation on single elements."""
        if any(isinstance(operand, Key) for operand in operands):
            return self._keys(primitive.name, operands)
        numbers = [cast(Number, operand) for operand in operands]
        if primitive.name in _SHORTCUTS and (result := _SHORTCUTS[primitive.name](*numbers)) is not None:
            return result
        lanes = {operand.lane for operand in numbers if isinstance(operand, OfLane)}
        if len(lanes) == 1:  # the other lanes may be asked for the same, and have done it then
            values = [operand.value if isinstance(operand, OfLane) else operand for operand in numbers]
            made = self._alike(primitive, parameters, *values)
            return made if isinstance(made, np.generic) else self.of_lane(made, *lanes)
        return self._alike(primitive, parameters, *map(self.same_for_all, numbers))

    def _alike(
        self, primitive: core.Primitive, parameters: Mapping[str, Any], *operands: "np.generic | Value"
    ) -> "np.generic | Value":
        """Return an elementwise operation that all lanes do with what they have."""
        if primitive.name in _SHORTCUTS and (result := _SHORTCUTS[primitive.name](*operands)) is not None:
            return cast("np.generic | Value", result)
        if all(isinstance(operand, np.generic) for operand in operands):
            [number] = _computed_now(primitive, parameters, operands)[0].reshape(1)
            return cast(np.generic, number)
        name = (primitive.name, str(parameters), *map(_name, operands))
        made = self._once(name, operands, lambda: self.writer.operation(primitive, parameters, operands))
        return cast(Value, made)

    def typed(self, number: Number, dtype: Any) -> Number:
        """Return a number in a precision, as it is where it has that."""
        if isinstance(number, np.generic):
            return cast(np.generic, np.asarray(number).astype(dtype)[()])
        if number.dtype == dtype:
            return number
        converted = {"new_dtype": np.dtype(dtype), "weak_type": False, "sharding": None}
        return cast(Number, self.element(lax.convert_element_type_p, converted, number))

    def _once(self, name: Hashable, operands: Any, make: Callable[[], Number]) -> Number:
        if name not in self.done:
            if len(self.done) >= MOST_OPERATIONS:
                raise Unsupported(f"a program of more than {MOST_OPERATIONS} operations on single numbers")
            self.done[name] = operands, make()
        return self.done[name][1]

    def _keys(self, name: str, operands: Sequence[Element]) -> Element:
        """Return the choice among random keys, the one operation that they have in common with numbers."""
        if name != "select_n":
            raise Unsupported(f"the operation {name} on random keys")
        which, *cases = operands
        keys = [cast(Key, case) for case in cases]
        high, low = [key.high for key in keys], [key.low for key in keys]
        return Key(*(cast(Number, self.element(lax.select_n_p, {}, which, *words)) for words in (high, low)))


def _in_order(elements: "Sequence[Any] | np.ndarray") -> Value | None:
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


def _name(element: Number) -> Hashable:
    return (element.dtype, element.tobytes()) if isinstance(element, np.generic) else id(element)


def _computed_now(
    primitive: core.Primitive, parameters: Mapping[str, Any], given: Sequence[Elements | Element]
) -> list[np.ndarray]:
    """Return the results of an operation on numbers alone, on the CPU, which compiles it sooner than a GPU."""
    bound = primitive.get_bind_params(dict(parameters))
    with jax.ensure_compile_time_eval(), jax.default_device(host()):
        results: Any = primitive.bind(*given, **bound)
        return [np.asarray(result) for result in (results if primitive.multiple_results else [results])]


# --- Operations that need not be written: the frames of a robot are full of zeros and ones. Those that XLA would leave
# --- out itself must be found here, as it stops the process at a kernel with a parameter that nothing reads any more.


def _product(a: Element, b: Element) -> Element | None:
    for one, other in ((a, b), (b, a)):
        if isinstance(one, np.generic) and one in (0, 1):
            return other if one == 1 else one
    return None


def _sum(a: Element, b: Element) -> Element | None:
    for one, other in ((a, b), (b, a)):
        if isinstance(one, np.generic) and one == 0:
            return other
    return None


def _difference(a: Element, b: Element) -> Element | None:
    if isinstance(b, np.generic) and b == 0:
        return a
    return cast(np.generic, cast(Number, b).dtype.type(0)) if a is b and _is_whole(b) else None


def _choice(which: Element, *cases: Element) -> Element | None:
    """Return the case that is taken whatever the choice, or the one that is known to be taken."""
    if isinstance(which, np.generic) and 0 <= int(which) < len(cases):
        return cases[int(which)]
    return cases[0] if len({_name(cast(Number, case)) for case in cases}) == 1 else None


def _both(a: Element, b: Element) -> Element | None:
    for one, other in ((a, b), (b, a)):
        if isinstance(one, np.generic):
            if one == 0:
                return one
            if one == _all_bits(one):
                return other
    return a if a is b else None


def _either(a: Element, b: Element) -> Element | None:
    for one, other in ((a, b), (b, a)):
        if isinstance(one, np.generic):
            if one == 0:
                return other
            if one == _all_bits(one):
                return one
    return a if a is b else None


def _all_bits(number: np.generic) -> Any:
    return ~np.zeros((), number.dtype)


def _of_equal(value: Any) -> Callable[..., Element | None]:
    """Return the shortcut of an operation that has this value, a truth or a zero, of whole numbers that are equal."""

    def shortcut(a: Element, b: Element) -> Element | None:
        if a is not b or not _is_whole(b):
            return None
        return cast(Element, np.bool_(value) if isinstance(value, bool) else cast(Value, b).dtype.type(value))

    return shortcut


def _compared(compare: Callable[[Any, Any], Any], equal: bool) -> Callable[..., Element | None]:
    """Return the shortcut of a comparison whose result is known from the range of whole numbers."""

    def shortcut(a: Element, b: Element) -> Element | None:
        found = _of_equal(equal)(a, b)
        if found is not None or not (_is_whole(a) and _is_whole(b)):
            return found
        ranges = [_range(number) for number in (a, b)]
        if any(ends is None for ends in ranges):
            return None
        results = {bool(compare(x, y)) for x in ranges[0] or () for y in ranges[1] or ()}
        return cast(Element, np.bool_(results.pop())) if len(results) == 1 else None

    return shortcut


def _range(number: Element) -> tuple[int, int]:
    """Return the least and the most that a whole number can be."""
    if isinstance(number, np.generic):
        return int(number), int(number)
    dtype = cast(Value, number).dtype
    if dtype.kind == "b":
        return 0, 1
    return int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)


def _extreme(better: Callable[[Any, Any], Any]) -> Callable[..., Element | None]:
    """Return the shortcut of a maximum or minimum of a value with itself, or with the end of its type's range."""

    def shortcut(a: Element, b: Element) -> Element | None:
        if a is b:
            return a
        for one, other in ((a, b), (b, a)):
            if isinstance(one, np.generic) and not isinstance(other, np.generic):
                least, most = _range(other) if _is_whole(one) else (-np.inf, np.inf)
                if one in (least, most):
                    return one if better(least, most) == one else other
        return None

    return shortcut


def _shifted(a: Element, b: Element) -> Element | None:
    if isinstance(b, np.generic) and int(b) >= 8 * b.dtype.itemsize:
        return cast(Element, cast(Value, a).dtype.type(0))
    return a if isinstance(b, np.generic) and b == 0 else None


def _remainder(a: Element, b: Element) -> Element | None:
    if _is_whole(b) and (a is b or (isinstance(b, np.generic) and abs(int(b)) == 1)):
        return cast(Element, cast(Value, a).dtype.type(0))
    return None


def _is_whole(element: Element) -> bool:
    return not isinstance(element, Key) and element.dtype.kind in "iub"


_IN_ANY_ORDER = frozenset({"add", "max", "min", "and", "or", "xor"})  # but for rounding

_SHORTCUTS: dict[str, Callable[..., Element | None]] = {
    "mul": _product,
    "add": _sum,
    "sub": _difference,
    "select_n": _choice,
    "and": _both,
    "or": _either,
    "xor": _of_equal(0),
    "eq": _of_equal(True),
    "ne": _of_equal(False),
    "lt": _compared(operator.lt, False),
    "le": _compared(operator.le, True),
    "gt": _compared(operator.gt, False),
    "ge": _compared(operator.ge, True),
    "max": _extreme(max),
    "min": _extreme(min),
    "rem": _remainder,
    "shift_left": _shifted,
    "shift_right_logical": _shifted,
}
