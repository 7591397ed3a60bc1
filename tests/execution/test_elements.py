"""Programs written out element by element: matrices, order, places."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scipy import linalg

from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.element_rules import results
from mjx_climb.execution.flat import flat, tangents_of
from tests.execution import primitives
from tests.execution.rows import carried_out

WRITTEN_OUT = [
    "cholesky", "convolve of a vector", "dynamic_update_slice", "gather that fills", "qr",
    "scatter", "solve", "sort",
]  # fmt: skip

AT_A_PLACE = {"dynamic_update_slice", "gather that fills", "scatter"}


@pytest.mark.parametrize("name", WRITTEN_OUT)
def test_simpler_operations_on_elements_are_those_of_arrays(name):
    """Of one robot; those of arrays are XLA's own."""
    vector, matrix = np.random.default_rng(5).uniform(-2.5, 2.5, 3), np.random.default_rng(6).uniform(-2.5, 2.5, (4, 3))
    program = jax.make_jaxpr(primitives.KNOWN[name])(vector, matrix, np.int32(0))
    for number in (-4, 2) if name in AT_A_PLACE else (2,):
        given = vector, matrix, np.asarray(number, np.int32)
        expected = results(Operations(None, None), program, [*given])
        for mine, xla in zip(carried_out(flat(program), given), expected, strict=True):
            assert mine.dtype == xla.dtype
            np.testing.assert_allclose(mine, xla, rtol=1e-12 if mine.dtype.kind == "f" else 0, atol=1e-12)


def triangles(a, b, *, left, lower, turned, unit):
    """Solve with one triangle of a matrix; whatever is in the other, and on a diagonal of ones, is not read."""
    triangle = np.tril(a) if lower else np.triu(a)
    triangle = triangle - np.diag(np.diag(triangle)) + np.eye(len(a)) if unit else triangle
    triangle = triangle.T if turned else triangle
    return np.linalg.solve(triangle, b) if left else np.linalg.solve(triangle.T, b.T).T


def scattered(array, starts, windows, axes, combine, *, clips):
    """Put windows at places one after the other: those that do not fit are left out, or moved to where they do."""
    array = array.copy()
    for start, window in zip(starts, windows, strict=True):
        most = np.array([array.shape[axis] - window.shape[axis] for axis in axes])
        start = np.clip(start, 0, most) if clips else start
        if (start < 0).any() or (start > most).any():
            continue
        begin = dict(zip(axes, start, strict=True))
        where = tuple(slice(begin.get(axis, 0), begin.get(axis, 0) + n) for axis, n in enumerate(window.shape))
        array[where] = combine(array[where], window)
    return array


