"""What a swinging limb puts on the base: the change of its links' momentum, along a nominal swing.

Worked out with NumPy before anything is compiled. The samples of a swing come first, then batch axes, limbs, links,
components; they lie at the extremes of a Chebyshev polynomial in each half of the swing, from which derivatives come
to rounding (Trefethen, Spectral Methods in MATLAB, 2000, chapter 6).
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from mjx_climb.quantities.swing import added_shapes, lift, rest_to_rest
from mjx_climb.robot.constants import Robot, load_robot
from mjx_climb.scenario.model import Gait, RobotFile, Scenario

_NODES = 32  # in each half of a swing, for eight digits
_POSE = 6  # joints of a limb that can put its foot anywhere, turned in any way
_STEPS = 300  # of Newton, at most
_SETTLED = 1e-12  # rad, or m
_LONGEST_STEP = 0.3  # rad, or m
_PULL = 1.0  # of the way to the rest posture in a step, where that does not move the foot
_TINY = 1e-12  # of a limb's squared lever


class Reaction(NamedTuple):
    """What swinging limbs put on the base, in walk axes (x ahead, z up) and about the base's centre of mass."""

    time: np.ndarray  # (S,) s since lift-off
    weight: np.ndarray  # (S,) s, of the samples in an integral over the swing
    force: np.ndarray  # (S, ..., L, 3) N
    moment: np.ndarray  # (S, ..., L, 3) N m
    foot: np.ndarray  # (S, ..., L, 3) m, where the foot is asked to be: from its foothold
    joints: np.ndarray  # (S, ..., L, N) rad, or m
    missed: np.ndarray  # (S, ..., L) m, by which the joints cannot have the foot there
    length: float  # m, mean distance of the feet from the base: what a moment is divided by to count as a force

    @property
    def squared(self) -> np.ndarray:
        """Integral over the swing of the squared wrench, moments over the length, (..., L) N^2 s."""
        wrench = np.concatenate([self.force, self.moment / self.length], axis=-1)
        total: np.ndarray = np.einsum("s,s...li,s...li->...l", self.weight, wrench, wrench)
        return total


def swing_reaction(scenario: Scenario, swing_path: np.ndarray) -> Reaction:
    """Return what each limb's swing puts on a base in its nominal motion, on flat ground.

    `swing_path` (..., L, 3, K) is what is added to the cubic swing, in step heights, as `Parameters.swing_path` has
    it; K is 0 where nothing is.
    """
    return reaction(scenario.robot, scenario.gait, scenario.contact.rotational_stiffness > 0, swing_path)


def reaction(
    name: str | RobotFile,
    gait: Gait,
    turned: bool,
    swing_path: np.ndarray,
    near: np.ndarray | None = None,
    nodes: int = _NODES,
) -> Reaction:
    """Return `swing_reaction` of a robot and a gait; with `turned` feet of six joints or more keep their attitudes.

    `near` (S, ..., L, N) are joint angles near those asked for, the rest stance where None; `nodes` is the number of
    samples in each half of the swing.
    """
    robot, (phase, derivative, weight) = load_robot(name), _samples(nodes)
    span = (1 - gait.duty) * gait.cycle
    lift_off = np.array([gait.lift_off[limb] for limb in robot.limbs])
    stance = _limb_arrays(robot.stance_joints)
    rest = _placed(robot, stance)

    # where foot and base are, from where they were at the start of the limb's cycle
    foot = gait.step_height * _added(phase, swing_path)
    foot[..., 0] += _per_sample(gait.stride * rest_to_rest(phase), foot[..., 0])
    foot[..., 2] += _per_sample(gait.step_height * lift(phase), foot[..., 2])
    base = np.zeros_like(foot)
    base[..., 0] = gait.stride * rest_to_rest(lift_off + (1 - gait.duty) * _per_sample(phase, foot[..., 0]))

    attitude = rest.rotation[:, -1] if turned and _driven(robot).sum(1).min() >= _POSE else None
    start = np.broadcast_to(stance if near is None else near, (*foot.shape[:-1], robot.joints))
    joints, missed = _postures(robot, rest.foot + foot - base, attitude, start)
    placed = _placed(robot, joints)

    rate = derivative / span
    mass, center, inertia = (_limb_arrays(value) for value in (robot.link_mass, robot.link_center, robot.link_inertia))
    arm = placed.position + (placed.rotation @ center[..., None])[..., 0]
    linear = np.tensordot(rate @ rate, arm + base[..., None, :], 1) * mass[..., None]
    turning = np.tensordot(rate, placed.rotation, 1) @ np.swapaxes(placed.rotation, -1, -2)
    angular = np.stack([turning[..., 2, 1], turning[..., 0, 2], turning[..., 1, 0]], axis=-1)
    spin = placed.rotation @ inertia @ np.swapaxes(placed.rotation, -1, -2) @ angular[..., None]
    moment = np.cross(arm, linear) + np.tensordot(rate, spin[..., 0], 1)
    return Reaction(
        time=span * phase,
        weight=span * weight,
        force=-linear.sum(-2),
        moment=-moment.sum(-2),
        foot=foot,
        joints=joints,
        missed=missed,
        length=float(np.linalg.norm(rest.foot, axis=-1).mean()),
    )


