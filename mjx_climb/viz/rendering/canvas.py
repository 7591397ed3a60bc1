"""Pictures of a MuJoCo model from a context without a window, and the camera that follows a walk."""

import dataclasses
import importlib
from collections.abc import Callable, Sequence

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.trajectory import Trajectory
from mjx_climb.viz.plots.events import row_at, size_of, whole
from mjx_climb.viz.rendering import backend

AZIMUTH, ELEVATION = 98.0, -38.0  # degrees, at heading zero: to the robot's right, so high that no limb hides
MICROGRAVITY = 0.02  # m/s^2; below, there is no down
MARGIN = 1.12
STRAYS = 0.15  # m, of HubRobo's: a base that strays farther from its reference is followed
LOST = 30.0  # m, of HubRobo's: a walk whose base has come so far shows where it was before
FARTHEST = 0.6  # m, of HubRobo's: parts farther from its base do not fit into the picture
LOOKED_AT = 40  # instants of a walk, at which the robot's extent is measured
MAX_GEOMS = 4000
OPAQUE = 70  # of 255: a mark at least this bright hides the picture behind it

Draw = Callable[[mujoco.MjvScene], None]


def pose(model: mujoco.MjModel, data: mujoco.MjData, trajectory: Trajectory, row: int) -> None:
    """Put the model where the robot was."""
    data.qpos[:3] = trajectory.base_position[row]
    data.qpos[3:7] = trajectory.base_orientation[row]
    data.qpos[7:] = trajectory.joint_angles[row].ravel()
    data.time = trajectory.time[row]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)


def shown_rows(walk: Trajectory) -> int:
    """Return how many rows can be drawn: those before the state stops being finite, or the base is far away."""
    rows = whole(walk)
    away = np.linalg.norm(walk.base_position[:rows] - walk.base_reference[:rows], axis=-1)
    lost = away > LOST * size_of(walk)
    return max(int(lost.argmax()), 1) if lost.any() else rows


@dataclasses.dataclass(frozen=True)
class View:
    """A camera: MuJoCo's free one, turned so that down is down in the picture."""

    target: np.ndarray  # (3,) m, world
    distance: float  # m
    azimuth: float  # degrees
    gravity: np.ndarray  # (3,) m/s^2, world; the ground's normal is up where there is none

    def axes(self) -> np.ndarray:
        """Return right, up and forward of the picture as rows, (3, 3) world."""
        azimuth, elevation = np.deg2rad([self.azimuth, ELEVATION])
        flat = np.cos(elevation)
        forward = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        up = np.array([0.0, 0.0, 1.0]) if np.linalg.norm(self.gravity) < MICROGRAVITY else -self.gravity
        up = up - (up @ forward) * forward
        up /= np.linalg.norm(up)
        return np.stack([np.cross(forward, up), up, forward])


def follower(
    trajectories: Sequence[Trajectory], model: mujoco.MjModel, aspect: float
) -> Callable[[Trajectory, float], View]:
    """Return the view of one of some walks over time, s.

    It glides with the gait's base reference, which all walks share, and with a robot that strays far from it. All links
    and feet of all walks fit into the picture.
    """
    first, size = max(trajectories, key=whole), size_of(trajectories[0])
    scenario, rows = first.scenario, whole(first)
    # the moving average over a cycle, the path's ends held
    window = round(scenario.gait.cycle / scenario.time_step)
    padded = np.pad(first.base_reference[:rows], ((window // 2, window - window // 2), (0, 0)), mode="edge")
    sums = np.cumsum(padded, axis=0)
    path = (sums[window:] - sums[:-window]) / window

    def followed(walk: Trajectory, time: float) -> np.ndarray:
        row = min(row_at(walk, time), shown_rows(walk) - 1)
        strays = walk.base_position[row] - walk.base_reference[row]
        beyond = max(0.0, 1 - STRAYS * size / max(float(np.linalg.norm(strays)), 1e-9))
        return np.asarray([np.interp(time, first.time[:rows], line) for line in path.T] + beyond * strays)

    data, seen = mujoco.MjData(model), []  # m, places of links and feet, relative to the camera's path
    for walk in trajectories:
        for row in np.unique(np.linspace(0, shown_rows(walk) - 1, LOOKED_AT).round().astype(int)):
            pose(model, data, walk, row)
            points = np.concatenate([data.xpos[1:], data.geom_xpos[model.geom_bodyid > 0], walk.foot_position[row]])
            near = np.linalg.norm(points - walk.base_position[row], axis=-1) < FARTHEST * size
            seen.append(points[near] - followed(walk, float(walk.time[row])))
    places = np.concatenate(seen)
    middle = (places.min(0) + places.max(0)) / 2
    radius = float(np.linalg.norm(places - middle, axis=-1).max())  # of a ball that fits the picture's narrower side
    half = np.deg2rad(float(model.vis.global_.fovy)) / 2
    distance = MARGIN * radius / np.sin(min(half, np.arctan(np.tan(half) * aspect * 0.8)))
    azimuth, gravity = AZIMUTH + float(np.rad2deg(scenario.gait.heading)), np.asarray(scenario.gravity)
    return lambda walk, time: View(followed(walk, time) + middle, distance, azimuth, gravity)


class Canvas:
    """An offscreen picture of `width` by `height` pixels; a context manager that frees its OpenGL context.

    Raises:
        RenderingError: no OpenGL on this machine.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        self._model = model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._gl = importlib.import_module(f"mujoco.{backend.find()}").GLContext(width, height)
        self._gl.make_current()
        self.scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = 0

    def __enter__(self) -> "Canvas":
        return self

    def __exit__(self, *_: object) -> None:
        self._context.free()
        self._gl.free()

    def draw(self, data: mujoco.MjData, view: View, on_top: Draw, inside: Draw | None = None) -> np.ndarray:
        """Return the picture of a pose, (height, width, 3) uint8.

        `inside` adds geoms among the model's, `on_top` such that nothing hides: an arrow inside a leg or the ground.
        """
        scene = self.scene
        camera, everything = mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL.value
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE  # its up is the world's z
        camera.lookat[:], camera.distance = view.target, view.distance
        camera.azimuth, camera.elevation = view.azimuth, ELEVATION
        mujoco.mjv_updateScene(self._model, data, self._options, None, camera, everything, scene)
        for geom in scene.geoms[: scene.ngeom]:
            # the ground casts no shadow: on itself it is specks, as fine as the cells of the shadow map
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and self._model.geom_bodyid[geom.objid] == 0:
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        up = view.axes()[1]
        for eye in scene.camera:
            eye.up[:] = up
        if inside is not None:
            inside(scene)
        picture = self._render()

        scene.ngeom = 0
        on_top(scene)
        if scene.ngeom:
            flags = scene.flags.copy()
            scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0
            marks = self._render()
            scene.flags[:] = flags
            rows, columns = (np.flatnonzero(marks.any(axes)) for axes in ((1, 2), (0, 2)))
            if rows.size:  # lay the marks, which are on black, over the picture; their soft edges stay soft
                part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
                over = marks[part].astype(np.float32)
                share = np.minimum(over.max(-1, keepdims=True) / OPAQUE, 1)
                picture[part] = np.minimum(picture[part] * (1 - share) + over, 255)
        return picture

    def _render(self) -> np.ndarray:
        pixels = np.empty((self._rectangle.height, self._rectangle.width, 3), np.uint8)
        self._gl.make_current()
        mujoco.mjr_render(self._rectangle, self.scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._rectangle, self._context)
        return pixels[::-1].copy()  # OpenGL's rows go upwards
