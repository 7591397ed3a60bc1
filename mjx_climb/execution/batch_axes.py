"""Batch axes of laws, gains and parameters, in front of the axes of one robot's values.

A tree here is a dataclass, or has some in it, with `AXES`: how many axes one robot's value has, by field, where it is
no scalar.
"""

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.execution.batches import flattened
from mjx_climb.execution.jax_types import PyTree

Tree = TypeVar("Tree")
Result = TypeVar("Result")


def is_traced(tree: PyTree) -> bool:
    """Return whether JAX traces any value of a tree, so that it is not known."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def own_axes(tree: Tree) -> Tree:
    """Return in place of each value how many axes one robot's value has."""
    own: Tree = _axes_of(jax.tree.structure(tree))
    return own


@functools.lru_cache(maxsize=256)
def _axes_of(structure: jax.tree_util.PyTreeDef) -> PyTree:
    """Return `own_axes` of all trees of a structure: types say it, values do not."""
    tree: PyTree = jax.tree.unflatten(structure, range(structure.num_leaves))

    def of(path: Sequence[PyTree], _: PyTree) -> int:
        owner: PyTree = tree  # the dataclass that has the value
        for key in path[:-1]:
            owner = owner[key.idx] if hasattr(key, "idx") else getattr(owner, key.name)
        return int(owner.AXES.get(path[-1].name, 0))

    return jax.tree_util.tree_map_with_path(of, tree)


def axes_behind(tree: Tree, shape: Sequence[int]) -> Tree:
    """Return in place of each value how many axes it has behind the batch axes `shape`."""
    own: Tree = jax.tree.map(lambda value: jnp.ndim(value) - len(shape), tree)
    return own


def batch_shape(*trees: PyTree, others: Mapping[str, tuple[int, ...]] = MappingProxyType({})) -> tuple[int, ...]:
    """Return the batch shape that the values of trees, and other batch axes by name, broadcast to.

    Raises:
        ValueError: in one line, which values have shapes that do not broadcast.
    """
    shapes = [_lead(value, own) for tree in trees for value, own in _with_own_axes(tree)]
    try:
        return np.broadcast_shapes(*dict.fromkeys((*shapes, *others.values())))
    except ValueError:
        paths = [_name(path) for tree in trees for path, _ in jax.tree.leaves_with_path(tree)]
        names: dict[tuple[int, ...], str] = {}  # of the first value of each shape
        for name, shape in (*zip(paths, shapes, strict=True), *others.items()):
            names.setdefault(shape, name)
        got = ", ".join(f"{name} {shape}" for shape, name in names.items() if shape)
        raise ValueError(f"batch axes of gains and parameters: expected some that broadcast, got {got}") from None


def _with_own_axes(tree: PyTree) -> Iterable[tuple[PyTree, int]]:
    """Return the values of a tree, each with how many axes one robot's value has."""
    leaves, structure = jax.tree.flatten(tree)
    return zip(leaves, jax.tree.leaves(_axes_of(structure)), strict=True)


def _lead(value: PyTree, own: int) -> tuple[int, ...]:
    shape: tuple[int, ...] = np.shape(value)
    return shape[: max(0, len(shape) - own)]


def _name(path: Sequence[PyTree]) -> str:
    """Return the place of a value in a tree, "contact.stiffness"."""
    return ".".join(str(key.idx) if hasattr(key, "idx") else key.name for key in path)


def over_batch(
    function: Callable[..., Result], trees: Sequence[PyTree], axes: Sequence[PyTree], shape: Sequence[int]
) -> Result:
    """Return the results of a function of one robot for all robots of a batch, batch axes in front.

    Values that do not vary over the batch are passed unchanged and computed once; of a batch of one what has
    batch axes counts as varying, so that it walks by the program of several.
    """
    if not shape:
        return function(*trees)
    owns = jax.tree.leaves(tuple(axes))
    leaves, tree = jax.tree.flatten(tuple(trees))
    leaves = [flattened(value, own, shape) for value, own in zip(leaves, owns, strict=True)]
    mapped = [0 if value.ndim > own else None for value, own in zip(leaves, owns, strict=True)]

    def of_leaves(*leaves: Array) -> Result:
        return function(*jax.tree.unflatten(tree, leaves))

    found = jax.vmap(of_leaves, in_axes=mapped, axis_size=math.prod(shape))(*leaves)
    return cast(Result, jax.tree.map(lambda value: value.reshape(*shape, *value.shape[1:]), found))
