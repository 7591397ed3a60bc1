"""Which axis of each value in a program runs over the limbs: found by data flow from the arrays that `of_limbs` marks.

The GPU kernel gives each limb a thread of its own, and the CPU's regions compute all limbs by one operation. Both ask
for the axis by name. It is never guessed from a shape: a quaternion has four components with any number of limbs.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import ClassVar, Protocol, TypeVar, runtime_checkable

import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.extend import core

from mjx_climb.execution.jax_internals import inner_program, scan_sizes
from mjx_climb.execution.jax_types import Atom, Parameters, aval_of

Axis = int | None
_NAME = "limbs"


@runtime_checkable
class HasLimbs(Protocol):
    """A dataclass that names its fields whose first axis runs over the limbs; None in place of one is passed over."""

    OF_LIMBS: ClassVar[tuple[str, ...]]
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[object]]]


Tree = TypeVar("Tree", bound=HasLimbs)


def of_limbs(tree: Tree) -> Tree:
    """Return a dataclass as it is, the arrays marked whose first axis runs over the limbs: its class names them.

    Raises:
        TypeError: a class without `OF_LIMBS`, the names of such fields.
    """
    if not isinstance(tree, HasLimbs):
        raise TypeError(
            f"{type(tree).__name__}: expected a class with OF_LIMBS, the fields whose first axis is the limbs"
        )
    values = {name: getattr(tree, name) for name in tree.OF_LIMBS}
    marked = {name: checkpoint_name(jnp.asarray(v), _NAME) for name, v in values.items() if v is not None}
    return dataclasses.replace(tree, **marked)


class LimbAxes:
    """The axis of the limbs of each variable of a flat program, its loops' bodies included, and how many limbs."""

    def __init__(self, program: core.ClosedJaxpr) -> None:
        self.count = 1
        self._axes: dict[core.Var, int] = {}
        self.follow(program.jaxpr, [None] * len(program.jaxpr.invars))

    def of(self, atom: Atom) -> Axis:
        """Return the axis of a value, None where it has none."""
        return None if isinstance(atom, core.Literal) else self._axes.get(atom)

    def follow(self, jaxpr: core.Jaxpr, axes: Sequence[Axis]) -> list[Axis]:
        """Find the axes of all that is in a program, from those of its arguments; return those of its results."""
        self._note(jaxpr.invars, axes)
        for equation in jaxpr.eqns:
            self._note(equation.outvars, self._through(equation))
        return [self.of(atom) for atom in jaxpr.outvars]

    def _note(self, variables: Sequence[core.Var], axes: Sequence[Axis]) -> None:
        for variable, axis in zip(variables, axes, strict=True):
            if axis is not None and _shape(variable)[axis] == self.count:
                self._axes[variable] = axis

    def _through(self, equation: core.JaxprEqn) -> Sequence[Axis]:
        name, given = equation.primitive.name, [self.of(atom) for atom in equation.invars]
        if name == "name" and equation.params["name"] == _NAME:
            self.count = _shape(equation.invars[0])[0]
            return [0]
        if name == "scan":
            return self._scan(equation, given)
        if name == "cond":
            return next(iter([self.follow(branch.jaxpr, given[1:]) for branch in equation.params["branches"]]))
        if (inner := inner_program(equation)) is not None:
            return self.follow(inner.jaxpr, given)
        moves = [(axis, atom) for axis, atom in zip(given, equation.invars, strict=True) if axis is not None]
        if not moves:
            axis = None
        elif name == "dot_general":
            axis = _of_product(equation, given)
        else:
            (axis, operand), after = moves[0], _shape(equation.outvars[0])
            if name in _MOVES:
                axis = _MOVES[name](equation.params, axis, _shape(operand), after)
            elif _shape(operand) != after or len(equation.outvars) > 1:
                axis = None
        return [axis] * len(equation.outvars)

    def _scan(self, equation: core.JaxprEqn, given: list[Axis]) -> list[Axis]:
        """Return the axes of a loop's last carry and of its records: carried values get theirs from any step."""
        body = equation.params["jaxpr"].jaxpr
        constants, carry = scan_sizes(equation.params)
        common, carried, read = given[:constants], given[constants : constants + carry], given[constants + carry :]
        read = [None if not axis else axis - 1 for axis in read]
        while True:
            found = self.follow(body, [*common, *carried, *read])
            after = [was if was is not None else now for was, now in zip(carried, found[:carry], strict=True)]
            if after == carried:
                return [*carried, *(None if axis is None else axis + 1 for axis in found[carry:])]
            carried = after


def _shape(atom: Atom) -> tuple[int, ...]:
    shape: tuple[int, ...] = aval_of(atom).shape
    return shape


def _of_product(equation: core.JaxprEqn, given: list[Axis]) -> Axis:
    """Return where the axis of either operand is in a product of matrices: those of a batch, of the left, the right."""
    summed, batched = equation.params["dimension_numbers"]
    before = len(batched[0])
    for operand, axis in enumerate(given):
        if axis in batched[operand]:
            return list(batched[operand]).index(axis)
        gone = (*summed[operand], *batched[operand])
        free = [a for a in range(len(_shape(equation.invars[operand]))) if a not in gone]
        if axis in free:
            return before + free.index(axis)
        before += len(free)
    return None


def _without(axis: int, gone: Sequence[int]) -> Axis:
    return None if axis in gone else axis - sum(other < axis for other in gone)


def _among(axis: int, new: Sequence[int]) -> int:
    """Return where an axis is once there are new ones, whose places are counted among all."""
    for place in sorted(new):
        axis += place <= axis
    return axis


def _reshaped(p: Parameters, axis: int, before: Sequence[int], after: Sequence[int]) -> Axis:
    """Return where an axis is after a reshape that keeps it and all that is before it."""
    count = math.prod(before[:axis])
    places = (n for n, size in enumerate(after) if math.prod(after[:n]) == count and size == before[axis])
    return None if p["dimensions"] else next(places, None)


# Where the operation's first operand with an axis of the limbs has it in the result, by parameters, axis and shapes,
# None where it is none any more. Other operations keep it together with the shape, if it has one result.
_Move = Callable[[Parameters, int, tuple[int, ...], tuple[int, ...]], Axis]
_MOVES: dict[str, _Move] = {
    **dict.fromkeys(
        "reduce_sum reduce_max reduce_min reduce_prod reduce_and reduce_or reduce_xor argmax argmin".split(),
        lambda p, axis, *_: _without(axis, p["axes"]),
    ),
    # along the axis they change its size, so that `_note` drops it
    **dict.fromkeys(("concatenate", "dynamic_slice", "pad", "slice", "split"), lambda _, axis, *__: axis),
    "broadcast_in_dim": lambda p, axis, *_: p["broadcast_dimensions"][axis],
    "expand_dims": lambda p, axis, *_: _among(axis, p["dimensions"]),
    "gather": lambda *_: None,
    "reshape": _reshaped,
    "rev": lambda p, axis, *_: None if axis in p["dimensions"] else axis,
    "squeeze": lambda p, axis, *_: _without(axis, p["dimensions"]),
    "stack": lambda p, axis, *_: _among(axis, [p["axis"]]),
    "transpose": lambda p, axis, *_: list(p["permutation"]).index(axis),
    "unstack": lambda p, axis, *_: _without(axis, [p["axis"]]),
}
