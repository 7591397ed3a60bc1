"""Robots stepped by hand walk as a rollout does, take actions, and are pure functions of state and action."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc

SHORT = {"duration": 0.2, "gait.cycle": 0.2, "disturbance.cargo.start": 0.1}
HISTORIES = ("base_position", "base_orientation", "joint_angles", "joint_torque", "foot_force", "support", "tsm")


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_1_2", "virtual_model", SHORT)


@pytest.fixture(scope="module")
def env(scenario):
    return mc.Environment(scenario)


@pytest.fixture(scope="module")
def walked(env):
    """Return a function that steps an environment from a state to the end of a walk, and all samples."""

    @jax.jit
    def walk(state, actions=None):
        return jax.lax.scan(env.step, state, actions, length=env.scenario.steps)

    return walk


@pytest.fixture(scope="module")
def alone(env, walked):
    return walked(env.reset())


def test_one_robot_walks_as_in_a_rollout_bit_for_bit(scenario, alone):
    trajectory = mc.rollout(scenario)
    for name in HISTORIES:
        np.testing.assert_array_equal(getattr(alone[1], name), getattr(trajectory, name), err_msg=name)


def test_robots_have_the_precision_that_is_asked_for(scenario):
    carry = jax.eval_shape(mc.Environment(scenario, dtype=np.float32).reset).carry
    assert {value.dtype for value in vars(carry.state).values()} == {np.dtype(np.float32)}


@pytest.mark.slow
def test_a_batch_walks_as_its_robots_do(scenario, env, walked):
    stiffness = np.array([1e3, 5e4, 1e5])
    _, together = walked(env.reset(gains={"stiffness": stiffness[:, None]}))
    for row, value in enumerate(stiffness):
        trajectory = mc.rollout(scenario, {"stiffness": value})
        np.testing.assert_allclose(together.foot_force[:, row], trajectory.foot_force, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_law_by_hand_is_the_law(env, walked, alone):
    """Joint targets as the law gave them, and the base shifted as the law shifted it, make the same walk."""
    samples = alone[1]
    _, targets = walked(env.reset(), mc.JointTargets(samples.joint_targets))
    _, shifts = walked(env.reset(), mc.BaseShift(samples.base_displacement))
    for again in (targets, shifts):
        np.testing.assert_allclose(again.foot_force, samples.foot_force, rtol=0, atol=1e-8)
        np.testing.assert_allclose(again.joint_torque, samples.joint_torque, rtol=0, atol=1e-9)


def test_an_action_moves_the_robot(env, alone):
    up = env.step(env.reset(), mc.BaseShift(jnp.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])))[1]
    assert np.abs(up.joint_targets - alone[1].joint_targets[0]).max() > 1e-3
    assert up.base_displacement[2] == 0.01


@pytest.mark.slow
def test_some_robots_begin_again_while_others_go_on(env, walked):
    start = env.reset(batch=(2,))
    state, _ = env.step(start)
    again = jax.tree.map(
        lambda new, old: jnp.where(jnp.array([True, False]).reshape(2, *[1] * (new.ndim - 1)), new, old), start, state
    )
    assert again.step.tolist() == [0, 1]
    sample = env.step(again)[1]
    np.testing.assert_allclose(sample.time, [0.0, env.scenario.time_step])
    np.testing.assert_allclose(sample.base_position[0], env.step(start)[1].base_position[0], rtol=0, atol=0)


@pytest.mark.slow
def test_vmap_adds_an_axis(env):
    starts = jax.vmap(lambda k: env.reset(gains={"stiffness": k}))(jnp.array([1e3, 1e5]))
    _, sample = jax.vmap(env.step)(starts)
    assert sample.joint_angles.shape == (2, 4, 3)
    assert starts.robot.joint_angles.shape == (2, 12)


@pytest.mark.nightly
@pytest.mark.slow  # the reverse mode of a step takes a minute to compile
def test_derivatives_by_an_action(scenario):
    """Forward and reverse agree with central differences of the base's velocity after two steps."""
    env = mc.Environment(scenario, in_pieces=False)

    def velocity(angle):
        state = env.reset()
        targets = state.carry.state.joint_angles.T.at[0, 1].add(angle)
        for _ in range(2):
            state, _ = env.step(state, mc.JointTargets(targets))
        return state.robot.base_linear_velocity[2]

    forward, reverse = jax.jacfwd(velocity)(0.01), jax.grad(velocity)(0.01)
    difference = (velocity(0.011) - velocity(0.009)) / 0.002
    np.testing.assert_allclose([forward, reverse], difference, rtol=1e-6)
    assert abs(difference) > 1e-3


