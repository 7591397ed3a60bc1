"""Operations that XLA may simplify until they no longer read one of their operands: `x and False`, `where(p, x, x)`."""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
from jax.extend import core

# results that are the same numbers as the operand, so that XLA may see through them
_TRANSPARENT = {"stop_gradient", "copy", "copy_p", "optimization_barrier"}
# of an array of equal numbers they make another one
_SPREADING = {"broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "rev", "slice"} | _TRANSPARENT
_OF_EQUAL_OPERANDS = {"sub", "xor", "rem", "eq", "ne", "lt", "le", "gt", "ge"}  # constant, for whole numbers
_COMPARISONS = {"lt", "le", "gt", "ge"}


def losing(equations: Sequence[core.JaxprEqn], constants: Mapping[core.Var, Any]) -> set[int]:
    """Return the ids of the equations that may lose an operand."""
    names: dict[core.Var, Hashable] = {}  # equal names, equal values
    uniform: dict[Hashable, Any] = {}  # by name: the one number that an array consists of
    lost = set()

    def name_of(atom: core.Var | core.Literal) -> Hashable:
        if isinstance(atom, core.Literal):
            aval: Any = atom.aval
            name: Hashable = "literal", aval.dtype, aval.shape, np.asarray(atom.val).tobytes()
            _note_uniform(uniform, name, atom.val)
            return name
        if atom not in names:
            names[atom] = "variable", id(atom)
            if atom in constants:
                _note_uniform(uniform, names[atom], constants[atom])
        return names[atom]

    for equation in equations:
        operands = [name_of(atom) for atom in equation.invars]
        if _may_lose(equation, operands, uniform):
            lost.add(id(equation))
        primitive = equation.primitive.name
        for index, variable in enumerate(equation.outvars):
            if primitive in _TRANSPARENT:
                names[variable] = operands[index]
                continue
            names[variable] = _result_name(equation, index, operands)
            if primitive in _SPREADING and operands[0] in uniform:
                uniform[names[variable]] = uniform[operands[0]]
            elif primitive == "convert_element_type" and operands[0] in uniform:
                _note_uniform(
                    uniform, names[variable], np.asarray(uniform[operands[0]], cast(Any, variable.aval).dtype)
                )
            elif primitive in ("and", "or", "mul") and id(equation) in lost:
                absorbing = next(uniform[o] for o in operands if o in uniform and _absorbs(primitive, uniform[o]))
                uniform[names[variable]] = absorbing
    return lost


def _result_name(equation: core.JaxprEqn, index: int, operands: Sequence[Hashable]) -> Hashable:
    try:
        name = equation.primitive.name, tuple(sorted(equation.params.items())), tuple(operands), index
        hash(name)
    except TypeError:  # parameters that are no plain values
        return "variable", id(equation.outvars[index])
    return name


def _note_uniform(uniform: dict[Hashable, Any], name: Hashable, value: Any) -> None:
    if isinstance(value, (bool, int, float, np.generic, np.ndarray)) and np.size(value):
        array = np.asarray(value)
        if array.size == 1 or (array == array.flat[0]).all():
            uniform[name] = array.flat[0]


def _may_lose(equation: core.JaxprEqn, operands: Sequence[Hashable], uniform: Mapping[Hashable, Any]) -> bool:
    name = equation.primitive.name
    constant = [uniform[operand] for operand in operands if operand in uniform]
    if name == "select_n":
        cases = [("uniform", uniform[case]) if case in uniform else case for case in operands[1:]]
        return operands[0] in uniform or len(set(cases)) < len(cases)
    if name == "clamp":
        return len(constant) >= 2
    if name == "pow":
        return operands[1] in uniform and uniform[operands[1]] == 0
    aval: Any = equation.invars[0].aval if equation.invars else None
    if aval is None or jnp.issubdtype(aval.dtype, jnp.inexact):
        return name in ("max", "min") and any(np.isinf(value) for value in constant)
    if name in _OF_EQUAL_OPERANDS and len(operands) == 2 and operands[0] == operands[1]:
        return True
    return any(_absorbs(name, value) for value in constant)


def _absorbs(name: str, value: Any) -> bool:
    """Return whether an operation with such a whole number or truth value no longer depends on the other operand."""
    kind = np.asarray(value).dtype
    if jnp.issubdtype(kind, jnp.inexact):
        return False
    boolean = jnp.issubdtype(kind, jnp.bool_)
    least, most = (False, True) if boolean else (np.iinfo(kind).min, np.iinfo(kind).max)
    if name in ("and", "mul"):
        return bool(value == 0)
    if name == "or":
        return bool(value) if boolean else bool(~np.asarray(value) == 0)
    if name in _COMPARISONS or name in ("max", "min"):
        return bool(value in (least, most))
    if name.startswith("shift"):
        return bool(value >= 8 * kind.itemsize)
    return name == "rem" and value in (1, -1)
