"""What a swinging limb puts on the base: the change of its links' momentum, along a nominal swing.

Worked out with NumPy before anything is compiled. The samples of a swing come first, then batch axes, limbs, links,
components; they lie at the extremes of a Chebyshev polynomial in each half of the swing, from which derivatives come
to rounding (Trefethen, Spectral Methods in MATLAB, 2000, chapter 6).
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from mjx_climb.dynamics.inverse_kinematics import Chain, inverse_kinematics, limb_geometry, settled
from mjx_climb.dynamics.kinematics import limb_frames
from mjx_climb.dynamics.spatial import quaternion_to_matrix
from mjx_climb.quantities.swing import added_shapes, lift, rest_to_rest
from mjx_climb.robot.constants import Robot, load_robot
from mjx_climb.scenario.model import Gait, RobotFile, Scenario

_NODES = 32  # in each half of a swing, for eight digits


class Reaction(NamedTuple):
    """What swinging limbs put on the base, in walk axes (x ahead, z up) and about the base's centre of mass."""

    time: np.ndarray  # (S,) s since lift-off
    weight: np.ndarray  # (S,) s, of the samples in an integral over the swing
    force: np.ndarray  # (S, ..., limb, 3) N
    moment: np.ndarray  # (S, ..., limb, 3) N m
    foot: np.ndarray  # (S, ..., limb, 3) m, where the foot is asked to be: from its foothold
    joints: np.ndarray  # (S, ..., limb, joint) rad, or m
    missed: np.ndarray  # (S, ..., limb) m, by which the joints cannot have the foot there
    length: float  # m, mean distance of the feet from the base: what a moment is divided by to count as a force

    @property
    def residuals(self) -> np.ndarray:
        """Force and moment over the length, weighted for the integral of their squares, (S, ..., limb, 6)."""
        wrench = np.concatenate([self.force, self.moment / self.length], axis=-1)
        weighted: np.ndarray = wrench * np.sqrt(_per_sample(self.weight, wrench))
        return weighted

    @property
    def squared(self) -> np.ndarray:
        """Integral over the swing of the squared wrench, moments over the length, (..., limb) N^2 s."""
        total: np.ndarray = (self.residuals**2).sum((0, -1))
        return total


def swing_reaction(scenario: Scenario, swing_path: np.ndarray) -> Reaction:
    """Return what each limb's swing puts on a base in its nominal motion, on flat ground.

    `swing_path` (..., limb, 3, K) is what is added to the cubic swing, in step heights, as `Parameters.swing_path` has
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

    `near` (S, ..., limb, joint) are joint angles near those asked for, the rest stance where None; `nodes` is the
    number of samples in each half of the swing.
    """
    robot, (phase, derivative, weight) = load_robot(name), _samples(nodes)
    span = (1 - gait.duty) * gait.cycle
    rotation = quaternion_to_matrix(robot.stance_orientation)
    rest = limb_frames(robot, rotation, robot.stance_joints)

    # where foot and base are, from where they were at the start of the limb's cycle
    foot = gait.step_height * _added(phase, swing_path)
    foot[..., 0] += _per_sample(gait.stride * rest_to_rest(phase), foot[..., 0])
    foot[..., 2] += _per_sample(gait.step_height * lift(phase), foot[..., 2])
    lift_off = np.array([gait.lift_off[limb] for limb in robot.limbs])
    base = np.zeros_like(foot)
    base[..., 0] = gait.stride * rest_to_rest(lift_off + (1 - gait.duty) * _per_sample(phase, foot[..., 0]))

    joints, missed = _postures(robot, turned, (rest.foot + foot - base) @ rotation, near)
    frames = limb_frames(robot, rotation, joints)
    rate = derivative / span
    arm = frames.position + np.matvec(frames.rotation, robot.link_center)
    linear = np.tensordot(rate @ rate, arm + base[..., None, :], 1) * robot.link_mass[..., None]
    turning = np.tensordot(rate, frames.rotation, 1) @ frames.rotation.mT  # the matrix of cross(omega, .)
    angular = np.stack([turning[..., 2, 1], turning[..., 0, 2], turning[..., 1, 0]], axis=-1)
    spin = np.matvec(frames.rotation @ robot.link_inertia @ frames.rotation.mT, angular)
    moment = np.cross(arm, linear) + np.tensordot(rate, spin, 1)
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


def _postures(robot: Robot, turned: bool, target: np.ndarray, near: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return joint values that the inverse kinematics of a walk settles at, and what the feet miss (..., limb) m.

    `target` (..., limb, 3) m are places of the feet in the base frame.
    """
    geometry = limb_geometry(robot, turned)
    if isinstance(geometry, Chain):
        start = robot.stance_joints if near is None else near
        return settled(geometry, target, np.broadcast_to(start, (*target.shape[:-1], robot.joints)))
    joints = inverse_kinematics(geometry, target).joint_angles
    return joints, np.linalg.norm(target - limb_frames(robot, None, joints).foot, axis=-1)


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


def heights(phase: np.ndarray, swing_path: np.ndarray) -> np.ndarray:
    """Return how high swings are at some phases, (S, ..., limb), in step heights."""
    added = _added(phase, swing_path)[..., 2]
    height: np.ndarray = added + _per_sample(lift(phase), added)
    return height


def _added(phase: np.ndarray, swing_path: np.ndarray) -> np.ndarray:
    """Return what is added to swings at some phases, (S, ..., limb, 3), in the units of `swing_path`."""
    horizontal, vertical = (np.stack(shapes) for shapes in added_shapes(phase))
    shapes = np.stack([horizontal, horizontal, vertical])[:, : swing_path.shape[-1]]
    added: np.ndarray = np.einsum("cks,...lck->s...lc", shapes, swing_path)
    return added


def _per_sample(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return values (S,) with axes for all that follows the samples in another array."""
    return values.reshape(-1, *[1] * (like.ndim - 1))
