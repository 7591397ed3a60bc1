"""Which axis of each value in a program runs over the limbs: found by data flow from the arrays that `of_limbs` marks.

The GPU kernel gives each limb a thread of its own, and the CPU's regions work out all limbs by one operation. Both ask
for the axis by name. It is never guessed from a shape: a quaternion has four components, whatever the limbs.
"""

import dataclasses
import typing
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.extend import core

from mjx_climb.execution.jax_internals import inner_program, scan_sizes

Tree = TypeVar("Tree")
Axis = int | None
_NAME = "limbs"


def of_limbs(tree: Tree) -> Tree:
    """Return a dataclass as it is, its arrays marked whose declared shape (jaxtyping) begins with the limbs."""
    hints = typing.get_type_hints(type(tree))
    named = {field.name: hints[field.name] for field in dataclasses.fields(cast(Any, tree))}
    marked = {
        name: checkpoint_name(jnp.asarray(value), _NAME)
        for name, hint in named.items()
        if (value := getattr(tree, name)) is not None and _begins_with_limbs(hint)
    }
    result: Tree = dataclasses.replace(cast(Any, tree), **marked)
    return result


def _begins_with_limbs(hint: Any) -> bool:
    """Return whether a type, or one that it is a union of, is an array with the limbs first."""
    return any(getattr(kind, "dim_str", "").split(" ")[0] == "limb" for kind in typing.get_args(hint) or [hint])


class LimbAxes:
    """The axis of the limbs of each variable of a flat program, its loops' bodies included, and how many limbs."""

    def __init__(self, program: core.ClosedJaxpr, of_arguments: Sequence[Axis] = ()) -> None:
        self.count = 1
        self._axes: dict[core.Var, int] = {}
        self._body(program.jaxpr, of_arguments or [None] * len(program.jaxpr.invars))

    def of(self, atom: core.Var | core.Literal) -> Axis:
        """Return the axis of a value, None where it has none."""
        return None if isinstance(atom, core.Literal) else self._axes.get(atom)

    def _body(self, jaxpr: core.Jaxpr, axes: Sequence[Axis]) -> list[Axis]:
        for variable, axis in zip(jaxpr.invars, axes, strict=True):
            self._note(variable, axis)
        for equation in jaxpr.eqns:
            for variable, axis in zip(equation.outvars, self._through(equation), strict=True):
                self._note(variable, axis)
        return [self.of(atom) for atom in jaxpr.outvars]

    def _note(self, variable: core.Var, axis: Axis) -> None:
        aval: Any = variable.aval
        if axis is not None and aval.shape[axis] == self.count:
            self._axes[variable] = axis

    def _through(self, equation: core.JaxprEqn) -> Sequence[Axis]:
        name, given = equation.primitive.name, [self.of(atom) for atom in equation.invars]
        if name == "name" and equation.params["name"] == _NAME:
            self.count = cast(Any, equation.invars[0].aval).shape[0]
            return [0]
        if name == "scan":
            return self._scan(equation, given)
        if (inner := inner_program(equation)) is not None:
            return self._body(inner.jaxpr, given)
        if all(axis is None for axis in given):
            return [None] * len(equation.outvars)
        if name in _MOVES:
            return _MOVES[name](equation, given)
        shape = cast(Any, equation.outvars[0].aval).shape
        whole = [a for a, atom in zip(given, equation.invars, strict=True) if cast(Any, atom.aval).shape == shape]
        axis = next((axis for axis in whole if axis is not None), None)  # of operations that keep the shape
        return [axis] * len(equation.outvars)

    def _scan(self, equation: core.JaxprEqn, given: list[Axis]) -> list[Axis]:
        """Return the axes of what a loop carries in the end and writes: carried values get theirs from any step."""
        body = equation.params["jaxpr"].jaxpr
        constants, carry = scan_sizes(equation.params)
        common, carried, read = given[:constants], given[constants : constants + carry], given[constants + carry :]
        read = [None if not axis else axis - 1 for axis in read]
        while True:
            found = self._body(body, [*common, *carried, *read])
            after = [was if was is not None else now for was, now in zip(carried, found[:carry], strict=True)]
            if after == carried:
                return [*carried, *(None if axis is None else axis + 1 for axis in found[carry:])]
            carried = after


