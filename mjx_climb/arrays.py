"""Arrays of JAX and of NumPy alike."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

AnyArray = Any  # an array of JAX or of NumPy


def namespace(*arrays: object) -> Any:
    """Return `jax.numpy` where some of the arrays are JAX's, else `numpy`."""
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np
