"""One walk in the layout of the hot path: what happens in a step, in the order in which it happens."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.checks.stance import check_stance
from mjx_climb.compilation.contents import Unidentifiable, identity
from mjx_climb.compilation.forked import check_process
from mjx_climb.control import LAWS, Law, Reference, Start, running
from mjx_climb.dynamics import ENGINES, ForwardDynamics, checked_engine
from mjx_climb.dynamics.kinematics import (
    base_wrench_of_foot_force,
    center_of_mass,
    foot_kinematics,
    foot_turning,
    limb_frames,
)
from mjx_climb.dynamics.spatial import dot, norm, quaternion_to_matrix, rotate_back
from mjx_climb.dynamics.state import State, integrate
from mjx_climb.hardware.pace import pace as pace_of
from mjx_climb.hardware.stages import IDEAL, Stages, stages_of
from mjx_climb.quantities.parameters import Parameters, own_numbers
from mjx_climb.robot.constants import Robot, load_robot
from mjx_climb.scenario.model import RobotFile, Scenario
from mjx_climb.walk import control_loop, disturbance, gait
from mjx_climb.walk.action import Action
from mjx_climb.walk.contact import Attitude, Contact, Reach, grip
from mjx_climb.walk.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.walk.metrics import METRICS, Metric, MetricTable
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.stability import gia_margin, net_external_wrench, tumble_stability_margin


class Structure(NamedTuple):
    """What a compiled walk depends on, numbers and control law apart; hashable."""

    robot: str | RobotFile
    engine: str
    lift_off: tuple[tuple[str, float], ...]  # of each limb, as a share of the cycle
    base_reference: str
    steps: int
    time_step: float
    metrics: MetricTable = METRICS
    smooth: bool = False  # no gripper is torn off
    stages: Stages = IDEAL  # of hardware between law and joints
    in_pieces: bool = False  # steps are compiled in pieces, see `mjx_climb.compilation.cpu_pieces`
    own_code: str = ""  # digest of a law and of metrics of the user's own


class Walk(NamedTuple):
    """What stays the same from step to step."""

    robot: Robot
    numbers: Parameters
    grip_numbers: Parameters  # with an infinite holding limit where nothing is torn off
    plan: gait.Plan
    windows: disturbance.Windows
    controller: control_loop.Controller
    engine: Callable[[Robot], ForwardDynamics]
    drives: Robot  # as the engine takes it: with the armature of the drives
    cycle_start: Callable[[gait.Plan, gait.Schedule, Array, Array], tuple[Array, Array]]
    time_step: float


class Carry(NamedTuple):
    """What goes from one step to the next."""

    state: State
    contact: Contact
    gait: Array  # (3, B) m, what the gait remembers of the base
    law: running.Leaves
    hardware: control_loop.Memory


def structure(
    scenario: Scenario,
    engine: str,
    numbers: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    smooth: bool = False,
    in_pieces: bool = False,
) -> Structure:
    """Return what a compiled walk of the scenario depends on beside its law and its numbers: its own where None.

    With `smooth` the metrics have their smooth companions, and no gripper is torn off.

    Raises:
        ConfigError: no such engine, or a rest stance that is singular.
        RuntimeError: a process that was forked from one in which JAX had begun.
        ValueError: two metrics of one name.
    """
    check_process()
    check_stance(scenario)
    numbers = own_numbers(scenario) if numbers is None else numbers
    table = MetricTable(metrics)
    stages = _with_own_drives(stages_of(scenario, numbers), load_robot(scenario.robot))
    return Structure(
        robot=scenario.robot,
        engine=checked_engine(engine),
        lift_off=tuple(scenario.gait.lift_off.items()),
        base_reference=scenario.gait.base_reference,
        steps=scenario.steps,
        time_step=scenario.time_step,
        metrics=table.with_companions if smooth else table,
        smooth=smooth,
        stages=stages,
        in_pieces=in_pieces,
        own_code=_own_code(law, table),
    )


def _own_code(law: Law | None, metrics: MetricTable) -> str:
    """Return a digest of law and metrics that are not shipped: a global that they read may have changed since a trace.

    Empty without any, and where contents do not tell.
    """
    own: list[Any] = [metric for metric in metrics if metric not in METRICS]
    own += [] if law is None or type(law) in LAWS.values() else [type(law)]
    try:
        return identity(own) if own else ""
    except Unidentifiable:
        return ""


def prepare(structure: Structure, law: Law, numbers: Parameters, batch: int) -> Walk:
    """Return the walk of so many robots for a law with gains (..., B) and numbers (..., B).

    Every choice by name is made here, once.
    """
    dtype = numbers.kp.dtype
    constants = load_robot(structure.robot)
    held_turned = structure.stages.rotational
    robot, geometry = jax.tree.map(
        lambda value: jnp.asarray(value, dtype), (constants, limb_geometry(constants, held_turned))
    )
    stance = limb_frames(robot, quaternion_to_matrix(robot.stance_orientation), robot.stance_joints)
    feet = robot.stance_position[:, None] + stance.foot
    stages, time_step = structure.stages, structure.time_step
    pace = pace_of(numbers, stages, time_step)
    held = time_step * pace.period if stages.control_period else time_step
    drives = _with_armature(robot, jnp.asarray(numbers.armature)) if stages.armature else robot
    own = _with_drives_of(robot, numbers)
    unlimited = jnp.full_like(numbers.holding_limit, jnp.inf)
    plan = gait.plan(robot, feet, numbers, structure.lift_off, structure.time_step)
    begun = running.begin(law, Start(held, _first_reference(plan, batch)))
    return Walk(
        robot=weighing(robot, numbers.mass_scale),
        numbers=numbers,
        grip_numbers=dataclasses.replace(numbers, holding_limit=unlimited) if structure.smooth else numbers,
        plan=plan,
        windows=disturbance.windows(numbers, time_step),
        controller=control_loop.Controller(begun, geometry, own, stages, pace, time_step),
        engine=ENGINES[structure.engine],
        drives=drives,
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


def _grown(value: Array, batch: int) -> Array:
    """Return a value for every robot: of a law that each works out at its own steps."""
    return jnp.broadcast_to(value, jnp.broadcast_shapes(value.shape, (batch,)))


def weighing(robot: Robot, scale: Array | np.ndarray) -> Robot:
    """Return the robot with all masses and inertias times `scale` (B,)."""
    names = ("base_mass", "base_inertia", "link_mass", "link_inertia")
    return dataclasses.replace(robot, **{name: getattr(robot, name) * scale for name in names})


def _with_armature(robot: Robot, armature: Array) -> Robot:
    """Return the robot with `armature` (B,) or (N, L, B) kg m^2 more at its joints."""
    own: Any = jnp.zeros_like(robot.joint_lower) if robot.armature is None else robot.armature
    return dataclasses.replace(robot, armature=own + armature)


def _with_own_drives(stages: Stages, robot: Robot) -> Stages:
    """Return the stages with those that the joints in the robot's own file ask for."""
    return stages._replace(
        torque_limit=stages.torque_limit or robot.torque_limit is not None,
        dry_friction=stages.dry_friction or robot.friction is not None,
        viscous_friction=stages.viscous_friction or robot.damping is not None,
    )


