"""A robot whose grippers are all shut, its base free: it sways by its servos, and no gripper opens or is torn off.

A step is that of `mjx_climb.walk.stand`: velocities, the base's too, stand half a step before positions, and what acts
at the beginning of a step takes them half a step on, as far as they go on as before. So motion and forces are right to
second order in the time step, the damping of the grips among them.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.dynamics.kinematics import foot_kinematics, foot_turning, limb_frames
from mjx_climb.dynamics.limb_engine import build
from mjx_climb.dynamics.state import Acceleration, Loads, State
from mjx_climb.hardware import servo
from mjx_climb.hardware.sensors import ForceSensor, measured_force
from mjx_climb.hardware.stages import Hardware
from mjx_climb.robot.constants import Robot
from mjx_climb.walk import stand as stands
from mjx_climb.walk.contact import Attitude, Contact, grip


class Gripped(NamedTuple):
    """What stays the same from step to step."""

    robot: Robot
    hardware: Hardware
    contact: Contact  # all grippers shut


class Moving(NamedTuple):
    """What goes from one step to the next."""

    limbs: stands.Moving
    base_change: Array  # (6,) m/s, rad/s, of the base's velocities in the step before
    filtered: Array  # (limb, 3) N, what the force sensors' filters hold


class Recorded(NamedTuple):
    """What is there to record at the beginning of a step."""

    position: Array  # (limb, joint) rad
    velocity: Array  # (limb, joint) rad/s
    effort: Array  # (limb, joint) N m, of the motors
    force: Array  # (limb, 3) N, as the sensors read that of the ground on the feet, world axes; not late
    base_position: Array  # (3,) m, of its centre of mass, world
    base_orientation: Array  # (4,) wxyz
    base_linear_velocity: Array  # (3,) m/s, world
    base_angular_velocity: Array  # (3,) rad/s, world


def grips(robot: Robot, state: State, hardware: Hardware, points: Array | None = None) -> Contact:
    """Return contacts of a robot that gripped in a state, at points (limb, 3) m; None: where its feet are."""
    frames = limb_frames(robot, None, state.joint_angles)
    points = foot_kinematics(robot, frames, state).position if points is None else points
    shut = jnp.ones(len(robot.limbs), bool)
    attitude: Attitude | tuple[()] = ()
    if hardware.stages.rotational:
        attitude = Attitude(foot_turning(robot, frames, state).rotation, shut)
    return Contact(points, shut, ~shut, (), attitude)


def begin(hardware: Hardware, state: State) -> Moving:
    """Return a robot whose servos and sensors begin in a state."""
    none = jnp.zeros_like(state.joint_rates)
    limbs = stands.Moving(state, servo.begin(state.joint_angles, hardware.stages), none)
    return Moving(limbs, jnp.zeros_like(none, shape=6), jnp.zeros_like(none, shape=(len(none), 3)))


def advance(gripped: Gripped, moving: Moving, targets: Array) -> tuple[Moving, Recorded]:
    """Return the robot one time step later, and what is recorded of it; joint targets are (limb, joint) rad.

    The targets are those that reach the servos, see `stand.targets_of`: a delay of commands is the caller's.
    """
    robot, hardware, state = gripped.robot, gripped.hardware, moving.limbs.state
    parameters = hardware.parameters
    before = jnp.concatenate([state.base_linear_velocity, state.base_angular_velocity])
    ahead = before + moving.base_change / 2
    centred = dataclasses.replace(
        state, base_linear_velocity=ahead[:3], base_angular_velocity=ahead[3:],
        joint_rates=state.joint_rates + moving.limbs.change / 2,
    )  # fmt: skip
    frames = limb_frames(robot, None, state.joint_angles)
    feet, turning = foot_kinematics(robot, frames, centred), None
    moments = jnp.zeros_like(targets)
    if hardware.stages.rotational:
        turning = foot_turning(robot, frames, centred)
    shut = jnp.ones(len(robot.limbs), bool)
    _, held = grip(gripped.contact, feet, shut, gripped.contact.grip_point[:, 2], parameters, turning)
    if turning is not None:
        moments = jnp.vecmat(held.foot_moment, turning.jacobian)
    share, none = 1 / parameters.mass_scale, jnp.zeros_like(ahead)
    wrench = none.at[3:].set(held.foot_moment.sum(0))
    loads = Loads(moments * share, held.foot_force * share, wrench * share, none[0], jnp.asarray(parameters.gravity))

    def accelerate(robot: Robot, state: State, torque: Array) -> Acceleration:
        now = dataclasses.replace(centred, joint_rates=state.joint_rates)
        return build(robot)(now, *loads._replace(joint_torque=loads.joint_torque + torque))

    stand = stands.Stand(robot, hardware)
    later, seen = stands.advance_by(accelerate, loads, stand, moving.limbs, targets)
    after = jnp.concatenate([later.state.base_linear_velocity, later.state.base_angular_velocity])
    sensor, read = measured_force(ForceSensor((), moving.filtered), held.foot_force, jnp.zeros((), int), hardware)
    filtered = moving.filtered if isinstance(sensor.filtered, tuple) else sensor.filtered
    recorded = Recorded(
        *seen, read, state.base_position, state.base_orientation, centred.base_linear_velocity,
        centred.base_angular_velocity,
    )  # fmt: skip
    return Moving(later, after - before, filtered), recorded
