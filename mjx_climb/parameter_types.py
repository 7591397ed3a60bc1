"""Gains and parameters: the numbers that may differ from one robot of a batch to the next."""
# ruff: noqa: RUF009 (fields carry their keys and units)

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import jax
import numpy as np
from jax import Array
from jaxtyping import PyTree, Real

from mjx_climb.arrays import AnyArray, namespace
from mjx_climb.component import Component

# batch axes of one gain need not be those of another: they broadcast
_Values = Array | np.ndarray
_Gain = Real[_Values, ""] | Real[_Values, "... 1"] | Real[_Values, "... 6"] | float
_JointGain = Real[_Values, "..."] | float
_Scalar = Real[_Values, "..."]
_Pushes = Real[_Values, "... pushes 3"]
_PushTimes = Real[_Values, "... pushes"]
ROUNDING = 2.0**-21  # of a number of steps: what single precision may be off
_TIMES = ("cycle", "cargo_start", "cargo_stop", "push_start", "push_stop", "control_period", "force_dead")


def _of(key: str | None, unit: str = "", long_name: str = "", default: object = dataclasses.MISSING) -> Any:
    """Return a field with the key of a scenario that it comes from; with a unit a sweep may run over it."""
    return dataclasses.field(metadata={"key": key, "unit": unit, "long_name": long_name}, default=default)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gains:
    """Gains of the admittance law (paper Eqs. 2 and 3): scalar, six axes, or a batch of six axes.

    Axes: three translations, then three rotations, about the axes of the walk (x ahead, z up). The end-effector law
    uses the translations. `kp`, `kd`, `ki` and `safe_kp` replace the scenario's joint gains where given.
    """

    AXES: ClassVar[Mapping[str, int]] = MappingProxyType({"inertia": 1, "damping": 1, "stiffness": 1})

    inertia: _Gain = _of("control.inertia", "kg, kg m^2", "virtual inertia M")
    damping: _Gain = _of("control.damping", "N s/m, N m s/rad", "virtual damping D")
    stiffness: _Gain = _of("control.stiffness", "N/m, N m/rad", "virtual stiffness K")
    kp: _JointGain | None = _of("control.kp", "N m/rad", "joint gain kp", default=None)
    kd: _JointGain | None = _of("control.kd", "N m s/rad", "joint gain kd", default=None)
    ki: _JointGain | None = _of("control.ki", "N m/(rad s)", "joint gain ki", default=None)
    safe_kp: _JointGain | None = _of("control.safe_kp", "N m/rad", "joint gain kp without a sensor", default=None)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Parameters:
    """Values of a scenario in SI units, each with any leading batch axes that broadcast with the gains'.

    Arrays of JAX, or of NumPy, which keep double precision whatever JAX's own setting.
    `AXES` tells how many axes one robot's value has, where it is no scalar.
    """

    AXES: ClassVar[Mapping[str, int]] = MappingProxyType(
        {"gravity": 1, "foothold_height": 2, "swing_path": 3, "force_dead": 1, "push_force": 2, "push_moment": 2,
         "push_start": 1, "push_stop": 1}
    )  # fmt: skip

    gravity: Real[_Values, "... 3"] = _of("gravity")  # (3,) m/s^2
    contact_stiffness: _Scalar = _of("contact.stiffness", "N/m", "contact stiffness")
    contact_damping: _Scalar = _of("contact.damping", "N s/m", "contact damping")
    rotational_stiffness: _Scalar = _of("contact.rotational_stiffness", "N m/rad", "turning stiffness of a grip")
    rotational_damping: _Scalar = _of("contact.rotational_damping", "N m s/rad", "turning damping of a grip")
    holding_limit: _Scalar = _of("contact.holding_limit", "N", "holding limit of a gripper")  # infinite: never torn off
    kp: _Scalar = _of("control.kp", "N m/rad", "joint gain kp")
    kd: _Scalar = _of("control.kd", "N m s/rad", "joint gain kd")
    ki: _Scalar = _of("control.ki", "N m/(rad s)", "joint gain ki")
    safe_kp: _Scalar = _of("control.safe_kp", "N m/rad", "joint gain kp without a sensor")
    stride: _Scalar = _of("gait.stride", "m", "stride")
    step_height: _Scalar = _of("gait.step_height", "m", "step height")
    cycle: _Scalar = _of("gait.cycle", "s", "gait cycle")
    duty: _Scalar = _of("gait.duty", "1", "duty")
    settling: _Scalar = _of("gait.settling", "1", "share of a swing in which the foot waits")
    height: _Scalar = _of("gait.height", "1", "height of the base as a share of the rest stance's")
    sway: _Scalar = _of("gait.sway", "1", "sway of the base")
    landing_speed: _Scalar = _of("gait.landing_speed", "m/s", "landing speed")
    heading: _Scalar = _of("gait.heading", "rad", "heading")
    foothold_height: Real[_Values, "... limbs N"] = _of(None)  # (limb, N) m, in order; N = 0: flat ground
    # (limb, 3, K) step heights, added to each swing; K = 0: nothing
    swing_path: Real[_Values, "... limbs 3 K"] = _of(None)
    cargo_mass: _Scalar = _of("disturbance.cargo.mass", "kg", "mass of the cargo")
    cargo_start: _Scalar = _of("disturbance.cargo.start", "s", "loading of the cargo")
    cargo_stop: _Scalar = _of("disturbance.cargo.stop", "s", "unloading of the cargo")
    push_force: _Pushes = _of("disturbance.pushes.force")  # (pushes, 3) N
    push_moment: _Pushes = _of("disturbance.pushes.moment")  # (pushes, 3) N m
    push_start: _PushTimes = _of("disturbance.pushes.start")  # (pushes,) s
    push_stop: _PushTimes = _of("disturbance.pushes.stop")  # (pushes,) s
    mass_scale: _Scalar = _of(None, "1", "scale of the robot's masses and inertias")  # the cargo's not
    capture_distance: _Scalar = _of("contact.capture_distance", "m", "reach of a gripper")  # infinite: any distance
    control_period: _Scalar = _of("hardware.control_period", "s", "control period")  # 0: the time step
    command_delay: _Scalar = _of("hardware.command_delay", "s", "delay of commands")
    force_delay: _Scalar = _of("hardware.force_sensor.delay", "s", "delay of the force sensors")
    force_noise: _Scalar = _of("hardware.force_sensor.noise", "N", "noise of the force sensors")
    force_bias: _Scalar = _of("hardware.force_sensor.bias", "N", "offset of the force sensors")
    force_resolution: _Scalar = _of("hardware.force_sensor.resolution", "N", "resolution of the force sensors")
    force_filter: _Scalar = _of("hardware.force_sensor.filter", "Hz", "cut-off of the force filter")  # infinite: none
    force_dead: Real[_Values, "... limbs"] = _of(None)  # (limb,) s, from when on the sensors read 0; infinite: never
    base_delay: _Scalar = _of("hardware.base_estimate.delay", "s", "delay of the base estimate")
    position_noise: _Scalar = _of("hardware.base_estimate.position_noise", "m", "noise of the base's position")
    velocity_noise: _Scalar = _of("hardware.base_estimate.velocity_noise", "m/s", "noise of the base's velocity")
    torque_limit: _Scalar = _of("hardware.servo.torque_limit", "N m", "torque limit")  # infinite: none
    no_load_speed: _Scalar = _of("hardware.servo.no_load_speed", "rad/s", "speed without load")  # infinite: none
    armature: _Scalar = _of("hardware.servo.armature", "kg m^2", "armature")  # beside what the robot's file says
    coulomb_friction: _Scalar = _of("hardware.servo.coulomb_friction", "N m", "dry friction")
    presliding: _Scalar = _of("hardware.servo.presliding", "rad", "bend before dry friction slips")
    viscous_friction: _Scalar = _of("hardware.servo.viscous_friction", "N m s/rad", "viscous friction")
    load_friction: _Scalar = _of("hardware.servo.load_friction", "1", "friction under load")
    external_load_friction: _Scalar = _of("hardware.servo.external_load_friction", "1", "friction under external load")
    stribeck_friction: _Scalar = _of("hardware.servo.stribeck_friction", "N m", "friction of standstill")
    stribeck_load_friction: _Scalar = _of("hardware.servo.stribeck_load_friction", "1", "load friction of standstill")
    stribeck_external_load_friction: _Scalar = _of(
        "hardware.servo.stribeck_external_load_friction", "1", "external load friction of standstill"
    )
    quadratic_load_friction: _Scalar = _of(
        "hardware.servo.quadratic_load_friction", "1/(N m)", "quadratic load friction"
    )
    quadratic_external_load_friction: _Scalar = _of(
        "hardware.servo.quadratic_external_load_friction", "1/(N m)", "quadratic external load friction"
    )
    stribeck_velocity: _Scalar = _of("hardware.servo.stribeck_velocity", "rad/s", "Stribeck velocity")
    stribeck_exponent: _Scalar = _of("hardware.servo.stribeck_exponent", "1", "Stribeck exponent")
    servo_rate: _Scalar = _of("hardware.servo.rate", "Hz", "rate of the servos' loop")  # infinite: every time step
    profile_velocity: _Scalar = _of("hardware.servo.profile_velocity", "rad/s", "velocity of goals")  # infinite: any
    profile_acceleration: _Scalar = _of("hardware.servo.profile_acceleration", "rad/s^2", "acceleration of goals")
    pwm_limit: _Scalar = _of("hardware.servo.pwm_limit", "1", "limit of PWM")
    current_limit: _Scalar = _of("hardware.servo.current_limit", "N m", "torque at the current limit")  # infinite: none
    rated_voltage: _Scalar = _of("hardware.servo.rated_voltage", "V", "rated voltage")  # infinite: the supply's
    supply_voltage: _Scalar = _of("hardware.servo.supply_voltage", "V", "supply voltage")  # infinite: the rated one
    backlash: _Scalar = _of("hardware.servo.backlash", "rad", "backlash")
    servo_delay: _Scalar = _of("hardware.servo.delay", "s", "delay of the servos")
    seed: _Scalar = _of("hardware.seed")  # whole, below 2^24 so that single precision holds it
    contact: PyTree = None  # a `Contact` in place of the gripper that the values above describe
    drive: PyTree = None  # an `Actuator` in place of the servos that the values above describe
    disturbances: PyTree = ()  # a tuple of `Disturbance`, beside cargo and pushes
    holds: PyTree = None  # `Holds`, the points that can be held; None: all of the ground
    footholds: PyTree = None  # `Footholds`, the choice among the holds; None: the planned ones
    recovery: PyTree = None  # `Recovery`; None: nothing interrupts the gait

    @property
    def numbers(self) -> dict[str, AnyArray]:
        """The values by name, without the components, which have values of their own."""
        return {name: value for name, value in vars(self).items() if name not in COMPONENTS}

    def with_components(self, change: Callable[[str, Component], Component]) -> "Parameters":
        """Parameters with each component replaced by what `change` makes of its place and itself."""
        changed = {place: change(place, each) for place, each in self.components.items()}
        others = tuple(changed[f"disturbances.{n}"] for n in range(len(self.disturbances)))
        single: dict[str, Any] = {name: each for name, each in changed.items() if name in COMPONENTS}
        return dataclasses.replace(self, **single, disturbances=others)

    @property
    def components(self) -> dict[str, Component]:
        """The components, as far as there are any, by their places: "contact", "disturbances.0"."""
        found = {f"disturbances.{n}": each for n, each in enumerate(self.disturbances)}
        single = [name for name in COMPONENTS if name != "disturbances"]
        return {name: each for name in single if (each := getattr(self, name)) is not None} | found


