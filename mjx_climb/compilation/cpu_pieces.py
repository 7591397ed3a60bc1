"""A function cut into pieces that XLA:CPU compiles as one kernel each.

XLA:CPU runs a program as a sequence of kernels, one for each operation or fusion, at some 60 ns a call. A step of a
walk has some 2700 operations, so that with a few hundred robots the calls cost more than the arithmetic. Fusion makes
fewer kernels of them, but works out shared values again in each. A function call with the attribute
`xla_cpu_small_call` becomes a single kernel: cut into such calls a step has few kernels, and what is shared between
them is worked out once.
"""

import functools
import itertools
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax._src.interpreters.ad import jvp_jaxpr  # not public; jax is pinned to one minor version
from jax.custom_derivatives import SymbolicZero
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core

from mjx_climb.compilation.element_moves import MOVES
from mjx_climb.compilation.element_operations import ELEMENTWISE
from mjx_climb.compilation.lost_operands import losing
from mjx_climb.compilation.reach import carried_on
from mjx_climb.compilation.trigonometry import NAMES, in_single

_Result = TypeVar("_Result")
_Carry = TypeVar("_Carry")
_Parts = dict[int, tuple[jax.Array, int, list[jax.Array]]]

EQUATIONS = 150  # in a piece: with fewer the calls cost more, with more fusion repeats more

_CALLS = {"jit": "jaxpr", "custom_jvp_call": "call_jaxpr"}
_FITTING = {*ELEMENTWISE, *MOVES, *NAMES, "iota"}  # XLA:CPU is known to compile these within a kernel

_REDUCTIONS = {
    "reduce_sum": lax.add,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}


def in_kernels(function: Callable[..., _Result], equations: int = EQUATIONS) -> Callable[..., _Result]:
    """Return the function with its equations in pieces of so many, each a kernel of its own.

    For values and forward derivatives, on a CPU. What is not known to fit in a kernel stays between the pieces.
    """

    def cut(*arguments: Any) -> _Result:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        program, outside = _of_what_may_move(closed)
        results = _with_slopes(program, equations)(*outside, *jax.tree.leaves(arguments))
        result: _Result = jax.tree.unflatten(jax.tree.structure(shape), results)
        return result

    return cut


def scan_in_kernels(
    step: Callable[[_Carry, None], tuple[_Carry, Any]], start: _Carry, *, length: int, equations: int = EQUATIONS
) -> tuple[_Carry, Any]:
    """Return what `jax.lax.scan` does of a step that reads nothing, with the step in pieces, see `in_kernels`.

    With rates asked for, a step without them is not cut, and a step with them once: what has a rate after some steps
    has one from the start. `scan` would trace both, and the rates again until it had found out.
    """
    closed, shape = jax.make_jaxpr(step, return_shape=True)(start, None)
    program, outside = _of_what_may_move(closed)
    values, tree = jax.tree.flatten(start)
    count = len(values)

    @jax.custom_jvp
    def scanned(outside: list[Any], values: list[Any]) -> list[Any]:
        def one(carry: list[Any], _: None) -> tuple[list[Any], list[Any]]:
            made = _in_pieces(program, equations, [*outside, *carry])
            return made[:count], made[count:]

        after, records = jax.lax.scan(one, values, length=length)
        return [*after, *records]

    @functools.partial(scanned.defjvp, symbolic_zeros=True)
    def with_rates(given: tuple[list[Any], ...], rates: tuple[list[Any], ...]) -> tuple[list[Any], list[Any]]:
        outside, values = given
        common, moving = ([not isinstance(rate, SymbolicZero) for rate in each] for each in rates)
        begun: list[bool] = []
        while begun != moving:  # once, but for rules that give rates to what nothing moves
            begun = carried_on(program.jaxpr.replace(outvars=program.jaxpr.outvars[:count]), common, moving)
            also = [*begun, *[False] * (len(program.jaxpr.outvars) - count)]
            both, moved = jvp_jaxpr(program, [*common, *begun], instantiate=also)
            moving = moved[:count]
        of_outside = [*itertools.compress(rates[0], common)]

        def one(carry: Any, _: None) -> tuple[Any, Any]:
            made = _in_pieces(both, equations, [*outside, *carry[0], *of_outside, *carry[1]])
            results, found = made[: len(moved)], made[len(moved) :]
            return (results[:count], found[: sum(begun)]), (results[count:], found[sum(begun) :])

        some = next(rate for rate in (*of_outside, *rates[1]) if not isinstance(rate, SymbolicZero))
        first: list[Any] = [
            _zeros(value, some) if isinstance(rate, SymbolicZero) else rate
            for value, rate in itertools.compress(zip(values, rates[1], strict=True), begun)
        ]
        after, records = jax.lax.scan(one, (values, first), length=length)
        results, found = [*after[0], *records[0]], iter([*after[1], *records[1]])
        return results, _where(moved, found, results)

    results = scanned(outside, values)
    records = jax.tree.unflatten(jax.tree.structure(shape[1]), results[count:])
    return jax.tree.unflatten(tree, results[:count]), records


