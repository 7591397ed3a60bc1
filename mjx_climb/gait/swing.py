"""Swings of a foot: their shapes over the phase, and the swing that disturbs the base least.

The shapes are written with operators alone, so that arrays of JAX and of NumPy do. The rest is NumPy, before anything
is compiled: the momentum of the links along a nominal swing gives the reaction on the base, and Gauss-Newton the
addition to each limb's cubic swing. The idea of a low-reaction swing is that of RAMP (Ribeiro et al., ICRA 2023); the
measure and the search are our own. Samples lie at the extremes of a Chebyshev polynomial in each half of the swing,
from which derivatives come to rounding (Trefethen, Spectral Methods in MATLAB, 2000, chapter 6); they come first, then
batch axes, limbs, links, components.
"""

import functools
from typing import NamedTuple, TypeVar

import numpy as np
from jax import Array
from numpy.polynomial import chebyshev

from mjx_climb.physics.inverse_kinematics import Chain, inverse_kinematics, limb_geometry, solve_to_convergence
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.model import Gait, Scenario

COUNT = 6  # of added shapes for each axis
_FINE, _NODES = 32, 12  # samples in each half of a swing: for eight digits, and for four in the search
# Gauss-Newton steps at most; it ends once one lowers the sum of squares by less than this share
_ROUNDS, _ENOUGH = 8, 1e-3
# shares of a step that are tried: a line search
_TRIED = 0.5 ** np.arange(8)
_DIFFERENCE = 1e-4  # step heights, of the finite differences of the Jacobian
# regularisation of the coefficients, relative to the reaction of the cubic swing
_WEIGHT = 1e-3
_WITHIN = 1e-9  # rad, or m, tolerance of joint limits and footholds

_Phase = TypeVar("_Phase", Array, np.ndarray)


def rest_to_rest(phase: _Phase) -> _Phase:
    """Return the cubic from 0 to 1 with zero slope at both ends; its curvature is zero in the middle."""
    risen: _Phase = phase * phase * (3 - 2 * phase)
    return risen


def lift(phase: _Phase) -> _Phase:
    """Return the height of a swing, from 0 to 1 in the middle and back to 0, at rest in all three."""
    return rest_to_rest(1 - abs(2 * phase - 1))


def added_shapes(phase: _Phase) -> tuple[list[_Phase], list[_Phase]]:
    """Return the shapes that may be added to a swing: `COUNT` for each horizontal axis, and as many for the height.

    All are zero with zero slope and curvature at both ends, so that a foot leaves its foothold and comes to the next in
    the direction of the cubic; those for the height are zero in the middle as well.
    """
    across = 2 * phase - 1
    bump = (1 - across * across) ** 3
    horizontal = [bump * across**k for k in range(COUNT)]
    return horizontal, [across * shape for shape in horizontal]


# --- the reaction of a swing on the base


class Reaction(NamedTuple):
    """Reaction of swinging limbs on the base, in walk axes (x ahead, z up) and about the base's centre of mass."""

    time: np.ndarray  # (S,) s since lift-off
    weight: np.ndarray  # (S,) s, of the samples in an integral over the swing
    force: np.ndarray  # (S, ..., limb, 3) N
    moment: np.ndarray  # (S, ..., limb, 3) N m
    joints: np.ndarray  # (S, ..., limb, joint) rad, or m
    missed: np.ndarray  # (S, ..., limb) m, distance of the foot from its target
    length: float  # m, mean distance of the feet from the base: moments over it count as forces

    @property
    def residuals(self) -> np.ndarray:
        """Force and moment over the length, weighted for the integral of their squares, (S, ..., limb, 6)."""
        wrench = np.concatenate([self.force, self.moment / self.length], axis=-1)
        return np.asarray(wrench * np.sqrt(_per_sample(self.weight, wrench)))


