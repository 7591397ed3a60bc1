"""Where the camera stands: one view that follows the walk, the same for all walks shown together."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.rendering.replay import whole
from mjx_climb.rollouts.trajectory import Trajectory

AZIMUTH, ELEVATION = 98.0, -38.0  # degrees, at heading zero: to the robot's right, so high that no limb hides
MICROGRAVITY = 0.02  # m/s^2; below, there is no down
MARGIN = 1.12
TALLEST = 0.6  # m, a robot that flies off leaves the picture


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
        forward = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
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
        self._distance = MARGIN * self._radius(trajectories) / np.sin(half)

    def _radius(self, trajectories: Sequence[Trajectory]) -> float:
        spans = []
        for trajectory in trajectories:
            rows = slice(0, whole(trajectory), 20)
            points = np.concatenate([trajectory.foot_position[rows], trajectory.base_position[rows, None]], axis=1)
            target = np.stack([np.interp(trajectory.time[rows], self._time, line) for line in self._path.T], -1)
            distance = np.linalg.norm(points - target[:, None], axis=-1)
            spans.append(distance[np.isfinite(distance) & (distance < TALLEST)].max(initial=0.2))
        return float(max(spans))

    def at(self, time: float) -> View:
        """Return the view at a time, s."""
        target = np.array([np.interp(time, self._time, line) for line in self._path.T])
        return View(target * [1, 1, 0.55], self._distance, self._azimuth, self._up)


def _smoothed(path: np.ndarray, window: int) -> np.ndarray:
    """Return the moving average of a path (T, 3) over `window` rows, its ends held."""
    padded = np.pad(path, ((window // 2, window - window // 2), (0, 0)), mode="edge")
    sums = np.cumsum(padded, axis=0)
    return np.asarray((sums[window:] - sums[:-window]) / window)
