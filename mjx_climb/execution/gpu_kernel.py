"""A function of one robot as one GPU kernel for a batch of them, with a thread for each robot, or for each limb.

XLA:GPU runs a step of a walk as some thirty kernels, one after the other, that hand their values on through memory: the
launches and the memory set the pace, not the arithmetic. But a robot needs nothing of the others. Written out element
by element, with the loop over time inside, its whole walk is a single kernel whose values stay in registers. And most
of a step is the same for each limb: with a thread for each of them it is written once, so that the code fits the
instruction cache, and sums over the limbs are exchanges within a warp.

The kernel is written in CUDA C (`cuda_writer`), compiled by NVRTC, a library that every installation of JAX for
NVIDIA's GPUs brings, and launched by the custom call
`__gpu$xla.gpu.ptx` of XLA's. Tangents are asked for beforehand (`tangents_over_robots`): each direction has
threads of its own, which work out the values beside it.
"""

import ctypes
import functools
import importlib.metadata
import importlib.util
import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from mjx_climb.execution.cuda_writer import NAME, THREADS, CudaWriter
from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.element_rules import results
from mjx_climb.execution.elements import Elements, Shared, Unsupported, Writer, as_array
from mjx_climb.execution.flat import flat
from mjx_climb.execution.limbs import LimbAxes
from mjx_climb.execution.tangents import tangents_of

_Result = TypeVar("_Result")
_TARGET = "__gpu$xla.gpu.ptx"


class Body(NamedTuple):
    """What is written of one robot: `results` are the elements of the outputs, made of the elements of the inputs."""

    inputs: Sequence[Any]  # with shape and dtype
    outputs: Sequence[Any]
    limbs: int  # threads of a robot
    results: Callable[[Writer, list[Elements]], list[list[Shared]]]


def over_robots(function: Callable[..., _Result], batched: Sequence[bool]) -> Callable[..., _Result]:
    """Return the function mapped over the first axis of its arguments, like `jax.vmap`, as one kernel.

    Arguments:
        function: of trees of numbers in single precision, whole numbers and truth values: operations that
            `element_rules` knows, on fixed shapes, with loops of a fixed number of steps.
        batched: whether an array has the batch axis, for each leaf of the arguments.

    Returns:
        A function of arguments with a batch axis, of any length, where `batched` says so. All results have it. It
        raises `Unsupported` while it is traced where the function holds what a kernel cannot do.
    """

    def mapped(*arguments: Any) -> _Result:
        program, shape = _of_one(function, arguments, batched)
        results: _Result = jax.tree.unflatten(shape, _launched(body_of(program), jax.tree.leaves(arguments), batched))
        return results

    return mapped


def tangents_over_robots(
    function: Callable[..., _Result], batched: Sequence[bool]
) -> Callable[..., tuple[_Result, Any]]:
    """Return the function with its tangents, like `jax.jvp` by its first argument, along several directions.

    Arguments:
        function, batched: as `over_robots` takes them; the first argument has real numbers alone, each with
            the batch axis.

    Returns:
        A function of directions and arguments: for each array (B, ...) of the first argument one (B, k, ...). It
        returns the results, and in place of each its tangents (B, k, ...), None where it is no real number.
    """

    def mapped(directions: Any, *arguments: Any) -> tuple[_Result, Any]:
        program, shape = _of_one(function, arguments, batched)
        along = [jnp.asarray(direction) for direction in jax.tree.leaves(directions)]
        robots, count = along[0].shape[:2]
        # every direction has threads of its own, and values for itself
        values = [
            jnp.repeat(jnp.asarray(value), count, 0) if own else value
            for value, own in zip(jax.tree.leaves(arguments), batched, strict=True)
        ]
        both, moved = tangents_of(program, [place < len(along) for place in range(len(values))])
        along = [direction.reshape(robots * count, *direction.shape[2:]) for direction in along]
        found = _launched(body_of(both), [*values, *along], [*batched, *[True] * len(along)])
        every = [array.reshape(robots, count, *array.shape[1:]) for array in found]
        results: _Result = jax.tree.unflatten(shape, [array[:, 0] for array in every[: len(moved)]])
        of_moving = iter(every[len(moved) :])
        tangents = [
            next(of_moving) if moves else jnp.zeros_like(array) if jnp.issubdtype(array.dtype, jnp.floating) else None
            for array, moves in zip(every, moved, strict=False)
        ]
        return results, jax.tree.unflatten(shape, tangents)

    return mapped