def _shape(atom: Any) -> tuple[int, ...]:
    return tuple(atom.aval.shape)


def _reshaped(before: Sequence[int], after: Sequence[int], axis: int) -> Axis:
    """Return where an axis is after a reshape that keeps it and all that is before it."""
    count = int(np.prod(before[:axis]))
    for place in range(len(after)):
        if int(np.prod(after[:place])) == count and after[place] == before[axis]:
            return place
    return None


def _without(axis: int, gone: Sequence[int]) -> Axis:
    return None if axis in gone else axis - sum(other < axis for other in gone)


def _among(axis: int, new: Sequence[int]) -> int:
    """Return where an axis is once there are new ones, whose places are counted among all."""
    for place in sorted(new):
        axis += place <= axis
    return axis


def _one(rule: Callable[[dict[str, Any], int, Any], Axis]) -> Callable[[core.JaxprEqn, list[Axis]], list[Axis]]:
    """Return the rule of an operation whose first operand counts."""

    def through(equation: core.JaxprEqn, given: list[Axis]) -> list[Axis]:
        axis = None if given[0] is None else rule(equation.params, given[0], equation)
        return [axis] * len(equation.outvars)

    return through


def _whole_slice(p: dict[str, Any], axis: int, e: Any) -> Axis:
    return axis if _shape(e.outvars[0])[axis] == _shape(e.invars[0])[axis] else None


def _side_by_side(equation: core.JaxprEqn, given: list[Axis]) -> list[Axis]:
    axis = next((axis for axis in given if axis is not None), None)
    return [None if axis == equation.params["dimension"] else axis]


def _stacked(equation: core.JaxprEqn, given: list[Axis]) -> list[Axis]:
    axis = next((axis for axis in given if axis is not None), None)
    return [None if axis is None else _among(axis, [equation.params["axis"]])]


def _product_of_matrices(equation: core.JaxprEqn, given: list[Axis]) -> list[Axis]:
    summed, shared = equation.params["dimension_numbers"]
    place = 0
    for operand, axis in enumerate(given):
        free = [
            a for a in range(len(_shape(equation.invars[operand]))) if a not in (*summed[operand], *shared[operand])
        ]
        if axis in shared[operand]:
            return [list(shared[operand]).index(axis)]
        if axis in free:
            return [len(shared[0]) + place + free.index(axis)]
        place += len(free)
    return [None]


_REDUCTIONS = "reduce_sum reduce_max reduce_min reduce_prod reduce_and reduce_or reduce_xor argmax argmin".split()
_MOVES: dict[str, Callable[[core.JaxprEqn, list[Axis]], Sequence[Axis]]] = {
    **dict.fromkeys(_REDUCTIONS, _one(lambda p, axis, e: _without(axis, p["axes"]))),
    "broadcast_in_dim": _one(lambda p, axis, e: p["broadcast_dimensions"][axis]),
    "concatenate": _side_by_side,
    "dot_general": _product_of_matrices,
    "dynamic_slice": _one(_whole_slice),
    "dynamic_update_slice": _one(lambda p, axis, e: axis),
    "expand_dims": _one(lambda p, axis, e: _among(axis, p["dimensions"])),
    "gather": _one(lambda p, axis, e: None),
    "pad": _one(_whole_slice),
    "reshape": _one(
        lambda p, axis, e: None if p["dimensions"] else _reshaped(_shape(e.invars[0]), _shape(e.outvars[0]), axis)
    ),
    "rev": _one(lambda p, axis, e: None if axis in p["dimensions"] else axis),
    "slice": _one(_whole_slice),
    "split": _one(lambda p, axis, e: None if axis == p["axis"] else axis),
    "squeeze": _one(lambda p, axis, e: _without(axis, p["dimensions"])),
    "stack": _stacked,
    "transpose": _one(lambda p, axis, e: list(p["permutation"]).index(axis)),
    "unstack": _one(lambda p, axis, e: _without(axis, [p["axis"]])),
}
