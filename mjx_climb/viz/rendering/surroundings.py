"""The ground of pictures: rock under gravity, the panels of a station without."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_climb.ground import holds_of
from mjx_climb.ground.holds import Shown
from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot_import.load import load_spec
from mjx_climb.trajectory import Trajectory
from mjx_climb.viz.plots.events import size_of, whole

GROUND = "relief"  # the geom's name
# lengths beside HubRobo, others in proportion
REACH = 1.8  # m, half the width of the ground that has relief
CELLS = 120  # of the relief, along each side
TEXTURE = 512  # pixels
PANEL = 0.35  # m, a panel of the station
LEVEL = 0.3  # of a normal's part along z: the surface of the ground, not of a body above it
MOST_GRIPS = 400  # of points that the relief follows
SINK = 0.003  # m, the ground lies this far below the grip points, which look like holds on it


class Style(NamedTuple):
    """Colours in [0, 1]; the relief is zero on the station."""

    name: str
    below: float  # m/s^2, gravity weaker than this looks so
    ground: tuple[float, float, float]
    sky: tuple[tuple[float, float, float], tuple[float, float, float]]  # zenith, horizon
    ambient: float
    sun: float
    relief: float  # m, height of the boulders around


STYLES = (
    Style("station", 0.02, (0.74, 0.76, 0.79), ((0.0, 0.0, 0.01), (0.02, 0.03, 0.06)), 0.30, 0.75, 0.0),
    Style("lunar", 2.7, (0.55, 0.54, 0.53), ((0.0, 0.0, 0.0), (0.03, 0.03, 0.04)), 0.24, 0.95, 0.16),
    Style("martian", 5.0, (0.64, 0.43, 0.31), ((0.62, 0.50, 0.42), (0.85, 0.72, 0.60)), 0.36, 0.75, 0.16),
    Style("earthly", np.inf, (0.56, 0.50, 0.43), ((0.36, 0.52, 0.72), (0.84, 0.89, 0.94)), 0.40, 0.70, 0.16),
)


def model(trajectories: Sequence[Trajectory]) -> mujoco.MjModel:
    """Return the model of walks of one robot on decorated ground, that of the first, just below all their grips.

    The strength of gravity chooses the looks.
    """
    scenario, size, grips = trajectories[0].scenario, size_of(trajectories[0]), []
    center = trajectories[0].base_reference[[0, -1], :2].mean(0)
    for walk in trajectories:
        rows = whole(walk)
        gripped = walk.grip_point[:rows][walk.contact[:rows] | walk.support[:rows]]
        grips.append(np.unique(gripped.round(3), axis=0) if gripped.size else walk.grip_point[0])
    if (holds := holds_of(scenario.ground)) is not None:
        grips.append(below(holds.shown()))
    looks = next(style for style in STYLES if np.linalg.norm(scenario.gravity) < style.below)
    spec = load_spec(scenario.robot)
    skybox, gradient = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    skies = [texture for texture in spec.textures if texture.type == skybox]
    for element in [*spec.worldbody.geoms, *spec.worldbody.lights, *skies]:
        spec.delete(element)
    dark, bright = looks.sky
    stars = {"mark": mujoco.mjtMark.mjMARK_RANDOM, "markrgb": [0.9] * 3, "random": 0.0008} if dark[2] < 0.1 else {}
    spec.add_texture(name="sky", type=skybox, builtin=gradient, rgb1=dark, rgb2=bright, width=512, height=3072, **stars)
    _add_ground(spec, looks, np.concatenate(grips), center, size)
    towards = np.array([0.28, 0.42, -1.0])  # low enough for the robot's shadow to lie beside it
    spec.worldbody.add_light(
        name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, castshadow=True, dir=towards,
        pos=[*center, 0.0] - 1.5 * size * towards, diffuse=[looks.sun] * 3, ambient=[0.0] * 3, specular=[0.25] * 3,
    )  # fmt: skip
    scene = spec.compile()
    quality, head, scene.vis.global_.fovy = scene.vis.quality, scene.vis.headlight, 30
    quality.shadowsize, quality.offsamples = 2048, 4
    quality.numslices, quality.numstacks = 20, 4  # a foot's path has hundreds of round pieces
    head.ambient[:], head.diffuse[:], head.specular[:] = looks.ambient, 0.18, 0.05
    scene.vis.map.znear, scene.vis.map.zfar = 0.02, 14
    scene.stat.extent, scene.stat.center[:] = 0.5 * size, [*center, 0.05 * size]
    return scene


def _add_ground(spec: mujoco.MjSpec, looks: Style, grips: np.ndarray, center: np.ndarray, size: float) -> None:
    random, station, side = np.random.default_rng(7), looks.name == "station", 2 * REACH
    if station:
        paint = _panels(random)
    else:  # rock: grain, stains and pits
        paint = 1 + 0.09 * _noise(random, TEXTURE, 1.1) + 0.05 * _noise(random, TEXTURE, 0.3)
        paint = np.where(_noise(random, TEXTURE, 0.8) > 2.2, 0.72 * paint, paint)
    pixels = np.clip(255 * paint[..., None] * np.asarray(looks.ground), 0, 255).astype(np.uint8)
    texture = spec.add_texture(name="paint", type=mujoco.mjtTexture.mjTEXTURE_2D, width=TEXTURE, height=TEXTURE)
    texture.nchannel, texture.data = 3, pixels.tobytes()
    material = spec.add_material(name="paint", texuniform=False, specular=0.1, shininess=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "paint"
    material.texrepeat = [side / (2 * PANEL)] * 2 if station else [3, 3]

    height = size * relief_of(random, looks.relief, (grips - [*center, 0.0]) / size)
    low, high = float(height.min()), float(height.max())
    span = max(high - low, 1e-3 * size)
    relief = spec.add_hfield(name=GROUND, nrow=CELLS, ncol=CELLS, size=[REACH * size, REACH * size, span, 0.1 * size])
    relief.userdata = ((height - low) / span).ravel()
    geom = spec.worldbody.add_geom(name=GROUND, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=GROUND)
    geom.pos, geom.material, geom.contype, geom.conaffinity, geom.group = [*center, low], "paint", 0, 0, 0
    for y in center[1] + size * np.array([-0.45, 0.45]) if station else ():  # handrails beside the way
        rail = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "contype": 0, "conaffinity": 0, "group": 0}
        rail["rgba"] = [0.86, 0.68, 0.16, 1]
        for left in center[0] + size * np.arange(-1.3, 1.3, 0.65):
            right, low, high = left + 0.5 * size, -0.01 * size, 0.05 * size
            spec.worldbody.add_geom(fromto=[left, y, high, right, y, high], size=[0.009 * size, 0, 0], **rail)
            for x in (left, right):
                spec.worldbody.add_geom(fromto=[x, y, low, x, y, high], size=[0.007 * size, 0, 0], **rail)


def below(holds: Shown) -> np.ndarray:
    """Points (n, 3) m that the ground passes below, of those that can be held: level ones, or the lowest of a body."""
    level = holds.position[holds.normal[:, 2] > LEVEL]
    if len(level) < len(holds.position):  # a pipe, a truss: the ground is all below it
        level = holds.position[[holds.position[:, 2].argmin()]]
    return np.asarray(level[:: max(len(level) // MOST_GRIPS, 1)])


def _noise(random: np.random.Generator, size: int, power: float, shortest: int = 2) -> np.ndarray:
    """Return periodic noise (size, size) whose spectrum falls with `power`, standard deviation 1."""
    waves = np.hypot(np.fft.fftfreq(size, 1 / size)[:, None], np.fft.rfftfreq(size, 1 / size))
    waves[0, 0] = np.inf
    spectrum = np.fft.rfft2(random.standard_normal((size, size))) / waves**power * (waves < size / shortest)
    noise = np.fft.irfft2(spectrum, (size, size))
    return np.asarray(noise / noise.std())


def _panels(random: np.random.Generator) -> np.ndarray:
    """Return the lightness of two by two panels, (TEXTURE, TEXTURE): seams, rivets, a little wear."""
    half = TEXTURE // 2
    rows, columns = np.indices((TEXTURE, TEXTURE))
    tint = np.array([[1.0, 0.93], [0.90, 0.97]])[rows // half, columns // half]
    paint = tint * (1 + 0.012 * _noise(random, TEXTURE, 1.0))
    across, along = rows % half, columns % half
    edge = np.minimum(np.minimum(across, half - across), np.minimum(along, half - along))
    paint = np.where(edge < 3, 0.45, np.where(edge < 6, 1.12 * paint, paint))
    period = half / 8
    distance = np.hypot((across % period) - period / 2, (along % period) - period / 2)
    return np.where((edge > 8) & (edge < 24) & (distance < 4), 0.6, paint)


def relief_of(random: np.random.Generator, boulders: float, grips: np.ndarray) -> np.ndarray:
    """Return the height of the ground, (CELLS, CELLS) m, rows along y, columns along x, centred.

    Close to the grips (N, 3) m it follows their heights; away from them rock rises up to `boulders`.
    """
    axis = np.linspace(-REACH, REACH, CELLS)[:, None]
    squares = (axis - grips[:, 0]) ** 2 + (axis[:, None] - grips[:, 1]) ** 2
    weights = 1 / (squares + 1e-3) ** 2
    ground = (weights * grips[:, 2]).sum(-1) / weights.sum(-1) - SINK
    if not boulders:
        return np.asarray(ground)
    distance = np.sqrt(squares.min(-1))
    away = np.clip((distance - 0.16) / 0.5, 0, 1) ** 1.5
    lumps = np.abs(_noise(random, CELLS, 2.0, 4)) + 0.25 * np.abs(_noise(random, CELLS, 1.2, 3))
    fine = np.abs(_noise(random, CELLS, 1.0))
    # close by only downwards: the feet stand on the grips
    near = -0.004 * fine * np.clip(distance / 0.03, 0, 1)
    return np.asarray(ground + near + away * boulders * 0.5 * lumps)
