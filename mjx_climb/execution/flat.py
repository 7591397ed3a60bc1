"""A traced program as one list of equations, which of its results depend on which arguments, and its tangents.

JAX takes the derivative of a maximum where a value equals it. Two kernels that each work the maximum out, and round
differently, find no value equal: the derivative of a maximum over rows is then 0/0, of two values 0. So maxima and
minima are made of comparisons first: one comparison chooses value and derivative. Of equal values the first is taken,
where JAX takes the mean; not-a-numbers stay, as in JAX's own.
"""

import functools
import itertools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend import core

from mjx_climb.execution.jax_internals import (
    carried_out,
    from_line_of,
    inner_program,
    jvp_jaxpr,
    line_of,
    new_program,
    scan_sizes,
    with_inner,
)
from mjx_climb.execution.jax_types import Atom, Function, Parameters
from mjx_climb.execution.simpler import rule_of, simpler


def flat(program: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Return a program without calls, and the bodies of its loops without calls; no two equations share a variable."""
    constants: dict[int, tuple[core.Var, Array]] = {}  # by id
    equations: list[core.JaxprEqn] = []

    def written_out(
        program: core.ClosedJaxpr, arguments: Sequence[Atom], called_at: core.JaxprEqn | None = None
    ) -> list[Atom]:
        atoms: dict[core.Var, Atom] = dict(zip(program.jaxpr.invars, arguments, strict=True))
        for variable, value in zip(program.jaxpr.constvars, program.consts, strict=True):
            atoms[variable] = constants.setdefault(id(value), (core.Var(variable.aval), value))[0]

        def read(atom: Atom) -> Atom:
            return atom if isinstance(atom, core.Literal) else atoms[atom]

        for equation in program.jaxpr.eqns:
            given = [read(atom) for atom in equation.invars]
            if called_at is not None and not line_of(equation):  # of a function of JAX's: the line that calls it
                equation = equation.replace(source_info=called_at.source_info)
            inner = inner_program(equation) or simpler(equation, differentiated=False)
            if inner is not None:
                atoms |= zip(equation.outvars, written_out(inner, given, equation), strict=True)
                continue
            parameters = with_inner(flat, equation)
            made = [core.Var(variable.aval) for variable in equation.outvars]
            atoms |= zip(equation.outvars, made, strict=True)
            equations.append(equation.replace(invars=given, outvars=made, params=parameters))
        return [read(atom) for atom in program.jaxpr.outvars]

    inputs = [core.Var(variable.aval) for variable in program.jaxpr.invars]
    outputs = written_out(program, inputs)
    return new_program(program.jaxpr, needed(equations, outputs), inputs, outputs, list(constants.values()))


def chained(*programs: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Return flat programs as one, each of the results of the one before; no two share a variable."""
    given: Sequence[Atom] = programs[0].jaxpr.invars
    equations: list[core.JaxprEqn] = []
    for program in programs:
        atoms = dict(zip(program.jaxpr.invars, given, strict=True))

        def read(atom: Atom, atoms: dict[core.Var, Atom] = atoms) -> Atom:
            return atom if isinstance(atom, core.Literal) else atoms.get(atom, atom)

        equations += [each.replace(invars=[*map(read, each.invars)]) for each in program.jaxpr.eqns]
        given = [*map(read, program.jaxpr.outvars)]
    constants = [pair for each in programs for pair in zip(each.jaxpr.constvars, each.consts, strict=True)]
    return new_program(programs[0].jaxpr, equations, programs[0].jaxpr.invars, given, constants)


def needed(equations: Sequence[core.JaxprEqn], results: Sequence[Atom]) -> list[core.JaxprEqn]:
    """Return those of some equations that results depend on."""
    read, found = set(variables_of(results)), []
    for equation in reversed(equations):
        if equation.effects or any(variable in read for variable in equation.outvars):
            found.append(equation)
            read.update(variables_of(equation.invars))
    return found[::-1]


def variables_of(atoms: Sequence[Atom]) -> dict[core.Var, None]:
    """Return the variables among atoms as the keys of a dict, which keeps their order."""
    return {atom: None for atom in atoms if not isinstance(atom, core.Literal)}


def runs(jaxpr: core.Jaxpr, alike: Callable[[core.JaxprEqn], bool]) -> list[tuple[core.ClosedJaxpr, bool]]:
    """Return equations in runs of those that are alike, each as a program from its operands to results read later."""
    groups = [(kind, list(group)) for kind, group in itertools.groupby(jaxpr.eqns, alike)]
    later, found = variables_of(jaxpr.outvars), []
    for kind, group in reversed(groups):
        found.append((region(jaxpr, group, later), kind))
        later |= variables_of(found[-1][0].jaxpr.invars)
    return found[::-1]


def region(like: core.Jaxpr, equations: list[core.JaxprEqn], later: dict[core.Var, None]) -> core.ClosedJaxpr:
    """Return equations as a program from their operands to results read later."""
    made = variables_of([variable for equation in equations for variable in equation.outvars])
    read = variables_of([atom for equation in equations for atom in equation.invars])
    return new_program(like, equations, [v for v in read if v not in made], [v for v in made if v in later])


# --- activity analysis: dependences, and so the batch axes of a value

Has = tuple[bool, ...]  # which batch axes a value has, behind its own


def reached(jaxpr: core.Jaxpr, moving: Sequence[bool]) -> list[bool]:
    """Return which results depend on the arguments that are `moving`."""
    known = {variable for variable, moves in zip(jaxpr.invars, moving, strict=True) if moves}

    def moves(atom: Atom) -> bool:
        return not isinstance(atom, core.Literal) and atom in known

    for equation in jaxpr.eqns:
        known.update(itertools.compress(equation.outvars, depend(equation, [*map(moves, equation.invars)])))
    return [moves(atom) for atom in jaxpr.outvars]


def carried_on(parameters: Parameters, given: Sequence[bool]) -> list[bool]:
    """Return which values that a loop carries, then which it writes, depend in the end on operands that are moving."""
    constants, carry = scan_sizes(parameters)
    common, moving, read = given[:constants], list(given[constants : constants + carry]), given[constants + carry :]
    while True:
        found = reached(parameters["jaxpr"].jaxpr, [*common, *moving, *read])
        after = [before or now for before, now in zip(moving, found[:carry], strict=True)]
        if after == moving:
            return [*moving, *found[carry:]]
        moving = after


def depend(equation: core.JaxprEqn, given: Sequence[bool]) -> list[bool]:
    """Return which results of an equation depend on the operands that are `given`."""
    if not any(given):
        return [False] * len(equation.outvars)
    name, inner = equation.primitive.name, inner_program(equation)
    if inner is not None and name != "custom_vjp_call":
        return reached(inner.jaxpr, given)
    if name == "scan":
        return carried_on(equation.params, given)
    if name == "while":
        return _repeated(equation.params, given)
    if name == "cond" and not given[0]:
        branches = [reached(branch.jaxpr, given[1:]) for branch in equation.params["branches"]]
        return [any(found) for found in zip(*branches, strict=True)]
    return [True] * len(equation.outvars)


def _repeated(parameters: Parameters, given: Sequence[bool]) -> list[bool]:
    """Return which values that a loop with a condition carries depend on operands: all, once the condition does."""
    of_condition, of_body = parameters["cond_nconsts"], parameters["body_nconsts"]
    asked, common = given[:of_condition], given[of_condition : of_condition + of_body]
    moving = list(given[of_condition + of_body :])
    while True:
        found = reached(parameters["body_jaxpr"].jaxpr, [*common, *moving])
        ends = reached(parameters["cond_jaxpr"].jaxpr, [*asked, *moving])
        after = [before or now or ends[0] for before, now in zip(moving, found, strict=True)]
        if after == moving:
            return moving
        moving = after


def by_axis(of_axis: Callable[[list[bool]], Sequence[bool]], varies: Sequence[Has], axes: int, count: int) -> list[Has]:
    """Return which batch axes `count` values have, by `of_axis`, asked of each axis alone."""
    each = [of_axis([has[axis] for has in varies]) for axis in range(axes)]
    return list(zip(*each, strict=True)) if each else [()] * count


def mapped(function: Function, varies: Sequence[Has], results: Sequence[Has]) -> Function:
    """Return `jax.vmap` of a function of one robot over the batch axes that arguments and results have."""
    for axis in range(len(results[0]) if results else 0):
        if any(has[axis] for has in varies):
            into, out = ([-1 if has[axis] else None for has in some] for some in (varies, results))
            function = jax.vmap(function, in_axes=into, out_axes=out)
    return function


def with_axes(value: Array, has: Has, wanted: Has, batch: tuple[int, ...]) -> Array:
    """Return a value summed over the batch axes that are not wanted, and broadcast over those that it lacks."""
    own = value.ndim - sum(has)
    places = itertools.accumulate(has, initial=own)
    gone = [place for place, h, w in zip(places, has, wanted, strict=False) if h and not w]
    value = value.sum(gone) if gone else value
    left = [h and w for h, w in zip(has, wanted, strict=True)]
    there = [own + sum(wanted[:axis]) for axis, h in enumerate(left) if h]
    shape = (*value.shape[:own], *itertools.compress(batch, wanted))
    return lax.broadcast_in_dim(value, shape, (*range(own), *there))


# --- forward derivatives


def tangents_of(program: core.ClosedJaxpr, moving: Sequence[bool]) -> tuple[core.ClosedJaxpr, list[bool]]:
    """Return a program of the arguments, and the tangents of those that are moving, and which results have tangents.

    It returns the results and then their tangents.
    """
    both, moved = jvp_jaxpr(with_stable_choices(program), tuple(moving), instantiate=False)
    return both, list(moved)


@functools.lru_cache(maxsize=128)
def with_stable_choices(program: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Return a program without `max`, `min`, their reductions and the operations of `simpler`.

    Functions with their own derivative stay.
    """
    if not _has_choices(program.jaxpr):
        return program

    def results_of(equation: core.JaxprEqn, values: list[Array]) -> list[Array]:
        primitive, inner = equation.primitive, inner_program(equation)
        compare = _COMPARISONS.get(primitive.name)
        if compare is not None and not values[0].size:  # of nothing: a constant
            return [lax.stop_gradient(carried_out(primitive, equation.params, values)[0])]
        if compare is not None:
            axes = equation.params.get("axes")
            return [_better(compare, *values) if axes is None else _best(compare, values[0], axes)]
        if inner is None:
            inner = simpler(equation, differentiated=True)
        if inner is not None and not primitive.name.startswith("custom"):
            results: list[Array] = core.jaxpr_as_fun(with_stable_choices(inner))(*values)
            return results
        return carried_out(primitive, with_inner(with_stable_choices, equation), values)

    return jax.make_jaxpr(lambda *arguments: evaluated(program, arguments, results_of))(*program.in_avals)


def evaluated(
    program: core.ClosedJaxpr,
    arguments: Sequence[Array],
    results_of: Callable[[core.JaxprEqn, list[Array]], list[Array]],
) -> list[Array]:
    """Return the results of a program whose equations are carried out by `results_of`."""
    known = dict(zip(program.jaxpr.constvars, program.consts, strict=True))
    known |= dict(zip(program.jaxpr.invars, arguments, strict=True))

    def read(atom: Atom) -> Array:
        value: Array = atom.val if isinstance(atom, core.Literal) else known[atom]
        return value

    for equation in program.jaxpr.eqns:
        with from_line_of(equation):
            results = results_of(equation, [read(atom) for atom in equation.invars])
        known.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in program.jaxpr.outvars]


def _has_choices(jaxpr: core.Jaxpr) -> bool:
    return any(
        equation.primitive.name in _COMPARISONS
        or rule_of(equation, differentiated=True) is not None
        or any(map(_has_choices, core.jaxprs_in_params(equation.params)))
        for equation in jaxpr.eqns
    )


def _better(compare: Callable[[Array, Array], Array], one: Array, other: Array) -> Array:
    """Return the better of two values, element by element: the first of equal ones, and not-a-numbers."""
    one, other = jnp.broadcast_arrays(one, other)
    return lax.select(compare(one, other) | (one != one), one, other)


def _best(compare: Callable[[Array, Array], Array], values: Array, axes: Sequence[int]) -> Array:
    for axis in sorted(axes, reverse=True):
        while (count := values.shape[axis]) > 1:
            half = (count + 1) // 2  # of an odd number the middle one is compared with itself
            first = lax.slice_in_dim(values, 0, half, axis=axis)
            values = _better(compare, first, lax.slice_in_dim(values, count - half, None, axis=axis))
        values = lax.squeeze(values, (axis,))
    return values


_COMPARISONS = {"max": lax.ge, "min": lax.le, "reduce_max": lax.ge, "reduce_min": lax.le}
