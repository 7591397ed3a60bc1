"""How a robot may stand: as a keyframe has it, or where its joints are off their limits and its limbs not singular."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.description import FILLING, PASSIVE, RobotError
from mjx_climb.robot.found_limbs import Chain, at_zero
from mjx_climb.robot.posture import SINGULAR, keeps_attitude, limb_joints, smallest_singular_values
from mjx_climb.robot.robot_file import compiled_robot, unposed
from mjx_climb.scenario.model import Limb, RobotFile

_SHARES = (0.35, 0.5, 0.65, 0.2, 0.05, 0.8)  # of a limb's reach: how far out and how far down a foot may stand
STANDING = 3  # feet on the ground that keep a robot from swinging about them: grips of fewer limbs hold attitudes
_WELL = 0.15  # of a joint's range to its limits: more counts for no more
_MET = 1e-9  # m
_SAMPLES, _HEIGHTS, _TRIED = 3000, 15, 4  # postures at random, heights looked at, postures tried at each
_LOW = 0.2  # of a limb's reach: a base nearer to the ground is for robots that cannot stand higher
_OUTWARD = 0.3  # what a reach further out is worth, in shares of a joint's range
_IN_SPACE = 3  # driven joints of a limb that can put its foot anywhere


class Hip(NamedTuple):
    """Where a limb begins."""

    place: np.ndarray  # (3,) m, base link's frame, of the first joint
    reach: float  # m, length of all links


class Stance(NamedTuple):
    """Where the feet stand in the rest stance, and how high the base link's frame is."""

    height: float  # m
    footholds: np.ndarray  # (L, 2) m


def keyframe(model: mujoco.MjModel) -> int | None:
    """Return the keyframe that a robot stands in: by its name, or the first."""
    names = [model.key(k).name for k in range(model.nkey)]
    return next((names.index(n) for n in ("stance", "stand", "home") if n in names), 0 if names else None)


def _in_base(data: mujoco.MjData, base: int, point: np.ndarray) -> np.ndarray:
    return np.asarray(data.xmat[base].reshape(3, 3).T @ (point - data.xpos[base]))


def foot_of(model: mujoco.MjModel, data: mujoco.MjData, chain: Chain | Limb) -> np.ndarray:
    """Return where a limb's foot is, (3,) m in world axes; at a site as far off it as from a body."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, chain.foot)
    body = -1 if site >= 0 else model.body(chain.foot).id
    place, axes = (data.site_xpos[site], data.site_xmat[site]) if site >= 0 else (data.xpos[body], data.xmat[body])
    return np.asarray(place + axes.reshape(3, 3) @ np.array(chain.at))


def stretched(model: mujoco.MjModel, base: int, limbs: dict[str, Chain]) -> list[Hip]:
    """Return where limbs begin and how long they are."""
    data = at_zero(model)
    hips = []
    for chain in limbs.values():
        points = [*(data.xanchor[j] for j in chain.joints), foot_of(model, data, chain)]
        reach = sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(points))
        hips.append(Hip(_in_base(data, base, points[0]), float(reach)))
    return hips


def of_keyframe(model: mujoco.MjModel, base: int, limbs: dict[str, Chain], key: int) -> Stance | None:
    """Return how the robot stands in a keyframe, None with its feet above its base."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[key]
    mujoco.mj_kinematics(model, data)
    feet = np.array([_in_base(data, base, foot_of(model, data, chain)) for chain in limbs.values()])
    height = -float(feet[:, 2].mean())
    return Stance(height, feet[:, :2]) if height > 0 else None


def section_of(
    path: str,
    model: mujoco.MjModel,
    limbs: dict[str, Chain],
    held: dict[str, float],
    springs: dict[str, dict[str, float]],
) -> dict[str, Any]:
    """Return the section of a robot, without height and footholds."""
    named = {}
    for name, chain in limbs.items():
        named[name] = {"joints": [model.joint(j).name for j in chain.joints], "foot": chain.foot}
        if any(chain.at):
            named[name]["at"] = list(chain.at)
    section: dict[str, Any] = {"file": path, "height": 1.0, "limbs": named}
    return section | ({"locked": held} if held else {}) | ({"springs": springs} if springs else {})