def _of_one(
    function: Callable[..., Any], arguments: Sequence[Any], batched: Sequence[bool]
) -> tuple[core.ClosedJaxpr, Any]:
    """Return a function of one robot, traced, and the tree of its results."""
    values, tree = jax.tree.flatten(tuple(arguments))
    one = [jax.ShapeDtypeStruct(value.shape[own:], value.dtype) for value, own in zip(values, batched, strict=True)]
    program, shape = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(tree, one))
    return program, jax.tree.structure(shape)


def body_of(program: core.ClosedJaxpr) -> Body:
    """Return what is written of a program of one robot."""
    whole = flat(program)
    limbs = LimbAxes(whole)

    def numbers(writer: Writer, given: list[Elements]) -> list[list[Shared]]:
        """Return the elements of each result, the same for all lanes and of its type."""
        do = Operations(writer, limbs)
        found = zip(results(do, whole, given), whole.out_avals, strict=True)
        return [do.put_together(array, aval.dtype, None) for array, aval in found]

    return Body(program.in_avals, program.out_avals, limbs.count, numbers)


def written(body: Body, batched: Sequence[bool]) -> str:
    """Return the kernel of a body, whose `batched` inputs are the robot's own, in CUDA C."""
    writer = CudaWriter(body.limbs)
    given = []
    for leaf, axis in zip(body.inputs, batched, strict=True):
        of = "own" if axis else "common"
        given.append(as_array((writer.read(of, leaf.dtype) for _ in range(math.prod(leaf.shape))), leaf.shape))
    return writer.source([number for result in body.results(writer, given) for number in result])


def _launched(body: Body, arrays: Sequence[Any], batched: Sequence[bool]) -> list[Array]:
    robots = next(len(array) for array, own in zip(arrays, batched, strict=True) if own)
    sizes = [math.prod(leaf.shape) for leaf in body.outputs]
    words = [_words(jnp.asarray(array)) for array in arrays]
    own = [array.reshape(robots, -1).T for array, axis in zip(words, batched, strict=True) if axis]
    common = [array.reshape(-1) for array, axis in zip(words, batched, strict=True) if not axis]
    source = ptx(written(body, batched), _capability())
    threads = robots * CudaWriter(body.limbs).width
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
        for part, leaf in zip(parts, body.outputs, strict=True)
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


# --- compilation

# Multiplications and additions in one, numbers below 1e-38 as zero, and divisions and roots to two units in the last
# place: what single precision is good for is lost in none of them.
OPTIONS = ("--fmad=true", "--ftz=true", "--prec-div=false", "--prec-sqrt=false", "--std=c++17")


@functools.lru_cache(maxsize=32)
def ptx(source: str, capability: str) -> str:
    """Return a kernel in PTX.

    Raises:
        Unsupported: no NVRTC, or it does not compile this.
    """
    library = _library()
    program = ctypes.c_void_p()
    _call(library.nvrtcCreateProgram, ctypes.byref(program), source.encode(), b"walk.cu", 0, None, None)
    try:
        options = [f"--gpu-architecture=compute_{capability.replace('.', '')}", *OPTIONS]
        array = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        if library.nvrtcCompileProgram(program, len(options), array):
            log = _filled(library.nvrtcGetProgramLogSize, library.nvrtcGetProgramLog, program)
            wrong = next((line for line in log.splitlines() if "error" in line), log)
            raise Unsupported(f"what NVRTC does not compile: {wrong.strip()[:200]}")
        return _filled(library.nvrtcGetPTXSize, library.nvrtcGetPTX, program)
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


def _filled(size_of: Any, get: Any, program: ctypes.c_void_p) -> str:
    size = ctypes.c_size_t()
    _call(size_of, program, ctypes.byref(size))
    text = ctypes.create_string_buffer(size.value)
    _call(get, program, text)
    return text.value.decode()


def _call(function: Any, *arguments: object) -> None:
    if error := function(*arguments):
        raise Unsupported(f"what NVRTC does not do: error {error} of {function.__name__}")


@functools.cache
def _library() -> ctypes.CDLL:
    for place in _places():
        try:
            return ctypes.CDLL(place)
        except OSError:
            continue
    raise Unsupported("anything without NVRTC (libnvrtc.so; pip install 'jax[cuda13]' brings it)")


def _places() -> list[str]:
    """Return where the library may be: of the CUDA that JAX's plugin is made for, then of any."""
    plugins = {package.name for package in importlib.metadata.distributions()}
    found = []
    for major in sorted(("13", "12"), key=lambda major: f"jax-cuda{major}-plugin" not in plugins):
        name = f"libnvrtc.so.{major}"
        spec = importlib.util.find_spec("nvidia")
        for folder in () if spec is None else spec.submodule_search_locations or ():
            for inside in (f"cu{major}/lib", "cuda_nvrtc/lib"):
                found.append(str(Path(folder) / inside / name))
        found.append(name)
    return found
