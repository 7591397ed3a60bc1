"""Forward derivatives in a kernel: beside a number its rate of change along one direction.

What the values need is written by another writer. Here each of them has its slope as a sum of a few rates, each times a
factor, and its own rate is written out only where another function is made of the sum. So of a chain of functions the
derivatives are multiplied first. What depends on nothing that moves has no rate.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from mjx_climb.compilation.element_operations import Operations
from mjx_climb.compilation.elements import Element, Elements, Key, Number, OfLane, Value, as_array, flat
from mjx_climb.compilation.unsupported import Unsupported
from mjx_climb.compilation.writer import Writer

MOST_TERMS = 3  # of a sum that is not written out: with more or fewer a walk takes longer


@dataclasses.dataclass(frozen=True, eq=False)
class _Sloped:
    """A number of the writer of the values, and its slope: rates of that writer, each with its factor."""

    value: Number
    slope: Mapping[Number, Number]


class SlopesWriter(Writer):
    """Writes a function of one robot together with its slopes along a direction, by a writer of values."""

    def __init__(self, values: Writer) -> None:
        self.lanes = values.lanes
        self._values, self._do = values, Operations(values)
        self._written: dict[_Sloped, Number] = {}  # rates, in this loop and around it
        self._derivatives: dict[Any, core.ClosedJaxpr] = {}

    def given(self, value: Number, rate: Number | None = None) -> Value:
        """Return a number that has this rate, or none."""
        return _value(value, {} if rate is None else {rate: _known(1, value.dtype)})

    def value_of(self, number: Number) -> Number:
        """Return a number without its slope."""
        return number if isinstance(number, np.generic) else _sloped(number).value

    def rate_of(self, number: Number) -> Number:
        """Return the rate of a number, written out."""
        terms = [self._product(factor, rate) for rate, factor in self._slope(number).items()]
        if not terms:
            return _known(0, number.dtype)
        rate, *others = terms
        for term in others:
            rate = self._number(lax.add_p, {}, rate, term)
        self._written[_sloped(number)] = rate
        return rate

    def moves(self, number: Number) -> bool:
        return bool(self._slope(number))

    def moving(self, number: Number) -> Number:
        return number if self.moves(number) else self.given(self.value_of(number), self.rate_of(number))

    def operation(self, primitive: core.Primitive, parameters: Mapping[str, Any], operands: Sequence[Number]) -> Value:
        values = [self.value_of(operand) for operand in operands]
        made = self._number(primitive, parameters, *values)
        moving = [place for place, operand in enumerate(operands) if self.moves(operand)]
        if not moving or made.dtype.kind != "f":
            return self.given(made)
        if primitive is lax.select_n_p:  # not by factors: a rate that is not taken may be infinite
            return self.given(made, self._number(primitive, parameters, values[0], *map(self.rate_of, operands[1:])))
        slope: dict[Number, Number] = {}
        for place in moving:
            factor = self._derivative(primitive, parameters, values, place)
            for rate, own in self._multiple(operands[place], factor).items():
                slope[rate] = self._number(lax.add_p, {}, slope[rate], own) if rate in slope else own
        result = _value(made, {rate: own for rate, own in slope.items() if not _is_zero(own)})
        if len(slope) > MOST_TERMS:
            self.rate_of(result)
        return result

    def each_its_own(self, numbers: Sequence[Number]) -> Value:
        made = self._values.each_its_own([self.value_of(number) for number in numbers])
        if not any(map(self.moves, numbers)):
            return self.given(made)
        return self.given(made, self._values.each_its_own([*map(self.rate_of, numbers)]))

    def of_lanes(self, value: Value, lanes: Sequence[int]) -> Value:
        made = self._of_lanes(self.value_of(value), lanes)
        return self.given(made, self._of_lanes(self.rate_of(value), lanes) if self.moves(value) else None)

    def by_own_rule(self, do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
        if equation.primitive.name != "custom_jvp_call":
            raise Unsupported(f"the slope of the operation {equation.primitive.name}")
        moving = [place for place, array in enumerate(given) if do.moves(array)]
        values = [self._each(array, self.value_of) for array in given]
        rates = [self._each(given[place], self.rate_of) for place in moving]
        found = self._do.closed(_by_own_rule(equation, moving), [*values, *rates])
        count = len(equation.outvars)
        return [self._together(do, *pair) for pair in zip(found[:count], found[count:], strict=True)]

    def loop(self, steps: int, start: Sequence[Number], step: Callable[[list[Value]], Sequence[Number]]) -> list[Value]:
        moving = [self.moves(number) for number in start]

        def apart(numbers: Sequence[Number]) -> list[Number]:
            """Return the numbers, and then the rates of those that move."""
            if any(self.moves(number) and not moves for number, moves in zip(numbers, moving, strict=True)):
                raise Unsupported("a loop in which something begins to move that should not")
            return [*map(self.value_of, numbers), *map(self.rate_of, itertools.compress(numbers, moving))]

        def together(numbers: Sequence[Number]) -> list[Value]:
            rates = iter(numbers[len(moving) :])
            values = zip(numbers, moving, strict=False)
            return [self.given(value, next(rates) if moves else None) for value, moves in values]

        def both(before: list[Value]) -> list[Number]:
            outside = self._do, self._written
            self._do, self._written = Operations(self._values, self._do.done), dict(self._written)
            made = apart(step(together(before)))
            self._do, self._written = outside
            return made

        return together(self._values.loop(steps, apart(start), both))

    def _each(self, array: Elements, part: Callable[[Number], Number]) -> Elements:
        """Return what `part` gives of each number, as elements of the writer of the values."""

        def of(element: Element) -> Element:
            if isinstance(element, Key):
                raise Unsupported("random keys in a function whose slope comes by a rule of its own")
            if not isinstance(element, OfLane):
                return part(element)
            number = part(element.value)
            return self._do.of_lane(number, element.lane) if isinstance(number, Value) else number

        return as_array(map(of, flat([array])), array.shape)

    def _together(self, do: Operations, values: Elements, rates: Elements) -> Elements:
        """Return elements of the writer of the values, with their rates."""
        made: dict[tuple[int, int], Value] = {}  # what lanes have of one value stays that

        def of(value: Number, rate: Number) -> Number:
            lane = value.lane if isinstance(value, OfLane) else None
            if lane is None:
                rate = self._do.same_for_all(rate)
            both = [number.value if isinstance(number, OfLane) else number for number in (value, rate)]
            key = id(both[0]), id(both[1])
            if key not in made:
                made[key] = self.given(both[0], None if _is_zero(both[1]) else both[1])
            return made[key] if lane is None else do.of_lane(made[key], lane)

        pairs = zip(flat([values]), flat([rates]), strict=True)
        return as_array((of(cast(Number, value), cast(Number, rate)) for value, rate in pairs), values.shape)

    def _slope(self, number: Number) -> Mapping[Number, Number]:
        if isinstance(number, np.generic):
            return {}
        written = self._written.get(_sloped(number))
        return _sloped(number).slope if written is None else {written: _known(1, number.dtype)}

    def _multiple(self, number: Number, factor: Number) -> Mapping[Number, Number]:
        """Return the slope of a number times a factor."""
        if len(self._slope(number)) > 1 and not isinstance(factor, np.generic):
            self.rate_of(number)
        return {rate: self._product(factor, own) for rate, own in self._slope(number).items()}

    def _derivative(
        self, primitive: core.Primitive, parameters: Mapping[str, Any], values: Sequence[Number], place: int
    ) -> Number:
        """Return the derivative of an operation by one operand."""
        kinds = [value.dtype for value in values]
        key = primitive.name, str(parameters), tuple(kinds), place
        if key not in self._derivatives:
            rule = _SHORTER.get((primitive.name, place)) or _by_jax(primitive, parameters, place)
            self._derivatives[key] = jax.make_jaxpr(rule)(*(jax.ShapeDtypeStruct((), kind) for kind in kinds))
        [found] = self._do.closed(self._derivatives[key], [as_array(iter([value]), ()) for value in values])
        return cast(Number, found[()])

    def _of_lanes(self, number: Number, lanes: Sequence[int]) -> Number:
        return self._values.of_lanes(number, lanes) if isinstance(number, Value) else number

    def _product(self, a: Number, b: Number) -> Number:
        return self._number(lax.mul_p, {}, a, b)

    def _number(self, primitive: core.Primitive, parameters: Mapping[str, Any], *operands: Number) -> Number:
        return cast(Number, self._do.element(primitive, parameters, *operands))


def _by_own_rule(equation: core.JaxprEqn, moving: Sequence[int]) -> core.ClosedJaxpr:
    """Return a function with a rule of its own, of its operands and the rates of those that move: results and rates."""
    count = len(equation.invars)

    def both(*given: Array) -> tuple[Any, Any]:
        def results(some: Sequence[Array]) -> Any:
            every = list(given[:count])
            for place, value in zip(moving, some, strict=True):
                every[place] = value
            return equation.primitive.bind(*every, **equation.primitive.get_bind_params(equation.params))

        return jax.jvp(results, ([given[place] for place in moving],), ([*given[count:]],))

    kinds = [cast(Any, atom.aval) for atom in equation.invars]
    return jax.make_jaxpr(both)(*kinds, *(kinds[place] for place in moving))


def _by_jax(primitive: core.Primitive, parameters: Mapping[str, Any], place: int) -> Callable[..., Array]:
    """Return the derivative of an operation by one operand, by JAX's rule."""

    def derivative(*operands: Array) -> Array:
        def by_one(operand: Array) -> Any:
            bound = primitive.get_bind_params(dict(parameters))
            return primitive.bind(*operands[:place], operand, *operands[place + 1 :], **bound)

        return cast(Array, jax.jvp(by_one, (operands[place],), (jnp.ones_like(operands[place]),))[1])

    return derivative


