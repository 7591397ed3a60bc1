"""Operations of JAX's made of simpler ones, which rows and kernels know: small arrays are taken apart and written out.

A rule is a function of an equation's parameters and operands to its results, of arrays of JAX's. Decisions are
comparisons and choices alone, so that the derivative of the simpler program is that of the case that is taken.

References:
    E. Anderson et al., LAPACK Users' Guide, third edition, 1999: pivots of `lu`, signs of `qr`.
"""

import itertools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from mjx_climb.execution.jax_types import Parameters, aval_of

MOST_IN_ORDER = 24  # numbers that are sorted
MOST_CASES = 2048  # numbers that a scatter chooses, or products of a convolution
MOST_PRODUCTS_OF_LU_AND_QR = 6**3  # of three sizes of a matrix
# The same in a Cholesky factor, a triangular solve, a product of matrices: the inertia of a robot of twelve joints.
# jaxlib 0.10's LAPACK shares a batch among XLA's threads and waits on one of them: two calls at once never end.
MOST_PRODUCTS = 18**3

Rule = Callable[..., list[Array]]
Matrix = list[list[Array]]


def simpler(equation: core.JaxprEqn, *, differentiated: bool) -> core.ClosedJaxpr | None:
    """Return an operation as a program of simpler ones, None where it has no rule or is too large.

    Arguments:
        equation: of a traced program.
        differentiated: whether the derivative is taken of the simpler program; JAX's own rules are better for matrices.
    """
    if (rule := rule_of(equation, differentiated=differentiated)) is None:
        return None
    given = [jax.ShapeDtypeStruct(aval_of(atom).shape, aval_of(atom).dtype) for atom in equation.invars]

    def written(*operands: Array) -> list[Array]:
        made = rule(equation.params, *operands)
        return [each.astype(aval_of(v).dtype) for each, v in zip(made, equation.outvars, strict=True)]

    with jax.default_matmul_precision("highest"):
        return jax.make_jaxpr(written)(*given)


def rule_of(equation: core.JaxprEqn, *, differentiated: bool) -> Rule | None:
    """Return the rule by which `simpler` returns a program, None where it returns none."""
    name = equation.primitive.name
    rule = _CHOICES.get(name) or (None if differentiated else _MATRICES.get(name))
    return rule if rule is not None and _is_small(equation) else None


def _is_small(equation: core.JaxprEqn) -> bool:
    avals = [aval_of(atom) for atom in (*equation.invars, *equation.outvars)]
    name, first, last = equation.primitive.name, avals[0], avals[-1]
    if any(jnp.issubdtype(aval.dtype, jnp.complexfloating) for aval in avals) or not first.size:
        return False
    if name in ("sort", "top_k"):
        axis = equation.params.get("dimension", equation.params.get("axis", len(first.shape) - 1))
        return bool(first.shape[axis] <= MOST_IN_ORDER and first.size <= 4 * MOST_IN_ORDER)
    if name.startswith("scatter"):
        plain = name != "scatter" or equation.params["update_jaxpr"] is None
        return bool(plain and first.size * avals[2].size <= MOST_CASES)
    if name == "conv_general_dilated":
        groups = equation.params["feature_group_count"] * equation.params["batch_group_count"]
        return bool(groups == 1 and last.size * avals[1].size <= MOST_CASES)
    if name in ("lu", "qr", "cholesky", "triangular_solve"):
        pivoting = equation.params.get("pivoting", False)
        most = MOST_PRODUCTS if name in ("cholesky", "triangular_solve") else MOST_PRODUCTS_OF_LU_AND_QR
        return bool(not pivoting and first.size * max(aval.shape[-1] for aval in avals) <= most)
    return bool(first.size <= MOST_CASES)


# --- order


def _parts(array: Array, axis: int) -> list[Array]:
    """Return an array's parts along an axis, without it."""
    return [lax.index_in_dim(array, place, axis, keepdims=False) for place in range(array.shape[axis])]


def _stacked(parts: Sequence[Array], axis: int) -> Array:
    return lax.concatenate([lax.expand_dims(part, (axis,)) for part in parts], axis)


def _is_real(array: Array) -> bool:
    return bool(jnp.issubdtype(array.dtype, jnp.floating))


def _is_after(a: Array, b: Array) -> Array:
    """Return whether a number belongs behind another in rising order; not-a-numbers are last."""
    return ~(a <= b) & (b == b) if _is_real(a) else a > b


def _is_less(a: Array, b: Array) -> Array:
    """Return whether a number belongs behind another in falling order; not-a-numbers are first."""
    return ~(a >= b) & (a == a) if _is_real(a) else a < b


def _is_same(a: Array, b: Array) -> Array:
    return (a == b) | ((a != a) & (b != b)) if _is_real(a) else a == b


