"""Extremes over rows: the values of NumPy's, and the derivative of the row that was chosen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Literal, jaxprs_in_params

import mjx_climb as mc
from mjx_climb.walk import chosen


@pytest.mark.parametrize("count", range(1, 10))
def test_the_extreme_row_and_its_derivative(count):
    rows = np.random.default_rng(count).normal(size=(count, 50))
    rates = np.random.default_rng(count + 100).normal(size=rows.shape)
    for ours, best in ((chosen.largest_row, np.argmax), (chosen.smallest_row, np.argmin)):
        found, rate = jax.jvp(ours, (rows,), (rates,))
        place = best(rows, axis=0), np.arange(50)
        np.testing.assert_array_equal(found, rows[place])
        np.testing.assert_array_equal(rate, rates[place])


def test_equal_rows_have_the_derivative_of_the_first():
    for ours in (chosen.largest_row, chosen.smallest_row):
        assert jax.jvp(ours, (jnp.ones((3, 1)),), (jnp.arange(1.0, 4.0)[:, None],))[1] == 1


@pytest.mark.parametrize("first", [True, False])
def test_what_is_not_a_number_stays(first):
    """A metric of a user's own that is undefined at one instant of a walk says so at its end."""
    rows = jnp.array([[1.0, np.nan, 3.0], [np.nan, 2.0, 1.0], [0.0, 1.0, 2.0]])
    assert np.isnan(chosen.largest_row(rows)).tolist() == [True, True, False]
    assert np.isnan(chosen.smallest_row(rows)).tolist() == [True, True, False]
    pair = (jnp.array(np.nan), jnp.array(1.0)) if first else (jnp.array(1.0), jnp.array(np.nan))
    assert np.isnan(chosen.larger(*pair)) and np.isnan(chosen.smaller(*pair))


def test_no_derivative_of_a_walk_looks_for_an_equal_number():
    """Where two kernels round differently there is none, and a slope is 0/0: so it was in whole programs of XLA's."""
    simulate = mc.simulator(mc.Scenario(duration=0.01), smooth=True)
    sloped = jax.make_jaxpr(lambda k: jax.jvp(lambda k: simulate({"stiffness": k}), (k,), (k,)))(np.full((2, 6), 3e3))
    assert "reduce_max" in str(sloped)  # of what has no derivative
    assert not compared_with_extremes(sloped.jaxpr)


def compared_with_extremes(jaxpr):
    """Return the comparisons for equality with a maximum or minimum over rows of real numbers."""
    extremes, found = set(), []
    for eqn in jaxpr.eqns:
        name, read = eqn.primitive.name, {v for v in eqn.invars if not isinstance(v, Literal)}
        if name in ("reduce_max", "reduce_min") and jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.floating):
            extremes.update(eqn.outvars)
        elif name in ("reshape", "broadcast_in_dim") and read & extremes:
            extremes.update(eqn.outvars)
        elif name == "eq" and read & extremes:
            found.append(eqn)
        for inner in jaxprs_in_params(eqn.params):
            found += compared_with_extremes(inner)
    return found
