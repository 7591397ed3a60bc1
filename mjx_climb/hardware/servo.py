"""The joints' servos: from the torque that the joint loop asks for to the one that turns the joint."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.hardware import delay, friction
from mjx_climb.hardware.backlash import across
from mjx_climb.hardware.stages import Stages
from mjx_climb.hardware.torque_limit import limited
from mjx_climb.quantities.parameters import Parameters

_NONE: Any = ()


class Servo(NamedTuple):
    """What the servos remember."""

    buffer: Any  # of torques (N, L, B) N m, newest first
    bristle: Any  # (N, L, B) 1, see `friction`


def start(rest: Array, stages: Stages) -> Servo:
    """Return servos without torque; `rest` is zero in the shape of the joints (N, L, B)."""
    return Servo(delay.start(rest, stages.servo_delay), rest if stages.dry_friction else ())


def target_across_play(target: Array, angles: Array, numbers: Parameters, stages: Stages) -> Array:
    """Return the target (N, L, B) rad that a joint at `angles` feels through its gears."""
    return angles + across(target - angles, jnp.asarray(numbers.backlash)) if stages.backlash else target


class Drive(NamedTuple):
    """What the servos do in a step."""

    motor_torque: Array  # (N, L, B) N m
    joint_torque: Array  # (N, L, B) N m, less friction
    armature: Any  # (N, L, B) kg m^2, what sticking joints have more of it in this step; () without dry friction


def driven(
    servo: Servo,
    torque: Array,
    rates: Array,
    numbers: Parameters,
    stages: Stages,
    weights: tuple[Array, ...],
    time_step: float,
) -> tuple[Servo, Drive]:
    """Return the servos after this step and what they do in it, asked for `torque` (N, L, B) N m."""
    buffer, bristle = servo
    if stages.servo_delay:
        buffer, torque = delay.delayed(buffer, torque, weights)
    if stages.torque_limit:
        torque = limited(torque, rates, jnp.asarray(numbers.torque_limit), jnp.asarray(numbers.no_load_speed))
    joint_torque, armature = torque, _NONE
    if stages.dry_friction:
        most = jnp.asarray(numbers.coulomb_friction) + jnp.asarray(numbers.load_friction) * jnp.abs(torque)
        bristle = friction.bent(bristle, rates, time_step)
        lost, armature = friction.dry(bristle, rates, most, time_step)
        joint_torque = joint_torque + lost
    if stages.viscous_friction:
        joint_torque = joint_torque + friction.viscous(rates, jnp.asarray(numbers.viscous_friction))
    return Servo(buffer, bristle), Drive(torque, joint_torque, armature)
