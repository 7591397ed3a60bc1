"""The larger and the smaller of values, with the derivative of the one that was chosen.

JAX takes the derivative of a maximum where a value equals it. A compiler that works out the two apart, in two kernels
that round differently, finds no value equal: the derivative of a maximum over rows is then 0/0, of two values 0. Here
one comparison chooses value and derivative. Of equal values the first is chosen; what is not a number stays, as in
JAX's own.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array


def larger(one: Array, other: Array) -> Array:
    """Return the larger of two values, element by element."""
    return jnp.where((one >= other) | (one != one), one, other)


def smaller(one: Array, other: Array) -> Array:
    """Return the smaller of two values, element by element."""
    return jnp.where((one <= other) | (one != one), one, other)


def largest_row(rows: Array) -> Array:
    """Return the largest (...) of values (n, ...)."""
    return _best(larger, rows)


def smallest_row(rows: Array) -> Array:
    """Return the smallest (...) of values (n, ...)."""
    return _best(smaller, rows)


def _best(better: Callable[[Array, Array], Array], rows: Array) -> Array:
    while (count := rows.shape[0]) > 1:
        half = (count + 1) // 2  # of an odd number the middle one is compared with itself
        rows = better(rows[:half], rows[count - half :])
    return rows[0]
