"""Accelerations, momentum and energy by MuJoCo's C code, to compare ours with."""

import jax
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation


def relative_error(ours, theirs):
    """Return the largest error of a vector over the batch, relative to the vector's length."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    return (np.linalg.norm(ours - theirs, axis=-1) / np.linalg.norm(theirs, axis=-1)).max()


def stacked(acceleration):
    return np.concatenate([acceleration.base_linear, acceleration.base_angular, acceleration.joints], axis=-1)


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
    data.qpos[:] = np.concatenate([position, orientation, np.ravel(angles)])
    to_base = Rotation.from_quat(orientation, scalar_first=True).inv()
    data.qvel[:] = np.concatenate([linear, to_base.apply(np.array(angular)), np.ravel(rates)])


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
