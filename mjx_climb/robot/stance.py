"""How a robot may stand: as a keyframe has it, or where its joints are off their limits and its limbs not singular."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mjx_climb.dynamics.kinematics import foot_jacobian, limb_frames
from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.description import RobotError
from mjx_climb.robot.limbs import Chain, at_zero, foot_of
from mjx_climb.robot.posture import (
    MET,
    SINGULAR,
    driven_mask,
    keeps_attitude,
    limb_joints,
    smallest_singular_values,
    unposed_robot,
)
from mjx_climb.robot.robot_file import compiled_robot, unposed
from mjx_climb.scenario.model import RobotFile

STANDING = 3  # feet on the ground that keep a robot from swinging about them: grips of fewer limbs hold attitudes
_SHARES = (0.35, 0.5, 0.65, 0.2, 0.05, 0.8)  # of a limb's reach: how far out and how far down a foot may stand
_WELL = 0.15  # of a joint's range to its limits: more counts for no more
_SAMPLES, _HEIGHTS, _TRIED = 3000, 15, 4  # postures at random, heights looked at, postures tried at each
_LOW = 0.2  # of a limb's reach: a base nearer to the ground is for robots that cannot stand higher
_OUTWARD = 0.3  # what a reach further out is worth, in shares of a joint's range
_LEVELLING, _LEVEL = 20, 1e-12  # steps, and m, in which a foot is put at a height
_IN_SPACE = 3  # driven joints of a limb that can put its foot anywhere


class Hips(NamedTuple):
    """Where the limbs begin."""

    places: np.ndarray  # (limb, 3) m, base link's frame, of the first joints
    reach: np.ndarray  # (limb,) m, length of all links


class Stance(NamedTuple):
    """Where the feet stand in the rest stance, and how high the base link's frame is."""

    height: float  # m
    footholds: np.ndarray  # (limb, 2) m


def keyframe(model: mujoco.MjModel) -> int | None:
    """Return the keyframe that a robot stands in: by its name, or the first."""
    names = [model.key(k).name for k in range(model.nkey)]
    return next((names.index(n) for n in ("stance", "stand", "home") if n in names), 0 if names else None)


def _in_base(data: mujoco.MjData, base: int, point: np.ndarray) -> np.ndarray:
    return np.asarray(data.xmat[base].reshape(3, 3).T @ (point - data.xpos[base]))


def stretched(model: mujoco.MjModel, base: int, limbs: dict[str, Chain]) -> Hips:
    """Return where limbs begin and how long they are."""
    data, places, reach = at_zero(model), [], []
    for chain in limbs.values():
        points = np.array([*data.xanchor[list(chain.joints)], foot_of(model, data, chain)])
        places.append(_in_base(data, base, points[0]))
        reach.append(sum(np.linalg.norm(link) for link in np.diff(points, axis=0)))
    return Hips(np.array(places), np.array(reach))


