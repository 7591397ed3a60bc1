"""One walk of one robot: the parts of a time step, in their order.

`prepare` computes constants, `begin` gives the start, `advance` makes one step:

    kinematics -> grips -> gait -> control loop -> disturbances -> accelerations -> integration

Before the first step of each planning period `look_ahead` lets the gait decide, where it does so.

How many robots walk at once is the affair of `mjx_climb.execution`.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from mjx_climb import execution
from mjx_climb.arrays import AnyArray, Tree
from mjx_climb.control import Law
from mjx_climb.control.law import Reference, constants, measurement_at
from mjx_climb.disturbances.disturbance import Body, External, sum_of
from mjx_climb.gait.chosen_footholds import ChosenFootholds
from mjx_climb.gait.footholds.reach import HeightTable, height_table, posture
from mjx_climb.gait.free_order import FreeOrder
from mjx_climb.gait.gait import Body as WholeBody
from mjx_climb.gait.gait import Gait
from mjx_climb.gait.own_swings import OwnSwings
from mjx_climb.gait.periodic import Periodic
from mjx_climb.gait.recovery import RecoveringGait, recovery_of
from mjx_climb.gait.schedule import Plan, Schedule, plan
from mjx_climb.gait.waiting import WaitingGait
from mjx_climb.hardware.actuator import Drive
from mjx_climb.hardware.sensors import effort_force
from mjx_climb.hardware.servo import Servos
from mjx_climb.hardware.stages import Hardware, hardware_of
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.contact.contact import Contact, clearance
from mjx_climb.physics.equations_of_motion import ENGINES
from mjx_climb.physics.inverse_dynamics import load_torque
from mjx_climb.physics.inverse_kinematics import Chain, LimbGeometry, limb_geometry
from mjx_climb.physics.kinematics import (
    LimbFrames,
    base_wrench_of_foot_force,
    center_of_mass,
    foot_kinematics,
    foot_turning,
    ground_normal,
    limb_frames,
)
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.physics.state import Acceleration, Loads, State, integrate
from mjx_climb.robot.constants import Robot
from mjx_climb.walk import control_loop
from mjx_climb.walk.answers import disturbed, gripped
from mjx_climb.walk.sample import Sample, Step, sample_of
from mjx_climb.walk.structure import Structure


class Setup(NamedTuple):
    """Law and parameters of a walk, and constants computed from them before its first step."""

    law: Law
    parameters: Parameters
    hardware: Hardware
    plan: Plan


class Walk(NamedTuple):
    """Constants of a walk."""

    robot: Robot  # as its file says: `mass_scale` is none of it
    parameters: Parameters
    gait: Gait
    contact: Contact
    holding_force: Array  # () N, the pull that margins may count on, in a smooth walk too
    controller: control_loop.Controller
    structure: Structure


class Carry(NamedTuple):
    """State between two steps."""

    state: State
    contact: PyTree  # memory of the contacts
    gait: PyTree  # memory of the gait
    memory: control_loop.Memory  # of the law and the hardware


def set_up(structure: Structure, law: Law, parameters: Parameters) -> Setup:
    """Return hardware and gait plan of a walk, for a law whose gains have their full length."""
    robot = _in_precision(structure.robot, parameters.gravity.dtype)
    base_rotation = quaternion_to_matrix(robot.stance_orientation)
    feet = robot.stance_position + limb_frames(robot, base_rotation, robot.stance_joints).foot
    return Setup(
        law=law,
        parameters=parameters,
        hardware=hardware_of(parameters, structure.stages, structure.time_step, robot),
        plan=plan(robot, feet, parameters, structure.lift_off, structure.time_step, structure.stages),
    )


def walk_of(structure: Structure, setup: Setup) -> Walk:
    """The walk of a setup, beside the constants that all robots of this structure share."""
    robot = structure.robot
    geometry = limb_geometry(robot, setup.parameters.contact.transmits_moments)
    rule = setup.parameters.footholds
    table = height_table(robot, geometry) if rule is not None and rule.reach_by_height else None
    robot, geometry, table = _in_precision((robot, geometry, table), setup.parameters.gravity.dtype)
    robot = execution.of_limbs(robot)  # from here on execution knows which arrays have the limbs first
    parameters, actuator = setup.parameters, setup.parameters.drive
    contact = parameters.contact.set_up(structure.time_step)
    if isinstance(actuator, Servos):
        actuator = dataclasses.replace(actuator, hardware=setup.hardware)
    controller = control_loop.Controller(setup.law, geometry, setup.hardware, actuator)
    # asked before the limit is taken away: without one, margins are those of bare feet
    holding_force = jnp.asarray(contact.holding_force())
    contact = contact.unbreakable() if structure.smooth else contact
    gait = _gait_of(structure, setup, robot, geometry, table)
    return Walk(robot, parameters, gait, contact, holding_force, controller, structure)


def _gait_of(
    structure: Structure, setup: Setup, robot: Robot, geometry: LimbGeometry | Chain, table: HeightTable | None
) -> Gait:
    rule, recovery = setup.parameters.footholds, recovery_of(setup.law, setup.parameters.recovery)
    own = setup.plan, structure.time_step, structure.base_reference == "actual"
    if not structure.planning:
        return Periodic(*own)
    of_limbs = *own, robot, geometry, setup.parameters.ground.holds, structure.planning
    moves = len(structure.lift_off if structure.free else {share for _, share in structure.lift_off})
    kind = FreeOrder if structure.free else ChosenFootholds
    gravity = jnp.asarray(setup.parameters.gravity)
    chosen = rule, moves, structure.way_points, table, gravity
    found = OwnSwings(*of_limbs) if rule is None else kind(*of_limbs, *chosen)
    if (waiting := setup.parameters.waiting) is not None:
        found = WaitingGait.of(found, waiting)
    return found if recovery is None else RecoveringGait.of(found, recovery)


def _in_precision(tree: Tree, dtype: jnp.dtype) -> Tree:
    cast_to: Tree = jax.tree.map(lambda value: jnp.asarray(value, dtype), tree)
    return cast_to


def prepare(structure: Structure, law: Law, parameters: Parameters) -> Walk:
    """Return the walk of a robot under a law, whose gains have their full length."""
    return walk_of(structure, set_up(structure, law, parameters))


def begin(walk: Walk) -> Carry:
    """Return the rest stance with all grippers shut."""
    robot, stages = walk.robot, walk.structure.stages
    remembered, reference = walk.gait.init()
    rotation, joints = quaternion_to_matrix(reference.base_orientation), jnp.asarray(robot.stance_joints)
    # elsewhere the rest stance already has the feet on their footholds
    chosen = walk.parameters.footholds is not None
    if walk.parameters.ground.foothold_height.size or stages.height or stages.sway or chosen:
        target = (reference.foot_position - reference.base_position) @ rotation
        joints = posture(walk.controller.geometry, target).joint_angles
    still = jnp.zeros_like(reference.base_position)
    state = State(reference.base_position, reference.base_orientation, still, still, joints, jnp.zeros_like(joints))
    attitudes = limb_frames(robot, rotation, joints).rotation[:, -1]
    contact = walk.contact.init(reference.foot_position, attitudes)
    memory = control_loop.begin(walk.controller, walk.robot, state, reference)
    return Carry(state, contact, remembered, memory)


def constants_of_law(walk: Walk, begun: Carry) -> list[bool | Array]:
    """Return which leaves of the law's state stay as they begin: see `mjx_climb.control.law.constants`."""
    state = begun.state
    feet = jnp.zeros_like(state.base_position, shape=(len(state.joint_angles), 3))
    reference = Reference(state.base_position, state.base_orientation, feet)
    measured = measurement_at(reference, state.joint_angles)
    return constants(walk.controller.law, begun.memory.law, measured, reference)


