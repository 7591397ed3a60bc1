"""A function of one robot as one GPU kernel for a batch of them, with a thread for each robot, or for each limb.

XLA:GPU runs a step of a walk as some thirty kernels, one after the other, that hand their values on through memory: the
launches and the memory set the pace, not the arithmetic. But a robot needs nothing of the others. Written out element
by element, with the loop over time inside, its whole walk is a single kernel whose values stay in registers. And most
of a step is the same for each limb: with a thread for each of them it is written once, so that the code fits the
instruction cache, and sums over the limbs are exchanges within a warp.

The kernel is written in CUDA C (`cuda_writer`), compiled by NVRTC (`nvrtc`), and launched by the custom call
`__gpu$xla.gpu.ptx` of XLA's. It is for values: it has no derivatives.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from mjx_climb.compilation import nvrtc
from mjx_climb.compilation.cuda_writer import NAME, THREADS, CudaWriter
from mjx_climb.compilation.element_operations import Operations
from mjx_climb.compilation.elements import Element, Elements, Number, as_array, flat
from mjx_climb.compilation.interpreted import Interpreted
from mjx_climb.compilation.unsupported import Unsupported
from mjx_climb.compilation.writer import Writer

_Result = TypeVar("_Result")
_TARGET = "__gpu$xla.gpu.ptx"


def over_robots(
    function: Callable[..., _Result], batched: Sequence[Any], *, limbs: int = 1, interpret: bool = False
) -> Callable[..., _Result]:
    """Return the function mapped over the first axis of its arguments, like `jax.vmap`, as one kernel.

    Arguments:
        function: of trees of numbers in single precision, whole numbers and truth values: operations that
            `element_operations` and `element_rules` know, on fixed shapes, with loops of a fixed number of steps.
        batched: for each argument a tree of bool: whether an array has the batch axis.
        limbs: threads of a robot, best as many as arrays that loops carry have along the axis before their last.
        interpret: by XLA's own operations, on any device and in any precision: for tests.

    Returns:
        A function of arguments with a batch axis, of any length, where `batched` says so. All results have it. It
        raises `Unsupported` while it is traced where the function holds what a kernel cannot do.
    """
    axes = [int(has_axis) for has_axis in jax.tree.leaves(tuple(batched))]

    def mapped(*arguments: Any) -> _Result:
        values, tree = jax.tree.flatten(arguments)
        one = [jax.ShapeDtypeStruct(value.shape[axis:], value.dtype) for value, axis in zip(values, axes, strict=True)]
        program, shape = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(tree, one))
        arrays = [jnp.asarray(value) for value in values]
        robots = next(len(value) for value, axis in zip(values, axes, strict=True) if axis)
        walk = _interpreted if interpret else _launched
        results = walk(program, limbs, robots, arrays, axes)
        result: _Result = jax.tree.unflatten(jax.tree.structure(shape), results)
        return result

    return mapped


def written(program: core.ClosedJaxpr, limbs: int, axes: Sequence[int]) -> str:
    """Return the kernel of a function of one robot, whose arguments with a 1 in `axes` are its own, in CUDA C."""
    writer = CudaWriter(limbs)
    given = []
    for leaf, axis in zip(program.in_avals, axes, strict=True):
        of = "own" if axis else "common"
        given.append(as_array((writer.read(of, leaf.dtype) for _ in range(math.prod(leaf.shape))), leaf.shape))
    return writer.source([number for result in _results(writer, program, given) for number in result])


def _results(writer: Writer, program: core.ClosedJaxpr, given: list[Elements]) -> list[list[Number]]:
    """Return the elements of each result, the same for all lanes and of its type."""
    do = Operations(writer)
    found = []
    for array, leaf in zip(do.closed(program, given), program.out_avals, strict=True):
        found.append([do.typed(do.same_for_all(_number(element)), leaf.dtype) for element in flat([array])])
    return found


def _number(element: Element) -> Number:
    assert isinstance(element, Number)
    return element


def _interpreted(
    program: core.ClosedJaxpr, limbs: int, robots: int, arrays: Sequence[Array], axes: Sequence[int]
) -> list[Array]:
    writer = Interpreted(limbs, robots)
    given = []
    for array, leaf, axis in zip(arrays, program.in_avals, axes, strict=True):
        rows = array.reshape(robots, -1).T if axis else array.reshape(-1, 1)
        given.append(as_array((writer.value(row[None]) for row in rows), leaf.shape))
    made = []
    for numbers, leaf in zip(_results(writer, program, given), program.out_avals, strict=True):
        columns = [writer.rows(number)[0] for number in numbers]
        made.append(jnp.stack(columns, 1).reshape(robots, *leaf.shape))
    return made


def _launched(
    program: core.ClosedJaxpr, limbs: int, robots: int, arrays: Sequence[Array], axes: Sequence[int]
) -> list[Array]:
    sizes = [math.prod(leaf.shape) for leaf in program.out_avals]
    own = [_words(array).reshape(robots, -1).T for array, axis in zip(arrays, axes, strict=True) if axis]
    common = [_words(array).reshape(-1) for array, axis in zip(arrays, axes, strict=True) if not axis]
    source = nvrtc.ptx(written(program, limbs, axes), _capability())
    threads = robots * CudaWriter(limbs).width
    launch = {"grid_x": -(-threads // THREADS), "block_x": THREADS, "shared_mem_bytes": 0}
    launch |= dict.fromkeys(("grid_y", "grid_z", "block_y", "block_z"), 1)
    made = jax.ffi.ffi_call(_TARGET, jax.ShapeDtypeStruct((sum(sizes), robots), np.int32))(
        jnp.concatenate(own),
        jnp.concatenate([jnp.full(1, robots, np.int32), *common]),
        name=NAME,
        kernel_type="ptx",
        kernel_data=source,
        **{name: np.int32(number) for name, number in launch.items()},
    )
    parts = jnp.split(made, list(itertools.accumulate(sizes))[:-1])
    return [
        _from_words(part, leaf.dtype).T.reshape(robots, *leaf.shape)
        for part, leaf in zip(parts, program.out_avals, strict=True)
    ]


def _capability() -> str:
    [device, *_] = jax.local_devices(backend="gpu")
    return str(device.compute_capability)


def _words(value: Array) -> Array:
    """Return numbers as words of 32 bits, whole numbers of fewer bits and truth values as such ones."""
    if value.dtype == np.float32 or (value.dtype.itemsize == 4 and jnp.issubdtype(value.dtype, jnp.integer)):
        return lax.bitcast_convert_type(value, np.int32)
    if value.dtype.kind == "b":
        return value.astype(np.int32)
    raise Unsupported(f"a function of {value.dtype}")


def _from_words(words: Array, dtype: Any) -> Array:
    if np.dtype(dtype).kind == "b":
        return words != 0
    if np.dtype(dtype).itemsize != 4:
        raise Unsupported(f"a function to {dtype}")
    return lax.bitcast_convert_type(words, dtype)