def _with_drives_of(robot: Robot, numbers: Parameters) -> Parameters:
    """Return the numbers with what the robot's file says of its joints beside the scenario's, (N, L, B) where it does.

    A joint that nothing drives has no gains.
    """
    dry, viscous = jnp.asarray(numbers.coulomb_friction), jnp.asarray(numbers.viscous_friction)
    if robot.driven is not None:
        numbers = dataclasses.replace(numbers, kp=numbers.kp * robot.driven, kd=numbers.kd * robot.driven)
    if robot.torque_limit is not None:
        least = jnp.minimum(jnp.asarray(numbers.torque_limit), robot.torque_limit)
        numbers = dataclasses.replace(numbers, torque_limit=least)
    return dataclasses.replace(
        numbers,
        coulomb_friction=dry if robot.friction is None else dry + robot.friction,
        viscous_friction=viscous if robot.damping is None else viscous + robot.damping,
    )


def _lighter_drives(robot: Robot, scale: Array | np.ndarray) -> Robot:
    """Return the robot whose drives have their armature over `scale` (B,): the engine is given forces over it."""
    return robot if robot.armature is None else dataclasses.replace(robot, armature=robot.armature / scale)


def begin(walk: Walk, batch: int) -> Carry:
    """Return the rest stance with all grippers shut."""
    position, orientation, feet = _first_reference(walk.plan, batch)
    joints = _each(walk.robot.stance_joints, batch)
    if not gait.is_flat(walk.plan):
        rotation = quaternion_to_matrix(orientation)[:, :, None]
        target = rotate_back(rotation, feet - position[:, None])
        joints = inverse_kinematics(walk.controller.geometry, target).joint_angles
    shut = jnp.ones(feet.shape[1:], bool)
    still = jnp.zeros_like(position)
    stages, initial = walk.controller.stages, walk.controller.law.initial
    state = State(position, orientation, still, still, joints, jnp.zeros_like(joints))
    contact = Contact(feet, shut, ~shut, Reach(shut, ~shut) if stages.capture else ())
    if stages.rotational:
        frames = limb_frames(walk.robot, quaternion_to_matrix(orientation), joints)
        contact = contact._replace(attitude=Attitude(frames.rotation[-1], ~shut))
    return Carry(
        state=state,
        contact=contact,
        gait=position,
        law=[_grown(value, batch) for value in walk.controller.law.initial] if stages.control_period else initial,
        hardware=control_loop.start(state, feet, walk.controller),
    )