def convolved(image, kernel, *, strides, padding, holes, steps):
    """Convolve (batch, in, ...) by (out, in, ...), place by place, with zeros between numbers and at the ends."""
    wide = np.zeros((*image.shape[:2], *((n - 1) * hole + 1 for n, hole in zip(image.shape[2:], holes, strict=True))))
    wide[(..., *(slice(None, None, hole) for hole in holes))] = image
    wide = np.pad(wide, [(0, 0), (0, 0), *padding])
    reach = [(n - 1) * step + 1 for n, step in zip(kernel.shape[2:], steps, strict=True)]
    sizes = [(n - r) // s + 1 for n, r, s in zip(wide.shape[2:], reach, strides, strict=True)]
    found = np.zeros((len(image), len(kernel), *sizes))
    for place in np.ndindex(*sizes):
        window = [slice(at * s, at * s + r, step) for at, s, r, step in zip(place, strides, reach, steps, strict=True)]
        found[(..., *place)] = np.tensordot(wide[(..., *window)], kernel, [[1, 2, 3], [1, 2, 3]])
    return found


SQUARE, RIGHT = np.array([[2.0, -1.0, 0.5], [0.3, -1.5, 0.7], [1.1, 0.4, 3.0]]), np.array([[1.0, 2], [-3, 4], [5, -6]])
WITH_NAN = np.array([[1.0, np.nan, -2.0, 1.0], [np.nan, 3.0, 3.0, -1.0], [0.0, -0.0, np.nan, 2.0]])
IMAGE, KERNEL = np.arange(24.0).reshape(1, 2, 4, 3) % 7 - 3, np.arange(24.0).reshape(3, 2, 2, 2) % 5 - 2
HOW = {"strides": (2, 1), "padding": ((1, 0), (0, 2)), "holes": (2, 1), "steps": (1, 2)}
WINDOWS = np.arange(1.0, 13).reshape(3, 2, 2)
PLACES = np.array([[0, 1], [-1, 0], [2, 2]], np.int32)
COMBINE = {"": lambda a, b: b, "_add": np.add, "_sub": np.subtract, "_mul": np.multiply, "_max": np.maximum,
           "_min": np.minimum}  # fmt: skip
CASES = {
    **{
        f"triangular_solve {bits:04b}": (
            lambda a, b, given=given: lax.linalg.triangular_solve(
                a, b if given[0] else b.T, left_side=given[0], lower=given[1], transpose_a=given[2],
                unit_diagonal=given[3],
            ),
            lambda a, b, given=given: triangles(
                a, b if given[0] else b.T, **dict(zip(("left", "lower", "turned", "unit"), given, strict=True))
            ),
            (SQUARE, RIGHT),
        )
        for bits in range(16)
        for given in [[bool(bits >> n & 1) for n in range(4)]]
    },
    **{
        f"scatter{name} {'clip' if clips else 'drop'}": (
            lambda a, w, p, name=name, clips=clips: getattr(lax, f"scatter{name}")(
                a, p, w, lax.ScatterDimensionNumbers((1, 2), (), (0, 1)), mode="clip" if clips else "drop"
            ),
            lambda a, w, p, name=name, clips=clips: scattered(a, p, w, (0, 1), COMBINE[name], clips=clips),
            (IMAGE[0, 0], WINDOWS, PLACES) if not name else (IMAGE[0, 0, :2], WINDOWS[:2, :1], PLACES[1:]),
        )
        for name, clips in itertools.product(COMBINE, (True, False))
        if clips or not name
    },
    **{
        f"lu of {name}": (lambda a: lax.linalg.lu(a)[:2], lambda a: linalg.lapack.dgetrf(a)[:2], (matrix,))
        for name, matrix in {
            "a square": SQUARE, "two equal pivots": np.array([[1.0, 2], [-1, 4]]),
            "a column of zeros": np.array([[0.0, 2, 1], [0, 3, 4], [0, 1, 5]]),
        }.items()
    },
    **{
        f"qr of {name}, {mode}": (
            lambda a, mode=mode: lax.linalg.qr(a, full_matrices=mode == "complete"),
            lambda a, mode=mode: np.linalg.qr(a, mode),
            (matrix,),
        )
        for name, matrix in {
            "a tall one": IMAGE[0, 0], "a wide one": IMAGE[0, 0].T, "a triangle": np.triu(SQUARE),
            "one that begins with 0": SQUARE - np.diag([2.0, 0, 0]),
        }.items()
        for mode in ("complete", "reduced")
    },
    "pivots to permutation": (
        lambda p: lax.linalg.lu_pivots_to_permutation(p, 5),
        lambda p: functools.reduce(
            lambda order, pair: order[[pair[1] if n == pair[0] else pair[0] if n == pair[1] else n for n in range(5)]],
            enumerate(p), np.arange(5),
        ),
        (np.array([3, 1, 4], np.int32),),
    ),
    "conv_general_dilated": (
        lambda a, k: lax.conv_general_dilated(a, k, HOW["strides"], HOW["padding"], HOW["holes"], HOW["steps"]),
        functools.partial(convolved, **HOW), (IMAGE, KERNEL),
    ),
    "conv_general_dilated of channels behind": (
        lambda a, k: lax.conv_general_dilated(
            a.transpose(0, 2, 3, 1), k.transpose(2, 3, 1, 0), HOW["strides"], HOW["padding"], HOW["holes"],
            HOW["steps"], ("NHWC", "HWIO", "HWNC"),
        ),
        lambda a, k: convolved(a, k, **HOW).transpose(2, 3, 0, 1), (IMAGE, KERNEL),
    ),
    **{
        f"{name} along {axis}{', backwards' * backwards}": (
            lambda a, name=name, axis=axis, backwards=backwards: getattr(lax, name)(a, axis, reverse=backwards),
            lambda a, of=of, axis=axis, backwards=backwards: np.flip(
                of(np.flip(a, axis) if backwards else a, axis), axis if backwards else ()
            ),
            (IMAGE[0, 0],),
        )
        for name, of in {"cumsum": np.cumsum, "cumprod": np.cumprod, "cummax": np.maximum.accumulate,
                         "cummin": np.minimum.accumulate}.items()
        for axis, backwards in ((0, False), (1, True))
    },
    **{
        f"{name} along {axis}": (
            lambda a, name=name, axis=axis: getattr(lax, name)(a, axis, np.int32),
            lambda a, name=name, axis=axis: getattr(np, name)(a, axis),  # of several not-a-numbers the first
            (WITH_NAN,),
        )
        for name in ("argmax", "argmin")
        for axis in (0, 1)
    },
    "top_k along 0": (
        lambda a: lax.top_k(a, 2, axis=0),
        lambda a: [(of := np.argsort(-a, 0, kind="stable")[:2]) * 0 + np.take_along_axis(a, of, 0), of],
        (np.nan_to_num(WITH_NAN, nan=3.0),),
    ),
    "top_k of NaN": (
        lambda a: lax.top_k(a, 3)[1],
        lambda a: np.argsort(-np.nan_to_num(a, nan=9.0), 1, kind="stable")[:, :3], (WITH_NAN,),
    ),
    "sort by two keys": (
        lambda *a: lax.sort(a, dimension=0, num_keys=2),
        lambda *a: [each[np.lexsort((a[1], a[0]))] for each in a],
        (np.array([2, 1, 2, 1, 2]), WITH_NAN.ravel()[:5], np.arange(5)),
    ),
    "sort along 1": (lambda a: lax.sort(a, dimension=1), lambda a: np.sort(a, 1), (WITH_NAN,)),
    "reshape of a turned array": (lambda a: lax.reshape(a, (3, 4), (1, 0)), lambda a: a.T, (IMAGE[0, 0],)),
    "slice with strides": (lambda a: lax.slice(a, (1, 0), (4, 3), (2, 2)), lambda a: a[1:4:2, ::2], (IMAGE[0, 0],)),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_operations_with_all_their_parameters_are_those_of_numpy(name):
    function, of_numpy, given = CASES[name]
    program = flat(jax.make_jaxpr(function)(*given))
    expected = of_numpy(*given)
    expected = expected if isinstance(expected, (list, tuple)) else [expected]
    for mine, theirs in zip(carried_out(program, given), expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
@pytest.mark.parametrize("name", ["max", "min"])
def test_an_extreme_has_the_derivative_of_the_first_of_equal_numbers(name, count):
    """Over one axis and over both, as over pairs; of a not-a-number its own."""
    numbers = np.array([2.0, 2.0, -1.0, 3.0, 3.0, -1.0, 0.5, 3.0, -1.0, -1.0])[: 2 * count].reshape(2, count)
    rates = np.arange(1.0, 1 + numbers.size).reshape(2, count)
    of = getattr(jnp, name)
    program = jax.make_jaxpr(lambda x: (of(x, 1), of(x), of(x, 0), getattr(jnp, f"{name}imum")(x[0], x[1])))(numbers)
    both, moved = tangents_of(program, [True])
    found = carried_out(flat(both), [numbers, rates])
    assert moved == [True] * 4
    best = getattr(np, f"arg{name}")
    expected = [getattr(numbers, name)(1), getattr(numbers, name)(), *[getattr(numbers, name)(0)] * 2]
    along = [np.take_along_axis(rates, best(numbers, 1)[:, None], 1)[:, 0], None,
             *[np.take_along_axis(rates, best(numbers, 0)[None], 0)[0]] * 2]  # fmt: skip
    for value, rate, exact, exact_rate in zip(found[:4], found[4:], expected, along, strict=True):
        np.testing.assert_array_equal(value, exact)
        if exact_rate is None:  # of equal ones in two rows one of theirs
            assert rate in rates[numbers == exact]
        else:
            np.testing.assert_array_equal(rate, exact_rate)
    numbers[1, -1] = np.nan
    assert np.isnan(carried_out(flat(both), [numbers, rates])[1])


def test_a_product_over_nothing_is_zero():
    program = flat(jax.make_jaxpr(lambda a, b: a @ b)(np.zeros((2, 0)), np.zeros((0, 3))))
    np.testing.assert_array_equal(carried_out(program, [np.zeros((2, 0)), np.zeros((0, 3))])[0], np.zeros((2, 3)))
