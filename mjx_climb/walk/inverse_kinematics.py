"""Inverse kinematics of the limbs: in closed form where there is one, else by damped Gauss-Newton steps.

The closed form is that of a yaw joint and two parallel pitch joints, all link offsets kept.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.dynamics.kinematics import foot_velocity_per_rate, limb_frames, turn_between, turning_per_rate
from mjx_climb.dynamics.limb_engine import factorize, solve
from mjx_climb.dynamics.spatial import chosen, compose, dot, norm, rotate_back
from mjx_climb.robot.constants import Robot

_PARALLEL = 1e-9
STEPS = 4  # of Gauss-Newton, from the last solution
_DAMPING = 0.5  # of a step, 1 per squared error: quadratic convergence near the target, calm out of reach
_LEAST_DAMPING = 1e-10  # of the limb's mean squared lever, in double precision
_LEAST_ROUNDINGS = 8.0  # the same in units of rounding, in single precision
_PULL = 0.05  # of the way to the rest posture in a step, where that does not move the foot
_LONGEST_STEP = 0.3  # rad, or m
POSE = 6  # joints of a limb that can put its foot anywhere, turned in any way
_MET = 1e-4  # m, from a target that counts as reached


class LimbGeometry(NamedTuple):
    """What the closed form needs of the limbs: plane coordinates are (outward, up) in the coxa's own frame."""

    hip_position: np.ndarray  # (3, L, 1) m, base frame
    hip_rotation: np.ndarray  # (3, 3, L, 1): x outward in the limb's plane, z along the coxa's axis
    lateral: np.ndarray  # (L, 1) m, distance of the foot from the plane through the coxa's axis
    femur_out: np.ndarray  # (L, 1) m, femur joint from the coxa's axis
    femur_up: np.ndarray  # (L, 1) m
    femur_length: np.ndarray  # (L, 1) m
    tibia_length: np.ndarray  # (L, 1) m
    femur_angle: np.ndarray  # (L, 1) rad, elevation of the femur's line at joint zero
    tibia_angle: np.ndarray  # (L, 1) rad, elevation of the line to the foot at joint zero
    femur_sign: np.ndarray  # (L, 1), +1 where a positive joint angle raises
    tibia_sign: np.ndarray  # (L, 1)
    knee_sign: np.ndarray  # (L, 1), sign of the knee's bend in the rest stance


class JointSolution(NamedTuple):
    """Joint angles and whether the target could be met."""

    joint_angles: Array  # (3, L, B) rad
    reachable: Array  # (L, B) bool


class Chain(NamedTuple):
    """Limbs without a closed form."""

    robot: Robot
    attitude: Any = None  # (3, 3, L, 1), base frame: how the last links are to be turned; None: any way


def limb_geometry(robot: Robot, turned: bool = False) -> LimbGeometry | Chain:
    """Return the geometry of a robot's limbs for `inverse_kinematics`.

    Limbs that rest in a posture that is not the closed form's, with the foot on the far side of the first joint's axis
    for example, have none. With `turned` the last links of limbs with six driven joints or more keep the attitudes of
    the rest stance.
    """
    driven = robot.joints if robot.driven is None else int(robot.driven.sum(0).min())
    if turned and driven >= POSE:
        return Chain(robot, limb_frames(robot, None, jnp.asarray(robot.stance_joints)).rotation[-1])
    if robot.joints != 3 or robot.slides or robot.passive:
        return Chain(robot)
    columns = []
    for limb in range(len(robot.limbs)):
        rotation = np.asarray(robot.frame_rotation)[..., limb, 0]
        position = np.asarray(robot.frame_position)[..., limb, 0]
        femur_axis = rotation[1][:, 2]  # in the coxa's frame
        tibia_axis = rotation[1] @ rotation[2][:, 2]
        if abs(femur_axis[2]) > _PARALLEL or np.linalg.norm(np.cross(femur_axis, tibia_axis)) > _PARALLEL:
            return Chain(robot)
        knee = position[1] + rotation[1] @ position[2]
        foot = knee + rotation[1] @ rotation[2] @ np.asarray(robot.foot_center)[:, limb, 0]
        outward = np.cross([0.0, 0.0, 1.0], femur_axis)
        outward *= np.sign(outward @ foot)
        plane = np.stack([outward, np.cross([0.0, 0.0, 1.0], outward), [0.0, 0.0, 1.0]], axis=1)
        femur_origin, knee, foot = (plane.T @ point for point in (position[1], knee, foot))
        # a rotation about the plane's own -y raises
        femur_sign, tibia_sign = (-(plane.T @ axis)[1] for axis in (femur_axis, tibia_axis))
        elevation = [np.arctan2(v[2], v[0]) for v in (knee - femur_origin, foot - knee)]
        bend = elevation[1] - elevation[0] + np.sign(tibia_sign) * np.asarray(robot.stance_joints)[2, limb, 0]
        columns.append(
            LimbGeometry(
                hip_position=position[0],
                hip_rotation=rotation[0] @ plane,
                lateral=foot[1],
                femur_out=femur_origin[0],
                femur_up=femur_origin[2],
                femur_length=np.hypot(*(knee - femur_origin)[[0, 2]]),
                tibia_length=np.hypot(*(foot - knee)[[0, 2]]),
                femur_angle=elevation[0],
                tibia_angle=elevation[1],
                femur_sign=np.sign(femur_sign),
                tibia_sign=np.sign(tibia_sign),
                knee_sign=np.sign(np.sin(bend)),
            )
        )
    geometry = LimbGeometry(*(np.stack(field, axis=-1)[..., None] for field in zip(*columns, strict=True)))
    return geometry if _stands(robot, geometry) else Chain(robot)


