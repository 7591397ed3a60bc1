"""Every operation by the fast paths of compilation: as XLA does it, or refused; never wrong."""

import jax
import numpy as np
import pytest

from mjx_climb.execution.element_operations import SHORTCUTS
from mjx_climb.execution.elements import Unsupported, Value
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
LONG = OF_MATRICES | {"interp", "searchsorted", "gather that fills", "dynamic_update_slice"}


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
