"""A function of one robot as one GPU kernel for a batch of them, with a thread for each robot.

XLA:GPU runs a step of a walk as some thirty kernels, one after the other, that hand their values on through memory: the
launches and the memory set the pace, not the arithmetic. But a robot needs nothing of the others. Written out element
by element, with the loop over time inside, its whole walk is a single kernel whose values stay in registers.

The kernel is compiled by way of Pallas and Triton. It is for values: it has no derivatives.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental import pallas
from jax.experimental.pallas import triton
from jax.extend import core

_Result = TypeVar("_Result")
_Element = np.generic | Array  # a number known when compiling; a number for all robots (), or one for each (threads,)
_Elements = np.ndarray  # of such elements, or of numbers

_THREADS = 128  # in a block, a robot for each
_WARP = 32  # threads

_CALLS = {"jit": "jaxpr", "closed_call": "call_jaxpr", "custom_jvp_call": "call_jaxpr"}
_REDUCTIONS = {
    "reduce_sum": lax.add_p,
    "reduce_max": lax.max_p,
    "reduce_min": lax.min_p,
    "reduce_and": lax.and_p,
    "reduce_or": lax.or_p,
}


def over_robots(
    function: Callable[..., _Result], batched: Sequence[Any], *, interpret: bool = False
) -> Callable[..., _Result]:
    """Return the function mapped over the first axis of its arguments, like `jax.vmap`, as one kernel.

    Arguments:
        function: of trees of real numbers, all of one precision: elementwise operations on fixed shapes, and loops of a
            fixed number of steps.
        batched: for each argument a tree of bool: whether an array has the batch axis.
        interpret: without Triton, on any device, slowly: for tests.

    Returns:
        A function of arguments with a batch axis, of any length, where `batched` says so. All results have it.
    """
    axes = [int(has_axis) for has_axis in jax.tree.leaves(tuple(batched))]

    def mapped(*arguments: Any) -> _Result:
        values, tree = jax.tree.flatten(arguments)
        one = [jax.ShapeDtypeStruct(value.shape[axis:], value.dtype) for value, axis in zip(values, axes, strict=True)]
        program, shape = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(tree, one))
        outputs = program.out_avals

        def walk(own: Iterator[Array], common: Iterator[Array]) -> list[_Element]:
            given = [
                _array(itertools.islice(own if axis else common, leaf.size), leaf.shape)
                for leaf, axis in zip(one, axes, strict=True)
            ]
            return _flat(_Operations().results(program.jaxpr, program.consts, given))

        robots = next(len(value) for value, axis in zip(values, axes, strict=True) if axis)
        rows = [value.reshape(robots, leaf.size).T for value, leaf, axis in zip(values, one, axes, strict=True) if axis]
        own = jnp.concatenate(rows)
        no_ref_is_empty = jnp.zeros(1, own.dtype)
        common = jnp.concatenate(
            [v.reshape(-1) for v, axis in zip(values, axes, strict=True) if not axis] + [no_ref_is_empty]
        )
        sizes = [math.prod(output.shape) for output in outputs]
        parts = jnp.split(_launch(walk, own, common, sum(sizes), interpret=interpret), np.cumsum(sizes)[:-1])
        results = [
            part.T.reshape(robots, *output.shape).astype(output.dtype)
            for part, output in zip(parts, outputs, strict=True)
        ]
        result: _Result = jax.tree.unflatten(jax.tree.structure(shape), results)
        return result

    return mapped


def _launch(
    walk: Callable[[Iterator[Array], Iterator[Array]], list[_Element]],
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
        results = [_for_each_robot(element, own.dtype) for element in elements]
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


class _Operations:
    """Operations on elements, each of which is carried out once: asked for again, it gives the same result."""

    def __init__(self, before: "Mapping[Any, tuple[Any, _Element]] | None" = None) -> None:
        # an operation and its operands: these, so that their ids stay their own, and the result
        self.done: dict[Any, tuple[Any, _Element]] = dict(before or {})

    def results(self, jaxpr: core.Jaxpr, constants: Sequence[Any], arguments: Sequence[_Elements]) -> list[_Elements]:
        """Return the results of a jaxpr for arrays of elements."""
        values = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
        values |= dict(zip(jaxpr.invars, arguments, strict=True))

        def read(atom: core.Var | core.Literal) -> _Elements:
            aval: Any = atom.aval
            return np.asarray(atom.val, aval.dtype) if isinstance(atom, core.Literal) else values[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation: core.JaxprEqn, given: list[_Elements]) -> list[_Elements]:
        name, parameters = equation.primitive.name, equation.params
        if name in _CALLS:
            inner = parameters[_CALLS[name]]
            return self.results(inner.jaxpr, inner.consts, given)
        if name == "scan":
            return self._loop(parameters["jaxpr"], parameters["length"], given)
        if name in _REARRANGED:
            return _REARRANGED[name](given, parameters)
        if all(array.dtype != object for array in given):
            return _computed_now(equation.primitive, parameters, given)
        if name in _REDUCTIONS:
            combine = functools.partial(self._each, _REDUCTIONS[name], {})
            array = given[0]
            for axis in sorted(parameters["axes"], reverse=True):
                array = functools.reduce(combine, _along(array, axis))
            return [array]
        return [self._each(equation.primitive, parameters, *given)]

    def _each(self, primitive: core.Primitive, parameters: Mapping[str, Any], *arrays: _Elements) -> _Elements:
        shape = np.broadcast_shapes(*(np.shape(array) for array in arrays))
        each = zip(*(np.broadcast_to(array, shape).reshape(-1) for array in arrays), strict=True)
        return _array((self._element(primitive, parameters, operands) for operands in each), shape)

    def _element(
        self, primitive: core.Primitive, parameters: Mapping[str, Any], operands: tuple[_Element, ...]
    ) -> _Element:
        if primitive.name in _SHORTCUTS and (known := _SHORTCUTS[primitive.name](*operands)) is not None:
            return known
        if all(isinstance(each, np.generic) for each in operands):
            [number] = _computed_now(primitive, parameters, operands)[0].reshape(1)
            return cast(np.generic, number)
        names = tuple(each.tobytes() if isinstance(each, np.generic) else id(each) for each in operands)
        operation = (primitive.name, str(parameters), names)
        if operation not in self.done:
            alike = (
                [_for_each_robot(each, each.dtype) for each in operands] if any(map(np.ndim, operands)) else operands
            )
            bind: Callable[..., Array] = _REPLACED.get(primitive.name, primitive.bind)
            self.done[operation] = operands, bind(*map(jnp.asarray, alike), **parameters)
        return self.done[operation][1]

    def _loop(self, body: core.ClosedJaxpr, steps: int, given: list[_Elements]) -> list[_Elements]:
        """Return what a scan carries in the end; it reads nothing and writes nothing step by step."""
        carried = [variable.aval for variable in body.jaxpr.outvars]
        constants, start = given[: -len(carried)], given[-len(carried) :]

        def arrays(elements: Sequence[Array]) -> list[_Elements]:
            rest = iter(elements)
            return [_array(itertools.islice(rest, math.prod(aval.shape)), aval.shape) for aval in carried]

        def elements(arrays: list[_Elements]) -> tuple[Array, ...]:
            typed = ((e, aval.dtype) for array, aval in zip(arrays, carried, strict=True) for e in array.reshape(-1))
            return tuple(_for_each_robot(element, dtype) for element, dtype in typed)

        def step(_: Array, before: tuple[Array, ...]) -> tuple[Array, ...]:
            inside = _Operations(self.done)
            return elements(inside.results(body.jaxpr, body.consts, [*constants, *arrays(before)]))

        return arrays(lax.fori_loop(0, steps, step, elements(start)))


def _array(elements: Iterator[_Element], shape: tuple[int, ...]) -> _Elements:
    """Return elements as an array, of plain numbers where all are known."""
    flat = list(elements)
    if flat and all(isinstance(element, np.generic) for element in flat):
        return np.array(flat).reshape(shape)
    array = np.empty(len(flat), object)
    for index, element in enumerate(flat):
        array[index] = element
    return array.reshape(shape)


def _flat(arrays: Sequence[_Elements]) -> list[_Element]:
    return [element for array in arrays for element in array.reshape(-1)]


def _for_each_robot(element: _Element, dtype: jnp.dtype) -> Array:
    value = jnp.asarray(element).astype(dtype)
    return value if value.ndim else lax.broadcast(value, (_THREADS,))


def _computed_now(
    primitive: core.Primitive, parameters: Mapping[str, Any], given: Sequence[_Elements | _Element]
) -> list[np.ndarray]:
    """Return the results of an operation on numbers alone, on the CPU, which compiles it sooner than a GPU."""
    with jax.ensure_compile_time_eval(), jax.default_device(jax.local_devices(backend="cpu")[0]):
        results: Any = primitive.bind(*given, **parameters)
        return [np.asarray(result) for result in (results if primitive.multiple_results else [results])]


def _objects(array: _Elements) -> _Elements:
    """Return an array of elements that keep their types among others."""
    result = np.empty(array.shape, object)
    for index in np.ndindex(*array.shape):
        result[index] = array[index]
    return result


def _along(array: _Elements, axis: int) -> list[_Elements]:
    """Return an array's parts along an axis, as arrays even where they are single elements."""
    return [np.moveaxis(array, axis, 0)[index, ...] for index in range(array.shape[axis])]


