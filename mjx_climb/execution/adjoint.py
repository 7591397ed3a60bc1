"""The adjoint of a program of one robot: derivatives of weighted results by all moving arguments, in reverse.

A loop of many steps does not keep all results of its steps. It keeps the values carried into each stretch of steps,
about as many stretches as a stretch has steps. On the way back each stretch is walked once more, and the values carried
into each of its steps are kept. Then each step is computed once more, last step first, with its own reverse
derivative. So n steps take the memory of two roots of n, and each step is computed three times.

References:
    A. Griewank and A. Walther, Evaluating Derivatives, second edition, 2008, chapter 12: checkpoints.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import CustomVJPPrimal, SymbolicZero
from jax.extend import core

from mjx_climb.execution.flat import carried_on, depend, evaluated, flat, with_stable_choices
from mjx_climb.execution.jax_internals import arguments_of, carried_out, inner_program, scan_sizes, without_unread
from mjx_climb.execution.jax_types import Parameters, aval_of

MOST_KEPT = 256  # steps of a loop that keeps its carried values at each
FEW_EQUATIONS = 1000  # in all steps of a loop that keeps all that it computes


@functools.lru_cache(maxsize=32)
def with_gradients(
    program: core.ClosedJaxpr, moving: tuple[bool, ...], weighed: tuple[bool, ...], *, values: bool
) -> core.ClosedJaxpr:
    """Return a program of the arguments and of weights of some results, to the gradients of the weighted sum.

    Arguments:
        program: of one robot.
        moving: which arguments, real numbers, the gradients are of.
        weighed: which results, real numbers, have weights.
        values: whether it returns the results too, first.
    """
    stable = with_stable_choices(program)
    count = len(moving)

    def of_robot(*given: Array) -> list[Array]:
        arguments, weights = given[:count], given[count:]

        def results(*some: Array) -> tuple[list[Array], list[Array]]:
            rest = iter(some)
            every = [next(rest) if moves else value for moves, value in zip(moving, arguments, strict=True)]
            found = _results(stable, every, moving)
            return list(itertools.compress(found, weighed)), found

        _, pull_back, found = jax.vjp(results, *itertools.compress(arguments, moving), has_aux=True)
        return [*(found if values else ()), *pull_back(list(weights))]

    weights = itertools.compress(program.out_avals, weighed)
    given = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in (*program.in_avals, *weights)]
    both = jax.make_jaxpr(of_robot)(*given)
    return flat(without_unread(both))


def _results(program: core.ClosedJaxpr, arguments: Sequence[Array], moving: Sequence[bool]) -> list[Array]:
    """Return the results of a program, whose long loops have the derivatives of `_loop`."""
    moves = dict(zip(program.jaxpr.invars, moving, strict=True))

    def results_of(equation: core.JaxprEqn, values: list[Array]) -> list[Array]:
        given = [not isinstance(atom, core.Literal) and moves.get(atom, False) for atom in equation.invars]
        moves.update(zip(equation.outvars, depend(equation, given), strict=True))
        inner, name = inner_program(equation), equation.primitive.name
        if inner is not None and not name.startswith("custom"):
            return _results(inner, values, given)
        if name == "scan" and any(given) and _is_long(equation.params):
            typed = zip(values, equation.invars, strict=True)
            arrays = [jnp.asarray(value, aval_of(atom).dtype) for value, atom in typed]
            return _loop(_Loop(equation.params, tuple(given)), arrays)
        return carried_out(equation.primitive, equation.params, values)

    return evaluated(program, arguments, results_of)


def _is_long(parameters: Parameters) -> bool:
    return bool(parameters["length"] > 1 and parameters["length"] * _work(parameters["jaxpr"].jaxpr) > FEW_EQUATIONS)


def _work(jaxpr: core.Jaxpr) -> int:
    """Return the number of equations of a program, those of a loop once for each of its steps."""
    return sum(
        1 + equation.params.get("length", 1) * sum(map(_work, core.jaxprs_in_params(equation.params)))
        for equation in jaxpr.eqns
    )


class _Loop(NamedTuple):
    """A loop, and which of its operands move."""

    parameters: Parameters
    given: tuple[bool, ...]

    @property
    def body(self) -> core.ClosedJaxpr:
        body: core.ClosedJaxpr = self.parameters["jaxpr"]
        return body

    @property
    def sizes(self) -> tuple[int, int]:
        """How many constants it has, and how many values it carries."""
        return scan_sizes(self.parameters)

    def moves(self) -> tuple[list[bool], list[bool]]:
        """Return which operands have gradients, and which results of a step have weights: real numbers that move."""
        constants, carry = self.sizes
        found = carried_on(self.parameters, self.given)
        into = [*self.given[:constants], *found[:carry], *self.given[constants + carry :]]
        avals = [aval_of(variable) for variable in (*self.body.jaxpr.invars, *self.body.jaxpr.outvars)]
        real = [bool(jnp.issubdtype(aval.dtype, jnp.floating)) for aval in avals]
        both = [moves and is_real for moves, is_real in zip((*into, *found), real, strict=True)]
        return both[: len(into)], both[len(into) :]

    def weighed(self, given: Sequence[bool]) -> tuple[list[bool], list[bool]]:
        """Return which operands have gradients, and which results of a step weights, from those of the whole loop."""
        (constants, carry), (into, _) = self.sizes, self.moves()
        of_step = list(given)
        while True:
            read = arguments_of(self.body, of_step)
            by = [moves and is_read for moves, is_read in zip(into, read, strict=True)]
            carried = [a or b for a, b in zip(of_step, by[constants : constants + carry], strict=False)]
            if carried == of_step[:carry]:
                return [*by[:constants], *carried, *by[constants + carry :]], of_step
            of_step[:carry] = carried

    def steps(self, values: Sequence[Array], length: int | None = None, *, keep: bool = False) -> list[Array]:
        """Return the last carry, the numbers written at each step, and with `keep` the carry into each step."""
        constants, carry = self.sizes
        common, begun, read = values[:constants], values[constants : constants + carry], values[constants + carry :]

        def step(carried: list[Array], now: list[Array]) -> tuple[list[Array], list[Array]]:
            made = core.jaxpr_as_fun(self.body)(*common, *carried, *now)
            return made[:carry], [*made[carry:], *(carried if keep else ())]

        steps, reverse = length or self.parameters["length"], self.parameters["reverse"]
        after, written = lax.scan(step, list(begun), list(read), length=steps, reverse=reverse)
        return [*after, *written]


def _loop(loop: _Loop, values: Sequence[Array]) -> list[Array]:
    """Return the results of a loop of many steps, which has an adjoint of bounded memory."""
    length = loop.parameters["length"]
    if length <= MOST_KEPT:
        return _kept(loop, values)
    count, stretch = _stretches(length)
    (constants, carry), reverse = loop.sizes, loop.parameters["reverse"]
    whole, rest = count * stretch, length - count * stretch
    common, begun, read = values[:constants], values[constants : constants + carry], values[constants + carry :]
    early, late = (slice(rest, None), slice(rest)) if reverse else (slice(whole), slice(whole, None))
    parts = [array[early].reshape(count, stretch, *array.shape[1:]) for array in read]

    def walk_stretch(common: list[Array], carried: list[Array], now: list[Array]) -> list[Array]:
        return loop.steps([*common, *carried, *now], stretch)

    avals = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), (list(common), list(begun), parts))
    avals = *avals[:2], [jax.ShapeDtypeStruct(aval.shape[1:], aval.dtype) for aval in avals[2]]
    body = jax.make_jaxpr(walk_stretch)(*avals)
    outer = _Loop({**loop.parameters, "jaxpr": body, "length": count}, loop.given)
    made = _kept(outer, [*common, *begun, *parts])
    written = [array.reshape(whole, *array.shape[2:]) for array in made[carry:]]
    if not rest:
        return [*made[:carry], *written]
    last = _kept(
        loop._replace(parameters={**loop.parameters, "length": rest}),
        [*common, *made[:carry], *(array[late] for array in read)],
    )
    order = (last[carry:], written) if reverse else (written, last[carry:])
    return [*last[:carry], *(jnp.concatenate(pair) for pair in zip(*order, strict=True))]


def _stretches(length: int) -> tuple[int, int]:
    """Return the number of stretches of a loop and the steps of one: all steps where two factors are alike.

    A rest is a loop of its own, which takes as long to compile.
    """
    root = math.isqrt(length)
    count = next(each for each in range(root, 0, -1) if length % each == 0)
    return (count, length // count) if count + length // count <= 3 * root else (length // root, root)


def _kept(loop: _Loop, values: Sequence[Array]) -> list[Array]:
    """Return the results of a loop whose adjoint keeps the values carried into each step."""
    (constants, carry), (_, out) = loop.sizes, loop.moves()
    count = len(out)
    body = with_stable_choices(loop.body)

    @jax.custom_vjp
    def walked(*given: Array) -> list[Array]:
        return loop.steps(given)

    def forward(*given: CustomVJPPrimal) -> tuple[list[Array], tuple[list[Array], list[Array], list[Array]]]:
        values: list[Array] = [each.value for each in given]
        found = loop.steps(values, keep=True)
        return found[:count], (values[:constants], found[count:], values[constants + carry :])

    def backward(
        kept: tuple[list[Array], list[Array], list[Array]], weights: list[Array | SymbolicZero]
    ) -> tuple[Array | None, ...]:
        common, carried, read = kept
        given = [moves and not isinstance(weight, SymbolicZero) for moves, weight in zip(out, weights, strict=True)]
        by, of = loop.weighed(given)
        asked = [jnp.zeros(w.shape, w.dtype) if isinstance(w, SymbolicZero) else w for w in weights]
        of_carry, of_written = (list(itertools.compress(asked[p], of[p])) for p in (slice(carry), slice(carry, None)))
        nothing = [jnp.zeros_like(value) for value in itertools.compress(common, by)]

        def back(
            sums: tuple[list[Array], list[Array]], now: tuple[list[Array], ...]
        ) -> tuple[tuple[list[Array], list[Array]], list[Array]]:
            (so_far, weights), (carried, read, of_written) = sums, now
            at_step = [*common, *carried, *read]

            def step(*some: Array) -> list[Array]:
                rest = iter(some)
                mixed = [next(rest) if moves else value for moves, value in zip(by, at_step, strict=True)]
                return list(itertools.compress(_results(body, mixed, by), of))

            _, pull_back = jax.vjp(step, *itertools.compress(at_step, by))
            found = pull_back([*weights, *of_written])
            ends = list(itertools.accumulate((sum(by[:constants]), sum(by[constants : constants + carry]))))
            more, before, of_read = found[: ends[0]], found[ends[0] : ends[1]], found[ends[1] :]
            return ([a + b for a, b in zip(so_far, more, strict=True)], list(before)), list(of_read)

        (of_common, of_begun), of_read = lax.scan(
            back,
            (nothing, of_carry),
            (carried, read, of_written),
            length=loop.parameters["length"],
            reverse=not loop.parameters["reverse"],
        )
        found = iter([*of_common, *of_begun, *of_read])
        return tuple(next(found) if moves else None for moves in by)

    walked.defvjp(forward, backward, symbolic_zeros=True)
    return list(walked(*values))
