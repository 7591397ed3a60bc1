"""One pass of the robot's own loop: sensors, law, inverse kinematics, bus, joint loop, servos."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree, Real
from numpy.typing import DTypeLike

from mjx_climb.control import Command, JointGains, Law, Measurement, Reference, Start, sensor_watch, shifted
from mjx_climb.control.law import beginning
from mjx_climb.hardware import bus as signals
from mjx_climb.hardware import sensors, servo
from mjx_climb.hardware.actuator import Actuator, ActuatorGains, Drive, Joints
from mjx_climb.hardware.stages import Hardware
from mjx_climb.physics.contact.contact import Grip
from mjx_climb.physics.inverse_kinematics import Chain, JointSolution, LimbGeometry, inverse_kinematics
from mjx_climb.physics.kinematics import Feet, Turning, base_wrench_of_foot_force, foot_jacobian, limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.physics.state import State
from mjx_climb.robot.constants import Robot
from mjx_climb.shapes import check_shape, dims_of
from mjx_climb.walk.answers import driven


class JointTargets(NamedTuple):
    """An action: where the joint loop should take the joints; no inverse kinematics, no law."""

    angles: Real[Array | np.ndarray, "... limbs joints"]  # rad


class BaseShift(NamedTuple):
    """An action: how far the base should be from its reference, along the reference's axes; the feet as planned."""

    displacement: Real[Array | np.ndarray, "... 6"]  # m, rad: a translation and a rotation vector


Action = JointTargets | BaseShift | None  # None: the law's command


def checked_action(action: Action, robot: Robot, dtype: DTypeLike, batch: tuple[int, ...] = ()) -> Action:
    """Return an action as arrays of a precision.

    Raises:
        ValueError: in one line, another action, or another shape than that of one robot or of a batch of them.
    """
    if action is None:
        return None
    if not isinstance(action, JointTargets | BaseShift):
        raise ValueError(f"action: expected JointTargets, BaseShift or None, got {type(action).__name__}")
    kind, sizes = type(action), {"limbs": len(robot.limbs), "joints": robot.joints}
    [(name, value)] = action._asdict().items()
    check_shape(f"{kind.__name__}.{name}", np.shape(value), dims_of(kind.__annotations__[name]), sizes, batch)
    return kind(jnp.asarray(value, np.dtype(dtype)))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Controller:
    """Constants of the control loop."""

    law: Law
    geometry: LimbGeometry | Chain
    hardware: Hardware
    actuator: Actuator


class LastCommand(NamedTuple):
    """The command of the law's last evaluation, and the joint targets of the one before."""

    command: Command
    joints: JointSolution
    before: Array | None  # (limb, joint) rad; None: targets are held


class Reports(NamedTuple):
    """Records that the servos send back over the bus."""

    buffers: tuple[signals.Buffer, ...]  # of angles, rates, torques and levers
    torque: Array  # (limb, joint) N m, of the motors in the step before


class Memory(NamedTuple):
    """State from one pass to the next; empty, or None, where a walk has no such stage of hardware."""

    law: PyTree  # its state
    force_sensor: sensors.ForceSensor
    sensor_watch: sensor_watch.SensorWatch | None  # None: the law reads no forces, or no sensor is ever silent
    filtered: tuple[Array, Array] | None  # foot forces (limb, 3) N and wrench (6,) N, N m that the law samples
    base_estimate: tuple[signals.Buffer, ...]  # one for each field of a `sensors.Base`
    held: LastCommand | None
    targets: signals.Buffer  # of joint targets (limb, joint) rad
    actuator: PyTree  # of the actuators
    posture: Array | None  # (limb, joint) rad, the joint angles last solved for; None: there is a closed form
    reports: Reports | None  # None: neither the law nor a sensor reads them
    joint_gains: tuple[signals.Buffer, ...]  # of the joint gains on their way


def foot_compliance(robot: Robot, joint_angles: Array, kp: Array) -> Array:
    """Return by how much feet give way to forces, (limb, 3, 3) m/N in the base's axes: `J kp^-1 J^T`.

    Joints that nothing drives give way by nothing.
    """
    jacobian, driven = foot_jacobian(robot, limb_frames(robot, None, joint_angles)), kp > 0
    soft = jnp.broadcast_to(jnp.where(driven, 1 / jnp.where(driven, kp, 1.0), 0.0), joint_angles.shape)
    return jnp.asarray((jacobian * soft[:, None]) @ jacobian.mT)


class Actual(NamedTuple):
    """The true state and contacts of a step, not as sensors measure them."""

    state: State
    feet: Feet
    turning: Turning | None  # of the feet, where grips transmit moments
    contact: PyTree  # memory of the contacts after the step
    grip: Grip
    wrench: Array  # (6,) N, N m, on the base, of all that the feet transmit
    felt: Array | None = None  # (limb, 3) N, by the joints' efforts; None: the forces have sensors of their own


