"""Pictures of one walk, or of several side by side in sync: a film's frames, or a strip of snapshots."""

import contextlib
import functools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.rendering import marks, surroundings
from mjx_climb.rendering.camera import Follower
from mjx_climb.rendering.canvas import Canvas
from mjx_climb.rendering.captions import Caption, controller
from mjx_climb.rendering.force_trace import ForceTrace
from mjx_climb.rendering.replay import pose, row_at
from mjx_climb.rollouts.trajectory import Trajectory

PATH_STEP = 0.04  # s, between points of a foot's path
TRACE = 0.16  # of a film's height
FPS, SIZE, PAIR_SIZE = 25, (1280, 720), (960, 720)
SNAPSHOTS, SNAPSHOT_SIZE = 4, (800, 600)


class Shot:
    """Walks of one robot, ready to be drawn side by side with the same camera, scales and ground."""

    def __init__(
        self,
        trajectories: Sequence[Trajectory],
        labels: Sequence[str] | None,
        size: tuple[int, int],
        trace: float,
        stack: contextlib.ExitStack,
    ):
        check(trajectories, labels, size)
        strip = 2 * round(trace * size[1] / 2)
        self._traces = [ForceTrace(trajectories, i, (size[0], strip)) for i in range(len(trajectories)) if strip]
        size = size[0], size[1] - strip
        scenario = trajectories[0].scenario
        names = [controller(t) for t in trajectories] if labels is None else labels
        self._trajectories, self._size = trajectories, size
        grips = np.concatenate([marks.grip_points(t) for t in trajectories])
        middle = trajectories[0].base_reference[[0, -1], :2].mean(0)
        self._model = surroundings.model(scenario.robot, np.asarray(scenario.gravity), grips, middle)
        self._data = mujoco.MjData(self._model)
        fovy = float(self._model.vis.global_.fovy)
        self._camera = Follower(trajectories, fovy, size[0] / size[1])
        self._focal = size[1] / (2 * np.tan(np.deg2rad(fovy) / 2))  # pixels
        self._scale = marks.scale(trajectories)
        self._every = max(round(PATH_STEP / scenario.time_step), 1)
        last = len(trajectories) - 1
        self._captions = [
            Caption(t, name, size, self._scale, legend=number == last)
            for number, (t, name) in enumerate(zip(trajectories, names, strict=True))
        ]
        self._canvas = stack.enter_context(Canvas(self._model, *size))

    def at(self, time: float) -> np.ndarray:
        """Return the picture at a time (s), (H, walks W, 3) uint8."""
        view = self._camera.at(time)
        panels = []
        for trajectory, caption in zip(self._trajectories, self._captions, strict=True):
            row = row_at(trajectory, time)
            pose(self._model, self._data, trajectory, row)
            picture = self._canvas.draw(
                self._data,
                view,
                functools.partial(marks.around, trajectory=trajectory, row=row, every=self._every),
                functools.partial(marks.forces, trajectory=trajectory, row=row, scale=self._scale),
            )
            panels.append(caption.draw(picture, row, view, self._focal / view.distance))
        if self._traces:
            panels = [np.concatenate(pair) for pair in zip(panels, (t.at(time) for t in self._traces), strict=True)]
        for panel in panels[1:]:
            panel[:, :2] = 255  # a line between walks
        return np.concatenate(panels, axis=1)


def check(trajectories: Sequence[Trajectory], labels: Sequence[str] | None, size: tuple[int, int]) -> None:
    """Refuse what cannot be shown.

    Raises:
        ValueError: no walk, walks of different robots, a label too few or too many, or an impossible size.
    """
    if not trajectories:
        raise ValueError("expected at least one trajectory, got none")
    if len({t.scenario.robot for t in trajectories}) > 1:
        raise ValueError("expected walks of one robot, got several robots")
    if labels is not None and len(labels) != len(trajectories):
        raise ValueError(f"expected {len(trajectories)} labels, got {len(labels)}")
    if not all(64 <= pixels <= 4096 and pixels % 2 == 0 for pixels in size):
        raise ValueError(f"expected a size of even numbers from 64 to 4096 pixels, got {size[0]}x{size[1]}")


def length(trajectories: Sequence[Trajectory]) -> float:
    """Return how long the longest walk lasts, s."""
    return max(float(t.time[-1]) + t.scenario.time_step for t in trajectories)


def frame_times(trajectories: Sequence[Trajectory], fps: float = FPS) -> np.ndarray:
    """Return when frames are taken, (N,) s; they play in the time that the walk takes."""
    return np.arange(max(round(length(trajectories) * fps), 1)) / fps


def frames(
    *trajectories: Trajectory,
    labels: Sequence[str] | None = None,
    fps: float = FPS,
    size: tuple[int, int] = SIZE,
) -> Iterator[np.ndarray]:
    """Yield the frames of walks, side by side and in sync, each (H, walks W, 3) uint8.

    A foot's force is an arrow from the foot: light blue where the ground presses, yellow to red as a pull nears the
    holding limit. Pushes on the base are pink. Walks share camera and scales. Below runs the largest foot force over
    time, that of the walks beside it in grey.

    Arguments:
        trajectories: walks of one robot.
        labels: above each; its controller by default.
        fps: frames per second.
        size: width and height of one walk's picture, even numbers of pixels.

    Raises:
        RenderingError: no OpenGL on this machine.
        ValueError: what cannot be shown.
    """
    yield from pictures(trajectories, frame_times(trajectories, fps), labels=labels, size=size, trace=TRACE)


def pictures(
    trajectories: Sequence[Trajectory],
    times: Iterable[float],
    *,
    labels: Sequence[str] | None = None,
    size: tuple[int, int] = SIZE,
    trace: float = 0.0,
) -> Iterator[np.ndarray]:
    """Yield the pictures of walks at some times (s), as `frames` does; `trace` is the share of the force's trace."""
    with contextlib.ExitStack() as stack:
        shot = Shot(trajectories, labels, size, trace, stack)
        for time in times:
            yield shot.at(float(time))


def snapshot_times(trajectories: Sequence[Trajectory], count: int = SNAPSHOTS) -> np.ndarray:
    """Return the middles of `count` equal stretches of the walk, (count,) s."""
    return (np.arange(count) + 0.5) / count * length(trajectories)


def snapshots(
    *trajectories: Trajectory,
    count: int = SNAPSHOTS,
    times: Sequence[float] | None = None,
    labels: Sequence[str] | None = None,
    size: tuple[int, int] = SNAPSHOT_SIZE,
) -> np.ndarray:
    """Return a strip of snapshots, (walks H, snapshots W, 3) uint8: one row per walk, time from left to right.

    Arguments:
        trajectories: walks of one robot.
        count: number of snapshots, evenly spread over the walk.
        times: instants in place of `count`, s.
        labels: above each walk; its controller by default.
        size: width and height of one snapshot, even numbers of pixels.

    Raises:
        RenderingError: no OpenGL on this machine.
        ValueError: what cannot be shown.
    """
    instants = snapshot_times(trajectories, count) if times is None else times
    columns = [
        np.concatenate(np.split(picture, len(trajectories), axis=1))
        for picture in pictures(trajectories, instants, labels=labels, size=size)
    ]
    return np.concatenate(columns, axis=1)
