"""The joints' servos: from joint targets to the torque that turns the joint.

A servo's loop is a PID, evaluated at its own rate. Its output is a torque, which the motor gives up to its
torque-speed line, or a share of the supply voltage (PWM), less the back EMF.

Dry friction bears up to a bound (`friction_bound`) by a bristle, a spring with a damper, that slips once it bears as
much as the friction can (an elastic, perfectly plastic element, also called Jenkin's, damped as LuGre's bristles are):
a joint at rest does not creep. A bristle that is not to ring is damped more than light links can bear in a step of
explicit Euler. So friction in a step is taken at the rates after the step: `(H + A) qdd = f - borne(rates
before)` with `A = h dborne/drate` on the joints' diagonal of H, where an armature is too. It then holds at any time
step.

References:
    M. Duclusaud, G. Passault, V. Padois, O. Ly, Extended Friction Models for the Physics Simulation of Servo Actuators,
    2024: models M1 to M6 of the bound; its program is github.com/Rhoban/bam.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.arrays import AnyArray
from mjx_climb.hardware import bus as signals
from mjx_climb.hardware.actuator import Actuator, ActuatorGains, Drive, Joints
from mjx_climb.hardware.stages import Hardware, Stages
from mjx_climb.scenario import declared

RELAXATION = 5e-3  # s, damper over spring: close to the critical damping of a link of 1e-3 kg m^2 under 0.1 N m


class Loop(NamedTuple):
    """Memory of the joint loop; None where it has no such stage."""

    goal: Array | None = None  # (limb, joint) rad, on its way to the joint targets
    goal_rate: Array | None = None  # (limb, joint) rad/s
    integral: Array | None = None  # (limb, joint) rad s, of the error
    # (limb, joint) N m, the loop's last output, and () time steps since then
    asked: tuple[Array, Array] | None = None


class Servo(NamedTuple):
    """Memory of the servos; empty, or None, where they have no such stage."""

    buffer: signals.Buffer  # of torques (limb, joint) N m
    bristle: Array | None  # (limb, joint) 1, see `dry_friction`
    loop: Loop = Loop()
    load: Array | None = None  # (limb, joint) N m, torque of the load on the joints in this step


def gains_of(hardware: Hardware) -> ActuatorGains:
    """Return the gains of the joint loop that the hardware's parameters have."""
    loop = hardware.parameters.joint_loop
    return ActuatorGains(*(jnp.asarray(getattr(loop, name)) for name in ActuatorGains._fields))


class Servos(declared.Servos, Actuator):
    """The joints' motors and gears, all alike.

    `drive`: the joint loop asks for a "torque", or a share of the supply "voltage".
    A limit, a speed, a rate or a voltage that is infinite is none.
    """

    KIND = "servo"

    drive: str = "torque"
    in_registers: bool = False  # gains are held as shares of the torque at standstill, and follow it
    # the hardware that a walk is set up with
    hardware: Hardware | None = dataclasses.field(default=None, metadata={"tree": True})

    @property
    def feels_load(self) -> bool:
        """Whether the servos' friction depends on the load."""
        return self._set_up.stages.load_torque

    def init(self, angles: Array) -> Servo:
        """The memory of servos that have always rested at joint angles (limb, joint) rad, under no torque."""
        return begin(angles, self._set_up.stages)

    def step(
        self, memory: Servo, targets: Array, gains: ActuatorGains, joints: Joints, period: float
    ) -> tuple[Servo, Drive]:
        """The servos after a step, and their torques in it: see `joint_loop`."""
        memory = memory if joints.load is None else memory._replace(load=joints.load)
        return joint_loop(memory, targets, joints, gains, self._set_up)

    @property
    def _set_up(self) -> Hardware:
        if self.hardware is None:
            raise ValueError("Servos: expected servos that a walk has set up")
        return self.hardware


def begin(angles: Array, stages: Stages) -> Servo:
    """Return servos that have always rested at joint angles (limb, joint) rad, under no torque."""
    none = jnp.zeros_like(angles)
    loop = Loop(
        goal=angles if stages.profile else None,
        goal_rate=none if stages.profile else None,
        integral=none if stages.integral else None,
        asked=(none, jnp.zeros_like(angles, shape=())) if stages.servo_rate else None,
    )
    load = none if stages.load_torque else None
    return Servo((none,) * stages.servo_delay, none if stages.dry_friction else None, loop, load)


