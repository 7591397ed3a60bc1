"""A robot on a stand: its base is held, its limbs move in the air by their servos, each limb a robot of its own.

A step evaluates torques at the beginning and takes the damping, the servo's kd and the viscous friction, at the
mean of the rates before and after: rates stand half a step before angles, as in leapfrog, so that angles, and rates as
`Recorded` has them, are right to second order in the time step. Centrifugal forces take the rates half a step on. A
walk's own step is right to first order.

Dry friction is the bristle of `mjx_climb.hardware.servo`; the acceleration of the step decides whether it slips. It may
come `lead` s before the rate: it then bears against `rate + lead acceleration`, as MuJoCo's friction loss does, a
constraint that asks for the acceleration `-rate / lead` and pushes where the joint brakes harder. There
`lead = timeconst dmax / 2` of `solref` and `solimp`, 9.5 ms by default.

References:
    MuJoCo documentation, Computation (constraint model, friction loss) and Modeling (solver parameters).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from mjx_climb.arrays import AnyArray
from mjx_climb.hardware import servo
from mjx_climb.hardware.actuator import Drive, Joints
from mjx_climb.hardware.stages import Hardware
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.inverse_dynamics import load_torque
from mjx_climb.physics.state import Acceleration, Loads, State, integrate
from mjx_climb.robot.constants import Robot
from mjx_climb.walk import answers
from mjx_climb.walk.step import driven_robot
from tuning.identification.model.held_dynamics import held_accelerations, held_mobility
from tuning.identification.readers.log import COMMANDS

_SWEEPS = 4  # of Gauss-Seidel, over the joints of a limb


class Stand(NamedTuple):
    """Constants of all steps."""

    robot: Robot
    hardware: Hardware
    lead: Any = 0.0  # () s, by which dry friction comes before the rate
    commanded: str = COMMANDS[0]  # kind of the commands, of COMMANDS


class Moving(NamedTuple):
    """The state between two steps."""

    state: State
    servo: Any  # `mjx_climb.hardware.servo.Servo`, or the memory of another drive
    change: Array  # (limb, joint) rad/s, of the rates in the step before


class Sent(NamedTuple):
    """The commands that reach the servos in a step, or their rates over time."""

    targets: AnyArray  # (limb, joint) rad; of other commands rad/s, N m, or the share of the supply voltage
    share: AnyArray | None = None  # () 1, of the P gain, 0 with the torque off; None: the P gain is the parameters'
    on: AnyArray | None = None  # () 1, of the step: the torque is on


class Recorded(NamedTuple):
    """The records at the beginning of a step."""

    position: Array  # (limb, joint) rad
    velocity: Array  # (limb, joint) rad/s
    effort: Array  # (limb, joint) N m, of the motors


def begin(stand: Stand, angles: Array, rates: Array) -> Moving:
    """Return a robot in its rest stance but for its joints, at angles (limb, joint) rad and rates rad/s."""
    robot = stand.robot
    still = jnp.zeros_like(angles, shape=3)
    position, orientation = (jnp.asarray(v, angles.dtype) for v in (robot.stance_position, robot.stance_orientation))
    state = State(position, orientation, still, still, angles, rates)
    return Moving(state, begun(stand.hardware, angles), jnp.zeros_like(rates))


def begun(hardware: Hardware, angles: Array) -> Any:
    """Return the memory of servos, or of another drive, that have rested at joint angles (limb, joint) rad."""
    drive = hardware.parameters.drive
    return servo.begin(angles, hardware.stages) if isinstance(drive, servo.Servos) else drive.init(angles)


def advance(stand: Stand, moving: Moving, targets: Array) -> tuple[Moving, Recorded]:
    """The robot one time step later, and its records; joint targets are (limb, joint) rad.

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
    """Return `advance` for other dynamics, given a robot, its state and the torques on its joints.

    The state's joint rates are those of the step's beginning. `loads` are all but the servos', for their gears.
    """
    hardware, state, before = stand.hardware, moving.state, moving.servo
    parameters, step, gains = hardware.parameters, hardware.time_step, servo.gains_of(hardware)
    smooth = dataclasses.replace(hardware, stages=hardware.stages._replace(dry_friction=False))
    if hardware.stages.load_torque:
        before = before._replace(load=jnp.asarray(parameters.mass_scale * load_torque(stand.robot, state, loads)))

    def driven(rates: Array) -> tuple[Array, tuple[Any, Drive]]:
        joints = Joints(state.joint_angles, rates, None)
        if stand.commanded != COMMANDS[0]:
            asked = _asked(stand.commanded, targets, rates, parameters)
            after, drive = servo.driven(before, asked, rates, smooth)
        elif isinstance(parameters.drive, servo.Servos):
            after, drive = servo.joint_loop(before, targets, joints, gains, smooth)
        else:
            after, drive = answers.driven(parameters.drive, before, targets, gains, joints, step)
        return drive.motor_torque, (after, drive)

    rates, ahead = state.joint_rates, moving.change / 2
    centred = rates + ahead  # at the beginning of the step, where the angles are, as far as it goes on as before
    _, slope, (after, drive) = jax.jvp(driven, (centred,), (jnp.ones_like(rates),), has_aux=True)
    damping = -slope + parameters.drive.viscous_friction if hardware.stages.viscous_friction else -slope
    ahead_of_it = damping * (step / 2)
    drive = drive._replace(armature=ahead_of_it if drive.armature is None else drive.armature + ahead_of_it)
    robot, torque = driven_robot(stand.robot, drive, state.joint_angles, parameters.mass_scale)
    torque = (torque + damping * ahead) / parameters.mass_scale
    state_now = dataclasses.replace(state, joint_rates=centred)
    if hardware.stages.dry_friction:
        most = servo.friction_bound(drive.motor_torque, before.load, centred, hardware)
        bristle = jnp.clip(before.bristle + rates * (step / parameters.drive.presliding), -1.0, 1.0)
        after = after._replace(bristle=bristle)
        free = accelerate(robot, state_now, torque).joints
        robot, torque = _rubbed(stand, robot, moving, _Rubbing(state_now, torque, free, bristle, most))
    later = integrate(state, accelerate(robot, state_now, torque), step)
    change = later.joint_rates - rates
    seen = Recorded(state.joint_angles, rates + change / 2, drive.motor_torque + slope * (change / 2 - ahead))
    return Moving(later, after, change), seen


