"""A law that is worked out less often than the world: what it said last is held, joint targets perhaps interpolated."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.quantities.whole_steps import whole_steps

Tree = TypeVar("Tree")


def period_steps(period: Array, time_step: float) -> Array:
    """Return how many time steps a period in s has, (B,), at least one."""
    return jnp.maximum(whole_steps(period, time_step), 1.0)


def steps_into(step: Array, steps: Array) -> Array:
    """Return how many steps ago the current period began, (B,): 0 where the law is worked out."""
    number = step.astype(steps.dtype)
    # half a step in, so that rounding cannot put the first step of a period into the last
    return number - steps * jnp.floor((number + 0.5) / steps)


def held(now: Array, new: Tree, before: Tree) -> Tree:
    """Return `new` where the law is worked out `now` (B,), what it said before elsewhere; trees of (..., B)."""
    kept: Tree = jax.tree.map(lambda fresh, old: jnp.where(now, fresh, old), new, before)
    return kept


def interpolated(begin: Array, end: Array, into: Array, steps: Array) -> Array:
    """Return targets (..., B) on the line from `begin` to `end`, which is reached in the last step of a period.

    The next target is known a period ahead to nobody: the line lags by up to a period.
    """
    return end - (end - begin) * (1 - (into + 1) / steps)