def joint_loop(
    servo: Servo, targets: Array, joints: Joints, gains: ActuatorGains, hardware: Hardware
) -> tuple[Servo, Drive]:
    """The servos after this step and their torques in it, for joint targets (limb, joint) rad.

    The loop is `tau = kp (phi_des - phi) + ki int(phi_des - phi) - kd phidot`: the desired rate is zero, D acts on the
    measured rate. A voltage drive takes `tau` over the stall torque for its share of the voltage.
    """
    before = servo.loop
    loop, asked = pid(before, targets, joints, gains, hardware)
    if before.asked is not None and hardware.pace.servo_period is not None:
        last, age = before.asked
        loop, asked = signals.held(age == 0, (loop, asked), (before, last))
        age = age + 1
        loop = loop._replace(asked=(asked, jnp.where(age < hardware.pace.servo_period - 0.5, age, 0.0)))
    return driven(servo._replace(loop=loop), asked, joints.rates, hardware)


def pid(loop: Loop, targets: Array, joints: Joints, gains: ActuatorGains, hardware: Hardware) -> tuple[Loop, Array]:
    """The loop once evaluated, and its output, (limb, joint) N m, before the motor's limits."""
    stages, servos, period = hardware.stages, hardware.parameters.drive, hardware.servo_period
    if loop.goal is not None and loop.goal_rate is not None:
        fastest = jnp.asarray(servos.profile_velocity), jnp.asarray(servos.profile_acceleration)
        targets, goal_rate = profiled(loop.goal, loop.goal_rate, targets, *fastest, period)
        loop = loop._replace(goal=targets, goal_rate=goal_rate)
    error = targets - joints.angles
    if stages.backlash:  # the motor rests at its target; the link is free to move by half the play either way
        play = servos.backlash / 2
        error = error - jnp.clip(error, -play, play)
    asked = jnp.asarray(gains.kp * error - gains.kd * joints.rates)
    if loop.integral is None:
        return loop, asked
    integral = loop.integral + period * error
    wanted = asked + gains.ki * integral
    # no wind-up: an output on its limit does not grow
    stuck = (jnp.abs(wanted) > largest_output(hardware)) & (wanted * error > 0)
    integral = jnp.where(stuck, loop.integral, integral)
    return loop._replace(integral=integral), asked + gains.ki * integral


def largest_output(hardware: Hardware) -> Array:
    """Return where the loop's output is cut, () or (limb, joint) N m: by PWM, or by current and torque limit."""
    servos = hardware.parameters.drive
    limit = jnp.asarray(servos.torque_limit)
    if hardware.stages.voltage:
        return jnp.asarray(limit * servos.pwm_limit)
    return jnp.minimum(limit, servos.current_limit)


def profiled(
    goal: Array, rate: Array, target: Array, velocity: Array, acceleration: Array, period: float | Array
) -> tuple[Array, Array]:
    """Return a goal, rad, and its rate, rad/s, after a period in s on a trapezoid to a target that may move.

    Its rate is at most the one from which it can still stop at the target: `v (v + a h) = 2 a d`, a way d in steps h.
    """
    way = target - goal
    far, some = jnp.abs(way), jnp.isfinite(acceleration)
    change = jnp.where(some, acceleration, 1.0) * period
    stopping = (jnp.sqrt(change**2 + 8 * change / period * far) - change) / 2
    most = jnp.minimum(jnp.minimum(velocity, far / period), jnp.where(some, stopping, jnp.inf))
    wanted = jnp.sign(way) * most
    rate = jnp.where(some, rate + jnp.clip(wanted - rate, -change, change), wanted)
    return goal + period * rate, rate


def driven(servo: Servo, torque: Array, rates: Array, hardware: Hardware) -> tuple[Servo, Drive]:
    """The servos after this step and their torques in it, asked for `torque` (limb, joint) N m."""
    buffer, bristle = servo.buffer, servo.bristle
    servos, stages, time_step = hardware.parameters.drive, hardware.stages, hardware.time_step
    if stages.servo_delay:
        buffer, torque = signals.delayed(buffer, torque, hardware.pace.servo)
    if stages.voltage:
        torque = voltage_driven(torque, rates, servos, sags=stages.supply_resistance)
    elif stages.torque_limit:
        torque = limited(torque, rates, jnp.asarray(servos.torque_limit), jnp.asarray(servos.no_load_speed))
    if stages.current_limit:
        torque = jnp.clip(torque, -servos.current_limit, servos.current_limit)
    joint_torque = torque
    armature = jnp.broadcast_to(servos.armature, torque.shape) if stages.armature else None
    if bristle is not None and stages.dry_friction:
        # the gears rub under the torque that the motor gives, not under the one that it is asked for
        most = friction_bound(torque, servo.load, rates, hardware)
        bristle, lost, stuck = dry_friction(bristle, rates, most, jnp.asarray(servos.presliding), time_step)
        armature = stuck if armature is None else armature + stuck
        joint_torque = joint_torque + lost
    if stages.viscous_friction:
        joint_torque = joint_torque - servos.viscous_friction * rates
    return servo._replace(buffer=buffer, bristle=bristle), Drive(torque, joint_torque, armature)


