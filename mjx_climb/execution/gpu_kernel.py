"""A function of one robot as one GPU kernel for a batch of them, with a thread for each limb.

The kernel is written in CUDA C (`cuda_writer`), compiled by NVRTC, a library that every installation of JAX for
NVIDIA's GPUs brings, and launched by a custom call of XLA's. Tangents are asked for beforehand: each direction has
threads of its own, which compute the values beside it.
"""

import contextlib
import ctypes
import functools
import importlib.metadata
import importlib.util
import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from mjx_climb.execution.adjoint import with_gradients
from mjx_climb.execution.cuda_writer import NAME, READ, SIDE_BY_SIDE, THREADS, CudaWriter
from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.element_rules import results
from mjx_climb.execution.elements import Elements, Shared, Unsupported, Writer, as_array
from mjx_climb.execution.flat import flat, tangents_of
from mjx_climb.execution.jax_internals import launched
from mjx_climb.execution.jax_types import Function, PyTree
from mjx_climb.execution.limbs import LimbAxes

_Result = TypeVar("_Result")


class Body(NamedTuple):
    """The kernel's text for one robot."""

    program: core.ClosedJaxpr  # flat
    limbs: LimbAxes

    def results(self, writer: Writer, given: list[Elements]) -> list[list[Shared]]:
        """Return the elements of each result, the same for all lanes and of its type."""
        found = results(do := Operations(writer, self.limbs), self.program, given)
        each = zip(found, self.program.out_avals, strict=True)
        return [do.put_together(array, aval.dtype, None) for array, aval in each]


def over_robots(function: Callable[..., _Result], batched: Sequence[bool]) -> Callable[..., _Result]:
    """Return the function mapped over the first axis of its arguments, like `jax.vmap`, as one kernel.

    Arguments:
        function: of trees of numbers in single precision, whole numbers and truth values: operations that
            `element_rules` knows, on fixed shapes, with loops of a fixed number of steps.
        batched: whether an array has the batch axis, for each leaf of the arguments.

    Returns:
        A function of arguments with a batch axis, of any length, where `batched` says so. All results have it. It
        raises `Unsupported` while it is traced where the function holds an operation without a rule.
    """

    def mapped(*arguments: PyTree) -> _Result:
        program, shape = _of_one(function, arguments, batched)
        results: _Result = jax.tree.unflatten(shape, by_kernel(body_of(program), jax.tree.leaves(arguments), batched))
        return results

    return mapped


def tangents_over_robots(
    function: Callable[..., _Result], batched: Sequence[bool]
) -> Callable[..., tuple[_Result, PyTree]]:
    """Return the function with its tangents, like `jax.jvp` by its first argument, along several directions.

    Arguments:
        function, batched: as `over_robots` takes them; the first argument has real numbers alone.

    Returns:
        A function of directions and arguments: of each robot's first argument its k directions (B, k, ...). It returns
        the results, and in place of each its tangents (B, k, ...), None where it is no real number.
    """

    def mapped(directions: PyTree, *arguments: PyTree) -> tuple[_Result, PyTree]:
        program, shape = _of_one(function, arguments, batched)
        along = jax.tree.leaves(directions)
        both, moved = _moved(program, len(along))
        found = by_kernel(body_of(both), [*jax.tree.leaves(arguments), *along], [*batched, *[2] * len(along)])
        results: _Result = jax.tree.unflatten(shape, [array[:, 0] for array in found[: len(moved)]])
        of_moving = iter(found[len(moved) :])
        tangents = [
            next(of_moving) if moves else jnp.zeros_like(array) if jnp.issubdtype(array.dtype, jnp.floating) else None
            for array, moves in zip(found, moved, strict=False)
        ]
        return results, jax.tree.unflatten(shape, tangents)

    return mapped