def _stands(robot: Robot, geometry: LimbGeometry) -> bool:
    """Return whether the closed form gives the rest stance: it takes the feet to be outward of the first joints' axes.

    By NumPy: this is asked whenever a walk is traced.
    """
    _, femur, tibia = np.asarray(robot.stance_joints)
    line = geometry.femur_angle + geometry.femur_sign * femur
    shin = line + geometry.tibia_angle - geometry.femur_angle + geometry.tibia_sign * tibia
    out = geometry.femur_out + geometry.femur_length * np.cos(line) + geometry.tibia_length * np.cos(shin)
    return bool((out > 0).all())


def _safe_sqrt(square: Array, floor: float) -> Array:
    """Return sqrt(square), held at sqrt(floor) with derivative zero below the floor."""
    above = square > floor
    return jnp.sqrt(jnp.where(above, square, floor))


def inverse_kinematics(
    geometry: LimbGeometry | Chain, foot: Array, last: Array | None = None, turn: Array | None = None
) -> JointSolution:
    """Return the joint angles that put the feet at `foot`, (3, L, B) m in the base frame.

    A target out of reach gives the nearest stretch or fold of the limb towards it, finite in value and derivative, and
    is flagged. Angles lie in (-pi, pi] in the closed form; joint limits are not applied here. Limbs without a closed
    form take `STEPS` steps from `last` (N, L, B), the posture before, or the rest stance; where they keep an attitude,
    it is that of the rest stance turned by `turn` (3, 3, B).
    """
    if isinstance(geometry, Chain):
        stance = jnp.asarray(geometry.robot.stance_joints)
        start = jnp.broadcast_to(stance, (*stance.shape[:2], foot.shape[-1])) if last is None else last
        attitude = geometry.attitude
        if attitude is not None and turn is not None:
            attitude = compose(turn[:, :, None], attitude)
        return _gauss_newton(geometry.robot, foot, attitude, start)
    return _closed_form(geometry, foot)


