"""A robot that carries out joint commands: its base held and its limbs in the air, or all of its grippers shut."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.arrays import AnyArray
from mjx_climb.hardware.stages import Stages, hardware_of
from mjx_climb.parameter_types import Parameters
from mjx_climb.robot.constants import Robot
from mjx_climb.walk.control_loop import JointTargets
from tuning.identification.model import held_base as stands
from tuning.identification.readers.log import COMMANDS


class Commands(NamedTuple):
    """The commands of each time step."""

    sent: stands.Sent  # (steps, ...) of a held base as it reaches the servos, else targets alone, as they are sent
    rates: stands.Sent  # of these over time
    delay: AnyArray  # (steps,) s, with which all of them reach the servos


class Carried(NamedTuple):
    """The motion of each time step."""

    angles: AnyArray  # (steps, limb, joint) rad
    rates: AnyArray  # (steps, limb, joint) rad/s
    torque: AnyArray  # (steps, limb, joint) N m, of the motors
    force: AnyArray  # (steps, limb, 3) N, of the ground on the feet


Simulate = Callable[..., Carried]  # pure, of one robot, of a `Robot`, `Parameters` and `Commands`


@functools.cache
def in_batch(simulate: Simulate) -> Simulate:
    """Return the compiled simulation of a batch of commands."""
    return jax.jit(jax.vmap(simulate, (None, None, 0)))


@functools.cache
def held(stages: Stages, time_step: float, kind: str = COMMANDS[0]) -> Simulate:
    """Return the motion of a robot whose base is held, from rest at angles (limb, joint) or at the first targets.

    Its commands are of a kind of `COMMANDS`. Its dry friction comes `lead` s before the rate, see
    `tuning.identification.model.held_base`.
    """

    def one_step(
        robot: Robot, parameters: Parameters, lead: Any, moving: stands.Moving, now: Commands
    ) -> tuple[stands.Moving, Carried]:
        late = parameters.bus.command_delay - now.delay
        sent: stands.Sent = jax.tree.map(lambda value, rate: value - late * rate, now.sent, now.rates)
        hardware = hardware_of(parameters, stages, time_step, robot)
        stand = stands.Stand(execution.of_limbs(robot), hardware, lead, kind)
        after, seen = stands.advance(stands.with_gains(stand, sent), moving, sent.targets)
        return after, Carried(*seen, jnp.zeros_like(robot.foot_center))

    fast = execution.over_robots(one_step)

    def carried_out(
        robot: Robot, parameters: Parameters, commands: Commands, begin: Array | None = None, lead: Any = 0.0
    ) -> Carried:
        first = jnp.asarray(commands.sent.targets[0] if begin is None else begin)
        stand = stands.Stand(robot, hardware_of(parameters, stages, time_step, robot))
        start = stands.begin(stand, first, jnp.zeros_like(first))
        return jax.lax.scan(functools.partial(fast, robot, parameters, lead), start, commands)[1]

    return carried_out


def swaying(scenario: mc.Scenario, duration: float) -> mc.Scenario:
    """Return a scenario in which the robot stands still on all feet for a time, s: its gait comes to no swing."""
    limbs = scenario.limbs
    gait = scenario.gait.model_dump(mode="json") | {
        "stride": 0.0, "cycle": math.ceil(10 * duration / scenario.time_step) * scenario.time_step, "duty": 0.95,
        "phases": {limb: 0.2 + 0.08 * n for n, limb in enumerate(limbs)},
    }  # fmt: skip
    changes = {"gait": gait, "disturbance.cargo.mass": 0.0, "disturbance.pushes": [], "control.controller": "pd"}
    return scenario.with_overrides(changes | {"control.reading": "virtual_model"})


@functools.cache
def standing(scenario: mc.Scenario, stages: Stages) -> Simulate:
    """Return the motion of the scenario's own robot, of `swaying`; the given robot is ignored."""
    simulation = mc.Simulation(scenario)

    def one_step(state: mc.simulation.SimulationState, target: Array) -> tuple[Any, Carried]:
        state, sample = simulation.step(state, JointTargets(target))
        return state, Carried(sample.joint_angles, sample.joint_rates, sample.joint_torque, sample.foot_force)

    def carried_out(_: Robot, parameters: Parameters, commands: Commands) -> Carried:
        start = simulation.reset(None, parameters, stages=stages)
        return jax.lax.scan(one_step, start, commands.sent.targets)[1]

    return carried_out