def voltage_driven(asked: Array, rate: Array, servos: Servos, *, sags: bool = False) -> Array:
    """Return the torque, N m, of motors on a share of the supply voltage: the torque asked for over that at stall.

    `kt / R V - kt^2 / R phidot`, with the stall torque `kt V / R` and the speed without load `V / kt`; no inductance.
    A supply that sags has `V = V_0 - R_0 u i` at a share u of the voltage and a current i of the motor.
    """
    stall = jnp.asarray(servos.torque_limit)
    most = stall * servos.pwm_limit
    driving = jnp.clip(asked, -most, most)
    if sags:
        # R_0 / R, with R = V_0^2 / (stall torque times speed without load); no torque at standstill: it is off
        resistance = servos.supply_resistance * stall * servos.no_load_speed / servos.supply_voltage**2
        share = driving / jnp.where(stall > 0, stall, 1.0)
        driving = driving * (1 + resistance * share * rate / servos.no_load_speed) / (1 + resistance * share**2)
    return driving - stall / servos.no_load_speed * rate


def limited(torque: Array, rate: Array, torque_limit: Array, no_load_speed: Array) -> Array:
    """Return the torque that the motor gives, N m, for the one that it is asked for.

    With the motion it falls to nothing at the no-load speed, rad/s, and brakes beyond it; against the motion it is
    limited alone. Infinite stands for no limit, and for the same limit at any speed.
    """
    # the torque-speed line of a DC motor
    slowness, limits = rate / no_load_speed, jnp.isfinite(torque_limit)
    bound = jnp.where(limits, torque_limit, 0.0)
    upper, lower = bound * jnp.clip(1 - slowness, -1.0, 1.0), -bound * jnp.clip(1 + slowness, -1.0, 1.0)
    return jnp.where(limits, jnp.clip(torque, lower, upper), torque)


def friction_bound(torque: Array, load: Array | None, rate: Array, hardware: Hardware) -> Array:
    """Return the bound of dry friction, N m, under the motor's torque and that of the load, at a rate.

    The gears carry `|k_e load - k_m torque|` of the two, which have opposite signs where one holds the other; the
    there is at standstill alone falls as `exp(-|rate / velocity|^exponent)` (M1 to M6 of Duclusaud et al.).
    """
    stages, p = hardware.stages, hardware.parameters.drive

    def geared(of_motor: AnyArray, of_load: AnyArray) -> Array:
        return of_motor * jnp.abs(torque) if load is None else jnp.abs(of_load * load - of_motor * torque)

    most = jnp.asarray(p.coulomb_friction + geared(p.load_friction, p.external_load_friction))
    if not stages.stribeck:
        return most
    still = p.stribeck_friction + geared(p.stribeck_load_friction, p.stribeck_external_load_friction)
    if load is not None:
        weaker = jnp.abs(load) < jnp.abs(torque)  # the motor drives, and the load resists
        square = jnp.where(weaker, p.quadratic_external_load_friction * load**2, p.quadratic_load_friction * torque**2)
        still = still + jnp.where(load * torque < 0, square, 0.0)
    slowness = jnp.abs(rate) / p.stribeck_velocity
    moves = slowness > 0  # a power has no derivative at zero
    fallen = jnp.exp(-jnp.where(moves, jnp.where(moves, slowness, 1.0) ** p.stribeck_exponent, 0.0))
    return jnp.asarray(most + still * fallen)


def dry_friction(
    bristle: Array, rate: Array, most: Array, presliding: Array, time_step: float
) -> tuple[Array, Array, Array]:
    """Return the bristle after a step at `rate` rad/s, its torque, N m, and its addition to the armature, kg m^2.

    The bristle is its bend as a share of `presliding`, rad, -1 to 1; the friction can bear `most`, N m.
    """
    # the torque is that after the step, linear in the rate: its slope times the step is an armature (see above)
    bristle = jnp.clip(bristle + rate * (time_step / presliding), -1.0, 1.0)
    slope = (RELAXATION + time_step) / presliding
    share = bristle + rate * slope
    armature = jnp.where(jnp.abs(share) < 1, most * (slope * time_step), 0.0)
    return bristle, -most * jnp.clip(share, -1.0, 1.0), armature
