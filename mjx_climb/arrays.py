"""Arrays of JAX and of NumPy alike, and trees of them."""

from types import ModuleType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

AnyArray = Any  # an array of JAX or of NumPy
Tree = TypeVar("Tree")  # of a pytree that a function returns with the same structure


def namespace(*arrays: object) -> ModuleType:
    """Return `jax.numpy` where some of the arrays are JAX's, else `numpy`."""
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np
