"""Types that JAX leaves untyped."""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias, cast

import jax
from jax.extend import core

PyTree: TypeAlias = Any  # of arrays of JAX or NumPy, or of something in place of each
Function: TypeAlias = Callable[..., Any]  # of such trees, and to one
Parameters: TypeAlias = Mapping[str, Any]  # of an equation: each operation has its own
Atom: TypeAlias = core.Var | core.Literal


def aval_of(atom: Atom) -> jax.ShapeDtypeStruct:
    """Return shape and type of an atom's value."""
    return cast(jax.ShapeDtypeStruct, atom.aval)
