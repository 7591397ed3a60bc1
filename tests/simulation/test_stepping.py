"""Robots stepped by hand walk as a rollout does, take actions, and are pure functions of state and action."""

import dataclasses
import timeit

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

import mjx_climb as mc

SHORT = {"duration": 0.2, "gait.cycle": 0.2, "disturbance.cargo.start": 0.1}
HISTORIES = ("base_position", "base_orientation", "joint_angles", "joint_torque", "foot_force", "support", "tsm")


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_1_2", "virtual_model", SHORT)


@pytest.fixture(scope="module")
def simulation(scenario):
    return mc.Simulation(scenario)


@pytest.fixture(scope="module")
def walked(simulation):
    """Return what steps robots from a state to the end of a walk, and returns all samples too."""
    return jax.jit(
        lambda state, actions=None: jax.lax.scan(simulation.step, state, actions, length=simulation.scenario.steps)
    )


@pytest.fixture(scope="module")
def alone(simulation, walked):
    return walked(simulation.reset())


@pytest.mark.slow
def test_one_robot_walks_as_in_a_rollout(scenario, alone):
    trajectory = mc.rollout(scenario)
    for name in HISTORIES:
        found, expected = getattr(alone[1], name), getattr(trajectory, name)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-10, err_msg=name)


@pytest.mark.nightly
def test_a_simulation_steps_one_robot(scenario, alone):
    """And `vmap` makes a batch of it, as batch axes do."""
    simulation, first = mc.Simulation(scenario), alone[1].joint_torque[0]
    starts = jax.vmap(lambda k: simulation.reset({"stiffness": k}))(jnp.array([1e3, 5e4]))
    _, sample = jax.jit(jax.vmap(simulation.step))(starts)
    np.testing.assert_allclose(sample.joint_torque, [first, first], rtol=0, atol=1e-12)  # no law has moved yet
    assert sample.joint_angles.shape == (2, 4, 3) and starts.robot.joint_angles.shape == (2, 12)
    one = jax.jit(simulation.step)(simulation.reset())[1]
    np.testing.assert_allclose(one.joint_torque, first, rtol=0, atol=1e-12)
    both = simulation.reset({"stiffness": np.array([[1e3], [5e4]])})
    np.testing.assert_allclose(simulation.step(both)[1].joint_torque, sample.joint_torque, rtol=0, atol=1e-12)
    with pytest.raises(dataclasses.FrozenInstanceError):
        simulation.engine = "mjx"


def test_robots_have_the_precision_that_is_asked_for(scenario):
    carry = jax.eval_shape(lambda: mc.Simulation(scenario).reset(dtype=np.float32)).carry
    assert {value.dtype for value in vars(carry.state).values()} == {np.dtype(np.float32)}


@pytest.mark.nightly
def test_the_law_by_hand_is_the_law(simulation, walked, alone):
    """Joint targets as the law gave them, and the base shifted as the law shifted it, make the same walk."""
    samples = alone[1]
    for actions in (mc.JointTargets(samples.joint_targets), mc.BaseShift(samples.base_displacement)):
        again = walked(simulation.reset(), actions)[1]
        np.testing.assert_allclose(again.foot_force, samples.foot_force, rtol=0, atol=1e-8)
        np.testing.assert_allclose(again.joint_torque, samples.joint_torque, rtol=0, atol=1e-9)


@pytest.mark.nightly
def test_an_action_moves_the_robots(simulation, alone):
    """All of them, or each by its own."""
    up = mc.BaseShift(jnp.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0]))
    both = simulation.step(simulation.reset(batch=(2,)), up)[1]
    np.testing.assert_array_equal(both.base_displacement[:, 2], 0.01)
    assert np.abs(both.joint_targets - alone[1].joint_targets[0]).max(axis=(1, 2)).min() > 1e-3
    targets = jnp.stack([alone[1].joint_targets[0], both.joint_targets[0]])
    each = simulation.step(simulation.reset(batch=(2,)), mc.JointTargets(targets))[1]
    np.testing.assert_allclose(each.joint_targets, targets)


