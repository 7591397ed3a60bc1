"""How a robot stands: stances off singular ones and joint limits."""

import itertools
from typing import Any, NamedTuple

import numpy as np

from mjx_climb.physics.kinematics import foot_jacobian, limb_frames
from mjx_climb.physics.postures import MET, SINGULAR, keeps_attitude, least_singular_values, limb_joints, moving_joints
from mjx_climb.robot.constants import RobotError
from mjx_climb.robot_import.robot_file import unposed
from mjx_climb.scenario.model import RobotFile

Section = dict[str, Any]  # of a scenario, or all of one, as plain data
# on fewer than three feet a robot swings about them, unless its grips hold attitudes
STANDING = 3
# distances of a foot from its hip that are tried, outwards and downwards, as shares of the limb's reach
_SHARES = (0.35, 0.5, 0.65, 0.2, 0.05, 0.8)
# margin to a joint's limits, as a share of its range, from which on more of it adds nothing to a stance's score
_WELL = 0.15
# random postures, heights of the base that are tried, and postures tried at each
_SAMPLES, _HEIGHTS, _TRIED = 3000, 15, 4
# lowest height of the base, as a share of a limb's reach, of robots that can stand as high
_LOW = 0.2
# weight of a foot's distance outwards, over the reach, beside the margin to joint limits
_OUTWARD = 0.3
# Newton steps that put a foot at a height, and their tolerance in m
_LEVELLING, _LEVEL = 20, 1e-12
# driven joints of a limb that can put its foot anywhere
_IN_SPACE = 3


class Stance(NamedTuple):
    """Where the feet stand in the rest stance, and how high the base link's frame is."""

    height: float  # m
    footholds: np.ndarray  # (limb, 2) m


class Standing:
    """The scores of stances of a robot, the section of a scenario, with its feet somewhere about `footholds`.

    `footholds` are (limb, 2) m, in the order of the section; the model has the limbs in an order of its own. Limbs that
    cannot put a foot anywhere in space may miss their places by `missing` m.
    """

    def __init__(self, section: Section, footholds: np.ndarray, missing: float = 0.0) -> None:
        limbs = {
            name: limb | {"foothold": foothold.tolist()}
            for (name, limb), foothold in zip(section["limbs"].items(), footholds, strict=True)
        }
        _, self.robot, self.offset = unposed(RobotFile.model_validate(section | {"limbs": limbs}))
        self.driven = moving_joints(self.robot)
        self.in_space = self.driven.sum(1) >= _IN_SPACE
        self.near = np.where(self.in_space, MET, max(missing, MET))
        self.rows = [list(limbs).index(name) for name in self.robot.limbs]  # of the model's limbs in the section

    def worth(self, *stances: Stance) -> np.ndarray:
        """Return the score of each stance: below 0 a foot misses its place or a joint its limits, 0 is singular.

        It is the smallest singular value of the limbs' Jacobians, as the grips hold, and less within `_WELL` of a
        joint's limit.
        """
        robot, lower, upper = self.robot, self.robot.joint_lower, self.robot.joint_upper
        down = np.ones((len(lower), 1))
        feet = np.stack([np.hstack([each.footholds, -each.height * down]) for each in stances])[:, self.rows]
        found = limb_joints(robot, feet - self.offset)
        share = (np.minimum(found.angles - lower, upper - found.angles) / (upper - lower)).min((1, 2))
        turned = len(lower) <= STANDING and keeps_attitude(robot)
        least = least_singular_values(robot, found.angles, turned).min(1)
        worth = np.where(least > SINGULAR, least * np.minimum(share / _WELL, 1.0), 0.0)
        return np.asarray(np.where((share <= 0) | ~(found.errors < self.near).all(1), -1.0, worth))

    def sampled(self, away: np.ndarray, reach: float) -> Stance | None:
        """Return a stance from postures at random, at the height where the worst limb has most room, or None.

        `away` (limb, 2) are directions out from the base. Room to the limits counts, and a foot far out.
        """
        robot, driven, lower, upper = self.robot, self.driven, self.robot.joint_lower, self.robot.joint_upper
        shares = np.random.default_rng(0).uniform(0.08, 0.92, (_SAMPLES, *lower.shape))
        postures = np.where(driven, lower + (upper - lower) * shares, np.clip(robot.stance_joints, lower, upper))
        feet = limb_frames(robot, None, postures).foot + self.offset
        room = np.where(driven, np.minimum(shares, 1 - shares), 1.0).min(2)
        worth = room + _OUTWARD * (feet[..., :2] * away[self.rows]).sum(2) / reach
        depths = -feet[..., 2]
        best, most = None, -np.inf
        low, high = (float(np.quantile(depths, share)) for share in (0.02, 0.98))
        for height in np.linspace(max(low, min(_LOW * reach, high)), high, _HEIGHTS):
            if height <= 0:
                continue
            near = np.where(np.abs(depths - height) < 0.1 * reach, worth, -np.inf)
            tried = np.argsort(-near, axis=0)[:_TRIED]
            angles, feet = self._levelled(np.take_along_axis(postures, tried[..., None], 0), -height)
            within = ((angles > lower) & (angles < upper)).all(2) & (np.abs(feet[..., 2] + height) < _LEVEL)
            values = np.where(within, np.take_along_axis(near, tried, 0), -np.inf)
            if (least := float(values.max(0).min())) > most:
                footholds = np.empty_like(away)
                footholds[self.rows] = feet[values.argmax(0), np.arange(len(lower)), :2]
                best, most = Stance(float(height), footholds), least
        return best

    def _levelled(self, angles: np.ndarray, z: float) -> tuple[np.ndarray, np.ndarray]:
        """Return postures (..., limb, joint) changed little, and their feet, at `z` m in the link's frame."""
        for _ in range(_LEVELLING):
            frames = limb_frames(self.robot, None, angles)
            feet = frames.foot + self.offset
            if np.abs(feet[..., 2] - z).max() < _LEVEL:
                break
            row = foot_jacobian(self.robot, frames)[..., 2, :] * self.driven
            angles = angles + row * ((z - feet[..., 2]) / np.maximum((row * row).sum(-1), 1e-12))[..., None]
        return angles, feet


