"""The three ways to run a walk agree, and transform as JAX functions do."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance
from mjx_climb.inputs.from_scenario import own_parameters


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
        with pytest.raises(mc.ConfigError, match=rf"^engine: expected one of limb, mjx, got '{engine}'$"):
            ask(scenario, engine=engine)


@pytest.fixture(scope="module")
def late(case):
    """Return a short walk of ideal hardware, and parameters with a delay, dry friction and an integral gain."""
    scenario = case("case_1_2", "virtual_model", {"duration": 0.03, "gait.cycle": 4.0, "control.stiffness": 3e3})
    own = {"hardware.force_sensor.delay": 0.004, "hardware.servo.coulomb_friction": 0.3, "control.ki": 50.0}
    return mc.Simulation(scenario), own_parameters(scenario).replace({p: np.asarray(v) for p, v in own.items()})


METHODS = {
    "simulate": lambda simulation, parameters: simulation.simulate(None, parameters),
    "metrics": lambda simulation, parameters: simulation.metrics(None, parameters, dtype=np.float64),
    "jit": lambda simulation, parameters: jax.jit(
        lambda damping: simulation.simulate({"damping": damping}, parameters)
    )(simulation.law.damping),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["simulate", *(pytest.param(m, marks=pytest.mark.nightly) for m in ("metrics", "jit"))]
)
def test_hardware_in_the_parameters_is_walked_by_every_method(late, method):
    """Whatever hardware the scenario has: the walk is that of the rollout."""
    simulation, parameters = late
    expected, found = mc.metrics(simulation.rollout(None, parameters)), METHODS[method](simulation, parameters)
    for name in ("peak_foot_force", "force_variation", "peak_joint_torque", "cost_of_transport"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9, err_msg=name)


@pytest.mark.nightly
def test_hardware_in_the_parameters_is_walked_step_by_step_and_is_not_the_ideal_one(late):
    simulation, parameters = late
    walk = simulation.rollout(None, parameters)
    expected, ideal = mc.metrics(walk), simulation.metrics(dtype=np.float64)
    for name in ("peak_foot_force", "force_variation", "peak_joint_torque", "cost_of_transport"):
        assert abs(ideal[name] / expected[name] - 1) > 1e-3
    steps = jax.jit(lambda state: jax.lax.scan(lambda s, _: simulation.step(s), state, length=walk.scenario.steps))
    torque = steps(simulation.reset(None, parameters))[1].joint_torque
    np.testing.assert_allclose(torque, walk.joint_torque, rtol=0, atol=1e-9)


def test_hardware_that_jax_traces_is_refused_where_a_walk_has_none(late):
    """By `jit`, `vmap` and derivatives along it; other parameters, and what the scenario has, may be traced."""
    simulation, parameters = late
    ideal = own_parameters(simulation.scenario)

    def along(name, simulation=simulation, method="simulate"):
        return lambda value: getattr(simulation, method)(None, ideal.replace({name: value}))

    reset = jax.eval_shape(lambda: simulation.reset(None, parameters))
    assert reset.setup.hardware.stages == simulation._structure(parameters, {}).stages != simulation.structure.stages
    said = r"^parameters\.{}: expected a value that is known where the walk is compiled, or a scenario that has such a "
    for name in ("hardware.servo.coulomb_friction", "control.ki", "contact.capture_distance",
                 "contact.rotational_stiffness", "gait.sway"):  # fmt: skip
        for method in ("simulate", "reset"):
            function, value = along(name, method=method), float(ideal.at(name))
            for traced in (
                lambda: jax.jit(function)(value),  # noqa: B023
                lambda: jax.vmap(function)(np.full(2, value)),  # noqa: B023
                lambda: jax.jvp(function, (value,), (1.0,)),  # noqa: B023
            ):
                with pytest.raises(ValueError, match=said.format(re.escape(name))):
                    traced()
    with pytest.raises(ValueError, match=r"^parameters\.[\w.]+: expected a value that is known where"):
        jax.jit(simulation.simulate)(None, parameters)
    with pytest.raises(ValueError, match=r"^gains\.ki: expected a value that is known"):
        jax.jit(lambda ki: simulation.simulate({"ki": ki}))(1.0)
    # a delay has a buffer of some length: a derivative alone knows its value
    has = mc.Simulation(simulation.scenario.with_overrides({"hardware.force_sensor.delay": 0.004}))
    with pytest.raises(ValueError, match=r"^parameters\.hardware\.force_sensor\.delay: expected a value that"):
        jax.eval_shape(along("hardware.force_sensor.delay", has, "reset"), 0.004)
    jax.eval_shape(lambda: jax.jvp(along("hardware.force_sensor.delay", has, "reset"), (0.004,), (1.0,))[1].step)
    jax.eval_shape(along("disturbance.cargo.mass", method="reset"), 1.0)


def test_an_integral_gain_is_not_taken_up_in_mid_walk(late):
    simulation, _ = late
    state = jax.eval_shape(simulation.reset)
    with pytest.raises(ValueError, match=r"^gains\.ki: expected 0, as the robot began without an integral gain"):
        jax.eval_shape(lambda state: simulation.with_gains(state, {"ki": 1.0}), state)


class Rewritten(VirtualModelAdmittance):
    """The same law, whose step hands on as a new value what it leaves as it is."""

    def step(self, mass, measured, reference):
        return super().step(jax.tree.map(lambda value: value * 1, mass), measured, reference)


@pytest.mark.slow
def test_other_gains_reach_what_a_step_hands_on_as_a_new_value(scenario):
    simulation = mc.Simulation(scenario, law=Rewritten())
    begun = simulation.reset({"damping": 1e3})
    moving = begun.carry.memory.law._replace(displacement=jnp.full(6, 0.01))
    memory = begun.carry.memory._replace(law=moving)
    state = dataclasses.replace(begun, carry=begun.carry._replace(memory=memory))
    found = simulation.with_gains(state, {"damping": 1e2}).carry.memory.law
    expected = simulation.reset({"damping": 1e2}).carry.memory.law._replace(displacement=moving.displacement)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_equal_arguments_give_the_same_function(late):
    """JAX compiles it once: it knows a function by the object."""
    scenario = late[0].scenario
    again = mc.Scenario.model_validate(scenario.model_dump())
    assert again is not scenario
    assert mc.simulator(scenario) is mc.simulator(again) is not mc.simulator(again, smooth=True)
    stiff, soft = (VirtualModelAdmittance(stiffness=np.full(6, value)) for value in (1e4, 1e3))
    assert (
        mc.simulator(scenario, law=stiff) is mc.simulator(scenario, law=stiff) is not mc.simulator(scenario, law=soft)
    )
    assert mc.simulator(scenario, engine="mjx") is not mc.simulator(scenario)
    two = mc.METRICS[:2]
    assert mc.simulator(scenario, metrics=two) is mc.simulator(scenario, metrics=two) is not mc.simulator(scenario)


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
