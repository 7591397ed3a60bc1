"""What must hold whatever the numbers: energy, static equilibrium, and no preferred direction."""

import dataclasses
import math

import jax
import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.physics.kinematics import center_of_mass, foot_jacobian, foot_kinematics, limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_model, load_robot
from tests.physics.mujoco_dynamics import set_state

MODEL = load_model("hubrobo_v3_2")
# all four grip from 0.4 s to 10 s, standing on the spot
STANDING = (
    ("gait.cycle", 40.0), ("gait.duty", 0.99), ("gait.stride", 0.0), ("gait.step_height", 1e-6),
    ("disturbance.cargo.mass", 0.0), ("disturbance.pushes", []), ("contact.holding_limit", None),
)  # fmt: skip


def energy(trajectory, step):
    """Return kinetic energy plus that of the joint and contact springs, J, without gravity."""
    tr, sc = trajectory, trajectory.scenario
    data = mujoco.MjData(MODEL)
    set_state(data, *(getattr(tr, field.name)[step] for field in dataclasses.fields(State)))
    mujoco.mj_fwdPosition(MODEL, data)
    mujoco.mj_energyVel(MODEL, data)
    joints = sc.control.kp / 2 * np.sum((tr.joint_targets - tr.joint_angles)[step] ** 2)
    return data.energy[1] + joints + sc.contact.stiffness / 2 * np.sum((tr.foot_position - tr.grip_point)[step] ** 2)


@pytest.fixture(scope="module")
def standing(case):
    """Return a scenario of a robot that stands still on four grips, by law."""

    def scenario(law, **changes):
        return case("case_2", law, (*STANDING, *((key.replace("__", "."), value) for key, value in changes.items())))

    return scenario


