"""A traced function carried out element by element, each operation once: what a GPU kernel consists of.

Everything that is known is listed: elementwise operations here, moves in `element_moves`, the rest in `element_rules`.
What is not listed, or has parameters that nobody has thought of, raises `Unsupported`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from mjx_climb.compilation.devices import host
from mjx_climb.compilation.element_moves import MOVES
from mjx_climb.compilation.elements import Element, Elements, Key, as_array, known
from mjx_climb.compilation.unsupported import Unsupported, refuse_unknown

MOST_OPERATIONS = 100_000  # a walk has some 12,000; Triton takes minutes for more than this
_DECIDED_ELSEWHERE = frozenset({"weak_type", "new_dtype", "y", "rounding_method"})  # by the operation itself

# each result element depends on one element of each operand
ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh bitcast_convert_type cbrt ceil clamp clz "
    "convert_element_type cos cosh div eq erf_inv exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p "
    "logistic lt max min mul ne neg nextafter not or population_count pow rem round rsqrt select_n shift_left "
    "shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub tan tanh xor".split()
)
_CALLS = {
    "jit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}


class Operations:
    """Operations on elements, each of which is carried out once: asked for again, it gives the same result."""

    def __init__(self, before: "Mapping[Any, tuple[Any, Element]] | None" = None) -> None:
        # an operation and its operands: these, so that their ids stay their own, and the result
        self.done: dict[Any, tuple[Any, Element]] = dict(before or {})

    def results(self, jaxpr: core.Jaxpr, constants: Sequence[Any], arguments: Sequence[Elements]) -> list[Elements]:
        """Return the results of a jaxpr for arrays of elements."""
        values = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
        values |= dict(zip(jaxpr.invars, arguments, strict=True))

        def read(atom: core.Var | core.Literal) -> Elements:
            aval: Any = atom.aval
            return np.asarray(atom.val, aval.dtype) if isinstance(atom, core.Literal) else values[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def closed(self, jaxpr: core.ClosedJaxpr, given: Sequence[Elements]) -> list[Elements]:
        """Return the results of a jaxpr with its constants."""
        return self.results(jaxpr.jaxpr, jaxpr.consts, given)

    def _equation(self, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
        from mjx_climb.compilation.element_rules import RULES

        name, parameters = equation.primitive.name, equation.params
        if equation.effects:
            raise Unsupported(f"the operation {name}, which has effects,")
        if any(jnp.issubdtype(cast(Any, v.aval).dtype, jnp.complexfloating) for v in equation.outvars):
            raise Unsupported(f"the operation {name} on complex numbers")
        if name in _CALLS:
            return self.closed(parameters[_CALLS[name]], given)
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
        """Return an elementwise operation on arrays that broadcast to each other."""
        shape = np.broadcast_shapes(*(np.shape(array) for array in arrays))
        each = zip(*(np.broadcast_to(array, shape).reshape(-1) for array in arrays), strict=True)
        return as_array((self.element(primitive, parameters, *operands) for operands in each), shape)

    def element(self, primitive: core.Primitive, parameters: Mapping[str, Any], *operands: Element) -> Element:
        """Return an elementwise operation on single elements."""
        name = primitive.name
        if any(isinstance(operand, Key) for operand in operands):
            return self._keys(name, operands)
        if name in _SHORTCUTS and (result := _SHORTCUTS[name](*operands)) is not None:
            return result
        if all(isinstance(each, np.generic) for each in operands):
            [number] = _computed_now(primitive, parameters, operands)[0].reshape(1)
            return cast(np.generic, number)
        names = tuple((each.dtype, each.tobytes()) if isinstance(each, np.generic) else id(each) for each in operands)
        operation = (name, str(parameters), names)
        if operation not in self.done:
            if len(self.done) == MOST_OPERATIONS:
                raise Unsupported(f"a program of more than {MOST_OPERATIONS} operations on single numbers")
            plain = [cast(Array, operand) for operand in operands]
            robots = next((np.shape(operand) for operand in plain if np.ndim(operand)), ())
            alike = [for_each_robot(operand, operand.dtype, robots) for operand in plain]
            bind: Callable[..., Array] = _REPLACED.get(name, primitive.bind)
            self.done[operation] = operands, bind(*map(jnp.asarray, alike), **parameters)
        return self.done[operation][1]

    def _keys(self, name: str, operands: Sequence[Element]) -> Element:
        """Return the choice among random keys, the one operation that they have in common with numbers."""
        if name != "select_n":
            raise Unsupported(f"the operation {name} on random keys")
        which, *cases = operands
        keys = [cast(Key, case) for case in cases]
        high, low = [key.high for key in keys], [key.low for key in keys]
        return Key(*(cast(Array, self.element(lax.select_n_p, {}, which, *words)) for words in (high, low)))


def for_each_robot(element: Element, dtype: Any, shape: tuple[int, ...]) -> Array:
    """Return an element in a precision, repeated for each robot where it is one of all."""
    value = jnp.asarray(element).astype(dtype)
    return value if value.ndim or not shape else lax.broadcast(value, shape)


def _computed_now(
    primitive: core.Primitive, parameters: Mapping[str, Any], given: Sequence[Elements | Element]
) -> list[np.ndarray]:
    """Return the results of an operation on numbers alone, on the CPU, which compiles it sooner than a GPU."""
    bound = primitive.get_bind_params(dict(parameters))
    with jax.ensure_compile_time_eval(), jax.default_device(host()):
        results: Any = primitive.bind(*given, **bound)
        return [np.asarray(result) for result in (results if primitive.multiple_results else [results])]


def _product(a: Element, b: Element) -> Element | None:
    """Return what needs no multiplication: the model's frames are full of zeros and ones."""
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
    return a if isinstance(b, np.generic) and b == 0 else None


def _choice(which: Element, *cases: Element) -> Element | None:
    """Return the case that is taken whatever the choice, or the one that is known to be taken."""
    if isinstance(which, np.generic) and 0 <= int(which) < len(cases):
        return cases[int(which)]
    return cases[0] if all(case is cases[0] for case in cases) else None


_SHORTCUTS: dict[str, Callable[..., Element | None]] = {
    "mul": _product,
    "add": _sum,
    "sub": _difference,
    "select_n": _choice,
}


def _round(value: Array, *, rounding_method: lax.RoundingMethod) -> Array:
    """Return the nearest whole number, of two the even one: Triton has no such operation."""
    if rounding_method is not lax.RoundingMethod.TO_NEAREST_EVEN:
        raise Unsupported(f"rounding by {rounding_method}")
    up = lax.floor(value + 0.5)
    odd = lax.floor(up * 0.5) * 2 != up
    return jnp.where((up - value == 0.5) & odd, up - 1, up)


def _select(which: Array, *cases: Array) -> Array:
    """Return the case of a number, one comparison for each: Triton chooses between two."""
    if which.dtype == bool:
        return lax.select_n(which, *cases)
    chosen = cases[0]
    for number, case in enumerate(cases[1:], 1):
        chosen = lax.select_n(which >= number, chosen, case)
    return chosen


_REPLACED: dict[str, Callable[..., Array]] = {"round": _round, "select_n": _select}


def sizes_of(avals: Sequence[Any]) -> list[int]:
    """Return how many elements arrays of these kinds have."""
    return [math.prod(aval.shape) for aval in avals]
