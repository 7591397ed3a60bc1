"""Postures of a model of base and limbs, found with MuJoCo's own kinematics, before anything is compiled."""

from typing import NamedTuple

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.description import FILLING, PASSIVE

_ITERATIONS = 60
_PATIENCE = 10  # iterations in which no limb comes nearer: those that are not there will not be
_STARTS = 5  # of femur and tibia each, spread over their limits
_OTHERS = 1e-3  # rad of the knee, that the other joints of a limb of three count for
_OTHER_STARTS = 15  # of limbs of another number of joints
POSE = 6  # joints of a limb that can keep its foot's attitude
SINGULAR = 0.01  # smallest singular value of a limb's Jacobian, lengths over its reach: below, it cannot move every way


class LimbJoints(NamedTuple):
    """Joint angles of every limb, and by how much its foot misses the target."""

    angles: np.ndarray  # (L, N) rad
    errors: np.ndarray  # (L,) m


def limb_joints(model: mujoco.MjModel, feet: np.ndarray, near: np.ndarray | None = None) -> LimbJoints:
    """Return joint angles within the limits that put the feet at `feet` (L, 3) m, in the frame of the base.

    Of several postures the one whose joints are nearest the middle of their ranges, in the mean of squares over these;
    of limbs of three joints the one whose knee is, and the others only where knees are alike. Of limbs with more joints
    a singular posture only where there is no other. Joints nothing drives are where their springs are slack. `near` are
    angles (L, N) to begin with: where all feet get there from these, no other posture is looked for.
    """
    data = mujoco.MjData(model)
    lower, upper = model.jnt_range[1:].reshape(len(feet), -1, 2).transpose(2, 0, 1)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    driven = (model.jnt_group[1:] != PASSIVE).reshape(lower.shape)
    slack = model.qpos_spring[7:].reshape(lower.shape)
    turned = keeps_attitude(model)
    best, errors = middle.copy(), np.full(len(feet), np.inf)
    bend = np.full(len(feet), np.inf)
    starts = [lower + (upper - lower) * fractions for fractions in _starts(lower.shape[1])]
    for number, wanted in enumerate(starts if near is None else [near, *starts]):
        if near is not None and number == 1 and errors.max() < 1e-9:
            break
        start = np.where(driven, wanted, slack)
        angles, missed = _newton(model, data, start, feet, driven)
        missed = np.where(((angles >= lower - 1e-9) & (angles <= upper + 1e-9)).all(1), missed, np.inf)
        off = np.abs(angles - middle)
        bent = ((off / half) ** 2).mean(1)
        if off.shape[1] == 3:
            bent = off[:, 2] + _OTHERS * bent
        else:
            bent += smallest_singular_values(model, angles, turned) < SINGULAR  # one range off the middle, at worst
        reached = missed < 1e-9
        better = np.where(reached, (errors >= 1e-9) | (bent < bend - 1e-9), missed < errors)
        best[better], errors[better], bend[better] = angles[better], missed[better], bent[better]
    return LimbJoints(best, errors)


def keeps_attitude(model: mujoco.MjModel) -> bool:
    """Return whether all limbs have the driven joints that it takes to keep the attitudes of their feet."""
    driven = ~np.isin(model.jnt_group[1:], (PASSIVE, FILLING))
    return bool(driven.reshape(model.nsite, -1).sum(1).min() >= POSE)


def smallest_singular_values(model: mujoco.MjModel, angles: np.ndarray, turned: bool) -> np.ndarray:
    """Return of each limb the smallest singular value of its Jacobian at joint angles (L, N), (L,).

    Lengths are shares of the limb's. Of what a foot does in space, with `turned` in place and attitude; of limbs with
    fewer driven joints than that, of what these can do.
    """
    data, least = mujoco.MjData(model), np.empty(len(angles))
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[7:] = angles.ravel()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    driven = ~np.isin(model.jnt_group[1:], (PASSIVE, FILLING)).reshape(angles.shape)
    anchors, jacobian = data.xanchor[1:].reshape(*angles.shape, 3), np.empty((6, model.nv))
    for limb, foot in enumerate(data.site_xpos):
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], limb)
        reach = np.linalg.norm(np.diff([*anchors[limb], foot], axis=0), axis=1).sum()
        columns = jacobian[:, 6 + limb * angles.shape[1] :][:, : angles.shape[1]][:, driven[limb]]
        rows = np.vstack([columns[:3] / reach, columns[3:]]) if turned else columns[:3] / reach
        least[limb] = np.linalg.svd(rows, compute_uv=False)[-1]
    return least


def _starts(joints: int) -> np.ndarray:
    """Return postures to start from, each joint's as a share of its range, (starts, N)."""
    if joints == 3:
        fractions = (np.arange(_STARTS) + 0.5) / _STARTS
        return np.array([[0.5, femur, tibia] for femur in fractions for tibia in fractions])
    spread = np.random.default_rng(0).uniform(0.1, 0.9, (_OTHER_STARTS, joints))
    return np.concatenate([np.full((1, joints), 0.5), spread])


def _newton(
    model: mujoco.MjModel, data: mujoco.MjData, angles: np.ndarray, feet: np.ndarray, driven: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return joint angles (L, N) from a start, and the distances (L,) m that are left; all limbs at once."""
    jacobian, columns = np.empty((3, model.nv)), 6 + np.arange(angles.size).reshape(angles.shape)
    damping = 1e-12 * np.eye(min(3, angles.shape[1]))
    turns = (model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_HINGE).reshape(angles.shape)
    angles, best, since = angles.copy(), np.full(len(feet), np.inf), 0
    for _ in range(_ITERATIONS):
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        data.qpos[7:] = angles.ravel()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        left = feet - data.site_xpos
        ways = []
        for limb in range(len(feet)):
            mujoco.mj_jacSite(model, data, jacobian, None, limb)
            ways.append(jacobian[:, columns[limb]] * driven[limb])
        if angles.shape[1] > 3:
            solved = np.linalg.solve(np.stack([j @ j.T for j in ways]) + damping, left[..., None])[..., 0]
            steps = np.stack([j.T @ each for j, each in zip(ways, solved, strict=True)])
        else:
            sides = np.stack([j.T @ each for j, each in zip(ways, left, strict=True)])
            steps = np.linalg.solve(np.stack([j.T @ j for j in ways]) + damping, sides[..., None])[..., 0]
        angles += steps * np.minimum(1.0, 0.5 / np.maximum(np.abs(steps).max(1, keepdims=True), 1e-12))
        angles = np.where(turns, np.remainder(angles + np.pi, 2 * np.pi) - np.pi, angles)
        missed = np.abs(left).max(1)
        since = 0 if (missed < 0.99 * best).any() else since + 1
        best = np.minimum(best, missed)
        if missed.max() < 1e-13 or since == _PATIENCE:
            break
    return angles, np.linalg.norm(left, axis=1)
