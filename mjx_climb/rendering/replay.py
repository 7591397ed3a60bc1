"""A walk as rows to show: which rows, and the pose of the model in them."""

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.rollouts.trajectory import Trajectory


def whole(trajectory: Trajectory) -> int:
    """Return how many rows there are before the state stops being finite, at least one."""
    finite = np.isfinite(trajectory.base_position).all(1) & np.isfinite(trajectory.foot_position).all((1, 2))
    finite &= np.isfinite(trajectory.joint_angles).all((1, 2)) & np.isfinite(trajectory.foot_force).all((1, 2))
    return max(int(finite.size if finite.all() else finite.argmin()), 1)


def row_at(trajectory: Trajectory, time: float) -> int:
    """Return the row nearest to a time, s; the last finite one where the walk ended or diverged before."""
    row = round((time - float(trajectory.time[0])) / trajectory.scenario.time_step)
    return min(max(row, 0), whole(trajectory) - 1)


def pose(model: mujoco.MjModel, data: mujoco.MjData, trajectory: Trajectory, row: int) -> None:
    """Put the model where the robot was."""
    data.qpos[:3] = trajectory.base_position[row]
    data.qpos[3:7] = trajectory.base_orientation[row]
    data.qpos[7:] = trajectory.joint_angles[row].ravel()
    data.time = trajectory.time[row]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