def with_gains(stand: Stand, sent: Sent) -> Stand:
    """Return a stand whose servos have the P gain that was sent, and give torque where it is on.

    With the torque off motors give nothing, nor do they brake; friction and armature stay.
    """
    if sent.on is None or sent.share is None:
        return stand
    stages, own = stand.hardware.stages, stand.hardware.parameters
    by = {"control.kp": sent.share, "control.kd": sent.on, "control.ki": sent.on}
    by |= {"hardware.servo.torque_limit": sent.on} if stages.torque_limit else {}
    parameters = own.replace({path: jnp.asarray(own.at(path) * share) for path, share in by.items()})
    return stand._replace(hardware=dataclasses.replace(stand.hardware, parameters=parameters))


def _asked(commanded: str, sent: Array, rates: Array, parameters: Parameters) -> Array:
    """The torque that motors are asked for, (limb, joint) N m, by commands of velocities, torques or PWM."""
    if commanded == "velocity_command":
        return jnp.asarray(parameters.joint_loop.kd * (sent - rates))
    return jnp.asarray(sent * parameters.drive.torque_limit) if commanded == "pwm_command" else sent


class _Rubbing(NamedTuple):
    state: State
    torque: Array  # (limb, joint) N m, without dry friction
    free: Array  # (limb, joint) rad/s^2, without it
    bristle: Array
    most: Array  # (limb, joint) N m


def _rubbed(stand: Stand, robot: Robot, moving: Moving, on: _Rubbing) -> tuple[Robot, Array]:
    """Return the robot and the torque on its joints, less dry friction; its part per acceleration is armature.

    Sticking is decided with the limbs' mobility while the base is held.
    """
    parameters, step = stand.hardware.parameters, stand.hardware.time_step
    passed = jnp.abs(moving.change) / 2  # a friction that turns round within the step: its mean over the step
    per_rate = 1 / (jnp.asarray(parameters.drive.presliding) / servo.RELAXATION + passed)
    share, per_change = on.bristle + per_rate * moving.state.joint_rates, per_rate * (step / 2 + stand.lead)
    most = on.most / parameters.mass_scale
    reached = _reached(*jax.lax.stop_gradient((held_mobility(robot, on.state), on.free, most, share, per_change)))
    sticks = jnp.abs(reached) < 1
    armature: Any = jnp.asarray(robot.armature) + jnp.where(sticks, most * per_change, 0.0)
    torque = on.torque - most * jnp.where(sticks, share, jnp.sign(reached))
    return dataclasses.replace(robot, armature=armature), torque


def _reached(mobility: Array, free: Array, most: Array, share: Array, per_change: Array) -> Array:
    """Return the friction torques (limb, joint) within their limits, by Gauss-Seidel."""
    most = jnp.broadcast_to(most, free.shape)
    borne, reached = most * jnp.clip(share, -1.0, 1.0), share
    for _ in range(_SWEEPS):
        for n in range(free.shape[1]):
            others = free[:, n] - (mobility[:, n] * borne.at[:, n].set(0.0)).sum(-1)
            found = (share + per_change * others[:, None])[:, n]
            found = found / (1 + most[:, n] * per_change[:, n] * mobility[:, n, n])
            borne, reached = borne.at[:, n].set(most[:, n] * jnp.clip(found, -1.0, 1.0)), reached.at[:, n].set(found)
    return reached


def targets_of(
    time: Float[np.ndarray, " samples"], command: Float[np.ndarray, " samples"], at: np.ndarray, time_step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint targets of steps that begin at times `at` (...) s, and their rates of change over time, rad/s.

    Each command is held until the next one; before the first that one holds. A target is the mean of the command from a
    step before to a step after, weighed by a triangle: the kicks of the steps then move an inertia as the command that
    jumps between them does, and a delay is a real number and has a derivative.
    """
    first = np.clip(np.searchsorted(time, at - time_step, side="right") - 1, 0, len(time) - 1)
    targets, rates = command[first].astype(float), np.zeros(np.shape(at))
    for later in range(1, len(time)):
        jump = np.minimum(first + later, len(time) - 1)
        way = (at - time[jump]) / time_step
        inside = (first + later < len(time)) & (way > -1)
        if not inside.any():
            break
        by = np.where(inside, command[jump] - command[jump - 1], 0.0)
        targets += by * np.where(way < 0, (1 + way) ** 2 / 2, 1 - (1 - way) ** 2 / 2)
        rates += by * (1 - np.abs(way)) / time_step
    return targets, rates
