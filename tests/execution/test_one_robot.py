"""A function of one robot under JAX's transformations, in any nesting: as the plain function's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.execution.one_robot import over_robots

BATCH = 3


def several(vector, number):
    """Results that move with the vector, with the number alone, and none."""
    return {"a": jnp.sin(vector).sum() * number, "b": vector * vector[0] ** 2, "c": number * 2.0, "d": vector > 0}


def real(function):
    def total(vector, number):
        found = function(vector, number)
        return found["a"] ** 2 + found["b"].sum() + found["c"]

    return total


def moved(function, vectors, numbers, along):
    """The linear map at one place, of several directions, also where only some results move."""
    _, change = jax.linearize(
        lambda *given: [v for v in function(*given).values() if v.dtype == float], vectors[0], numbers[0]
    )
    return jax.vmap(change, (0, None))(along, numbers[1]), jax.vmap(change, (None, 0))(along[0], numbers)


def summed(function):
    return lambda vectors, number: jax.vmap(real(function), (0, None))(vectors, number).sum()


# of a function, vectors (BATCH, 2), numbers (BATCH,) and directions of the vectors
TRANSFORMED = {
    "values": lambda f, v, n, d: jax.vmap(f, (0, None))(v, n[0]),
    "tangents of a batch": lambda f, v, n, d: jax.jvp(jax.vmap(real(f), (0, None)), (v, n[0]), (d, n[1])),
    "linear map": moved,
    "gradient of a batch": lambda f, v, n, d: jax.grad(summed(f), (0, 1))(v, n[0]),
    "batch of gradients": lambda f, v, n, d: jax.vmap(jax.grad(real(f)))(v, n),
    "batch of second derivatives": lambda f, v, n, d: jax.vmap(jax.hessian(real(f)), (0, None))(v, n[0]),
}
LONG = "batch of second derivatives"


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n == LONG)) for n in TRANSFORMED])
def test_a_transformed_function_is_the_plain_ones(name):
    random = np.random.default_rng(0)
    given = random.normal(size=(BATCH, 2)), random.normal(size=BATCH), random.normal(size=(BATCH, 2))
    mine, plain = (TRANSFORMED[name](function, *given) for function in (over_robots(several), jax.jit(several)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12), mine, plain)


def test_whole_numbers_have_no_tangents():
    """JAX gives them some without a size."""
    numbers, counts, rates = np.array([1.0, 2.0, 3.0]), np.arange(3), np.array([0.5, 1.0, -1.0])
    batch = jax.vmap(over_robots(lambda number, count: {"power": number**2 * count, "next": count + 1}))
    along = rates, np.zeros(3, jax.dtypes.float0)
    found, tangents = jax.jvp(batch, (numbers, counts), along)
    np.testing.assert_allclose(found["power"], numbers**2 * counts)
    np.testing.assert_allclose(tangents["power"], 2 * numbers * counts * rates)
    assert tangents["next"].dtype == jax.dtypes.float0