def _source(section: dict[str, Any], footholds: np.ndarray) -> RobotFile:
    limbs = {
        name: limb | {"foothold": [float(v) for v in foothold]}
        for (name, limb), foothold in zip(section["limbs"].items(), footholds, strict=True)
    }
    return RobotFile.model_validate(section | {"limbs": limbs})


class _Posed(NamedTuple):
    """A robot that may stand in any way."""

    model: mujoco.MjModel
    rows: list[int]  # of the model's limbs among those of the section
    offset: np.ndarray  # (3,) m, the base's centre of mass in its link's frame

    @property
    def limits(self) -> np.ndarray:
        """Lower and upper limits of the joints, (2, L, N) rad."""
        limits: np.ndarray = self.model.jnt_range[1:].reshape(len(self.rows), -1, 2).transpose(2, 0, 1)
        return limits

    @property
    def driven(self) -> np.ndarray:
        """Which joints are driven, (L, N); those that only fill up a limb are not."""
        mask = ~np.isin(self.model.jnt_group[1:], (PASSIVE, FILLING))
        return np.reshape(mask, (len(self.rows), -1))


def _posed(section: dict[str, Any], footholds: np.ndarray) -> _Posed:
    """Return the robot; `footholds` (L, 2) m are somewhere about where the feet are to stand."""
    source = _source(section, footholds)
    spec, offset = unposed(source)
    model = compiled_robot(source, spec)
    order = [model.site(s).name.removesuffix("_foot") for s in range(model.nsite)]
    return _Posed(model, [list(section["limbs"]).index(name) for name in order], offset)


def judge(section: dict[str, Any], footholds: np.ndarray, missing: float = 0.0) -> Callable[[Stance], float]:
    """Return what tells the worth of a stance: below 0 a foot misses its place or a joint its limits, 0 is singular.

    It is the smallest singular value of the limbs' Jacobians, for what the grips hold, and less within `_WELL` of a
    joint's limit. `footholds` (L, 2) m are somewhere about where the feet are to stand. Limbs that cannot put a foot
    anywhere in space may miss their places by `missing` m.
    """
    posed = _posed(section, footholds)
    lower, upper = posed.limits
    near = np.where(posed.driven.sum(1) < _IN_SPACE, max(missing, _MET), _MET)
    turned = len(section["limbs"]) <= STANDING and keeps_attitude(posed.model)

    def worth(stance: Stance) -> float:
        feet = np.column_stack([stance.footholds, np.full(len(near), -stance.height)])[posed.rows] - posed.offset
        found = limb_joints(posed.model, feet)
        share = float((np.minimum(found.angles - lower, upper - found.angles) / (upper - lower)).min())
        if share <= 0 or not (found.errors < near).all():
            return -1.0
        least = float(smallest_singular_values(posed.model, found.angles, turned).min())
        return least * min(share / _WELL, 1.0) if least > SINGULAR else 0.0

    return worth


def checked(section: dict[str, Any], stance: Stance) -> Stance | None:
    """Return a stance to as few digits as will do, None where joints pass their limits, or it is singular."""
    worth = judge(section, stance.footholds)
    for digits in (4, 12):
        rounded = Stance(round(stance.height, digits), stance.footholds.round(digits))
        if worth(rounded) > 0:
            return rounded
    return None


def searched(path: str, section: dict[str, Any], hips: list[Hip]) -> Stance:
    """Return the stance of most worth among those with the feet some way out and down, or else at random.

    Raises:
        RobotError: none was found, or singular ones alone.
    """
    reach = min(hip.reach for hip in hips)
    places = np.array([hip.place for hip in hips])
    away = places[:, :2] / np.maximum(np.linalg.norm(places[:, :2], axis=1, keepdims=True), 1e-6)
    stances = []
    for out in _SHARES:
        for down in _SHARES:
            height = round(down * reach - float(places[:, 2].min()), 4)
            if np.hypot(out, down) < 1 and height > 0:
                stances.append(Stance(height, (places[:, :2] + out * reach * away).round(4)))
    posed = _posed(section, places[:, :2] + 0.5 * reach * away)
    best, most = None, -1.0
    if (posed.driven.sum(1) >= _IN_SPACE).all() and stances:
        worth = judge(section, stances[0].footholds)
        most, best = max(((worth(stance), stance) for stance in stances), key=lambda found: found[0])
    if most < 0:
        at_random = _sampled(posed, np.array([away[row] for row in posed.rows]), reach)
        best = None if at_random is None else checked(section, at_random)
        most = -1.0 if best is None else 1.0
    if best is None or most <= 0:
        expected = "a stance with all feet in reach below the base link, whose own z axis is up"
        singular = "singular ones alone: in them a limb cannot move its foot, or turn what its grip holds, every way"
        raise RobotError(f"{path}: expected {expected}, found {'none' if most < 0 else singular}")
    return best


