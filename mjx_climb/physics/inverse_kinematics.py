"""Inverse kinematics of the limbs: in closed form where there is one, else by damped least squares.

The closed form is that of a yaw joint and two parallel pitch joints, all link offsets kept. Everything works over
leading axes and on NumPy's arrays too.
"""

from typing import NamedTuple

import numpy as np

from mjx_climb.arrays import AnyArray, namespace
from mjx_climb.physics.kinematics import foot_jacobian, joint_axes, limb_frames, turn_between
from mjx_climb.physics.spatial import norm, solve_symmetric
from mjx_climb.robot.constants import Robot

STEPS = 4  # of a walk's inverse kinematics, from the last solution
POSE = 6  # joints of a limb that can put its foot anywhere, turned in any way
_PARALLEL = 1e-9  # sine of the angle between axes that count as parallel
# Levenberg-Marquardt damping per squared error: quadratic convergence near the target, calm out of reach (Sugihara)
_DAMPING = 0.5
# least damping, as a share of the limb's mean squared lever, and in units of rounding for single precision
_LEAST_DAMPING, _LEAST_ROUNDINGS = 1e-10, 8.0
# share of the way to the rest posture that a step takes in the null space of the foot's Jacobian
_PULL = 0.05
_LONGEST_STEP = 0.3  # rad, or m
_MET = 1e-4  # m, from a target that counts as reached
_SETTLED = 1e-12  # rad, or m: steps shorter than this change nothing


class LimbGeometry(NamedTuple):
    """Constants of the limbs for the closed form: plane coordinates are (outward, up) in the coxa's own frame."""

    hip_position: np.ndarray  # (limb, 3) m, base frame
    hip_rotation: np.ndarray  # (limb, 3, 3): x outward in the limb's plane, z along the coxa's axis
    lateral: np.ndarray  # (limb,) m, distance of the foot from the plane through the coxa's axis
    femur_out: np.ndarray  # (limb,) m, femur joint from the coxa's axis
    femur_up: np.ndarray  # (limb,) m
    femur_length: np.ndarray  # (limb,) m
    tibia_length: np.ndarray  # (limb,) m
    femur_angle: np.ndarray  # (limb,) rad, elevation of the femur's line at joint zero
    tibia_angle: np.ndarray  # (limb,) rad, elevation of the line to the foot at joint zero
    femur_sign: np.ndarray  # (limb,), +1 where a positive joint angle raises
    tibia_sign: np.ndarray  # (limb,)
    knee_sign: np.ndarray  # (limb,), sign of the knee's bend in the rest stance


class Chain(NamedTuple):
    """Limbs without a closed form."""

    robot: Robot
    attitude: AnyArray = None  # (limb, 3, 3), base frame: how the last links are to be turned; None: any way


class JointSolution(NamedTuple):
    """Joint angles and whether the target could be met."""

    joint_angles: AnyArray  # (limb, joint) rad
    reachable: AnyArray  # (limb,) bool


def limb_geometry(robot: Robot, turned: bool = False) -> LimbGeometry | Chain:
    """Return the geometry of a robot's limbs for `inverse_kinematics`.

    With `turned` the last links of limbs with six driven joints or more keep the attitudes of the rest stance.
    """
    driven = robot.joints if robot.driven is None else int(robot.driven.sum(1).min())
    if turned and driven >= POSE:
        return Chain(robot, limb_frames(robot, None, np.asarray(robot.stance_joints)).rotation[:, -1])
    if robot.joints != 3 or robot.slides or robot.passive:
        return Chain(robot)
    constants = (robot.frame_position, robot.frame_rotation, robot.foot_center, robot.stance_joints)
    found = [_limb_geometry(*limb) for limb in zip(*constants, strict=True)]
    limbs = [limb for limb in found if limb is not None]
    return Chain(robot) if len(limbs) < len(found) else LimbGeometry(*map(np.stack, zip(*limbs, strict=True)))


