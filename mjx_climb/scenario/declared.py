"""The values of the components that a config has sections for: unit, bounds, default and meaning of each, once.

Sections of a config and the classes that walk are both made from these; nothing here needs JAX.
"""

from __future__ import annotations

import dataclasses
import math
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


def value(
    unit: str, bounds: tuple[float, float], long_name: str, meaning: str = "", *, default: float, **more: Any
) -> Any:
    """Return the field of a value, as `parameter` does."""
    return parameter(unit, bounds=bounds, default=default, long_name=long_name, meaning=meaning, **more)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(value,))
class Values:
    """Base of declarations: a subclass becomes a frozen dataclass."""

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "__dataclass_params__" not in vars(cls):  # a component has become one
            dataclasses.dataclass(frozen=True, eq=False)(cls)


class SpringGrip(Values):
    """A spring-damper between a gripped foot and its grip point."""

    stiffness: Array = value("N/m", POSITIVE, "contact stiffness", "contact stiffness per axis", default=1e4)
    damping: Array = value("N s/m", NONNEGATIVE, "contact damping", "contact damping per axis", default=20.0)
    rotational_stiffness: Array = value(
        "N m/rad", NONNEGATIVE, "turning stiffness of a grip",
        "stiffness of a grip against turning; 0: a foot is held as a point", default=0.0,
    )  # fmt: skip
    rotational_damping: Array = value(
        "N m s/rad", NONNEGATIVE, "turning damping of a grip",
        "damping of a grip against turning; felt with a rotational_stiffness", default=0.0,
    )  # fmt: skip
    capture_distance: Array = value(
        "m", UNLIMITED, "reach of a gripper",
        "how far off the ground a foot may be for its shutting gripper to hold; null: any distance", default=math.inf,
    )  # fmt: skip
    closing_time: Array = value(
        "s", NONNEGATIVE, "closing time of a gripper",
        "time in which a gripper that shuts off the ground closes two thirds of the gap; 0: at once", default=0.0,
    )  # fmt: skip
    closing_force: Array = value(
        "N", POSITIVE_OR_INFINITE, "closing force of a gripper",
        "pull at which a closing gripper stalls; null: none", default=math.inf,
    )  # fmt: skip


class Gripper(SpringGrip):
    """The gripper of the paper's Eq. 5."""

    holding_limit: Array = value(
        "N", UNLIMITED, "holding limit of a gripper",
        "force above which a pulled gripper lets go; null: grippers never let go", default=15.0,
    )  # fmt: skip


class JointLoop(Values):
    """Gains of the joint loop."""

    kp: Array = value("N m/rad", POSITIVE, "joint gain kp", "proportional gain of the joint loop", default=50.0)
    kd: Array = value("N m s/rad", NONNEGATIVE, "joint gain kd", "derivative gain of the joint loop", default=0.2)
    ki: Array = value(
        "N m/(rad s)", NONNEGATIVE, "joint gain ki", "integral gain of the joint loop; 0: no integral term", default=0.0
    )
    safe_kp: Array = value("N m/rad", POSITIVE, "joint gain kp without a sensor", default=50.0)


class Recovery(Values):
    """Thresholds that interrupt the gait, and how it is interrupted."""

    shift: Array = value(
        "m", POSITIVE_OR_INFINITE, "shift of the base that interrupts",
        "shift of the base from its reference that interrupts the gait; null: none", default=math.inf,
    )  # fmt: skip
    utilization: Array = value(
        "1", POSITIVE_OR_INFINITE, "use of a grip that interrupts",
        "predicted pull of a grip, over its holding limit, that does; null: none", default=math.inf,
    )  # fmt: skip
    margin: Array = value("m/s^2", UNLIMITED, "GIA margin that interrupts", default=0.0)
    lead_time: Array = value(
        "s", NONNEGATIVE, "time until the predicted use",
        "time ahead for which the pull of a grip is predicted", default=0.02,
    )  # fmt: skip
    landing_time: Array = value(
        "s", POSITIVE, "time of a landing", "time in which a limb in the air comes down", default=0.25
    )
    rest_time: Array = value(
        "s", NONNEGATIVE, "time at rest after a landing", "time for which the gait then stands still", default=1.2
    )
    take_over: Array = value(
        "1", PART, "share of a shift that is taken over",
        "share of the base's shift that its reference takes over", default=0.3,
    )  # fmt: skip
    return_time: Array = value(
        "s", POSITIVE, "time of the base's return",
        "time in which the base reference goes back to its path", default=1.0,
    )  # fmt: skip
    reach: Array = value(
        "m", NONNEGATIVE, "how far beside itself a foot may land",
        "how far beside itself a foot may land on ground that is all held", default=0.03,
    )  # fmt: skip


