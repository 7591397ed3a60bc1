"""The declaration of a value: unit, shape, bounds, default and meaning. It needs no JAX."""

import dataclasses
import math
import sys
from typing import Any, NamedTuple

_LEAST, _MOST = math.ulp(0.0), sys.float_info.max
BELOW_ONE = math.nextafter(1.0, 0.0)
# bounds, ends included
FINITE = (-_MOST, _MOST)
NONNEGATIVE = (0.0, _MOST)
POSITIVE = (_LEAST, _MOST)
UNLIMITED = (0.0, math.inf)  # infinite: no limit
POSITIVE_OR_INFINITE = (_LEAST, math.inf)
SHARE = (0.0, BELOW_ONE)
PART = (_LEAST, 1.0)
OPEN = (_LEAST, _MOST, BELOW_ONE, math.inf)  # ends that no value of any precision may pass


class ValueField(NamedTuple):
    """The declaration of a value beside its default."""

    unit: str
    shape: tuple[int | None, ...]  # of one robot's value; () of one number; None: any length
    bounds: tuple[float, float]  # of a search
    rotation_bounds: tuple[float, float] | None = None  # of a search, where rotations have their own
    long_name: str = ""
    searched: bool = True  # whether searches move it without being asked
    in_steps: bool = False  # a time that is counted in whole time steps
    limits: tuple[float, float] | None = None  # that a value must lie in; None: those of a search do not bind
    whole: bool = False  # a whole number
    note: str = ""  # behind the long name, for the keys of a config; "null: ..." gives the meaning of null

    @property
    def description(self) -> str:
        """The long name with the unit and the note, as a config's keys have it."""
        return f"{self.long_name}, {self.unit}{self.note and f'; {self.note}'}"

    @property
    def lengths(self) -> tuple[int, ...]:
        """The shape, with 1 in place of any length."""
        return tuple(length or 1 for length in self.shape)

    @property
    def size(self) -> int:
        """How many numbers the value of one robot has."""
        return math.prod(self.lengths)


def parameter(
    unit: str,
    *,
    shape: tuple[int | None, ...] = (),
    bounds: tuple[float, float],
    default: object = dataclasses.MISSING,
    long_name: str = "",
    in_steps: bool = False,
    whole: bool = False,
) -> Any:
    """Return the field of a contact, an actuator or a disturbance that is one of its values.

    Arguments:
        unit: as in "N".
        shape: of one robot's value, None for any length; a value may have batch axes in front, or be a scalar.
        bounds: the lowest and the highest value that there may be.
        default: the value of a component that is made without one.
        long_name: for axes and tables; the field's own name where empty. Behind a semicolon a note for the keys of a
            config, as "; null: none".
        in_steps: a time that a walk rounds to whole time steps, in double precision.
        whole: whole numbers alone.

    Raises:
        ValueError: bounds that are not in order.
    """
    name, _, note = long_name.partition("; ")
    how: dict[str, Any] = {"in_steps": in_steps, "limits": bounds, "whole": whole, "note": note}
    return value_field(ValueField(unit, tuple(shape), bounds, None, name, **how), default)


def value_field(field: ValueField, default: object) -> Any:
    """Return a field of a dataclass that is a value, as declared.

    Raises:
        ValueError: bounds that are not in order.
    """
    for low, high in (field.bounds, field.rotation_bounds or field.bounds):
        if not low < high:
            raise ValueError(f"bounds of a value: expected low < high, got {low}, {high}")
    if isinstance(default, list) or hasattr(default, "__array__"):  # which may be changed in place
        import numpy as np

        own = np.array(default, float)
        return dataclasses.field(default_factory=lambda: own, metadata={"value": field})
    return dataclasses.field(default=default, metadata={"value": field})


def in_words(limits: tuple[float, float]) -> str:
    """Return the numbers between limits in words: "finite numbers above 0"."""
    low, high = limits
    if high in (_MOST, math.inf):
        least = {-_MOST: "", 0.0: " of 0 or more", _LEAST: " above 0"}.get(low, f" of {low:g} or more")
        return f"finite numbers{least}{', or infinite ones' if high == math.inf else ''}"
    if low == _LEAST:
        return "numbers above 0 and below 1" if high == BELOW_ONE else f"numbers above 0, {high:g} at most"
    return f"numbers from {low:g} to {'below 1' if high == BELOW_ONE else f'{high:g}'}"


def one_in_words(limits: tuple[float, float], whole: bool = False) -> str:
    """Return a number between limits in words: "a finite number above 0"; null stands for an infinite one."""
    (low, high), kind = limits, "whole " if whole else ""
    if high in (_MOST, math.inf):
        least = {-_MOST: "", -math.inf: "", 0.0: ", 0 or above", _LEAST: " above 0"}.get(low, f", {low:g} or above")
        return f"a finite {kind}number{least}"
    if low == _LEAST:
        return f"a {kind}number above 0" + (" and below 1" if high == BELOW_ONE else f", {high:g} at most")
    most = "below 1" if high == BELOW_ONE else f"{high:.0f}" if whole else f"{high:g}"
    return f"a {kind}number from {low:g} to {most}"


def option(default: bool | str | float | int, meaning: str) -> Any:
    """Return the field of a component that is part of the program, by keyword alone: another value compiles anew.

    Arguments:
        default: its kind is that of the key in a config.
        meaning: for the keys of a config.
    """
    return dataclasses.field(default=default, kw_only=True, metadata={"meaning": meaning})
