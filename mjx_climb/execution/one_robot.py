"""A function of one robot as one operation of JAX's, which knows its batches, its derivatives and its compilation.

Under `vmap` it takes a batch axis more, under `jvp` its traced program is differentiated, in reverse mode its adjoint
is taken, and where any of these is compiled for a CPU it is cut into regions (`cpu_regions`). Other devices take the
equations as they are.
"""

import functools
import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypedDict, TypeVar, Unpack

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend import core
from jax.interpreters import ad, batching, mlir

from mjx_climb.execution.adjoint import with_gradients
from mjx_climb.execution.cpu_regions import in_regions
from mjx_climb.execution.elements import Unsupported
from mjx_climb.execution.flat import Has, by_axis, mapped, reached, tangents_of, with_axes
from mjx_climb.execution.jax_internals import (
    OVER_ROBOTS,
    new_program,
    register_reverse_mode,
    take_tables_in_each_precision,
)
from mjx_climb.execution.jax_types import PyTree

_Result = TypeVar("_Result")

_program = core.Primitive(OVER_ROBOTS)  # of one robot
_program.multiple_results = True


class _Batch(TypedDict):
    """The operation's parameters beside the program."""

    batch: tuple[int, ...]  # sizes of the batch axes, behind an array's own
    varies: tuple[Has, ...]  # of each argument
    regions: bool | None


class _Whole(_Batch):
    """All of them."""

    program: core.ClosedJaxpr


def over_robots(function: Callable[..., _Result], *, regions: bool | None = None) -> Callable[..., _Result]:
    """Return a pure function of one robot, compiled, that is fast under `vmap`.

    It takes and gives trees of arrays, and works under `jit`, `scan`, `vmap`, `jvp` and `grad`, nested as one likes.

    Arguments:
        function: pure.
        regions: whether a CPU works in regions; None: where they can, and a warning says where they cannot.

    Raises:
        Unsupported: when it is compiled, an operation without a rule.
    """

    def call(*arguments: PyTree) -> _Result:
        program, values, tree = _traced(function, arguments)
        results = _program.bind(*values, program=program, batch=(), varies=((),) * len(values), regions=regions)
        whole: _Result = jax.tree.unflatten(tree, results)
        return whole

    return jax.jit(functools.wraps(function)(call))


def gradients_over_robots(
    function: Callable[..., dict[str, Array]], *, regions: bool | None = None
) -> Callable[..., tuple[dict[str, Array], PyTree]]:
    """Return a function of one robot to its results and the gradients of a weighted sum of them; see `over_robots`.

    It takes weights by the names of results that are real numbers, then the function's arguments. The gradients are by
    the first of these, a tree of real numbers.
    """

    def call(weights: dict[str, Array], *arguments: PyTree) -> tuple[dict[str, Array], PyTree]:
        program, values, tree = _traced(function, arguments)
        moving, along = jax.tree.flatten(arguments[0])
        outside = len(values) - len(jax.tree.leaves(arguments))
        moves = tuple(outside <= place < outside + len(moving) for place in range(len(values)))
        names = jax.tree.unflatten(tree, range(tree.num_leaves))
        weighed = tuple(place in {names[name] for name in weights} for place in range(tree.num_leaves))
        both = with_gradients(program, moves, weighed, values=True)
        given = [*values, *(weights[name] for name in sorted(weights))]
        made = _program.bind(*given, program=both, batch=(), varies=((),) * len(given), regions=regions)
        found: dict[str, Array] = jax.tree.unflatten(tree, made[: tree.num_leaves])
        return found, jax.tree.unflatten(along, made[tree.num_leaves :])

    return jax.jit(call)


def _traced(
    function: Callable[..., PyTree], arguments: Sequence[PyTree]
) -> tuple[core.ClosedJaxpr, list[Array], jax.tree_util.PyTreeDef]:
    """Return the program of a function, the values that it takes, and the tree of its results.

    Traced values that the program closes over become its first arguments.
    """
    # XLA's default for float32 on a GPU is TF32, of ten bits
    with jax.default_matmul_precision("highest"):
        traced, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    constants = list(zip(traced.jaxpr.constvars, traced.consts, strict=True))
    outside = [(variable, value) for variable, value in constants if isinstance(value, jax.core.Tracer)]
    known = [(variable, value) for variable, value in constants if not isinstance(value, jax.core.Tracer)]
    inputs = [*(variable for variable, _ in outside), *traced.jaxpr.invars]
    program = new_program(traced.jaxpr, traced.jaxpr.eqns, inputs, traced.jaxpr.outvars, known)
    values = [*(value for _, value in outside), *jax.tree.leaves(arguments)]
    return program, values, jax.tree.structure(shape)


def _abstract(*avals: PyTree, program: core.ClosedJaxpr, **how: Unpack[_Batch]) -> list[PyTree]:
    each = zip(program.out_avals, _vary({"program": program, **how}), strict=True)
    return [aval.update(shape=(*aval.shape, *itertools.compress(how["batch"], has))) for aval, has in each]


