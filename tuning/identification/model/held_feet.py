"""A robot whose grippers are all shut, its base free: it sways by its servos, and no gripper opens or is torn off.

A step is that of `tuning.identification.model.held_base`: velocities, the base's too, stand half a step before
positions (leapfrog), and the loads of a step take them half a step on. Motion and forces are right to second order in
the step.

A grip's damping takes the foot's velocity half a step on by `AHEAD` of the change in this step, and the rest of the
change in the step before: at a frequency w the former is too small by (w h)^2 / 8, the latter too large by 3 (w h)^2 /
8, and together they are right to third order. The change in this step, Jacobian times accelerations, is felt as a point
mass at the foot would be, less its weight and its inertia at constant rates.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from mjx_climb.hardware.sensors import ForceSensor, measured_force
from mjx_climb.hardware.stages import Hardware
from mjx_climb.physics.contact.contact import Contact, Grip
from mjx_climb.physics.contact.gripper import GripperMemory, SpringGrip
from mjx_climb.physics.kinematics import LimbFrames, Turning, foot_jacobian, foot_kinematics, foot_turning, limb_frames
from mjx_climb.physics.limb_engine import build
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.physics.state import Acceleration, Loads, State
from mjx_climb.robot.constants import Robot
from tuning.identification.model import held_base as stands
from tuning.identification.model.foot_mass import with_foot_mass

AHEAD = 0.75  # of the change of a foot's velocity that its damping takes from this step


class Gripped(NamedTuple):
    """Constants of all steps."""

    robot: Robot
    hardware: Hardware
    contact: PyTree  # memory of the contacts, all grippers shut
    ground: Array  # (limb,) m, height of the ground below each foot


class Moving(NamedTuple):
    """The state between two steps."""

    limbs: stands.Moving
    base_change: Array  # (6,) m/s, rad/s, of the base's velocities in the step before
    filtered: Array  # (limb, 3) N, memory of the force sensors' filters


class Recorded(NamedTuple):
    """The records at the beginning of a step."""

    position: Array  # (limb, joint) rad
    velocity: Array  # (limb, joint) rad/s
    effort: Array  # (limb, joint) N m, of the motors
    force: Array  # (limb, 3) N, as the sensors read that of the ground on the feet, world axes; not late
    base_position: Array  # (3,) m, of its centre of mass, world
    base_orientation: Array  # (4,) wxyz
    base_linear_velocity: Array  # (3,) m/s, world
    base_angular_velocity: Array  # (3,) rad/s, world


def gripped(robot: Robot, hardware: Hardware, state: State, points: Array | None = None) -> Gripped:
    """Return a robot that gripped in a state, at points (limb, 3) m; None: where its feet are."""
    frames = limb_frames(robot, None, state.joint_angles)
    points = foot_kinematics(robot, frames, state).position if points is None else points
    shut, contact = jnp.ones(len(robot.limbs), bool), _unbreakable(hardware)
    memory = contact.init(points, foot_turning(robot, frames, state).rotation)
    if isinstance(memory, GripperMemory) and memory.attitude is not None:
        memory = memory._replace(attitude=memory.attitude._replace(held=shut))
    return Gripped(robot, hardware, memory, points[:, 2])


def _unbreakable(hardware: Hardware) -> Contact:
    """Return contacts that no force tears off, and that reach the ground wherever they shut."""
    contact: Contact = hardware.parameters.contact.unbreakable()
    return (
        dataclasses.replace(contact, limited_reach=False, closes=False) if isinstance(contact, SpringGrip) else contact
    )


def begin(hardware: Hardware, state: State) -> Moving:
    """Return a robot whose servos and sensors begin in a state."""
    none = jnp.zeros_like(state.joint_rates)
    limbs = stands.Moving(state, stands.begun(hardware, state.joint_angles), none)
    return Moving(limbs, jnp.zeros_like(none, shape=6), jnp.zeros_like(none, shape=(len(none), 3)))


def advance(gripped: Gripped, moving: Moving, targets: Array) -> tuple[Moving, Recorded]:
    """The robot one time step later, and its records; joint targets are (limb, joint) rad.

    The targets are those that reach the servos, see `stand.targets_of`: a delay of commands is the caller's.
    """
    robot, hardware, state = gripped.robot, gripped.hardware, moving.limbs.state
    parameters, share = hardware.parameters, 1 / hardware.parameters.mass_scale
    changes = moving.base_change, moving.limbs.change
    frames = limb_frames(robot, None, state.joint_angles)
    centred = _changed(state, changes, 0.5)
    turning = foot_turning(robot, frames, centred) if parameters.contact.transmits_moments else None
    foot_force, held = _held(gripped, frames, _changed(state, changes, (1 - AHEAD) / 2), turning)
    gravity = jnp.asarray(parameters.gravity)
    mass = AHEAD * parameters.contact.springs().damping * (hardware.time_step / 2)
    moments = jnp.zeros_like(targets) if turning is None else jnp.vecmat(held.foot_moment, turning.jacobian)
    none = jnp.zeros_like(moving.base_change)
    wrench = none.at[3:].set(held.foot_moment.sum(0))
    loads = Loads(moments * share, foot_force * share, wrench * share, none[0], gravity)
    driving = loads._replace(
        foot_force=(foot_force + mass * (_turning_round(robot, frames, centred) - gravity)) * share
    )

    def accelerate(robot: Robot, state: State, torque: Array) -> Acceleration:
        now = dataclasses.replace(centred, joint_rates=state.joint_rates)
        damped = with_foot_mass(robot, jnp.asarray(mass * share))
        return build(damped)(now, *driving._replace(joint_torque=loads.joint_torque + torque))

    stand = stands.Stand(robot, hardware)
    later, seen = stands.advance_by(accelerate, loads, stand, moving.limbs, targets)
    change = _base_rates(later.state) - _base_rates(state)
    acted = _changed(_changed(state, changes, (1 - AHEAD) / 2), (change, later.change), AHEAD / 2)
    force, _ = _held(gripped, frames, acted, turning)
    sensor, read = measured_force(ForceSensor((), moving.filtered), force, jnp.zeros((), int), hardware)
    filtered = moving.filtered if sensor.filtered is None else sensor.filtered
    recorded = Recorded(
        *seen, read, state.base_position, state.base_orientation, centred.base_linear_velocity,
        centred.base_angular_velocity,
    )  # fmt: skip
    return Moving(later, change, filtered), recorded


def _base_rates(state: State) -> Array:
    return jnp.concatenate([state.base_linear_velocity, state.base_angular_velocity])


def _changed(state: State, changes: tuple[Array, Array], share: float) -> State:
    """Return a state whose velocities have changed by a share of those of the base (6,) and of the joints."""
    base = _base_rates(state) + share * changes[0]
    return dataclasses.replace(
        state, base_linear_velocity=base[:3], base_angular_velocity=base[3:],
        joint_rates=state.joint_rates + share * changes[1],
    )  # fmt: skip


def _turning_round(robot: Robot, frames: LimbFrames, state: State) -> Array:
    """Return the feet's accelerations (limb, 3) m/s^2, world axes, while base and joints keep their rates."""
    rotation, spin = quaternion_to_matrix(state.base_orientation), state.base_angular_velocity

    def speed(angles: Array) -> Array:
        return jnp.matvec(foot_jacobian(robot, limb_frames(robot, None, angles)), state.joint_rates)

    own, change = jax.jvp(speed, (state.joint_angles,), (state.joint_rates,))
    around = jnp.cross(spin, frames.foot @ rotation.T) + 2 * own @ rotation.T
    return jnp.asarray(jnp.cross(spin, around) + change @ rotation.T)


def _held(gripped: Gripped, frames: LimbFrames, state: State, turning: Turning | None) -> tuple[Array, Grip]:
    """Return the forces of the grips (limb, 3) N in a state, and all that they do."""
    feet, shut = foot_kinematics(gripped.robot, frames, state), jnp.ones(len(gripped.robot.limbs), bool)
    _, held = _unbreakable(gripped.hardware).step(gripped.contact, feet, turning, shut, gripped.ground)
    return held.foot_force, held
