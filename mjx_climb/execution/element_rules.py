"""A traced function carried out element by element: the contents of regions and kernels.

`elements.MOVES`, and the tables below, list all that is known. Any other operation, or an unknown parameter,
raises `Unsupported`. A rule is a function of the operations, the equation and its operands.
"""

import collections
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from mjx_climb.execution.element_operations import Operations, computed_now, neutral
from mjx_climb.execution.elements import (
    MOVES,
    Elements,
    OfLane,
    Shared,
    Unsupported,
    Value,
    along,
    as_array,
    known,
    objects,
)
from mjx_climb.execution.jax_internals import inner_program, line_of, new_program, scan_sizes
from mjx_climb.execution.jax_types import Parameters, aval_of
from mjx_climb.execution.limbs import Axis
from mjx_climb.execution.simpler import MOST_PRODUCTS

MOST_ELEMENTS = 1000  # of one equation in a region: a larger one stays an array to XLA
MOST_STEPS = 64  # of a loop that is written out step by step
MOST_OF_A_TABLE = 200_000  # numbers that a loop writes
MANY_SUMS = 64  # numbers of sums that a loop carries, from which they stand in memory
MOST_WRITTEN_OUT = 1000  # equations of all steps of a loop that reads something at each
MOST_OF_BRANCHES = 100  # equations of a condition all of whose branches are computed
SHARED_BY_LANES = 8  # terms of a sum, from which lanes share a product of a matrix and a vector out
MOST_CHOICES = 64  # places of a table at which an operation may read or write

# each result element depends on one element of each operand
ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type cos cosh div eq "
    "erf_inv exp exp2 expm1 floor ge gt integer_pow is_finite le le_to log log1p log2 logistic lt lt_to max min mul ne "
    "neg nextafter not one_minus_square or pow rem round rsqrt select_n shift_left shift_right_arithmetic "
    "shift_right_logical sign sin sinh sqrt square sub tan tanh xor".split()
)
# Moves that JAX carries out on the elements' numbers, and how many operands are moved: the rest must be known.
_BY_NUMBER = {"dynamic_update_slice": 2, "pad": 2} | dict.fromkeys(
    ("dynamic_slice", "expand_dims", "gather", "rev", "split", "tile", "unstack"), 1
)
# Parameters that an operation above, a move or a rule looks at; a product of matrices has the precision of its
# elements, which is no less than any that is asked for.
_UNDERSTOOD = frozenset(
    "axes axis branches broadcast_dimensions dimension dimension_numbers dimensions ft_in ft_out jaxpr length "
    "limit_indices name new_dtype new_sizes num_carry num_consts permutation precision preferred_element_type reverse "
    "rounding_method shape start_indices strides unroll weak_type y".split()
)


def can_write(equation: core.JaxprEqn) -> bool:
    """Return whether a region writes an equation as elements: nothing that loops, is large, or calls a library."""
    name, avals = equation.primitive.name, [aval_of(atom) for atom in (*equation.invars, *equation.outvars)]
    if equation.effects or any(_is_strange(aval.dtype) for aval in avals):
        return False
    if name in ("scan", "cond"):
        inner = [equation.params["jaxpr"]] if name == "scan" else equation.params["branches"]
        every = [each for program in inner for each in program.jaxpr.eqns]
        short = _searches(equation) if name == "scan" else len(every) <= MOST_OF_BRANCHES
        return short and all(map(can_write, every))
    if not (_is_listed(name) or name in _BY_NUMBER or name == "iota"):
        return False
    products = 0
    if name == "dot_general":
        (summed, _), _ = equation.params["dimension_numbers"]
        products = math.prod(avals[0].shape[axis] for axis in summed) * avals[-1].size
    return sum(aval.size for aval in avals) <= MOST_ELEMENTS and products <= MOST_ELEMENTS


def _is_listed(name: str) -> bool:
    return name in MOVES or name in RULES or name in ELEMENTWISE