def _sampled(posed: _Posed, away: np.ndarray, reach: float) -> Stance | None:
    """Return a stance from postures at random, at the height where the worst limb has most room; None: there is none.

    `away` (L, 2) are directions out from the base, of the model's limbs. What counts is room to the limits, and a foot
    far out.
    """
    model, (lower, upper), driven = posed.model, posed.limits, posed.driven
    slack = model.qpos_spring[7:].reshape(lower.shape)
    shares = np.random.default_rng(0).uniform(0.08, 0.92, (_SAMPLES, *lower.shape))
    postures = np.where(driven, lower + (upper - lower) * shares, np.clip(slack, lower, upper))
    feet = np.array([_feet(model, posture) for posture in postures]) + posed.offset
    room = np.where(driven, np.minimum(shares, 1 - shares), 1.0).min(2)
    worth = room + _OUTWARD * (feet[..., :2] * away).sum(2) / reach
    depths = -feet[..., 2]
    best, most = None, -np.inf
    low, high = (float(np.quantile(depths, share)) for share in (0.02, 0.98))
    for height in np.linspace(max(low, min(_LOW * reach, high)), high, _HEIGHTS):
        if height <= 0:
            continue
        found = [
            _at_height(posed, limb, postures[:, limb], np.abs(depths[:, limb] - height), worth[:, limb], height, reach)
            for limb in range(len(lower))
        ]
        least = min(value for value, _ in found)
        if least > most:
            best, most = (height, [place for _, place in found]), least
    if best is None:
        return None
    footholds = np.empty((len(posed.rows), 2))
    footholds[posed.rows] = [place + posed.offset[:2] for place in best[1]]
    return Stance(float(best[0]), footholds)


def _at_height(
    posed: _Posed,
    limb: int,
    postures: np.ndarray,
    off: np.ndarray,
    worth: np.ndarray,
    height: float,
    reach: float,
) -> tuple[float, np.ndarray]:
    """Return what a limb's best posture with its foot at a height is worth, and the foot's x and y there."""
    lower, upper = (limits[limb] for limits in posed.limits)
    near = np.flatnonzero(off < 0.1 * reach)
    for number in near[np.argsort(-worth[near])][:_TRIED]:
        angles, foot = _levelled(posed, limb, postures[number], -height - posed.offset[2])
        if foot is not None and ((angles > lower) & (angles < upper)).all():
            return float(worth[number]), foot[:2]
    return -np.inf, np.zeros(2)


def _levelled(posed: _Posed, limb: int, angles: np.ndarray, z: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Return a limb's angles changed as little as puts its foot at `z` m in the base frame, and the foot; or None."""
    model, data, jacobian = posed.model, mujoco.MjData(posed.model), np.empty((3, posed.model.nv))
    count, angles = len(angles), angles.copy()
    for _ in range(20):
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        data.qpos[7 + limb * count : 7 + (limb + 1) * count] = angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        foot = data.site_xpos[limb]
        if abs(foot[2] - z) < 1e-13:
            return angles, foot.copy()
        mujoco.mj_jacSite(model, data, jacobian, None, limb)
        row = jacobian[2, 6 + limb * count : 6 + (limb + 1) * count] * posed.driven[limb]
        angles += row * (z - foot[2]) / max(float(row @ row), 1e-12)
    return angles, None


def _feet(model: mujoco.MjModel, angles: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[7:] = angles.ravel()
    mujoco.mj_kinematics(model, data)
    return np.array(data.site_xpos)
