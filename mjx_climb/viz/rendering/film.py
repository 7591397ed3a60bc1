"""Walks shown: frames, snapshots, films (PNG, H.264 in MP4), MuJoCo's viewer; and a robot from a file as it stands."""

import contextlib
import functools
import io
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from mjx_climb.files.writing import whole, write_bytes_atomically
from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot_import.bodies import foot_of
from mjx_climb.robot_import.description import bare, compiled, described
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import RobotFile
from mjx_climb.trajectory import Trajectory
from mjx_climb.viz.plots.events import row_at
from mjx_climb.viz.rendering import marks, surroundings
from mjx_climb.viz.rendering.backend import require_display
from mjx_climb.viz.rendering.canvas import AZIMUTH, ELEVATION, MARGIN, Canvas, View, follower, pose, shown_rows
from mjx_climb.viz.rendering.captions import Caption, ForceTrace, controller

TRACE = 0.16  # of a film's height
FPS, SIZE, PAIR_SIZE = 25, (1280, 720), (960, 720)
SNAPSHOTS, SNAPSHOT_SIZE = 4, (800, 600)
QUALITY = "20"  # x264's constant rate factor: smaller is better and larger
PAUSE = 1.0  # s, in the viewer, at the end of a walk, before the next one starts
GROUND_ALPHA = 0.6  # there, for pulling forces point into the ground
STANCE_MARK = 0.03  # of a robot's size, the radius of a mark
# neither light nor dark, so that light and dark robots stand out
STANCE_SKY, STANCE_GROUND = (0.56, 0.60, 0.65), (0.42, 0.45, 0.49, 1.0)