COMPONENTS = ("contact", "drive", "disturbances", "holds", "footholds", "recovery")
KEYS: dict[str, str] = {  # of a scenario, whose values and ranges these are
    field.name: field.metadata["key"] for field in dataclasses.fields(Parameters) if field.metadata.get("key")
}
# what a sweep may run over: units, long name
COORDINATES: dict[str, tuple[str, str]] = {
    field.name: (field.metadata["unit"], field.metadata["long_name"])
    for kind in (Gains, Parameters)
    for field in dataclasses.fields(kind)
    if field.metadata.get("unit")
}


def whole_steps(seconds: AnyArray, time_step: float) -> AnyArray:
    """Return the whole number of time steps nearest to each time in s, of two the larger; arrays of JAX or of NumPy.

    What lies below half a step by no more than the rounding of single precision counts as half a step.
    """
    steps = seconds / time_step + 0.5
    return namespace(steps).floor(steps + _slack(steps))


def stance_steps(duty: AnyArray, cycle_steps: AnyArray) -> AnyArray:
    """Return for how many steps of a cycle a limb stands: rounded up, so that limbs in turn never swing together."""
    steps = duty * cycle_steps
    return namespace(steps).ceil(steps - _slack(steps))


def _slack(steps: AnyArray) -> AnyArray:
    # rounding grows with the number of steps, and is never as much as an eighth of one
    return namespace(steps).minimum(steps * ROUNDING, 0.125)


def with_whole_steps(parameters: Parameters, time_step: float) -> Parameters:
    """Return parameters whose gait, windows and control period are whole time steps, counted in double precision.

    A walk in any precision finds the same numbers of steps in them. Values that JAX traces stay as they are.
    """
    known = {name: getattr(parameters, name) for name in (*_TIMES, "duty")}
    known = {n: np.asarray(v, np.float64) for n, v in known.items() if not isinstance(v, jax.core.Tracer)}
    steps = {name: whole_steps(known[name], time_step) for name in _TIMES if name in known}
    changed = {name: count * time_step for name, count in steps.items()}
    if "duty" in known and "cycle" in known:
        changed["duty"] = stance_steps(known["duty"], steps["cycle"]) / np.maximum(steps["cycle"], 1)
    return dataclasses.replace(parameters, **changed)
