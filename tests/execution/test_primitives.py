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