def begin(controller: Controller, robot: Robot, state: State, reference: Reference) -> Memory:
    """Return the memory of a robot that has always rested in a state, with its feet where the reference has them.

    Raises:
        ValueError: the law's `step` does not keep the structure of its `init`.
    """
    hardware, angles, feet = controller.hardware, state.joint_angles, reference.foot_position
    stages, no_force, no_torque = hardware.stages, jnp.zeros_like(feet), jnp.zeros_like(angles)
    no_wrench = jnp.zeros_like(state.base_position, shape=6)
    weight = jnp.asarray(hardware.parameters.gravity) * robot.total_mass
    compliance = foot_compliance(robot, angles, servo.gains_of(hardware).kp)
    law = beginning(controller.law, Start(hardware.law_period, reference, angles, weight, compliance))
    watch = sensor_watch.begin(feet) if stages.silent_sensors and law.reads_forces else None
    held = None
    if stages.control_period:
        command = Command(state.base_position, state.base_orientation, feet, no_wrench, law.joint_gains)
        held = LastCommand(
            command, JointSolution(angles, jnp.ones(len(angles), bool)), angles if stages.linear else None
        )
    base = sensors.true_base(state) if stages.base_delay else ()
    lever = (feet - state.base_position) @ quaternion_to_matrix(state.base_orientation)
    reported = tuple((value,) * stages.command_delay for value in (angles, state.joint_rates, no_torque, lever))
    drift = no_force if stages.force_drift else None
    return Memory(
        law=law.state,
        force_sensor=sensors.ForceSensor(
            (no_force,) * stages.force_delay, no_force if stages.force_filter else None, drift
        ),
        sensor_watch=watch,
        filtered=(no_force, no_wrench) if stages.sampled_filter else None,
        base_estimate=tuple((value,) * stages.base_delay for value in base),
        held=held,
        targets=(angles,) * stages.command_delay,
        actuator=controller.actuator.init(angles),
        posture=angles if isinstance(controller.geometry, Chain) else None,
        reports=Reports(reported, no_torque) if law.reads_servos or stages.joint_effort else None,
        joint_gains=tuple((value,) * stages.command_delay for value in _sent(law.joint_gains, watch).values()),
    )


def control(
    controller: Controller,
    memory: Memory,
    actual: Actual,
    reference: Reference,
    step: Array,
    load: Array | None,
    action: Action = None,
) -> tuple[Memory, Command, JointSolution, Drive]:
    """Return the memory after a step, the command, the joint targets from it, and the actuators' torques.

    An action takes the place of the law, whose state then stays as it is; its way to the joints is the same. `step`
    counts steps, (). `load` is that on the joints, where the actuator asks for it.
    """
    hardware, state = controller.hardware, actual.state
    stages, pace = hardware.stages, hardware.pace
    into = signals.steps_into(step, pace.period) if pace.period is not None else jnp.zeros(())
    memory, measured = _measure(hardware, memory, actual, step, into)

    law_state, command = controller.law.step(memory.law, measured, reference)
    if action is not None:
        displacement = action.displacement if isinstance(action, BaseShift) else jnp.zeros_like(actual.wrench)
        own, law_state = jax.tree.map(jnp.ones_like, command.joint_gains), memory.law
        command = shifted(reference, jnp.asarray(displacement))._replace(joint_gains=own)
    joints, posture = _solve(controller.geometry, memory.posture, command, reference)
    if isinstance(action, JointTargets):
        joints = joints._replace(joint_angles=action.angles)

    held, targets = memory.held, memory.targets
    if held is not None and pace.period is not None:
        now, before, last = into == 0, held.before, held.joints.joint_angles
        law_state = signals.held(now, law_state, memory.law)
        before = None if before is None else signals.held(now, last, before)
        command, joints = signals.held(now, (command, joints), (held.command, held.joints))
        held = LastCommand(command, joints, before)
        # the next target is not known a period ahead: the line reaches this one in the last step
        if before is not None:
            end = joints.joint_angles
            joints = joints._replace(joint_angles=end - (end - before) * (1 - (into + 1) / pace.period))
    if stages.command_delay:
        targets, late = signals.delayed(targets, joints.joint_angles, pace.command)
        joints = joints._replace(joint_angles=late)

    sent = _sent(command.joint_gains, memory.sensor_watch)
    late_gains, gains = _joint_gains(hardware, memory.joint_gains, sent)
    actual_joints = Joints(state.joint_angles, state.joint_rates, load)
    actuators, drive = driven(
        controller.actuator, memory.actuator, joints.joint_angles, gains, actual_joints, hardware.time_step
    )
    reports = None if memory.reports is None else memory.reports._replace(torque=drive.motor_torque)
    memory = memory._replace(
        law=law_state, held=held, targets=targets, actuator=actuators, posture=posture, reports=reports
    )
    return memory._replace(joint_gains=late_gains), command, joints, drive


