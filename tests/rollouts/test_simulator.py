"""The three ways to run a walk agree, and transform as JAX functions do."""

import typing

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beartype.door import is_bearable

import mjx_climb as mc


def equal(ours, named, **tolerance):
    """Tell whether metrics as arrays are those as plain numbers, NaN for None."""
    for name, value in named.items():
        if name == "detached_limb":
            limbs = ("LF", "LH", "RH", "RF")
            assert int(ours[name]) == (-1 if value is None else limbs.index(value))
        else:
            value = np.nan if value is None else value
            np.testing.assert_allclose(ours[name], value, err_msg=name, **tolerance)


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_1_1", "virtual_model")


@pytest.fixture(scope="module")
def simulate(scenario):
    return mc.simulator(scenario)


@pytest.fixture(scope="module")
def batched(simulate, scenario, numbers):
    """Metrics of a batch of two gains, by jit alone: stiffness times the argument."""
    there = numbers(scenario)

    def run(factor):
        return simulate(mc.Gains(jnp.ones((2, 6)), jnp.full((2, 6), 1e4), 4e5 * factor[:, None] * jnp.ones(6)), there)

    return jax.jit(run)(jnp.array([1.0, 0.01]))


@pytest.mark.slow
def test_rollout_metrics_are_the_metrics_of_the_rollout(scenario, batched, walk):
    """What accumulates step by step is what the stored histories give, a walk that tears off a gripper included."""
    equal({name: value[0] for name, value in batched.items()}, mc.metrics(walk(scenario)), rtol=1e-9)


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
    there = numbers(scenario)

    def run(factor):
        return simulate(mc.Gains(jnp.ones(6), jnp.full(6, 1e4), 4e5 * factor * jnp.ones(6)), there)

    mapped = jax.jit(jax.vmap(run))(jnp.array([1.0, 0.01]))
    for name, values in batched.items():
        np.testing.assert_allclose(mapped[name], values, rtol=1e-9, err_msg=name)


@pytest.mark.slow
def test_memory_does_not_grow_with_time(case):
    """The compiled walk of 8 s needs the memory of the one of 1 s."""
    short, long = (case("case_1_1", "virtual_model", (("duration", span),)) for span in (1.0, 8.0))
    gains = mc.Gains(1.0, 1e4, np.full((8, 6), 4e5))

    def need(scenario):
        walk = jax.jit(mc.simulator(scenario))
        return walk.lower(gains).compile().memory_analysis().temp_size_in_bytes

    # the list of steps is the one thing that is longer
    assert need(long) - need(short) <= 8 * 8000


def test_no_array_over_time(scenario, simulate):
    """In the program of a batch no array has an entry for each time step."""
    text = str(jax.make_jaxpr(simulate)(mc.Gains(1.0, 1e4, np.full((3, 6), 4e5))))
    assert f"length={scenario.steps}\n" in text  # the loop
    assert f"[{scenario.steps}]" not in text
    assert f"[{scenario.steps}," not in text


def test_parameters_hold_what_they_are_annotated_with(scenario):
    """Arrays of JAX and of numpy."""
    ours = mc.parameters(scenario)
    hints = {name: hint for name, hint in typing.get_type_hints(mc.Parameters).items() if name != "AXES"}
    for numbers in (ours, jax.tree.map(np.asarray, ours)):
        assert [name for name, hint in hints.items() if not is_bearable(getattr(numbers, name), hint)] == []


@pytest.mark.parametrize("engine", ["lim", ""])
def test_an_unknown_engine_is_refused_in_one_line(scenario, engine):
    for ask in (mc.simulator, mc.rollout, mc.rollout_metrics):
        with pytest.raises(mc.ConfigError, match=rf"^engine: expected one of mjx, limb, got '{engine}'$"):
            ask(scenario, engine=engine)


@pytest.fixture(scope="module")
def variation(case):
    """Return the force variation over ten steps as a function of the damping."""
    simulate = mc.simulator(case("case_1_1", "virtual_model", (("duration", 0.01),)))
    return lambda damping: simulate({"damping": damping})["force_variation"]


@pytest.fixture(scope="module")
def forward(variation):
    """Return the variations of three dampings, their tangents, and the central difference of the middle one."""
    tangents = jax.jit(jax.vmap(lambda damping: jax.jvp(variation, (damping,), (1.0,))))
    (below, _, above), found = tangents(1e4 * jnp.array([0.99, 1.0, 1.01]))
    return found[1], (above - below) / 2e2


def test_forward_derivatives_are_central_differences(forward):
    tangent, difference = forward
    assert abs(difference) > 0
    np.testing.assert_allclose(tangent, difference, rtol=1e-3)


@pytest.mark.slow
def test_reverse_derivatives_of_one_are_the_forward_ones_of_a_batch(variation, forward):
    np.testing.assert_allclose(jax.jit(jax.grad(variation))(1e4), forward[0], rtol=1e-9)