def advance(walk: Walk, carry: Carry, step: Array, action: Action = None) -> tuple[Carry, Sample]:
    """Return the walk one time step later, and all that is known about this step.

    `step` counts them, () or (B,). An action takes the place of the law, which then stays as it is.
    """
    robot, numbers, state = walk.robot, walk.numbers, carry.state
    rotation = quaternion_to_matrix(state.base_orientation)
    frames = limb_frames(robot, rotation, state.joint_angles)
    feet = foot_kinematics(robot, frames, state)

    now = gait.schedule(walk.plan, step)
    turning = foot_turning(robot, frames, state) if walk.controller.stages.rotational else None
    ground = gait.ground_height(walk.plan, now)
    contact, held = grip(carry.contact, feet, now.closed, ground, walk.grip_numbers, turning)
    wrench = base_wrench_of_foot_force(feet.lever, held.force)
    moment: Any = ()
    if turning is not None:
        moment = jnp.concatenate([jnp.zeros_like(wrench[:3]), held.moment.sum(1)])
        wrench = wrench + moment

    memory, cycle_start = walk.cycle_start(walk.plan, now, carry.gait, state.base_position)
    reference = Reference(
        base_position=gait.base_reference(walk.plan, now, cycle_start),
        base_orientation=walk.plan.base_orientation,
        foot_position=gait.foot_targets(walk.plan, now, contact.grip_point),
    )
    hardware, law_state, driven = control_loop.run(
        walk.controller,
        carry.hardware,
        carry.law,
        state,
        control_loop.Contacts(feet.lever, held.force, held.support, wrench, moment),
        reference,
        step,
        action,
    )

    cargo = disturbance.cargo_mass(numbers, walk.windows.cargo, step)
    push = disturbance.push(numbers, walk.windows.pushes, step)
    # the margins before the accelerations: a kernel then has registers for these
    mass = cargo + robot.total_mass
    com = center_of_mass(robot, frames, state.base_position, cargo)
    net_force, net_moment = net_external_wrench(wrench + push, state.base_position)
    # a gripper that cannot be torn off has no holding force to count on: the margins are then those of bare feet
    holding = jnp.where(jnp.isfinite(numbers.holding_limit), numbers.holding_limit, 0.0)
    tsm = tumble_stability_margin(
        feet.position, held.support, net_force, net_moment, mass, norm(numbers.gravity), holding
    )
    margin = gia_margin(feet.position, held.support, com, net_force, mass, holding)

    # s (H qdd + c) = f has the accelerations of H qdd + c = f / s: no engine needs to know of mass_scale
    share = 1 / numbers.mass_scale
    torque = driven.drive.joint_torque
    if robot.spring is not None and robot.spring_rest is not None:
        torque = torque - robot.spring * (state.joint_angles - robot.spring_rest)
    sticking = driven.drive.armature
    outside = push
    if turning is not None:
        torque = torque + jnp.stack([dot(axis, held.moment) for axis in turning.axes])
        outside = push + moment
    drives = _with_armature(walk.drives, sticking) if walk.controller.stages.dry_friction else walk.drives
    acceleration = walk.engine(_lighter_drives(drives, numbers.mass_scale))(
        state,
        torque * share,
        held.force * share,
        outside * share,
        cargo * share,
        jnp.asarray(numbers.gravity),
    )

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
        joint_targets=driven.joints.joint_angles,
        joint_torque=driven.drive.motor_torque,
        foot_position=feet.position,
        foot_velocity=feet.velocity,
        foot_target=driven.command.foot_position,
        foot_force=held.force,
        foot_moment=held.moment,
        grip_point=contact.grip_point,
        support=held.support,
        contact=contact.touching,
        detached=carry.contact.detached,
        torn_off=held.torn_off,
        missed=held.missed,
        reachable=driven.joints.reachable,
        base_reference=reference.base_position,
        base_displacement=driven.command.base_displacement,
        base_wrench=wrench,
        push=push,
        cargo_mass=cargo,
        center_of_mass=com,
        tsm=tsm,
        gia_margin=margin,
    )
    after = Carry(integrate(state, acceleration, walk.time_step), contact, memory, law_state, hardware)
    # what all environments share (a gait of one timing, say) has a batch axis of one until here
    after = jax.tree.map(lambda new, old: jnp.broadcast_to(new, old.shape), after, carry)
    if not contact.reach:  # nobody misses; said last, so that a step without it is cut into the same pieces
        sample = sample._replace(missed=jnp.zeros_like(held.support))
    if turning is None:
        sample = sample._replace(foot_moment=jnp.zeros_like(held.force))
    return after, sample