def _limb_geometry(
    position: np.ndarray, rotation: np.ndarray, foot: np.ndarray, stance: np.ndarray
) -> LimbGeometry | None:
    """Return the geometry of one limb, None where its axes or its rest posture are not the closed form's."""
    femur_axis = rotation[1][:, 2]  # in the coxa's frame
    tibia_axis = rotation[1] @ rotation[2][:, 2]
    if abs(femur_axis[2]) > _PARALLEL or np.linalg.norm(np.cross(femur_axis, tibia_axis)) > _PARALLEL:
        return None
    knee = position[1] + rotation[1] @ position[2]
    foot, up = knee + rotation[1] @ rotation[2] @ foot, np.array([0.0, 0.0, 1.0])
    outward = np.cross(up, femur_axis)
    outward *= np.sign(outward @ foot)
    plane = np.stack([outward, np.cross(up, outward), up], axis=1)
    femur_origin, knee, foot = (plane.T @ point for point in (position[1], knee, foot))
    # a rotation about the plane's own -y raises
    femur_sign, tibia_sign = (-np.sign((plane.T @ axis)[1]) for axis in (femur_axis, tibia_axis))
    (femur_x, _, femur_z), (tibia_x, _, tibia_z) = knee - femur_origin, foot - knee
    femur_length, tibia_length = np.hypot(femur_x, femur_z), np.hypot(tibia_x, tibia_z)
    femur_angle, tibia_angle = np.arctan2(femur_z, femur_x), np.arctan2(tibia_z, tibia_x)
    bend = tibia_angle - femur_angle + tibia_sign * stance[2]
    line = femur_angle + femur_sign * stance[1]
    # the closed form takes the feet to be outward of the first joints' axes
    if femur_origin[0] + femur_length * np.cos(line) + tibia_length * np.cos(line + bend) <= 0:
        return None
    return LimbGeometry(
        position[0], rotation[0] @ plane, foot[1], femur_origin[0], femur_origin[2], femur_length, tibia_length,
        femur_angle, tibia_angle, femur_sign, tibia_sign, np.sign(np.sin(bend)),
    )  # fmt: skip


def inverse_kinematics(
    geometry: LimbGeometry | Chain, foot: AnyArray, last: AnyArray | None = None, turn: AnyArray | None = None
) -> JointSolution:
    """Return the joint angles that put the feet at `foot`, (limb, 3) m in the base frame.

    A target out of reach gives the nearest stretch or fold of the limb towards it, finite in value and derivative, and
    is flagged. Angles lie in (-pi, pi] in the closed form; joint limits are not applied here. Limbs without a closed
    form take `STEPS` steps from `last` (limb, joint), the posture before, or the rest stance; where they keep an
    attitude, it is that of the rest stance turned by `turn` (3, 3).
    """
    if isinstance(geometry, LimbGeometry):
        return _closed_form(geometry, foot)
    if geometry.attitude is not None and turn is not None:
        geometry = geometry._replace(attitude=turn @ geometry.attitude)
    angles = geometry.robot.stance_joints if last is None else last
    # the last two steps go towards the target alone
    for step in range(STEPS):
        weight, way = _toward_rest(geometry, angles)
        angles = angles + _change(geometry, foot, angles, _DAMPING, _PULL * weight * way if step < STEPS - 2 else None)
    error = _error_and_jacobian(geometry, foot, angles)[0]
    return JointSolution(angles, (error * error).sum(-1) < _MET**2)


def solve_to_convergence(
    chain: Chain,
    foot: np.ndarray,
    angles: np.ndarray,
    steps: int = 100,
    pull: bool = True,
    longest: float = _LONGEST_STEP,
) -> tuple[np.ndarray, np.ndarray]:
    """The limit of steps of inverse kinematics, (..., limb, joint), and the feet's errors, (..., limb) m.

    For NumPy, before anything is compiled: as many steps as it takes each posture, from `angles` (..., limb, joint),
    none longer than `longest` in any joint. With `pull`, spare joints are as near the rest posture as the steps of a
    walk pull them, else where they were.
    """
    shape = np.broadcast_shapes(foot.shape[:-1], angles.shape[:-1])
    feet = np.broadcast_to(foot, (*shape, 3)).reshape(-1, shape[-1], 3)
    found = np.broadcast_to(angles, (*shape, chain.robot.joints)).reshape(len(feet), shape[-1], -1).copy()
    moving = np.arange(len(found))
    for _ in range(steps):
        some = found[moving]
        weight, way = _toward_rest(chain, some)
        rest = weight / weight.max(-1, keepdims=True) * way if pull else None
        change = _change(chain, feet[moving], some, 0.0, rest, longest)
        found[moving] = some + change
        moving = moving[np.abs(change).max((1, 2)) >= _SETTLED]
        if not moving.size:
            break
    found = found.reshape(*shape, -1)
    return found, norm(foot - limb_frames(chain.robot, None, found).foot)