def _is_strange(dtype: np.dtype) -> bool:
    return bool(jnp.issubdtype(dtype, jax.dtypes.extended) or jnp.issubdtype(dtype, jnp.complexfloating))


def results(do: Operations, program: core.ClosedJaxpr, given: Sequence[Elements]) -> list[Elements]:
    """Return the results of a program for arrays of elements."""
    jaxpr = program.jaxpr
    values = dict(zip(jaxpr.constvars, map(np.asarray, program.consts), strict=True))
    values |= dict(zip(jaxpr.invars, given, strict=True))

    def read(atom: core.Var | core.Literal) -> Elements:
        return np.asarray(atom.val, aval_of(atom).dtype) if isinstance(atom, core.Literal) else values[atom]

    for equation in jaxpr.eqns:
        try:
            results = _equation(do, equation, [read(atom) for atom in equation.invars])
        except Unsupported as error:
            if error.equation is None and (line := line_of(equation)):
                error.args = (f"{error} ({line})",)
            error.equation = equation  # in the end the one of the whole program
            raise
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _equation(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    primitive, parameters, name = equation.primitive, equation.params, equation.primitive.name
    if equation.effects:
        raise Unsupported(f"the operation {name}, which has effects,")
    if any(_is_strange(aval_of(variable).dtype) for variable in equation.outvars):
        raise Unsupported(f"the operation {name} on complex numbers or random keys")
    if (inner := inner_program(equation)) is not None:
        return results(do, inner, given)
    if name not in MOVES and all(map(known, given)):
        return computed_now(primitive, parameters, given)
    if name in _BY_NUMBER:
        return _moved_by_number(do, equation, given)
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


def _moved_by_number(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    name, parameters = equation.primitive.name, equation.params
    tables, places = given[: _BY_NUMBER[name]], given[_BY_NUMBER[name] :]
    if not all(map(known, places)):
        return [_chosen_in_walk(do, equation, tables, places)]
    elements = [objects(table).reshape(-1) for table in tables]
    flat = np.split(np.arange(sum(map(len, elements)), dtype=np.int32), np.cumsum([*map(len, elements)])[:-1])
    numbers = [number.reshape(table.shape) for number, table in zip(flat, tables, strict=True)]
    filled = {"fill_value": -1} if "fill_value" in parameters else {}
    moved = computed_now(equation.primitive, parameters | filled, [*numbers, *places])
    if any((found < 0).any() for found in moved):
        raise Unsupported(f"the operation {name} beyond the ends of a table")
    return [np.concatenate(elements)[found, ...] for found in moved]  # arrays, of single elements too


def _chosen_in_walk(
    do: Operations, equation: core.JaxprEqn, tables: list[Elements], places: list[Elements]
) -> Elements:
    """Return the result of an operation at places that are known only in the walk, chosen among all there may be."""
    name, parameters, shape = equation.primitive.name, equation.params, aval_of(equation.outvars[0]).shape
    if name == "gather":
        [rows], numbers = places, parameters["dimension_numbers"]
        axes, sizes = numbers.start_index_map, parameters["slice_sizes"]
        inside = [1 if axis in numbers.offset_dims else size for axis, size in enumerate(shape)]
        starts = [rows[..., component].reshape(inside) for component in range(len(axes))]
    else:
        axes, starts = range(len(places)), places
        sizes = parameters.get("slice_sizes") or tables[1].shape
    counts = [tables[0].shape[axis] - sizes[axis] + 1 for axis in axes]
    if math.prod(counts) > MOST_CHOICES:
        raise Unsupported(f"the operation {name} at one of more than {MOST_CHOICES} places")

    def at(*places: int) -> list[Elements]:
        given = np.array(places, np.int32)
        return [np.broadcast_to(given, rows.shape)] if name == "gather" else list(given)

    def chosen(*fixed: int) -> Elements:
        if (component := len(fixed)) == len(counts):
            return _moved_by_number(do, equation, [*tables, *at(*fixed)])[0]
        return do.choice(starts[component], [chosen(*fixed, place) for place in range(counts[component])], shape)

    result = chosen()
    if parameters.get("mode") != lax.GatherScatterMode.FILL_OR_DROP:
        return result
    nothing = np.zeros(tables[0].shape, aval_of(equation.invars[0]).dtype)
    [filled] = computed_now(equation.primitive, parameters, [nothing, *at(*[-1] * len(counts))])
    for start, count in zip(starts, counts, strict=True):
        for compare, end in ((lax.ge_p, 0), (lax.lt_p, count)):
            within = np.broadcast_to(do.each(compare, {}, start, do.typed_like(start, end)), shape)
            result = do.each(lax.select_n_p, {}, within, filled, result)
    return result


# --- rules

Rule = Callable[[Operations, core.JaxprEqn, list[Elements]], list[Elements]]


def _reduction(combine: core.Primitive) -> Rule:
    def rule(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
        [array], axes = given, list(equation.params["axes"])
        axes.sort(key=lambda axis: (do.runs_over_lanes(given[0], axis), -axis))  # first each lane on its own
        while axes:
            gone = axes.pop(0)
            if array.shape[gone] == 0:  # a table of no pushes, the third feet of two limbs
                dtype = aval_of(equation.outvars[0]).dtype
                array = np.full(np.delete(array.shape, gone), neutral(combine, dtype), dtype)
            else:
                array = do.together(combine, along(array, gone))
            axes = [axis - (axis > gone) for axis in axes]
        return [array]

    return rule


def _product_of_matrices(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    result, matrices = aval_of(equation.outvars[0]), []
    for array, summed, batched in zip(given, *equation.params["dimension_numbers"], strict=True):
        free = [axis for axis in range(array.ndim) if axis not in (*batched, *summed)]
        sizes = [math.prod(array.shape[axis] for axis in axes) for axes in (batched, free, summed)]
        matrices.append(do.converted(array, result.dtype).transpose(*batched, *free, *summed).reshape(sizes))
    left, right = matrices
    if result.size * left.shape[2] > MOST_PRODUCTS:
        raise Unsupported(f"a product of matrices of more than {MOST_PRODUCTS} products")
    if left.shape[2] == 0:
        return [np.zeros(result.shape, result.dtype)]
    for one, other in ((0, 1), (1, 0)):  # the other is a vector
        if len(left) == 1 and matrices[other].shape[1] == 1 and left.shape[2] >= SHARED_BY_LANES:
            if (found := _in_lanes(do, matrices[one][0], matrices[other][0, 0])) is not None:
                return [found.reshape(result.shape)]
    products = do.each(lax.mul_p, {}, left[:, :, None], right[:, None])  # (batch, row, column, term)
    return [do.together(lax.add_p, along(products, 3)).reshape(result.shape)]


def _in_lanes(do: Operations, matrix: Elements, vector: Elements) -> Elements | None:
    """Return a matrix times a vector, the products shared out among the lanes; None where that would not be less.

    If the vector's elements are the lanes', each multiplies the columns of its own. If all lanes have the vector, each
    multiplies as many rows as the others.
    """
    lanes, own = do.writer.lanes, [element.lane if isinstance(element, OfLane) else None for element in objects(vector)]
    columns = [[place for place, lane in enumerate(own) if lane == each] for each in range(lanes)]
    if lanes > 1 and None not in own and len({*map(len, columns)}) == 1:
        groups = [list(group) for group in zip(*columns, strict=True)]  # a column of each lane
        if (mine := _packed(do, [[row[group] for group in groups] for row in objects(matrix)])) is None:
            return None
        parts = [do.packed(vector[group]) for group in groups]
        sums = (cast(Value, _sum_of_products(do, row, parts)) for row in mine)
        return as_array((do.total(lax.add_p, each) for each in sums), [len(matrix)])
    if lanes > 1 and len(matrix) % lanes == 0 and own.count(None) == len(own):
        rows = objects(matrix).reshape(lanes, -1, len(vector))
        if (mine := _packed(do, [list(np.moveaxis(rows[:, place], 1, 0)) for place in range(rows.shape[1])])) is None:
            return None
        found = [_sum_of_products(do, row, [*vector]) for row in mine]
        return do.taken_apart(found, [lanes, len(found)], 0).reshape(len(matrix))
    return None


def _packed(do: Operations, rows: Sequence[Sequence[np.ndarray]]) -> list[list[Shared]] | None:
    """Return values that give each lane its number, of the numbers of all lanes; None where that takes operations."""
    return [[*map(do.packed, row)] for row in rows] if all(do.writer.packs([*g]) for row in rows for g in row) else None


def _sum_of_products(do: Operations, left: Sequence[Shared], right: Sequence[Shared]) -> Shared:
    products = (do.alike(lax.mul_p, {}, *both) for both in zip(left, right, strict=True))
    return functools.reduce(functools.partial(do.alike, lax.add_p, {}), products)


def _named(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    """Return an array as lanes where a function says that its first axis runs over them."""
    [array], [variable] = given, equation.outvars
    axis = do.limbs.of(variable) if do.writer.lanes > 1 else None
    if axis is None or known(array) or do.runs_over_lanes(array, axis):
        return given
    aval = aval_of(variable)
    return [do.taken_apart(do.put_together(array, aval.dtype, axis), aval.shape, axis)]


def _loop(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    constants, carry = scan_sizes(equation.params)
    common, start, read = given[:constants], given[constants : constants + carry], given[constants + carry :]
    body = equation.params["jaxpr"]
    steps, wide = equation.params["length"], len(read) + len(body.jaxpr.outvars) > carry
    few = steps <= MOST_STEPS and steps * len(body.jaxpr.eqns) <= MOST_WRITTEN_OUT
    if _searches(equation) or (wide and few and not _loops(body)):
        return _written_out(do, equation.params, common, start, read)
    if steps * sum(aval_of(variable).size for variable in body.jaxpr.outvars[carry:]) > MOST_OF_A_TABLE:
        raise Unsupported(f"a loop that writes more than {MOST_OF_A_TABLE} numbers")
    avals = [aval_of(variable) for variable in body.jaxpr.outvars]
    axes = [do.limbs.of(variable) for variable in body.jaxpr.invars[constants:]]
    body, sums = _with_addends(body, range(constants, constants + carry)) if do.writer.sums else (body, set())
    carried = [place for place in range(carry) if place not in sums]
    carry_of = _Shapes([avals[place] for place in carried], [axes[place] for place in carried])
    written_of = _Shapes(avals[carry:], [do.limbs.of(variable) for variable in body.jaxpr.outvars[carry:]])
    # numbers that a loop has written keep their lanes, an argument's are the same for all
    own = [
        axis if axis is not None and do.runs_over_lanes(array, axis + 1) else None
        for array, axis in zip(read, axes[carry:], strict=True)
    ]
    read_of = _Shapes([aval_of(variable) for variable in body.jaxpr.invars[constants + carry :]], own)
    each = [*map(objects, read)]
    rows = [read_of.numbers(do, [array[step, ...] for array in each]) for step in range(steps)]
    rows = rows[::-1] if equation.params["reverse"] else rows
    totals: dict[int, Elements] = {}

    def step(before: list[Value], now: list[Value]) -> list[Shared]:
        inside = Operations(do.writer, do.limbs, do.done)  # knows the operations before the loop
        begun = dict(enumerate(start)) | dict(zip(carried, carry_of.arrays(inside, before), strict=True))
        made = results(inside, body, [*common, *begun.values(), *read_of.arrays(inside, now)])
        totals.update((place, _summed(inside, made[place])) for place in sums)
        kept = carry_of.numbers(inside, [made[place] for place in carried])
        return [*kept, *written_of.numbers(inside, made[carry:])]

    columns = list(zip(*rows, strict=True)) if read else []
    ended, kept = do.writer.loop(steps, carry_of.numbers(do, [start[place] for place in carried]), columns, step)
    after = dict(enumerate(start)) | dict(zip(carried, carry_of.arrays(do, ended), strict=True))
    after |= {place: do.each(lax.add_p, {}, start[place], total) for place, total in totals.items()}
    order = slice(None, None, -1 if equation.params["reverse"] else 1)
    at_steps = [written_of.arrays(do, list(now)) for now in zip(*kept, strict=True)][order]
    stacked = [np.stack([*map(objects, column)]) for column in zip(*at_steps, strict=True)]
    return [*after.values(), *stacked]


def _with_addends(body: core.ClosedJaxpr, carry: range) -> tuple[core.ClosedJaxpr, set[int]]:
    """Return the step of a loop with addends in place of carried sums, and which these are, where there are many.

    A sum is read by its own addition alone.
    """
    jaxpr = body.jaxpr
    read = collections.Counter(id(atom) for equation in jaxpr.eqns for atom in equation.invars)
    read.update(map(id, jaxpr.outvars))
    additions = {id(e.outvars[0]): e for e in jaxpr.eqns if e.primitive.name in ("add", "add_any")}
    found: dict[int, core.JaxprEqn] = {}
    for place, (before, after) in enumerate(zip(jaxpr.invars[carry.start : carry.stop], jaxpr.outvars, strict=False)):
        made = additions.get(id(after))
        if made is None or not read[id(before)] == read[id(after)] == 1 or aval_of(after).dtype != np.float32:
            continue
        if any(atom is before for atom in made.invars):
            found[place] = made
    if sum(aval_of(made.outvars[0]).size for made in found.values()) < MANY_SUMS:
        return body, set()
    outputs = list(jaxpr.outvars)
    for place, made in found.items():
        [outputs[place]] = [atom for atom in made.invars if atom is not jaxpr.invars[carry[place]]]
    gone = set(map(id, found.values()))
    left = [equation for equation in jaxpr.eqns if id(equation) not in gone]
    constants = list(zip(jaxpr.constvars, body.consts, strict=True))
    return new_program(jaxpr, left, jaxpr.invars, outputs, constants), set(found)


def _summed(do: Operations, addends: Elements) -> Elements:
    """Return sums over the steps of a loop, a share of them in each lane: those of one value's lanes are together."""
    lanes, elements = do.writer.lanes, objects(addends).reshape(-1)
    parts: dict[int, dict[int, int]] = collections.defaultdict(dict)  # places by value and lane
    for place, element in enumerate(elements):
        if isinstance(element, OfLane):
            parts[id(element.value)].setdefault(element.lane, place)
    groups = [[places[lane] for lane in range(lanes)] for places in parts.values() if len(places) == lanes]
    together = set(itertools.chain.from_iterable(groups))
    rest = [p for p, element in enumerate(elements) if p not in together and not _is_zero(element)]
    groups += [rest[first : first + lanes] for first in range(0, len(rest), lanes)]
    each = [[elements[place] for place in (group * lanes)[:lanes]] for group in groups]
    totals = elements.copy()
    for total, group in zip(do.writer.summed(lambda: [do.packed(row) for row in each]), groups, strict=True):
        for lane, place in enumerate(group):
            totals[place] = do.of_lane(total, lane) if lanes > 1 else total
    return as_array(totals, addends.shape)


def _is_zero(element: object) -> bool:
    return isinstance(element, np.generic) and element == 0


class _Shapes(NamedTuple):
    """Arrays that variables of a kernel hold."""

    avals: Sequence[jax.ShapeDtypeStruct]
    axes: Sequence[Axis]  # of each, which runs over the limbs

    def numbers(self, do: Operations, arrays: Sequence[Elements]) -> list[Shared]:
        """Return the elements of arrays as numbers of all lanes."""
        each = zip(arrays, self.avals, self.axes, strict=True)
        return [
            number
            for array, aval, axis in each
            for number in do.put_together(array, aval.dtype, axis if do.writer.lanes > 1 else None)
        ]

    def arrays(self, do: Operations, values: Sequence[Value]) -> list[Elements]:
        """Return arrays of the values that `numbers` would give."""
        rest, result = iter(values), []
        for aval, of_limbs in zip(self.avals, self.axes, strict=True):
            axis = of_limbs if do.writer.lanes > 1 else None
            count = math.prod(size for number, size in enumerate(aval.shape) if number != axis)
            result.append(do.taken_apart(itertools.islice(rest, count), aval.shape, axis))
        return result


def _searches(loop: core.JaxprEqn) -> bool:
    """Return whether a loop is like a search in a table: of few steps, it carries places alone."""
    avals = [aval_of(variable) for variable in loop.outvars]
    return bool(avals) and loop.params["length"] <= MOST_STEPS and all(aval.dtype.kind in "iub" for aval in avals)


def _condition(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    """Return the results of the branch that is taken: all are computed, as under `jax.vmap`, but for long ones.

    A long one is computed where a robot takes it that shares its threads' way.
    """
    which, *operands = given
    branches = equation.params["branches"]
    if len(branches) == 2 and not known(which) and _is_long(branches[1]):
        return _branched(do, equation, which, operands)
    made = [results(do, branch, operands) for branch in branches]
    shapes = [aval_of(variable).shape for variable in equation.outvars]
    return [do.choice(which, cases, shape) for *cases, shape in zip(*made, shapes, strict=True)]


def _branched(do: Operations, equation: core.JaxprEqn, which: Elements, operands: list[Elements]) -> list[Elements]:
    """Return the results of the second of two branches where it is taken."""
    otherwise, long = equation.params["branches"]
    made_of = _Shapes([aval_of(v) for v in equation.outvars], [do.limbs.of(v) for v in equation.outvars])

    def make() -> list[Shared]:
        inside = Operations(do.writer, do.limbs, do.done)  # knows the operations before the branch
        return made_of.numbers(inside, results(inside, long, operands))

    [taken] = do.put_together(which, np.dtype(bool), None)
    before = made_of.numbers(do, results(do, otherwise, operands))
    return made_of.arrays(do, do.writer.branch(taken, before, make))


def _is_long(program: core.ClosedJaxpr) -> bool:
    """Return whether a branch is too long to be computed by all robots."""
    return _loops(program) or len(program.jaxpr.eqns) > MOST_OF_BRANCHES


def _loops(program: core.ClosedJaxpr) -> bool:
    """Return whether a program has a loop that is not written out as a search is."""
    return any(equation.primitive.name == "scan" and not _searches(equation) for equation in program.jaxpr.eqns)


def _written_out(
    do: Operations, loop: Parameters, common: list[Elements], carried: list[Elements], read: list[Elements]
) -> list[Elements]:
    """Return the last carry of a short loop and its records at each step."""
    steps = loop["length"]
    if not steps:
        raise Unsupported("a loop of no steps that reads or writes something at each")
    order = slice(None, None, -1 if loop["reverse"] else 1)
    written: list[list[Elements]] = []
    for step in range(steps)[order]:
        made = results(do, loop["jaxpr"], [*common, *carried, *(array[step, ...] for array in map(objects, read))])
        carried, now = made[: len(carried)], made[len(carried) :]
        written.append([*map(objects, now)])
    stacked = [np.stack(column) for column in zip(*written[order], strict=True)]
    return [*carried, *(as_array(array.reshape(-1), array.shape) for array in stacked)]


RULES: dict[str, Rule] = {
    "reduce_sum": _reduction(lax.add_p),
    "reduce_prod": _reduction(lax.mul_p),
    "reduce_max": _reduction(lax.max_p),
    "reduce_min": _reduction(lax.min_p),
    "reduce_and": _reduction(lax.and_p),
    "reduce_or": _reduction(lax.or_p),
    "dot_general": _product_of_matrices,
    "cond": _condition,
    "name": _named,
    "scan": _loop,
}
