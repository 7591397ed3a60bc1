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
from mjx_climb.control import Law, Reference
from mjx_climb.dynamics import ENGINES
from mjx_climb.dynamics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.dynamics.kinematics import (
    base_wrench_of_foot_force,
    center_of_mass,
    foot_kinematics,
    foot_turning,
    limb_frames,
)
from mjx_climb.dynamics.spatial import norm, quaternion_to_matrix
from mjx_climb.dynamics.state import Acceleration, State, integrate
from mjx_climb.hardware.stages import Hardware, Stages, hardware_of
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.robot.constants import Robot, load_robot
from mjx_climb.walk import control_loop, disturbance, gait
from mjx_climb.walk.contact import Attitude, Contact, Reach, grip
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.stability import gia_margin, net_external_wrench, tumble_stability_margin
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

    @property
    def stages(self) -> Stages:
        """The stages of hardware between law and joints."""
        return self.structure.stages


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
        plan=gait.plan(robot, feet, parameters, structure.lift_off, structure.time_step),
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
    plan, robot, stages = walk.plan, walk.robot, walk.stages
    start = gait.planned_start(plan, jnp.zeros_like(plan.cycle_steps))
    reference = Reference(start, plan.base_orientation, gait.first_footholds(plan))
    rotation, joints = quaternion_to_matrix(reference.base_orientation), jnp.asarray(robot.stance_joints)
    if not gait.is_flat(plan):
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
    return Carry(state, contact, reference.base_position, memory)


def advance(walk: Walk, carry: Carry, step: Array, action: control_loop.Action = None) -> tuple[Carry, Sample]:
    """Return the walk one time step later, and all that is known about this step.

    `step` counts them, (). An action takes the place of the law, which then stays as it is.
    """
    robot, parameters, state = walk.robot, walk.parameters, carry.state
    frames = limb_frames(robot, None, state.joint_angles)
    feet = foot_kinematics(robot, frames, state)
    turning = foot_turning(robot, frames, state) if walk.stages.rotational else None

    now = gait.schedule(walk.plan, step)
    ground = gait.ground_height(walk.plan, now)
    contact, held = grip(carry.contact, feet, now.closed, ground, _grip_parameters(walk), turning)
    grip_wrench = jnp.concatenate([jnp.zeros_like(state.base_position), held.moment.sum(0)])
    wrench = base_wrench_of_foot_force(feet.lever, held.force) + grip_wrench

    find_start = gait.CYCLE_STARTS[walk.structure.base_reference]
    cycle_start, start = find_start(walk.plan, now, carry.cycle_start, state.base_position)
    reference = Reference(
        base_position=gait.base_reference(walk.plan, now, start),
        base_orientation=walk.plan.base_orientation,
        foot_position=gait.foot_targets(walk.plan, now, contact.grip_point),
    )
    grip_moment = grip_wrench[3:] if turning is not None else None
    actual = control_loop.Actual(state, feet.lever, held.force, held.support, wrench, grip_moment)
    memory, output = control_loop.control(walk.controller, carry.memory, actual, reference, step, action)

    cargo = disturbance.cargo_mass(parameters, walk.windows, step)
    push = disturbance.push(parameters, walk.windows, step)
    torque = output.drive.joint_torque
    if turning is not None:
        torque = torque + jnp.vecmat(held.moment, turning.jacobian)
    loads = _Loads(torque, held.force, push + grip_wrench, cargo)
    acceleration = _accelerations(walk, state, loads, output.drive.armature)

    com = center_of_mass(robot, frames, state, cargo / parameters.mass_scale)
    net_wrench = net_external_wrench(wrench + push, state.base_position)
    tsm, gia = _stability_margins(walk, feet.position, held.support, net_wrench, com, cargo)
    sample = Sample(
        time=step * jnp.asarray(walk.structure.time_step, com.dtype),
        **vars(state),
        base_linear_acceleration=acceleration.base_linear,
        base_angular_acceleration=acceleration.base_angular,
        joint_accelerations=acceleration.joints,
        joint_targets=output.joints.joint_angles,
        joint_torque=output.drive.motor_torque,
        foot_position=feet.position,
        foot_velocity=feet.velocity,
        foot_target=output.command.foot_position,
        foot_force=held.force,
        foot_moment=held.moment,
        grip_point=contact.grip_point,
        support=held.support,
        contact=contact.touching,
        detached=carry.contact.detached,
        torn_off=held.torn_off,
        missed=held.missed,
        reachable=output.joints.reachable,
        base_reference=reference.base_position,
        base_displacement=output.command.base_displacement,
        base_wrench=wrench,
        push=push,
        cargo_mass=cargo,
        center_of_mass=com,
        tsm=tsm,
        gia_margin=gia,
    )
    return Carry(integrate(state, acceleration, walk.structure.time_step), contact, cycle_start, memory), sample


def _grip_parameters(walk: Walk) -> Parameters:
    """Return the parameters of contacts and grippers: with an infinite holding limit where nothing is torn off."""
    if not walk.structure.smooth:
        return walk.parameters
    return dataclasses.replace(walk.parameters, holding_limit=jnp.full_like(walk.parameters.holding_limit, jnp.inf))


class _Loads(NamedTuple):
    """What acts on the robot."""

    joint_torque: Array  # (limb, joint) N m
    foot_force: Array  # (limb, 3) N
    base_wrench: Array  # (6,) N, N m, beside that of the foot forces
    cargo_mass: Array  # () kg


def _accelerations(walk: Walk, state: State, loads: _Loads, sticking: Any) -> Acceleration:
    """Return what the equations of motion give; `sticking` is the armature (limb, joint) that friction adds, if any.

    With all masses times s, s (H qdd + c) = f has the accelerations of H qdd + c = f / s: the engine is given the
    robot as its file says, and forces, armature and cargo over s.
    """
    robot, parameters, torque = walk.robot, walk.parameters, loads.joint_torque
    share = 1 / parameters.mass_scale
    if walk.stages.armature or walk.stages.dry_friction or robot.armature is not None:
        own: Any = jnp.zeros_like(robot.joint_lower) if robot.armature is None else robot.armature
        own = own + sticking if walk.stages.dry_friction else own
        robot = dataclasses.replace(robot, armature=(own + jnp.asarray(parameters.armature)) * share)
    if robot.spring is not None and robot.spring_rest is not None:
        torque = torque - robot.spring * (state.joint_angles - robot.spring_rest)
    torque, foot_force, base_wrench, cargo = (load * share for load in loads._replace(joint_torque=torque))
    gravity = jnp.asarray(parameters.gravity)
    return ENGINES[walk.structure.engine](robot)(state, torque, foot_force, base_wrench, cargo, gravity)


def _stability_margins(
    walk: Walk, feet: Array, support: Array, net_wrench: tuple[Array, Array], com: Array, cargo: Array
) -> tuple[Array, Array]:
    """Return TSM, m, and GIA margin, m/s^2.

    A gripper that cannot be torn off has no holding force to count on: the margins are then those of bare feet.
    """
    parameters = walk.parameters
    mass = cargo + parameters.mass_scale * walk.robot.total_mass
    holding = jnp.where(jnp.isfinite(parameters.holding_limit), parameters.holding_limit, 0.0)
    tsm = tumble_stability_margin(feet, support, *net_wrench, mass, norm(jnp.asarray(parameters.gravity)), holding)
    return tsm, gia_margin(feet, support, com, net_wrench[0], mass, holding)