def _toward_rest(chain: Chain, angles: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return weights, more near a joint's limits, and the ways of the joints to the rest posture, (limb, joint)."""
    robot, xp = chain.robot, namespace(angles)
    # after Liegeois, IEEE Trans. Systems, Man and Cybernetics 7, 1977
    middle, half = (robot.joint_lower + robot.joint_upper) / 2, (robot.joint_upper - robot.joint_lower) / 2
    way = robot.stance_joints - angles
    weight = 1 + xp.clip(((angles - middle) / half) ** 8, 0.0, 8.0)
    return weight, way if robot.driven is None else xp.where(robot.driven, way, 0.0)


def _error_and_jacobian(chain: Chain, target: AnyArray, angles: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return the error of the feet (..., limb, rows), and its Jacobian by the joints (..., limb, rows, joint).

    Rows are the foot's place and, where an attitude is kept, its turn times the limb's mean length. Joints that nothing
    drives change nothing.
    """
    robot, xp = chain.robot, namespace(target, angles)
    frames = limb_frames(robot, None, angles)
    error, jacobian = target - frames.foot, foot_jacobian(robot, frames)
    if chain.attitude is not None:
        length = ((norm(robot.foot_center) + norm(robot.frame_position[:, 1:]).sum(-1)) / robot.joints)[:, None]
        turn = turn_between(frames.rotation[..., -1, :, :], chain.attitude)
        error = xp.concatenate([error, length * turn], axis=-1)
        jacobian = xp.concatenate([jacobian, length[..., None] * joint_axes(robot, frames).angular.mT], axis=-2)
    if robot.driven is not None:
        jacobian = xp.where(robot.driven[:, None], jacobian, 0.0)
    return error, jacobian


def _change(
    chain: Chain,
    target: AnyArray,
    angles: AnyArray,
    damping: float,
    pull: AnyArray | None,
    longest: float = _LONGEST_STEP,
) -> AnyArray:
    """Return the change of joint angles of one step of damped least squares, shortened limb by limb to the longest.

    It is `J^T (J J^T + d)^-1 e`, or `(J^T J + d)^-1 J^T e` where J has fewer columns than rows. The damping d is
    `damping` times the squared error (Levenberg-Marquardt, after Sugihara, IEEE Trans. Robotics 27, 2011) and a little
    that keeps factors finite. Of `pull` (limb, joint) that part is added which moves no foot.
    """
    xp = namespace(target, angles)
    error, jacobian = _error_and_jacobian(chain, target, angles)
    rows, joints = jacobian.shape[-2:]
    least = max(_LEAST_DAMPING, _LEAST_ROUNDINGS * float(xp.finfo(angles.dtype).eps)) / joints
    damped = damping * (error * error).sum(-1) + least * (jacobian * jacobian).sum((-1, -2))
    damped = damped[..., None, None] * xp.eye(min(rows, joints), dtype=jacobian.dtype)
    pulled = pull is not None and joints > rows
    vector = (error - xp.matvec(jacobian, pull) if pulled else error)[..., None]
    back = jacobian.mT
    if joints < rows:
        change = solve_symmetric(back @ jacobian + damped, back @ vector)[..., 0]
    else:
        change = (back @ solve_symmetric(jacobian @ back + damped, vector))[..., 0]
    change = pull + change if pulled else change
    return change * (longest / xp.maximum(abs(change).max(-1, keepdims=True), longest))


def _closed_form(geometry: LimbGeometry, foot: AnyArray) -> JointSolution:
    xp = namespace(foot)
    local = xp.vecmat(foot - geometry.hip_position, geometry.hip_rotation)
    ahead, aside, up = local[..., 0], local[..., 1], local[..., 2]
    tiny = float(xp.finfo(local.dtype).eps) * 1e-2
    horizontal = ahead**2 + aside**2 - geometry.lateral**2
    out = xp.sqrt(xp.where(horizontal > tiny, horizontal, tiny))
    # the foot's direction about the coxa's axis, less that of its offset from the plane of femur and tibia
    coxa = _angle(aside, ahead, tiny) - xp.arctan2(geometry.lateral, out)

    x, z = out - geometry.femur_out, up - geometry.femur_up
    a, b = geometry.femur_length, geometry.tibia_length
    # the law of cosines in that plane; out of reach the knee is straight, or folded
    cosine = (x * x + z * z - a * a - b * b) / (2 * a * b)
    within = abs(cosine) < 1
    cosine = xp.clip(cosine, -1.0, 1.0)
    sine = geometry.knee_sign * xp.where(within, xp.sqrt(xp.where(within, 1 - cosine**2, 1.0)), 0.0)
    knee = xp.arctan2(sine, cosine)
    line = _angle(z, x, tiny) - _angle(b * sine, a + b * cosine, tiny)

    femur = geometry.femur_sign * (line - geometry.femur_angle)
    tibia = geometry.tibia_sign * (knee + geometry.femur_angle - geometry.tibia_angle)
    angles = xp.stack([coxa, femur, tibia], axis=-1)
    wrapped = xp.where(angles > np.pi, angles - 2 * np.pi, xp.where(angles <= -np.pi, angles + 2 * np.pi, angles))
    return JointSolution(wrapped, within & (horizontal > tiny))


def _angle(y: AnyArray, x: AnyArray, tiny: float) -> AnyArray:
    """Return `arctan2(y, x)`, zero with derivative zero next to the origin."""
    xp = namespace(y, x)
    at_origin = x * x + y * y < tiny
    return xp.arctan2(xp.where(at_origin, 0.0, y), xp.where(at_origin, 1.0, x))