@pytest.mark.nightly
def test_energy_of_an_undamped_grip(standing, walk):
    """Springs alone: the energy of a pushed robot stays for 6 s, in a band that narrows with the time step."""
    push = [{"force": [2.0, 4.0, -6.0], "moment": [0.1, 0.04, 0.06], "start": 0.6, "stop": 0.7}]
    undamped = {"contact__damping": 0.0, "control__kd": 0.0, "gravity": [0.0, 0.0, 0.0], "disturbance__pushes": push}
    band = []
    for time_step in (1e-3, 5e-4):
        trajectory = walk(standing("pd", **undamped, time_step=time_step))
        late = np.arange(round(0.7 / time_step), len(trajectory.time), round(0.01 / time_step))
        course = np.array([energy(trajectory, step) for step in late])
        assert course.mean() > 1e-3
        first, last = course[: len(course) // 2], course[len(course) // 2 :]
        assert abs(last.mean() / first.mean() - 1) < 2e-3
        band.append(np.std(course) / np.mean(course))
    assert band[0] < 0.05
    assert 1.8 < band[0] / band[1] < 2.2


def static_shift(gravity, stiffness=None):
    """Return the shift (6,) of a base standing at its reference on four grips, by linear statics.

    Each limb is its joint springs and its contact spring in series: the foot gives way by J kp^-1 J^T + 1 / k_s. The
    weight of the limbs bends their joints too. An admittance law with `stiffness` yields to the wrench -w / K on top.
    """
    robot, kp, k_s = load_robot("hubrobo_v3_2"), 50.0, 1e4
    still = np.zeros(3)
    state = State(
        robot.stance_position, robot.stance_orientation, still, still, robot.stance_joints, 0 * robot.stance_joints
    )
    frames = limb_frames(robot, None, state.joint_angles)
    feet = jax.tree.map(np.asarray, foot_kinematics(robot, frames, state))
    jacobians = quaternion_to_matrix(robot.stance_orientation) @ foot_jacobian(robot, frames)
    mass = robot.total_mass
    lever = np.asarray(center_of_mass(robot, frames, state, 0.0)) - state.base_position
    weight = np.concatenate([mass * gravity, np.cross(lever, mass * gravity)])
    # MuJoCo's bias at rest is minus the generalised force of gravity
    model = MODEL.__copy__()
    model.opt.gravity[:] = gravity
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[0]
    mujoco.mj_forward(model, data)
    joint_weight = -data.qfrc_bias[6:].reshape(4, 3)
    matrix, load = np.zeros((6, 6)), weight.copy()
    for limb in range(4):
        jacobian, r = jacobians[limb], feet.lever[limb]
        grip_stiffness = np.linalg.inv(jacobian @ jacobian.T / kp + np.eye(3) / k_s)
        rigid = np.hstack([np.eye(3), np.cross(r, np.eye(3))])
        matrix += rigid.T @ grip_stiffness @ rigid
        load -= rigid.T @ grip_stiffness @ jacobian @ joint_weight[limb] / kp
    shift = np.linalg.solve(matrix, load)
    return shift if stiffness is None else shift + weight / stiffness


GRAVITY = np.array([0.02, -0.01, -0.1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "stiffness", "tilt"),
    [pytest.param("pd", None, 2.5e-4, marks=pytest.mark.slow), ("virtual_model", 500.0, 4e-3)],
)
def test_sag_is_that_of_the_springs_in_series(standing, walk, law, stiffness, tilt):
    """The settled sag on a slope is that of joints, contacts (and admittance) in series, to 1.2e-4, so is the tilt."""
    changes = {"gravity": list(GRAVITY), "control__damping": 50.0, "control__stiffness": stiffness or 1.0}
    trajectory = walk(standing(law, **changes))
    assert np.abs(trajectory.base_linear_velocity[-1]).max() < 1e-8
    expected = static_shift(GRAVITY, stiffness)
    moved = trajectory.base_position[-1] - trajectory.base_reference[-1]
    turned = 2 * trajectory.base_orientation[-1, 1:]
    assert np.linalg.norm(moved - expected[:3]) < 1.2e-4 * np.linalg.norm(expected[:3])
    assert np.linalg.norm(turned - expected[3:]) < tilt * np.linalg.norm(expected[3:])


def turned(vector, angle):
    c, s = math.cos(angle), math.sin(angle)
    return [c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]]


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", ["pd", "virtual_model", "end_effector", pytest.param("measured_pose", marks=pytest.mark.nightly)]
)
def test_no_direction_is_preferred(case, walk, law):
    """Case 2 on a slope, turned about z as a whole, gives the same metrics, unequal gains per axis included."""
    pushes = [push.model_dump() for push in case("case_2", law).disturbance.pushes]
    gravity = [0.1, -0.05, -0.3]
    gains = {  # unlike in x, y and z
        "control.inertia": [1.0, 2.0, 0.5, 0.01, 0.02, 0.03],
        "control.damping": [2e2, 5e2, 1e3, 5.0, 3.0, 8.0] if law != "measured_pose" else 5e3,
        "control.stiffness": [2e3, 9e3, 5e3, 40.0, 80.0, 60.0] if law != "measured_pose" else 2e4,
    }
    if law == "measured_pose":
        gains = {"control.inertia": [1.0, 1.2, 0.9, 1.1, 1.0, 0.8]} | {
            "control.damping": [5e3, 4e3, 6e3, 5e3, 3e3, 4e3], "control.stiffness": [2e4, 3e4, 1e4, 2e4, 1e4, 3e4]
        }  # fmt: skip
    results = []
    for angle in (0.0, 0.7):
        there = [{**p, "force": turned(p["force"], angle), "moment": turned(p["moment"], angle)} for p in pushes]
        changes = gains | {"gravity": turned(gravity, angle), "disturbance.pushes": there, "gait.heading": angle}
        results.append(mc.metrics(walk(case("case_2", law, changes))))
    straight, rotated = results
    assert not straight["diverged"]
    for name, value in straight.items():
        assert rotated[name] == (pytest.approx(value, rel=1e-9) if isinstance(value, float) else value), name
