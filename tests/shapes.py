"""Shapes checked while the tests run: jaxtyping's import hook over both packages, with beartype behind it.

The hook alone would bind the arguments of every function, with shapes or without: a quarter of the tests' time.
"""

import dataclasses
import functools
import operator
import types
from collections.abc import Callable
from typing import Any, Union, get_args, get_origin

import jax
import jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, install_import_hook, jaxtyped

_CHECKED = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int where a float is expected is fine


def check() -> None:
    """Check arguments, results and fields that are annotated with shapes, in all that is imported from here on."""
    jaxtyping.jaxtyped = lambda **_: checked  # the hook decorates with what has this name
    install_import_hook(["mjx_climb", "tuning"], None)


def checked(of: Any) -> Any:
    """Return a function, or a dataclass, with its annotations checked, itself where none is of a shape."""
    if not isinstance(of, type):
        return _checked_function(of)
    if dataclasses.is_dataclass(of) and "__init__" in vars(of):
        of.__init__ = _checked_fields(of.__init__)
    return of


def _checked_function(function: Callable[..., Any]) -> Callable[..., Any]:
    hints = getattr(function, "__annotations__", {})
    if not any(map(_is_shaped, hints.values())):
        return function
    function.__annotations__ = {name: _of_any_array(hint) for name, hint in hints.items()}
    whole = _CHECKED(function)
    function.__annotations__ = hints

    @functools.wraps(function)
    def scoped(*values: Any, **named: Any) -> Any:
        with jaxtyped("context"):  # in which a name in a shape stands for one length
            return whole(*values, **named)

    return scoped


def _checked_fields(init: Callable[..., None]) -> Callable[..., None]:
    """Return the `__init__` of a dataclass that checks arrays, and lets what JAX puts into trees pass."""
    whole = _checked_function(init)

    @functools.wraps(init)
    def filled(*fields: Any, **named: Any) -> None:
        values = jax.tree.leaves((fields[1:], named))
        counts = all(type(value) is int for value in values)  # a tree of what is to be known of another's arrays
        (init if counts or any(map(_stands_for_a_leaf, values)) else whole)(*fields, **named)

    return init if whole is init else filled


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