class PeriodicGait(Values):
    """How far, how high and when the limbs swing."""

    stride: Array = value("m", (0.0, _LENGTH[1]), "stride", "way of the base per cycle", default=0.05)
    step_height: Array = value(
        "m", _LENGTH, "step height", "height of a swing foot's arc over the ground", default=0.03
    )
    cycle: Array = value(
        "s", POSITIVE, "gait cycle", "period of the gait; a whole number of time steps", default=4.0, in_steps=True
    )
    duty: Array = value(
        "1", (POSITIVE[0], BELOW_ONE), "duty", "share of the cycle that each limb is gripped", default=0.75
    )
    settling: Array = value(
        "1", SHARE, "share of a swing in which the foot waits",
        "share of a swing, at its end, in which the foot waits over its new foothold for the gripper to shut",
        default=0.0,
    )  # fmt: skip
    height: Array = value(
        "1", _LENGTH, "height of the base as a share of the rest stance's",
        "height of the base over its feet, as a share of that in the rest stance", default=1.0,
    )  # fmt: skip
    sway: Array = value(
        "1", SHARE, "sway of the base",
        "share of the way to the centroid of the other feet that the base sways in the middle of each swing",
        default=0.0,
    )  # fmt: skip
    landing_speed: Array = value(
        "m/s", NONNEGATIVE, "landing speed", "speed along the ground's normal at which a swing ends", default=0.0
    )
    heading: Array = value(
        "rad", (-2 * math.pi, 2 * math.pi), "heading", "direction of walking and initial yaw about world z", default=0.0
    )


class Waiting(Values):
    """How often a foot that does not hold tries again."""

    retries: Array = value(
        "1", (0.0, 100.0), "landings on a hold after the first",
        "how often a foot that does not hold goes to the same hold again", default=1.0, whole=True,
    )  # fmt: skip
    other_holds: Array = value(
        "1", (0.0, 100.0), "other holds that are tried", "how many other holds it tries then", default=2.0, whole=True
    )
    reach: Array = value(
        "m", NONNEGATIVE, "how far from its foothold another one is",
        "how far from its foothold the farthest other one is on ground that is all held", default=0.03,
    )  # fmt: skip


class Cargo(Values):
    """A point mass at the base's centre of mass."""

    mass: Array = value("kg", NONNEGATIVE, "mass of the cargo", "mass; 0: no cargo", default=0.0)
    start: Array = value("s", NONNEGATIVE, "loading of the cargo", "time of loading", default=2.0, in_steps=True)
    stop: Array = value(
        "s", UNLIMITED, "unloading of the cargo",
        "time of unloading; null: stays until the end", default=math.inf, in_steps=True,
    )  # fmt: skip


class Push(Values):
    """A constant wrench on the base."""

    force: Array = value("N", FINITE, "force of the push", "force on the base, world axes", default=0.0, shape=(3,))
    moment: Array = value(
        "N m", FINITE, "moment of the push", "moment on the base, world axes", default=0.0, shape=(3,)
    )
    start: Array = value("s", NONNEGATIVE, "start of the push", "first instant", default=0.0, in_steps=True)
    stop: Array = value(
        "s", UNLIMITED, "end of the push", "last instant; null: until the end", default=math.inf, in_steps=True
    )


class Bus(Values):
    """The bus between law and joints, and the seed of all noise."""

    control_period: Array = value(
        "s", NONNEGATIVE, "control period",
        "period of law and joint targets; a whole number of time steps; 0: the time step", default=0.0, in_steps=True,
    )  # fmt: skip
    command_delay: Array = value("s", NONNEGATIVE, "delay of commands", "from the law to the joints", default=0.0)
    # below 2^24 single precision holds every whole number
    seed: Array = value(
        "1", (0.0, 2.0**24 - 1), "seed of all noise", "of all noise; equal seeds, equal noise", default=0.0, whole=True
    )


class ForceSensors(Values):
    """The force sensors of the feet."""

    delay: Array = value("s", NONNEGATIVE, "delay of the force sensors", "age of what the law reads", default=0.0)
    noise: Array = value(
        "N", NONNEGATIVE, "noise of the force sensors",
        "white noise, standard deviation per axis and sample", default=0.0,
    )  # fmt: skip
    bias: Array = value(
        "N", FINITE, "offset of the force sensors", "offset on every axis of every sensor, world axes", default=0.0
    )
    drift: Array = value(
        "N/sqrt(s)", NONNEGATIVE, "drift of the force sensors",
        "random walk of the offset per axis, from 0 at the start: standard deviation after 1 s", default=0.0,
    )  # fmt: skip
    resolution: Array = value(
        "N", NONNEGATIVE, "resolution of the force sensors", "smallest step that the sensor tells; 0: any", default=0.0
    )
    filter: Array = value(
        "Hz", POSITIVE_OR_INFINITE, "cut-off of the force filter",
        "first-order low pass, cut-off; null: none", default=math.inf,
    )  # fmt: skip


