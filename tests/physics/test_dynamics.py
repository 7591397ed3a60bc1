"""Every engine of the dynamics: against ClimbLab's reference vectors, MuJoCo's own C code, and a changed MJCF."""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.physics.kinematics import foot_kinematics, limb_frames
from mjx_climb.physics.state import State, integrate
from mjx_climb.robot_import.load import load_model, load_robot
from mjx_climb.walk.metrics import FAILURES
from tests.physics.mujoco_dynamics import apply, relative_error, set_state

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "dynamics_vectors.json").read_text())
CASES = REFERENCE["cases"]
GRAVITY = tuple(REFERENCE["conventions"]["gravity_world"])
MASS = REFERENCE["model"]["total_mass"]
STEPS, MOTIONS = 1000, 4


engines = pytest.mark.parametrize(
    "engine", [pytest.param(name, marks=[pytest.mark.slow] * (name == "mjx")) for name in mc.ENGINES]
)


@functools.partial(jax.jit, static_argnames=("engine", "robot"))  # one program, where eager JAX compiles hundreds
def dynamics(state, tau, foot_force, push, cargo, engine, robot="hubrobo_v3_2"):
    return mc.forward_dynamics(state, tau, foot_force, push, cargo, gravity=GRAVITY, robot=robot, engine=engine)


def test_whole_numbers_as_torques_are_those_numbers():
    """The state decides about the precision."""
    rng = np.random.default_rng(2)
    with jax.enable_x64(True):
        state = State(rng.normal(size=3), np.array([1.0, 0, 0, 0]), *rng.normal(size=(2, 3)), *rng.normal(size=(2, 12)))
        feet = np.zeros((4, 3)), np.zeros(6), 0.0
        whole, real = (dynamics(state, np.arange(12, dtype=kind), *feet, "limb") for kind in (int, float))
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(real), strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == np.float64


def of_cases(part, name):
    return jnp.asarray([case[part][name] for case in CASES], float)


@pytest.fixture(scope="module")
def states():
    names = ("base_pos_world", "base_quat_wxyz", "base_linvel_world", "base_angvel_world", "q", "qd")
    return State(*(of_cases("inputs", name) for name in names))


@pytest.fixture(scope="module")
def forces():
    push = of_cases("inputs", "base_force_world_F0")
    return of_cases("inputs", "tau"), of_cases("inputs", "foot_force_world"), jnp.pad(push, ((0, 0), (0, 3)))


@engines
def test_accelerations_are_those_of_climblab(engine, states, forces):
    """The equations of motion, foot forces and base force included, hold for robots in any state."""
    ours = vars(dynamics(states, *forces, 0.0, engine)).values()
    for value, name in zip(ours, ("base_linacc_world_vd0", "base_angacc_world_wd0", "qdd"), strict=True):
        assert relative_error(value, of_cases("dynamics", name)) < 1e-8


def test_feet_are_where_climblab_has_them(states):
    """Forward kinematics and the true foot velocity (not ClimbLab's) of robots in any state."""
    robot = load_robot("hubrobo_v3_2")
    by_limb = {name: getattr(states, name).reshape(-1, 4, 3) for name in ("joint_angles", "joint_rates")}
    one = lambda state: foot_kinematics(robot, limb_frames(robot, None, state.joint_angles), state)  # noqa: E731
    feet = jax.jit(jax.vmap(one))(dataclasses.replace(states, **by_limb))
    np.testing.assert_allclose(feet.position, of_cases("kinematics", "foot_pos_world"), atol=1e-12)
    np.testing.assert_allclose(feet.velocity, of_cases("kinematics", "foot_linvel_world_true"), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("engine", [pytest.param(n, marks=[pytest.mark.nightly] * (n == "mjx")) for n in mc.ENGINES])
def test_one_state_without_batch_axes(engine, states, forces):
    """A state without batch axes has the accelerations that it has as one of a batch."""
    batch = dynamics(states, *forces, 0.5, engine)
    alone = dynamics(*jax.tree.map(lambda a: a[3], (states, *forces)), 0.5, engine)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[3], rtol=1e-12), alone, batch)


