"""A traced function carried out element by element: what regions and kernels consist of.

`elements.MOVES`, and the tables below, list all that is known. What is not listed, or has parameters that nobody has
thought of, raises `Unsupported`. A rule is a function of the operations, the equation and its operands.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from mjx_climb.execution.element_operations import Operations, computed_now
from mjx_climb.execution.elements import MOVES, Elements, Shared, Unsupported, Value, along, as_array, known, objects
from mjx_climb.execution.jax_internals import inner_program, scan_sizes

MOST_ELEMENTS = 1000  # of one equation in a region: what has more is an array to XLA as well
MOST_PRODUCTS = 4096  # of a product of matrices
MOST_STEPS = 64  # of a loop that reads or writes something at each


# each result element depends on one element of each operand
ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type cos cosh div eq "
    "erf_inv exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p log2 logistic lt max min mul ne neg "
    "nextafter not one_minus_square or pow rem round rsqrt select_n shift_left shift_right_arithmetic "
    "shift_right_logical sign sin sinh sqrt square sub tan tanh xor".split()
)
# Moves that JAX carries out on the elements' numbers, and how many operands are moved: the rest must be known.
_BY_NUMBER = {
    "dynamic_slice": 1,
    "dynamic_update_slice": 2,
    "expand_dims": 1,
    "gather": 1,
    "pad": 2,
    "rev": 1,
    "split": 1,
    "tile": 1,
    "unstack": 1,
}
# Parameters that an operation above, a move or a rule looks at; a product of matrices has the precision of its
# elements, which is no less than any that is asked for.
_UNDERSTOOD = frozenset(
    "axes axis broadcast_dimensions dimension dimension_numbers dimensions ft_in ft_out jaxpr length limit_indices "
    "name new_dtype new_sizes num_carry num_consts permutation precision preferred_element_type reverse "
    "rounding_method shape start_indices strides unroll weak_type y".split()
)


def can_write(equation: core.JaxprEqn) -> bool:
    """Return whether a region writes an equation as elements: nothing that loops, is large, or calls a library."""
    name, atoms = equation.primitive.name, (*equation.invars, *equation.outvars)
    avals = [cast(Any, atom.aval) for atom in atoms]
    if equation.effects or name == "scan" or any(_is_strange(aval.dtype) for aval in avals):
        return False
    if not _is_listed(name) and name not in _BY_NUMBER and name != "iota":
        return False
    return sum(aval.size for aval in avals) <= MOST_ELEMENTS and _products(equation) <= MOST_ELEMENTS


def _is_listed(name: str) -> bool:
    return name in MOVES or name in RULES or name in ELEMENTWISE


def _is_strange(dtype: Any) -> bool:
    return bool(jnp.issubdtype(dtype, jax.dtypes.extended) or jnp.issubdtype(dtype, jnp.complexfloating))


def _products(equation: core.JaxprEqn) -> int:
    """Return how many products a product of matrices has, zero of anything else."""
    if equation.primitive.name != "dot_general":
        return 0
    (left, _), _ = equation.params["dimension_numbers"]
    terms = math.prod(cast(Any, equation.invars[0].aval).shape[axis] for axis in left)
    return int(terms * cast(Any, equation.outvars[0].aval).size)


def results(do: Operations, program: core.ClosedJaxpr, given: Sequence[Elements]) -> list[Elements]:
    """Return the results of a program for arrays of elements."""
    jaxpr = program.jaxpr
    values = dict(zip(jaxpr.constvars, map(np.asarray, program.consts), strict=True))
    values |= dict(zip(jaxpr.invars, given, strict=True))

    def read(atom: core.Var | core.Literal) -> Elements:
        aval: Any = atom.aval
        return np.asarray(atom.val, aval.dtype) if isinstance(atom, core.Literal) else values[atom]

    for equation in jaxpr.eqns:
        try:
            results = _equation(do, equation, [read(atom) for atom in equation.invars])
        except Unsupported as error:
            error.equation = error.equation or equation
            raise
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _equation(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    primitive, parameters, name = equation.primitive, equation.params, equation.primitive.name
    if equation.effects:
        raise Unsupported(f"the operation {name}, which has effects,")
    if any(_is_strange(cast(Any, variable.aval).dtype) for variable in equation.outvars):
        raise Unsupported(f"the operation {name} on complex numbers or random keys")
    if (inner := inner_program(equation)) is not None:
        return results(do, inner, given)
    if name not in MOVES and all(map(known, given)):
        return computed_now(primitive, parameters, given)
    if name in _BY_NUMBER:
        return _moved_by_number(equation, given)
    if not _is_listed(name):
        raise Unsupported(f"the operation {name}")
    for parameter, value in parameters.items():  # those left empty are fine
        if parameter not in _UNDERSTOOD and value is not None and value is not False and value != ():
            raise Unsupported(f"the operation {name} with {parameter}={value}")
    if name in MOVES:
        return MOVES[name](given, parameters)
    if name in RULES:
        return RULES[name](do, equation, given)
    return [do.each(primitive, parameters, *given)]


def _moved_by_number(equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    name, parameters = equation.primitive.name, equation.params
    tables, places = given[: _BY_NUMBER[name]], given[_BY_NUMBER[name] :]
    if not all(map(known, places)):
        raise Unsupported(f"the operation {name} at places that are known only in the walk")
    elements = [objects(table).reshape(-1) for table in tables]
    flat = np.split(np.arange(sum(map(len, elements)), dtype=np.int32), np.cumsum([*map(len, elements)])[:-1])
    numbers = [number.reshape(table.shape) for number, table in zip(flat, tables, strict=True)]
    filled = {"fill_value": -1} if "fill_value" in parameters else {}
    moved = computed_now(equation.primitive, parameters | filled, [*numbers, *places])
    if any((found < 0).any() for found in moved):
        raise Unsupported(f"the operation {name} beyond the ends of a table")
    return [np.concatenate(elements)[found, ...] for found in moved]  # arrays, of single elements too


# --- rules

Rule = Callable[[Operations, core.JaxprEqn, list[Elements]], list[Elements]]


def _reduction(combine: core.Primitive) -> Rule:
    def rule(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
        [array], axes = given, list(equation.params["axes"])
        axes.sort(key=lambda axis: (do.runs_over_lanes(given[0], axis), -axis))  # first what a lane does on its own
        while axes:
            gone = axes.pop(0)
            if array.shape[gone] == 0 and combine in (lax.add_p, lax.or_p):  # an empty table of pushes, say
                array = np.zeros(np.delete(array.shape, gone), cast(Any, equation.outvars[0].aval).dtype)
            else:
                array = do.together(combine, along(array, gone))
            axes = [axis - (axis > gone) for axis in axes]
        return [array]

    return rule


def _product_of_matrices(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    (summed, batched) = equation.params["dimension_numbers"]
    dtype = cast(Any, equation.outvars[0].aval).dtype
    left, right = (do.converted(array, dtype) for array in given)
    rows, columns = (_axes_in_order(a, both, s) for a, both, s in zip((left, right), batched, summed, strict=True))
    if len(rows[0]) * rows[0].shape[1] * columns[0].shape[1] * rows[0].shape[2] > MOST_PRODUCTS:
        raise Unsupported(f"a product of matrices of more than {MOST_PRODUCTS} products")
    (a, shared, free_left), (b, _, free_right) = rows, columns
    if a.shape[2] == 0:
        return [np.zeros((*shared, *free_left, *free_right), dtype)]
    products = do.each(lax.mul_p, {}, a[:, :, None], b[:, None])  # (batch, row, column, term)
    total = do.together(lax.add_p, along(products, 3))
    return [total.reshape((*shared, *free_left, *free_right))]


def _axes_in_order(
    array: Elements, batched: Sequence[int], summed: Sequence[int]
) -> tuple[Elements, tuple[int, ...], tuple[int, ...]]:
    """Return an array as (batch, free, summed), and the shapes of the first two."""
    free = [axis for axis in range(array.ndim) if axis not in (*batched, *summed)]
    shapes = [tuple(array.shape[axis] for axis in axes) for axes in (batched, free, summed)]
    sizes = [int(np.prod(shape)) for shape in shapes]
    return array.transpose(*batched, *free, *summed).reshape(sizes), shapes[0], shapes[1]


def _loop(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    parameters = equation.params
    body, steps = parameters["jaxpr"], parameters["length"]
    constants, carry = scan_sizes(parameters)
    common, start, read = given[:constants], given[constants : constants + carry], given[constants + carry :]
    if read or len(body.jaxpr.outvars) > carry:
        return _written_out(do, parameters, common, start, read)
    return _loop_of_numbers(do, body, common, start, steps)


def _written_out(
    do: Operations,
    parameters: Mapping[str, Any],
    common: list[Elements],
    carried: list[Elements],
    read: list[Elements],
) -> list[Elements]:
    """Return what a loop of a few steps carries in the end and what it writes at each step."""
    body, steps, reverse = (parameters[name] for name in ("jaxpr", "length", "reverse"))
    if not 0 < steps <= MOST_STEPS:
        raise Unsupported(f"a loop of {steps} steps that reads or writes something at each")
    written: list[list[Elements]] = []
    for step in reversed(range(steps)) if reverse else range(steps):
        made = results(do, body, [*common, *carried, *(array[step, ...] for array in map(objects, read))])
        carried, now = made[: len(carried)], made[len(carried) :]
        written.append([objects(array) for array in now])
    in_order = written[::-1] if reverse else written
    stacked = [np.stack(column) for column in zip(*in_order, strict=True)]
    return [*carried, *(as_array(array.reshape(-1), array.shape) for array in stacked)]


def _loop_of_numbers(
    do: Operations, body: core.ClosedJaxpr, common: list[Elements], start: list[Elements], steps: int
) -> list[Elements]:
    """Return what a loop carries in the end; it reads nothing and writes nothing step by step."""
    carried = [cast(Any, variable.aval) for variable in body.jaxpr.outvars]
    kept = body.jaxpr.invars[len(common) :]
    axes = [do.limbs.of(variable) if do.writer.lanes > 1 else None for variable in kept]

    def numbers(inside: Operations, arrays: Sequence[Elements]) -> list[Shared]:
        """Return the elements of arrays, a single one for all lanes along the limbs."""
        found: list[Shared] = []
        for array, aval, axis in zip(arrays, carried, axes, strict=True):
            if axis is None:
                some = [inside.same_for_all(element) for element in array.reshape(-1)]
            else:
                rows = np.moveaxis(objects(array), axis, -1).reshape(-1, do.writer.lanes)
                some = [inside.packed(row) for row in rows]
            found += [inside.typed(number, aval.dtype) for number in some]
        return found

    def arrays(inside: Operations, values: Sequence[Value]) -> list[Elements]:
        rest, result = iter(values), []
        for aval, axis in zip(carried, axes, strict=True):
            if axis is None:
                result.append(as_array(itertools.islice(rest, math.prod(aval.shape)), aval.shape))
                continue
            others = [size for number, size in enumerate(aval.shape) if number != axis]
            rows = []
            for value in itertools.islice(rest, math.prod(others)):
                rows.append([inside.of_lane(value, lane) for lane in range(do.writer.lanes)])
            each = as_array((element for row in rows for element in row), (*others, do.writer.lanes))
            result.append(np.moveaxis(each, -1, axis))
        return result

    def step(before: list[Value]) -> list[Shared]:
        inside = do.inside()
        return numbers(inside, results(inside, body, [*common, *arrays(inside, before)]))

    return arrays(do, do.writer.loop(steps, numbers(do, start), step))


RULES: dict[str, Rule] = {
    "reduce_sum": _reduction(lax.add_p),
    "reduce_prod": _reduction(lax.mul_p),
    "reduce_max": _reduction(lax.max_p),
    "reduce_min": _reduction(lax.min_p),
    "reduce_and": _reduction(lax.and_p),
    "reduce_or": _reduction(lax.or_p),
    "dot_general": _product_of_matrices,
    "scan": _loop,
}
