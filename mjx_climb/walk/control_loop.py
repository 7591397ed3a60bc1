"""One pass of the robot's own loop: sensors, law, inverse kinematics, bus, joint loop, servos."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.control import Command, Measurement, Reference, running
from mjx_climb.control.base_shift import shifted_by
from mjx_climb.control.joint_loop import joint_torque
from mjx_climb.dynamics.kinematics import base_wrench_of_foot_force
from mjx_climb.dynamics.spatial import quaternion_to_matrix, rotate_back
from mjx_climb.dynamics.state import State
from mjx_climb.hardware import base_estimate, control_period, delay, force_sensor, servo
from mjx_climb.hardware.pace import Pace
from mjx_climb.hardware.stages import Stages
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.walk.action import Action, JointTargets, displacement_of
from mjx_climb.walk.inverse_kinematics import Chain, JointSolution, LimbGeometry, inverse_kinematics


class Controller(NamedTuple):
    """What stays the same from step to step."""

    law: running.Running
    geometry: LimbGeometry | Chain
    numbers: Parameters
    stages: Stages
    pace: Pace
    time_step: float


class Said(NamedTuple):
    """What the law said when it was worked out last, and where the joint targets were before."""

    command: Command
    joints: JointSolution
    before: Any  # (N, L, B) rad, () where targets are held


class Memory(NamedTuple):
    """What the stages of hardware remember; empty where a walk has no such stage."""

    force_sensor: force_sensor.ForceSensor
    filtered: Any  # (3, L, B) N and (6, B) N, N m, of what the law samples; () where it filters nothing
    base_estimate: Any
    said: Any  # `Said`
    targets: Any  # buffer of joint targets (N, L, B) rad
    servo: servo.Servo
    posture: Any  # (N, L, B) rad, the joint angles last solved for, () where there is a closed form


class Contacts(NamedTuple):
    """What acts on the feet, and the wrench that it amounts to."""

    lever: Array  # (3, L, B) m, from the base to the feet
    force: Array  # (3, L, B) N
    support: Array  # (L, B) bool
    wrench: Array  # (6, B) N, N m
    moment: Any = ()  # (6, B) N, N m, what of it are moments of the grips; () where they transmit none


class Driven(NamedTuple):
    """What a pass ends in."""

    command: Command
    joints: JointSolution  # with the targets that the joint loop got
    drive: servo.Drive


def start(state: State, feet: Array, controller: Controller) -> Memory:
    """Return the memory of a robot that has always rested in a state, with `feet` (3, L, B) m in the world."""
    angles, stages = state.joint_angles, controller.stages
    said: Any = ()
    no_force, no_shift = jnp.zeros_like(feet), jnp.zeros_like(jnp.concatenate([state.base_position] * 2))
    if stages.control_period:
        command = Command(state.base_position, state.base_orientation, feet, no_shift)
        joints = JointSolution(angles, jnp.ones(angles.shape[1:], bool))
        said = Said(command, joints, angles if stages.linear else ())
    return Memory(
        force_sensor=force_sensor.start(no_force, stages),
        filtered=(no_force, no_shift) if stages.sampled_filter else (),
        base_estimate=base_estimate.start(base_estimate.true_base(state), stages),
        said=said,
        targets=delay.start(angles, stages.command_delay),
        servo=servo.start(jnp.zeros_like(angles), stages),
        posture=angles if isinstance(controller.geometry, Chain) else (),
    )


def _transposed_times(rotation: Array, other: Array) -> Array:
    """Return `R^T S` (3, 3, B)."""
    return jnp.stack([rotate_back(rotation, other[:, column]) for column in range(3)], axis=1)


def run(
    controller: Controller,
    memory: Memory,
    law_state: Any,
    state: State,
    contacts: Contacts,
    reference: Reference,
    step: Array,
    action: Action = None,
) -> tuple[Memory, Any, Driven]:
    """Return the memory and the law's state after a step, and what the joints do in it.

    An action takes the place of the law, which then stays as it is; its way to the joints is the same.
    """
    numbers, stages, pace = controller.numbers, controller.stages, controller.pace
    sensor, force, wrench = memory.force_sensor, contacts.force, contacts.wrench
    if stages.force:
        sensor, force = force_sensor.measured(sensor, force, step, numbers, stages, pace.force, pace.filter_share)
        wrench = base_wrench_of_foot_force(contacts.lever, force)
        wrench = wrench + contacts.moment if stages.rotational else wrench
    if stages.control_period:
        into = control_period.steps_into(step, pace.period)
        now = into == 0
    filtered = memory.filtered
    if stages.sampled_filter:
        pairs = zip(filtered, (force, wrench), strict=True)
        force, wrench = (force_sensor.low_passed(before, new, pace.filter_share) for before, new in pairs)
        if stages.control_period:
            force, wrench = control_period.held(now, (force, wrench), filtered)
        filtered = force, wrench
    buffers, base = base_estimate.estimated(
        memory.base_estimate, base_estimate.true_base(state), step, numbers, stages, pace.base
    )

    measurement = Measurement(*base, force, wrench, contacts.support)
    after, command = controller.law.command(law_state, measurement, reference)
    if action is not None:
        after, command = law_state, shifted_by(reference, displacement_of(action, wrench))
    rotation = quaternion_to_matrix(command.base_orientation)
    target = rotate_back(rotation[:, :, None], command.foot_position - command.base_position[:, None])
    posture: Any = ()
    if isinstance(controller.geometry, Chain):
        turn = _transposed_times(rotation, quaternion_to_matrix(reference.base_orientation))
        joints = inverse_kinematics(controller.geometry, target, memory.posture, turn)
        posture = joints.joint_angles
    else:
        joints = inverse_kinematics(controller.geometry, target)
    if isinstance(action, JointTargets):
        joints = joints._replace(joint_angles=action.angles)

    said = memory.said
    if stages.control_period:
        after = control_period.held(now, after, law_state)
        before: Any = control_period.held(now, said.joints.joint_angles, said.before) if stages.linear else ()
        said = Said(*control_period.held(now, (command, joints), (said.command, said.joints)), before)
        command, joints = said.command, said.joints
        if stages.linear:
            line = control_period.interpolated(before, joints.joint_angles, into, pace.period)
            joints = joints._replace(joint_angles=line)
    targets = memory.targets
    if stages.command_delay:
        targets, late = delay.delayed(targets, joints.joint_angles, pace.command)
        joints = joints._replace(joint_angles=late)

    felt = servo.target_across_play(joints.joint_angles, state.joint_angles, numbers, stages)
    asked = joint_torque(numbers, felt, state.joint_angles, state.joint_rates)
    servos, drive = servo.driven(
        memory.servo, asked, state.joint_rates, numbers, stages, pace.servo, controller.time_step
    )
    return Memory(sensor, filtered, buffers, said, targets, servos, posture), after, Driven(command, joints, drive)
