"""One walk of one robot: what happens in a time step, in the order in which it happens.

`prepare` works out what stays the same, `begin` gives the start, `advance` makes one step:

    kinematics -> grips -> gait -> control loop -> cargo and pushes -> accelerations -> integration

How many robots walk at once is the affair of `mjx_climb.execution`.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb import execution
from mjx_climb.control import Law
from mjx_climb.disturbances import on_base as disturbance
from mjx_climb.gait import schedule as gait
from mjx_climb.hardware import servo
from mjx_climb.hardware.stages import Hardware, hardware_of
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.contact.gripper import Attitude, Contact, Reach, grip
from mjx_climb.physics.equations_of_motion import ENGINES
from mjx_climb.physics.inverse_dynamics import load_torque
from mjx_climb.physics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import (
    LimbFrames,
    base_wrench_of_foot_force,
    center_of_mass,
    foot_kinematics,
    foot_turning,
    limb_frames,
)
from mjx_climb.physics.margins import gia_margin, net_external_wrench, support_axes, tumble_stability_margin
from mjx_climb.physics.spatial import norm, quaternion_to_matrix
from mjx_climb.physics.state import Acceleration, Loads, State, integrate
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.walk import control_loop
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.structure import Structure


class Setup(NamedTuple):
    """What law and parameters make of themselves once a walk."""

    law: Law
    parameters: Parameters
    hardware: Hardware
    plan: gait.Plan
    windows: disturbance.Windows


class Walk(NamedTuple):
    """What stays the same from step to step."""

    robot: Robot  # as its file says: `mass_scale` is none of it
    parameters: Parameters
    plan: gait.Plan
    windows: disturbance.Windows
    controller: control_loop.Controller
    structure: Structure


class Carry(NamedTuple):
    """What goes from one step to the next."""

    state: State
    contact: Contact
    cycle_start: Array  # (3,) m, what the gait remembers of the base
    memory: control_loop.Memory  # of the law and the hardware


def set_up(structure: Structure, law: Law, parameters: Parameters) -> Setup:
    """Return what a law, whose gains have their full length, and parameters make of themselves."""
    robot = _in_precision(load_robot(structure.robot), parameters.kp.dtype)
    base_rotation = quaternion_to_matrix(robot.stance_orientation)
    feet = robot.stance_position + limb_frames(robot, base_rotation, robot.stance_joints).foot
    return Setup(
        law=law,
        parameters=parameters,
        hardware=hardware_of(parameters, structure.stages, structure.time_step, robot),
        plan=gait.plan(robot, feet, parameters, structure.lift_off, structure.time_step, structure.stages),
        windows=disturbance.windows(parameters, structure.time_step),
    )


def walk_of(structure: Structure, setup: Setup) -> Walk:
    """Return the walk of what has been set up, beside all that every robot of this structure shares."""
    robot = load_robot(structure.robot)
    geometry = limb_geometry(robot, structure.stages.rotational)
    robot, geometry = _in_precision((robot, geometry), setup.parameters.kp.dtype)
    robot = execution.of_limbs(robot)  # from here on execution knows which arrays have the limbs first
    controller = control_loop.Controller(setup.law, geometry, setup.hardware)
    return Walk(robot, setup.parameters, setup.plan, setup.windows, controller, structure)


def _in_precision(tree: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda value: jnp.asarray(value, dtype), tree)


def prepare(structure: Structure, law: Law, parameters: Parameters) -> Walk:
    """Return the walk of a robot under a law, whose gains have their full length."""
    return walk_of(structure, set_up(structure, law, parameters))


def begin(walk: Walk) -> Carry:
    """Return the rest stance with all grippers shut."""
    plan, robot, stages = walk.plan, walk.robot, walk.structure.stages
    now = gait.schedule(plan, jnp.zeros_like(plan.cycle_steps))
    start, feet = gait.planned_start(plan, now.cycle), gait.first_footholds(plan)
    reference = gait.reference(plan, now, start, feet, walk.structure.time_step)._replace(foot_position=feet)
    rotation, joints = quaternion_to_matrix(reference.base_orientation), jnp.asarray(robot.stance_joints)
    if plan.heights.size or stages.height or stages.sway:  # the rest stance is none
        target = (reference.foot_position - reference.base_position) @ rotation
        joints = inverse_kinematics(walk.controller.geometry, target).joint_angles
    still = jnp.zeros_like(reference.base_position)
    state = State(reference.base_position, reference.base_orientation, still, still, joints, jnp.zeros_like(joints))
    shut = jnp.ones(len(robot.limbs), bool)
    contact = Contact(reference.foot_position, shut, ~shut, Reach(shut, ~shut) if stages.capture else ())
    if stages.rotational:
        frames = limb_frames(robot, rotation, joints)
        contact = contact._replace(attitude=Attitude(frames.rotation[:, -1], ~shut))
    memory = control_loop.begin(walk.controller, state, reference)
    return Carry(state, contact, gait.unswayed(plan, now, reference.base_position), memory)


def advance(walk: Walk, carry: Carry, step: Array, action: control_loop.Action = None) -> tuple[Carry, Sample]:
    """Return the walk one time step later, and all that is known about this step.

    `step` counts them, (). An action takes the place of the law, which then stays as it is.
    """
    state, parameters = carry.state, walk.parameters
    frames, now = limb_frames(walk.robot, None, state.joint_angles), gait.schedule(walk.plan, step)
    actual = _standing(walk, carry, frames, now)

    cycle_start, start = carry.cycle_start, gait.planned_start(walk.plan, now.cycle)
    if walk.structure.base_reference == "actual":  # a cycle starts where the base is, not where the last one ended
        here = gait.unswayed(walk.plan, now, state.base_position)
        cycle_start = start = jnp.where(now.cycle_phase == 0, here, carry.cycle_start)
    reference = gait.reference(walk.plan, now, start, actual.contact.grip_point, walk.structure.time_step)
    cargo, push = disturbance.acting(parameters, walk.windows, step)
    memory = carry.memory
    if walk.structure.stages.load_torque:  # of all but the servos: what their gears carry
        loads = _loads(walk, actual, jnp.zeros_like(state.joint_angles), push, cargo)
        load = parameters.mass_scale * load_torque(walk.robot, state, loads)
        memory = memory._replace(servo=memory.servo._replace(load=load))
    memory, command, joints, drive = control_loop.control(walk.controller, memory, actual, reference, step, action)

    acceleration = _accelerations(walk, actual, drive, push, cargo)
    com = center_of_mass(walk.robot, frames, state, cargo / parameters.mass_scale)
    tsm, gia = _stability_margins(walk, actual, push, com, cargo)
    watch, no_sensor = memory.sensor_watch, jnp.zeros_like(actual.grip.support)
    sample = Sample(
        time=step * jnp.asarray(walk.structure.time_step, com.dtype), **vars(state), **actual.grip._asdict(),
        base_linear_acceleration=acceleration.base_linear, base_angular_acceleration=acceleration.base_angular,
        joint_accelerations=acceleration.joints, joint_torque=drive.motor_torque,
        joint_targets=joints.joint_angles, reachable=joints.reachable,
        foot_position=actual.feet.position, foot_velocity=actual.feet.velocity, foot_target=command.foot_position,
        grip_point=actual.contact.grip_point, contact=actual.contact.touching, detached=carry.contact.detached,
        sensor_lost=watch.lost if watch else no_sensor,
        base_reference=reference.base_position, base_displacement=command.base_displacement,
        base_wrench=actual.wrench, push=push, cargo_mass=cargo, center_of_mass=com, tsm=tsm, gia_margin=gia,
    )  # fmt: skip
    return Carry(integrate(state, acceleration, walk.structure.time_step), actual.contact, cycle_start, memory), sample


def _standing(walk: Walk, carry: Carry, frames: LimbFrames, now: gait.Schedule) -> control_loop.Actual:
    """Return how the robot stands on the ground in a step."""
    parameters, ground = walk.parameters, gait.foothold_height(walk.plan, now.foothold)
    if walk.structure.smooth:  # nothing is torn off
        parameters = dataclasses.replace(parameters, holding_limit=jnp.full_like(parameters.holding_limit, jnp.inf))
    feet = foot_kinematics(walk.robot, frames, carry.state)
    turning = foot_turning(walk.robot, frames, carry.state) if walk.structure.stages.rotational else None
    contact, held = grip(carry.contact, feet, now.closed, ground, parameters, turning)
    wrench = base_wrench_of_foot_force(feet.lever, held.foot_force, held.foot_moment)
    return control_loop.Actual(carry.state, feet, turning, contact, held, wrench)


def _accelerations(
    walk: Walk, actual: control_loop.Actual, drive: servo.Drive, push: Array, cargo: Array
) -> Acceleration:
    """Return what the equations of motion give."""
    robot, torque = driven_robot(walk.robot, drive, actual.state.joint_angles, walk.controller.hardware)
    loads = _loads(walk, actual, torque, push, cargo)
    return ENGINES[walk.structure.engine](robot)(actual.state, *loads)


def _loads(walk: Walk, actual: control_loop.Actual, torque: Array, push: Array, cargo: Array) -> Loads:
    """Return what acts on the robot, its servos with a torque (limb, joint) N m.

    With all masses times s, s (H qdd + c) = f has the accelerations of H qdd + c = f / s: the engine is given the
    robot as its file says, and forces, armature and cargo over s.
    """
    parameters, state, held, share = walk.parameters, actual.state, actual.grip, 1 / walk.parameters.mass_scale
    if actual.turning is not None:
        torque = torque + jnp.vecmat(held.foot_moment, actual.turning.jacobian)
    no_force, gravity = jnp.zeros_like(state.base_position), jnp.asarray(parameters.gravity)
    wrench = push + jnp.concatenate([no_force, held.foot_moment.sum(0)])
    return Loads(torque * share, held.foot_force * share, wrench * share, cargo * share, gravity)


def driven_robot(robot: Robot, drive: servo.Drive, joint_angles: Array, hardware: Hardware) -> tuple[Robot, Array]:
    """Return the robot with the armature of its drives, over `mass_scale`, and the torques (limb, joint) N m on it."""
    parameters, torque, own = hardware.parameters, drive.joint_torque, robot.armature
    if hardware.stages.armature or not isinstance(drive.armature, tuple) or own is not None:
        armature: Any = jnp.zeros_like(robot.joint_lower) if own is None else own
        armature = armature if isinstance(drive.armature, tuple) else armature + drive.armature
        armature = (armature + jnp.asarray(parameters.armature)) / parameters.mass_scale
        robot = dataclasses.replace(robot, armature=armature)
    if robot.spring is not None and robot.spring_rest is not None:
        torque = torque - robot.spring * (joint_angles - robot.spring_rest)
    return robot, torque


def _stability_margins(
    walk: Walk, actual: control_loop.Actual, push: Array, com: Array, cargo: Array
) -> tuple[Array, Array]:
    """Return TSM, m, and GIA margin, m/s^2.

    A gripper that cannot be torn off has no holding force to count on: the margins are then those of bare feet.
    """
    net_wrench = net_external_wrench(actual.wrench + push, actual.state.base_position)
    parameters, axes = walk.parameters, support_axes(actual.feet.position, actual.grip.support)
    mass = cargo + parameters.mass_scale * walk.robot.total_mass
    holding = jnp.where(jnp.isfinite(parameters.holding_limit), parameters.holding_limit, 0.0)
    tsm = tumble_stability_margin(axes, net_wrench, mass, norm(jnp.asarray(parameters.gravity)), holding)
    return tsm, gia_margin(axes, com, net_wrench[0], mass, holding)
