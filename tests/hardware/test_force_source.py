"""Where measured forces come from, and how they drift: statics by MuJoCo, the variance of a random walk."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.hardware import sensors
from mjx_climb.hardware.stages import IDEAL, hardware_of, stages_of
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_model, load_robot

STEP = 1e-3


def test_forces_by_efforts_hold_limbs_still():
    """Random poses, attitudes and gravity: MuJoCo's torques that hold the limbs under random forces on the feet."""
    random, robot = np.random.default_rng(3), load_robot("hubrobo_v3_2")
    model = load_model("hubrobo_v3_2").__copy__()
    model.opt.gravity[:] = gravity = random.normal(size=3) * 5
    data = mujoco.MjData(model)

    @jax.jit
    def by_efforts(state, torque):
        frames = limb_frames(robot, None, state.joint_angles)
        return sensors.effort_force(robot, frames, state, torque, jnp.asarray(gravity))

    for _ in range(5):
        angles = robot.stance_joints + 0.3 * random.normal(size=robot.stance_joints.shape)
        quaternion, forces = random.normal(size=4), 10 * random.normal(size=(4, 3))
        quaternion /= np.linalg.norm(quaternion)
        data.qpos[:] = np.concatenate([random.normal(size=3), quaternion, angles.ravel()])
        mujoco.mj_forward(model, data)
        torque = data.qfrc_bias.copy()
        for limb, force in enumerate(forces):
            columns = np.empty((3, model.nv))
            mujoco.mj_jacSite(model, data, columns, None, limb)
            torque -= columns.T @ force
        still = jnp.zeros(3)
        state = State(still, jnp.asarray(quaternion), still, still, jnp.asarray(angles), jnp.zeros((4, 3)))
        found = by_efforts(state, jnp.asarray(torque[6:].reshape(4, 3)))
        np.testing.assert_allclose(found, forces, rtol=1e-9, atol=1e-9)


def read(keys, force, steps, seeds=1):
    """What the sensors read of constant forces, (seeds, steps, limb, 3) N."""
    own = mc.parameters(mc.Scenario().with_overrides({"hardware.force_sensor": keys}))
    stages = stages_of(own, STEP)

    def one(seed):
        walking = dataclasses.replace(own, bus=dataclasses.replace(own.bus, seed=seed))
        hardware = hardware_of(walking, stages, STEP)
        begun = sensors.ForceSensor((), None, jnp.zeros_like(force) if stages.force_drift else None)
        return jax.lax.scan(lambda at, n: sensors.measured_force(at, force, n, hardware), begun, jnp.arange(steps))[1]

    return np.asarray(jax.vmap(one)(jnp.arange(float(seeds))))


def test_a_drift_is_a_random_walk():
    """Its variance grows with the time; its steps are independent of each other, of axis, sensor and seed."""
    drift, force = 0.7, jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)))
    bias = (read({"drift": drift}, force, 400, 200) - np.asarray(force)).reshape(200, 400, 12)
    for step in (99, 399):
        values, expected = bias[:, step].ravel(), drift**2 * (step + 1) * STEP
        assert abs(values.mean()) < 4 * np.sqrt(expected / values.size)
        assert values.var() == pytest.approx(expected, rel=4 * np.sqrt(2 / values.size))
    steps = np.diff(bias, axis=1)
    assert abs((steps[:, 1:] * steps[:, :-1]).mean()) < 4 * drift**2 * STEP / np.sqrt(steps[:, 1:].size)
    assert np.abs(np.corrcoef(steps.reshape(-1, 12).T) - np.eye(12)).max() < 4.5 / np.sqrt(steps[..., 0].size)


def test_one_axis_is_measured_along_z():
    force = jnp.arange(12.0).reshape(4, 3) + 1
    np.testing.assert_array_equal(read({"axes": "z"}, force, 1)[0, 0], np.asarray(force) * [0, 0, 1])


def test_sensors_of_three_axes_compile_no_stage():
    keys = {"hardware.force_sensor": {"source": "sensor", "axes": "xyz", "drift": 0.0}}
    assert stages_of(mc.parameters(mc.Scenario().with_overrides(keys)), STEP) == IDEAL