@functools.cache
def _samples(nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return phases (S,), the matrix (S, S) that differentiates by phase within each half, and weights (S,)."""
    order = np.arange(nodes)
    points = -np.cos(np.pi * order / (nodes - 1))
    values = chebyshev.chebvander(points, nodes - 1)
    slopes = np.stack([chebyshev.chebval(points, chebyshev.chebder(one)) for one in np.eye(nodes)], axis=1)
    integrals = np.where(order % 2 == 0, 2 / (1 - np.where(order == 1, 0, order) ** 2), 0.0)
    derivative, weight = slopes @ np.linalg.inv(values), np.linalg.solve(values.T, integrals)
    phase = (points + 1) / 4  # a half is a quarter as long as from -1 to 1
    return np.concatenate([phase, phase + 0.5]), 4 * np.kron(np.eye(2), derivative), np.tile(weight, 2) / 4


def _added(phase: np.ndarray, swing_path: np.ndarray) -> np.ndarray:
    """Return what is added to swings at some phases, (S, ..., L, 3), in the units of `swing_path` (..., L, 3, K)."""
    horizontal, vertical = (np.stack(shapes) for shapes in added_shapes(phase))
    shapes = np.stack([horizontal, horizontal, vertical])[:, : swing_path.shape[-1]]
    added: np.ndarray = np.einsum("cks,...lck->s...lc", shapes, swing_path)
    return added


def heights(phase: np.ndarray, swing_path: np.ndarray) -> np.ndarray:
    """Return how high swings are at some phases, (S, ..., L), in step heights."""
    added = _added(phase, swing_path)[..., 2]
    height: np.ndarray = added + _per_sample(lift(phase), added)
    return height


def _per_sample(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return values (S,) with axes for all that follows the samples in another array."""
    return values.reshape(-1, *[1] * (like.ndim - 1))


class _Placed(NamedTuple):
    """Links of the limbs from the base's centre of mass, in walk axes."""

    rotation: np.ndarray  # (..., L, N, 3, 3)
    position: np.ndarray  # (..., L, N, 3) m
    foot: np.ndarray  # (..., L, 3) m


def _limb_arrays(value: np.ndarray) -> np.ndarray:
    """Return a robot's constants (N, ..., L, 1) as (L, N, ...)."""
    return np.moveaxis(value[..., 0], -1, 0)


def _driven(robot: Robot) -> np.ndarray:
    """Return which joints are driven, (L, N) bool."""
    return ~np.array(robot.passive).T if robot.passive else np.ones((len(robot.limbs), robot.joints), bool)


def _slides(robot: Robot) -> np.ndarray:
    """Return which joints are prismatic, (L, N) bool."""
    return np.array(robot.slides).T if robot.slides else np.zeros((len(robot.limbs), robot.joints), bool)


def _turned(orientation: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = orientation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def _placed(robot: Robot, joints: np.ndarray) -> _Placed:
    """Return where the links are at joint values (..., L, N), the base as in the rest stance."""
    slides = _slides(robot)
    offset, frame = _limb_arrays(robot.frame_position), _limb_arrays(robot.frame_rotation)
    rotation = np.broadcast_to(_turned(robot.stance_orientation[:, 0]), (*joints.shape[:-1], 3, 3))
    position = np.zeros((*joints.shape[:-1], 3))
    rotations, positions = [], []
    for link in range(robot.joints):
        position = position + (rotation @ offset[:, link, :, None])[..., 0]
        rotation = rotation @ frame[:, link]
        position = position + rotation[..., 2] * np.where(slides[:, link], joints[..., link], 0.0)[..., None]
        angle = np.where(slides[:, link], 0.0, joints[..., link])[..., None]
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = (rotation[..., axis] for axis in range(3))
        rotation = np.stack([c * x + s * y, c * y - s * x, z], axis=-1)
        rotations.append(rotation)
        positions.append(position)
    foot = position + (rotation @ _limb_arrays(robot.foot_center[None])[:, 0, :, None])[..., 0]
    return _Placed(np.stack(rotations, axis=-3), np.stack(positions, axis=-2), foot)


def _postures(
    robot: Robot, target: np.ndarray, attitude: np.ndarray | None, joints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint values (..., L, N) that the inverse kinematics of a walk settles at, and what the feet miss.

    What moves no foot is as near the rest posture as `mjx_climb.walk.inverse_kinematics` pulls it.
    """
    slides, driven, stance = _slides(robot), _driven(robot), _limb_arrays(robot.stance_joints)
    lower, upper = _limb_arrays(robot.joint_lower), _limb_arrays(robot.joint_upper)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    reach = np.linalg.norm(_limb_arrays(robot.frame_position[1:]), axis=-1).sum(-1)
    reach = (reach + np.linalg.norm(robot.foot_center[..., 0], axis=0)) / robot.joints
    for _ in range(_STEPS):
        placed = _placed(robot, joints)
        axis = placed.rotation[..., 2]
        column = np.where(slides[..., None], axis, np.cross(axis, placed.foot[..., None, :] - placed.position, axis=-1))
        left = target - placed.foot
        if attitude is not None:
            now = placed.rotation[..., -1, :, :]
            turn = 0.5 * np.cross(np.swapaxes(now, -1, -2), np.swapaxes(attitude, -1, -2)).sum(-2)
            left = np.concatenate([left, reach[:, None] * turn], axis=-1)
            turning = np.where(slides[..., None], 0.0, axis) * reach[:, None, None]
            column = np.concatenate([column, turning], axis=-1)
        column = np.where(driven[..., None], column, 0.0)
        inverse = _pseudo_inverse(np.swapaxes(column, -1, -2))
        change = (inverse @ left[..., None])[..., 0]
        if robot.joints > left.shape[-1]:
            near = np.clip(((joints - middle) / half) ** 8, 0.0, 8.0)
            pull = np.where(driven, (1 + near) * (stance - joints), 0.0)
            pull = pull - (inverse @ (np.swapaxes(column, -1, -2) @ pull[..., None]))[..., 0]
            change = change + _PULL / (1 + near.max(-1, keepdims=True)) * pull
        largest = np.abs(change).max(-1, keepdims=True)
        joints = joints + change * (_LONGEST_STEP / np.maximum(largest, _LONGEST_STEP))
        if largest.max() < _SETTLED:
            break
    return joints, np.linalg.norm(target - _placed(robot, joints).foot, axis=-1)


def _pseudo_inverse(jacobian: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverses (..., N, rows) of matrices (..., rows, N), damped at the edge of rank."""
    transposed = np.swapaxes(jacobian, -1, -2)
    rows, columns = jacobian.shape[-2:]
    least = _TINY * (jacobian**2).sum((-1, -2))[..., None, None]
    if columns < rows:
        inverse: np.ndarray = np.linalg.solve(transposed @ jacobian + least * np.eye(columns), transposed)
        return inverse
    over = np.linalg.solve(jacobian @ transposed + least * np.eye(rows), jacobian)
    return np.swapaxes(over, -1, -2)