class BaseEstimate(Values):
    """The law's knowledge of the base's pose and rates."""

    delay: Array = value("s", NONNEGATIVE, "delay of the base estimate", "age of pose and rates", default=0.0)
    position_noise: Array = value(
        "m", NONNEGATIVE, "noise of the base's position", "white noise, standard deviation per axis", default=0.0
    )
    velocity_noise: Array = value(
        "m/s", NONNEGATIVE, "noise of the base's velocity", "white noise, standard deviation per axis", default=0.0
    )


class Servos(Values):
    """The joints' motors and gears, all alike."""

    torque_limit: Array = value(
        "N m", POSITIVE_OR_INFINITE, "torque limit", "torque at standstill; null: any", default=math.inf
    )
    no_load_speed: Array = value(
        "rad/s", POSITIVE_OR_INFINITE, "speed without load",
        "speed at which no torque is left; null: the torque limit holds at any speed", default=math.inf,
    )  # fmt: skip
    # armature and friction beside those of the robot's file
    armature: Array = value(
        "kg m^2", NONNEGATIVE, "armature", "inertia of motor and gears seen at the joint", default=0.0
    )
    coulomb_friction: Array = value("N m", NONNEGATIVE, "dry friction", default=0.0)
    presliding: Array = value(
        "rad", POSITIVE, "bend before dry friction slips",
        "how far a joint that dry friction holds gives before it slips; a third of a count of 4096 a turn",
        default=5e-4,
    )  # fmt: skip
    viscous_friction: Array = value(
        "N m s/rad", NONNEGATIVE, "viscous friction", "friction that grows with the rate", default=0.0
    )
    load_friction: Array = value(
        "1", NONNEGATIVE, "friction under load", "dry friction as a share of the motor's torque", default=0.0
    )
    external_load_friction: Array = value(
        "1", NONNEGATIVE, "friction under external load", "dry friction as a share of the load's torque", default=0.0
    )
    stribeck_friction: Array = value(
        "N m", NONNEGATIVE, "friction of standstill", "dry friction at standstill beside coulomb_friction", default=0.0
    )
    stribeck_load_friction: Array = value(
        "1", NONNEGATIVE, "load friction of standstill", "load_friction at standstill beside that", default=0.0
    )
    stribeck_external_load_friction: Array = value(
        "1", NONNEGATIVE, "external load friction of standstill",
        "external_load_friction at standstill beside that", default=0.0,
    )  # fmt: skip
    quadratic_load_friction: Array = value(
        "1/(N m)", NONNEGATIVE, "quadratic load friction",
        "friction at standstill by the motor's torque squared, where the load drives", default=0.0,
    )  # fmt: skip
    quadratic_external_load_friction: Array = value(
        "1/(N m)", NONNEGATIVE, "quadratic external load friction",
        "friction at standstill by the load's torque squared, where the motor drives", default=0.0,
    )  # fmt: skip
    stribeck_velocity: Array = value(
        "rad/s", POSITIVE, "Stribeck velocity", "speed by which friction of standstill fell to 37 %", default=0.1
    )
    stribeck_exponent: Array = value("1", POSITIVE, "Stribeck exponent", "how suddenly it falls there", default=1.0)
    rate: Array = value(
        "Hz", POSITIVE_OR_INFINITE, "rate of the servos' loop",
        "rate of the servo's own loop; a period is a whole number of time steps; null: every time step",
        default=math.inf,
    )  # fmt: skip
    profile_velocity: Array = value(
        "rad/s", POSITIVE_OR_INFINITE, "velocity of goals",
        "speed at which the servo takes its goal to the joint target; null: at once", default=math.inf,
    )  # fmt: skip
    profile_acceleration: Array = value(
        "rad/s^2", POSITIVE_OR_INFINITE, "acceleration of goals",
        "acceleration of that goal; null: any", default=math.inf,
    )  # fmt: skip
    pwm_limit: Array = value(
        "1", PART, "limit of PWM", "largest share of the supply voltage that a voltage drive gives", default=1.0
    )
    current_limit: Array = value(
        "N m", POSITIVE_OR_INFINITE, "torque at the current limit",
        "torque of the motor at the largest current that the servo lets flow; null: any", default=math.inf,
    )  # fmt: skip
    rated_voltage: Array = value(
        "V", POSITIVE_OR_INFINITE, "rated voltage",
        "voltage of torque_limit, no_load_speed and the loop's gains; null: the supply's", default=math.inf,
    )  # fmt: skip
    supply_voltage: Array = value(
        "V", POSITIVE_OR_INFINITE, "supply voltage",
        "measured voltage, by which torque_limit and no_load_speed scale; null: rated_voltage", default=math.inf,
    )  # fmt: skip
    supply_resistance: Array = value(
        "Ohm", NONNEGATIVE, "resistance of the supply",
        "resistance between supply_voltage and servo: the voltage sags under the motor's current; 0: it does not",
        default=0.0,
    )  # fmt: skip
    backlash: Array = value("rad", NONNEGATIVE, "backlash", "play of the gears from end to end", default=0.0)
    delay: Array = value(
        "s", NONNEGATIVE, "delay of the servos", "from the joint loop to the motor's torque", default=0.0
    )
