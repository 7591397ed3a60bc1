"""Marks in the scene beside the robot: forces, grips, foot paths, cargo and pushes, as MuJoCo's geoms."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike

from mjx_climb.ground import holds_of
from mjx_climb.mujoco_import import mujoco
from mjx_climb.trajectory import Trajectory
from mjx_climb.viz.plots.events import size_of, whole
from mjx_climb.viz.plots.holds import SCALE
from mjx_climb.viz.plots.styling import LIMB_COLORS, ORANGE, RED, SKY, VERMILLION

RGB = tuple[float, float, float]  # a colour, in [0, 1]

# lengths beside HubRobo, others in proportion
LONGEST = 0.24  # m, of the largest arrow
SHORTEST = 0.004  # m, shorter ones are left out
SHAFT = 0.0045  # m, radius
PIECE = 0.004  # m, of a foot's path
PATH_STEP = 0.04  # s, between points of a foot's path
PATHS = LIMB_COLORS
PRESSED = to_rgb(SKY)
# from barely pulled to the holding limit; darker all the way, so that it also reads without colours
PULLED = (to_rgb("#FFF3A0"), to_rgb("#F0C020"), to_rgb(ORANGE), to_rgb(VERMILLION), to_rgb("#B00020"))
PUSH = to_rgb("#E24FB0")
GRIP, STRAP = (0.95, 0.95, 0.95), (0.25, 0.22, 0.18)
# points that can be held, of those around the base; a scene has room for some thousand shapes
MOST_HOLDS = 1000
ANY_HOLD = (0.74, 0.74, 0.74)
CARGO_DENSITY = 2600.0  # kg/m^3, of the box that stands for the cargo

_ARROW, _CAPSULE, _CYLINDER, _BOX = (
    getattr(mujoco.mjtGeom, f"mjGEOM_{name}") for name in ("ARROW", "CAPSULE", "CYLINDER", "BOX")
)


def scale(trajectories: Sequence[Trajectory]) -> float:
    """Return the length of an arrow of 1 N, m: one for all walks that are shown together."""
    largest = 1e-9
    for trajectory in trajectories:
        rows = whole(trajectory)
        rows = min(rows, 1 + int(np.argmax(trajectory.detached.any(1)))) if trajectory.detached.any() else rows
        forces = np.linalg.norm(trajectory.foot_force[:rows], axis=-1).max(1)
        # a kick of few milliseconds may be longer than that
        largest = max(largest, np.quantile(forces, 0.999), np.linalg.norm(trajectory.push[:rows, :3], axis=-1).max())
    return LONGEST * size_of(trajectories[0]) / float(largest)


def color(force: np.ndarray, limit: float | None) -> RGB:
    """Return the colour of a foot's force (3,) N: one where the ground presses, a scale where it pulls."""
    return pulled(float(np.linalg.norm(force)) / limit if limit else 0.0) if force[2] < 0 else PRESSED


def pulled(share: float) -> RGB:
    """Return the colour of a pull at this share of the holding limit."""
    places = np.linspace(0, 1, len(PULLED))
    red, green, blue = (float(np.interp(share, places, channel)) for channel in zip(*PULLED, strict=True))
    return red, green, blue


def forces(scene: mujoco.MjvScene, trajectory: Trajectory, row: int, scale: float) -> None:
    """Add an arrow for the force on every foot, one for the push on the base, and a cross on torn feet."""
    limit, size = trajectory.scenario.value("contact.holding_limit"), size_of(trajectory)
    for limb, force in enumerate(trajectory.foot_force[row]):
        foot = trajectory.foot_position[row, limb]
        arrow(scene, foot, foot + scale * force, color(force, limit), size)
        if trajectory.detached[row, limb] or trajectory.torn_off[row, limb]:
            for across in size * np.array([[0.028, 0.028, 0.0], [0.028, -0.028, 0.0]]):
                _connect(scene, _CAPSULE, 0.004 * size, (foot - across, foot + across), to_rgb(RED), emission=0.8)
    push = trajectory.push[row, :3]
    if scale * (strength := float(np.linalg.norm(push))) > SHORTEST * size:
        # it ends at the hull, not inside
        hit = trajectory.base_position[row] - 0.055 * size * push / strength
        arrow(scene, hit - scale * push, hit, PUSH, size, 1.5)