def _vary(how: _Whole) -> list[Has]:
    return _results_vary(how["program"], how["varies"], len(how["batch"]))


@functools.lru_cache(maxsize=256)
def _results_vary(program: core.ClosedJaxpr, varies: Sequence[Has], axes: int) -> list[Has]:
    """Return which batch axes the results have."""
    return by_axis(functools.partial(reached, program.jaxpr), varies, axes, len(program.out_avals))


def _batched(
    primitive: core.Primitive,
    vary: Callable[[Any], list[Has]],
    values: Sequence[Array],
    axes: Sequence[int | None],
    **how: Any,
) -> tuple[list[Array], list[int | None]]:
    """Add a batch axis, as the last, to an operation; `vary` tells which axes its results have."""
    size = next(value.shape[axis] for value, axis in zip(values, axes, strict=True) if axis is not None)
    last = [v if axis is None else jnp.moveaxis(v, axis, -1) for v, axis in zip(values, axes, strict=True)]
    how["varies"] = tuple((*has, axis is not None) for has, axis in zip(how["varies"], axes, strict=True))
    how["batch"] = (*how["batch"], size)
    results = primitive.bind(*last, **how)
    return results, [value.ndim - 1 if has[-1] else None for value, has in zip(results, vary(how), strict=True)]


def _differentiated(
    values: Sequence[Array], tangents: Sequence[Array | ad.Zero], program: core.ClosedJaxpr, **how: Unpack[_Batch]
) -> tuple[list[Array], list[Array | ad.Zero]]:
    moving = [not isinstance(tangent, ad.Zero) and tangent.dtype != jax.dtypes.float0 for tangent in tangents]
    both, moved = tangents_of(program, moving)
    varies = (*how["varies"], *itertools.compress(how["varies"], moving))
    made = _program.bind(*values, *itertools.compress(tangents, moving), program=both, **how | {"varies": varies})
    results, found = made[: len(moved)], iter(made[len(moved) :])
    zeros = (ad.Zero(jax.typeof(value).to_tangent_aval()) for value in results)
    return results, [next(found) if moves else zero for moves, zero in zip(moved, zeros, strict=True)]


def _linearized(moving: Sequence[bool], *values: Array, **parameters: Unpack[_Whole]) -> PyTree:
    """Return results, which of them have tangents, and these as a linear operation, whose transpose is the adjoint."""
    program = parameters["program"]
    moving = tuple(bool(m) and _is_real(value) for m, value in zip(moving, values, strict=True))
    _, moved = tangents_of(program, moving)
    results = _program.bind(*values, **parameters)

    def tangents(*given: Array) -> list[Array | ad.Zero]:
        along = [
            ad.instantiate_zeros(tangent) if isinstance(tangent, ad.Zero) else tangent
            for tangent in itertools.compress(given, moving)
        ]
        varies = (*parameters["varies"], *itertools.compress(parameters["varies"], moving))
        how = parameters | {"varies": varies, "moving": moving, "moved": tuple(moved)}
        found = iter(_tangents.bind(*values, *along, **how) if any(moved) else [])
        zeros = (ad.Zero(jax.typeof(value).to_tangent_aval()) for value in results)
        return [next(found) if moves else zero for moves, zero in zip(moved, zeros, strict=True)]

    return results, moved, tangents


# --- tangents of an operation as a linear operation, to be transposed

_tangents = core.Primitive("tangents_over_robots")
_tangents.multiple_results = True


class _Linear(_Whole):
    """Parameters of the tangents: `varies` of the arguments, then of the tangents of those that are moving."""

    moving: tuple[bool, ...]  # of the arguments
    moved: tuple[bool, ...]  # of the results


def _tangents_vary(how: _Linear) -> list[Has]:
    """Return which batch axes the tangents of results have: those of the results, and those of the tangents given."""
    axes, count = len(how["batch"]), len(how["moving"])
    of_results = _results_vary(how["program"], how["varies"][:count], axes)
    both, _ = tangents_of(how["program"], how["moving"])
    along = itertools.compress(of_results, how["moved"])
    found = _results_vary(both, how["varies"], axes)[len(how["moved"]) :]
    return [tuple(map(any, zip(*each, strict=True))) for each in zip(along, found, strict=True)]


def _shared_out(value: Array, has: Has, wanted: Has, batch: tuple[int, ...]) -> Array:
    """Return a value in equal parts over the batch axes that it lacks: their sum is the value."""
    lacking = math.prod(size for size, h, w in zip(batch, has, wanted, strict=True) if w and not h)
    return value if has == wanted else with_axes(value / lacking, has, wanted, batch)


def _tangents_made(*values: Array, **how: Unpack[_Linear]) -> list[Array]:
    both, _ = tangents_of(how["program"], how["moving"])
    batch, varies, regions = how["batch"], how["varies"], how["regions"]
    made = _program.bind(*values, program=both, batch=batch, varies=varies, regions=regions)
    count = len(how["moved"])
    each = zip(made[count:], _results_vary(both, varies, len(batch))[count:], _tangents_vary(how), strict=True)
    return [with_axes(value, own, wanted, batch) for value, own, wanted in each]


