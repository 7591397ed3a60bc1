"""Programs written out element by element: matrices, order, places."""

import jax
import numpy as np
import pytest

from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.element_rules import results
from mjx_climb.execution.flat import flat
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
