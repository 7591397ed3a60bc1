"""Activity analysis: which results of a program depend on which of its arguments; and so on which batch axes."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend import core

from mjx_climb.execution.jax_internals import inner_program, scan_sizes

Has = tuple[bool, ...]  # which batch axes a value has, behind its own


def reached(jaxpr: core.Jaxpr, moving: Sequence[bool]) -> list[bool]:
    """Return which results depend on the arguments that are `moving`."""
    known = {variable for variable, moves in zip(jaxpr.invars, moving, strict=True) if moves}

    def moves(atom: core.Var | core.Literal) -> bool:
        return not isinstance(atom, core.Literal) and atom in known

    for equation in jaxpr.eqns:
        given = [moves(atom) for atom in equation.invars]
        if any(given):
            known.update(v for v, found in zip(equation.outvars, _through(equation, given), strict=True) if found)
    return [moves(atom) for atom in jaxpr.outvars]


def carried_on(
    body: core.Jaxpr, common: Sequence[bool], start: Sequence[bool], read: Sequence[bool] = ()
) -> list[bool]:
    """Return which of the values that a loop carries depend, after some steps, on what is moving.

    Arguments:
        body: a step, of what is common to all steps, what is carried, and what is read at each.
        common, start, read: which of these are moving.
    """
    moving = list(start)
    while True:
        found = reached(body, [*common, *moving, *read])[: len(moving)]
        after = [before or now for before, now in zip(moving, found, strict=True)]
        if after == moving:
            return moving
        moving = after


def _through(equation: core.JaxprEqn, given: Sequence[bool]) -> list[bool]:
    name, inner = equation.primitive.name, inner_program(equation)
    if inner is not None and name != "custom_vjp_call":
        return reached(inner.jaxpr, given)
    if name != "scan":
        return [True] * len(equation.outvars)
    body = equation.params["jaxpr"].jaxpr
    constants, carry = scan_sizes(equation.params)
    common, start, read = given[:constants], given[constants : constants + carry], given[constants + carry :]
    moving = carried_on(body, common, start, read)
    return [*moving, *reached(body, [*common, *moving, *read])[carry:]]


def by_axis(of_axis: Callable[[list[bool]], Sequence[bool]], varies: Sequence[Has], axes: int, count: int) -> list[Has]:
    """Return which batch axes `count` values have, by what `of_axis` says of each axis alone."""
    each = [of_axis([has[axis] for has in varies]) for axis in range(axes)]
    return list(zip(*each, strict=True)) if each else [()] * count


def mapped(function: Callable[..., Sequence[Any]], varies: Sequence[Has], results: Sequence[Has]) -> Callable[..., Any]:
    """Return `jax.vmap` of a function of one robot over the batch axes that arguments and results have."""
    for axis in range(len(results[0]) if results else 0):
        if any(has[axis] for has in varies):
            into, out = ([-1 if has[axis] else None for has in some] for some in (varies, results))
            function = jax.vmap(function, in_axes=into, out_axes=out)
    return function
