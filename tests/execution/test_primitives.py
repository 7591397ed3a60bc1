"""Every operation by the fast paths of compilation: as XLA does it, or refused; never wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend import core

from mjx_climb.execution.element_operations import SHORTCUTS, Operations
from mjx_climb.execution.element_rules import results
from mjx_climb.execution.elements import Unsupported, Value
from mjx_climb.execution.flat import flat
from mjx_climb.execution.gpu_kernel import over_robots
from tests.execution import primitives

ROBOTS = 9
OF_MATRICES = {
    "inertia of a robot",
    "inv of six",
    "qr",
    "solve",
    "inv",
    "cholesky",
    "convolve of a vector",
    "sort",
    "median",
    "scatter",
}
LOOPS = {"a long loop", "a loop that reads", "a loop in a loop that reads"}
LONG = (
    OF_MATRICES | LOOPS | {"interp", "searchsorted", "gather that fills", "dynamic_update_slice", "qr of a wide matrix"}
)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in primitives.EVERY]
)
def test_the_kernel_does_as_xla_or_refuses(name, interpreted):
    """In float64 to 1e-12; whole numbers, truth values and random bits the same."""

    def function(vector, matrix, number):
        return primitives.EVERY[name](vector, matrix * vector[1], number)

    rng = np.random.default_rng(5)
    arguments = rng.uniform(-2.5, 2.5, (ROBOTS, 3)), rng.uniform(-2.5, 2.5, (4, 3)), np.arange(-4, 5, dtype=np.int32)
    expected = jax.jit(jax.vmap(function, (0, None, 0)))(*arguments)
    try:
        found = jax.jit(over_robots(function, [True, False, True]))(*arguments)
    except Unsupported:
        assert name not in primitives.KNOWN
        return
    for mine, xla in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert mine.dtype == xla.dtype
        tolerance = 1e-12 if np.issubdtype(mine.dtype, np.floating) else 0
        np.testing.assert_allclose(mine, xla, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", ["shift_left", "shift_right_logical"])
def test_a_shift_by_all_bits_is_written_as_zero(name):
    """CUDA's own is undefined there."""
    number = Value(None, np.dtype(np.int32))
    assert SHORTCUTS[name](number, np.int32(32)) == 0 and SHORTCUTS[name](number, np.int32(0)) is number
    assert SHORTCUTS[name](number, np.int32(31)) is None


OF_TYPE = {
    np.float64: [0.0, 1.0, -1.0, 2.5, -1e30, 1e-3], np.int32: [0, 1, -1, 2, -7, 31, 32, 2**31 - 1, -(2**31)],
    np.uint32: [0, 1, 2, 31, 32, 2**32 - 1], np.bool_: [False, True],
}  # fmt: skip
BY_NUMPY = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "max": np.maximum, "min": np.minimum,
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "eq": np.equal, "ne": np.not_equal,
    "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "rem": lambda a, b: np.where(b == 0, a, np.fmod(a, np.where(b == 0, 1, b))).astype(a.dtype),  # as XLA's by nothing
    "shift_left": lambda a, b: np.where((b >= 0) & (b < 32), np.left_shift(a, b & 31), 0).astype(a.dtype),
    "shift_right_logical": lambda a, b: np.where(
        (b >= 0) & (b < 32), np.right_shift(a.view(np.uint32), (b & 31).astype(np.uint32)), 0
    ).astype(a.dtype),
}  # fmt: skip
ARITHMETIC = {"add", "add_any", "sub", "mul"}
NOT_FOUND = {"rem", "xor", "shift_left", "shift_right_logical"}  # in some cases: of nothing, say
COMBINING = {"and", "or", "xor", "max", "min"}


@pytest.mark.parametrize("dtype", OF_TYPE)
@pytest.mark.parametrize("name", BY_NUMPY)
def test_an_operation_that_changes_nothing_is_found_and_no_other(name, dtype):
    """Of a value with itself and with each number: what NumPy makes of many values of it."""
    kind = np.dtype(dtype).kind
    if (kind == "b" and name in {*ARITHMETIC, "rem"}) or (kind == "f" and name in ("and", "or", "xor")) or (
        name.startswith("shift") and kind not in "iu"
    ):  # fmt: skip
        return
    value, samples = Value(None, np.dtype(dtype)), np.array(OF_TYPE[dtype], dtype)
    for number in (None, *samples):
        for turned in (False, True):
            given = [value, value if number is None else number][:: -1 if turned else 1]
            if (
                kind == "b"
                and number is not None
                and BY_NUMPY[name](True, True).dtype == bool
                and name not in COMBINING
            ):
                continue  # a comparison with a truth value is that value or its opposite
            columns = [samples if each is value else np.broadcast_to(number, samples.shape).copy() for each in given]
            with np.errstate(all="ignore"):
                expected = BY_NUMPY[name](*columns)
            found = SHORTCUTS[name](*given)
            same = [np.array_equal(expected, samples)] * (expected.dtype == samples.dtype)
            constant = np.ptp(expected.astype(float)) == 0
            if found is value:
                assert same == [True], (number, turned)
            elif found is not None:
                assert constant and found == expected[0] and found.dtype == expected.dtype, (number, turned)
            elif name not in NOT_FOUND and kind != "f" and not (name in ARITHMETIC and number is None):
                assert not (any(same) or constant), (number, turned)


