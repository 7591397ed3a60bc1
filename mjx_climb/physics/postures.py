"""Postures with the feet in given places, and how far they are from singular ones."""

from typing import NamedTuple

import numpy as np

from mjx_climb.physics.inverse_kinematics import POSE, Chain, solve_to_convergence
from mjx_climb.physics.kinematics import foot_jacobian, joint_axes, limb_frames
from mjx_climb.robot.constants import FILLING, PASSIVE, Robot

_ITERATIONS, _LONGEST_STEP = 60, 0.5  # rad, or m
MET = 1e-9  # m, rad, tolerance of a foot that is at its place
_STARTS = 5  # of femur and tibia each, spread over their limits
_OTHERS = 1e-3  # weight of the other joints of a limb of three, beside its knee
_OTHER_STARTS = 15  # of limbs of another number of joints
# smallest singular value of a limb's Jacobian, lengths over its reach, with which it can move its foot every way
SINGULAR = 0.01


class LimbJoints(NamedTuple):
    """Joint angles of every limb, and by how much its foot misses the target."""

    angles: np.ndarray  # (..., limb, joint) rad
    errors: np.ndarray  # (..., limb) m


def limb_joints(robot: Robot, feet: np.ndarray, near: np.ndarray | None = None) -> LimbJoints:
    """Return joint angles within the limits that put the feet at `feet` (..., limb, 3) m, in the frame of the base.

    Of several postures the one whose joints are nearest the middle of their ranges, in the mean of squares over these;
    of limbs of three joints the one whose knee is, and the others only where knees are alike. Of limbs with more joints
    a singular posture only where there is no other. Joints nothing drives are where their springs are slack. `near` are
    angles (limb, joint) to begin with: where all feet get there from these, no other posture is looked for.
    """
    if near is None:
        return _best_of_many(robot, feet)
    angles, missed = _reached(robot, feet, np.broadcast_to(near, (*feet.shape[:-1], robot.joints)))
    if (far := missed.max(-1) >= MET).any():
        angles[far], missed[far] = _best_of_many(robot, feet[far], near[None])
    return LimbJoints(angles, missed)


def _best_of_many(robot: Robot, feet: np.ndarray, also: np.ndarray | None = None) -> LimbJoints:
    """Return the best of the postures that are reached from many starts, and from some of the caller's."""
    if robot.joints == 3:
        fractions = (np.arange(_STARTS) + 0.5) / _STARTS
        shares = np.array([[0.5, femur, tibia] for femur in fractions for tibia in fractions])
    else:
        spread = np.random.default_rng(0).uniform(0.1, 0.9, (_OTHER_STARTS, robot.joints))
        shares = np.vstack([np.full(robot.joints, 0.5), spread])
    starts = robot.joint_lower + (robot.joint_upper - robot.joint_lower) * shares[:, None]
    starts = starts if also is None else np.concatenate([also, starts])
    angles, missed = _reached(robot, feet, starts.reshape(-1, *(1,) * (feet.ndim - 2), *robot.joint_lower.shape))
    middle, half = (robot.joint_lower + robot.joint_upper) / 2, (robot.joint_upper - robot.joint_lower) / 2
    off = np.abs(angles - middle)
    bent = ((off / half) ** 2).mean(-1)
    if robot.joints == 3:
        bent = off[..., 2] + _OTHERS * bent
    else:  # one range off the middle, at worst
        bent += least_singular_values(robot, angles, keeps_attitude(robot)) < SINGULAR
    bent[missed >= MET] = np.inf
    best = np.where(np.isfinite(bent), bent <= bent.min(0) + MET, missed <= missed.min(0)).argmax(0)[None]
    errors, angles = (np.take_along_axis(*each, 0)[0] for each in ((missed, best), (angles, best[..., None])))
    return LimbJoints(np.where(np.isfinite(errors)[..., None], angles, middle), errors)


def _reached(robot: Robot, feet: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Postures from some starts (start, limb, joint), and the feet's distances, infinite beyond the limits."""
    if robot.driven is not None:
        slack = robot.model.qpos_spring[7:].reshape(robot.driven.shape)
        starts = np.where(robot.driven, starts, slack)
    angles, missed = solve_to_convergence(Chain(robot), feet, starts, _ITERATIONS, pull=False, longest=_LONGEST_STEP)
    wrapped = np.remainder(angles + np.pi, 2 * np.pi) - np.pi
    angles = wrapped if robot.sliding is None else np.where(robot.sliding, angles, wrapped)
    within = ((angles >= robot.joint_lower - MET) & (angles <= robot.joint_upper + MET)).all(-1)
    return angles, np.where(within, missed, np.inf)


def moving_joints(robot: Robot) -> np.ndarray:
    """Return which joints are driven and move something, (limb, joint): not those that only fill up a limb."""
    return ~np.isin(robot.model.jnt_group[1:], (PASSIVE, FILLING)).reshape(len(robot.limbs), -1)


def keeps_attitude(robot: Robot) -> bool:
    """Return whether all limbs have the driven joints that it takes to keep the attitudes of their feet."""
    return bool(moving_joints(robot).sum(1).min() >= POSE)


def least_singular_values(robot: Robot, angles: np.ndarray, turned: bool) -> np.ndarray:
    """Return each limb's smallest singular value of the Jacobian of its driven joints at angles (..., limb, joint).

    Lengths are shares of the limb's. It is of the foot's place, with `turned` of its attitude, too.
    """
    frames = limb_frames(robot, None, angles)
    points = np.concatenate([frames.position, frames.foot[..., None, :]], axis=-2)
    reach = np.linalg.norm(np.diff(points, axis=-2), axis=-1).sum(-1)
    jacobian = foot_jacobian(robot, frames) / reach[..., None, None]
    if turned:
        jacobian = np.concatenate([jacobian, joint_axes(robot, frames).angular.mT], axis=-2)
    own = (jacobian[..., limb, :, :][..., moved] for limb, moved in enumerate(moving_joints(robot)))
    return np.stack([np.linalg.svd(columns, compute_uv=False)[..., -1] for columns in own], axis=-1)
