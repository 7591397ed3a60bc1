"""How a robot stands: postures with the feet in given places, and stances off singular ones and joint limits."""

import functools
import itertools
from typing import Any, NamedTuple

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.physics.inverse_kinematics import POSE, Chain, settled
from mjx_climb.physics.kinematics import foot_jacobian, joint_axes, limb_frames
from mjx_climb.robot.constants import Robot, RobotError, load_robot
from mjx_climb.robot_import.description import FILLING, PASSIVE
from mjx_climb.robot_import.robot_file import refusal, unposed
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import RobotFile, Scenario

_ITERATIONS, _LONGEST_STEP = 60, 0.5  # rad, or m
MET = 1e-9  # m, rad: a foot as near to its place is there
_STARTS = 5  # of femur and tibia each, spread over their limits
_OTHERS = 1e-3  # rad of the knee, that the other joints of a limb of three count for
_OTHER_STARTS = 15  # of limbs of another number of joints
_SINGULAR = (
    0.01  # smallest singular value of a limb's Jacobian, lengths over its reach: below, it cannot move every way
)
STANDING = 3  # feet on the ground that keep a robot from swinging about them: grips of fewer limbs hold attitudes
_SHARES = (0.35, 0.5, 0.65, 0.2, 0.05, 0.8)  # of a limb's reach: how far out and how far down a foot may stand
_WELL = 0.15  # of a joint's range to its limits: more counts for no more
_SAMPLES, _HEIGHTS, _TRIED = 3000, 15, 4  # postures at random, heights looked at, postures tried at each
_LOW = 0.2  # of a limb's reach: a base nearer to the ground is for robots that cannot stand higher
_OUTWARD = 0.3  # what a reach further out is worth, in shares of a joint's range
_LEVELLING, _LEVEL = 20, 1e-12  # steps, and m, in which a foot is put at a height
_IN_SPACE = 3  # driven joints of a limb that can put its foot anywhere


class LimbJoints(NamedTuple):
    """Joint angles of every limb, and by how much its foot misses the target."""

    angles: np.ndarray  # (limb, joint) rad
    errors: np.ndarray  # (limb,) m


def limb_joints(robot: Robot, feet: np.ndarray, near: np.ndarray | None = None) -> LimbJoints:
    """Return joint angles within the limits that put the feet at `feet` (limb, 3) m, in the frame of the base.

    Of several postures the one whose joints are nearest the middle of their ranges, in the mean of squares over these;
    of limbs of three joints the one whose knee is, and the others only where knees are alike. Of limbs with more joints
    a singular posture only where there is no other. Joints nothing drives are where their springs are slack. `near` are
    angles (limb, joint) to begin with: where all feet get there from these, no other posture is looked for.
    """
    if robot.joints == 3:
        fractions = (np.arange(_STARTS) + 0.5) / _STARTS
        shares = np.array([[0.5, femur, tibia] for femur in fractions for tibia in fractions])
    else:
        spread = np.random.default_rng(0).uniform(0.1, 0.9, (_OTHER_STARTS, robot.joints))
        shares = np.vstack([np.full(robot.joints, 0.5), spread])
    starts = robot.joint_lower + (robot.joint_upper - robot.joint_lower) * shares[:, None]
    if near is not None:
        angles, missed = _reached(robot, feet, near[None])
        if missed.max() < MET:
            return LimbJoints(angles[0], missed[0])
        starts = np.concatenate([near[None], starts])
    angles, missed = _reached(robot, feet, starts)
    middle, half = (robot.joint_lower + robot.joint_upper) / 2, (robot.joint_upper - robot.joint_lower) / 2
    off = np.abs(angles - middle)
    bent = ((off / half) ** 2).mean(-1)
    if robot.joints == 3:
        bent = off[..., 2] + _OTHERS * bent
    else:  # one range off the middle, at worst
        bent += _least_singular_values(robot, angles, _keeps_attitude(robot)) < _SINGULAR
    bent[missed >= MET] = np.inf
    first_best = np.where(np.isfinite(bent), bent <= bent.min(0) + MET, missed <= missed.min(0)).argmax(0)
    limbs = np.arange(len(feet))
    best, errors = angles[first_best, limbs], missed[first_best, limbs]
    return LimbJoints(np.where(np.isfinite(errors)[:, None], best, middle), errors)


