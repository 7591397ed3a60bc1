"""Forward derivatives of a traced program, whose maxima have the derivative of the value that was taken.

JAX takes the derivative of a maximum where a value equals it. Two kernels that each work the maximum out, and round
differently, find no value equal: the derivative of a maximum over rows is then 0/0, of two values 0. So maxima and
minima are made of comparisons first: one comparison chooses value and derivative. Of equal values the first is taken,
where JAX takes the mean; what is not a number stays, as in JAX's own.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend import core

from mjx_climb.execution.jax_internals import inner_program, jvp_jaxpr, scan_sizes


def tangents_of(program: core.ClosedJaxpr, moving: Sequence[bool]) -> tuple[core.ClosedJaxpr, list[bool]]:
    """Return a program of the arguments, and the tangents of those that are moving, and which results have tangents.

    It returns the results and then their tangents.
    """
    both, moved = jvp_jaxpr(with_stable_maxima(program), tuple(moving), instantiate=False)
    return both, list(moved)


@functools.lru_cache(maxsize=128)
def with_stable_maxima(program: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Return a program without `max`, `min` and their reductions, outside of functions with their own derivative."""
    if not _has_maxima(program.jaxpr):
        return program

    def evaluated(*arguments: Any) -> list[Any]:
        known = dict(zip(program.jaxpr.constvars, program.consts, strict=True))
        known |= dict(zip(program.jaxpr.invars, arguments, strict=True))

        def read(atom: core.Var | core.Literal) -> Any:
            return atom.val if isinstance(atom, core.Literal) else known[atom]

        for equation in program.jaxpr.eqns:
            values = [read(atom) for atom in equation.invars]
            name, inner = equation.primitive.name, inner_program(equation)
            if name in _BETTER:
                results = [better(_BETTER[name], *values)]
            elif name in _OF_ROWS:
                results = [_best(_OF_ROWS[name], values[0], equation.params["axes"])]
            elif inner is not None and not name.startswith("custom"):
                results = core.jaxpr_as_fun(with_stable_maxima(inner))(*values)
            elif name == "scan":
                results = _scan(equation, values)
            else:
                made = equation.primitive.bind(*values, **equation.primitive.get_bind_params(equation.params))
                results = made if equation.primitive.multiple_results else [made]
            known.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in program.jaxpr.outvars]

    return jax.make_jaxpr(evaluated)(*program.in_avals)


def _has_maxima(jaxpr: core.Jaxpr) -> bool:
    def has(equation: core.JaxprEqn) -> bool:
        if equation.primitive.name in _BETTER or equation.primitive.name in _OF_ROWS:
            return True
        return any(_has_maxima(inner) for inner in core.jaxprs_in_params(equation.params))

    return any(map(has, jaxpr.eqns))


def _scan(equation: core.JaxprEqn, values: Sequence[Any]) -> list[Any]:
    body = with_stable_maxima(equation.params["jaxpr"])
    constants, carry = scan_sizes(equation.params)

    def step(carried: list[Any], read: list[Any]) -> tuple[list[Any], list[Any]]:
        made = core.jaxpr_as_fun(body)(*values[:constants], *carried, *read)
        return made[:carry], made[carry:]

    how = {name: equation.params[name] for name in ("length", "reverse", "unroll")}
    after, written = lax.scan(
        step, list(values[constants : constants + carry]), list(values[constants + carry :]), **how
    )
    return [*after, *written]


def better(compare: Callable[[Array, Array], Array], one: Any, other: Any) -> Array:
    """Return the better of two values, element by element: the first of equal ones, and what is not a number."""
    one, other = jnp.broadcast_arrays(one, other)
    return lax.select(compare(one, other) | (one != one), one, other)


def _best(compare: Callable[[Array, Array], Array], values: Array, axes: Sequence[int]) -> Array:
    """Return the best of values along axes."""
    for axis in sorted(axes, reverse=True):
        while (count := values.shape[axis]) > 1:
            half = (count + 1) // 2  # of an odd number the middle one is compared with itself
            first, last = (
                lax.slice_in_dim(values, 0, half, axis=axis),
                lax.slice_in_dim(values, count - half, None, axis=axis),
            )
            values = better(compare, first, last)
        values = lax.squeeze(values, (axis,))
    return values


_BETTER = {"max": lax.ge, "min": lax.le}
_OF_ROWS = {"reduce_max": lax.ge, "reduce_min": lax.le}
