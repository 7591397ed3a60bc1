"""Shapes checked while the tests run: jaxtyping's import hook over both packages, with beartype behind it."""

import functools
import operator
import types
from collections.abc import Callable
from typing import Any, Union, get_args, get_origin

import jax
import numpy as np
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, install_import_hook

_CHECKED = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int where a float is expected is fine


def check() -> None:
    """Check arguments, results and fields that are annotated with shapes, in all that is imported from here on."""
    install_import_hook(["mjx_climb", "tuning"], "tests.shapes.checked")


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with its annotations checked, itself where none is of a shape."""
    hints = getattr(function, "__annotations__", {})
    if not any(map(_is_shaped, hints.values())):
        return function
    function.__annotations__ = {name: _of_any_array(hint) for name, hint in hints.items()}
    whole = _CHECKED(function)
    if function.__name__ != "__init__":
        return whole

    @functools.wraps(function)
    def filled(*fields: Any, **named: Any) -> Any:
        values = [value for value in (*fields[1:], *named.values()) if value is not None]
        counts = all(type(value) is int for value in values)  # a tree of what is to be known of another's arrays
        return None if counts or any(map(_stands_for_a_leaf, values)) else whole(*fields, **named)

    return filled


def _is_shaped(hint: object) -> bool:
    return _is_array(hint) or any(map(_is_shaped, get_args(hint)))


def _is_array(hint: object) -> bool:
    return isinstance(hint, type) and issubclass(hint, AbstractArray)


def _of_any_array(hint: Any) -> Any:
    """Return an annotation for arrays of JAX and of numpy alike: one goes for the other."""
    if _is_array(hint):
        return hint.dtype[jax.Array | np.ndarray | np.generic, hint.dim_str]
    if get_origin(hint) in (Union, types.UnionType):
        return functools.reduce(operator.or_, map(_of_any_array, get_args(hint)))
    return hint


def _stands_for_a_leaf(value: object) -> bool:
    """Return whether JAX put a value into a tree in place of an array: a flag, a shape, its name, nothing at all."""
    kind = type(value)
    if isinstance(value, str):
        return value.endswith("]")  # as in "float64[3]"
    return kind in (object, bool) or (kind.__module__.startswith("jax") and not isinstance(value, jax.Array))
