"""MuJoCo's interactive viewer on a replay."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.rendering import film, marks, surroundings
from mjx_climb.rendering.backend import require_display
from mjx_climb.rendering.camera import Follower, pose, row_at
from mjx_climb.rendering.captions import controller
from mjx_climb.rollouts.trajectory import Trajectory

PAUSE = 1.0  # s, at the end of a walk, before the next one starts
GROUND_ALPHA = 0.6  # pulling forces point into the ground


def view(*trajectories: Trajectory, rounds: int | None = None, until: Callable[[], bool] = lambda: False) -> None:
    """Show walks one after the other in MuJoCo's viewer, in real time and over and over, until its window is closed.

    Arguments:
        trajectories: walks of one robot; they share the scale of the forces.
        rounds: how often they are shown; None: until the window is closed.
        until: asked for every frame; the window closes where it says so.

    Raises:
        RenderingError: no display, or no window can be opened on it.
        ValueError: no walk, or walks of different robots.
    """
    film.check(trajectories, None, film.SIZE)
    require_display()
    model = surroundings.of(trajectories)
    model.geom(surroundings.GROUND).rgba[3] = model.mat("paint").rgba[3] = GROUND_ALPHA
    model.light("sun").castshadow = False  # such a ground takes none
    data, scale = mujoco.MjData(model), marks.scale(trajectories)
    start = Follower(trajectories, float(model.vis.global_.fovy), 1.5).at(0.0)
    length = film.length(trajectories)
    pose(model, data, trajectories[0], 0)
    with _window(model, data) as window:
        with window.lock():
            window.cam.lookat[:], window.cam.distance = start.target, start.distance
            window.cam.azimuth, window.cam.elevation = start.azimuth, start.camera().elevation
        begin = time.perf_counter()
        while window.is_running() and not until():
            shown, now = divmod(time.perf_counter() - begin, length + PAUSE)
            if rounds is not None and shown >= rounds * len(trajectories):
                break
            trajectory = trajectories[int(shown) % len(trajectories)]
            row = row_at(trajectory, now)
            with window.lock():
                pose(model, data, trajectory, row)
                window.user_scn.ngeom = 0
                marks.around(window.user_scn, trajectory, row)
                marks.forces(window.user_scn, trajectory, row, scale)
            window.set_texts((None, None, *words(trajectory, row)))
            window.sync()
            time.sleep(1 / 60)


@contextlib.contextmanager
def _window(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[Any]:
    """Open MuJoCo's viewer without its panels; on leaving, wait until its thread has ended.

    A process that ends before the thread that draws dies of a segmentation fault.
    """
    from mujoco.viewer import launch_passive

    others = set(threading.enumerate())
    try:
        with launch_passive(model, data, show_left_ui=False, show_right_ui=False) as window:
            yield window
    finally:
        for thread in set(threading.enumerate()) - others:
            thread.join()


def words(trajectory: Trajectory, row: int) -> tuple[str, str]:
    """Return names and values to write into the window."""
    forces = np.linalg.norm(trajectory.foot_force[row], axis=-1)
    limb = int(forces.argmax())
    names = ["controller", "time", "largest force"]
    values = [controller(trajectory), f"{trajectory.time[row]:.2f} s", f"{forces[limb]:.1f} N"]
    values[-1] += f" at {trajectory.limbs[limb]}" if forces[limb] else ""
    torn = [name for name, lost in zip(trajectory.limbs, trajectory.detached[row], strict=True) if lost]
    if torn:
        names.append("torn off")
        values.append(", ".join(torn))
    return "\n".join(names), "\n".join(values)