def advance(walk: Walk, carry: Carry, step: Array, action: control_loop.Action = None) -> tuple[Carry, Sample]:
    """Return the walk one time step later, and all that is known about this step.

    `step` counts them, (). An action takes the place of the law, which then stays as it is.
    """
    state, parameters = carry.state, walk.parameters
    frames, now = limb_frames(walk.robot, None, state.joint_angles), walk.gait.schedule(carry.gait, step)
    # Eq. 5: the forces of the grips, and which of them let go
    actual = _evaluate_contacts(walk, carry, frames, now)

    grip_point = actual.grip.grip_point
    remembered, reference = walk.gait.reference(carry.gait, now, step, state.base_position, grip_point)
    if (reports := carry.memory.reports) is not None and walk.structure.stages.joint_effort:
        felt = effort_force(walk.robot, frames, state, reports.torque, jnp.asarray(parameters.gravity))
        actual = actual._replace(felt=jnp.where(actual.grip.support[:, None], felt, 0.0))
    external = _external(walk, Body(walk.robot, frames, state), step)
    remembered = walk.gait.after_contacts(remembered, now, step, actual.grip)
    load = None
    # of all but the actuators: the load on their gears
    if walk.controller.actuator.feels_load:
        loads = _loads(walk, actual, jnp.zeros_like(state.joint_angles), external)
        load = jnp.asarray(parameters.mass_scale * load_torque(walk.robot, state, loads))
    # Eqs. 2 and 3, or another law, then inverse kinematics, bus and joint loop
    loop = control_loop.control(walk.controller, carry.memory, actual, reference, step, load, action)
    memory, command, joints, drive = loop

    # Eq. 1
    acceleration = _accelerations(walk, actual, drive, external)
    watch, no_sensor = memory.sensor_watch, jnp.zeros_like(actual.grip.support)
    sample = sample_of(
        Step(
            time=step * jnp.asarray(walk.structure.time_step, state.base_position.dtype),
            robot=walk.robot, parameters=parameters, frames=frames, actual=actual, reference=reference,
            command=command, joints=joints, drive=drive, external=external, acceleration=acceleration,
            sensor_lost=no_sensor if watch is None else watch.lost,
            stands=walk.gait.stands(remembered, actual.grip),
            grip_gap=_grip_gap(walk, carry, now, actual),
            holding_force=walk.gait.pulls(carry.gait, now, actual.feet.surface, walk.holding_force),
        )
    )  # fmt: skip
    after = integrate(state, acceleration, walk.structure.time_step)
    return Carry(after, actual.contact, remembered, memory), sample