def of_keyframe(model: mujoco.MjModel, base: int, limbs: dict[str, Chain], key: int) -> Stance | None:
    """Return how the robot stands in a keyframe, None with its feet above its base."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[key]
    mujoco.mj_kinematics(model, data)
    feet = np.array([_in_base(data, base, foot_of(model, data, chain)) for chain in limbs.values()])
    height = -float(feet[:, 2].mean())
    return Stance(height, feet[:, :2]) if height > 0 else None


class _Standing:
    """A robot's section of a scenario, whose footholds are about where its feet are to stand.

    The model has its limbs in an order of its own; `rows` are their places in the section.
    """

    def __init__(self, section: dict[str, Any], footholds: np.ndarray) -> None:
        limbs = {
            name: limb | {"foothold": [float(v) for v in foothold]}
            for (name, limb), foothold in zip(section["limbs"].items(), footholds, strict=True)
        }
        source = RobotFile.model_validate(section | {"limbs": limbs})
        spec, self.offset = unposed(source)  # (3,) m, the base's centre of mass in its link's frame
        self.model = compiled_robot(source, spec)
        self.robot = unposed_robot(self.model)
        self.driven = driven_mask(self.model)
        self.rows = [list(limbs).index(self.model.site(s).name.removesuffix("_foot")) for s in range(len(limbs))]
        self.in_space = self.driven.sum(1) >= _IN_SPACE


def worth_of(section: dict[str, Any], footholds: np.ndarray, missing: float = 0.0) -> Callable[[Stance], float]:
    """Return the worth of stances: below 0 a foot misses its place or a joint its limits, 0 is singular.

    It is the smallest singular value of the limbs' Jacobians, for what the grips hold, and less within `_WELL` of a
    joint's limit. `footholds` (limb, 2) m are somewhere about where the feet are to stand. Limbs that cannot put a foot
    anywhere in space may miss their places by `missing` m.
    """
    standing = _Standing(section, footholds)
    model, lower, upper = standing.model, standing.robot.joint_lower, standing.robot.joint_upper
    near = np.where(standing.in_space, MET, max(missing, MET))
    turned = len(near) <= STANDING and keeps_attitude(model)

    def worth(stance: Stance) -> float:
        feet = np.column_stack([stance.footholds, np.full(len(near), -stance.height)])[standing.rows] - standing.offset
        found = limb_joints(model, feet)
        share = float((np.minimum(found.angles - lower, upper - found.angles) / (upper - lower)).min())
        if share <= 0 or not (found.errors < near).all():
            return -1.0
        least = float(smallest_singular_values(model, found.angles, turned).min())
        return least * min(share / _WELL, 1.0) if least > SINGULAR else 0.0

    return worth


def checked(section: dict[str, Any], stance: Stance) -> Stance | None:
    """Return a stance to as few digits as will do, None where joints pass their limits, or it is singular."""
    worth = worth_of(section, stance.footholds)
    tried = (Stance(round(stance.height, digits), stance.footholds.round(digits)) for digits in (4, 12))
    return next((rounded for rounded in tried if worth(rounded) > 0), None)


def searched(section: dict[str, Any], hips: Hips) -> Stance:
    """Return the stance of most worth among those with the feet some way out and down, or else at random.

    Raises:
        RobotError: none was found, or singular ones alone.
    """
    reach, places = float(hips.reach.min()), hips.places
    away = places[:, :2] / np.maximum(np.linalg.norm(places[:, :2], axis=1, keepdims=True), 1e-6)
    stances = [
        Stance(height, (places[:, :2] + out * reach * away).round(4))
        for out, down in itertools.product(_SHARES, _SHARES)
        if np.hypot(out, down) < 1 and (height := round(down * reach - float(places[:, 2].min()), 4)) > 0
    ]
    standing = _Standing(section, places[:, :2] + 0.5 * reach * away)
    best, most = None, -1.0
    if standing.in_space.all() and stances:
        worth = worth_of(section, stances[0].footholds)
        most, best = max(((worth(stance), stance) for stance in stances), key=lambda found: found[0])
    if most < 0:
        at_random = _sampled(standing, away[standing.rows], reach)
        best = None if at_random is None else checked(section, at_random)
        most = -1.0 if best is None else 1.0
    if best is None or most <= 0:
        expected = "a stance with all feet in reach below the base link, whose own z axis is up"
        singular = "singular ones alone: in them a limb cannot move its foot, or turn what its grip holds, every way"
        raise RobotError(f"{section['file']}: expected {expected}, found {'none' if most < 0 else singular}")
    return best


def _sampled(standing: _Standing, away: np.ndarray, reach: float) -> Stance | None:
    """Return a stance from postures at random, at the height where the worst limb has most room; None: there is none.

    `away` (limb, 2) are directions out from the base. What counts is room to the limits, and a foot far out.
    """
    robot, driven = standing.robot, standing.driven
    lower, upper = robot.joint_lower, robot.joint_upper
    shares = np.random.default_rng(0).uniform(0.08, 0.92, (_SAMPLES, *lower.shape))
    slack = np.clip(robot.stance_joints, lower, upper)
    postures = np.where(driven, lower + (upper - lower) * shares, slack)
    feet = limb_frames(robot, None, postures).foot + standing.offset
    room = np.where(driven, np.minimum(shares, 1 - shares), 1.0).min(2)
    worth = room + _OUTWARD * (feet[..., :2] * away).sum(2) / reach
    depths = -feet[..., 2]
    best, most = None, -np.inf
    low, high = (float(np.quantile(depths, share)) for share in (0.02, 0.98))
    for height in np.linspace(max(low, min(_LOW * reach, high)), high, _HEIGHTS):
        if height <= 0:
            continue
        near = np.where(np.abs(depths - height) < 0.1 * reach, worth, -np.inf)
        tried = np.argsort(-near, axis=0)[:_TRIED]
        angles, feet = _levelled(standing, np.take_along_axis(postures, tried[..., None], 0), -height)
        within = ((angles > lower) & (angles < upper)).all(2) & (np.abs(feet[..., 2] + height) < _LEVEL)
        values = np.where(within, np.take_along_axis(near, tried, 0), -np.inf)
        if (least := float(values.max(0).min())) > most:
            footholds = np.empty((len(lower), 2))
            footholds[standing.rows] = feet[values.argmax(0), np.arange(len(lower)), :2]
            best, most = Stance(float(height), footholds), least
    return best


def _levelled(standing: _Standing, angles: np.ndarray, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Return postures (..., limb, joint) changed as little as puts the feet at height `z` m, and the feet.

    Height and feet (..., limb, 3) m are in the frame of the base link.
    """
    for _ in range(_LEVELLING):
        frames = limb_frames(standing.robot, None, angles)
        feet = frames.foot + standing.offset
        if np.abs(feet[..., 2] - z).max() < _LEVEL:
            break
        row = foot_jacobian(standing.robot, frames)[..., 2, :] * standing.driven
        angles = angles + row * ((z - feet[..., 2]) / np.maximum((row * row).sum(-1), 1e-12))[..., None]
    return angles, feet
