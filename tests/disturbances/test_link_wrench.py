"""A wrench on a link, against MuJoCo's C code and in a walk of a batch."""

import dataclasses

import jax
import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.disturbances.link_wrench import LinkWrench
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_model, load_robot

ROBOT = "hubrobo_v3_2"
FORCE, MOMENT, AT = np.array([3.0, -2.0, 1.0]), np.array([0.2, 0.1, -0.3]), np.array([0.03, -0.01, 0.02])
TOUCH = {"force": FORCE, "moment": MOMENT, "at": AT, "start": 0.1, "stop": 0.2}


def of_mujoco(state, limb, link, frame):
    """The generalised forces of the wrench by MuJoCo's C code, base (6,) and joints (limb, joint)."""
    model, robot = load_model(ROBOT), load_robot(ROBOT)
    data = mujoco.MjData(model)
    angles = np.asarray(state.joint_angles)
    data.qpos[:] = np.concatenate([state.base_position, state.base_orientation, angles.ravel()])
    mujoco.mj_forward(model, data)
    body = 2 + limb * robot.joints + link
    frames = limb_frames(robot, None, angles)
    base = data.xmat[1].reshape(3, 3)
    turned = base @ frames.rotation[limb, link]
    point = data.xpos[1] + base @ frames.position[limb, link] + turned @ AT
    force, moment = (turned @ FORCE, turned @ MOMENT) if frame == "link" else (FORCE, MOMENT)
    found = np.zeros(model.nv)
    mujoco.mj_applyFT(model, data, force, moment, point, body, found)
    # a free joint's moments are in the axes of its body
    return np.concatenate([found[:3], base @ found[3:6]]), found[6:].reshape(angles.shape)


@pytest.mark.parametrize("frame", ["world", "link"])
@pytest.mark.parametrize(("limb", "link"), [(0, 0), (2, 1), (3, 2)])
def test_a_wrench_is_that_of_mujoco(limb, link, frame):
    draw, robot = np.random.default_rng(limb), load_robot(ROBOT)
    turn = draw.normal(size=4)
    angles = robot.stance_joints + draw.uniform(-0.3, 0.3, robot.stance_joints.shape)
    still = np.zeros(3)
    state = State(draw.normal(size=3), turn / np.linalg.norm(turn), still, still, angles, 0 * angles)
    body = mc.Body(robot, limb_frames(robot, None, angles), jax.tree.map(jax.numpy.asarray, state))
    touch = LinkWrench(limb=float(limb), link=float(link), frame=frame, **TOUCH)
    wrench, torque = of_mujoco(state, limb, link, frame)
    found = touch.act(0.15, body)
    np.testing.assert_allclose(found.base_wrench, wrench, atol=1e-12)
    np.testing.assert_allclose(found.joint_torque, torque, atol=1e-12)
    assert not any(np.any(value) for value in touch.act(0.25, body))  # after its window


@pytest.mark.slow
def test_a_window_takes_the_steps_nearest_to_it(case):
    """A step counts where its middle is in the window."""
    scenario = case("case_1_2", "pd", {"duration": 0.3, "disturbance.cargo.mass": 0.0})
    window = TOUCH | {"start": 0.1004, "stop": 0.2004}
    touched = mc.Simulation(scenario, disturbances=[LinkWrench(limb=1.0, link=2.0, **window)]).rollout()
    acts = np.flatnonzero(np.abs(touched.push).sum(1))
    assert (acts[0], acts[-1], len(acts)) == (100, 199, 100)
    np.testing.assert_allclose(touched.push[acts, :3], FORCE[None] * np.ones((100, 1)), atol=1e-12)


@pytest.mark.nightly
def test_a_batch_is_touched_as_one_robot_is(case):
    """On the fast path, without a fall back: warnings are errors."""
    scenario = case("case_1_2", "pd", {"duration": 0.3})
    one = LinkWrench(limb=1.0, link=2.0, **TOUCH)
    force = FORCE * np.array([[0.5], [1.0], [2.0]])
    batch = mc.Simulation(scenario, disturbances=[dataclasses.replace(one, force=force)]).metrics()
    alone = mc.metrics(mc.Simulation(scenario, disturbances=[one]).rollout())
    assert batch["peak_foot_force"].shape == (3,)
    np.testing.assert_allclose(batch["peak_foot_force"][1], alone["peak_foot_force"], rtol=1e-4)
    assert len({*batch["peak_foot_force"].round(3)}) == 3
