"""Arrays written out element by element, as a kernel sees them: numpy arrays whose entries are single numbers.

An element is a number known when the kernel is written, a value that the kernel computes, or the value that one lane
has of it. An array whose elements are all known is a plain numpy array.

Lanes are the threads that share a robot: a thread for each limb. Values that are computed alike for each limb
are computed once, by all lanes side by side.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import numpy as np
from jax.extend import core

from mjx_climb.execution.jax_types import Parameters


class Unsupported(NotImplementedError):
    """An operation, or a use of it, that a fast path does not know: raised while tracing, for the plain path."""

    equation: core.JaxprEqn | None = None  # which one of the program, where that is known


@dataclasses.dataclass(frozen=True, eq=False)
class Value:
    """A number that every lane has, the same or its own."""

    content: Any  # of the writer that made it
    dtype: np.dtype
    parts: dict[int, "OfLane"] = dataclasses.field(default_factory=dict, repr=False)  # those asked for, by lane


@dataclasses.dataclass(frozen=True, eq=False)
class OfLane:
    """One lane's part of a value."""

    value: Value
    lane: int

    @property
    def dtype(self) -> np.dtype:
        return self.value.dtype


Shared = np.generic | Value  # a number that all lanes have
Number = Shared | OfLane
Elements = np.ndarray  # of such numbers as objects, or of known ones


class Writer(Protocol):
    """Writes operations down one after the other. Numbers are values of it, or known ones."""

    lanes: int  # that share a robot, one for each limb; 1: a robot has one of its own
    sums: bool = False  # whether it has `summed`

    def operation(self, primitive: core.Primitive, parameters: Parameters, operands: Sequence[Shared]) -> Value:
        """Return an elementwise operation of JAX's; each lane does it with its own part."""

    def each_its_own(self, numbers: Sequence[Shared]) -> Value:
        """Return a value that gives each lane the number of its place."""

    def packs(self, numbers: Sequence[Shared]) -> bool:
        """Return whether `each_its_own` of such numbers costs no more than one of them."""
        return False

    def of_lanes(self, value: Value, lanes: Sequence[int]) -> Value:
        """Return a value that gives each lane another lane's part of `value`: of the lane at its place in `lanes`."""

    def over_lanes(self, combine: core.Primitive, value: Value) -> Value | None:
        """Return a value reduced over all lanes; None: the caller exchanges between lanes."""
        return None

    def loop(
        self,
        steps: int,
        start: Sequence[Shared],
        read: Sequence[Sequence[Shared]],
        step: Callable[[list[Value], list[Value]], Sequence[Shared]],
    ) -> tuple[list[Value], list[list[Value]]]:
        """Return the last carry of a loop, and each number that it writes, at all steps.

        `step` maps a carry and the numbers that it reads to the next carry and behind it the numbers that it writes;
        `read` has the values of each number that it reads at all steps.
        """
        raise Unsupported("a loop")

    def summed(self, make: Callable[[], Sequence[Shared]]) -> list[Value]:
        """Return sums of real numbers over all steps of the loop that is being written, to be read behind it."""
        raise Unsupported("sums over steps")

    def branch(self, taken: Shared, before: Sequence[Shared], make: Callable[[], Sequence[Shared]]) -> list[Value]:
        """Return the numbers of `make` where `taken`, the same in all lanes of a robot, is true, `before` elsewhere."""
        raise Unsupported("a branch of its own")


def as_array(elements: Iterable[object], shape: Sequence[int]) -> Elements:
    """Return elements as an array, of plain numbers where all are known."""
    flat = list(elements)
    if flat and all(isinstance(element, np.generic) for element in flat):
        return np.array(flat).reshape(shape)
    array = np.empty(len(flat), object)
    array[:] = flat
    return array.reshape(shape)


def objects(array: Elements) -> Elements:
    """Return an array of elements that keep their types among others, a new one."""
    result = np.empty(array.size, object)
    result[:] = list(array.flat)
    return result.reshape(array.shape)


def along(array: Elements, axis: int) -> list[Elements]:
    """Return an array's parts along an axis, as arrays even where they are single elements."""
    return [np.moveaxis(array, axis, 0)[index, ...] for index in range(array.shape[axis])]


def known(array: Elements) -> bool:
    """Return whether all elements are plain numbers."""
    return array.dtype != object


# --- operations that move elements without a look at them, of the operands and the operation's parameters

Move = Callable[[list[Elements], Parameters], list[Elements]]


def _broadcast(given: list[Elements], p: Parameters) -> list[Elements]:
    [array], shape = given, p["shape"]
    sizes = dict(zip(p["broadcast_dimensions"], array.shape, strict=True))
    return [np.broadcast_to(array.reshape([sizes.get(axis, 1) for axis in range(len(shape))]), shape)]


def _reshaped(given: list[Elements], p: Parameters) -> list[Elements]:
    [array], order = given, p["dimensions"]
    return [(array if order is None else array.transpose(order)).reshape(p["new_sizes"])]


def _alike(given: list[Elements]) -> list[Elements]:
    return given if all(map(known, given)) else [*map(objects, given)]


def _slice(given: list[Elements], p: Parameters) -> list[Elements]:
    steps = p["strides"] or itertools.repeat(1)
    return [given[0][tuple(map(slice, p["start_indices"], p["limit_indices"], steps))]]


MOVES: dict[str, Move] = {
    **dict.fromkeys(("copy", "copy_p", "optimization_barrier", "stop_gradient"), lambda x, p: x),
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda x, p: [np.concatenate(_alike(x), p["dimension"])],
    "reshape": _reshaped,
    "slice": _slice,
    "squeeze": lambda x, p: [np.squeeze(x[0], tuple(p["dimensions"]))],
    "stack": lambda x, p: [np.stack(_alike(x), p["axis"])],
    "transpose": lambda x, p: [x[0].transpose(p["permutation"])],
}
