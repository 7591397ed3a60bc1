"""Operations that are neither elementwise nor moves, written out for single elements: sums, loops, choices by number.

A rule is a function of the operations, the equation and its operands. A table read or written at a place that differs
from robot to robot has no address: every place is compared with the wanted one, so tables must be small.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core
from jax.extend import random as random_kinds

from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.elements import Element, Elements, Key, Number, Value, along, as_array, flat, known, objects
from mjx_climb.execution.jax_internals import scan_sizes
from mjx_climb.execution.unsupported import Unsupported

Rule = Callable[[Operations, core.JaxprEqn, list[Elements]], list[Elements]]

MOST_PLACES = 64  # of a table that is read or written by number
MOST_PRODUCTS = 4096  # of a product of matrices
MOST_STEPS = 64  # of a loop that reads or writes something at each


def _reduction(combine: core.Primitive) -> Rule:
    def rule(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
        [array], axes = given, list(equation.params["axes"])
        axes.sort(key=lambda axis: (do.runs_over_lanes(given[0], axis), -axis))  # first what a lane does on its own
        while axes:
            gone = axes.pop(0)
            if array.shape[gone] == 0 and combine in (lax.add_p, lax.or_p):  # an empty table of pushes, say
                array = np.zeros(np.delete(array.shape, gone), _dtype_of(equation))
            else:
                array = do.together(combine, _some(along(array, gone), equation))
            axes = [axis - (axis > gone) for axis in axes]
        return [array]

    return rule


def _cumulative(combine: core.Primitive) -> Rule:
    def rule(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
        axis, reverse = equation.params["axis"], equation.params["reverse"]
        parts = _some(along(given[0], axis), equation)
        steps = parts[::-1] if reverse else parts
        totals = list(itertools.accumulate(steps, lambda total, part: do.each(combine, {}, total, part)))
        return [np.stack([*map(objects, totals[::-1] if reverse else totals)], axis)]

    return rule


def _extreme_place(better: core.Primitive) -> Rule:
    """Return the rule for where the first extreme is; the first NaN counts as one."""

    def rule(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
        [axis], dtype = equation.params["axes"], np.dtype(equation.params["index_dtype"])
        best, *others = _some(along(given[0], axis), equation)
        place: Elements = np.zeros(best.shape, dtype)
        for number, other in enumerate(others, 1):
            is_nan, was_nan = (do.each(lax.ne_p, {}, value, value) for value in (other, best))
            taken = do.each(lax.or_p, {}, do.each(better, {}, other, best), is_nan)
            taken = do.each(lax.and_p, {}, taken, do.each(lax.not_p, {}, was_nan))
            best = do.each(lax.select_n_p, {}, taken, best, other)
            place = do.each(lax.select_n_p, {}, taken, place, np.asarray(number, dtype))
        return [place]

    return rule


def _dtype_of(equation: core.JaxprEqn) -> Any:
    return cast(Any, equation.outvars[0].aval).dtype


def _some(parts: list[Elements], equation: core.JaxprEqn) -> list[Elements]:
    if not parts:
        raise Unsupported(f"the operation {equation.primitive.name} over no elements")
    return parts


def _product_of_matrices(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    (summed, batched) = equation.params["dimension_numbers"]
    dtype = cast(Any, equation.outvars[0].aval).dtype
    left, right = (_as(do, array, dtype) for array in given)
    rows, columns = (_axes_in_order(a, both, s) for a, both, s in zip((left, right), batched, summed, strict=True))
    if len(rows[0]) * rows[0].shape[1] * columns[0].shape[1] * rows[0].shape[2] > MOST_PRODUCTS:
        raise Unsupported(f"a product of matrices of more than {MOST_PRODUCTS} products")
    (a, shared, free_left), (b, _, free_right) = rows, columns
    if a.shape[2] == 0:
        return [np.zeros((*shared, *free_left, *free_right), dtype)]
    products = do.each(lax.mul_p, {}, a[:, :, None], b[:, None])  # (batch, row, column, term)
    total = do.together(lax.add_p, _some(along(products, 3), equation))
    return [total.reshape((*shared, *free_left, *free_right))]


def _axes_in_order(
    array: Elements, batched: Sequence[int], summed: Sequence[int]
) -> tuple[Elements, tuple[int, ...], tuple[int, ...]]:
    """Return an array as (batch, free, summed), and the shapes of the first two."""
    free = [axis for axis in range(array.ndim) if axis not in (*batched, *summed)]
    shapes = [tuple(array.shape[axis] for axis in axes) for axes in (batched, free, summed)]
    sizes = [int(np.prod(shape)) for shape in shapes]
    return array.transpose(*batched, *free, *summed).reshape(sizes), shapes[0], shapes[1]


def _as(do: Operations, array: Elements, dtype: Any) -> Elements:
    if known(array):
        return array.astype(dtype)
    converted = {"new_dtype": np.dtype(dtype), "weak_type": False, "sharding": None}
    types = {element.dtype for element in array.reshape(-1)}
    return array if types == {np.dtype(dtype)} else do.each(lax.convert_element_type_p, converted, array)


# --- places that are known only in the walk


def _places(
    do: Operations, start: Sequence[Element], last: Sequence[int]
) -> Iterator[tuple[tuple[int, ...], Element | None]]:
    """Give every place from 0 to `last` along each axis that `start`, clamped, can be, and whether it is that one.

    None stands for the one place that there can be.
    """
    choices: list[list[int]] = []
    for number, most in zip(start, last, strict=True):
        choices.append([min(max(int(number), 0), most)] if isinstance(number, np.generic) else list(range(most + 1)))
    if np.prod([len(choice) for choice in choices]) > MOST_PLACES:
        raise Unsupported(f"a table read or written by number, with more than {MOST_PLACES} places")
    for place in itertools.product(*choices):
        found: Element | None = None
        for number, choice, most, here in zip(start, choices, last, place, strict=True):
            if len(choice) == 1:
                continue
            # the first and the last place also stand for what is beyond them
            compare = lax.le_p if here == 0 else lax.ge_p if here == most else lax.eq_p
            fits = do.element(compare, {}, number, _number(here, number))
            found = fits if found is None else do.element(lax.and_p, {}, found, fits)
        yield place, found


def _number(value: Any, like: Element) -> Element:
    return cast(Element, np.asarray(value, cast(Number, like).dtype)[()])


def _read(do: Operations, table: Elements, start: Sequence[Element], sizes: Sequence[int]) -> Elements:
    last = [whole - size for whole, size in zip(table.shape, sizes, strict=True)]
    result: Elements | None = None
    for place, found in _places(do, start, last):
        part = table[tuple(slice(p, p + size) for p, size in zip(place, sizes, strict=True))]
        if result is None or found is None:
            result = part
        else:
            result = do.each(lax.select_n_p, {}, as_array(iter([found]), ()), result, part)
    assert result is not None
    return result


def _dynamic_slice(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    table, *start = given
    return [_read(do, table, flat(start), equation.params["slice_sizes"])]


def _dynamic_update_slice(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    table, update, *start = given
    last = [whole - size for whole, size in zip(table.shape, update.shape, strict=True)]
    result = objects(table)
    for place, found in _places(do, flat(start), last):
        at = tuple(slice(p, p + size) for p, size in zip(place, update.shape, strict=True))
        if found is None:
            result[at] = objects(update)
        else:
            which = as_array(iter([found]), ())
            result[at] = objects(do.each(lax.select_n_p, {}, which, result[at], update))
    return [as_array(iter(result.reshape(-1)), table.shape)]


def _gather(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    table, indices = given
    parameters = equation.params
    numbers, sizes, mode = parameters["dimension_numbers"], parameters["slice_sizes"], parameters["mode"]
    aval: Any = equation.outvars[0].aval
    result = np.empty(aval.shape, object)
    shared = [axis for axis in range(result.ndim) if axis not in numbers.offset_dims]
    gone = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    for which in np.ndindex(*indices.shape[:-1]):
        start: list[Element] = [cast(np.generic, np.int32(0))] * table.ndim
        for number, axis in enumerate(numbers.start_index_map):
            start[axis] = indices[(*which, number)]
        for axis, place in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
            start[axis] = cast(np.generic, np.int32(which[place]))
        part = _read(do, table, start, sizes)
        if mode == lax.GatherScatterMode.FILL_OR_DROP:
            last = [whole - size for whole, size in zip(table.shape, sizes, strict=True)]
            inside = _inside(do, start, last)
            fill = np.asarray(_fill(parameters["fill_value"], aval.dtype), aval.dtype)
            part = do.each(lax.select_n_p, {}, inside, fill, part)
        elif mode not in (lax.GatherScatterMode.CLIP, lax.GatherScatterMode.PROMISE_IN_BOUNDS):
            raise Unsupported(f"the operation gather with mode={mode}")
        at: list[Any] = [slice(None)] * result.ndim
        for axis, place in zip(shared, which, strict=True):
            at[axis] = place
        result[(*at, ...)] = objects(part.reshape([n for axis, n in enumerate(part.shape) if axis not in gone]))
    return [as_array(iter(result.reshape(-1)), result.shape)]


def _inside(do: Operations, start: Sequence[Element], last: Sequence[int]) -> Elements:
    """Return whether a place is one of the table's."""
    inside: Element = cast(np.generic, np.bool_(True))
    for number, most in zip(start, last, strict=True):
        for compare, bound in ((lax.ge_p, 0), (lax.le_p, most)):
            inside = do.element(lax.and_p, {}, inside, do.element(compare, {}, number, _number(bound, number)))
    return as_array(iter([inside]), ())


