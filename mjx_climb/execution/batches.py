"""The door: a function of one robot carried out for a batch, on all devices, by the fastest path.

Three paths lead to the same results: regions (`cpu_regions`) on CPUs, one kernel (`gpu_kernel`) on GPUs, and XLA's own
way of compiling the lifted program. Where the fast path of a device does not work there, or cannot do what a function
asks for, the plain one is taken, and a warning says so once.
"""

import functools
import json
import math
from collections.abc import Callable, Hashable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Sharding
from jax.tree_util import PyTreeDef

from mjx_climb.execution import devices, gpu_kernel, paths
from mjx_climb.execution.cache import (
    cached_jit,
    code_digest,
    enable_cache,
    executable_file,
    read_whole,
    store_whole,
)
from mjx_climb.execution.contents import Unidentifiable, identity
from mjx_climb.execution.jax_types import Function, PyTree
from mjx_climb.execution.one_robot import gradients_over_robots, over_robots
from mjx_climb.execution.paths import first_possible

MOST_GRADIENTS = 2**16  # walks whose gradients one call takes: each keeps some 200 kB on its way back
Progress = Callable[[int, int], None]
_Values = TypeVar("_Values", np.ndarray, Array)
# before the name of a result with a tangent, or of a gain with a gradient
_TANGENT, _GRADIENT = "tangent of ", "gradient by "


class _Call(NamedTuple):
    """The static part of a program: a function of one robot, which arguments have a batch axis, and the way to go."""

    function: Function
    structure: Hashable
    batched: tuple[bool, ...]  # of each leaf of the arguments
    path: str = ""
    derivatives: str = ""  # `_TANGENT` or `_GRADIENT`, which are asked for by the last tree of the arguments


class Robots(NamedTuple):
    """The arguments of a batch of robots."""

    arguments: Sequence[PyTree]  # trees of numpy arrays, whose leading axes broadcast to `shape`
    axes: Sequence[PyTree]  # the same trees; in place of each array the number of axes that the value of one robot has
    shape: tuple[int, ...]  # the batch axes
    # a tree like `arguments[0]` of arrays (*shape, k, ...) of tangents; with axes of 1 for all robots
    directions: PyTree = None
    # weights (*shape, k) by the names of results, of k sums whose gradients by `arguments[0]` are asked for
    weights: PyTree = None