def _in_order(
    columns: Sequence[tuple[Array, ...]], swapped: Callable[..., Array], count: int
) -> list[tuple[Array, ...]]:
    """Return columns whose first `count` are in order: neighbours change places, equal ones never."""
    found = list(columns)
    for done in range(min(count, len(found) - 1)):
        for place in range(len(found) - 1, done, -1):
            before, after = found[place - 1 : place + 1]
            swap = swapped(before, after)
            found[place - 1] = tuple(lax.select(swap, b, a) for a, b in zip(before, after, strict=True))
            found[place] = tuple(lax.select(swap, a, b) for a, b in zip(before, after, strict=True))
    return found


def _sort(p: Parameters, *operands: Array) -> list[Array]:
    def swapped(before: tuple[Array, ...], after: tuple[Array, ...]) -> Array:
        keys = list(zip(before, after, strict=True))[: p["num_keys"]]
        swap = _is_after(*keys[-1])
        for a, b in reversed(keys[:-1]):
            swap = _is_after(a, b) | (_is_same(a, b) & swap)
        return swap

    axis = p["dimension"]
    columns = list(zip(*(_parts(operand, axis) for operand in operands), strict=True))
    ordered = _in_order(columns, swapped, len(columns))
    return [_stacked(parts, axis) for parts in zip(*ordered, strict=True)]


def _top(p: Parameters, operand: Array) -> list[Array]:
    axis = p.get("axis", operand.ndim - 1)
    parts = _parts(operand, axis)
    places = [jnp.full(part.shape, place, np.int32) for place, part in enumerate(parts)]
    columns = list(zip(parts, places, strict=True))
    ordered = _in_order(columns, lambda a, b: _is_less(a[0], b[0]), p["k"])[: p["k"]]
    return [_stacked(each, axis) for each in zip(*ordered, strict=True)]


def _place_of(better: Callable[[Array, Array], Array]) -> Rule:
    """Return the rule of the place of the best number, the first of equal ones, or of a not-a-number."""

    def rule(p: Parameters, operand: Array) -> list[Array]:
        [axis] = p["axes"]
        best, *others = _parts(operand, axis)
        found = jnp.zeros(best.shape, p["index_dtype"])
        for place, other in enumerate(others, 1):
            takes = better(other, best)
            takes = takes | ((other != other) & (best == best)) if _is_real(best) else takes
            best = lax.select(takes, other, best)
            found = lax.select(takes, jnp.full_like(found, place), found)
        return [found]

    return rule


def _accumulated(combine: Callable[[Array, Array], Array]) -> Rule:
    def rule(p: Parameters, operand: Array) -> list[Array]:
        parts = _parts(operand, p["axis"])[:: -1 if p["reverse"] else 1]
        sums = list(itertools.accumulate(parts, combine))
        return [_stacked(sums[:: -1 if p["reverse"] else 1], p["axis"])]

    return rule


# --- places


def _scattered(combine: Callable[[Array, Array], Array]) -> Rule:
    """Return the rule of a scatter: at each place of an array a choice between its old number and each update."""

    def rule(p: Parameters, operand: Array, places: Array, updates: Array) -> list[Array]:
        numbers, axes = p["dimension_numbers"], range(operand.ndim)
        inner = [axis for axis in range(updates.ndim) if axis not in numbers.update_window_dims]
        updates = lax.transpose(updates, (*inner, *numbers.update_window_dims))
        gone = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        window, kept = updates.shape[len(inner) :], [axis for axis in axes if axis not in gone]
        sizes = [1] * operand.ndim
        for axis, size in zip(kept, window, strict=True):
            sizes[axis] = size
        clips = p["mode"] == lax.GatherScatterMode.CLIP

        for row in np.ndindex(*updates.shape[: len(inner)]):
            update = lax.reshape(updates[row], sizes)
            starts: dict[int, Array | int] = {axis: 0 for axis in axes if sizes[axis] < operand.shape[axis]}
            batching = zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True)
            starts |= {axis: row[of] for axis, of in batching}
            starts |= dict(zip(numbers.scatter_dims_to_operand_dims, _parts(places[row], 0), strict=True))
            whole: Array | bool = True
            for axis in numbers.scatter_dims_to_operand_dims:
                most = operand.shape[axis] - sizes[axis]
                starts[axis] = jnp.clip(starts[axis], 0, most) if clips else starts[axis]
                if sizes[axis] > 1:  # a window that does not fit is left out as a whole
                    whole = whole & (starts[axis] >= 0) & (starts[axis] <= most)
            for offset in np.ndindex(*(sizes[axis] for axis in starts)):
                here: Array | bool = whole
                part = update
                for axis, (of, start) in zip(offset, starts.items(), strict=True):
                    at = np.arange(operand.shape[of]) == start + axis
                    here = here & jnp.expand_dims(at, [other for other in axes if other != of])
                    part = lax.slice_in_dim(part, axis, axis + 1, axis=of)
                where, part = (jnp.broadcast_to(each, operand.shape) for each in (here, part))
                operand = lax.select(where, combine(operand, part), operand)
        return [operand]

    return rule


