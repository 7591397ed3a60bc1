"""The three ways to run a walk agree, and transform as JAX functions do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_1_1", "virtual_model")


@pytest.fixture(scope="module")
def simulate(scenario):
    return mc.simulator(scenario)


STIFFNESS = 4e5 * jnp.array([[1.0], [0.01]]) * jnp.ones(6)


@pytest.fixture(scope="module")
def batched(simulate, scenario, numbers):
    """Metrics of a batch of two gains, by jit alone."""
    one, there = jnp.ones((2, 6)), numbers(scenario)
    return jax.jit(lambda stiffness: simulate(mc.Gains(one, 1e4 * one, stiffness), there))(STIFFNESS)


@pytest.mark.slow
def test_rollout_metrics_are_the_metrics_of_the_rollout(scenario, batched, walk):
    """What accumulates step by step is what the stored histories give, a walk that tears off a gripper included."""
    for name, value in mc.metrics(walk(scenario)).items():
        if name == "detached_limb":
            value = -1 if value is None else walk(scenario).limbs.index(value)
        np.testing.assert_allclose(batched[name][0], np.nan if value is None else value, rtol=1e-9, err_msg=name)


@pytest.mark.slow
def test_metrics_are_of_the_parameters_that_were_walked(case, gains, numbers):
    """A rollout with parameters in place of the scenario's is evaluated with them: other gravity, other cost."""
    scenario = case("case_2", "pd")
    lunar = numbers(scenario, gravity=(0.0, 0.0, -1.635))
    ours = mc.metrics(mc.rollout(scenario, gains(scenario), lunar))
    same = mc.metrics(mc.rollout(case("case_2", "pd", (("gravity", [0.0, 0.0, -1.635]),)), gains(scenario), lunar))
    assert ours == same


@pytest.mark.nightly
@pytest.mark.slow
def test_simulator_under_vmap(simulate, scenario, numbers, batched):
    """vmap over single walks gives what a batch axis in the gains gives."""
    one, there = jnp.ones(6), numbers(scenario)
    mapped = jax.jit(jax.vmap(lambda stiffness: simulate(mc.Gains(one, 1e4 * one, stiffness), there)))(STIFFNESS)
    for name, values in batched.items():
        np.testing.assert_allclose(mapped[name], values, rtol=1e-9, err_msg=name)


def test_no_array_over_time(scenario, simulate):
    """In the program of a batch no array has an entry for each time step: memory does not grow with time."""
    text = str(jax.make_jaxpr(simulate)(mc.Gains(1.0, 1e4, np.full((3, 6), 4e5))))
    assert f"length={scenario.steps}\n" in text  # the loop
    assert f"[{scenario.steps}]" not in text
    assert f"[{scenario.steps}," not in text


@pytest.mark.parametrize("engine", ["lim", ""])
def test_an_unknown_engine_is_refused_in_one_line(scenario, engine):
    for ask in (mc.simulator, mc.rollout, mc.rollout_metrics):
        with pytest.raises(mc.ConfigError, match=rf"^engine: expected one of mjx, limb, got '{engine}'$"):
            ask(scenario, engine=engine)


@pytest.fixture(scope="module")
def variation(case):
    """Return the force variation over ten steps by the damping, alone and, of a batch, with its tangents."""
    simulate = mc.simulator(case("case_1_1", "virtual_model", (("duration", 0.01),)))

    def one(damping):
        return simulate({"damping": damping})["force_variation"]

    return one, jax.jit(jax.vmap(lambda damping: jax.jvp(one, (damping,), (1.0,))))


@pytest.mark.slow
def test_forward_derivatives_are_central_differences(variation):
    (below, _, above), (_, tangent, _) = variation[1](1e4 * jnp.array([0.99, 1.0, 1.01]))
    assert above != below
    np.testing.assert_allclose(tangent, (above - below) / 2e2, rtol=1e-3)


@pytest.mark.slow
def test_reverse_derivatives_of_one_are_the_forward_ones_of_a_batch(variation):
    tangents = variation[1](1e4 * jnp.array([0.99, 1.0, 1.01]))[1]
    np.testing.assert_allclose(jax.jit(jax.grad(variation[0]))(1e4), tangents[1], rtol=1e-9)