def _broadcast(array: _Elements, shape: tuple[int, ...], axes: Sequence[int]) -> _Elements:
    sizes = dict(zip(axes, array.shape, strict=True))
    return np.broadcast_to(array.reshape([sizes.get(axis, 1) for axis in range(len(shape))]), shape)


def _slice(array: _Elements, starts: Sequence[int], limits: Sequence[int], strides: Sequence[int] | None) -> _Elements:
    return array[tuple(map(slice, starts, limits, strides or itertools.repeat(1)))]


# what moves elements without a look at them, from the operands and the parameters of the operation
_REARRANGED: dict[str, Callable[[list[_Elements], Mapping[str, Any]], list[_Elements]]] = {
    "broadcast_in_dim": lambda x, p: [_broadcast(x[0], p["shape"], p["broadcast_dimensions"])],
    "concatenate": lambda x, p: [np.concatenate([*map(_objects, x)], p["dimension"])],
    "copy": lambda x, p: x,
    "expand_dims": lambda x, p: [np.expand_dims(x[0], tuple(p["dimensions"]))],
    "reshape": lambda x, p: [x[0].reshape(p["new_sizes"])],
    "rev": lambda x, p: [np.flip(x[0], p["dimensions"])],
    "slice": lambda x, p: [_slice(x[0], p["start_indices"], p["limit_indices"], p["strides"])],
    "squeeze": lambda x, p: [np.squeeze(x[0], tuple(p["dimensions"]))],
    "stack": lambda x, p: [np.stack([*map(_objects, x)], p["axis"])],
    "transpose": lambda x, p: [x[0].transpose(p["permutation"])],
    "unstack": lambda x, p: _along(x[0], p["axis"]),
}