def _convolved(p: Parameters, left: Array, right: Array) -> list[Array]:
    """Return a convolution as a sum over the places of the kernel."""
    numbers, spatial = p["dimension_numbers"], left.ndim - 2
    left, right = lax.transpose(left, numbers.lhs_spec), lax.transpose(right, numbers.rhs_spec)
    dtype = p["preferred_element_type"] or left.dtype
    low_high = [(low, high, step - 1) for (low, high), step in zip(p["padding"], p["lhs_dilation"], strict=True)]
    left = lax.pad(left.astype(dtype), jnp.zeros((), dtype), [(0, 0, 0), (0, 0, 0), *low_high])
    reach = [(size - 1) * step + 1 for size, step in zip(right.shape[2:], p["rhs_dilation"], strict=True)]
    ends = [size - of + 1 for size, of in zip(left.shape[2:], reach, strict=True)]  # of the kernel's first place
    total: Array | None = None
    for place in np.ndindex(*right.shape[2:]):
        begin = [at * step for at, step in zip(place, p["rhs_dilation"], strict=True)]
        limits = [first + end for first, end in zip(begin, ends, strict=True)]
        part = lax.slice(left, (0, 0, *begin), (*left.shape[:2], *limits), (1, 1, *p["window_strides"]))
        kernel = right[(slice(None), slice(None), *place)].astype(dtype)
        product = jnp.tensordot(kernel, part, [[1], [1]])  # (out, batch, ...)
        total = product if total is None else total + product
    assert total is not None
    total = jnp.swapaxes(total, 0, 1)
    return [lax.transpose(total, [numbers.out_spec.index(axis) for axis in range(spatial + 2)])]


# --- small matrices, taken apart into rows of numbers, with any axes before


def _entries(matrix: Array) -> Matrix:
    return [_parts(row, row.ndim - 1) for row in _parts(matrix, matrix.ndim - 2)]


def _matrix(entries: Matrix) -> Array:
    rows = [_stacked(row, row[0].ndim) for row in entries]
    return _stacked(rows, rows[0].ndim - 1)


def _chosen(cases: Sequence[tuple[Array, Array]], otherwise: Array) -> Array:
    """Return the number of the case that holds."""
    for holds, case in cases:
        otherwise = lax.select(holds, case, otherwise)
    return otherwise


def _lu(p: Parameters, matrix: Array) -> list[Array]:
    """Return factors, pivots and permutation, by elimination with the largest number of each column as its pivot."""
    rows = _entries(matrix)
    height, width = len(rows), len(rows[0])
    order = [jnp.full(rows[0][0].shape, row, np.int32) for row in range(height)]
    pivots = []
    for step in range(min(height, width)):
        largest, pivot = abs(rows[step][step]), jnp.full_like(order[0], step)
        for row in range(step + 1, height):
            size = abs(rows[row][step])
            larger = size > largest
            largest, pivot = lax.select(larger, size, largest), lax.select(larger, jnp.full_like(pivot, row), pivot)
        pivots.append(pivot)
        taken = [(pivot == row, row) for row in range(step + 1, height)]
        first, first_order = rows[step], order[step]
        rows[step] = [_chosen([(takes, rows[row][n]) for takes, row in taken], first[n]) for n in range(width)]
        order[step] = _chosen([(takes, order[row]) for takes, row in taken], first_order)
        for takes, row in taken:
            rows[row] = [lax.select(takes, first[n], rows[row][n]) for n in range(width)]
            order[row] = lax.select(takes, first_order, order[row])
        divisor = rows[step][step]
        divisor = lax.select(divisor == 0, jnp.ones_like(divisor), divisor)
        for row in range(step + 1, height):
            factor = rows[row][step] / divisor
            behind = [rows[row][n] - factor * rows[step][n] for n in range(step + 1, width)]
            rows[row] = [*rows[row][:step], factor, *behind]
    return [_matrix(rows), _stacked(pivots, pivots[0].ndim), _stacked(order, order[0].ndim)]


def _permuted(p: Parameters, pivots: Array) -> list[Array]:
    """Return the permutation that exchanges of rows make."""
    size, places = p["permutation_size"], _parts(pivots, pivots.ndim - 1)
    order = [jnp.full(places[0].shape, row, np.int32) for row in range(size)]
    for step, place in enumerate(places):
        first = order[step]
        order[step] = _chosen([(place == row, order[row]) for row in range(step + 1, size)], first)
        for row in range(step + 1, size):
            order[row] = lax.select(place == row, first, order[row])
    return [_stacked(order, order[0].ndim)]


