"""Shapes checked while the tests run: jaxtyping's import hook over both packages, with beartype behind it."""

import functools
from collections.abc import Callable
from typing import Any, get_args

import jax
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, install_import_hook

_CHECKED = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int where a float is expected is fine


def check() -> None:
    """Check arguments, results and fields that are annotated with shapes, in all that is imported from here on."""
    install_import_hook(["mjx_climb", "tuning"], "tests.shapes.checked")


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with its annotations checked, itself where none is of a shape."""
    if not any(_is_shaped(hint) for hint in getattr(function, "__annotations__", {}).values()):
        return function
    whole = _CHECKED(function)
    if function.__name__ != "__init__":
        return whole

    @functools.wraps(function)
    def filled(*fields: Any, **named: Any) -> Any:
        return None if any(map(_stands_for_a_leaf, (*fields, *named.values()))) else whole(*fields, **named)

    return filled


def _stands_for_a_leaf(value: object) -> bool:
    """Return whether JAX put a value into a tree in place of an array: a flag, a shape, nothing at all."""
    kind = type(value)
    return kind in (object, bool) or (kind.__module__.startswith("jax") and not isinstance(value, jax.Array))


def _is_shaped(hint: object) -> bool:
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(_is_shaped(part) for part in get_args(hint))
