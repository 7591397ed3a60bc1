"""Forward kinematics of the limbs: frames, feet and their Jacobians.

`limb_frames`, `joint_axes` and `foot_jacobian` work over leading axes and on NumPy's arrays too.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.arrays import AnyArray, namespace
from mjx_climb.physics.spatial import quaternion_to_matrix, turn_about_z
from mjx_climb.physics.state import State
from mjx_climb.robot.constants import Robot

UP = (0.0, 0.0, 1.0)  # normal of the ground, where there are no holds


class LinkPose(NamedTuple):
    """Each link's frame in that of its parent."""

    rotation: AnyArray  # (limb, joint, 3, 3)
    position: AnyArray  # (limb, joint, 3) m


class LimbFrames(NamedTuple):
    """Link frames of every limb, relative to the base's centre of mass."""

    rotation: AnyArray  # (limb, joint, 3, 3)
    position: AnyArray  # (limb, joint, 3) m, of the joint
    foot: AnyArray  # (limb, 3) m


class JointAxes(NamedTuple):
    """Velocity of the links beyond each joint per unit of its rate, of the point at the joint."""

    angular: AnyArray  # (limb, joint, 3), zero for sliding joints
    linear: AnyArray | None  # (limb, joint, 3), zero for revolute joints; None: no joint slides


class Surface(NamedTuple):
    """The planes of the ground at the feet, in world axes."""

    point: Array  # (limb, 3) m, on it
    normal: Array  # (limb, 3) 1, unit, out of the ground


class Feet(NamedTuple):
    """Position and velocity of the feet, in world axes."""

    position: Array  # (limb, 3) m
    velocity: Array  # (limb, 3) m/s, of the foot point itself
    lever: Array  # (limb, 3) m, from the base's centre of mass to the foot
    surface: Surface | None = None  # of the holds; None: z is the normal everywhere


def ground_normal(feet: Feet) -> Array:
    """Return the normals of the ground at the feet, (limb, 3)."""
    if feet.surface is not None:
        return feet.surface.normal
    return jnp.broadcast_to(jnp.array(UP, feet.position.dtype), feet.position.shape)


class Turning(NamedTuple):
    """How the links that end in feet are turned, and turn, in world axes."""

    rotation: Array  # (limb, 3, 3)
    velocity: Array  # (limb, 3) rad/s
    jacobian: Array  # (limb, 3, joint): angular velocity per joint rate


def by_kind(robot: Robot, values: AnyArray) -> tuple[AnyArray, AnyArray | None]:
    """Return joint values (limb, joint) of revolute joints alone, and of sliding ones alone; others are zero.

    The second is None where no joint slides.
    """
    slides = robot.sliding
    if slides is None:
        return values, None
    xp = namespace(values)
    return xp.where(slides, 0.0, values), xp.where(slides, values, 0.0)


def link_poses(robot: Robot, joint_angles: AnyArray) -> LinkPose:
    """Return where links are in their parents' frames, for joint angles (limb, joint) rad, or m of sliding joints."""
    angle, travel = by_kind(robot, joint_angles)
    position = robot.frame_position
    if travel is not None:
        position = position + robot.frame_rotation[..., 2] * travel[..., None]
    return LinkPose(turn_about_z(robot.frame_rotation, angle), position)


def limb_frames(robot: Robot, base_rotation: AnyArray | None, joint_angles: AnyArray) -> LimbFrames:
    """Return the link frames in world axes; where `base_rotation` (3, 3) is None, in the base's own.

    Joint angles are (limb, joint) rad, or m of sliding joints.
    """
    xp = namespace(base_rotation, joint_angles)
    local = link_poses(robot, joint_angles)
    rotation: AnyArray = base_rotation
    position: AnyArray = 0.0
    rotations, positions = [], []
    for link in range(robot.joints):
        turn, arm = local.rotation[..., link, :, :], local.position[..., link, :]
        position = position + (arm if rotation is None else xp.matvec(rotation, arm))
        rotation = turn if rotation is None else rotation @ turn
        rotations.append(rotation)
        positions.append(position)
    foot = position + xp.matvec(rotation, robot.foot_center)
    return LimbFrames(xp.stack(rotations, axis=-3), xp.stack(xp.broadcast_arrays(*positions), axis=-2), foot)


def joint_axes(robot: Robot, frames: LimbFrames) -> JointAxes:
    """Return the axes of revolute and of sliding joints."""
    axis, slides = frames.rotation[..., 2], robot.sliding
    if slides is None:
        return JointAxes(axis, None)
    xp, slides = namespace(axis), slides[..., None]
    return JointAxes(xp.where(slides, 0.0, axis), xp.where(slides, axis, 0.0))


def foot_jacobian(robot: Robot, frames: LimbFrames) -> AnyArray:
    """Return the velocity of the feet per joint rate, (limb, 3, joint) m."""
    angular, linear = joint_axes(robot, frames)
    xp = namespace(angular)
    # omega x r for each joint's axis
    columns = xp.cross(angular, frames.foot[..., None, :] - frames.position)
    return (columns if linear is None else columns + linear).mT


def foot_kinematics(robot: Robot, frames: LimbFrames, state: State) -> Feet:
    """Return positions and velocities of the feet, from frames in the base's axes."""
    rotation = quaternion_to_matrix(state.base_orientation)
    lever = frames.foot @ rotation.T  # each row times R^T is R p
    velocity = state.base_linear_velocity + jnp.cross(state.base_angular_velocity, lever)
    velocity = velocity + jnp.matvec(foot_jacobian(robot, frames), state.joint_rates) @ rotation.T
    return Feet(state.base_position + lever, velocity, lever)


def foot_turning(robot: Robot, frames: LimbFrames, state: State) -> Turning:
    """Return the attitudes of the last links and how they change, from frames in the base's axes."""
    rotation = quaternion_to_matrix(state.base_orientation)
    jacobian = rotation @ joint_axes(robot, frames).angular.mT
    velocity = state.base_angular_velocity + jnp.matvec(jacobian, state.joint_rates)
    return Turning(rotation @ frames.rotation[:, -1], velocity, jacobian)


def turn_between(one: AnyArray, other: AnyArray) -> AnyArray:
    """Return the axis of the turn from an attitude (..., 3, 3) to another, times the sine of its angle (..., 3)."""
    return 0.5 * namespace(one, other).cross(one.mT, other.mT).sum(-2)


def center_of_mass(robot: Robot, frames: LimbFrames, state: State, cargo_mass: Array) -> AnyArray:
    """Return the centre of mass (3,) m, world, of robot and cargo, () kg, from frames in the base's axes."""
    center = frames.position + jnp.matvec(frames.rotation, robot.link_center)
    moment = (robot.link_mass[..., None] * center).sum((0, 1))
    return state.base_position + quaternion_to_matrix(state.base_orientation) @ moment / (cargo_mass + robot.total_mass)


def base_wrench_of_foot_force(lever: Array, foot_force: Array, foot_moment: Array | float = 0.0) -> Array:
    """Return `J_b^T F_e` (6,): sums of the foot forces (limb, 3), N, and of their moments about the base, N m."""
    return jnp.concatenate([foot_force.sum(0), (jnp.cross(lever, foot_force) + foot_moment).sum(0)])
