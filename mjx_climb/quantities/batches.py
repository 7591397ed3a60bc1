"""Batch axes of laws, gains and parameters: leading in public, last in the hot path.

A tree here has `AXES`: how many axes one environment's value has, by field, where it is no scalar.
"""

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Tree = TypeVar("Tree")


def own_axes(tree: Tree) -> Tree:
    """Return in place of each value how many axes one environment's value has."""
    axes = tree.AXES  # type: ignore[attr-defined]
    own: Tree = jax.tree_util.tree_map_with_path(lambda path, _: axes.get(path[-1].name, 0), tree)
    return own


def batch_shape(*trees: Any) -> tuple[int, ...]:
    """Return the batch shape that the values of trees broadcast to.

    Raises:
        ValueError: shapes that do not broadcast.
    """
    shapes = []
    for tree in trees:
        pairs = zip(jax.tree.leaves(tree), jax.tree.leaves(own_axes(tree)), strict=True)
        shapes += [jnp.shape(value)[: max(0, jnp.ndim(value) - own)] for value, own in pairs]
    return jnp.broadcast_shapes(*shapes)


def batch_last(tree: Tree, shape: Sequence[int], dtype: Any) -> Tree:
    """Return a tree with values (..., B) in the layout of the hot path.

    The batch axes `shape` are flattened to one; what does not vary over them keeps a batch axis of size one.
    """

    def last(value: Any, own: int) -> jax.Array:
        value = jnp.asarray(value, dtype)
        natural, lead = value.shape[value.ndim - own :], value.shape[: value.ndim - own]
        if math.prod(lead) != 1:
            lead = tuple(shape)
        value = jnp.broadcast_to(value, (*lead, *natural)).reshape(math.prod(lead), *natural)
        return jnp.moveaxis(value, 0, -1)

    laid_out: Tree = jax.tree.map(last, tree, own_axes(tree))
    return laid_out


def flattened(tree: Tree, axes: Tree, shape: Sequence[int]) -> Tree:
    """Return arrays of numpy with one batch axis wherever they vary, before each value's own `axes`.

    Of a single robot those vary that have batch axes, so that it walks by the program of several.
    """
    robots = math.prod(shape)

    def flat(value: np.ndarray, own: int) -> np.ndarray:
        tail, varies = value.shape[value.ndim - own :], robots == 1 and value.ndim > own
        if math.prod(value.shape[: value.ndim - own]) == 1 and not varies:
            return value.reshape(tail)
        return np.broadcast_to(value, (*shape, *tail)).reshape(robots, *tail)

    result: Tree = jax.tree.map(flat, tree, axes)
    return result


def rows_of(tree: Tree, axes: Tree, rows: np.ndarray) -> Tree:
    """Return some environments of a flattened tree."""
    some: Tree = jax.tree.map(lambda value, own: value[rows] if value.ndim > own else value, tree, axes)
    return some


def varying(tree: Tree) -> Tree:
    """Return in place of each value of a flattened tree whether it varies from environment to environment."""
    flags: Tree = jax.tree.map(lambda value, own: jnp.ndim(value) > own, tree, own_axes(tree))
    return flags
