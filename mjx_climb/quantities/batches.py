"""Batch axes of laws, gains and parameters, in front of the axes of one robot's values.

A tree here has `AXES`: how many axes one environment's value has, by field, where it is no scalar.
"""

import math
from collections.abc import Callable, Sequence
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


def axes_behind(tree: Tree, shape: Sequence[int]) -> Tree:
    """Return in place of each value how many axes it has behind the batch axes `shape`."""
    own: Tree = jax.tree.map(lambda value: jnp.ndim(value) - len(shape), tree)
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


def flattened(tree: Tree, axes: Tree, shape: Sequence[int]) -> Tree:
    """Return arrays with one batch axis wherever they vary, before each value's own `axes`.

    Of a single robot those vary that have batch axes, so that it walks by the program of several.
    """
    robots = math.prod(shape)

    def flat(value: Any, own: int) -> Any:
        tail, varies = value.shape[value.ndim - own :], robots == 1 and value.ndim > own
        if math.prod(value.shape[: value.ndim - own]) == 1 and not varies:
            return value.reshape(tail)
        broadcast = jnp.broadcast_to if isinstance(value, jax.Array) else np.broadcast_to
        return broadcast(value, (*shape, *tail)).reshape(robots, *tail)

    result: Tree = jax.tree.map(flat, tree, axes)
    return result


def rows_of(tree: Tree, axes: Tree, rows: np.ndarray) -> Tree:
    """Return some environments of a flattened tree."""
    some: Tree = jax.tree.map(lambda value, own: value[rows] if value.ndim > own else value, tree, axes)
    return some


def over_batch(function: Callable[..., Any], trees: Sequence[Any], axes: Sequence[Any], shape: Sequence[int]) -> Any:
    """Return what a function of one robot gives for all robots of a batch, with the batch axes in front.

    What does not vary over the batch is passed as it is, so that it is worked out once.
    """
    if not shape:
        return function(*trees)
    leaves, tree = jax.tree.flatten(flattened(tuple(trees), tuple(axes), shape))
    mapped = [0 if leaf.ndim > own else None for leaf, own in zip(leaves, jax.tree.leaves(tuple(axes)), strict=True)]

    def of_leaves(*leaves: Any) -> Any:
        return function(*jax.tree.unflatten(tree, leaves))

    found = jax.vmap(of_leaves, in_axes=mapped, axis_size=math.prod(shape))(*leaves)
    return jax.tree.map(lambda value: value.reshape(*shape, *value.shape[1:]), found)