@pytest.mark.nightly
@engines
def test_a_second_of_motion_is_that_of_mujoco(engine):
    """Random torques, foot forces, pushes and gravity; cargo comes and goes: our steps are mj_step's."""
    rng = np.random.default_rng(0)
    robot = load_robot("hubrobo_v3_2")

    def held(scale, *shape):
        """Random values (motion, step, ...), each held for 50 steps."""
        return np.repeat(rng.normal(scale=scale, size=(MOTIONS, STEPS // 50, *shape)), 50, axis=1)

    torque, foot_force, push = held(0.02, 4, 3), held(0.2, 4, 3), held(0.2, 6)
    push[..., 3:] *= 0.05
    cargo = np.zeros((MOTIONS, STEPS))
    cargo[:, 300:700] = np.linspace(0, 1, MOTIONS)[:, None]
    gravity = rng.normal(scale=3.0, size=(MOTIONS, 3))
    orientation = rng.normal(size=(MOTIONS, 4))
    start = State(
        base_position=rng.normal(size=(MOTIONS, 3)),
        base_orientation=orientation / np.linalg.norm(orientation, axis=1, keepdims=True),
        base_linear_velocity=rng.normal(scale=0.1, size=(MOTIONS, 3)),
        base_angular_velocity=rng.normal(scale=0.3, size=(MOTIONS, 3)),
        joint_angles=robot.stance_joints + rng.normal(scale=0.2, size=(MOTIONS, 4, 3)),
        joint_rates=rng.normal(scale=0.3, size=(MOTIONS, 4, 3)),
    )
    forward_dynamics = mc.ENGINES[engine](jax.tree.map(jnp.asarray, robot))

    @jax.jit
    @jax.vmap
    def move(state, gravity, forces):
        def step(state, forces):
            after = integrate(state, forward_dynamics(state, *forces, gravity), 1e-3)
            return after, after

        return jax.lax.scan(step, state, forces)[1]

    ours = jax.tree.map(np.asarray, move(start, gravity, (torque, foot_force, push, cargo)))
    for motion in range(MOTIONS):
        model = load_model("hubrobo_v3_2").__copy__()
        model.opt.gravity[:] = gravity[motion]
        mass, data = model.body_mass[1], mujoco.MjData(model)
        set_state(data, *(value[motion] for value in vars(start).values()))
        for step in range(STEPS):
            model.body_mass[1] = mass + cargo[motion, step]
            apply(model, data, torque[motion, step].ravel(), foot_force[motion, step], push[motion, step])
            mujoco.mj_step(model, data)
            angular = Rotation.from_quat(data.qpos[3:7], scalar_first=True).apply(data.qvel[3:6])
            theirs = data.qpos[:3], data.qpos[3:7], data.qvel[:3], angular, data.qpos[7:], data.qvel[6:]
            for (name, value), expected in zip(vars(ours).items(), theirs, strict=True):
                assert np.abs(value[motion, step].ravel() - expected).max() < 1e-9, (name, step)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["case_1_1", "case_2"])
def test_engines_agree_over_a_walk(case, name):
    """Eight seconds of walking are the same under every engine to 1e-9, in value and in derivative."""
    scenario = case(name, "virtual_model")
    at = jnp.log(jnp.array([scenario.control.damping, scenario.control.stiffness]))

    def values_and_tangents(engine):
        def metrics(logarithms):
            damping, stiffness = jnp.exp(logarithms)
            gains = mc.Gains(jnp.ones(6), damping * jnp.ones(6), stiffness * jnp.ones(6))
            return mc.simulator(scenario, engine=engine)(gains)

        push = lambda direction: jax.jvp(metrics, (at,), (direction,))  # noqa: E731
        return jax.jit(jax.vmap(push, out_axes=(None, 0)))(jnp.eye(2))

    first, *others = (values_and_tangents(engine) for engine in mc.ENGINES)
    for metric in (metric for metric in mc.METRICS.names if metric not in FAILURES):
        for values, tangents in others:
            np.testing.assert_allclose(values[metric], first[0][metric], rtol=1e-9, err_msg=metric)
            np.testing.assert_allclose(tangents[metric], first[1][metric], rtol=1e-9, atol=1e-12, err_msg=metric)