def swing_reaction(
    robot: Robot,
    gait: Gait,
    turned: bool,
    path: np.ndarray,
    near: np.ndarray | None = None,
    nodes: int = _FINE,
) -> Reaction:
    """Return the reaction of each limb's swing on a base in its nominal motion, on flat ground.

    `path` (..., limb, 3, K) is added to the cubic swing, as `swing_path` has it. With `turned` feet of six
    joints or more keep their attitudes. `near` (S, ..., limb, joint) are joint angles near those asked for, the rest
    stance where None.
    """
    phase, derivative, weight = _samples(nodes)
    span = (1 - gait.settling) * (1 - gait.duty) * gait.cycle
    rotation = quaternion_to_matrix(robot.stance_orientation)
    rest = limb_frames(robot, rotation, robot.stance_joints)

    # where foot and base are, from where they were at the start of the limb's cycle
    foot = gait.step_height * _added(phase, path)
    foot[..., 0] += _per_sample(gait.stride * rest_to_rest(phase), foot[..., 0])
    foot[..., 2] += _per_sample(gait.step_height * lift(phase), foot[..., 2])
    lift_off = np.array([gait.lift_off[limb] for limb in robot.limbs])
    base = np.zeros_like(foot)
    base[..., 0] = gait.stride * rest_to_rest(lift_off + span / gait.cycle * _per_sample(phase, foot[..., 0]))

    target = (rest.foot + foot - base) @ rotation
    geometry = limb_geometry(robot, turned)
    # the solution to which the inverse kinematics of a walk converges
    if isinstance(geometry, Chain):
        start = robot.stance_joints if near is None else near
        joints, missed = solve_to_convergence(
            geometry, target, np.broadcast_to(start, (*target.shape[:-1], robot.joints))
        )
    else:
        joints = inverse_kinematics(geometry, target).joint_angles
        missed = np.linalg.norm(target - limb_frames(robot, None, joints).foot, axis=-1)
    frames = limb_frames(robot, rotation, joints)
    rate = derivative / span
    arm = frames.position + np.matvec(frames.rotation, robot.link_center)
    linear = np.tensordot(rate @ rate, arm + base[..., None, :], 1) * robot.link_mass[..., None]
    turning = np.tensordot(rate, frames.rotation, 1) @ frames.rotation.mT  # the matrix of cross(omega, .)
    angular = np.stack([turning[..., 2, 1], turning[..., 0, 2], turning[..., 1, 0]], axis=-1)
    spin = np.matvec(frames.rotation @ robot.link_inertia @ frames.rotation.mT, angular)
    moment = np.cross(arm, linear) + np.tensordot(rate, spin, 1)
    length = float(np.linalg.norm(rest.foot, axis=-1).mean())
    return Reaction(span * phase, span * weight, -linear.sum(-2), -moment.sum(-2), joints, missed, length)


