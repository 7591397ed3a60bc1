"""The values of the components that a config has sections for: unit, bounds, default and meaning of each, once.

Sections of a config and the classes that walk are both made from these; nothing here needs JAX.
"""

from __future__ import annotations

import dataclasses
from math import inf, pi
from typing import TYPE_CHECKING, Any, dataclass_transform

from mjx_climb.value_field import (
    BELOW_ONE,
    FINITE,
    NONNEGATIVE,
    PART,
    POSITIVE,
    POSITIVE_OR_INFINITE,
    SHARE,
    UNLIMITED,
    parameter,
)

if TYPE_CHECKING:
    from jax import Array

_LENGTH = (POSITIVE[0], 100.0)  # m, of a step or a stride; 1


def value(unit: str, bounds: tuple[float, float], long_name: str, *, default: float, **more: Any) -> Any:
    """Return the field of a value, as `parameter` does."""
    return parameter(unit, bounds=bounds, default=default, long_name=long_name, **more)


def nonnegative(unit: str, long_name: str, *, default: float, **more: Any) -> Any:
    """Return the field of a value that is 0 or more."""
    return value(unit, NONNEGATIVE, long_name, default=default, **more)


def positive(unit: str, long_name: str, *, default: float, **more: Any) -> Any:
    """Return the field of a value above 0."""
    return value(unit, POSITIVE, long_name, default=default, **more)


def limit(unit: str, long_name: str, *, default: float, bounds: Any = POSITIVE_OR_INFINITE, **more: Any) -> Any:
    """Return the field of a limit; an infinite one is null in a config."""
    return value(unit, bounds, long_name, default=default, **more)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(value, nonnegative, positive, limit))
class Values:
    """Base of declarations: a subclass becomes a frozen dataclass."""

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "__dataclass_params__" not in vars(cls):  # a component has become one
            dataclasses.dataclass(frozen=True, eq=False)(cls)


class SpringGrip(Values):
    """A spring-damper between a gripped foot and its grip point."""

    stiffness: Array = positive("N/m", "contact stiffness per axis", default=1e4)
    damping: Array = nonnegative("N s/m", "contact damping per axis", default=20.0)
    rotational_stiffness: Array = nonnegative(
        "N m/rad", "stiffness of a grip against turning; 0: held as a point", default=0.0
    )
    rotational_damping: Array = nonnegative(
        "N m s/rad", "damping of a grip against turning; felt with a rotational_stiffness", default=0.0
    )
    capture_distance: Array = limit(
        "m", "reach of a gripper that shuts off the ground; null: any", default=inf, bounds=UNLIMITED
    )
    closing_time: Array = nonnegative(
        "s", "time in which a gripper off the ground closes two thirds of the gap; 0: at once", default=0.0
    )
    closing_force: Array = limit("N", "pull at which a closing gripper stalls; null: none", default=inf)


class Gripper(SpringGrip):
    """The gripper of the paper's Eq. 5."""

    holding_limit: Array = limit(
        "N",
        "holding limit of a gripper, which lets go of a stronger pull; null: never lets go",
        default=15.0,
        bounds=UNLIMITED,
    )


class JointLoop(Values):
    """Gains of the joint loop."""

    kp: Array = positive("N m/rad", "joint gain kp, proportional", default=50.0)
    kd: Array = nonnegative("N m s/rad", "joint gain kd, derivative", default=0.2)
    ki: Array = nonnegative("N m/(rad s)", "joint gain ki, integral; 0: no integral term", default=0.0)
    safe_kp: Array = positive("N m/rad", "joint gain kp without a sensor", default=50.0)


JOINT_GAINS = tuple(JointLoop.__annotations__)


