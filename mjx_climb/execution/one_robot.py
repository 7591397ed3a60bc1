"""A function of one robot as one operation of JAX's, which knows its batches, its derivatives and its compilation.

Under `vmap` it takes a batch axis more, under `jvp` its traced program is differentiated, and where it is compiled for
a CPU it is cut into regions (`cpu_regions`). Other devices, and reverse mode, take the equations as they are.
"""

import functools
import itertools
import warnings
from collections.abc import Callable, Sequence
from typing import TypedDict, TypeVar, Unpack

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend import core
from jax.interpreters import ad, batching, mlir

from mjx_climb.execution.cpu_regions import in_regions
from mjx_climb.execution.elements import Unsupported
from mjx_climb.execution.flat import Has, by_axis, mapped, reached, tangents_of
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
        Unsupported: when it is compiled, what regions cannot do.
    """

    def call(*arguments: PyTree) -> _Result:
        # XLA's default for float32 on a GPU is TF32, of ten bits
        with jax.default_matmul_precision("highest"):
            traced, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        constants = list(zip(traced.jaxpr.constvars, traced.consts, strict=True))
        # traced values that the program closes over become its first arguments
        outside = [(variable, value) for variable, value in constants if isinstance(value, jax.core.Tracer)]
        known = [(variable, value) for variable, value in constants if not isinstance(value, jax.core.Tracer)]
        inputs = [*(variable for variable, _ in outside), *traced.jaxpr.invars]
        program = new_program(traced.jaxpr, traced.jaxpr.eqns, inputs, traced.jaxpr.outvars, known)
        values = [*(value for _, value in outside), *jax.tree.leaves(arguments)]
        results = _program.bind(*values, program=program, batch=(), varies=((),) * len(values), regions=regions)
        whole: _Result = jax.tree.unflatten(jax.tree.structure(shape), results)
        return whole

    return jax.jit(functools.wraps(function)(call))


def _abstract(*avals: PyTree, program: core.ClosedJaxpr, **how: Unpack[_Batch]) -> list[PyTree]:
    sizes = how["batch"]
    return [
        aval.update(shape=(*aval.shape, *itertools.compress(sizes, has)))
        for aval, has in zip(program.out_avals, _results_vary(program, how["varies"], len(sizes)), strict=True)
    ]


@functools.lru_cache(maxsize=256)
def _results_vary(program: core.ClosedJaxpr, varies: Sequence[Has], axes: int) -> list[Has]:
    """Return which batch axes the results have."""
    return by_axis(functools.partial(reached, program.jaxpr), varies, axes, len(program.out_avals))


def _batched(
    values: Sequence[Array], axes: Sequence[int | None], program: core.ClosedJaxpr, **how: Unpack[_Batch]
) -> tuple[list[Array], list[int | None]]:
    """Add a batch axis, as the last."""
    size = next(value.shape[axis] for value, axis in zip(values, axes, strict=True) if axis is not None)
    last = [v if axis is None else jnp.moveaxis(v, axis, -1) for v, axis in zip(values, axes, strict=True)]
    varies = tuple((*has, axis is not None) for has, axis in zip(how["varies"], axes, strict=True))
    batch = (*how["batch"], size)
    results = _program.bind(*last, program=program, batch=batch, varies=varies, regions=how["regions"])
    having = _results_vary(program, varies, len(batch))
    return results, [value.ndim - 1 if has[-1] else None for value, has in zip(results, having, strict=True)]


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
    """Reverse mode goes by JAX's own operations, uncut: a region can be neither transposed nor split in time."""
    moving = [m and _is_real(value) for m, value in zip(moving, values, strict=True)]

    def plain(*some: Array) -> list[Array]:
        given = iter(some)
        return _whole(*(next(given) if m else v for m, v in zip(moving, values, strict=True)), **parameters)

    results, along = jax.linearize(plain, *itertools.compress(values, moving))
    real = [_is_real(value) for value in results]

    def tangents(*given: Array) -> list[Array | ad.Zero]:
        found = along(*itertools.compress(given, moving))
        zeros = (ad.Zero(jax.typeof(value).to_tangent_aval()) for value in results)
        return [rate if is_real else zero for rate, is_real, zero in zip(found, real, zeros, strict=True)]

    return results, real, tangents


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
batching.primitive_batchers[_program] = _batched
ad.primitive_jvps[_program] = _differentiated
register_reverse_mode(_program, _linearized, _whole, _as_call)
take_tables_in_each_precision()
mlir.register_lowering(_program, mlir.lower_fun(_whole, multiple_results=True))
mlir.register_lowering(_program, mlir.lower_fun(_for_cpu, multiple_results=True), platform="cpu")
