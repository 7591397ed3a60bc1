"""Forward kinematics of the limbs: frames, feet and their Jacobians."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.dynamics.spatial import chosen, compose, cross, dot, rotate
from mjx_climb.dynamics.state import State
from mjx_climb.robot.constants import Robot


class LimbFrames(NamedTuple):
    """Link frames of every limb, in world axes, relative to the base's centre of mass."""

    rotation: tuple[Array, ...]  # per link (3, 3, L, B)
    position: tuple[Array, ...]  # per link (3, L, B) m, the joint
    foot: Array  # (3, L, B) m


class Feet(NamedTuple):
    """Position, velocity and Jacobian of the feet, in world axes."""

    position: Array  # (3, L, B) m
    velocity: Array  # (3, L, B) m/s, of the foot point itself
    lever: Array  # (3, L, B) m, from the base's centre of mass to the foot
    jacobian: tuple[Array, ...]  # per joint of a limb (3, L, B) m: foot velocity per joint rate


def limb_frames(robot: Robot, base_rotation: Array | None, joint_angles: Array) -> LimbFrames:
    """Return the link frames for a base rotation (3, 3, B), or None: in the base's own axes, and joint angles.

    Joint angles are (N, L, B) rad, or m of sliding joints.
    """
    rotation = None if base_rotation is None else base_rotation[:, :, None, :]
    position = jnp.zeros((3, *joint_angles.shape[1:]), joint_angles.dtype)
    rotations, positions = [], []
    for link in range(robot.joints):
        offset = robot.frame_position[link]
        position = position + (offset if rotation is None else rotate(rotation, offset))
        turned_frame = robot.frame_rotation[link]
        zero_rotation = jnp.asarray(turned_frame) if rotation is None else compose(rotation, turned_frame)
        slides, angles = robot.sliding(link), joint_angles
        if slides is not None:
            position = position + zero_rotation[:, 2] * chosen(slides, joint_angles[link], jnp.zeros_like(position[0]))
            angles = chosen(slides, jnp.zeros_like(joint_angles), joint_angles)
        if slides is not None and slides.all():
            rotation = jnp.broadcast_to(zero_rotation, (3, *position.shape))
        else:
            c, s = jnp.cos(angles[link]), jnp.sin(angles[link])
            x, y, z = zero_rotation[:, 0], zero_rotation[:, 1], zero_rotation[:, 2]
            turned = c * x + s * y
            rotation = jnp.stack([turned, c * y - s * x, jnp.broadcast_to(z, turned.shape)], axis=1)
        rotations.append(rotation)
        positions.append(position)
    return LimbFrames(tuple(rotations), tuple(positions), position + rotate(rotations[-1], robot.foot_center))


def foot_kinematics(robot: Robot, frames: LimbFrames, state: State) -> Feet:
    """Return positions, velocities and Jacobians of the feet for a state in the layout of the hot path."""
    jacobian = tuple(
        foot_velocity_per_rate(robot, link, rotation[:, 2], frames.foot - position)
        for link, (rotation, position) in enumerate(zip(frames.rotation, frames.position, strict=True))
    )
    velocity = state.base_linear_velocity[:, None] + cross(state.base_angular_velocity[:, None], frames.foot)
    for column, rate in zip(jacobian, state.joint_rates, strict=True):
        velocity = velocity + column * rate
    return Feet(state.base_position[:, None] + frames.foot, velocity, frames.foot, jacobian)


class Turning(NamedTuple):
    """How the links that end in feet are turned, and turn."""

    rotation: Array  # (3, 3, L, B), world
    velocity: Array  # (3, L, B) rad/s, world axes
    axes: tuple[Array, ...]  # per joint of a limb (3, L, B): angular velocity per joint rate


def foot_turning(robot: Robot, frames: LimbFrames, state: State) -> Turning:
    """Return the attitudes of the last links and how they change, for a state in the layout of the hot path."""
    axes = tuple(turning_per_rate(robot, link, rotation[:, 2]) for link, rotation in enumerate(frames.rotation))
    velocity = jnp.broadcast_to(state.base_angular_velocity[:, None], frames.foot.shape)
    for axis, rate in zip(axes, state.joint_rates, strict=True):
        velocity = velocity + axis * rate
    return Turning(frames.rotation[-1], velocity, axes)


def turning_per_rate(robot: Robot, link: int, axis: Array) -> Array:
    """Return the angular velocity (3, L, B) of the links beyond a joint with `axis` per rate of it."""
    slides = robot.sliding(link)
    return axis if slides is None else chosen(slides, jnp.zeros_like(axis), axis)


def turn_between(one: Array, other: Array) -> Array:
    """Return the axis of the turn from an attitude (3, 3, L, B) to another, times the sine of its angle (3, L, B)."""
    return 0.5 * (cross(one[:, 0], other[:, 0]) + cross(one[:, 1], other[:, 1]) + cross(one[:, 2], other[:, 2]))


def foot_velocity_per_rate(robot: Robot, link: int, axis: Array, lever: Array) -> Array:
    """Return the velocity (3, L, B) of the foot per rate of a joint with `axis`, from which it is `lever` m away."""
    turning, slides = cross(axis, lever), robot.sliding(link)
    return turning if slides is None else chosen(slides, axis, turning)


def center_of_mass(robot: Robot, frames: LimbFrames, base_position: Array, cargo_mass: Array) -> Array:
    """Return the centre of mass (3, B) m, world, of the robot with `cargo_mass` (B,) kg at the base's own."""
    moment: Array = sum(
        mass * (position + rotate(rotation, center))
        for mass, center, position, rotation in zip(
            robot.link_mass, robot.link_center, frames.position, frames.rotation, strict=True
        )
    )
    return base_position + moment.sum(1) * (1 / (cargo_mass + robot.total_mass))


def joint_torque_of_foot_force(feet: Feet, foot_force: Array) -> Array:
    """Return `J_m^T F_e`, the joint torques (N, L, B) N m that foot forces (3, L, B) N amount to."""
    return jnp.stack([dot(column, foot_force) for column in feet.jacobian])


def base_wrench_of_foot_force(lever: Array, foot_force: Array) -> Array:
    """Return `J_b^T F_e` (6, B): sum of the foot forces, N, and of their moments about the base, N m."""
    return jnp.concatenate([foot_force.sum(1), cross(lever, foot_force).sum(1)])