@functools.cache
def _samples(nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return phases (S,), the matrix (S, S) that differentiates by phase within each half, and weights (S,)."""
    points = -np.cos(np.pi * np.arange(nodes) / (nodes - 1))
    values = chebyshev.chebvander(points, nodes - 1)
    slopes = chebyshev.chebval(points, chebyshev.chebder(np.eye(nodes))).T
    integrals = chebyshev.chebval(1.0, chebyshev.chebint(np.eye(nodes), lbnd=-1))
    derivative, weight = slopes @ np.linalg.inv(values), np.linalg.solve(values.T, integrals)
    phase = (points + 1) / 4  # a half is a quarter as long as from -1 to 1
    return np.concatenate([phase, phase + 0.5]), 4 * np.kron(np.eye(2), derivative), np.tile(weight, 2) / 4


def heights(phase: np.ndarray, swing_path: np.ndarray) -> np.ndarray:
    """Return how high swings are at some phases, (S, ..., limb), in step heights."""
    added = _added(phase, swing_path)[..., 2]
    return np.asarray(added + _per_sample(lift(phase), added))


def _added(phase: np.ndarray, swing_path: np.ndarray) -> np.ndarray:
    """Return the changes of swings at some phases, (S, ..., limb, 3), in the units of `swing_path`."""
    horizontal, vertical = (np.stack(shapes) for shapes in added_shapes(phase))
    shapes = np.stack([horizontal, horizontal, vertical])[:, : swing_path.shape[-1]]
    return np.asarray(np.einsum("cks,...lck->s...lc", shapes, swing_path))


def _per_sample(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return values (S,) with axes for all that follows the samples in another array."""
    return values.reshape(-1, *[1] * (like.ndim - 1))


# --- the swing of least reaction


def swing_path(scenario: Scenario, robot: Robot, turned: bool = False) -> np.ndarray:
    """Return the coefficients of a scenario's `gait.swing`, (limb, 3, K), in step heights; K is 0 for `cubic`.

    Axes: ahead, left, up; shapes as `added_shapes`. For `low_reaction` the integral of the squared reaction on the base
    is as small as these shapes make it (a local minimum, from the cubic), on flat ground: see `swing_reaction`. Limbs
    that lift off together count by the sum of their reactions.
    Feet stay above the ground and as high as the cubic in the middle, joints within their limits or those of the cubic.
    A limb that cannot follow its cubic keeps it, as do those that lift off with it.

    It is computed for the scenario's own stride, step height and timing. In `Parameters` it is one value for all
    robots of a batch, in step heights: other step heights scale it, headings turn it, and it is zero at both ends, so
    that other strides, cycles and grounds get a sound swing, if not their best. For these give the parameters a batch
    of `swing_path`, one from each scenario.
    """
    if scenario.gait.swing == "cubic":
        return np.zeros((len(scenario.gait.lift_off), 3, 0))
    return _least(robot, scenario.gait, turned).copy()


@functools.lru_cache(maxsize=64)
def _least(robot: Robot, gait: Gait, turned: bool) -> np.ndarray:
    """Return the paths (limb, 3, K) by Gauss-Newton, one for each group of limbs that lift off together."""
    unknowns = 3 * COUNT
    lift_off = np.array([gait.lift_off[limb] for limb in robot.limbs])
    groups = [lift_off == one for one in np.unique(lift_off)]
    swung = functools.partial(swing_reaction, robot, gait, turned, nodes=_NODES)
    path = np.zeros((len(robot.limbs), 3, COUNT))
    now = swung(path)
    lower = np.minimum(robot.joint_lower, now.joints.min(0)) - _WITHIN
    upper = np.maximum(robot.joint_upper, now.joints.max(0)) + _WITHIN
    weights = [_WEIGHT * _sum_of_squares(now, path, 0.0, group) for group in groups]
    for _ in range(_ROUNDS):
        aside = path + _DIFFERENCE * np.eye(unknowns).reshape(-1, 1, 3, COUNT)
        around = swung(aside, now.joints[:, None])
        jacobian = (around.residuals - now.residuals[:, None]) / _DIFFERENCE
        step = np.zeros_like(path)
        for group, weight in zip(groups, weights, strict=True):
            columns = np.moveaxis(jacobian[:, :, group], (2, 1), (-2, -1)).reshape(-1, group.sum() * unknowns)
            held = np.sqrt(weight) * np.eye(columns.shape[1])
            left = np.concatenate([now.residuals[:, group].sum(1).ravel(), np.sqrt(weight) * path[group].ravel()])
            step[group] = -np.linalg.lstsq(np.concatenate([columns, held]), left, rcond=None)[0].reshape(-1, 3, COUNT)
        tried = path + _TRIED[:, None, None, None] * step
        tries = swung(tried, now.joints[:, None])
        allowed = ((tries.joints >= lower) & (tries.joints <= upper)).all((0, -1)) & (tries.missed.max(0) <= _WITHIN)
        gained = 0.0
        for group, weight in zip(groups, weights, strict=True):
            before = _sum_of_squares(now, path, weight, group)
            after = np.where(allowed[:, group].all(1), _sum_of_squares(tries, tried, weight, group), np.inf)
            if after[best := int(np.argmin(after))] < before:
                path[group] = tried[best, group]
                gained = max(gained, 1 - after[best] / before)
        now = swung(path, now.joints)
        if gained < _ENOUGH:
            break
    return path


def _sum_of_squares(swung: Reaction, path: np.ndarray, weight: np.ndarray | float, group: np.ndarray) -> np.ndarray:
    """Return the objective (...) of limbs that swing together: squared reaction and weighted coefficients."""
    together = swung.residuals[..., group, :].sum(-2)
    return np.asarray((together**2).sum((0, -1)) + weight * (path[..., group, :, :] ** 2).sum((-3, -2, -1)))
