"""A traced program as one list of equations: calls are written out, and what nothing needs is left out."""

from collections.abc import Callable, Sequence
from typing import Any

from jax.extend import core

from mjx_climb.execution.jax_internals import inner_program, new_program, new_variable

Atom = core.Var | core.Literal


def flat(program: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Return a program without calls, and the bodies of its loops without calls; no two equations share a variable."""
    constants: dict[int, tuple[core.Var, Any]] = {}  # by id
    equations: list[core.JaxprEqn] = []

    def written_out(program: core.ClosedJaxpr, arguments: Sequence[Atom]) -> list[Atom]:
        atoms: dict[core.Var, Atom] = dict(zip(program.jaxpr.invars, arguments, strict=True))
        for variable, value in zip(program.jaxpr.constvars, program.consts, strict=True):
            atoms[variable] = constants.setdefault(id(value), (new_variable(variable.aval), value))[0]

        def read(atom: Atom) -> Atom:
            return atom if isinstance(atom, core.Literal) else atoms[atom]

        for equation in program.jaxpr.eqns:
            given, inner = [read(atom) for atom in equation.invars], inner_program(equation)
            if inner is not None:
                atoms |= zip(equation.outvars, written_out(inner, given), strict=True)
                continue
            parameters = equation.params
            if equation.primitive.name == "scan":
                parameters = parameters | {"jaxpr": flat(parameters["jaxpr"])}
            made = [new_variable(variable.aval) for variable in equation.outvars]
            atoms |= zip(equation.outvars, made, strict=True)
            equations.append(equation.replace(invars=given, outvars=made, params=parameters))
        return [read(atom) for atom in program.jaxpr.outvars]

    inputs = [new_variable(variable.aval) for variable in program.jaxpr.invars]
    outputs = written_out(program, inputs)
    return new_program(program.jaxpr, needed(equations, outputs), inputs, outputs, list(constants.values()))


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
    """Return equations in runs of those that are alike, each as a program of what it reads to what is read later."""
    groups: list[tuple[list[core.JaxprEqn], bool]] = []
    for equation in jaxpr.eqns:
        kind = alike(equation)
        if not groups or groups[-1][1] != kind:
            groups.append(([], kind))
        groups[-1][0].append(equation)
    later, found = variables_of(jaxpr.outvars), []
    for group, kind in reversed(groups):
        found.append((region(jaxpr, group, later), kind))
        later |= variables_of(found[-1][0].jaxpr.invars)
    return found[::-1]


def region(like: core.Jaxpr, equations: list[core.JaxprEqn], later: dict[core.Var, None]) -> core.ClosedJaxpr:
    """Return equations as a program of what they read to what is read later."""
    made = variables_of([variable for equation in equations for variable in equation.outvars])
    read = variables_of([atom for equation in equations for atom in equation.invars])
    return new_program(like, equations, [v for v in read if v not in made], [v for v in made if v in later])
