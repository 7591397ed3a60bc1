"""Which stages of hardware a walk has, decided once before it is compiled, and what they need of its parameters."""

import dataclasses
from collections.abc import Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_climb.hardware.bus import Buffer, buffer_length, period_steps, weights
from mjx_climb.parameter_types import Parameters
from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.model import Scenario

DELAYED = ("force", "base", "command", "servo")
_QUADRATIC = ("quadratic_load_friction", "quadratic_external_load_friction")
_STRIBECK = ("stribeck_friction", "stribeck_load_friction", "stribeck_external_load_friction", *_QUADRATIC)
_OF_LOAD = ("external_load_friction", "stribeck_external_load_friction", *_QUADRATIC)


class Stages(NamedTuple):
    """The stages that a walk has; lengths of buffers in samples, 0 without one. Static: a walk is compiled for them."""

    force_delay: int = 0
    force_noise: bool = False
    force_bias: bool = False
    force_resolution: bool = False
    force_filter: bool = False
    force_dead: bool = False
    sampled_filter: bool = False  # the law filters what it samples
    base_delay: int = 0
    base_noise: bool = False
    control_period: bool = False
    linear: bool = False  # joint targets move linearly between two periods
    command_delay: int = 0
    servo_delay: int = 0
    servo_rate: bool = False
    profile: bool = False
    integral: bool = False
    voltage: bool = False  # the servos' loops give shares of the supply voltage
    supply_voltage: bool = False
    torque_limit: bool = False
    current_limit: bool = False
    armature: bool = False
    dry_friction: bool = False
    stribeck: bool = False
    load_torque: bool = False  # the servos' friction depends on the torque of the load
    viscous_friction: bool = False
    backlash: bool = False
    capture: bool = False
    rotational: bool = False  # grips transmit moments
    height: bool = False  # the base stands higher or lower than in the rest stance
    sway: bool = False
    landing_speed: bool = False

    @property
    def force(self) -> bool:
        """Whether the law reads other foot forces than act."""
        chain = self.force_delay, self.force_noise, self.force_bias, self.force_resolution, self.force_filter
        return any((*chain, self.force_dead))

    @property
    def silent_sensors(self) -> bool:
        """Whether a force sensor of a foot that bears something may read nothing."""
        return self.force_dead or self.force_resolution


IDEAL = Stages()


def stages_of(
    scenario: Scenario, parameters: Parameters, robot: Robot | None = None, moving: Collection[str] = ()
) -> Stages:
    """Return the stages that some robot of a batch needs; buffers are as long as the longest delay needs.

    The parameters named in `moving` have their stages whatever their values, as derivatives along them need.

    Raises:
        ValueError: motors on a voltage without a torque at standstill or a speed without load.
        TypeError: parameters that JAX traces, by which nothing can be decided: see `stages_under_trace`.
    """
    for name, value in parameters.numbers.items():
        if isinstance(value, jax.core.Tracer):
            raise TypeError(f"parameters.{name}: expected an array, got one that JAX traces")
    step, voltage = scenario.time_step, scenario.hardware.servo.drive == "voltage"
    for name in ("torque_limit", "no_load_speed") if voltage else ():
        if not np.isfinite(np.asarray(getattr(parameters, name))).all():
            raise ValueError(f"parameters.{name}: expected finite numbers with drive: voltage, got inf")
    limited, dry, viscous = (
        robot is not None and getattr(robot, name) is not None for name in ("torque_limit", "friction", "damping")
    )

    def some(*names: str) -> bool:
        """Return whether a parameter of these is not zero for some robot."""
        return any(name in moving or given(getattr(parameters, name)) for name in names)

    def finite(name: str) -> bool:
        return name in moving or bool(np.any(np.isfinite(np.asarray(getattr(parameters, name)))))

    def length(name: str) -> int:
        return buffer_length(np.maximum(getattr(parameters, name), step if name in moving else 0.0), step)

    filtered, by_law = finite("force_filter"), scenario.hardware.force_sensor.filtered_by == "law"
    simple = "force_noise force_bias force_resolution control_period armature backlash sway landing_speed".split()
    found = {name: some(name) for name in simple}
    found |= {name: finite(name) for name in ("force_dead", "servo_rate", "supply_voltage")}
    return Stages(
        **found,
        force_delay=length("force_delay"),
        base_delay=length("base_delay"),
        command_delay=length("command_delay"),
        servo_delay=length("servo_delay"),
        force_filter=filtered and not by_law,
        sampled_filter=filtered and by_law,
        base_noise=some("position_noise", "velocity_noise"),
        linear=found["control_period"] and scenario.hardware.interpolation == "linear",
        profile=finite("profile_velocity"),
        integral=some("ki"),
        voltage=voltage,
        torque_limit=limited or finite("torque_limit"),
        current_limit=(voltage and limited) or finite("current_limit"),
        dry_friction=dry or some("coulomb_friction", "load_friction", *_OF_LOAD, *_STRIBECK),
        stribeck=some(*_STRIBECK),
        load_torque=some(*_OF_LOAD),
        viscous_friction=viscous or some("viscous_friction"),
        capture=finite("capture_distance"),
        rotational=some("rotational_stiffness"),
        height="height" in moving or given(np.asarray(parameters.height) - 1),
    )


