"""A function of one robot as one GPU kernel for a batch of them, with a thread for each robot.

XLA:GPU runs a step of a walk as some thirty kernels, one after the other, that hand their values on through memory: the
launches and the memory set the pace, not the arithmetic. But a robot needs nothing of the others. Written out element
by element, with the loop over time inside, its whole walk is a single kernel whose values stay in registers.

The kernel is compiled by way of Pallas and Triton. It is for values: it has no derivatives.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental import pallas
from jax.experimental.pallas import triton

from mjx_climb.compilation.element_operations import Operations, for_each_robot
from mjx_climb.compilation.elements import Element, Elements, as_array, flat
from mjx_climb.compilation.unsupported import Unsupported

_Result = TypeVar("_Result")
_THREADS = 128  # in a block, a robot for each
_WARP = 32  # threads
_BITS = 16  # of a whole number that travel as one real number, exactly in each precision


def over_robots(
    function: Callable[..., _Result], batched: Sequence[Any], *, interpret: bool = False
) -> Callable[..., _Result]:
    """Return the function mapped over the first axis of its arguments, like `jax.vmap`, as one kernel.

    Arguments:
        function: of trees of numbers, the real ones of one precision: operations that `element_operations` and
            `element_rules` know, on fixed shapes, with loops of a fixed number of steps.
        batched: for each argument a tree of bool: whether an array has the batch axis.
        interpret: without Triton, on any device, slowly: for tests.

    Returns:
        A function of arguments with a batch axis, of any length, where `batched` says so. All results have it. It
        raises `Unsupported` while it is traced where the function holds what a kernel cannot do.
    """
    axes = [int(has_axis) for has_axis in jax.tree.leaves(tuple(batched))]

    def mapped(*arguments: Any) -> _Result:
        values, tree = jax.tree.flatten(arguments)
        one = [jax.ShapeDtypeStruct(value.shape[axis:], value.dtype) for value, axis in zip(values, axes, strict=True)]
        program, shape = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(tree, one))
        outputs = program.out_avals
        dtype = _precision([*one, *outputs])

        def walk(own: Iterator[Array], common: Iterator[Array]) -> list[Element]:
            given = [_unpacked(own if axis else common, leaf) for leaf, axis in zip(one, axes, strict=True)]
            results = Operations().closed(program, given)
            return [row for array, leaf in zip(results, outputs, strict=True) for row in _packed_elements(array, leaf)]

        robots = next(len(value) for value, axis in zip(values, axes, strict=True) if axis)
        rows = [
            _packed(v.reshape(robots, leaf.size).T, dtype)
            for v, leaf, axis in zip(values, one, axes, strict=True)
            if axis
        ]
        no_ref_is_empty = jnp.zeros(1, dtype)
        same = [
            _packed(v.reshape(leaf.size, 1), dtype)[:, 0]
            for v, leaf, axis in zip(values, one, axes, strict=True)
            if not axis
        ]
        sizes = [output.size * _parts_of(output) for output in outputs]
        made = _launch(
            walk, jnp.concatenate(rows), jnp.concatenate([*same, no_ref_is_empty]), sum(sizes), interpret=interpret
        )
        parts = jnp.split(made, np.cumsum(sizes)[:-1])
        results = [
            _whole(part, output).T.reshape(robots, *output.shape) for part, output in zip(parts, outputs, strict=True)
        ]
        result: _Result = jax.tree.unflatten(jax.tree.structure(shape), results)
        return result

    return mapped


def _launch(
    walk: Callable[[Iterator[Array], Iterator[Array]], list[Element]],
    own: Array,
    common: Array,
    rows: int,
    *,
    interpret: bool,
) -> Array:
    """Return the elements (rows, robots) that `walk` makes of each robot's `own` numbers and of the `common` ones."""
    count, robots = own.shape
    blocks = -(-robots // _THREADS)
    own = jnp.pad(own, ((0, 0), (0, blocks * _THREADS - robots)), mode="edge")

    # Rows are read and written by a single instruction each, in loops: Triton's compile time for every one is quadratic
    # in the length of all that depends on it, which is everything.
    def kernel(own_ref: Any, common_ref: Any, result_ref: Any) -> None:
        def load(row: Array, found: tuple[Array, ...]) -> tuple[Array, ...]:
            value = own_ref[row, :]
            return tuple(jnp.where(row == k, value, before) for k, before in enumerate(found))

        def store(row: Array, _: None) -> None:
            result_ref[row, :] = functools.reduce(lambda a, k: jnp.where(row == k, results[k], a), range(rows), zero)

        zero = jnp.zeros(_THREADS, own.dtype)
        found = lax.fori_loop(0, count, load, (zero,) * count)
        elements = walk(iter(found), (common_ref[k] for k in range(common.size)))
        results = [for_each_robot(element, own.dtype, (_THREADS,)) for element in elements]
        lax.fori_loop(0, rows, store, None)

    call = pallas.pallas_call(
        kernel,
        grid=(blocks,),
        in_specs=[
            pallas.BlockSpec((count, _THREADS), lambda block: (0, block)),
            pallas.BlockSpec(common.shape, lambda block: (0,)),
        ],
        out_specs=pallas.BlockSpec((rows, _THREADS), lambda block: (0, block)),
        out_shape=jax.ShapeDtypeStruct((rows, blocks * _THREADS), own.dtype),
        compiler_params=None if interpret else triton.CompilerParams(num_warps=_THREADS // _WARP, num_stages=1),
        interpret=interpret,
        name="walk",
    )
    result: Array = call(own, common)
    return result[:, :robots]


# What a kernel reads and writes is of one precision: whole numbers travel as parts of 16 bits.


def _precision(leaves: Sequence[Any]) -> Any:
    found = {np.dtype(leaf.dtype) for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)}
    others = [leaf.dtype for leaf in leaves if not _is_plain(leaf.dtype)]
    if others or len(found) > 1:
        raise Unsupported(f"a function of and to {', '.join(sorted(map(str, [*found, *others])))}")
    return found.pop() if found else jnp.result_type(float)


def _is_plain(dtype: Any) -> bool:
    return any(jnp.issubdtype(dtype, kind) for kind in (jnp.floating, jnp.integer, jnp.bool_))


def _parts_of(leaf: Any) -> int:
    """Return how many real numbers each number of an array travels as."""
    return max(1, 8 * np.dtype(leaf.dtype).itemsize // _BITS) if jnp.issubdtype(leaf.dtype, jnp.integer) else 1


def _packed(value: Array, dtype: Any) -> Array:
    """Return numbers (n, robots) as real ones (n parts, robots)."""
    if not jnp.issubdtype(value.dtype, jnp.integer):
        return jnp.asarray(value).astype(dtype)
    parts = [_bits(jnp.asarray(value), part) for part in range(_parts_of(value))]
    return jnp.stack(parts, 1).reshape(-1, value.shape[-1]).astype(dtype)


def _bits(value: Array, part: int) -> Array:
    shifted = lax.shift_right_logical(value, jnp.asarray(_BITS * part, value.dtype))
    return shifted & jnp.asarray(min(2**_BITS - 1, jnp.iinfo(value.dtype).max), value.dtype)


def _whole(parts: Array, leaf: Any) -> Array:
    """Return numbers (n, robots) from real ones (n parts, robots)."""
    if not jnp.issubdtype(leaf.dtype, jnp.integer):
        return parts.astype(leaf.dtype)
    each = parts.reshape(-1, _parts_of(leaf), parts.shape[-1])
    return functools.reduce(lax.bitwise_or, (_shifted(each[:, k], k, leaf.dtype) for k in range(each.shape[1])))


def _shifted(part: Array, number: int, dtype: Any) -> Array:
    wide = part.astype(jnp.int32).astype(dtype)
    return lax.shift_left(wide, jnp.asarray(_BITS * number, dtype))


def _unpacked(read: Iterator[Array], leaf: Any) -> Elements:
    """Return the elements of an argument from the numbers that a kernel reads, in their order."""

    def element() -> Element:
        parts = list(itertools.islice(read, _parts_of(leaf)))
        if not jnp.issubdtype(leaf.dtype, jnp.integer):
            return parts[0].astype(leaf.dtype)
        return functools.reduce(lax.bitwise_or, (_shifted(part, k, leaf.dtype) for k, part in enumerate(parts)))

    return as_array((element() for _ in range(leaf.size)), leaf.shape)


def _packed_elements(results: Elements, leaf: Any) -> list[Element]:
    """Return the numbers that a kernel writes for a result."""
    elements = [cast(Array, element) for element in flat([results])]
    if not jnp.issubdtype(leaf.dtype, jnp.integer):
        return list(elements)
    return [_bits(jnp.asarray(element), part) for element in elements for part in range(_parts_of(leaf))]