class Recovery(Values):
    """Thresholds that interrupt the gait, and how it is interrupted."""

    shift: Array = limit("m", "shift of the base from its reference that interrupts the gait; null: none", default=inf)
    utilization: Array = limit("1", "predicted use of a grip that interrupts the gait; null: none", default=inf)
    margin: Array = value("m/s^2", UNLIMITED, "GIA margin that interrupts", default=0.0)
    lead_time: Array = nonnegative("s", "time ahead for which the pull of a grip is predicted", default=0.02)
    landing_time: Array = positive("s", "time in which a limb in the air comes down", default=0.25)
    rest_time: Array = nonnegative("s", "time at rest after a landing", default=1.2)
    take_over: Array = value("1", PART, "share of the base's shift that its reference takes over", default=0.3)
    return_time: Array = positive("s", "time in which the base reference goes back to its path", default=1.0)
    reach: Array = nonnegative("m", "how far beside itself a foot may land on ground that is all held", default=0.03)


class PeriodicGait(Values):
    """How far, how high and when the limbs swing."""

    stride: Array = value("m", (0.0, _LENGTH[1]), "stride, way of the base per cycle", default=0.05)
    step_height: Array = value("m", _LENGTH, "step height, of a swing foot's arc over the ground", default=0.03)
    cycle: Array = positive("s", "gait cycle; a whole number of time steps", default=4.0, in_steps=True)
    duty: Array = value(
        "1", (POSITIVE[0], BELOW_ONE), "duty, share of the cycle that each limb is gripped", default=0.75
    )
    settling: Array = value(
        "1", SHARE, "share of a swing, at its end, in which the foot waits for the gripper to shut", default=0.0
    )
    height: Array = value(
        "1", _LENGTH, "height of the base over its feet, as a share of that in the rest stance", default=1.0
    )
    sway: Array = value(
        "1",
        SHARE,
        "sway of the base in mid-swing, as a share of the way to the centroid of the other feet",
        default=0.0,
    )
    landing_speed: Array = nonnegative("m/s", "landing speed, along the ground's normal", default=0.0)
    heading: Array = value(
        "rad", (-2 * pi, 2 * pi), "heading, direction of walking and initial yaw about world z", default=0.0
    )


class Waiting(Values):
    """How often a foot that does not hold tries again."""

    retries: Array = value("1", (0.0, 100.0), "landings on a hold after the first", default=1.0, whole=True)
    other_holds: Array = value("1", (0.0, 100.0), "other holds that are tried then", default=2.0, whole=True)
    reach: Array = nonnegative(
        "m", "how far from its foothold the farthest other one is on ground that is all held", default=0.03
    )


class Cargo(Values):
    """A point mass at the base's centre of mass."""

    mass: Array = nonnegative("kg", "mass of the cargo; 0: none", default=0.0)
    start: Array = nonnegative("s", "loading of the cargo", default=2.0, in_steps=True)
    stop: Array = limit(
        "s", "unloading of the cargo; null: stays until the end", default=inf, bounds=UNLIMITED, in_steps=True
    )


class Push(Values):
    """A constant wrench on the base."""

    force: Array = value("N", FINITE, "force of the push on the base, world axes", default=0.0, shape=(3,))
    moment: Array = value("N m", FINITE, "moment of the push on the base, world axes", default=0.0, shape=(3,))
    start: Array = nonnegative("s", "start of the push", default=0.0, in_steps=True)
    stop: Array = limit("s", "end of the push; null: that of the walk", default=inf, bounds=UNLIMITED, in_steps=True)


class Bus(Values):
    """The bus between law and joints, and the seed of all noise."""

    control_period: Array = nonnegative(
        "s",
        "control period, of law and joint targets; a whole number of time steps; 0: the time step",
        default=0.0,
        in_steps=True,
    )
    command_delay: Array = nonnegative("s", "delay of commands from the law to the joints", default=0.0)
    # below 2^24 single precision holds every whole number
    seed: Array = value("1", (0.0, 2.0**24 - 1), "seed of all noise; equal seeds, equal noise", default=0.0, whole=True)