def _tangents_abstract(*avals: PyTree, **how: Unpack[_Linear]) -> list[PyTree]:
    each = zip(itertools.compress(how["program"].out_avals, how["moved"]), _tangents_vary(how), strict=True)
    return [aval.update(shape=(*aval.shape, *itertools.compress(how["batch"], has))) for aval, has in each]


def _tangents_transposed(
    weights: Sequence[Array | ad.Zero], *values: PyTree, **how: Unpack[_Linear]
) -> list[Array | None]:
    """Return the adjoint: gradients of weighted results by the arguments that are moving."""
    count, program, batch = len(how["moving"]), how["program"], how["batch"]
    given = iter(zip(weights, _tangents_vary(how), strict=True))
    along = [next(given) if moves else None for moves in how["moved"]]
    given_weights = [each for each in along if each is not None]
    some = [(weight, has) for weight, has in given_weights if not isinstance(weight, ad.Zero)]
    weighed = tuple(each is not None and not isinstance(each[0], ad.Zero) for each in along)
    # a result of all robots counts once, not once for each
    axes = tuple(map(any, zip(*how["varies"][:count], *(has for _, has in some), strict=True)))
    some = [(_shared_out(weight, has, axes, batch), axes) for weight, has in some]
    back = with_gradients(program, how["moving"], weighed, values=False)
    varies = (*how["varies"][:count], *(has for _, has in some))
    arguments = *values[:count], *(value for value, _ in some)
    made = _program.bind(*arguments, program=back, batch=batch, varies=varies, regions=how["regions"])
    each = zip(made, _results_vary(back, varies, len(batch)), how["varies"][count:], strict=True)
    return [*[None] * count, *(with_axes(value, has, wanted, batch) for value, has, wanted in each)]


def _tangents_moved(
    values: Sequence[Array], tangents: Sequence[Array | ad.Zero], **how: Unpack[_Linear]
) -> tuple[list[Array], list[Array]]:
    some = [ad.instantiate_zeros(tangent) for tangent in tangents]
    return jax.jvp(lambda *given: _tangents_made(*given, **how), tuple(values), tuple(some))


_tangents.def_abstract_eval(_tangents_abstract)
_tangents.def_impl(lambda *values, **how: jax.jit(functools.partial(_tangents.bind, **how))(*values))
ad.primitive_transposes[_tangents] = _tangents_transposed
ad.primitive_jvps[_tangents] = _tangents_moved
batching.primitive_batchers[_tangents] = functools.partial(_batched, _tangents, _tangents_vary)
mlir.register_lowering(_tangents, mlir.lower_fun(_tangents_made, multiple_results=True))


def _is_real(value: Array) -> bool:
    return bool(jnp.issubdtype(value.dtype, jnp.inexact))


def _whole(*values: Array, program: core.ClosedJaxpr, **how: Unpack[_Batch]) -> list[Array]:
    """Return the results by JAX's own operations."""
    having = _results_vary(program, how["varies"], len(how["batch"]))
    results: list[Array] = mapped(core.jaxpr_as_fun(program), how["varies"], having)(*values)
    return results


def _as_call(program: core.ClosedJaxpr, **how: Unpack[_Batch]) -> _Whole:
    """Return the parameters of an operation whose program takes the values with their batch axes."""
    if how["batch"]:
        how["varies"] = how["varies"][: len(program.in_avals)]
        shapes = [
            jax.ShapeDtypeStruct((*aval.shape, *itertools.compress(how["batch"], has)), aval.dtype)
            for aval, has in zip(program.in_avals, how["varies"], strict=True)
        ]
        program = jax.make_jaxpr(functools.partial(_whole, program=program, **how))(*shapes)
    return {"program": program, "batch": (), "varies": ((),) * len(program.in_avals), "regions": False}


def _for_cpu(*values: Array, program: core.ClosedJaxpr, **how: Unpack[_Batch]) -> list[Array]:
    if how["regions"] is not False:
        try:
            return in_regions(program, values, how["varies"], how["batch"])
        except Unsupported as error:
            if how["regions"]:
                raise
            warnings.warn(f"the CPU's regions cannot do {error}: by XLA's own way, slower", stacklevel=2)
    return _whole(*values, program=program, **how)


_program.def_abstract_eval(_abstract)
_program.def_impl(lambda *values, **how: jax.jit(functools.partial(_program.bind, **how))(*values))
batching.primitive_batchers[_program] = functools.partial(_batched, _program, _vary)
ad.primitive_jvps[_program] = _differentiated
register_reverse_mode(_program, _linearized, _whole, _as_call)
take_tables_in_each_precision()
mlir.register_lowering(_program, mlir.lower_fun(_whole, multiple_results=True))
mlir.register_lowering(_program, mlir.lower_fun(_for_cpu, multiple_results=True), platform="cpu")