def around(scene: mujoco.MjvScene, trajectory: Trajectory, row: int) -> None:
    """Add the grip points and foot paths up to this row, the cargo, and the points that can be held.

    A disc is a point that a limb gripped, a larger one the point that it holds now.
    """
    holds(scene, trajectory, row)
    every = max(round(PATH_STEP / trajectory.scenario.time_step), 1)
    rows = np.unique([*range(0, row + 1, every), row])
    size = size_of(trajectory)
    rims = [(limb, to_rgb(PATHS[limb % len(PATHS)])) for limb in range(len(trajectory.limbs))]
    for limb, rim in rims:
        held, grips = trajectory.support[rows, limb], trajectory.grip_point[rows, limb]
        for point in np.unique(grips[held].round(3), axis=0):
            current = held[-1] and np.abs(point - grips[-1]).max() < 1e-3
            for wide, high, rgb in (
                (0.031 if current else 0.026, 0.0012, rim),
                (0.025 if current else 0.022, 0.0016, GRIP),
            ):
                _add(scene, _CYLINDER, size * np.array([wide, high, 0]), point, rgb)
    for limb, rgb in rims:
        start, *points = trajectory.foot_position[rows, limb]
        for point in points:
            if np.linalg.norm(point - start) > PIECE * size:
                _connect(scene, _CYLINDER, 0.0022 * size, (start, point), rgb, emission=0.5)
                start = point
    if (mass := float(trajectory.cargo_mass[row])) > 0:
        half, rotation = (mass / CARGO_DENSITY) ** (1 / 3) / 2, np.empty(9)
        mujoco.mju_quat2Mat(rotation, np.asarray(trajectory.base_orientation[row], float))
        position = trajectory.base_position[row] + rotation.reshape(3, 3)[:, 2] * (0.036 * size + half)
        for sides, rgb in (([1, 1, 1], to_rgb("#C9A227")), ([1.03, 0.2, 1.03], STRAP), ([0.2, 1.03, 1.03], STRAP)):
            _add(scene, _BOX, half * np.array(sides), position, rgb, rotation)


def holds(scene: mujoco.MjvScene, trajectory: Trajectory, row: int) -> None:
    """Add a disc for each point that can be held around the base, in the colour of the largest pull that it bears."""
    if (ground := holds_of(trajectory.scenario.ground)) is None:
        return
    points, size = ground.shown(), size_of(trajectory)
    away = np.linalg.norm(points.position - trajectory.base_position[row], axis=1)
    limited = np.isfinite(points.pull)
    largest = np.max(points.pull, where=limited, initial=1e-9)
    colors = np.where(
        limited[:, None], colormaps[SCALE](np.where(limited, points.pull / largest, 1.0))[:, :3], ANY_HOLD
    )
    for number in np.argsort(away, kind="stable")[:MOST_HOLDS]:
        rotation, turn = np.empty(9), np.empty(4)
        mujoco.mju_quatZ2Vec(turn, points.normal[number])
        mujoco.mju_quat2Mat(rotation, turn)
        red, green, blue = map(float, colors[number])
        disc = size * np.array([0.010, 0.0008, 0])
        _add(scene, _CYLINDER, disc, points.position[number], (red, green, blue), rotation)


def limb(scene: mujoco.MjvScene, points: np.ndarray, radius: float, color: str) -> None:
    """Add lines between the joints of a limb and its foot, (N, 3) m from the base outwards, and a ball at the foot."""
    for ends in itertools.pairwise(points):
        _connect(scene, _CAPSULE, radius / 2, ends, to_rgb(color), emission=0.8)
    _connect(scene, _CAPSULE, radius, (points[-1], points[-1] + 1e-5), to_rgb(color), emission=0.8)


def arrow(
    scene: mujoco.MjvScene, start: np.ndarray, end: np.ndarray, rgb: RGB, size: float = 1, width: float = 1
) -> None:
    """Add an arrow between two points, (3,) m, beside a robot of a size, so many times as thick as others."""
    if SHORTEST * size < np.linalg.norm(end - start) < 10 * LONGEST * size:  # longer: the walk has long failed
        # half of the light is its own: shaded, and still of the legend's colour
        red, green, blue = rgb
        _connect(scene, _ARROW, width * SHAFT * size, (start, end), (red / 2, green / 2, blue / 2), emission=1.3)


def _connect(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, width: float, ends: Sequence[np.ndarray], rgb: RGB,
    *, emission: float,
) -> None:  # fmt: skip
    """Add a geom between two points, (3,) m, that shines by itself."""
    start, end = ends
    if (geom := _add(scene, kind, np.zeros(3), np.zeros(3), rgb)) is None:
        return
    mujoco.mjv_connector(geom, kind, width, np.asarray(start, float), np.asarray(end, float))
    if kind == _ARROW:
        geom.size[2] *= 2  # MuJoCo draws an arrow half as long as its connector
    geom.emission = emission


def _add(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, size: ArrayLike, position: ArrayLike, rgb: RGB,
    rotation: ArrayLike = (1, 0, 0, 0, 1, 0, 0, 0, 1),
) -> mujoco.MjvGeom | None:  # fmt: skip
    """Add a geom and return it; none once the scene is full."""
    if scene.ngeom == scene.maxgeom:
        return None
    geom, rgba = scene.geoms[scene.ngeom], np.array([*rgb, 1.0], np.float32)
    mujoco.mjv_initGeom(geom, kind, *(np.asarray(values, float) for values in (size, position, rotation)), rgba)
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    scene.ngeom += 1
    return geom