def _sent(factors: JointGains | None, watch: sensor_watch.SensorWatch | None) -> dict[str, Array]:
    """Return the changes of the joint loop's gains by name: factors of them, and kp's rising share."""
    return ({} if factors is None else factors.moved) | ({} if watch is None else {"kp_rise": watch.kp_rise})


def _joint_gains(
    hardware: Hardware, buffers: tuple[signals.Buffer, ...], sent: dict[str, Array]
) -> tuple[tuple[signals.Buffer, ...], ActuatorGains]:
    """Return the buffers of the changes on the bus, and the joint loop's gains in a step."""
    gains = servo.gains_of(hardware)
    if hardware.stages.command_delay and sent:  # by the bus that takes the joint targets
        both = [signals.delayed(*each, hardware.pace.command) for each in zip(buffers, sent.values(), strict=True)]
        buffers, late = zip(*both, strict=True)
        sent = dict(zip(sent, late, strict=True))
    factors = {name: each for name, each in sent.items() if name != "kp_rise"}
    gains = gains._replace(**{name: getattr(gains, name) * each[:, None] for name, each in factors.items()})
    if "kp_rise" in sent:
        safe = jnp.asarray(hardware.parameters.joint_loop.safe_kp)
        gains = gains._replace(kp=sensor_watch.raised_kp(gains.kp, safe, sent["kp_rise"]))
    return buffers, gains


def _measure(
    hardware: Hardware, memory: Memory, actual: Actual, step: Array, into: Array
) -> tuple[Memory, Measurement]:
    """The memory with that of the sensors, and their measurement."""
    stages, share = hardware.stages, hardware.pace.filter_share
    sensor, force, wrench = memory.force_sensor, actual.grip.foot_force, actual.wrench
    if stages.force:
        force = force if actual.felt is None else actual.felt
        sensor, force = sensors.measured_force(sensor, force, step, hardware)
    watch, known = memory.sensor_watch, jnp.asarray(True)
    if watch is not None:
        watch, force, known = sensor_watch.watched(watch, force, actual.grip.support, hardware.law_period)
        if stages.control_period:
            watch = signals.held(into == 0, watch, memory.sensor_watch)
    if stages.force:
        wrench = base_wrench_of_foot_force(actual.feet.lever, force, actual.grip.foot_moment)
        wrench = jnp.where(known, wrench, 0.0) if watch is not None else wrench
    filtered = memory.filtered
    if filtered is not None and share is not None:
        force, wrench = (y + share * (u - y) for y, u in zip(filtered, (force, wrench), strict=True))
        if stages.control_period:
            force, wrench = signals.held(into == 0, (force, wrench), filtered)
        filtered = force, wrench
    buffers, base = sensors.estimated_base(memory.base_estimate, sensors.true_base(actual.state), step, hardware)
    reports, joints = _reported(hardware, memory.reports, actual)
    memory = memory._replace(force_sensor=sensor, sensor_watch=watch, filtered=filtered)
    memory = memory._replace(base_estimate=buffers, reports=reports)
    *servos, lever = joints
    measured = Measurement(*base, force, wrench, actual.grip.support, *servos)
    return memory, measured._replace(forces_known=known, foot_lever=lever)


def _reported(hardware: Hardware, reports: Reports | None, actual: Actual) -> tuple[Reports | None, tuple[Array, ...]]:
    """Return the servos' reports on the bus; angles, rates, torques and levers of the feet as the law receives them."""
    state = actual.state
    lever = actual.feet.lever @ quaternion_to_matrix(state.base_orientation)
    if reports is None:
        return None, (state.joint_angles, state.joint_rates, jnp.zeros_like(state.joint_rates), lever)
    joints, buffers = (state.joint_angles, state.joint_rates, reports.torque, lever), reports.buffers
    if hardware.stages.command_delay:
        late = [signals.delayed(*each, hardware.pace.command) for each in zip(buffers, joints, strict=True)]
        buffers, joints = zip(*late, strict=True)
    return reports._replace(buffers=buffers), joints


def _solve(
    geometry: LimbGeometry | Chain, posture: Array | None, command: Command, reference: Reference
) -> tuple[JointSolution, Array | None]:
    """Return the joint angles that put base and feet in place, and the posture from which the next ones are found."""
    rotation = quaternion_to_matrix(command.base_orientation)
    target = (command.foot_position - command.base_position) @ rotation  # in the base's axes: each row times R is R^T p
    if not isinstance(geometry, Chain):
        return inverse_kinematics(geometry, target), posture
    turn = rotation.T @ quaternion_to_matrix(reference.base_orientation)
    joints = inverse_kinematics(geometry, target, posture, turn)
    return joints, joints.joint_angles
