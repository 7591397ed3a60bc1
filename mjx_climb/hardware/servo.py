"""The joints' servos: from joint targets to the torque that turns the joint.

Dry friction is a bristle, a spring with a damper, that slips once it bears as much as the friction can (an elastic,
perfectly plastic element, also called Jenkin's, damped as LuGre's bristles are): a joint at rest does not creep. A
bristle that is not to ring is damped more than light links can bear in a step of explicit Euler. So what it bears in a
step is taken at the rates after the step: `(H + A) qdd = f - borne(rates before)` with `A = h dborne/drate` on the
joints' diagonal of H, where an armature is too. It then holds at any time step.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.dynamics.state import State
from mjx_climb.hardware import signals
from mjx_climb.hardware.stages import Hardware, Stages

PRESLIDING = 5e-4  # rad, bend at which a bristle slips: a third of a count of a servo's encoder of 4096 counts
RELAXATION = 5e-3  # s, damper over spring: close to the critical damping of a link of 1e-3 kg m^2 under 0.1 N m


class Servo(NamedTuple):
    """What the servos remember; empty where they have no such stage."""

    buffer: signals.Buffer  # of torques (limb, joint) N m
    bristle: Any  # (limb, joint) 1, see `dry_friction`


class Drive(NamedTuple):
    """What the servos do in a step."""

    motor_torque: Array  # (limb, joint) N m
    joint_torque: Array  # (limb, joint) N m, less friction
    armature: Any  # (limb, joint) kg m^2, what sticking joints have more of it in this step; () without dry friction


class JointGains(NamedTuple):
    """Gains of the joint loop in a step."""

    kp: Array  # () or (limb, joint) N m/rad
    kd: Array  # () or (limb, joint) N m s/rad


def begin(angles: Array, stages: Stages) -> Servo:
    """Return servos that have always rested at joint angles (limb, joint) rad."""
    no_torque = jnp.zeros_like(angles)
    return Servo((no_torque,) * stages.servo_delay, no_torque if stages.dry_friction else ())


def joint_loop(
    servo: Servo, targets: Array, state: State, gains: JointGains, hardware: Hardware
) -> tuple[Servo, Drive]:
    """Return the servos after this step and what they do in it, for joint targets (limb, joint) rad.

    The loop is `tau = kp (phi_des - phi) - kd phidot`: the desired rate is zero.
    """
    error = targets - state.joint_angles
    if hardware.stages.backlash:  # the motor rests at its target; the link is free to move by half the play either way
        play = hardware.parameters.backlash / 2
        error = error - jnp.clip(error, -play, play)
    return driven(servo, jnp.asarray(gains.kp * error - gains.kd * state.joint_rates), state.joint_rates, hardware)


def driven(servo: Servo, torque: Array, rates: Array, hardware: Hardware) -> tuple[Servo, Drive]:
    """Return the servos after this step and what they do in it, asked for `torque` (limb, joint) N m."""
    buffer, bristle = servo
    parameters, stages, time_step = hardware.parameters, hardware.stages, hardware.time_step
    if stages.servo_delay:
        buffer, torque = signals.delayed(buffer, torque, hardware.pace.servo)
    if stages.torque_limit:
        torque = limited(torque, rates, jnp.asarray(parameters.torque_limit), jnp.asarray(parameters.no_load_speed))
    joint_torque = torque
    armature: Any = ()
    if stages.dry_friction:
        # the gears rub under the torque that the motor gives, not under the one that it is asked for
        most = jnp.asarray(parameters.coulomb_friction + parameters.load_friction * jnp.abs(torque))
        bristle, lost, armature = dry_friction(bristle, rates, most, time_step)
        joint_torque = joint_torque + lost
    if stages.viscous_friction:
        joint_torque = joint_torque - parameters.viscous_friction * rates
    return Servo(buffer, bristle), Drive(torque, joint_torque, armature)


def limited(torque: Array, rate: Array, torque_limit: Array, no_load_speed: Array) -> Array:
    """Return the torque that the motor gives, N m, for the one that it is asked for.

    With the motion it falls to nothing at the no-load speed, rad/s, and brakes beyond it; against the motion it is
    limited alone. Infinite stands for no limit, and for the same limit at any speed.
    """
    slowness, limits = rate / no_load_speed, jnp.isfinite(torque_limit)
    bound = jnp.where(limits, torque_limit, 0.0)
    upper, lower = bound * jnp.clip(1 - slowness, -1.0, 1.0), -bound * jnp.clip(1 + slowness, -1.0, 1.0)
    return jnp.where(limits, jnp.clip(torque, lower, upper), torque)


def dry_friction(bristle: Array, rate: Array, most: Array, time_step: float) -> tuple[Array, Array, Array]:
    """Return the bristle after a step at `rate` rad/s, its torque, N m, and what it adds to the armature, kg m^2.

    The bristle is its bend as a share of `PRESLIDING`, -1 to 1; the friction can bear `most`, N m.
    """
    bristle = jnp.clip(bristle + rate * (time_step / PRESLIDING), -1.0, 1.0)
    slope = (RELAXATION + time_step) / PRESLIDING
    share = bristle + rate * slope
    armature = jnp.where(jnp.abs(share) < 1, most * (slope * time_step), 0.0)
    return bristle, -most * jnp.clip(share, -1.0, 1.0), armature
