"""Arrays written out element by element, as a GPU kernel sees them: numpy arrays whose entries are single numbers.

An element is a number known when the kernel is written, a value that the kernel works out, the value that one lane has
of it, or the two words of a random key. An array whose elements are all known is a plain numpy array.

Lanes are the threads that share a robot: a thread for each limb. What is worked out for each limb in the same way is
worked out once, by all lanes side by side.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True, eq=False)
class Value:
    """A number that every lane has, the same or its own."""

    content: Any  # of the writer that made it
    dtype: np.dtype


@dataclasses.dataclass(frozen=True, eq=False)
class OfLane:
    """What one lane has of a value."""

    value: Value
    lane: int

    @property
    def dtype(self) -> np.dtype:
        return self.value.dtype


@dataclasses.dataclass(frozen=True, eq=False)
class Key:
    """A random key of the Threefry kind: two words of 32 bits."""

    high: "Number"
    low: "Number"


Number = np.generic | Value | OfLane
Element = Number | Key
Elements = np.ndarray  # of such elements, or of numbers


def as_array(elements: Iterator[Element], shape: tuple[int, ...]) -> Elements:
    """Return elements as an array, of plain numbers where all are known."""
    flat = list(elements)
    if flat and all(isinstance(element, np.generic) for element in flat):
        return np.array(flat).reshape(shape)
    array = np.empty(len(flat), object)
    for index, element in enumerate(flat):
        array[index] = element
    return array.reshape(shape)


def flat(arrays: Sequence[Elements]) -> list[Element]:
    """Return the elements of arrays, one after the other."""
    return [element for array in arrays for element in array.reshape(-1)]


def objects(array: Elements) -> Elements:
    """Return an array of elements that keep their types among others."""
    if array.dtype == object:
        return array.copy()
    result = np.empty(array.shape, object)
    for index in np.ndindex(*array.shape):
        result[index] = array[index]
    return result


def along(array: Elements, axis: int) -> list[Elements]:
    """Return an array's parts along an axis, as arrays even where they are single elements."""
    return [np.moveaxis(array, axis, 0)[index, ...] for index in range(array.shape[axis])]


def known(array: Elements) -> bool:
    """Return whether all elements are plain numbers."""
    return array.dtype != object
