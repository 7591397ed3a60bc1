"""What of a walk is shown: the row at a time, the pose of the model in it, and a camera that follows the walk."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.plots.events import finite_rows
from mjx_climb.rollouts.trajectory import Trajectory

AZIMUTH, ELEVATION = 98.0, -38.0  # degrees, at heading zero: to the robot's right, so high that no limb hides
MICROGRAVITY = 0.02  # m/s^2; below, there is no down
MARGIN = 1.12
TALLEST = 0.6  # m, a robot that flies off leaves the picture


def whole(trajectory: Trajectory) -> int:
    """Return how many rows can be shown: those before the state stops being finite, at least one."""
    return max(finite_rows(trajectory), 1)


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


@dataclasses.dataclass(frozen=True)
class View:
    """A camera: MuJoCo's free one, and which way is up in the picture."""

    target: np.ndarray  # (3,) m, world
    distance: float  # m
    azimuth: float  # degrees
    up: np.ndarray  # (3,) world, unit

    def camera(self) -> mujoco.MjvCamera:
        """Return MuJoCo's camera, whose up is always the world's z."""
        made = mujoco.MjvCamera()
        made.type = mujoco.mjtCamera.mjCAMERA_FREE
        made.lookat[:], made.distance = self.target, self.distance
        made.azimuth, made.elevation = self.azimuth, ELEVATION
        return made

    def axes(self) -> np.ndarray:
        """Return right, up and forward of the picture as rows, (3, 3) world."""
        azimuth, elevation = np.deg2rad([self.azimuth, ELEVATION])
        flat = np.cos(elevation)
        forward = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        up = self.up - (self.up @ forward) * forward
        up /= np.linalg.norm(up)
        return np.stack([np.cross(forward, up), up, forward])


def up(gravity: np.ndarray) -> np.ndarray:
    """Return which way is up, (3,) world: against gravity (3,) m/s^2, or the ground's normal where there is none."""
    strength = np.linalg.norm(gravity)
    return np.array([0.0, 0.0, 1.0]) if strength < MICROGRAVITY else -np.asarray(gravity) / strength


class Follower:
    """The view over time: it glides with the gait's base reference, far enough to show all feet and bases."""

    def __init__(self, trajectories: Sequence[Trajectory], fovy: float, aspect: float):
        first = max(trajectories, key=whole)
        scenario, rows = first.scenario, whole(first)
        self._time = first.time[:rows]
        self._path = _smoothed(first.base_reference[:rows], round(scenario.gait.cycle / scenario.time_step))
        self._up = up(np.asarray(scenario.gravity))
        self._azimuth = AZIMUTH + float(np.rad2deg(scenario.gait.heading))
        # the ball around what is to be seen must fit the narrower side of the picture
        half = np.deg2rad(fovy) / 2
        half = min(half, np.arctan(np.tan(half) * aspect * 0.8))
        self._distance = MARGIN * max(map(self._radius, trajectories)) / np.sin(half)

    def _radius(self, trajectory: Trajectory) -> float:
        """Return how far feet and base are from where the camera looks, m, at most."""
        rows = slice(0, whole(trajectory), 20)
        points = np.concatenate([trajectory.foot_position[rows], trajectory.base_position[rows, None]], axis=1)
        distance = np.linalg.norm(points - self._target(trajectory.time[rows])[:, None], axis=-1)
        return float(distance[np.isfinite(distance) & (distance < TALLEST)].max(initial=0.2))

    def _target(self, time: np.ndarray | float) -> np.ndarray:
        return np.stack([np.interp(time, self._time, line) for line in self._path.T], axis=-1)

    def at(self, time: float) -> View:
        """Return the view at a time, s."""
        return View(self._target(time) * [1, 1, 0.55], self._distance, self._azimuth, self._up)


def _smoothed(path: np.ndarray, window: int) -> np.ndarray:
    """Return the moving average of a path (T, 3) over `window` rows, its ends held."""
    padded = np.pad(path, ((window // 2, window - window // 2), (0, 0)), mode="edge")
    sums = np.cumsum(padded, axis=0)
    return np.asarray((sums[window:] - sums[:-window]) / window)
