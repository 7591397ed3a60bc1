"""How large a robot is: marks, ground and handrails are as large beside any robot as beside HubRobo."""

import numpy as np

from mjx_climb.trajectory import Trajectory

HUBROBO = 0.23  # m, between HubRobo's base and its feet, for which all lengths of pictures are written


def size_of(trajectory: Trajectory) -> float:
    """Return the robot's size in HubRobos: by the mean distance between base and feet where the walk begins."""
    away = np.linalg.norm(trajectory.foot_position[0] - trajectory.base_position[0], axis=-1)
    return float(away.mean()) / HUBROBO
