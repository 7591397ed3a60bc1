"""One walk in the layout of the hot path: what happens in a step, in the order in which it happens."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.control import Law, Measurement, Reference, Start, running
from mjx_climb.control.joint_loop import joint_torque
from mjx_climb.dynamics import ENGINES, ForwardDynamics, checked_engine
from mjx_climb.dynamics.kinematics import base_wrench_of_foot_force, center_of_mass, foot_kinematics, limb_frames
from mjx_climb.dynamics.spatial import norm, quaternion_to_matrix, rotate_back
from mjx_climb.dynamics.state import State, integrate
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.robot.constants import Robot, load_robot
from mjx_climb.scenario.model import RobotFile, Scenario
from mjx_climb.walk import disturbance, gait
from mjx_climb.walk.action import Action, BaseShift, JointTargets
from mjx_climb.walk.contact import Contact, grip
from mjx_climb.walk.inverse_kinematics import LimbGeometry, inverse_kinematics, limb_geometry
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.stability import gia_margin, net_external_wrench, tumble_stability_margin


class Structure(NamedTuple):
    """What a compiled walk depends on, numbers and control law apart; hashable."""

    robot: str | RobotFile
    engine: str
    sequence: tuple[str, ...]
    base_reference: str
    steps: int
    time_step: float
    smooth: bool = False  # no gripper is torn off, and the metrics have smooth companions
    in_pieces: bool = False  # steps are compiled in pieces, see `mjx_climb.compilation.cpu_pieces`


class Walk(NamedTuple):
    """What stays the same from step to step."""

    robot: Robot
    geometry: LimbGeometry
    numbers: Parameters
    grip_numbers: Parameters  # with an infinite holding limit where nothing is torn off
    plan: gait.Plan
    law: running.Running
    forward_dynamics: ForwardDynamics
    cycle_start: Callable[[gait.Plan, gait.Schedule, Array, Array], tuple[Array, Array]]
    time_step: float


class Carry(NamedTuple):
    """What goes from one step to the next."""

    state: State
    contact: Contact
    gait: Array  # (3, B) m, what the gait remembers of the base
    law: running.Leaves


def structure(scenario: Scenario, engine: str, *, smooth: bool = False, in_pieces: bool = False) -> Structure:
    """Return what a compiled walk of the scenario depends on beside its numbers and its law.

    Raises:
        ConfigError: no such engine.
    """
    return Structure(
        robot=scenario.robot,
        engine=checked_engine(engine),
        sequence=scenario.gait.sequence,
        base_reference=scenario.gait.base_reference,
        steps=scenario.steps,
        time_step=scenario.time_step,
        smooth=smooth,
        in_pieces=in_pieces,
    )


def prepare(structure: Structure, law: Law, numbers: Parameters, batch: int) -> Walk:
    """Return the walk of so many robots for a law with gains (..., B) and numbers (..., B).

    Every choice by name is made here, once.
    """
    dtype = numbers.kp.dtype
    constants = load_robot(structure.robot)
    robot, geometry = jax.tree.map(lambda value: jnp.asarray(value, dtype), (constants, limb_geometry(constants)))
    stance = limb_frames(robot, quaternion_to_matrix(robot.stance_orientation), robot.stance_joints)
    feet = robot.stance_position[:, None] + stance.foot
    unlimited = jnp.full_like(numbers.holding_limit, jnp.inf)
    plan = gait.plan(robot, feet, numbers, structure.sequence, structure.time_step)
    return Walk(
        robot=weighing(robot, numbers.mass_scale),
        geometry=geometry,
        numbers=numbers,
        grip_numbers=dataclasses.replace(numbers, holding_limit=unlimited) if structure.smooth else numbers,
        plan=plan,
        law=running.begin(law, Start(structure.time_step, _first_reference(plan, batch))),
        forward_dynamics=ENGINES[structure.engine](robot),
        time_step=structure.time_step,
        cycle_start=gait.CYCLE_STARTS[structure.base_reference],
    )


def _first_reference(plan: gait.Plan, batch: int) -> Reference:
    """Return what the gait asks for at the start."""
    position = plan.base_start
    if not gait.is_flat(plan):
        position = position + gait.rise(plan, jnp.zeros(1))
    return Reference(*(_each(value, batch) for value in (position, plan.base_orientation, gait.first_footholds(plan))))


def _each(value: Array | np.ndarray, batch: int) -> Array:
    """Return a value (..., 1 or B) for every robot, (..., B)."""
    return jnp.broadcast_to(value, (*value.shape[:-1], batch))


def weighing(robot: Robot, scale: Array | np.ndarray) -> Robot:
    """Return the robot with all masses and inertias times `scale` (B,)."""
    names = ("base_mass", "base_inertia", "link_mass", "link_inertia")
    return dataclasses.replace(robot, **{name: getattr(robot, name) * scale for name in names})


def begin(walk: Walk, batch: int) -> Carry:
    """Return the rest stance with all grippers shut."""
    position, orientation, feet = _first_reference(walk.plan, batch)
    joints = _each(walk.robot.stance_joints, batch)
    if not gait.is_flat(walk.plan):
        rotation = quaternion_to_matrix(orientation)[:, :, None]
        joints = inverse_kinematics(walk.geometry, rotate_back(rotation, feet - position[:, None])).joint_angles
    shut = jnp.ones(feet.shape[1:], bool)
    still = jnp.zeros_like(position)
    return Carry(
        state=State(position, orientation, still, still, joints, jnp.zeros_like(joints)),
        contact=Contact(grip_point=feet, touching=shut, detached=~shut),
        gait=position,
        law=walk.law.initial,
    )


def advance(walk: Walk, carry: Carry, step: Array, action: Action = None) -> tuple[Carry, Sample]:
    """Return the walk one time step later, and all that is known about this step.

    `step` counts them, () or (B,). An action takes the place of the law, which then stays as it is.
    """
    robot, numbers, state = walk.robot, walk.numbers, carry.state
    rotation = quaternion_to_matrix(state.base_orientation)
    frames = limb_frames(robot, rotation, state.joint_angles)
    feet = foot_kinematics(frames, state)

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
    if action is None:
        law_state, command = walk.law.command(carry.law, measurement, reference)
    else:
        shift = action.displacement if isinstance(action, BaseShift) else jnp.zeros_like(wrench)
        law_state, command = carry.law, shifted_by(reference, shift)
    target_rotation = quaternion_to_matrix(command.base_orientation)
    target = rotate_back(target_rotation[:, :, None], command.foot_position - command.base_position[:, None])
    joints = inverse_kinematics(walk.geometry, target)
    joint_targets = action.angles if isinstance(action, JointTargets) else joints.joint_angles
    torque = joint_torque(numbers, joint_targets, state.joint_angles, state.joint_rates)

    cargo = disturbance.cargo_mass(numbers, step, walk.time_step)
    push = disturbance.push(numbers, step, walk.time_step)
    # s (H qdd + c) = f has the accelerations of H qdd + c = f / s: no engine needs to know of mass_scale
    share = 1 / numbers.mass_scale
    acceleration = walk.forward_dynamics(
        state, torque * share, held.force * share, push * share, cargo * share, jnp.asarray(numbers.gravity)
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
        joint_targets=joint_targets,
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
    after = Carry(integrate(state, acceleration, walk.time_step), contact, memory, law_state)
    # what all environments share (a gait of one timing, say) has a batch axis of one until here
    return jax.tree.map(lambda new, old: jnp.broadcast_to(new, old.shape), after, carry), sample
