"""A robot on a stand: its base is held, its limbs move in the air by their servos, each limb a robot of its own.

A step evaluates torques at the beginning and takes what damps them, the servo's kd and the viscous friction, at the
mean of the rates before and after: rates stand half a step before angles, as in leapfrog, so that angles, and rates as
`Recorded` has them, are right to second order in the time step. Dry friction and centrifugal forces take the rates half
a step on. A walk's own step is right to first order.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from mjx_climb.dynamics.inverse_dynamics import load_torque
from mjx_climb.dynamics.limb_engine import held_accelerations
from mjx_climb.dynamics.state import Acceleration, Loads, State, integrate
from mjx_climb.hardware import servo
from mjx_climb.hardware.stages import Hardware
from mjx_climb.robot.constants import Robot
from mjx_climb.walk.step import driven_robot


class Stand(NamedTuple):
    """What stays the same from step to step."""

    robot: Robot
    hardware: Hardware


class Moving(NamedTuple):
    """What goes from one step to the next."""

    state: State
    servo: servo.Servo
    change: Array  # (limb, joint) rad/s, of the rates in the step before


class Sent(NamedTuple):
    """What reaches the servos in a step, or its rate over time."""

    targets: Any  # (limb, joint) rad
    share: Any = ()  # () 1, of the P gain, 0 with the torque off; (): the P gain is the parameters'
    on: Any = ()  # () 1, of the step: the torque is on


class Recorded(NamedTuple):
    """What is there to record at the beginning of a step."""

    position: Array  # (limb, joint) rad
    velocity: Array  # (limb, joint) rad/s
    effort: Array  # (limb, joint) N m, of the motors


def begin(stand: Stand, angles: Array, rates: Array) -> Moving:
    """Return a robot in its rest stance but for its joints, at angles (limb, joint) rad and rates rad/s."""
    robot = stand.robot
    still = jnp.zeros_like(angles, shape=3)
    position, orientation = (jnp.asarray(v, angles.dtype) for v in (robot.stance_position, robot.stance_orientation))
    state = State(position, orientation, still, still, angles, rates)
    return Moving(state, servo.begin(angles, stand.hardware.stages), jnp.zeros_like(rates))


def advance(stand: Stand, moving: Moving, targets: Array) -> tuple[Moving, Recorded]:
    """Return the robot one time step later, and what is recorded of it; joint targets are (limb, joint) rad.

    The targets are those that reach the servos, see `targets_of`: a delay of commands is the caller's.
    """
    gravity = jnp.asarray(stand.hardware.parameters.gravity)
    still = jnp.zeros_like(moving.state.base_position)

    def accelerate(robot: Robot, state: State, torque: Array) -> Acceleration:
        return Acceleration(still, still, held_accelerations(robot, state, torque, gravity))

    no_forces = jnp.zeros_like(targets, shape=(len(targets), 3))
    loads = Loads(
        jnp.zeros_like(targets), no_forces, jnp.zeros_like(still, shape=6), jnp.zeros_like(still, shape=()), gravity
    )
    return advance_by(accelerate, loads, stand, moving, targets)


def advance_by(
    accelerate: Callable[[Robot, State, Array], Acceleration], loads: Loads, stand: Stand, moving: Moving,
    targets: Array,
) -> tuple[Moving, Recorded]:  # fmt: skip
    """Return what `advance` does for other dynamics, given a robot, its state and the torques on its joints.

    The state's joint rates are those of the step's beginning. `loads` are all but the servos', for their gears.
    """
    hardware, state, before = stand.hardware, moving.state, moving.servo
    parameters, step, gains = hardware.parameters, hardware.time_step, servo.gains_of(hardware)
    if hardware.stages.load_torque:
        before = before._replace(load=parameters.mass_scale * load_torque(stand.robot, state, loads))

    def driven(rates: Array) -> tuple[Array, tuple[servo.Servo, servo.Drive]]:
        now = dataclasses.replace(state, joint_rates=rates)
        after, drive = servo.joint_loop(before, targets, now, gains, hardware)
        return drive.motor_torque, (after, drive)

    rates, ahead = state.joint_rates, moving.change / 2
    centred = rates + ahead  # at the beginning of the step, where the angles are, as far as it goes on as before
    _, slope, (after, drive) = jax.jvp(driven, (centred,), (jnp.ones_like(rates),), has_aux=True)
    damping = -slope + parameters.viscous_friction if hardware.stages.viscous_friction else -slope
    own = 0.0 if isinstance(drive.armature, tuple) else drive.armature
    drive = drive._replace(armature=own + damping * (step / 2))
    robot, torque = driven_robot(stand.robot, drive, state.joint_angles, hardware)
    torque = (torque + damping * ahead) / parameters.mass_scale
    later = integrate(state, accelerate(robot, dataclasses.replace(state, joint_rates=centred), torque), step)
    change = later.joint_rates - rates
    seen = Recorded(state.joint_angles, rates + change / 2, drive.motor_torque + slope * (change / 2 - ahead))
    return Moving(later, after, change), seen


def with_gains(stand: Stand, sent: Sent) -> Stand:
    """Return a stand whose servos have the P gain that was sent, and give torque where it is on.

    With the torque off motors give nothing, nor do they brake; friction and armature stay.
    """
    if isinstance(sent.on, tuple):
        return stand
    stages, own = stand.hardware.stages, stand.hardware.parameters
    gains = {"kp": own.kp * sent.share, "kd": own.kd * sent.on, "ki": own.ki * sent.on}
    if stages.torque_limit:
        gains["torque_limit"] = own.torque_limit * sent.on
    changed: Any = {name: jnp.asarray(value) for name, value in gains.items()}
    parameters = dataclasses.replace(own, **changed)
    return stand._replace(hardware=dataclasses.replace(stand.hardware, parameters=parameters))


def targets_of(
    time: Float[np.ndarray, " samples"], command: Float[np.ndarray, " samples"], at: np.ndarray, time_step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint targets of steps that begin at times `at` (...) s, and their rates of change over time, rad/s.

    Each command is held until the next one. A step stands for the time from half a step before its beginning to half a
    step after: its target is the mean of the command there, so that a delay is a real number and has a derivative.
    Before the first command that one holds.
    """
    total = np.concatenate([[0.0], np.cumsum(command[:-1] * np.diff(time))])  # integral of the command
    ends = []
    for moment in (at - time_step / 2, at + time_step / 2):
        held = np.clip(np.searchsorted(time, moment, side="right") - 1, 0, len(time) - 1)
        ends.append((total[held] + command[held] * (moment - time[held]), command[held]))
    (before, first), (after, last) = ends
    return (after - before) / time_step, (last - first) / time_step
