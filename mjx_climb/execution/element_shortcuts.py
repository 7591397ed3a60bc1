"""Operations that need not be written: the frames of a robot are full of zeros and ones.

Those that XLA would leave out itself must be found here, as it stops the process at a kernel with a parameter that
nothing reads any more.
"""

import operator
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np

from mjx_climb.execution.elements import Number

Shortcut = Callable[..., Number | None]  # of the operands: the result, None where the operation must be written


def name_of(element: Number) -> Hashable:
    """Return what two elements share where they are the same number."""
    return (element.dtype, element.tobytes()) if isinstance(element, np.generic) else id(element)


def _with(neutral: Callable[[np.dtype], Any], absorbing: Callable[[np.dtype], Any] | None, itself: bool) -> Shortcut:
    """Return the shortcut of an operation that leaves the other operand of a neutral number, and an absorbing one."""

    def shortcut(a: Number, b: Number) -> Number | None:
        if itself and a is b:
            return a
        for one, other in ((a, b), (b, a)):
            if isinstance(one, np.generic) and absorbing is not None and one == absorbing(one.dtype):
                return one
            if isinstance(one, np.generic) and one == neutral(one.dtype):
                return other
        return None

    return shortcut


def _zero(dtype: np.dtype) -> Any:
    return 0


def _all_bits(dtype: np.dtype) -> Any:
    return ~np.zeros((), dtype)


def _least(dtype: np.dtype) -> Any:
    return -np.inf if dtype.kind == "f" else _range(dtype)[0]


def _most(dtype: np.dtype) -> Any:
    return np.inf if dtype.kind == "f" else _range(dtype)[1]


def _range(dtype: np.dtype) -> tuple[int, int]:
    return (0, 1) if dtype.kind == "b" else (int(np.iinfo(dtype).min), int(np.iinfo(dtype).max))


def _is_whole(element: Number) -> bool:
    return element.dtype.kind in "iub"


def _difference(a: Number, b: Number) -> Number | None:
    if isinstance(b, np.generic) and b == 0:
        return a
    return b.dtype.type(0) if a is b and _is_whole(b) else None


def _choice(which: Number, *cases: Number) -> Number | None:
    """Return the case that is taken whatever the choice, or the one that is known to be taken."""
    if isinstance(which, np.generic) and 0 <= int(which) < len(cases):
        return cases[int(which)]
    return cases[0] if len({name_of(case) for case in cases}) == 1 else None


def _nothing_of_itself(a: Number, b: Number) -> Number | None:
    return b.dtype.type(0) if a is b and _is_whole(b) else None


def _compared(compare: Callable[[Any, Any], Any]) -> Shortcut:
    """Return the shortcut of a comparison whose result is known: of equals, or from the range of whole numbers."""

    def shortcut(a: Number, b: Number) -> Number | None:
        if not (_is_whole(a) and _is_whole(b)):
            return None
        if a is b:
            return np.bool_(compare(0, 0))
        if compare in (operator.eq, operator.ne):
            return None
        ends = [(int(e), int(e)) if isinstance(e, np.generic) else _range(e.dtype) for e in (a, b)]
        results = {bool(compare(x, y)) for x in ends[0] for y in ends[1]}
        return np.bool_(results.pop()) if len(results) == 1 else None

    return shortcut


def _shifted(a: Number, b: Number) -> Number | None:
    if isinstance(b, np.generic) and int(b) >= 8 * b.dtype.itemsize:
        return a.dtype.type(0)
    return a if isinstance(b, np.generic) and b == 0 else None


def _remainder(a: Number, b: Number) -> Number | None:
    if _is_whole(b) and (a is b or (isinstance(b, np.generic) and abs(int(b)) == 1)):
        return a.dtype.type(0)
    return None


SHORTCUTS: dict[str, Shortcut] = {
    "add": _with(_zero, None, itself=False),
    "mul": _with(lambda dtype: 1, _zero, itself=False),
    "and": _with(_all_bits, _zero, itself=True),
    "or": _with(_zero, _all_bits, itself=True),
    "max": _with(_least, _most, itself=True),
    "min": _with(_most, _least, itself=True),
    "sub": _difference,
    "select_n": _choice,
    "xor": _nothing_of_itself,
    "eq": _compared(operator.eq),
    "ne": _compared(operator.ne),
    "lt": _compared(operator.lt),
    "le": _compared(operator.le),
    "gt": _compared(operator.gt),
    "ge": _compared(operator.ge),
    "rem": _remainder,
    "shift_left": _shifted,
    "shift_right_logical": _shifted,
}
