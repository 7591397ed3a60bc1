"""A fast program where it can be built, else the plain one: said once, and remembered."""

import threading
import warnings
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import jax
from jax.errors import JaxRuntimeError

from mjx_climb.execution.elements import Unsupported

_Result = TypeVar("_Result")
# XLA:CPU works out large arrays by several threads of one pool, in which two programs may wait for each other for ever
_one_at_a_time = threading.Lock()


def one_at_a_time(program: Callable[..., _Result]) -> Callable[..., _Result]:
    """Return a plain program on CPUs, which waits for other such programs."""

    def alone(structure: Hashable, *arrays: Any) -> _Result:
        with _one_at_a_time:
            result: _Result = jax.block_until_ready(program(structure, *arrays))
            return result

    return alone


def first_possible(
    fast: Callable[..., _Result], plain: Callable[[], Callable[..., _Result]], what: str
) -> Callable[..., _Result]:
    """Return a program of a structure and trees of arrays that goes by `fast`, or by `plain` where that cannot be.

    Arguments:
        fast: a program that raises `Unsupported` while it is traced, or an error of the compiler's.
        plain: gives the program that can do everything.
        what: the name of the fast path, for the warning.
    """
    refused: set[Hashable] = set()
    alone = threading.Lock()  # shares of a batch come from several threads

    def program(structure: Hashable, *arrays: Any) -> _Result:
        kind = structure, jax.tree.structure(arrays)
        if kind not in refused:
            try:
                return fast(structure, *arrays)
            except (NotImplementedError, JaxRuntimeError) as error:
                if not isinstance(error, Unsupported) and _out_of_memory(error):
                    raise
                with alone:
                    if kind not in refused:
                        refused.add(kind)
                        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
                        warnings.warn(f"{what} cannot do {reason}: by XLA's own way, slower", stacklevel=2)
        return plain()(structure, *arrays)

    return program


def _out_of_memory(error: Exception) -> bool:
    return "RESOURCE_EXHAUSTED" in str(error)