def _solved(p: Parameters, triangle: Array, right: Array) -> list[Array]:
    """Return the solution of equations with a triangle of numbers, row after row."""
    lower = p["lower"] != p["transpose_a"]
    if not p["left_side"]:
        right, lower = jnp.swapaxes(right, -1, -2), not lower
    if p["transpose_a"] == p["left_side"]:
        triangle = jnp.swapaxes(triangle, -1, -2)
    factors, rows = _entries(triangle), _parts(right, right.ndim - 2)
    solved: dict[int, Array] = {}
    for row in range(len(rows)) if lower else reversed(range(len(rows))):
        value = rows[row]
        for other, known in solved.items():
            value = value - factors[row][other][..., None] * known
        solved[row] = value if p["unit_diagonal"] else value / factors[row][row][..., None]
    found = _stacked([solved[row] for row in range(len(rows))], right.ndim - 2)
    return [found if p["left_side"] else jnp.swapaxes(found, -1, -2)]


def _cholesky(p: Parameters, matrix: Array) -> list[Array]:
    rows = _entries(matrix)
    zero = jnp.zeros_like(rows[0][0])
    made = [[zero] * len(rows) for _ in rows]
    for column in range(len(rows)):
        for row in range(column, len(rows)):
            value = rows[row][column]
            for other in range(column):
                value = value - made[row][other] * made[column][other]
            made[row][column] = jnp.sqrt(value) if row == column else value / made[column][column]
    return [_matrix(made)]


def _qr(p: Parameters, matrix: Array) -> list[Array]:
    """Return both factors by reflections."""
    rows = _entries(matrix)
    height, width = len(rows), len(rows[0])
    size = height if p["full_matrices"] else min(height, width)
    one, zero = jnp.ones_like(rows[0][0]), jnp.zeros_like(rows[0][0])
    reflections: list[tuple[int, Array, list[Array]]] = []

    def reflected(columns: Matrix, step: int, scale: Array, behind: list[Array], first: int) -> None:
        for n in range(first, len(columns[0])):
            along = columns[step][n]
            for place, weight in enumerate(behind, step + 1):
                along = along + weight * columns[place][n]
            along = scale * along
            columns[step][n] = columns[step][n] - along
            for place, weight in enumerate(behind, step + 1):
                columns[place][n] = columns[place][n] - weight * along

    for step in range(min(height - 1, width)):
        head, rest = rows[step][step], [rows[row][step] for row in range(step + 1, height)]
        squares = sum((value * value for value in rest), start=zero)
        length, nothing = jnp.sqrt(head * head + squares), squares == 0
        turned = lax.select(head >= 0, -length, length)
        safe = lax.select(nothing, one, turned)
        scale = lax.select(nothing, zero, (turned - head) / safe)
        divisor = lax.select(nothing, one, head - turned)
        behind = [value / divisor for value in rest]
        rows[step][step] = lax.select(nothing, head, turned)
        for row in range(step + 1, height):
            rows[row][step] = zero
        reflected(rows, step, scale, behind, step + 1)
        reflections.append((step, scale, behind))
    turns = [[one if row == column else zero for column in range(size)] for row in range(height)]
    for step, scale, behind in reversed(reflections):
        reflected(turns, step, scale, behind, step)
    upper = [[value if row <= n else zero for n, value in enumerate(rows[row])] for row in range(size)]
    return [_matrix(turns), _matrix(upper)]


def _linear_solve(p: Parameters, *operands: Array) -> list[Array]:
    lengths = p["const_lengths"]
    before, of_solve = lengths.matvec + lengths.vecmat, lengths.solve
    given = *operands[before : before + of_solve], *operands[sum(lengths) :]
    found: list[Array] = core.jaxpr_as_fun(p["jaxprs"].solve)(*given)
    return found


_CHOICES: dict[str, Rule] = {
    "argmax": _place_of(lax.gt),
    "argmin": _place_of(lax.lt),
    "conv_general_dilated": _convolved,
    "cummax": _accumulated(lax.max),
    "cummin": _accumulated(lax.min),
    "cumprod": _accumulated(lax.mul),
    "cumsum": _accumulated(lax.add),
    "scatter": _scattered(lambda old, new: new),
    "scatter-add": _scattered(lax.add),
    "scatter-max": _scattered(lax.max),
    "scatter-min": _scattered(lax.min),
    "scatter-mul": _scattered(lax.mul),
    "scatter-sub": _scattered(lax.sub),
    "sort": _sort,
    "top_k": _top,
}
_MATRICES: dict[str, Rule] = {
    "cholesky": _cholesky,
    "custom_linear_solve": _linear_solve,
    "lu": _lu,
    "lu_pivots_to_permutation": _permuted,
    "qr": _qr,
    "triangular_solve": _solved,
}