def _zeros(value: Any, rate: Any) -> jax.Array:
    """Return rates of zero of a value, for `vmap` as many as of another rate: it traces a loop to find that out."""
    return jnp.where(False, rate.reshape(-1)[0].astype(value.dtype), jnp.zeros_like(value))


def _of_what_may_move(closed: core.ClosedJaxpr) -> tuple[core.ClosedJaxpr, list[Any]]:
    """Return a program as one of the traced values that it closes over and its arguments, and these values."""
    pairs = list(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    outside = [(variable, value) for variable, value in pairs if isinstance(value, jax.core.Tracer)]
    numbers = [(variable, value) for variable, value in pairs if not isinstance(value, jax.core.Tracer)]
    inputs = [*(variable for variable, _ in outside), *closed.jaxpr.invars]
    jaxpr = closed.jaxpr.replace(constvars=[variable for variable, _ in numbers], invars=inputs)
    return core.ClosedJaxpr(jaxpr, [value for _, value in numbers]), [value for _, value in outside]


def _with_slopes(program: core.ClosedJaxpr, equations: int) -> Callable[..., list[Any]]:
    """Return a program in pieces, and with slopes, where these are asked for.

    They are taken of the whole program, not of the pieces, so that rules for larger parts of it hold.
    """

    @jax.custom_jvp
    def values(*given: Any) -> list[Any]:
        return _in_pieces(program, equations, given)

    @functools.partial(values.defjvp, symbolic_zeros=True)
    def slopes(given: Sequence[Any], rates: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        moving = [not isinstance(rate, SymbolicZero) for rate in rates]
        both, moved = jvp_jaxpr(program, moving, instantiate=False)
        made = _in_pieces(both, equations, [*given, *itertools.compress(rates, moving)])
        results, found = made[: len(moved)], iter(made[len(moved) :])
        return results, _where(moved, found, results)

    return values


def _where(moved: Sequence[bool], rates: Iterator[Any], results: Sequence[Any]) -> list[Any]:
    """Return the rates of the results that have one, in their places."""
    return [
        next(rates) if moves else SymbolicZero(jax.typeof(result).to_tangent_aval())
        for moves, result in zip(moved, results, strict=True)
    ]


def _in_pieces(program: core.ClosedJaxpr, equations: int, given: Sequence[Any]) -> list[Any]:
    closed = jax.make_jaxpr(lambda *values: _evaluated(program.jaxpr, program.consts, values))(*given)
    jaxpr = closed.jaxpr
    values = dict(zip(jaxpr.constvars, closed.consts, strict=True)) | dict(zip(jaxpr.invars, given, strict=True))
    for inputs, piece, outputs, fits in _pieces(closed, equations):
        part = core.ClosedJaxpr(jaxpr.replace(constvars=(), invars=inputs, outvars=outputs, eqns=piece), ())
        carried_out = core.jaxpr_as_fun(part)
        results = (_one_kernel(carried_out) if fits else carried_out)(*(values[variable] for variable in inputs))
        values |= zip(outputs, results, strict=True)
    return [atom.val if isinstance(atom, core.Literal) else values[atom] for atom in jaxpr.outvars]


def _one_kernel(function: Callable[..., list[jax.Array]]) -> Callable[..., list[jax.Array]]:
    def piece(*arguments: jax.Array) -> list[jax.Array]:
        with set_xla_metadata(xla_cpu_small_call=None, inlineable=None):  # not for what is called within
            return function(*arguments)

    jitted = jax.jit(piece)

    def call(*arguments: jax.Array) -> list[jax.Array]:
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            results: list[jax.Array] = jitted(*arguments)
            return results

    return call


class _Piece(NamedTuple):
    inputs: list[core.Var]
    equations: list[core.JaxprEqn]
    outputs: list[core.Var]
    fits: bool  # in one kernel


def _pieces(closed: core.ClosedJaxpr, most: int) -> list[_Piece]:
    """Return pieces of at most so many equations in order of execution, without what nothing depends on."""
    jaxpr, constants = closed.jaxpr, dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    living = _needed(jaxpr.eqns, jaxpr.outvars)
    numbers, others = _between_numbers(living, constants)
    results, repeated = _variables(jaxpr.outvars), {v for equation in numbers for v in equation.outvars}
    pieces = []
    later = {variable: None for variable in results if variable not in repeated}
    for part, fits in reversed(_parts(others, losing(living, constants), most)):
        whole = [*_needed(numbers, [atom for equation in part for atom in equation.invars]), *part]
        pieces.append(_piece(whole, later, fits=fits))
        later |= dict.fromkeys(pieces[-1].inputs)
    known = _piece(_needed(numbers, jaxpr.outvars), results, fits=False)
    return [known, *reversed(pieces)] if known.equations else pieces[::-1]


def _piece(equations: list[core.JaxprEqn], later: Mapping[core.Var, None], *, fits: bool) -> _Piece:
    """Return a piece of some equations, whose results are those that are read later."""
    made = _variables([variable for equation in equations for variable in equation.outvars])
    read = _variables([atom for equation in equations for atom in equation.invars])
    return _Piece([v for v in read if v not in made], equations, [v for v in made if v in later], fits)


def _needed(equations: Sequence[core.JaxprEqn], results: Sequence[core.Var | core.Literal]) -> list[core.JaxprEqn]:
    """Return those of some equations that results depend on."""
    read, found = _variables(results), []
    for equation in reversed(equations):
        if any(variable in read for variable in equation.outvars):
            found.append(equation)
            read |= _variables(equation.invars)
    return found[::-1]


def _between_numbers(
    equations: Sequence[core.JaxprEqn], constants: Mapping[core.Var, Any]
) -> tuple[list[core.JaxprEqn], list[core.JaxprEqn]]:
    """Return the equations that nothing but numbers goes into and real numbers come out of, and the others.

    Each piece has its own of those that it reads. As a kernel's parameters XLA would put them in their place, and
    nothing would read the parameters, see `_parts`.
    """
    known = set(constants)
    numbers, others = [], []
    for equation in equations:
        real = all(jnp.issubdtype(cast(Any, variable.aval).dtype, jnp.floating) for variable in equation.outvars)
        if real and equation.primitive.name in _FITTING and all(v in known for v in _variables(equation.invars)):
            known |= {*equation.outvars}
            numbers.append(equation)
        else:
            others.append(equation)
    return numbers, others


def _parts(
    equations: Sequence[core.JaxprEqn], lost: Collection[int], most: int
) -> list[tuple[list[core.JaxprEqn], bool]]:
    """Return the equations in parts of at most so many, and whether each fits in a kernel.

    Others call libraries, or loop, or are, by their ids, among the `lost`, which XLA makes lose an operand, or
    have no elements: XLA:CPU (jaxlib 0.10) stops the process at a kernel with a parameter that nothing in it reads.
    """

    def fits(equation: core.JaxprEqn) -> bool:
        avals = (cast(Any, atom.aval) for atom in (*equation.invars, *equation.outvars))
        return equation.primitive.name in _FITTING and id(equation) not in lost and all(aval.size for aval in avals)

    runs = [(list(run), fitting) for fitting, run in itertools.groupby(equations, fits)]
    return [(run[start : start + most], fitting) for run, fitting in runs for start in range(0, len(run), most)]


def _variables(atoms: Sequence[core.Var | core.Literal]) -> dict[core.Var, None]:
    """Return the variables among atoms as the keys of a dict, which keeps their order."""
    return {atom: None for atom in atoms if not isinstance(atom, core.Literal)}


def _evaluated(jaxpr: core.Jaxpr, constants: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    """Return the results of a jaxpr: no calls, reductions term by term, slices of a concatenation from its parts.

    XLA would do the last as well. But what it makes needless must not be the parameter of a kernel, see `_parts`. And
    what is worked out again later in a step, as the engine does the frames of the links, it sees within a piece alone:
    here equal equations are carried out once. Functions of the C library are replaced, see
    `mjx_climb.compilation.trigonometry`.
    """
    values: dict[core.Var, Any] = {}
    # id of a concatenation: itself, so that the id stays its own, the axis, and what it is made of
    parts: _Parts = {}
    # what was expanded to be such a part, by the part's id and the axes: the part, so that the id stays its own, and it
    expanded: dict[tuple[int, tuple[int, ...]], tuple[jax.Array, jax.Array]] = {}
    done: dict[Hashable, tuple[list[Any], list[Any]]] = {}  # operands, so that their ids stay their own, and results

    def read(atom: core.Var | core.Literal) -> Any:
        return atom.val if isinstance(atom, core.Literal) else values[atom]

    def evaluated(jaxpr: core.Jaxpr, constants: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
        values.update(zip(jaxpr.constvars, constants, strict=True))
        values.update(zip(jaxpr.invars, arguments, strict=True))
        for equation in jaxpr.eqns:
            given = [read(atom) for atom in equation.invars]
            name = equation.primitive.name
            key = _same(equation, given)
            if key in done:
                values.update(zip(equation.outvars, done[key][1], strict=True))
                continue
            if name in _CALLS:
                inner = equation.params[_CALLS[name]]
                results = evaluated(inner.jaxpr, inner.consts, given)
            elif (single := in_single(name, given)) is not None:
                results = [single]
            elif name == "slice":
                results = [_sliced(given[0], parts, **equation.params)]
            elif name == "squeeze" and (id(given[0]), equation.params["dimensions"]) in expanded:
                results = [expanded[id(given[0]), equation.params["dimensions"]][1]]
            elif name in _REDUCTIONS and given[0].size:
                results = [_reduced(_REDUCTIONS[name], given[0], parts, equation.params["axes"])]
            else:
                results = equation.primitive.bind(*given, **equation.primitive.get_bind_params(equation.params))
                results = results if equation.primitive.multiple_results else [results]
                if name == "concatenate":
                    parts[id(results[0])] = results[0], equation.params["dimension"], given
                elif name == "stack":
                    axis = equation.params["axis"]
                    slices = [lax.expand_dims(each, (axis,)) for each in given]
                    expanded.update({(id(one), (axis,)): (one, each) for one, each in zip(slices, given, strict=True)})
                    parts[id(results[0])] = results[0], axis, slices
            if key is not None:
                done[key] = given, results
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    return evaluated(jaxpr, constants, arguments)


def _same(equation: core.JaxprEqn, given: Sequence[Any]) -> Hashable | None:
    """Return what equations that give the same results have in common, None where that cannot be told."""
    if equation.primitive.name not in _FITTING and equation.primitive.name not in _REDUCTIONS:
        return None
    avals = tuple(variable.aval for variable in equation.outvars)
    try:
        operands = tuple(id(value) if isinstance(value, jax.core.Tracer) else _number(value) for value in given)
        key = equation.primitive.name, tuple(equation.params.items()), operands, avals
        hash(key)
    except TypeError:  # random keys, or parameters that are no plain values
        return None
    return key


def _number(value: Any) -> Hashable:
    array = np.asarray(value)
    return array.dtype.str, array.shape, array.tobytes()


def _reduced(
    combine: Callable[[jax.Array, jax.Array], jax.Array], array: jax.Array, parts: _Parts, axes: Sequence[int]
) -> jax.Array:
    """Return a reduction, term by term: XLA hands large ones to a library, which a kernel cannot call."""
    for axis in sorted(axes, reverse=True):
        ends = [(0, size) for size in array.shape]
        terms = []
        for index in range(array.shape[axis]):
            ends[axis] = (index, index + 1)
            starts, limits = zip(*ends, strict=True)
            terms.append(lax.squeeze(_sliced(array, parts, starts, limits, None), (axis,)))
        array = functools.reduce(combine, terms)
    return array


def _sliced(
    array: jax.Array,
    parts: _Parts,
    start_indices: Sequence[int],
    limit_indices: Sequence[int],
    strides: Sequence[int] | None,
) -> jax.Array:
    """Return a slice of an array, of the one part that holds it where the array is a concatenation."""
    starts, steps = list(start_indices), [1] * len(start_indices) if strides is None else list(strides)
    counts = [len(range(*each)) for each in zip(starts, limit_indices, steps, strict=True)]
    limits = [s + (count - 1) * step + 1 if count else s for s, count, step in zip(starts, counts, steps, strict=True)]
    while all(counts) and id(array) in parts:
        _, axis, pieces = parts[id(array)]
        begin = 0
        for piece in pieces:
            end = begin + piece.shape[axis]
            if begin <= starts[axis] and limits[axis] <= end:
                break
            begin = end
        else:
            break
        array, starts[axis], limits[axis] = piece, starts[axis] - begin, limits[axis] - begin
    return array if tuple(counts) == array.shape else lax.slice(array, starts, limits, steps)