def look_ahead(walk: Walk, carry: Carry, step: Array) -> Carry:
    """Return the walk before a step, () integer, with the decisions of the gait."""
    state, parameters = carry.state, walk.parameters
    frames, now = limb_frames(walk.robot, None, state.joint_angles), walk.gait.schedule(carry.gait, step)
    actual = _evaluate_contacts(walk, carry, frames, now)
    grip_point = actual.grip.grip_point
    _, reference = walk.gait.reference(carry.gait, now, step, state.base_position, grip_point)
    cargo = _external(walk, Body(walk.robot, frames, state), step).cargo_mass
    mass = cargo + parameters.mass_scale * walk.robot.total_mass
    body = WholeBody(
        mass=mass, center_of_mass=center_of_mass(walk.robot, frames, state, cargo / parameters.mass_scale),
        velocity=state.base_linear_velocity, weight=mass * jnp.asarray(parameters.gravity), feet=actual.feet.position,
        support=actual.grip.support, foot_force=actual.grip.foot_force, holding_force=walk.holding_force,
        normal=ground_normal(actual.feet),
        pull=walk.gait.pulls(carry.gait, now, actual.feet.surface, walk.holding_force),
        base_position=state.base_position, base_rotation=quaternion_to_matrix(state.base_orientation),
        grip_point=grip_point,
    )  # fmt: skip
    return carry._replace(gait=walk.gait.look_ahead(carry.gait, now, step, reference, body))