def _reached(robot: Robot, feet: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return postures from some starts (start, limb, joint), and what the feet miss, infinite beyond the limits."""
    if robot.driven is not None:
        slack = robot.model.qpos_spring[7:].reshape(robot.driven.shape)
        starts = np.where(robot.driven, starts, slack)
    angles, missed = settled(Chain(robot), feet, starts, _ITERATIONS, pull=False, longest=_LONGEST_STEP)
    wrapped = np.remainder(angles + np.pi, 2 * np.pi) - np.pi
    angles = wrapped if robot.sliding is None else np.where(robot.sliding, angles, wrapped)
    within = ((angles >= robot.joint_lower - MET) & (angles <= robot.joint_upper + MET)).all(-1)
    return angles, np.where(within, missed, np.inf)


def _driven(robot: Robot) -> np.ndarray:
    """Return which joints are driven and move something, (limb, joint): not those that only fill up a limb."""
    return ~np.isin(robot.model.jnt_group[1:], (PASSIVE, FILLING)).reshape(len(robot.limbs), -1)


def _keeps_attitude(robot: Robot) -> bool:
    """Return whether all limbs have the driven joints that it takes to keep the attitudes of their feet."""
    return bool(_driven(robot).sum(1).min() >= POSE)


def _least_singular_values(robot: Robot, angles: np.ndarray, turned: bool) -> np.ndarray:
    """Return each limb's smallest singular value of the Jacobian of its driven joints at angles (..., limb, joint).

    Lengths are shares of the limb's. It is of the foot's place, with `turned` of its attitude, too.
    """
    frames = limb_frames(robot, None, angles)
    points = np.concatenate([frames.position, frames.foot[..., None, :]], axis=-2)
    reach = np.linalg.norm(np.diff(points, axis=-2), axis=-1).sum(-1)
    jacobian = foot_jacobian(robot, frames) / reach[..., None, None]
    if turned:
        jacobian = np.concatenate([jacobian, joint_axes(robot, frames).angular.mT], axis=-2)
    own = (jacobian[..., limb, :, :][..., moved] for limb, moved in enumerate(_driven(robot)))
    return np.stack([np.linalg.svd(columns, compute_uv=False)[..., -1] for columns in own], axis=-1)


# ------------------------------------------------------------------------------------------------------------
# The rest stance of a scenario


def spec_of(source: RobotFile) -> mujoco.MjSpec:
    """Return a robot file as simulated, see `unposed`, in its rest stance.

    Raises:
        RobotError: in one line, the key of the config, what was expected and what the file has.
    """
    spec, robot, offset = unposed(source)
    limbs = dict(source.limbs.items())
    feet = np.array([[*limbs[name].foothold, -source.height] for name in robot.limbs]) - offset
    joints = limb_joints(robot, feet)
    for limb, error in zip(robot.limbs, joints.errors, strict=True):
        if error > MET:
            expected = f"a foothold within reach and joint limits at a height of {source.height:g} m"
            got = f"one that the foot misses by {error * 1e3:.3g} mm" if np.isfinite(error) else "one beyond the limits"
            raise refusal(source, f"limbs.{limb}.foothold", expected, got)
    position = [offset[0], offset[1], source.height + offset[2]]
    spec.add_key(name="stance", qpos=[*position, 1, 0, 0, 0, *joints.angles.ravel()])
    spec.body("base").pos = position
    return spec


def check_stance(scenario: Scenario, source: str = "scenario") -> None:
    """Refuse a rest stance in which a limb is singular: it cannot move its foot every way, or turn it as its grip asks.

    Raises:
        ConfigError: in one line, the limb and the smallest singular value of its Jacobian.
    """
    if wrong := _singular_limb(scenario.robot, scenario.contact.rotational_stiffness > 0):
        raise ConfigError(f"{source}: {wrong}")


@functools.lru_cache(maxsize=64)
def _singular_limb(name: str | RobotFile, moments: bool) -> str | None:
    robot = load_robot(name)
    turned = moments and _keeps_attitude(robot)
    values = _least_singular_values(robot, robot.stance_joints, turned)
    limb, least, does = robot.limbs[values.argmin()], values.min(), "move and turn" if turned else "move"
    if least >= _SINGULAR:
        return None
    return (
        f"robot.limbs.{limb}.foothold: expected a stance in which the limb can {does} its foot every way, got a "
        f"singular one (smallest singular value of its Jacobian {least:.2g}, lengths over the limb's): another height "
        "or foothold"
    )


# ------------------------------------------------------------------------------------------------------------
# In search of a stance


class Stance(NamedTuple):
    """Where the feet stand in the rest stance, and how high the base link's frame is."""

    height: float  # m
    footholds: np.ndarray  # (limb, 2) m


class Standing:
    """What stances are worth to a robot, the section of a scenario, with its feet somewhere about `footholds`.

    `footholds` are (limb, 2) m, in the order of the section; the model has the limbs in an order of its own. Limbs that
    cannot put a foot anywhere in space may miss their places by `missing` m.
    """

    def __init__(self, section: dict[str, Any], footholds: np.ndarray, missing: float = 0.0) -> None:
        limbs = {
            name: limb | {"foothold": foothold.tolist()}
            for (name, limb), foothold in zip(section["limbs"].items(), footholds, strict=True)
        }
        _, self.robot, self.offset = unposed(RobotFile.model_validate(section | {"limbs": limbs}))
        self.driven = _driven(self.robot)
        self.in_space = self.driven.sum(1) >= _IN_SPACE
        self.near = np.where(self.in_space, MET, max(missing, MET))
        self.rows = [list(limbs).index(name) for name in self.robot.limbs]  # of the model's limbs in the section

    def worth(self, stance: Stance) -> float:
        """Return what a stance is worth: below 0 a foot misses its place or a joint its limits, 0 is singular.

        It is the smallest singular value of the limbs' Jacobians, for what the grips hold, and less within `_WELL` of a
        joint's limit.
        """
        robot, lower, upper = self.robot, self.robot.joint_lower, self.robot.joint_upper
        feet = np.column_stack([stance.footholds, np.full(len(lower), -stance.height)])[self.rows] - self.offset
        found = limb_joints(robot, feet)
        share = float((np.minimum(found.angles - lower, upper - found.angles) / (upper - lower)).min())
        if share <= 0 or not (found.errors < self.near).all():
            return -1.0
        turned = len(lower) <= STANDING and _keeps_attitude(robot)
        least = float(_least_singular_values(robot, found.angles, turned).min())
        return least * min(share / _WELL, 1.0) if least > _SINGULAR else 0.0

    def sampled(self, away: np.ndarray, reach: float) -> Stance | None:
        """Return a stance from postures at random, at the height where the worst limb has most room, or None.

        `away` (limb, 2) are directions out from the base. What counts is room to the limits, and a foot far out.
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


def checked(section: dict[str, Any], stance: Stance) -> Stance | None:
    """Return a stance to as few digits as will do, None where joints pass their limits, or it is singular."""
    worth = Standing(section, stance.footholds).worth
    tried = (Stance(round(stance.height, digits), stance.footholds.round(digits)) for digits in (4, 12))
    return next((rounded for rounded in tried if worth(rounded) > 0), None)


def searched(section: dict[str, Any], hips: np.ndarray, reach: float) -> Stance:
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
        most, best = max(((standing.worth(stance), stance) for stance in stances), key=lambda found: found[0])
    if most < 0:
        at_random = standing.sampled(away, reach)
        best = at_random and checked(section, at_random)
        most = -1.0 if best is None else 1.0
    if best is None or most <= 0:
        expected = "a stance with all feet in reach below the base link, whose own z axis is up"
        singular = "singular ones alone: in them a limb cannot move its foot, or turn what its grip holds, every way"
        raise RobotError(f"{section['file']}: expected {expected}, found {'none' if most < 0 else singular}")
    return best
