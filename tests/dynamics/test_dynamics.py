"""Every engine of the dynamics: against ClimbLab's reference vectors, MuJoCo's own C code, and a changed MJCF."""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.dynamics.kinematics import foot_kinematics, limb_frames
from mjx_climb.dynamics.spatial import quaternion_to_matrix
from mjx_climb.dynamics.state import State, batch_last
from mjx_climb.robot import constants
from mjx_climb.robot.constants import load_model, load_robot, model_path, robot_from_model

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "dynamics_vectors.json").read_text())
CASES = REFERENCE["cases"]
GRAVITY = tuple(REFERENCE["conventions"]["gravity_world"])
MASS = REFERENCE["model"]["total_mass"]
STEPS, MOTIONS = 1000, 4


@functools.partial(jax.jit, static_argnames=("engine", "robot"))  # one program, where eager JAX compiles hundreds
def dynamics(state, tau, foot_force, push, cargo, engine, robot="hubrobo_v3_2"):
    return mc.forward_dynamics(state, tau, foot_force, push, cargo, gravity=GRAVITY, robot=robot, engine=engine)


# what all engines are called by is the same: MJX takes ten seconds to compile each time
ONE_OF_BOTH = pytest.mark.parametrize("engine", ["limb", pytest.param("mjx", marks=pytest.mark.slow)])


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


def relative_error(ours, theirs):
    """Return the largest error of a vector over the batch, relative to the vector's length."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    return (np.linalg.norm(ours - theirs, axis=-1) / np.linalg.norm(theirs, axis=-1)).max()


def test_accelerations_are_those_of_climblab(engine, states, forces):
    """The equations of motion, foot forces and base force included, hold for robots in any state."""
    ours = dynamics(states, *forces, 0.0, engine)
    assert relative_error(ours.base_linear, of_cases("dynamics", "base_linacc_world_vd0")) < 1e-8
    assert relative_error(ours.base_angular, of_cases("dynamics", "base_angacc_world_wd0")) < 1e-8
    assert relative_error(ours.joints, of_cases("dynamics", "qdd")) < 1e-8


def test_feet_are_where_climblab_has_them(states):
    """Forward kinematics and the true foot velocity (not ClimbLab's) of robots in any state."""
    hot, robot = batch_last(states, 4), load_robot("hubrobo_v3_2")
    frames = limb_frames(robot, quaternion_to_matrix(hot.base_orientation), hot.joint_angles)
    feet = foot_kinematics(robot, frames, hot)
    theirs = of_cases("kinematics", "foot_pos_world"), of_cases("kinematics", "foot_linvel_world_true")
    np.testing.assert_allclose(feet.position.T, theirs[0], atol=1e-12)
    np.testing.assert_allclose(feet.velocity.T, theirs[1], atol=1e-12)


@ONE_OF_BOTH
@pytest.mark.slow
def test_one_state_without_batch_axes(engine, states, forces):
    """A state without batch axes has the accelerations that it has as one of a batch."""
    batch = dynamics(states, *forces, 0.5, engine)
    alone = dynamics(*jax.tree.map(lambda a: a[3], (states, *forces)), 0.5, engine)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[3], rtol=1e-12), alone, batch)


def mujoco_acceleration(model, states, forces):
    """Return linear, angular (world axes) and joint accelerations by MuJoCo's C code under Earth gravity."""
    data, rows = mujoco.MjData(model), []
    arrays = jax.tree.map(np.asarray, (*vars(states).values(), *forces))
    for position, orientation, linear, angular, angles, rates, torque, foot_force, push in zip(*arrays, strict=True):
        set_state(data, position, orientation, linear, angular, angles, rates)
        apply(model, data, torque, foot_force, push)
        mujoco.mj_forward(model, data)
        rows.append(np.concatenate([data.qacc[:3], data.xmat[1].reshape(3, 3) @ data.qacc[3:6], data.qacc[6:]]))
    return np.array(rows)


def set_state(data, position, orientation, linear, angular, angles, rates):
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, orientation)
    data.qpos[:] = np.concatenate([position, orientation, angles])
    data.qvel[:] = np.concatenate([linear, rotation.reshape(3, 3).T @ angular, rates])