def _evaluate_contacts(walk: Walk, carry: Carry, frames: LimbFrames, now: Schedule) -> control_loop.Actual:
    """Return feet, contacts (paper Eq. 5) and the wrench of the feet on the base, `J_b^T F_e`, in a step."""
    feet = foot_kinematics(walk.robot, frames, carry.state)
    ground, surface = walk.gait.ground(carry.gait, now)
    feet = feet._replace(surface=surface)
    turning = foot_turning(walk.robot, frames, carry.state) if walk.contact.transmits_moments else None
    contact, held = gripped(walk.contact, carry.contact, feet, turning, now.closed, ground)
    share = walk.gait.share_of_limits(carry.gait, now, held.foot_force)
    if share is not None:
        share = jnp.where(held.support, share, 0.0)
        held = held._replace(utilization=jnp.maximum(held.utilization, share))
        if not walk.structure.smooth:
            contact, held = walk.contact.tear_off(contact, held, share > 1)
    wrench = base_wrench_of_foot_force(feet.lever, held.foot_force, held.foot_moment)
    return control_loop.Actual(carry.state, feet, turning, contact, held, wrench)


def _grip_gap(walk: Walk, carry: Carry, now: Schedule, actual: control_loop.Actual) -> Array:
    """Return how far off the ground feet are whose grippers are commanded shut in this step, (limb,) m."""
    off, _ = clearance(actual.feet, walk.gait.ground(carry.gait, now)[0])
    return jnp.where(now.closed & (now.since_touchdown < 1), jnp.maximum(off, 0.0), 0.0)


def _external(walk: Walk, body: Body, step: Array) -> External:
    """Return the sum of all disturbances in a step."""
    middle = (step + 0.5) * jnp.asarray(walk.structure.time_step, body.state.base_position.dtype)
    found, nothing = sum_of(disturbed(each, middle, body) for each in walk.parameters.disturbances), body.untouched()
    wrench = nothing.base_wrench if found.base_wrench is None else found.base_wrench
    return External(wrench, found.joint_torque, nothing.cargo_mass if found.cargo_mass is None else found.cargo_mass)


def _accelerations(walk: Walk, actual: control_loop.Actual, drive: Drive, external: External) -> Acceleration:
    """Return the accelerations by the equations of motion, paper Eq. 1."""
    robot, torque = driven_robot(walk.robot, drive, actual.state.joint_angles, walk.parameters.mass_scale)
    return ENGINES[walk.structure.engine](robot)(actual.state, *_loads(walk, actual, torque, external))


def _loads(walk: Walk, actual: control_loop.Actual, torque: Array, external: External) -> Loads:
    """Return the loads on the robot, its actuators' torque (limb, joint) N m included.

    With all masses times s, s (H qdd + c) = f has the accelerations of H qdd + c = f / s: the engine is given the
    robot as its file says, and forces, armature and cargo over s.
    """
    parameters, state, held, share = walk.parameters, actual.state, actual.grip, 1 / walk.parameters.mass_scale
    if external.joint_torque is not None:
        torque = torque + external.joint_torque
    if actual.turning is not None:
        torque = torque + jnp.vecmat(held.foot_moment, actual.turning.jacobian)
    no_force, gravity = jnp.zeros_like(state.base_position), jnp.asarray(parameters.gravity)
    wrench = external.base_wrench + jnp.concatenate([no_force, held.foot_moment.sum(0)])
    return Loads(torque * share, held.foot_force * share, wrench * share, external.cargo_mass * share, gravity)


def driven_robot(robot: Robot, drive: Drive, joint_angles: Array, mass_scale: AnyArray) -> tuple[Robot, Array]:
    """Return the robot with the armature of its drives, over `mass_scale`, and the torques (limb, joint) N m on it."""
    torque, own = drive.joint_torque, robot.armature
    if drive.armature is not None or own is not None:
        armature: AnyArray = jnp.zeros_like(robot.joint_lower) if own is None else own
        armature = armature if drive.armature is None else armature + drive.armature
        robot = dataclasses.replace(robot, armature=armature / mass_scale)
    if robot.spring is not None and robot.spring_rest is not None:
        torque = torque - robot.spring * (joint_angles - robot.spring_rest)
    return robot, torque