def _fill(value: Any, dtype: Any) -> Any:
    """Return what stands for the elements of no place, by JAX's rule."""
    if value is not None:
        return value
    if jnp.issubdtype(dtype, jnp.inexact):
        return jnp.nan
    if dtype == np.bool_:
        return True
    limits = jnp.iinfo(dtype)
    return limits.min if jnp.issubdtype(dtype, jnp.signedinteger) else limits.max


# --- control flow


def _choice(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    """Return the results of the branch that is taken; where that differs from robot to robot, of all of them."""
    which, *operands = given
    branches = equation.params["branches"]
    if known(which):
        return do.closed(branches[min(max(int(which), 0), len(branches) - 1)], operands)
    results = [do.closed(branch, operands) for branch in branches]
    number = _as(do, which, np.int32)
    return [_select(do, number, cases) for cases in zip(*results, strict=True)]


def _select(do: Operations, which: Elements, cases: Sequence[Elements]) -> Elements:
    chosen = cases[0]
    for number, case in enumerate(cases[1:], 1):
        later = do.each(lax.ge_p, {}, which, np.asarray(number, np.int32))
        chosen = do.each(lax.select_n_p, {}, later, chosen, case)
    return chosen


def _loop(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    parameters = equation.params
    body, steps = parameters["jaxpr"], parameters["length"]
    constants, carry = scan_sizes(parameters)
    common, start, read = given[:constants], given[constants : constants + carry], given[constants + carry :]
    if read or len(body.jaxpr.outvars) > carry:
        return _written_out(do, body, common, start, read, steps, reverse=parameters["reverse"])
    return _loop_of_numbers(do, body, common, start, steps)


def _written_out(
    do: Operations,
    body: core.ClosedJaxpr,
    common: list[Elements],
    carried: list[Elements],
    read: list[Elements],
    steps: int,
    *,
    reverse: bool,
) -> list[Elements]:
    """Return what a loop of a few steps carries in the end and what it writes at each step."""
    if not 0 < steps <= MOST_STEPS:
        raise Unsupported(f"a loop of {steps} steps that reads or writes something at each")
    written: list[list[Elements]] = []
    for step in reversed(range(steps)) if reverse else range(steps):
        results = do.closed(body, [*common, *carried, *(array[step, ...] for array in map(objects, read))])
        carried, now = results[: len(carried)], results[len(carried) :]
        written.append([objects(array) for array in now])
    in_order = written[::-1] if reverse else written
    stacked = [np.stack(column) for column in zip(*in_order, strict=True)]
    return [*carried, *(as_array(iter(array.reshape(-1)), array.shape) for array in stacked)]


def _loop_of_numbers(
    do: Operations, body: core.ClosedJaxpr, common: list[Elements], start: list[Elements], steps: int
) -> list[Elements]:
    """Return what a loop carries in the end; it reads nothing and writes nothing step by step."""
    carried = [cast(Any, variable.aval) for variable in body.jaxpr.outvars]
    if any(jnp.issubdtype(aval.dtype, jax.dtypes.extended) for aval in carried):
        raise Unsupported("a loop that carries random keys, other than as plain words,")
    kept = body.jaxpr.invars[len(common) :]
    axes = [do.limbs.of(variable) if do.writer.lanes > 1 else None for variable in kept]

    def numbers(inside: Operations, arrays: Sequence[Elements]) -> list[Number]:
        """Return the elements of arrays, a single one for all lanes along the limbs."""
        found: list[Number] = []
        for array, aval, axis in zip(arrays, carried, axes, strict=True):
            if axis is None:
                some = [inside.same_for_all(cast(Number, element)) for element in flat([array])]
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

    def step(before: list[Value]) -> list[Number]:
        inside = do.inside()
        return numbers(inside, inside.closed(body, [*common, *arrays(inside, before)]))

    return arrays(do, do.writer.loop(steps, numbers(do, start), step))


# --- random numbers

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def _threefry(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    """Return Threefry-2x32 with 20 rounds (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, 2011)."""

    def word(value: int) -> Elements:
        return np.asarray(value, np.uint32)

    def add(a: Elements, b: Elements) -> Elements:
        return do.each(lax.add_p, {}, a, b)

    def xor(a: Elements, b: Elements) -> Elements:
        return do.each(lax.xor_p, {}, a, b)

    first, second, x, y = given
    keys = [first, second, xor(xor(first, second), word(_PARITY))]
    x, y = add(x, first), add(y, second)
    for turn in range(5):
        for bits in _ROTATIONS[turn % 2]:
            x = add(x, y)
            high = do.each(lax.shift_left_p, {}, y, word(bits))
            low = do.each(lax.shift_right_logical_p, {}, y, word(32 - bits))
            y = xor(x, do.each(lax.or_p, {}, high, low))
        x = add(x, keys[(turn + 1) % 3])
        y = add(add(y, keys[(turn + 2) % 3]), word(turn + 1))
    return [x, y]


def _wrapped(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    _refuse_other_kinds(equation.outvars[0])
    return [_keys_of(given[0])]


def _keys_of(words: Elements) -> Elements:
    """Return random keys from their words (..., 2)."""
    pairs = words.reshape(-1, 2)
    return as_array((Key(high, low) for high, low in pairs), words.shape[:-1])


def _words_of(keys: Elements) -> Elements:
    """Return the words (..., 2) of random keys."""
    return as_array((word for key in keys.reshape(-1) for word in (key.high, key.low)), (*keys.shape, 2))


def _unwrapped(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    return [_words_of(given[0])]


def _same(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    return given


def _of_each_key(function: Callable[..., Array]) -> Rule:
    """Return the rule for a function of a key's words, a number beside each key, and the operation's parameters."""

    def rule(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
        _refuse_other_kinds(equation.invars[0])
        keys, *others = given
        wide = [np.broadcast_to(objects(other), keys.shape) for other in others]
        results = []
        for place in np.ndindex(*keys.shape):
            key, *beside = (cast(Element, array[place]) for array in (keys, *wide))
            operands = [_words_of(as_array(iter([key]), ())), *(as_array(iter([number]), ()) for number in beside)]
            results.append(objects(_traced(do, function, equation, operands)))
        made = np.stack(results).reshape(*keys.shape, *results[0].shape)
        made = as_array(iter(made.reshape(-1)), made.shape)
        return [_keys_of(made) if equation.primitive.name in ("random_split", "random_fold_in") else made]

    return rule


def _seeded(do: Operations, equation: core.JaxprEqn, given: list[Elements]) -> list[Elements]:
    _refuse_other_kinds(equation.outvars[0])
    seeds = [as_array(iter([seed]), ()) for seed in objects(given[0]).reshape(-1)]
    words = [objects(_traced(do, lambda seed, impl: _THREEFRY.seed(seed), equation, [seed])) for seed in seeds]
    made = np.stack(words).reshape(*given[0].shape, 2)
    return [_keys_of(as_array(iter(made.reshape(-1)), made.shape))]


def _traced(
    do: Operations, function: Callable[..., Array], equation: core.JaxprEqn, operands: list[Elements]
) -> Elements:
    kinds = [jax.ShapeDtypeStruct(array.shape, _dtype(array)) for array in operands]
    program = jax.make_jaxpr(functools.partial(function, **equation.params))(*kinds)
    return do.closed(program, operands)[0]


def _dtype(array: Elements) -> Any:
    return array.dtype if known(array) else np.dtype(array.reshape(-1)[0].dtype)


def _refuse_other_kinds(atom: core.Var | core.Literal) -> None:
    kind = str(cast(Any, atom.aval).dtype)
    if kind != "key<fry>":
        raise Unsupported(f"random numbers from {kind}")


_THREEFRY = random_kinds.threefry_prng_impl

# with the parameters that are looked at
RULES: dict[str, tuple[Rule, frozenset[str]]] = {
    "reduce_sum": (_reduction(lax.add_p), frozenset({"axes"})),
    "reduce_prod": (_reduction(lax.mul_p), frozenset({"axes"})),
    "reduce_max": (_reduction(lax.max_p), frozenset({"axes"})),
    "reduce_min": (_reduction(lax.min_p), frozenset({"axes"})),
    "reduce_and": (_reduction(lax.and_p), frozenset({"axes"})),
    "reduce_or": (_reduction(lax.or_p), frozenset({"axes"})),
    "reduce_xor": (_reduction(lax.xor_p), frozenset({"axes"})),
    "cumsum": (_cumulative(lax.add_p), frozenset({"axis", "reverse"})),
    "cumprod": (_cumulative(lax.mul_p), frozenset({"axis", "reverse"})),
    "cummax": (_cumulative(lax.max_p), frozenset({"axis", "reverse"})),
    "cummin": (_cumulative(lax.min_p), frozenset({"axis", "reverse"})),
    "argmax": (_extreme_place(lax.gt_p), frozenset({"axes", "index_dtype"})),
    "argmin": (_extreme_place(lax.lt_p), frozenset({"axes", "index_dtype"})),
    # elements are multiplied in their own precision, which is no less than any that is asked for
    "dot_general": (_product_of_matrices, frozenset({"dimension_numbers", "precision", "preferred_element_type"})),
    "dynamic_slice": (_dynamic_slice, frozenset({"slice_sizes"})),
    "dynamic_update_slice": (_dynamic_update_slice, frozenset()),
    "gather": (
        _gather,
        # the rest are promises of the caller
        frozenset({"dimension_numbers", "slice_sizes", "mode", "fill_value", "unique_indices", "indices_are_sorted"}),
    ),
    "cond": (_choice, frozenset({"branches"})),
    "scan": (
        _loop,
        frozenset({"jaxpr", "length", "num_consts", "num_carry", "ft_in", "ft_out", "reverse", "unroll"}),
    ),
    "threefry2x32": (_threefry, frozenset()),
    "random_seed": (_seeded, frozenset({"impl"})),
    "random_wrap": (_wrapped, frozenset({"impl"})),
    "random_unwrap": (_unwrapped, frozenset()),
    "random_clone": (_same, frozenset()),
    "random_bits": (_of_each_key(_THREEFRY.random_bits), frozenset({"bit_width", "shape"})),
    "random_split": (_of_each_key(_THREEFRY.split), frozenset({"shape"})),
    "random_fold_in": (_of_each_key(_THREEFRY.fold_in), frozenset()),
}
