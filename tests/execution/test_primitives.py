"""Every operation by the fast paths of compilation: as XLA does it, or refused; never wrong."""

import inspect

import jax
import numpy as np
import pytest

from mjx_climb.execution.elements import Unsupported
from mjx_climb.execution.gpu_kernel import over_robots
from tests.execution import primitives

ROBOTS = 9


def _arguments(real, whole):
    rng = np.random.default_rng(5)
    vector = rng.uniform(-2.5, 2.5, (ROBOTS, 3)).astype(real)
    matrix = rng.uniform(-2.5, 2.5, (4, 3)).astype(real)
    return vector, matrix, np.arange(-4, ROBOTS - 4).astype(whole)


def _in_kernel(name):
    """Return the operation by the kernel, carried out on the CPU, on numbers that differ from robot to robot."""
    operation = primitives.EVERY[name]

    def function(vector, matrix, number):
        return operation(vector, matrix * vector[1], number)

    return function


@pytest.mark.parametrize("name", primitives.EVERY)
def test_the_kernel_does_as_xla_or_refuses(name, interpreted):
    """In float64 to 1e-12; whole numbers, truth values and random bits the same."""
    function, arguments = _in_kernel(name), _arguments(np.float64, np.int32)
    expected = jax.jit(jax.vmap(function, (0, None, 0)))(*arguments)
    try:
        found = jax.jit(over_robots(function, [True, False, True]))(*arguments)
    except Unsupported:
        assert name not in primitives.KNOWN
        return
    for mine, xla in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert mine.dtype == xla.dtype
        if np.issubdtype(mine.dtype, np.floating):
            np.testing.assert_allclose(mine, xla, rtol=1e-12, atol=1e-12)
        else:
            np.testing.assert_array_equal(mine, xla)


@pytest.mark.parametrize("name", primitives.KNOWN)
def test_what_the_kernel_knows_is_written_for_gpus(name, without_nvrtc):
    """Each operation of the list has its form in CUDA C, but for numbers that kernels have not."""
    if "int8" in inspect.getsource(primitives.EVERY[name]):
        return
    with jax.enable_x64(False):
        arguments = _arguments(np.float32, np.int32)
        mapped = over_robots(_in_kernel(name), [True, False, True])
        lowered = jax.jit(mapped).trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()
    assert lowered.count("__gpu$xla.gpu.ptx") == 1