def _product(a: _Element, b: _Element) -> _Element | None:
    """Return what needs no multiplication: the model's frames are full of zeros and ones."""
    for known, other in ((a, b), (b, a)):
        if isinstance(known, np.generic) and known in (0, 1):
            return other if known == 1 else known
    return None


def _sum(a: _Element, b: _Element) -> _Element | None:
    for known, other in ((a, b), (b, a)):
        if isinstance(known, np.generic) and known == 0:
            return other
    return None


def _difference(a: _Element, b: _Element) -> _Element | None:
    return a if isinstance(b, np.generic) and b == 0 else None


_SHORTCUTS: dict[str, Callable[..., _Element | None]] = {"mul": _product, "add": _sum, "sub": _difference}


def _round(value: Array, *, rounding_method: lax.RoundingMethod) -> Array:
    """Return the nearest whole number, of two the even one: Triton has no such operation."""
    if rounding_method is not lax.RoundingMethod.TO_NEAREST_EVEN:
        raise NotImplementedError(f"rounding by {rounding_method} in a GPU kernel")
    up = lax.floor(value + 0.5)
    odd = lax.floor(up * 0.5) * 2 != up
    return jnp.where((up - value == 0.5) & odd, up - 1, up)


_REPLACED: dict[str, Callable[..., Array]] = {"round": _round}