def gradients_over_robots(
    function: Callable[..., dict[str, Array]], batched: Sequence[bool]
) -> Callable[..., tuple[dict[str, Array], PyTree]]:
    """Return the function with gradients of several weighted sums of its results, by its first argument.

    Arguments:
        function, batched: as `over_robots` takes them; the first argument has real numbers alone.

    Returns:
        A function of weights and arguments: the weights (B, k) by the names of results that are real numbers, (). It
        returns the results, and gradients (B, k, ...) in a tree like the first argument.
    """

    def mapped(weights: dict[str, Array], *arguments: PyTree) -> tuple[dict[str, Array], PyTree]:
        program, tree = _of_one(function, arguments, batched)
        moving, along = jax.tree.flatten(arguments[0])
        names = jax.tree.unflatten(tree, range(tree.num_leaves))
        weighed = tuple(place in {names[name] for name in weights} for place in range(tree.num_leaves))
        moves = tuple(place < len(moving) for place in range(len(program.in_avals)))
        both = with_gradients(program, moves, weighed, values=True)
        given = [*jax.tree.leaves(arguments), *(weights[name] for name in sorted(weights))]
        found = by_kernel(body_of(both), given, [*batched, *[2] * len(weights)])
        results: dict[str, Array] = jax.tree.unflatten(tree, [array[:, 0] for array in found[: tree.num_leaves]])
        return results, jax.tree.unflatten(along, found[tree.num_leaves :])

    return mapped


def _of_one(
    function: Function, arguments: Sequence[PyTree], batched: Sequence[bool]
) -> tuple[core.ClosedJaxpr, jax.tree_util.PyTreeDef]:
    """Return a function of one robot, traced, and the tree of its results."""
    values, tree = jax.tree.flatten(tuple(arguments))
    one = [jax.ShapeDtypeStruct(value.shape[own:], value.dtype) for value, own in zip(values, batched, strict=True)]
    program, shape = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(tree, one))
    return program, jax.tree.structure(shape)


# Texts of programs are kept: batches of other sizes have the same, and one takes seconds.
_KEPT = 8  # programs


@functools.lru_cache(_KEPT)
def _moved(program: core.ClosedJaxpr, moving: int) -> tuple[core.ClosedJaxpr, tuple[bool, ...]]:
    """Return a program with tangents by its first inputs, so many, and which of its results have some."""
    both, moved = tangents_of(program, [place < moving for place in range(len(program.in_avals))])
    return both, tuple(moved)


@functools.lru_cache(_KEPT)
def body_of(program: core.ClosedJaxpr) -> Body:
    """Return the body of the kernel of a program of one robot."""
    whole = flat(program)
    return Body(whole, LimbAxes(whole))