def run(
    function: Callable[..., dict[str, Array]],
    structure: Hashable,
    robots: Robots,
    *,
    batch_size: int | None = None,
    progress: Progress | None = None,
    compile_briefly: bool = False,
    over_time: bool = False,
) -> PyTree:
    """Carry out a function of one robot for a batch of them, on all devices: where there is a GPU, few on the CPU.

    Arguments:
        function: of the structure and the arguments of one robot; of a module, pure. It returns a dict of arrays.
        structure: all that the function depends on beside the arguments; hashable. Executables are found by it, on
            disk too, by its contents.
        robots: their arguments.
        batch_size: at most so many robots in one call of the executable, one call at a time on a GPU and one on each
            core of a CPU.
        progress: called with the number of robots that are done and the number in all, after each call; the last one
            counts once, however often it is repeated.
        compile_briefly: at a low level of optimisation, for large programs that run once.
        over_time: whether the function returns something of each step, which a GPU's kernel cannot.

    Returns:
        The results with the batch axes in front; with `directions` a pair of these and of the tangents (*shape, k, ...)
        of those that are real numbers, with `weights` of these and of the gradients (*shape, k, ...).

    Raises:
        ValueError: a batch size below one.
    """
    arguments, axes, shape, directions, weights = robots
    count = math.prod(shape)
    trees, own = tuple(arguments), tuple(axes)
    asked, derivatives = (weights, _GRADIENT) if directions is None else (directions, _TANGENT)
    derivatives = "" if asked is None else derivatives
    if asked is not None:
        trees, own = (*trees, asked), (*own, jax.tree.map(lambda rate: rate.ndim - len(shape), asked))
    leaves, tree = jax.tree.flatten(trees)
    own_axes = jax.tree.leaves(own)
    leads = [leaf.shape[: leaf.ndim - size] for leaf, size in zip(leaves, own_axes, strict=True)]
    batched = [math.prod(lead) != 1 or (count == 1 and lead != ()) for lead in leads]
    rows_of = {lead: _rows_of(lead, shape) for lead in dict.fromkeys(leads)}
    tables = [v.reshape(math.prod(lead), *v.shape[len(lead) :]) for v, lead in zip(leaves, leads, strict=True)]
    varying = [(table, rows_of[lead]) for table, lead, own in zip(tables, leads, batched, strict=True) if own]
    walked = _without_fill(varying, count)
    if not varying:  # a batch of equal robots: one leaf says how many
        batched[0], varying = True, [(tables[0], rows_of[leads[0]])]

    number = 0 if asked is None else jax.tree.leaves(asked)[0].shape[len(shape)]
    double = any(table.dtype == np.float64 for table in tables)
    kernel = not (double or over_time)  # in double precision its values do not find room in the registers
    tangents = number * paths.AN_ADJOINT if derivatives == _GRADIENT else number
    on = paths.device_for(count, tangents, kernel=kernel)
    call = _Call(function, structure, tuple(batched), derivatives=derivatives)
    enable_cache()

    same = [table[0] for table, own in zip(tables, batched, strict=True) if not own]
    known = tuple((leaf.dtype.str, leaf.shape, leaf.tobytes()) for leaf in same)

    def by(path: str) -> dict[str, np.ndarray]:
        share = devices.share_size(count, batch_size, on, in_regions=path == "regions" and not derivatives)
        if derivatives == _GRADIENT:
            share = min(share, max(1, MOST_GRADIENTS // number))
        program = _program(path, on, compile_briefly)

        def of_rows(rows: np.ndarray, sharding: Sharding) -> dict[str, Array]:
            with devices.on_host(), jax.enable_x64(double):  # holds for one thread
                # each robot's values are taken here, where devices work side by side
                each = jax.device_put([table.take(place[rows], 0) for table, place in varying], sharding)
                by_kind = {True: iter(each), False: iter(_same_for_all(known, sharding))}
                leaves = [next(by_kind[own]) for own in batched]
                return program(call._replace(path=path), *jax.tree.unflatten(tree, leaves))

        return devices.in_smaller_shares(lambda share: devices.spread(of_rows, walked, share, progress, on), share)

    found = first_possible(by, paths.path_for(on, kernel=kernel), (call, tree))
    if walked < count:
        found = {name: value[np.minimum(np.arange(count), walked - 1)] for name, value in found.items()}
    found = {name: value.reshape((*shape, *value.shape[1:])) for name, value in found.items()}
    if not derivatives:
        return found
    values = {name: value for name, value in found.items() if not name.startswith(derivatives)}
    return values, {n.removeprefix(derivatives): value for n, value in found.items() if n.startswith(derivatives)}


def _without_fill(varying: Sequence[tuple[np.ndarray, np.ndarray]], count: int) -> int:
    """Return how many robots of a batch there are before the last one is repeated, as where it fills up a batch.

    Of equal robots, with which speed is measured, all. `varying` are values, and which of them each robot has.
    """
    if count < 2 or any((table[place[-2]] != table[place[-1]]).any() for table, place in varying):
        return count
    others = np.zeros(count, bool)
    for table, place in varying:
        differs = table != table[place[-1]]
        others |= differs.any(tuple(range(1, differs.ndim)))[place]
    return int(np.flatnonzero(others)[-1]) + 2 if others.any() else count


@functools.lru_cache(8)
def _same_for_all(arrays: tuple[tuple[str, tuple[int, ...], bytes], ...], sharding: Sharding) -> list[Array]:
    """Return the arrays that all robots have, on a device: for a GPU that takes milliseconds, and calls are alike."""
    each = [np.frombuffer(content, dtype).reshape(shape) for dtype, shape, content in arrays]
    placed: list[Array] = jax.device_put(each, sharding)
    return placed


def run_one(function: Function, structure: Hashable, *arguments: PyTree) -> PyTree:
    """Carry out a function of one robot on the CPU, in the precision of the arrays; see `run`.

    Returns:
        The function's results, as arrays of numpy.
    """
    double = any(leaf.dtype == np.float64 for leaf in jax.tree.leaves(arguments))
    call = _Call(function, structure, ())
    enable_cache()

    def by(path: str) -> PyTree:
        with devices.on_host(), jax.enable_x64(double):
            return jax.tree.map(np.asarray, _program(path, "cpu", False)(call._replace(path=path), *arguments))

    return first_possible(by, paths.path_for("cpu", kernel=False), (call, jax.tree.structure(arguments)))


def shapes_of(
    function: Callable[..., dict[str, Array]], structure: Hashable, *arguments: PyTree
) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a function's results for one robot, in double precision.

    They are kept on disk as executables are, so that a warm start does not trace for them.

    Arguments:
        function: as of `run`.
        structure: as of `run`.
        arguments: trees of `jax.ShapeDtypeStruct`.
    """
    enable_cache()
    leaves, tree = jax.tree.flatten(arguments)
    return dict(_shapes_of(_Call(function, structure, ()), tree, tuple(leaves)))


@functools.cache
def _shapes_of(call: _Call, tree: PyTreeDef, leaves: tuple[jax.ShapeDtypeStruct, ...]) -> dict[str, tuple[int, ...]]:
    trees = jax.tree.unflatten(tree, leaves)
    known = _identity(call, *trees)
    file = None if known is None else executable_file(call.function, known, (tree, leaves), {})
    if (stored := None if file is None else read_whole(file)) is not None:
        return {name: tuple(shape) for name, shape in json.loads(stored)}
    with devices.on_host(), jax.enable_x64(True):
        found = jax.eval_shape(functools.partial(call.function, call.structure), *trees)
    shapes = {name: value.shape for name, value in found.items()}
    if file is not None:
        store_whole(file, json.dumps([*shapes.items()]).encode())
    return shapes


def walking_with(robots: range, whole: int) -> range:
    """Return which robots of a batch of `whole` walk in a batch of their own, where `robots` shall keep their bits."""
    return devices.walking_with(robots, whole, in_regions=paths.path_for(None, kernel=True) == "regions")


def _rows_of(lead: tuple[int, ...], shape: Sequence[int]) -> np.ndarray:
    """Return which of the values with the batch axes `lead` each robot has, (B,)."""
    numbers = np.arange(math.prod(lead)).reshape(lead)
    return np.broadcast_to(numbers, shape).ravel()


def flattened(value: _Values, own: int, shape: Sequence[int]) -> _Values:
    """Return an array of NumPy or JAX with one batch axis where it varies, before its `own` axes.

    Of a single robot those vary that have batch axes, so that it goes by the executable of several.
    """
    shared = value.ndim - own
    lead: tuple[int, ...] = value.shape[:shared]
    tail: tuple[int, ...] = value.shape[shared:]
    count = math.prod(shape)
    if math.prod(lead) == 1 and not (count == 1 and lead):
        return value.reshape(tail)
    xp = np if isinstance(value, np.ndarray) else jnp
    whole: _Values = xp.broadcast_to(value, (*shape, *tail)).reshape(count, *tail)
    return whole


@functools.cache
def _program(path: str, device: str | None, briefly: bool) -> Callable[..., dict[str, Array]]:
    """Return the program of a path."""
    return cached_jit(_carried_out, _identity, paths.compiler_options(path, device, briefly=briefly))


def _identity(call: _Call, *trees: PyTree) -> str | None:
    """Return the identity of a call, None where its function cannot be identified."""
    kinds = sorted(_classes(jax.tree.structure(trees)), key=lambda kind: (kind.__module__, kind.__qualname__))
    try:
        known = identity((call.function, call.structure, kinds))
        return repr((known, *call[2:], code_digest({each.__module__ for each in (call.function, *kinds)})))
    except Unidentifiable:
        return None


@functools.lru_cache(64)
def _of_structure(function: Function, structure: Hashable) -> Function:
    """Return a function of one robot's arguments, the same object each time: JAX finds traced programs by it."""
    return functools.partial(function, structure)


def _classes(tree: PyTreeDef) -> set[type]:
    """Return the classes of a tree's nodes: a law, the parameters and their components."""
    about = tree.node_data()
    return {*([] if about is None else [about[0]]), *(kind for each in tree.children() for kind in _classes(each))}


def _carried_out(call: _Call, *trees: PyTree) -> PyTree:
    """Return the results of a batch, and derivatives (B, k, ...) by their names after `_TANGENT` or `_GRADIENT`.

    The last tree is the directions of tangents, or the weights of gradients.
    """
    function = _of_structure(call.function, call.structure)
    if call.path == "kernel":
        if not call.derivatives:
            return gpu_kernel.over_robots(function, call.batched)(*trees)
        *given, asked = trees
        every, (along, tree) = zip(jax.tree.leaves(trees), call.batched, strict=True), jax.tree.flatten(asked)
        robots, batched = next(len(leaf) for leaf, own in every if own), call.batched[: -len(along)]
        own = zip(along, call.batched[-len(along) :], strict=True)
        along = [leaf if own else jnp.broadcast_to(leaf, (robots, *leaf.shape)) for leaf, own in own]
        tangents, gradients = gpu_kernel.tangents_over_robots, gpu_kernel.gradients_over_robots
        derived = (tangents if call.derivatives == _TANGENT else gradients)(function, batched)
        values, found = derived(jax.tree.unflatten(tree, along), *given)
        return values | {call.derivatives + name: value for name, value in found.items() if value is not None}
    one = over_robots(function, regions=call.path == "regions")
    if not call.batched:
        return one(*trees)

    def with_tangents(moving: PyTree, *trees: PyTree) -> dict[str, Array]:
        def real_ones(moving: PyTree) -> tuple[dict[str, Array], dict[str, Array]]:
            found = one(moving, *trees[:-1])
            real = {name: value for name, value in found.items() if jnp.issubdtype(value.dtype, jnp.floating)}
            return real, {name: value for name, value in found.items() if name not in real}

        def along(direction: PyTree) -> PyTree:
            return jax.jvp(real_ones, (moving,), (direction,), has_aux=True)

        real, tangents, rest = jax.vmap(along, out_axes=(None, 0, None))(trees[-1])
        found: dict[str, Array] = real | rest | {_TANGENT + name: value for name, value in tangents.items()}
        return found

    def with_gradients(*trees: PyTree) -> dict[str, Array]:
        by_weights = gradients_over_robots(function, regions=call.path == "regions")
        results, found = jax.vmap(lambda weights: by_weights(weights, *trees[:-1]), out_axes=(None, 0))(trees[-1])
        return results | {_GRADIENT + name: value for name, value in found.items()}

    leaves, tree = jax.tree.flatten(trees)
    carry_out = {"": one, _TANGENT: with_tangents, _GRADIENT: with_gradients}[call.derivatives]
    mapped = [0 if batched else None for batched in call.batched]
    return jax.vmap(lambda *leaves: carry_out(*jax.tree.unflatten(tree, leaves)), in_axes=mapped)(*leaves)