def _share(larger: Array, smaller: Array) -> Array:
    """Return the derivative of a maximum by the first of two, which have equal shares where they are equal."""
    whole = jnp.ones_like(larger)
    return jnp.where(larger > smaller, whole, jnp.where(larger == smaller, whole / 2, 0 * whole))


# by the name of the operation and the operand's place: the same as JAX's, with fewer divisions
_SHORTER: dict[tuple[str, int], Callable[..., Array]] = {
    ("div", 0): lambda x, y: 1 / y,
    ("div", 1): lambda x, y: -(x / y) * (1 / y),
    ("max", 0): _share,
    ("max", 1): lambda x, y: _share(y, x),
    ("min", 0): lambda x, y: _share(y, x),
    ("min", 1): _share,
}


def _value(value: Number, slope: Mapping[Number, Number]) -> Value:
    return Value(_Sloped(value, slope), np.dtype(value.dtype))


def _sloped(number: Number) -> _Sloped:
    assert isinstance(number, Value)  # what is written is of all lanes
    return cast(_Sloped, number.content)


def _known(number: float, dtype: Any) -> np.generic:
    return cast(np.generic, np.asarray(number, dtype)[()])


def _is_zero(number: Number) -> bool:
    return isinstance(number, np.generic) and bool(number == 0)