def test_forward_derivatives_of_pieces(scenario):
    env = mc.Environment(scenario, in_pieces=True)
    state = env.reset()

    @jax.jit
    def torque(shift):
        return env.step(state, mc.BaseShift(jnp.zeros(6).at[0].set(shift)))[1].joint_torque[0, 1]

    slope = jax.jvp(torque, (1e-3,), (1.0,))[1]
    np.testing.assert_allclose(slope, (torque(1.01e-3) - torque(0.99e-3)) / 2e-5, rtol=1e-5)
    assert abs(slope) > 1


@pytest.mark.slow
def test_reverse_mode_of_pieces_is_refused(scenario):
    env = mc.Environment(scenario, in_pieces=True)
    state = env.reset()

    def torque(shift):
        return env.step(state, mc.BaseShift(jnp.full(6, shift)))[1].joint_torque.sum()

    with pytest.raises(NotImplementedError, match="in_pieces=False"):
        jax.grad(torque)(0.0)


def test_hardware_that_is_not_compiled_is_refused(scenario, env):
    late = dataclasses.replace(mc.parameters(scenario), force_delay=jnp.asarray(0.005))
    with pytest.raises(ValueError, match="hardware"):
        env.reset(late)


def test_equal_environments_are_compiled_once(scenario, env):
    from mjx_climb.rollouts import environment

    env.step(env.reset())
    before = environment._stepped._cache_size()
    other = mc.Environment(scenario)
    other.step(other.reset())
    assert environment._stepped._cache_size() == before


@pytest.mark.slow
@pytest.mark.timing
def test_stepping_by_hand_is_half_as_fast_as_a_rollout(case):
    """One program against one program: `rollout_metrics` spreads its robots over the cores beside."""
    scenario = case("case_1_2", "virtual_model", {"duration": 0.5, "gait.cycle": 0.5})
    robots = 1024
    env = mc.Environment(scenario, dtype=np.float32)

    def walk(state):
        def step(state, _):
            state, sample = env.step(state)
            return state, sample.foot_force[..., 2].max()

        return jax.lax.scan(step, state, length=scenario.steps)

    pieces = mc.pieces_pay("limb")
    options = mc.compiler_options(robots, in_pieces=pieces)
    by_hand = jax.jit(walk, compiler_options=options)
    simulate = jax.jit(mc.simulator(scenario, in_pieces=pieces), compiler_options=options)
    gains = {"stiffness": np.geomspace(1e4, 1e5, robots, dtype=np.float32)[:, None]}
    numbers = mc.parameters(scenario, np.float32)
    start = env.reset(gains=gains)

    def seconds(run):
        run()
        best = np.inf
        for _ in range(3):
            begin = time.perf_counter()
            run()
            best = min(best, time.perf_counter() - begin)
        return best

    mine = seconds(lambda: jax.block_until_ready(by_hand(start)))
    theirs = seconds(lambda: jax.block_until_ready(simulate(gains, numbers)))
    print(f"by hand {robots * scenario.steps / mine:.3g} steps/s, a rollout {robots * scenario.steps / theirs:.3g}")
    assert theirs > 0.5 * mine


def test_gains_change_in_mid_walk(env, walked):
    """From then on it walks as a robot that began with them and was brought to this state; what is not given stays."""
    first = {"stiffness": 1e3, "kp": 40.0}
    state, _ = walked(env.reset(gains=first))
    state = dataclasses.replace(state, step=0 * state.step)
    begun = env.reset(gains={"stiffness": 1e3, "damping": 50.0, "kp": 60.0})
    expected = walked(dataclasses.replace(begun, carry=state.carry))[1]
    after, sample = env.step(state, gains={"damping": 50.0, "kp": 60.0})
    np.testing.assert_array_equal(sample.joint_torque, expected.joint_torque[0])
    np.testing.assert_array_equal(env.step(after)[1].joint_torque, expected.joint_torque[1])
    assert np.abs(walked(state)[1].joint_torque[0] - sample.joint_torque).max() > 1e-3
    np.testing.assert_array_equal(after.law.damping, [50.0] * 6)
    assert after.law.stiffness[0] == 1e3 and after.parameters.kp == 60.0
    with pytest.raises(ValueError, match=r"^gains: expected batch axes that broadcast to the state's \(\), got \(2,\)"):
        env.step(state, gains={"kp": np.ones(2)})


@pytest.mark.slow
def test_gains_change_under_scan_and_of_some_robots(env):
    state = env.reset(batch=(2,))
    gains = {"stiffness": jnp.array([[1e3], [1e5]]) * jnp.ones((3, 1, 1))}
    _, together = jax.jit(lambda s: jax.lax.scan(lambda s, g: env.step(s, None, g), s, gains))(state)
    for row, stiffness in enumerate((1e3, 1e5)):
        one = env.reset(gains={"stiffness": stiffness})
        for count in range(3):
            one, sample = env.step(one)
            np.testing.assert_allclose(together.joint_torque[count, row], sample.joint_torque, rtol=0, atol=1e-9)
