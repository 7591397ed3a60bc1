"""The seam between the elements of a function and the kernel that is made of them."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from jax.extend import core

from mjx_climb.execution.elements import Number, Value

if TYPE_CHECKING:
    pass


class Writer(Protocol):
    """Writes operations down one after the other. Numbers are values of it, or known ones."""

    lanes: int  # that share a robot, one for each limb; 1: a robot has one of its own

    def operation(self, primitive: core.Primitive, parameters: Mapping[str, Any], operands: Sequence[Number]) -> Value:
        """Return an elementwise operation of JAX's; each lane does it with what it has."""

    def each_its_own(self, numbers: Sequence[Number]) -> Value:
        """Return a value of which each lane has the number of its place."""

    def of_lanes(self, value: Value, lanes: Sequence[int]) -> Value:
        """Return a value of which each lane has what another lane, that of its place, has of `value`."""

    def over_lanes(self, combine: core.Primitive, value: Value) -> Value | None:
        """Return what all lanes have of a value, combined; None: by exchanges between lanes."""
        return None

    def loop(self, steps: int, start: Sequence[Number], step: Callable[[list[Value]], Sequence[Number]]) -> list[Value]:
        """Return what a loop carries in the end: `step` makes what it carries next from what it carried before."""
