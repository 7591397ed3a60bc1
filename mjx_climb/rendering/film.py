"""Pictures of one walk, or of several side by side in sync: frames, snapshots, and their files (PNG, H.264 in MP4)."""

import functools
import io
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from mjx_climb.files.writing import whole, write_bytes_atomically
from mjx_climb.mujoco_import import mujoco
from mjx_climb.rendering import marks, surroundings
from mjx_climb.rendering.camera import Follower, pose, row_at
from mjx_climb.rendering.canvas import Canvas
from mjx_climb.rendering.captions import Caption, ForceTrace, controller
from mjx_climb.rollouts.trajectory import Trajectory

TRACE = 0.16  # of a film's height
FPS, SIZE, PAIR_SIZE = 25, (1280, 720), (960, 720)
SNAPSHOTS, SNAPSHOT_SIZE = 4, (800, 600)
QUALITY = "20"  # x264's constant rate factor: smaller is better and larger


def pictures(
    trajectories: Sequence[Trajectory],
    times: Iterable[float],
    *,
    labels: Sequence[str] | None = None,
    size: tuple[int, int] = SIZE,
    trace: float = 0.0,
) -> Iterator[np.ndarray]:
    """Yield the pictures of walks at some times (s), as `frames` does; `trace` is the share of the force's trace."""
    check(trajectories, labels, size)
    count, strip = len(trajectories), 2 * round(trace * size[1] / 2)
    traces = [ForceTrace(trajectories, number, (size[0], strip)) for number in range(count) if strip]
    size = size[0], size[1] - strip
    model = surroundings.of(trajectories)
    data = mujoco.MjData(model)
    fovy = float(model.vis.global_.fovy)
    follower, scale = Follower(trajectories, fovy, size[0] / size[1]), marks.scale(trajectories)
    focal = size[1] / (2 * np.tan(np.deg2rad(fovy) / 2))  # pixels
    captions = [
        Caption(trajectory, controller(trajectory) if labels is None else labels[number], size, scale)
        for number, trajectory in enumerate(trajectories)
    ]
    with Canvas(model, *size) as canvas:
        for time in map(float, times):
            view, panels = follower.at(time), []
            for number, trajectory in enumerate(trajectories):
                row = row_at(trajectory, time)
                pose(model, data, trajectory, row)
                around = functools.partial(marks.around, trajectory=trajectory, row=row)
                forces = functools.partial(marks.forces, trajectory=trajectory, row=row, scale=scale)
                picture = canvas.draw(data, view, around, forces)
                legend = None if number < count - 1 else focal / view.distance
                panel = captions[number].draw(picture, row, view, legend)
                if traces:
                    panel = np.concatenate([panel, traces[number].at(time)])
                if number:
                    panel[:, :2] = 255  # a line between walks
                panels.append(panel)
            yield np.concatenate(panels, axis=1)


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
    shown = pictures(trajectories, instants, labels=labels, size=size)
    columns = [np.concatenate(np.split(picture, len(trajectories), axis=1)) for picture in shown]
    return np.concatenate(columns, axis=1)


def save_video(
    path: str | os.PathLike[str],
    *trajectories: Trajectory,
    labels: Sequence[str] | None = None,
    fps: int = FPS,
    size: tuple[int, int] = SIZE,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Write walks as an MP4 video, side by side and in sync, and return its path.

    The file is either whole or not there.

    Arguments:
        path: ends in .mp4.
        trajectories, labels, fps, size: as of `frames`.
        progress: called with how many frames are done, and of how many.

    Raises:
        RenderingError: no OpenGL on this machine.
        OutputError: the file cannot be written.
        ValueError: what cannot be shown.
    """
    check(trajectories, labels, size)
    shown, total = frames(*trajectories, labels=labels, fps=fps, size=size), frame_times(trajectories, fps).size
    return encode(path, shown, fps, (size[0] * len(trajectories), size[1]), lambda done: progress(done, total))


def encode(
    path: str | os.PathLike[str],
    pictures: Iterable[np.ndarray],
    fps: int,
    size: tuple[int, int],
    progress: Callable[[int], None] = lambda done: None,
) -> Path:
    """Write pictures (H, W, 3) uint8 of one size (W, H) as an H.264 video and return its path.

    Raises:
        OutputError: the file cannot be written.
    """
    import av

    # the index in front lets a browser start before all is there
    first = {"movflags": "+faststart"}
    with whole(path) as part, av.open(str(part), "w", format="mp4", options=first) as container:
        stream = container.add_stream("libx264", rate=Fraction(fps), options={"crf": QUALITY, "preset": "veryfast"})
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"  # what all players decode
        stream.codec_context.time_base = Fraction(1, fps)
        for done, picture in enumerate(pictures, 1):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            progress(done)
        container.mux(stream.encode(None))
    return Path(path)


def save_image(path: str | os.PathLike[str], picture: np.ndarray) -> Path:
    """Write a picture (H, W, 3) uint8 as PNG and return its path.

    Raises:
        OutputError: the file cannot be written.
    """
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=True)
    return write_bytes_atomically(path, buffer.getvalue())