def _gauss_newton(robot: Robot, target: Array, attitude: Array | None, angles: Array) -> JointSolution:
    """Return the posture after a fixed number of damped steps, the last two of them towards the target alone.

    What moves no foot goes towards the rest posture, the more the nearer a joint is to its limits (Levenberg-Marquardt
    with the error as its damping, after Sugihara, IEEE Trans. Robotics 27, 2011; null-space
    motion after Liegeois, IEEE Trans. Systems, Man and Cybernetics 7, 1977). A turn counts as a way by the limb's mean
    length. Joints that nothing drives stay where they are.
    """
    middle, half = (robot.joint_lower + robot.joint_upper) / 2, (robot.joint_upper - robot.joint_lower) / 2
    least = max(_LEAST_DAMPING, _LEAST_ROUNDINGS * float(jnp.finfo(angles.dtype).eps))
    rows, length = 3, norm(robot.foot_center)
    if attitude is not None:
        rows = 6
        length = (length + sum(norm(offset) for offset in robot.frame_position[1:])) / robot.joints

    def at(angles: Array) -> tuple[Array, list[Array]]:
        frames = limb_frames(robot, None, angles)
        axes = [rotation[:, 2] for rotation in frames.rotation]
        columns = [
            foot_velocity_per_rate(robot, k, axes[k], frames.foot - frames.position[k]) for k in range(robot.joints)
        ]
        error = target - frames.foot
        if attitude is not None:
            turn = turn_between(frames.rotation[-1], jnp.broadcast_to(attitude, frames.rotation[-1].shape))
            error = jnp.concatenate([error, length * turn])
            columns = [
                jnp.concatenate([column, length * turning_per_rate(robot, k, axes[k])])
                for k, column in enumerate(columns)
            ]
        if robot.driven is not None:
            columns = [chosen(mask, one, 0 * one) for mask, one in zip(robot.driven, columns, strict=True)]
        return error, columns

    for step in range(STEPS):
        error, columns = at(angles)
        lever = sum((dot(column, column) for column in columns), jnp.zeros_like(angles[0])) / robot.joints
        back = _pseudo_inverse(columns, _DAMPING * dot(error, error) + least * lever)
        change = back(error)
        if step < STEPS - 2 and robot.joints > rows:
            near = jnp.clip(((angles - middle) / half) ** 8, 0.0, 8.0)
            pull = _PULL * (1 + near) * (robot.stance_joints - angles)
            if robot.driven is not None:
                pull = jnp.stack([chosen(mask, one, 0 * one) for mask, one in zip(robot.driven, pull, strict=True)])
            moved = jnp.stack([dot(row, pull) for row in jnp.stack(columns, axis=1)])
            change = change + pull - back(moved)
        largest = jnp.abs(change).max(0)
        angles = angles + change * (_LONGEST_STEP / jnp.maximum(largest, _LONGEST_STEP))
    error, _ = at(angles)
    return JointSolution(angles, dot(error, error) < _MET**2)


def _pseudo_inverse(columns: list[Array], damping: Array) -> Callable[[Array], Array]:
    """Return `J^T (J J^T + d)^-1`, or `(J^T J + d)^-1 J^T` where J has fewer columns than rows, as a function.

    It turns (rows, L, B) into (N, L, B). What is factorised is then of full rank where J is.
    """
    over = columns if len(columns) < columns[0].shape[0] else list(jnp.stack(columns, axis=1))
    size = len(over)
    gram = {(i, j): dot(over[i], over[j]) + (damping if i == j else 0.0) for i in range(size) for j in range(i, size)}
    factor = factorize(gram)

    def transposed_times(vector: Array) -> Array:
        return jnp.stack([dot(column, vector) for column in columns])

    if over is columns:
        return lambda vector: solve(factor, transposed_times(vector))
    return lambda vector: transposed_times(solve(factor, vector))


def _closed_form(geometry: LimbGeometry, foot: Array) -> JointSolution:
    local = rotate_back(geometry.hip_rotation, foot - geometry.hip_position)
    tiny = float(jnp.finfo(local.dtype).eps) * 1e-2
    horizontal = local[0] ** 2 + local[1] ** 2 - geometry.lateral**2
    out = _safe_sqrt(horizontal, tiny)
    on_axis = local[0] ** 2 + local[1] ** 2 < tiny
    coxa = jnp.arctan2(jnp.where(on_axis, 0.0, local[1]), jnp.where(on_axis, 1.0, local[0])) - jnp.arctan2(
        geometry.lateral, out
    )

    x, z = out - geometry.femur_out, local[2] - geometry.femur_up
    a, b = geometry.femur_length, geometry.tibia_length
    cosine = (x * x + z * z - a * a - b * b) / (2 * a * b)
    within = jnp.abs(cosine) < 1
    cosine = jnp.clip(cosine, -1.0, 1.0)
    sine = geometry.knee_sign * jnp.where(within, jnp.sqrt(jnp.where(within, 1 - cosine**2, 1.0)), 0.0)
    knee = jnp.arctan2(sine, cosine)
    at_femur = x * x + z * z < tiny
    direction = jnp.arctan2(jnp.where(at_femur, 0.0, z), jnp.where(at_femur, 1.0, x))
    along, across = a + b * cosine, b * sine
    folded = along * along + across * across < tiny
    line = direction - jnp.arctan2(jnp.where(folded, 0.0, across), jnp.where(folded, 1.0, along))

    femur = geometry.femur_sign * (line - geometry.femur_angle)
    tibia = geometry.tibia_sign * (knee + geometry.femur_angle - geometry.tibia_angle)
    angles = jnp.stack([coxa, femur, tibia])
    wrapped = jnp.where(angles > jnp.pi, angles - 2 * jnp.pi, jnp.where(angles <= -jnp.pi, angles + 2 * jnp.pi, angles))
    return JointSolution(wrapped, within & (horizontal > tiny))