def pictures(
    trajectories: Sequence[Trajectory], times: Iterable[float], *, labels: Sequence[str] | None = None,
    size: tuple[int, int] = SIZE, trace: float = 0.0,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Yield the pictures of walks at some times (s), as `frames` does; `trace` is the share of the force's trace."""
    check(trajectories, labels, size)
    strip = 2 * round(trace * size[1] / 2)
    traces = [ForceTrace(trajectories, number, (size[0], strip)) for number in range(len(trajectories)) if strip]
    size = size[0], size[1] - strip
    model = surroundings.model(trajectories)
    data, fovy = mujoco.MjData(model), float(model.vis.global_.fovy)
    view_at, scale = follower(trajectories, model, size[0] / size[1]), marks.scale(trajectories)
    focal = size[1] / (2 * np.tan(np.deg2rad(fovy) / 2))  # pixels
    named = zip(trajectories, labels or map(controller, trajectories), strict=True)
    captions = [Caption(trajectory, label, size, scale) for trajectory, label in named]
    with Canvas(model, *size) as canvas:
        for instant in map(float, times):
            panels = []
            for number, trajectory in enumerate(trajectories):
                row, view = row_at(trajectory, instant), view_at(trajectory, instant)
                drawn = min(row, shown_rows(trajectory) - 1)
                pose(model, data, trajectory, drawn)
                forces = functools.partial(marks.forces, trajectory=trajectory, row=drawn, scale=scale)
                around = functools.partial(marks.around, trajectory=trajectory, row=drawn)
                picture = canvas.draw(data, view, forces, around)
                legend = focal / view.distance if number == len(trajectories) - 1 else None
                panel = captions[number].draw(picture, row, view, legend)
                if traces:
                    panel = np.concatenate([panel, traces[number].at(instant)])
                if number:
                    panel[:, :2] = 255  # a line between walks
                panels.append(panel)
            yield np.concatenate(panels, axis=1)


def check(trajectories: Sequence[Trajectory], labels: Sequence[str] | None, size: tuple[int, int]) -> None:
    """Refuse walks that cannot be shown together.

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
    *trajectories: Trajectory, labels: Sequence[str] | None = None, fps: float = FPS, size: tuple[int, int] = SIZE
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
        ValueError: as `check`.
    """
    yield from pictures(trajectories, frame_times(trajectories, fps), labels=labels, size=size, trace=TRACE)


def snapshots(
    *trajectories: Trajectory, count: int = SNAPSHOTS, times: Sequence[float] | None = None,
    labels: Sequence[str] | None = None, size: tuple[int, int] = SNAPSHOT_SIZE,
) -> np.ndarray:  # fmt: skip
    """Return a strip of snapshots, (walks H, snapshots W, 3) uint8: one row per walk, time from left to right.

    They are taken at `times`, s, else in the middles of `count` equal stretches of the walk; `size` is of one of them.
    All else, errors too, is as of `frames`.
    """
    instants = (np.arange(count) + 0.5) / count * length(trajectories) if times is None else times
    shown = pictures(trajectories, instants, labels=labels, size=size)
    columns = [np.concatenate(np.split(picture, len(trajectories), axis=1)) for picture in shown]
    return np.concatenate(columns, axis=1)


def save_video(
    path: str | os.PathLike[str], *trajectories: Trajectory, labels: Sequence[str] | None = None, fps: int = FPS,
    size: tuple[int, int] = SIZE, progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:  # fmt: skip
    """Write the `frames` of walks as an MP4 video and return its path; the file is either whole or not there.

    `progress` is called with how many frames are done, and of how many; all else is as of `frames`.

    Raises:
        RenderingError: no OpenGL on this machine.
        OutputError: the file cannot be written.
        ValueError: as `check`.
    """
    check(trajectories, labels, size)
    shown, total = frames(*trajectories, labels=labels, fps=fps, size=size), frame_times(trajectories, fps).size
    return encode(path, shown, fps, (size[0] * len(trajectories), size[1]), lambda done: progress(done, total))


def encode(
    path: str | os.PathLike[str], pictures: Iterable[np.ndarray], fps: int, size: tuple[int, int],
    progress: Callable[[int], None] = lambda done: None,
) -> Path:  # fmt: skip
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
        stream.pix_fmt = "yuv420p"  # all players decode it
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


def view(*trajectories: Trajectory, rounds: int | None = None, until: Callable[[], bool] = lambda: False) -> None:
    """Show walks of one robot one after the other in MuJoCo's viewer, in real time, until its window is closed.

    They share the scale of the forces and are shown over and over, or so many `rounds`; `until` is asked for every
    frame, and the window closes where it says so.

    Raises:
        RenderingError: no display, or no window can be opened on it.
        ValueError: no walk, or walks of different robots.
    """
    check(trajectories, None, SIZE)
    require_display()
    from mujoco.viewer import launch_passive

    model = surroundings.model(trajectories)
    model.geom(surroundings.GROUND).rgba[3] = model.mat("paint").rgba[3] = GROUND_ALPHA
    model.light("sun").castshadow = False  # such a ground takes none
    data, scale = mujoco.MjData(model), marks.scale(trajectories)
    start = follower(trajectories, model, 1.5)(trajectories[0], 0.0)
    pose(model, data, trajectories[0], 0)
    with _joined(), launch_passive(model, data, show_left_ui=False, show_right_ui=False) as window:
        with window.lock():
            window.cam.lookat[:], window.cam.distance = start.target, start.distance
            window.cam.azimuth, window.cam.elevation = start.azimuth, ELEVATION
        begin = time.perf_counter()
        while window.is_running() and not until():
            shown, now = divmod(time.perf_counter() - begin, length(trajectories) + PAUSE)
            if rounds is not None and shown >= rounds * len(trajectories):
                break
            trajectory = trajectories[int(shown) % len(trajectories)]
            row = min(row_at(trajectory, now), shown_rows(trajectory) - 1)
            with window.lock():
                pose(model, data, trajectory, row)
                window.user_scn.ngeom = 0
                marks.around(window.user_scn, trajectory, row)
                marks.forces(window.user_scn, trajectory, row, scale)
            window.set_texts((None, None, *viewer_words(trajectory, row)))
            window.sync()
            time.sleep(1 / 60)


@contextlib.contextmanager
def _joined() -> Iterator[None]:
    """Wait, on leaving, until all threads that began meanwhile have ended.

    A process that ends before the viewer's thread, which draws, dies of a segmentation fault.
    """
    others = set(threading.enumerate())
    try:
        yield
    finally:
        for thread in set(threading.enumerate()) - others:
            thread.join()


def viewer_words(trajectory: Trajectory, row: int) -> tuple[str, str]:
    """Return names and values to write into the window."""
    forces = np.linalg.norm(trajectory.foot_force[row], axis=-1)
    limb = int(forces.argmax())
    shown = {
        "controller": controller(trajectory),
        "time": f"{trajectory.time[row]:.2f} s",
        "largest force": f"{forces[limb]:.1f} N" + (f" at {trajectory.limbs[limb]}" if forces[limb] else ""),
    }
    if torn := [name for name, lost in zip(trajectory.limbs, trajectory.detached[row], strict=True) if lost]:
        shown["torn off"] = ", ".join(torn)
    return "\n".join(shown), "\n".join(shown.values())


def stance(robot: str | RobotFile) -> np.ndarray:
    """Return the picture of a robot from a file in its rest stance, (600, 800, 3) uint8.

    Raises:
        ValueError: a robot that is known by name.
        RenderingError: no OpenGL on this machine.
    """
    if isinstance(robot, str):
        raise ValueError(f"expected a robot from a file, got {robot!r}")
    spec = bare(robot.file, {body.name for body in described(robot.file).bodies})
    sky, plane = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtGeom.mjGEOM_PLANE
    flat, head = mujoco.mjtBuiltin.mjBUILTIN_FLAT, spec.visual.headlight
    head.ambient, head.diffuse, head.active = [0.4] * 3, [0.5] * 3, 1
    spec.add_texture(name="sky", type=sky, builtin=flat, rgb1=STANCE_SKY, rgb2=STANCE_SKY, width=64, height=384)
    ground = spec.worldbody.add_geom(type=plane, pos=[0, 0, 1], size=[10, 10, 0.1], rgba=STANCE_GROUND)
    ground.name = "ground of the picture"
    model = compiled(robot.file, spec)
    data, loaded = mujoco.MjData(model), load_robot(robot)
    limbs = [dict(robot.limbs.items())[name] for name in loaded.limbs]
    held = dict(robot.locked.items())
    for limb, angles in zip(limbs, loaded.stance_joints, strict=True):
        held |= zip(limb.joints, angles, strict=False)  # padded to the longest limb
    data.qpos[:] = model.qpos0
    for name, value in held.items():
        data.joint(name).qpos[:] = value
    mujoco.mj_kinematics(model, data)
    if robot.base is not None:  # the file has the foot upright that it begins at
        base = model.body(robot.base).id
        root = model.body_rootid[base]
        upright = data.xmat[base].reshape(3, 3).T @ data.xmat[root].reshape(3, 3)
        mujoco.mju_mat2Quat(model.body_quat[root], upright.ravel())
        mujoco.mj_kinematics(model, data)
    feet = np.array([foot_of(model, data, limb.foot, limb.at) for limb in limbs])
    model.geom(ground.name).pos[2] = feet[:, 2].mean()
    anchors = [data.xanchor[[model.joint(joint).id for joint in limb.joints]] for limb in limbs]
    hips = np.array([points[0] for points in anchors])
    places = np.concatenate([feet, *anchors])
    middle = (places.min(0) + places.max(0)) / 2
    half = float(np.linalg.norm(places - middle, axis=1).max())
    model.stat.extent, model.vis.map.znear, model.vis.map.zfar, model.vis.global_.fovy = half, 0.01, 100, 45
    away = MARGIN * half / np.sin(np.deg2rad(model.vis.global_.fovy / 2))

    def mark(scene: mujoco.MjvScene) -> None:
        for number, (joints, foot) in enumerate(zip(anchors, feet, strict=True)):
            # from the middle of the hips on: a trunk whose meshes are missing is there all the same
            points = np.array([hips.mean(0), *joints, foot])
            marks.limb(scene, points, STANCE_MARK * half, marks.PATHS[number % len(marks.PATHS)])

    mujoco.mj_forward(model, data)
    with Canvas(model, *SNAPSHOT_SIZE) as canvas:
        return canvas.draw(data, View(middle, away, AZIMUTH, np.zeros(3)), mark)
