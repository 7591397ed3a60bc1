"""One walk in the layout of the hot path: what happens in a step, in the order in which it happens."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.control import LAWS, Law, Measurement, Reference
from mjx_climb.control.joint_loop import joint_torque
from mjx_climb.dynamics import ENGINES, ForwardDynamics
from mjx_climb.dynamics.kinematics import base_wrench_of_foot_force, center_of_mass, foot_kinematics, limb_frames
from mjx_climb.dynamics.spatial import norm, quaternion_to_matrix, rotate_back
from mjx_climb.dynamics.state import State, integrate
from mjx_climb.quantities.parameters import Gains, Parameters
from mjx_climb.robot.constants import Robot, load_robot
from mjx_climb.scenario.model import RobotFile, Scenario
from mjx_climb.walk import disturbance, gait
from mjx_climb.walk.contact import Contact, grip
from mjx_climb.walk.inverse_kinematics import Chain, LimbGeometry, inverse_kinematics, limb_geometry
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.stability import gia_margin, net_external_wrench, tumble_stability_margin


class Structure(NamedTuple):
    """What a compiled walk depends on, numbers apart; hashable."""

    robot: str | RobotFile
    engine: str
    controller: str
    reading: str
    lift_off: tuple[tuple[str, float], ...]  # of each limb, as a share of the cycle
    base_reference: str
    steps: int
    time_step: float
    smooth: bool = False  # no gripper is torn off, and the metrics have smooth companions
    in_pieces: bool = False  # steps are compiled in pieces, see `mjx_climb.compilation.cpu_pieces`


class Walk(NamedTuple):
    """What stays the same from step to step."""

    robot: Robot
    geometry: LimbGeometry | Chain
    numbers: Parameters
    grip_numbers: Parameters  # with an infinite holding limit where nothing is torn off
    plan: gait.Plan
    law: Law
    forward_dynamics: ForwardDynamics
    cycle_start: Callable[[gait.Plan, gait.Schedule, Array, Array], tuple[Array, Array]]
    time_step: float


class Carry(NamedTuple):
    """What goes from one step to the next."""

    state: State
    contact: Contact
    gait: Array  # (3, B) m, what the gait remembers of the base
    posture: Array | tuple[()]  # (N, L, B) rad, the joint targets, where the next ones are found from them
    law: Any


def structure(scenario: Scenario, engine: str, *, smooth: bool = False, in_pieces: bool = False) -> Structure:
    """Return what a compiled walk of the scenario depends on beside its numbers."""
    return Structure(
        robot=scenario.robot,
        engine=engine,
        controller=scenario.control.controller,
        reading=scenario.control.reading,
        lift_off=tuple(scenario.gait.lift_off.items()),
        base_reference=scenario.gait.base_reference,
        steps=scenario.steps,
        time_step=scenario.time_step,
        smooth=smooth,
        in_pieces=in_pieces,
    )


def prepare(structure: Structure, gains: Gains, numbers: Parameters) -> Walk:
    """Return the walk for gains (6, B) and numbers (..., B): every choice by name is made here, once."""
    dtype = jnp.result_type(gains.stiffness)
    constants = load_robot(structure.robot)
    robot, geometry = jax.tree.map(lambda value: jnp.asarray(value, dtype), (constants, limb_geometry(constants)))
    stance = limb_frames(robot, quaternion_to_matrix(robot.stance_orientation), robot.stance_joints)
    feet = robot.stance_position[:, None] + stance.foot
    unlimited = jnp.full_like(numbers.holding_limit, jnp.inf)
    return Walk(
        robot=weighing(robot, numbers.mass_scale),
        geometry=geometry,
        numbers=numbers,
        grip_numbers=dataclasses.replace(numbers, holding_limit=unlimited) if structure.smooth else numbers,
        plan=gait.plan(robot, feet, numbers, structure.lift_off, structure.time_step),
        law=LAWS[structure.controller, structure.reading](gains, structure.time_step),
        forward_dynamics=ENGINES[structure.engine](_lighter_drives(robot, numbers.mass_scale)),
        time_step=structure.time_step,
        cycle_start=gait.CYCLE_STARTS[structure.base_reference],
    )


def weighing(robot: Robot, scale: Array | np.ndarray) -> Robot:
    """Return the robot with all masses and inertias times `scale` (B,)."""
    names = ("base_mass", "base_inertia", "link_mass", "link_inertia")
    return dataclasses.replace(robot, **{name: getattr(robot, name) * scale for name in names})


def _lighter_drives(robot: Robot, scale: Array | np.ndarray) -> Robot:
    """Return the robot whose drives have their armature over `scale` (B,): the engine is given forces over it."""
    return robot if robot.armature is None else dataclasses.replace(robot, armature=robot.armature / scale)


def begin(walk: Walk, batch: int) -> Carry:
    """Return the rest stance with all grippers shut."""
    dtype = walk.plan.base_start.dtype

    def each(value: Array | np.ndarray) -> Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype), (*value.shape[:-1], batch))

    joints, position = each(walk.robot.stance_joints), each(walk.plan.base_start)
    feet = each(gait.first_footholds(walk.plan))
    if not gait.is_flat(walk.plan):
        position = position + gait.rise(walk.plan, jnp.zeros(1))
        rotation = quaternion_to_matrix(each(walk.plan.base_orientation))[:, :, None]
        joints = inverse_kinematics(walk.geometry, rotate_back(rotation, feet - position[:, None])).joint_angles
    shut = jnp.ones(feet.shape[1:], bool)
    still = jnp.zeros_like(position)
    return Carry(
        state=State(position, each(walk.plan.base_orientation), still, still, joints, jnp.zeros_like(joints)),
        contact=Contact(grip_point=feet, touching=shut, detached=~shut),
        gait=position,
        posture=joints if isinstance(walk.geometry, Chain) else (),
        law=jax.tree.map(each, walk.law.initial),
    )


def advance(walk: Walk, carry: Carry, step: Array) -> tuple[Carry, Sample]:
    """Return the walk one time step later, and all that is known about this step."""
    robot, numbers, state = walk.robot, walk.numbers, carry.state
    rotation = quaternion_to_matrix(state.base_orientation)
    frames = limb_frames(robot, rotation, state.joint_angles)
    feet = foot_kinematics(robot, frames, state)

    now = gait.schedule(walk.plan, step)
    contact, held = grip(carry.contact, feet, now.closed, gait.ground_height(walk.plan, now), walk.grip_numbers)
    wrench = base_wrench_of_foot_force(feet.lever, held.force)

    memory, cycle_start = walk.cycle_start(walk.plan, now, carry.gait, state.base_position)
    reference = Reference(
        base_position=gait.base_reference(walk.plan, now, cycle_start),
        base_orientation=walk.plan.base_orientation,
        foot_position=gait.foot_targets(walk.plan, now, contact.grip_point),
    )
    measurement = Measurement(
        state.base_position,
        state.base_orientation,
        state.base_linear_velocity,
        state.base_angular_velocity,
        held.force,
        wrench,
        held.support,
    )
    law_state, command = walk.law.command(carry.law, measurement, reference)
    target_rotation = quaternion_to_matrix(command.base_orientation)
    target = rotate_back(target_rotation[:, :, None], command.foot_position - command.base_position[:, None])
    last = carry.posture
    joints = inverse_kinematics(walk.geometry, target, None if isinstance(last, tuple) else last)
    torque = joint_torque(numbers, joints.joint_angles, state.joint_angles, state.joint_rates)
    left = torque if robot.damping is None else torque - robot.damping * state.joint_rates

    cargo = disturbance.cargo_mass(numbers, step, walk.time_step)
    push = disturbance.push(numbers, step, walk.time_step)
    # s (H qdd + c) = f has the accelerations of H qdd + c = f / s: no engine needs to know of mass_scale
    share = 1 / numbers.mass_scale
    acceleration = walk.forward_dynamics(
        state, left * share, held.force * share, push * share, cargo * share, jnp.asarray(numbers.gravity)
    )

    mass = cargo + robot.total_mass
    com = center_of_mass(robot, frames, state.base_position, cargo)
    net_force, net_moment = net_external_wrench(feet.position, held.force, state.base_position, push)
    # a gripper that cannot be torn off has no holding force to count on: the margins are then those of bare feet
    holding = jnp.where(jnp.isfinite(numbers.holding_limit), numbers.holding_limit, 0.0)
    sample = Sample(
        time=step * jnp.asarray(walk.time_step, com.dtype),
        base_position=state.base_position,
        base_orientation=state.base_orientation,
        base_linear_velocity=state.base_linear_velocity,
        base_angular_velocity=state.base_angular_velocity,
        base_linear_acceleration=acceleration.base_linear,
        base_angular_acceleration=acceleration.base_angular,
        joint_angles=state.joint_angles,
        joint_rates=state.joint_rates,
        joint_accelerations=acceleration.joints,
        joint_targets=joints.joint_angles,
        joint_torque=torque,
        foot_position=feet.position,
        foot_velocity=feet.velocity,
        foot_target=command.foot_position,
        foot_force=held.force,
        grip_point=contact.grip_point,
        support=held.support,
        contact=contact.touching,
        detached=carry.contact.detached,
        torn_off=held.torn_off,
        reachable=joints.reachable,
        base_reference=reference.base_position,
        base_displacement=command.base_displacement,
        base_wrench=wrench,
        push=push,
        cargo_mass=cargo,
        center_of_mass=com,
        tsm=tumble_stability_margin(
            feet.position, held.support, net_force, net_moment, mass, norm(numbers.gravity), holding
        ),
        gia_margin=gia_margin(feet.position, held.support, com, net_force, mass, holding),
    )
    posture = () if isinstance(last, tuple) else joints.joint_angles
    after = Carry(integrate(state, acceleration, walk.time_step), contact, memory, posture, law_state)
    # what all environments share (a gait of one timing, say) has a batch axis of one until here
    return jax.tree.map(lambda new, old: jnp.broadcast_to(new, old.shape), after, carry), sample