def lacking(stages: Stages, asked: Stages) -> bool:
    """Return whether a stage that is asked for is missing."""
    return any(wanted and not there for there, wanted in zip(stages, asked, strict=True))


def given(value: ArrayLike) -> bool:
    """Return whether any number of an array is not zero."""
    return bool(np.any(np.asarray(value) != 0))


class Pace(NamedTuple):
    """What is computed once of a robot's delays, filter and control period; empty, or None, without such a stage."""

    force: Buffer  # weights of the samples, see `signals.weights`
    base: Buffer
    command: Buffer
    servo: Buffer
    filter_share: Array | None  # () 1
    period: Array | None  # () time steps
    servo_period: Array | None  # () time steps


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Hardware:
    """The hardware of one robot: what it is compiled for, and its parameters."""

    parameters: Parameters  # those of joints are (), or (limb, joint) where the robot's file says something of them
    pace: Pace
    stages: Stages = dataclasses.field(metadata={"static": True})
    time_step: float = dataclasses.field(metadata={"static": True})  # s

    @property
    def law_period(self) -> float | Array:
        """Time from one step of the law to the next, s."""
        return self.time_step * self.pace.period if self.pace.period is not None else self.time_step

    @property
    def servo_period(self) -> float | Array:
        """Time from one evaluation of the servos' loops to the next, s."""
        return self.time_step * self.pace.servo_period if self.pace.servo_period is not None else self.time_step


def hardware_of(parameters: Parameters, stages: Stages, time_step: float, robot: Robot | None = None) -> Hardware:
    """Return the hardware of a robot; what its file says of its joints comes beside the scenario's parameters.

    Frictions add up, the lower torque limit holds, and a joint that nothing drives has no gains.
    """
    period = share = servo_period = None
    if stages.control_period:
        period = period_steps(jnp.asarray(parameters.control_period), time_step)
    if stages.force_filter or stages.sampled_filter:
        sampled = time_step if period is None or not stages.sampled_filter else time_step * period
        # what a first-order filter takes in of an input held over a period: 1 - exp(-2 pi f h)
        share = -jnp.expm1(-2 * jnp.pi * sampled * parameters.force_filter)
    late: dict[str, Buffer] = {}
    for part in DELAYED:
        length, seconds = getattr(stages, f"{part}_delay"), getattr(parameters, f"{part}_delay")
        late[part] = weights(jnp.asarray(seconds) / time_step, length) if length else ()
    if stages.servo_rate:
        servo_period = period_steps(1 / jnp.asarray(parameters.servo_rate), time_step)
    pace = Pace(**late, filter_share=share, period=period, servo_period=servo_period)
    parameters = _at_supply_voltage(parameters, stages)
    # under a voltage the torque limit is the motor's own, at standstill
    limit, stall = ("current_limit", "torque_limit") if stages.voltage else ("torque_limit", "")
    for name, own, combined in (
        ("kp", "driven", jnp.multiply), ("kd", "driven", jnp.multiply), ("ki", "driven", jnp.multiply),
        ("safe_kp", "driven", jnp.multiply), (stall, "driven", jnp.multiply), (limit, "torque_limit", jnp.minimum),
        ("coulomb_friction", "friction", jnp.add), ("viscous_friction", "damping", jnp.add),
    ):  # fmt: skip
        if name and robot is not None and getattr(robot, own) is not None:
            changed = combined(getattr(parameters, name), getattr(robot, own))
            parameters = dataclasses.replace(parameters, **{name: changed})
    return Hardware(parameters, pace, stages, time_step)


def _at_supply_voltage(parameters: Parameters, stages: Stages) -> Parameters:
    """Return parameters with what motors give and how fast they are at the supply voltage in place of the rated one.

    A loop that gives a share of the voltage has gains in N m/rad that grow with it, one that asks for torques does not.
    """
    if not stages.supply_voltage:
        return parameters
    known = jnp.isfinite(parameters.supply_voltage) & jnp.isfinite(parameters.rated_voltage)
    supply, rated = (jnp.where(known, getattr(parameters, f"{name}_voltage"), 1.0) for name in ("supply", "rated"))
    names = ("torque_limit", "no_load_speed", *(("kp", "kd", "ki", "safe_kp") if stages.voltage else ()))
    scaled = {name: getattr(parameters, name) * (supply / rated) for name in names}
    return dataclasses.replace(parameters, **scaled)
