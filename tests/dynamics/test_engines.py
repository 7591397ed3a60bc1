"""The engines are one physics: a whole walk and its derivative agree, and so do the accelerations they rest on."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.walk.metrics import FAILURES

SMOOTH = [name for name in mc.METRICS.names if name not in FAILURES]


def _value_and_slopes(scenario, engine):
    """Return the metrics and their derivatives by the logarithms of damping and stiffness."""
    simulate = mc.simulator(scenario, engine=engine)

    def metrics(logarithms):
        damping, stiffness = jnp.exp(logarithms)
        return simulate(mc.Gains(jnp.ones(6), damping * jnp.ones(6), stiffness * jnp.ones(6)))

    at = jnp.log(jnp.array([scenario.control.damping, scenario.control.stiffness]))
    push = functools.partial(jax.jvp, metrics, (at,))
    return jax.jit(jax.vmap(lambda direction: push((direction,)), out_axes=(None, 0)))(jnp.eye(2))


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["case_1_1", "case_2"])
def test_engines_agree_over_a_walk(case, name):
    """Eight seconds of walking are the same under every engine to 1e-9, in value and in derivative."""
    scenario = case(name, "virtual_model")
    results = [_value_and_slopes(scenario, engine) for engine in mc.ENGINES]
    for metric in SMOOTH:
        for value, slopes in results[1:]:
            np.testing.assert_allclose(value[metric], results[0][0][metric], rtol=1e-9, err_msg=metric)
            np.testing.assert_allclose(slopes[metric], results[0][1][metric], rtol=1e-9, atol=1e-12, err_msg=metric)