def checked(section: Section, stance: Stance) -> Stance | None:
    """Return a stance to as few digits as will do, None where joints pass their limits, or it is singular."""
    worth = Standing(section, stance.footholds).worth
    tried = (Stance(round(stance.height, digits), stance.footholds.round(digits)) for digits in (4, 12))
    return next((rounded for rounded in tried if worth(rounded)[0] > 0), None)


def searched(section: Section, hips: np.ndarray, reach: float) -> Stance:
    """Return the stance of most worth among those with the feet some way out and down, or else at random.

    `hips` (limb, 3) m are where the limbs begin, in the base link's frame, `reach` m the shortest one's length.

    Raises:
        RobotError: none was found, or singular ones alone.
    """
    away = hips[:, :2] / np.maximum(np.linalg.norm(hips[:, :2], axis=1, keepdims=True), 1e-6)
    stances = [
        Stance(height, (hips[:, :2] + out * reach * away).round(4))
        for out, down in itertools.product(_SHARES, _SHARES)
        if np.hypot(out, down) < 1 and (height := round(down * reach - float(hips[:, 2].min()), 4)) > 0
    ]
    standing = Standing(section, hips[:, :2] + 0.5 * reach * away)
    best, most = None, -1.0
    if standing.in_space.all() and stances:
        worths = standing.worth(*stances)
        most, best = float(worths.max()), stances[int(worths.argmax())]
    if most < 0:
        at_random = standing.sampled(away, reach)
        best = at_random and checked(section, at_random)
        most = -1.0 if best is None else 1.0
    if best is None or most <= 0:
        expected = "a stance with all feet in reach below the base link, whose own z axis is up"
        singular = "singular ones alone: in them a limb cannot move its foot, or turn what its grip holds, every way"
        raise RobotError(f"{section['file']}: expected {expected}, found {'none' if most < 0 else singular}")
    return best