def apply(model, data, torque, foot_force, push):
    """Put joint torques, foot forces (4, 3) and the base wrench into the data of MuJoCo."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    data.xfrc_applied[1] = push
    data.qfrc_applied[:] = 0
    for site, force in enumerate(foot_force):
        body = model.site_bodyid[site]
        mujoco.mj_applyFT(model, data, force, np.zeros(3), data.site_xpos[site], body, data.qfrc_applied)
    data.qfrc_applied[6:] += torque


HEAVIER = (  # base and the first tibia, LF's
    model_path("hubrobo_v3_2")
    .read_text()
    .replace('mass="0.4417225774"', 'mass="0.9"', 1)
    .replace('mass="0.220163242967499"', 'mass="0.4"', 1)
)


def stacked(acceleration):
    return np.concatenate([acceleration.base_linear, acceleration.base_angular, acceleration.joints], axis=-1)


@ONE_OF_BOTH
def test_a_mass_changed_in_the_mjcf_changes_everywhere(engine, states, forces, monkeypatch, tmp_path):
    """A robot file with a heavier base and tibia: total mass and accelerations are those of MuJoCo on that file."""
    (tmp_path / "heavier.xml").write_text(HEAVIER)
    monkeypatch.setattr(constants, "model_path", lambda name: tmp_path / f"{name}.xml")
    robot = load_robot("heavier")
    assert robot.total_mass[0] == pytest.approx(MASS + 0.9 - 0.4417225774 + 0.4 - 0.220163242967499, rel=1e-12)
    ours = dynamics(states, *forces, 0.0, engine, "heavier")
    theirs = mujoco_acceleration(load_model("heavier"), states, forces)
    assert relative_error(stacked(ours), theirs) < 1e-9


@ONE_OF_BOTH
@pytest.mark.slow
def test_dynamics_of_a_robot_given_as_constants(engine, states, forces):
    """Constants read off any MuJoCo model are enough: the engine obeys them, not the file of the same name."""
    model = mujoco.MjModel.from_xml_string(HEAVIER)
    robot = robot_from_model(model, "hubrobo_v3_2")
    ours = jax.jit(lambda *given: mc.forward_dynamics(*given, 0.0, robot=robot, engine=engine))(states, *forces)
    assert relative_error(stacked(ours), mujoco_acceleration(model, states, forces)) < 1e-9


def test_cargo_is_mass_at_the_base(engine, states, forces):
    """Cargo changes inertia and weight as a point mass at the base's centre of mass does in the MJCF."""
    model = load_model("hubrobo_v3_2").__copy__()
    model.body_mass[1] += 1.0
    ours = dynamics(states, *forces, 1.0, engine)
    assert relative_error(stacked(ours), mujoco_acceleration(model, states, forces)) < 1e-9


def test_a_second_of_motion_is_that_of_mujoco(engine, open_loop):
    """Random torques, foot forces, pushes and gravity; cargo comes and goes: our steps are mj_step's."""
    rng = np.random.default_rng(0)
    robot = load_robot("hubrobo_v3_2")

    def held(scale, *shape):
        """Random values, each held for 50 steps."""
        return np.repeat(rng.normal(scale=scale, size=(STEPS // 50, *shape)), 50, axis=0)

    torque, foot_force, push = held(0.02, 3, 4, MOTIONS), held(0.2, 3, 4, MOTIONS), held(0.2, 6, MOTIONS)
    push[:, 3:] *= 0.05
    cargo = np.zeros((STEPS, MOTIONS))
    cargo[300:700] = np.linspace(0, 1, MOTIONS)
    gravity = rng.normal(scale=3.0, size=(3, MOTIONS))
    orientation = rng.normal(size=(4, MOTIONS))
    start = State(
        base_position=rng.normal(size=(3, MOTIONS)),
        base_orientation=orientation / np.linalg.norm(orientation, axis=0),
        base_linear_velocity=rng.normal(scale=0.1, size=(3, MOTIONS)),
        base_angular_velocity=rng.normal(scale=0.3, size=(3, MOTIONS)),
        joint_angles=robot.stance_joints + rng.normal(scale=0.2, size=(3, 4, MOTIONS)),
        joint_rates=rng.normal(scale=0.3, size=(3, 4, MOTIONS)),
    )
    ours = open_loop(engine)(start, torque, foot_force, push, cargo, gravity, np.full(MOTIONS, 1e-3))
    for motion in range(MOTIONS):
        model = load_model("hubrobo_v3_2").__copy__()
        model.opt.gravity[:] = gravity[:, motion]
        mass, data = model.body_mass[1], mujoco.MjData(model)
        flat = lambda a: a.T.ravel() if a.ndim == 2 else a  # noqa: E731
        set_state(data, *(flat(value[..., motion]) for value in vars(start).values()))
        for step in range(STEPS):
            model.body_mass[1] = mass + cargo[step, motion]
            forces = torque[step, ..., motion], foot_force[step, ..., motion], push[step, ..., motion]
            apply(model, data, flat(forces[0]), forces[1].T, forces[2])
            mujoco.mj_step(model, data)
            rotation = np.empty(9)
            mujoco.mju_quat2Mat(rotation, data.qpos[3:7])
            angular = rotation.reshape(3, 3) @ data.qvel[3:6]
            theirs = data.qpos[:3], data.qpos[3:7], data.qvel[:3], angular, data.qpos[7:], data.qvel[6:]
            for (name, value), expected in zip(vars(ours).items(), theirs, strict=True):
                error = np.abs(flat(np.asarray(value[step, ..., motion])) - expected).max()
                assert error < 1e-9, (name, step, error)