NUMBERS = np.array([0.0, -0.0, 1.0, -2.5, 3.7, 1e-3, 1e30, np.inf, -np.inf, np.nan])
ON_NUMBERS = {
    "elementwise": lambda x, n: (jnp.abs(x), lax.ceil(x), x / x[::-1], lax.floor(x), jnp.sqrt(x), jnp.square(x), n * n),
    "conversions": lambda x, n: (x.astype(np.float32), n.astype(np.float64), x.astype(bool), n.astype(np.int64)),
    "places": lambda x, n: (lax.iota(np.int32, 4), lax.broadcasted_iota(np.int32, (2, 3), 1), lax.rev(n, (0,))),
    "pads": lambda x, n: (
        lax.pad(n, np.int32(7), [(2, 1, 0)]),
        lax.pad(x.reshape(2, 5), 0.5, [(-1, 0, 2), (1, -2, 0)]),
    ),
    "reductions": lambda x, n: (n.sum(), n.reshape(2, 5).max(0), n.min(), (n > 3).any(), (n > 3).all()),
    "parts": lambda x, n: (*jnp.split(n, [3, 4]), *lax.split(x, (4, 6)), jnp.where(x > 0, x, 2.0)),
    "functions": lambda x, n: (jnp.cos(x), jnp.exp(x), jnp.log(x), jnp.sin(x), jnp.tan(x), x**3, x**-2),
    "sums": lambda x, n: (x[2:6].sum(), x[2:8].reshape(2, 3).sum(0)),
    "products": lambda x, n: (
        x[2:6] @ x[:4],
        lax.dot_general(x[:6].reshape(2, 3, 1), n[:6].astype(float).reshape(3, 1, 2), (((0,), (2,)), ((1,), (0,)))),
        lax.dot_general(n[:6].reshape(2, 3), n[:6].reshape(3, 2), (((1,), (0,)), ((), ()))),
        lax.dot_general(x[2:5], x[2:5], (((), ()), ((), ())), preferred_element_type=np.float32),
    ),
}
TO_ROUNDING = {"functions", "sums", "products"}


@pytest.mark.parametrize("name", ON_NUMBERS)
def test_operations_on_numbers_alone_compile_nothing(name):
    """Their bits are those that XLA computes, those of `TO_ROUNDING` nearly."""
    given = NUMBERS, np.arange(-4, 6, dtype=np.int32)
    program = jax.make_jaxpr(ON_NUMBERS[name])(*given)
    expected = jax.jit(core.jaxpr_as_fun(program))(*given)
    heard = []
    listener = lambda event, *_, **__: heard.append(event)  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listener)
    try:
        found = results(Operations(None, None), flat(program), list(given))
    finally:
        jax.monitoring.unregister_event_duration_listener(listener)
    for mine, xla in zip(found, expected, strict=True):
        assert mine.dtype == xla.dtype and mine.shape == xla.shape
        if name in TO_ROUNDING:
            np.testing.assert_allclose(mine, xla, rtol=4 * np.finfo(xla.dtype).eps if xla.dtype.kind == "f" else 0)
        else:
            assert mine.tobytes() == np.asarray(xla).tobytes()
    assert not [event for event in heard if "compile" in event]


def test_no_library_factors_the_inertia_of_a_robot():
    """Two calls of jaxlib's LAPACK at once wait for each other for ever, over batches on a CPU."""
    program = flat(jax.make_jaxpr(primitives.EVERY["inertia of a robot"])(jnp.ones(3), jnp.eye(3), 1.0))
    names = {equation.primitive.name for equation in program.jaxpr.eqns}
    assert names & {"sqrt", "cholesky", "triangular_solve"} == {"sqrt"}
