"""Which results of a traced function can change with which of its arguments, as far as real numbers go."""

from collections.abc import Sequence
from typing import Any, cast

import jax.numpy as jnp
from jax.extend import core


def reached(jaxpr: core.Jaxpr, moving: Sequence[bool]) -> list[bool]:
    """Return which results may move where some arguments do."""
    known = {variable for variable, moves in zip(jaxpr.invars, moving, strict=True) if moves}

    def moves(atom: core.Var | core.Literal) -> bool:
        return not isinstance(atom, core.Literal) and atom in known

    for equation in jaxpr.eqns:
        given = [moves(atom) for atom in equation.invars]
        found = _through(equation, given) if any(given) else [False] * len(equation.outvars)
        known |= {v for v, moving in zip(equation.outvars, found, strict=True) if moving and _is_real(v)}
    return [moves(atom) for atom in jaxpr.outvars]


def carried_on(body: core.Jaxpr, common: Sequence[bool], start: Sequence[bool]) -> list[bool]:
    """Return which of the numbers that a loop carries move sooner or later, from what moves at its start.

    Only for loops that read nothing step by step: their body is of what is common to all steps, and what is carried.
    """
    moving = list(start)
    while (after := [m or n for m, n in zip(moving, reached(body, [*common, *moving]), strict=True)]) != moving:
        moving = after
    return moving


def _through(equation: core.JaxprEqn, given: Sequence[bool]) -> list[bool]:
    inside = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
    if equation.primitive.name in ("scan", "while", "cond") or inside is None:
        return [True] * len(equation.outvars)
    return reached(getattr(inside, "jaxpr", inside), given)


def _is_real(variable: core.Var) -> bool:
    return bool(jnp.issubdtype(cast(Any, variable.aval).dtype, jnp.floating))