@pytest.mark.nightly
def test_some_robots_begin_again_while_others_go_on(simulation, walked):
    start, first = simulation.reset(batch=(2,)), jnp.array([True, False])
    state, _ = simulation.step(start)
    choose = lambda new, old: jnp.where(first.reshape(2, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
    again = jax.tree.map(choose, start, state)
    assert again.step.tolist() == [0, 1]
    sample = simulation.step(again)[1]
    np.testing.assert_allclose(sample.time, [0.0, simulation.scenario.time_step])
    np.testing.assert_allclose(sample.base_position[0], simulation.step(start)[1].base_position[0], rtol=0, atol=0)


@pytest.mark.nightly
def test_derivatives_by_an_action(simulation):
    """By central differences: in reverse the base's velocity after two steps, forward a torque after one."""

    def velocity(angle):
        state = simulation.reset()
        action = mc.JointTargets(state.carry.state.joint_angles.at[0, 1].add(angle))
        state, _ = jax.lax.scan(lambda state, _: simulation.step(state, action), state, length=2)
        return state.robot.base_linear_velocity[2]

    both = jax.jit(jax.value_and_grad(velocity))
    difference = (both(0.011)[0] - both(0.009)[0]) / 0.002
    np.testing.assert_allclose(both(0.01)[1], difference, rtol=1e-6)
    assert abs(difference) > 1e-3

    def torque(shift):
        return simulation.step(simulation.reset(), mc.BaseShift(jnp.zeros(6).at[0].set(shift)))[1].joint_torque[0, 1]

    along = jax.jit(lambda shift: jax.jvp(torque, (shift,), (1.0,)))
    tangent = along(1e-3)[1]
    np.testing.assert_allclose(tangent, (along(1.01e-3)[0] - along(0.99e-3)[0]) / 2e-5, rtol=1e-5)
    assert abs(tangent) > 1


@pytest.mark.slow
def test_equal_simulations_are_compiled_once(scenario, simulation):
    simulation.step(simulation.reset())
    compiled = []
    monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compiled.append(event))
    mc.Simulation(scenario).step(mc.Simulation(scenario).reset())
    assert not [event for event in compiled if "compile" in event]


@pytest.mark.slow
@pytest.mark.timing
def test_stepping_by_hand_is_nearly_as_fast_as_a_rollout(case):
    """One program against one program: `rollout_metrics` spreads its robots over the cores beside."""
    scenario, robots = case("case_1_2", "virtual_model", {"duration": 0.5, "gait.cycle": 0.5}), 1024
    simulation = mc.Simulation(scenario)

    def walk(state):
        def step(state, _):
            state, sample = jax.vmap(simulation.step)(state)
            return state, sample.foot_force[..., 2].max()

        return jax.lax.scan(step, state, length=scenario.steps)

    by_hand, simulate = jax.jit(walk), jax.jit(lambda gains: simulation.simulate(gains, parameters))
    gains = {"stiffness": np.geomspace(1e4, 1e5, robots, dtype=np.float32)[:, None]}
    parameters = mc.parameters(scenario, np.float32)
    start = simulation.reset(gains, dtype=np.float32)

    def seconds(run, *arguments):
        run(*arguments)
        return min(timeit.repeat(lambda: jax.block_until_ready(run(*arguments)), number=1, repeat=3))

    mine, theirs = seconds(by_hand, start), seconds(simulate, gains)
    print(f"by hand {robots * scenario.steps / mine:.3g} steps/s, a rollout {robots * scenario.steps / theirs:.3g}")
    assert theirs > 0.6 * mine


@pytest.mark.nightly
def test_gains_change_in_mid_walk(simulation, walked):
    """From then on it walks as a robot that began with them and was brought to this state; what is not given stays."""
    state, _ = walked(simulation.reset({"stiffness": 1e3, "kp": 40.0}))
    state = dataclasses.replace(state, step=0 * state.step)
    begun = simulation.reset({"stiffness": 1e3, "damping": 50.0, "kp": 60.0})
    law, memory = begun.carry.memory.law, state.carry.memory
    remembered = memory._replace(law=memory.law._replace(by=law.by))
    expected = walked(dataclasses.replace(begun, carry=state.carry._replace(memory=remembered)))[1]
    after, sample = simulation.step(state, gains={"damping": 50.0, "kp": 60.0})
    np.testing.assert_allclose(sample.joint_torque, expected.joint_torque[0], rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(simulation.step(after)[1].joint_torque, expected.joint_torque[1], rtol=1e-12, atol=1e-13)
    assert np.abs(walked(state)[1].joint_torque[0] - sample.joint_torque).max() > 1e-3
    np.testing.assert_array_equal(after.law.damping, [50.0] * 6)
    assert after.law.stiffness[0] == 1e3 and after.parameters.joint_loop.kp == 60.0
    with pytest.raises(ValueError, match=r"^gains: expected batch axes that broadcast to the state's \(\), got \(2,\)"):
        simulation.step(state, gains={"kp": np.ones(2)})


@pytest.mark.nightly
def test_gains_change_under_scan_and_of_some_robots(simulation):
    state = simulation.reset(batch=(2,))
    gains = {"stiffness": jnp.array([[1e3], [1e5]]) * jnp.ones((3, 1, 1))}
    _, together = jax.jit(lambda s: jax.lax.scan(lambda s, g: simulation.step(s, None, g), s, gains))(state)
    for row, stiffness in enumerate((1e3, 1e5)):
        one = simulation.reset({"stiffness": stiffness})
        for count in range(3):
            one, sample = simulation.step(one)
            np.testing.assert_allclose(together.joint_torque[count, row], sample.joint_torque, rtol=0, atol=1e-9)