class Kernel(NamedTuple):
    """A kernel in CUDA C, and how many words its loops write of each thread."""

    text: str
    kept: int
    threads: int  # of a walk

    def blocks(self, walks: int) -> int:
        """Return how many blocks of threads it takes."""
        return -(-walks * self.threads // THREADS)

    def words(self, rows: int, walks: int) -> int:
        """Return how many words it writes: rows of results, and behind them those of its loops."""
        return _rounded(rows * walks) + self.kept * self.blocks(walks) * THREADS


def side_by_side(rows: Array) -> Array:
    """Return words (n, rows) of robots or walks as a kernel reads them (groups, rows, `SIDE_BY_SIDE`)."""
    count, size = rows.shape
    whole = jnp.pad(rows, ((0, _rounded(count) - count), (0, 0)))
    return whole.reshape(-1, SIDE_BY_SIDE, size).swapaxes(1, 2)


def _rounded(count: int) -> int:
    return -(-count // SIDE_BY_SIDE) * SIDE_BY_SIDE


@functools.lru_cache(_KEPT)
def written(body: Body, axes: tuple[int, ...]) -> Kernel:
    """Return the kernel of a body; `axes` as of `by_kernel`."""
    writer, given = CudaWriter(body.limbs.count), []
    for aval, count in zip(body.program.in_avals, axes, strict=True):
        given.append(as_array((writer.read(READ[count], aval.dtype) for _ in range(aval.size)), aval.shape))
    text = writer.source([number for result in body.results(writer, given) for number in result])
    return Kernel(text, writer.kept, writer.width)


def by_kernel(body: Body, arrays: Sequence[Array], axes: Sequence[int]) -> list[Array]:
    """Return the results of a body, with all batch axes that there are.

    Arguments:
        axes: how many batch axes each array has: none, the robots, or these and the directions of each.
    """
    arrays = [*map(jnp.asarray, arrays)]
    batch = next(array.shape[:count] for array, count in zip(arrays, axes, strict=True) if count == max(axes))
    words: list[list[Array]] = [[jnp.array([*batch, 1][:2], np.int32)[None]], [], []]
    for array, count in zip(arrays, axes, strict=True):
        if array.dtype.kind != "b" and (array.dtype.itemsize != 4 or array.dtype.kind not in "fiu"):
            raise Unsupported(f"a function of {array.dtype}")
        whole = array.astype(np.int32) if array.dtype.kind == "b" else lax.bitcast_convert_type(array, np.int32)
        words[count].append(whole.reshape(math.prod(batch[:count]), -1))
    kernel = written(body, tuple(axes))
    source, walks, outputs = ptx(kernel.text), math.prod(batch), body.program.out_avals
    rows = sum(aval.size for aval in outputs)
    # in two axes: there may be more words than 32 bits count
    shape = jax.ShapeDtypeStruct((kernel.words(rows, walks) // SIDE_BY_SIDE, SIDE_BY_SIDE), np.int32)
    common, *others = (jnp.concatenate(each, 1) for each in words if each)
    given = [common[0], *map(side_by_side, others)]
    made = launched(source, NAME, kernel.blocks(walks), THREADS, shape, *given)
    made = made[: _rounded(rows * walks) // SIDE_BY_SIDE].reshape(-1)[: rows * walks].reshape(rows, walks)
    parts, found = jnp.split(made, list(itertools.accumulate(aval.size for aval in outputs))[:-1]), []
    for part, aval in zip(parts, outputs, strict=True):
        if aval.dtype.kind != "b" and aval.dtype.itemsize != 4:
            raise Unsupported(f"a function to {aval.dtype}")
        values = part != 0 if aval.dtype.kind == "b" else lax.bitcast_convert_type(part, aval.dtype)
        found.append(values.T.reshape(*batch, *aval.shape))
    return found


# --- compilation

# Multiplications and additions in one, numbers below 1e-38 as zero, and divisions and roots to two units in the last
# place: none of them loses digits of single precision.
OPTIONS = ("--fmad=true", "--ftz=true", "--prec-div=false", "--prec-sqrt=false", "--std=c++17")


@functools.lru_cache(_KEPT)
def ptx(source: str) -> str:
    """Return a kernel in PTX, for the first GPU.

    Raises:
        Unsupported: no NVRTC, or it does not compile this.
    """
    library, program = _library(), ctypes.c_void_p()

    def call(name: str, *arguments: object) -> None:
        if error := library[f"nvrtc{name}"](*arguments):
            raise Unsupported(f"what NVRTC does not do: error {error} of nvrtc{name}")

    def filled(name: str) -> str:
        size = ctypes.c_size_t()
        call(f"Get{name}Size", program, ctypes.byref(size))
        text = ctypes.create_string_buffer(size.value)
        call(f"Get{name}", program, text)
        return text.value.decode()

    [device, *_] = jax.local_devices(backend="gpu")
    architecture = f"--gpu-architecture=compute_{str(device.compute_capability).replace('.', '')}"
    call("CreateProgram", ctypes.byref(program), source.encode(), b"walk.cu", 0, None, None)
    try:
        options = [option.encode() for option in (architecture, *OPTIONS)]
        if library.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options)):
            log = filled("ProgramLog")
            wrong = next((line for line in log.splitlines() if "error" in line), log)
            raise Unsupported(f"what NVRTC does not compile: {wrong.strip()[:200]}")
        return filled("PTX")
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


@functools.cache
def _library() -> ctypes.CDLL:
    """Return NVRTC: of the CUDA that JAX's plugin is made for, else of any."""
    plugins = {package.name for package in importlib.metadata.distributions()}
    spec = importlib.util.find_spec("nvidia")
    for major in sorted(("13", "12"), key=lambda major: f"jax-cuda{major}-plugin" not in plugins):
        folders = () if spec is None else spec.submodule_search_locations or ()
        places = [Path(folder) / inside for folder in folders for inside in (f"cu{major}/lib", "cuda_nvrtc/lib")]
        for place in (*places, Path()):
            with contextlib.suppress(OSError):
                return ctypes.CDLL(str(place / f"libnvrtc.so.{major}"))
    raise Unsupported("anything without NVRTC (libnvrtc.so; pip install 'jax[cuda13]' brings it)")