class ForceSensors(Values):
    """The force sensors of the feet."""

    delay: Array = nonnegative("s", "delay of the force sensors", default=0.0)
    noise: Array = nonnegative(
        "N", "white noise of the force sensors, standard deviation per axis and sample", default=0.0
    )
    bias: Array = value("N", FINITE, "offset of the force sensors on every world axis", default=0.0)
    drift: Array = nonnegative(
        "N/sqrt(s)",
        "drift of the force sensors, per axis: standard deviation of the random walk after 1 s",
        default=0.0,
    )
    resolution: Array = nonnegative("N", "smallest step that the force sensors tell; 0: any", default=0.0)
    filter: Array = limit("Hz", "cut-off of the first-order force filter; null: none", default=inf)


class BaseEstimate(Values):
    """The law's knowledge of the base's pose and rates."""

    delay: Array = nonnegative("s", "delay of the base's pose and rates", default=0.0)
    position_noise: Array = nonnegative(
        "m", "white noise of the base's position, standard deviation per axis", default=0.0
    )
    velocity_noise: Array = nonnegative(
        "m/s", "white noise of the base's velocity, standard deviation per axis", default=0.0
    )


class Servos(Values):
    """The joints' motors and gears, all alike."""

    torque_limit: Array = limit("N m", "torque limit at standstill; null: none", default=inf)
    no_load_speed: Array = limit("rad/s", "speed without load, at which no torque is left; null: any", default=inf)
    # armature and friction beside those of the robot's file
    armature: Array = nonnegative("kg m^2", "armature, inertia of motor and gears seen at the joint", default=0.0)
    coulomb_friction: Array = nonnegative("N m", "dry friction", default=0.0)
    presliding: Array = positive(
        "rad", "bend of a joint before dry friction slips; a third of a count of 4096 a turn", default=5e-4
    )
    viscous_friction: Array = nonnegative("N m s/rad", "viscous friction", default=0.0)
    load_friction: Array = nonnegative("1", "dry friction as a share of the motor's torque", default=0.0)
    external_load_friction: Array = nonnegative("1", "dry friction as a share of the load's torque", default=0.0)
    stribeck_friction: Array = nonnegative("N m", "dry friction at standstill beside coulomb_friction", default=0.0)
    stribeck_load_friction: Array = nonnegative("1", "load_friction at standstill beside that", default=0.0)
    stribeck_external_load_friction: Array = nonnegative(
        "1", "external_load_friction at standstill beside that", default=0.0
    )
    quadratic_load_friction: Array = nonnegative(
        "1/(N m)", "standstill friction by the motor's torque squared, where the load drives", default=0.0
    )
    quadratic_external_load_friction: Array = nonnegative(
        "1/(N m)", "standstill friction by the load's torque squared, where the motor drives", default=0.0
    )
    stribeck_velocity: Array = positive(
        "rad/s", "Stribeck velocity, by which friction of standstill fell to 37 %", default=0.1
    )
    stribeck_exponent: Array = positive("1", "Stribeck exponent, how suddenly it falls there", default=1.0)
    rate: Array = limit(
        "Hz",
        "rate of the servos' own loop; its period is a whole number of time steps; null: every time step",
        default=inf,
    )
    profile_velocity: Array = limit(
        "rad/s", "speed at which a servo takes its goal to the joint target; null: at once", default=inf
    )
    profile_acceleration: Array = limit("rad/s^2", "acceleration of that goal; null: any", default=inf)
    pwm_limit: Array = value("1", PART, "largest share of the supply voltage that a voltage drive gives", default=1.0)
    current_limit: Array = limit(
        "N m", "torque at the largest current that the servo lets flow; null: any", default=inf
    )
    rated_voltage: Array = limit(
        "V", "voltage of torque_limit, no_load_speed and the loop's gains; null: the supply's", default=inf
    )
    supply_voltage: Array = limit(
        "V", "measured voltage, by which torque_limit and no_load_speed scale; null: rated_voltage", default=inf
    )
    supply_resistance: Array = nonnegative(
        "Ohm", "resistance between supply_voltage and servo, which makes it sag; 0: none", default=0.0
    )
    backlash: Array = nonnegative("rad", "backlash, play of the gears from end to end", default=0.0)
    delay: Array = nonnegative("s", "delay from the joint loop to the motor's torque", default=0.0)
