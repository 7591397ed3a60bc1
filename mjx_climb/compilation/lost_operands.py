"""Operations that XLA may simplify until they no longer read one of their operands: `x and False`, `where(p, x, x)`."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
from jax.extend import core

# results that are the same numbers as the operand, so that XLA may see through them
_TRANSPARENT = {"stop_gradient", "copy", "copy_p", "optimization_barrier"}
# of an array of equal numbers they make another one
_SPREADING = {"broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "rev", "slice"}
_OF_EQUAL_OPERANDS = {"sub", "xor", "rem", "eq", "ne", "lt", "le", "gt", "ge"}  # constant, for whole numbers
_COMPARISONS = {"lt", "le", "gt", "ge"}


def losing(equations: Sequence[core.JaxprEqn], constants: Mapping[core.Var, Any]) -> set[int]:
    """Return the ids of the equations that may lose an operand."""
    values = _Values(constants)
    lost = set()
    for equation in equations:
        operands = [values.of(atom) for atom in equation.invars]
        if _may_lose(equation, operands, values.uniform):
            lost.add(id(equation))
        values.note(equation, operands, absorbed=id(equation) in lost)
    return lost


class _Values:
    """Numbers for values, the same for what is surely equal; and which are arrays of one number only."""

    def __init__(self, constants: Mapping[core.Var, Any]) -> None:
        self.uniform: dict[int, Any] = {}
        self._numbers: dict[Any, int] = {}
        self._of: dict[core.Var, int] = {}
        for variable, value in constants.items():
            self._uniform(self.of(variable), value)

    def of(self, atom: core.Var | core.Literal) -> int:
        """Return the number of a value."""
        if isinstance(atom, core.Literal):
            aval: Any = atom.aval
            number = self._number((aval.dtype, aval.shape, np.asarray(atom.val).tobytes()))
            self._uniform(number, atom.val)
            return number
        if atom not in self._of:
            self._of[atom] = self._number(("variable", id(atom)))
        return self._of[atom]

    def note(self, equation: core.JaxprEqn, operands: Sequence[int], *, absorbed: bool) -> None:
        """Take down the results of an equation."""
        name = equation.primitive.name
        for index, variable in enumerate(equation.outvars):
            if name in _TRANSPARENT:
                self._of[variable] = operands[index]
                continue
            number = self._of[variable] = self._result(equation, index, operands)
            known = [self.uniform[operand] for operand in operands if operand in self.uniform]
            if name in _SPREADING and known:
                self.uniform[number] = known[0]
            elif name == "convert_element_type" and known:
                self.uniform[number] = np.asarray(known[0], cast(Any, variable.aval).dtype)[()]
            elif name in ("and", "or", "mul") and absorbed:
                self.uniform[number] = next(value for value in known if _absorbs(name, value))

    def _result(self, equation: core.JaxprEqn, index: int, operands: Sequence[int]) -> int:
        try:
            return self._number((equation.primitive.name, tuple(equation.params.items()), tuple(operands), index))
        except TypeError:  # parameters that are no plain values
            return self._number(("variable", id(equation.outvars[index])))

    def _number(self, name: Any) -> int:
        return self._numbers.setdefault(name, len(self._numbers))

    def _uniform(self, number: int, value: Any) -> None:
        if isinstance(value, (bool, int, float, np.generic, np.ndarray)) and np.size(value):
            array = np.asarray(value)
            if (array == array.flat[0]).all():
                self.uniform[number] = array.flat[0]


def _may_lose(equation: core.JaxprEqn, operands: Sequence[int], uniform: Mapping[int, Any]) -> bool:
    name = equation.primitive.name
    constant = [uniform[operand] for operand in operands if operand in uniform]
    if name == "select_n":
        cases = [("uniform", uniform[case]) if case in uniform else ("value", case) for case in operands[1:]]
        return operands[0] in uniform or len(set(cases)) < len(cases)
    if name == "clamp":
        return len(constant) >= 2
    if name == "pow":
        return operands[1] in uniform and uniform[operands[1]] == 0
    if not equation.invars:
        return False
    aval: Any = equation.invars[0].aval
    if jnp.issubdtype(aval.dtype, jnp.inexact):
        return name in ("max", "min") and any(np.isinf(value) for value in constant)
    if name in _OF_EQUAL_OPERANDS and operands[0] == operands[1]:
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
