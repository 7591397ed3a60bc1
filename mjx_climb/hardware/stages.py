"""Which stages of hardware a walk has, decided once before it is compiled, and constants of them."""

import dataclasses
from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import given
from mjx_climb.hardware.bus import Buffer, buffer_length, period_steps, weights
from mjx_climb.parameter_types import SECTIONS, Parameters
from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.declared import JOINT_GAINS

_SERVO = SECTIONS["drive"]
# by the names of buffers: the path of their delay
DELAYED = {
    "force": "hardware.force_sensor.delay",
    "base": "hardware.base_estimate.delay",
    "command": "hardware.command_delay",
    "servo": f"{_SERVO}.delay",
}
_QUADRATIC = ("quadratic_load_friction", "quadratic_external_load_friction")
_STRIBECK = ("stribeck_friction", "stribeck_load_friction", "stribeck_external_load_friction", *_QUADRATIC)
_OF_LOAD = ("external_load_friction", "stribeck_external_load_friction", *_QUADRATIC)


class Stages(NamedTuple):
    """The stages that a walk has; lengths of buffers in samples, 0 without one. Static: a walk is compiled for them."""

    joint_effort: bool = False  # forces are those of the joints' efforts
    force_along_normal: bool = False  # along z alone
    force_delay: int = 0
    force_drift: bool = False
    force_noise: bool = False
    force_bias: bool = False
    force_resolution: bool = False
    force_filter: bool = False
    force_dead: bool = False
    sampled_filter: bool = False  # the law filters its samples
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
    supply_resistance: bool = False  # it sags under load
    torque_limit: bool = False
    current_limit: bool = False
    armature: bool = False
    dry_friction: bool = False
    stribeck: bool = False
    load_torque: bool = False  # the servos' friction depends on the torque of the load
    viscous_friction: bool = False
    backlash: bool = False
    height: bool = False  # the base stands higher or lower than in the rest stance
    sway: bool = False
    landing_speed: bool = False

    @property
    def force(self) -> bool:
        """Whether the law reads other foot forces than act."""
        chain = self.force_delay, self.force_noise, self.force_bias, self.force_resolution, self.force_filter
        return any((*chain, self.joint_effort, self.force_along_normal, self.force_drift, self.force_dead))

    @property
    def silent_sensors(self) -> bool:
        """Whether a force sensor of a foot that bears something may read nothing."""
        return self.force_dead or self.force_resolution


IDEAL = Stages()


def stages_of(
    parameters: Parameters, time_step: float, robot: Robot | None = None, moving: Collection[str] = ()
) -> Stages:
    """Return the stages that some robot of a batch needs; buffers are as long as the longest delay needs.

    The values at the paths `moving` always have their stages, as derivatives along them need.

    Raises:
        ValueError: motors on a voltage without a torque at standstill or a speed without load.
        TypeError: parameters that JAX traces, which cannot decide: see `stages_under_trace`.
    """
    values = parameters.values
    for path, value in values.items():
        if isinstance(value, jax.core.Tracer):
            raise TypeError(f"parameters.{path}: expected an array, got one that JAX traces")
    voltage = getattr(parameters.drive, "drive", "torque") == "voltage"
    for path in (f"{_SERVO}.torque_limit", f"{_SERVO}.no_load_speed") if voltage else ():
        if not np.isfinite(np.asarray(values[path])).all():
            raise ValueError(f"parameters.{path}: expected finite numbers with drive: voltage, got inf")
    servos = f"{_SERVO}.torque_limit" in values  # joints that something else drives have no servos' stages
    limited, dry, viscous = (
        servos and robot is not None and getattr(robot, name) is not None
        for name in ("torque_limit", "friction", "damping")
    )

    def some(*paths: str) -> bool:
        """Return whether a value is not zero for some robot."""
        return any(path in moving or given(values.get(path, 0.0)) for path in paths)

    def finite(path: str) -> bool:
        return path in moving or bool(np.any(np.isfinite(np.asarray(values.get(path, np.inf)))))

    def length(path: str) -> int:
        delay = np.asarray(values.get(path, 0.0))
        return buffer_length(np.maximum(delay, time_step if path in moving else 0.0), time_step)

    def of_servo(*names: str) -> list[str]:
        return [f"{_SERVO}.{name}" for name in names]

    force, period = "hardware.force_sensor", some("hardware.control_period")
    filtered, by_law = finite(f"{force}.filter"), parameters.force_sensor.filtered_by == "law"
    return Stages(
        joint_effort=parameters.force_sensor.source == "joint_effort",
        force_along_normal=parameters.force_sensor.axes == "z",
        force_drift=some(f"{force}.drift"),
        force_delay=length(f"{force}.delay"),
        force_noise=some(f"{force}.noise"),
        force_bias=some(f"{force}.bias"),
        force_resolution=some(f"{force}.resolution"),
        force_filter=filtered and not by_law,
        force_dead=finite(f"{force}.dead"),
        sampled_filter=filtered and by_law,
        base_delay=length("hardware.base_estimate.delay"),
        base_noise=some("hardware.base_estimate.position_noise", "hardware.base_estimate.velocity_noise"),
        control_period=period,
        linear=period and parameters.bus.interpolation == "linear",
        command_delay=length("hardware.command_delay"),
        servo_delay=length(f"{_SERVO}.delay"),
        servo_rate=finite(f"{_SERVO}.rate"),
        profile=finite(f"{_SERVO}.profile_velocity"),
        integral=some("control.ki"),
        voltage=voltage,
        supply_voltage=finite(f"{_SERVO}.supply_voltage"),
        supply_resistance=some(f"{_SERVO}.supply_resistance"),
        torque_limit=limited or finite(f"{_SERVO}.torque_limit"),
        current_limit=(voltage and limited) or finite(f"{_SERVO}.current_limit"),
        armature=servos and some(f"{_SERVO}.armature"),
        dry_friction=dry or some(*of_servo("coulomb_friction", "load_friction", *_OF_LOAD, *_STRIBECK)),
        stribeck=some(*of_servo(*_STRIBECK)),
        load_torque=some(*of_servo(*_OF_LOAD)),
        viscous_friction=viscous or some(f"{_SERVO}.viscous_friction"),
        backlash=some(f"{_SERVO}.backlash"),
        height="gait.height" in moving or given(np.asarray(parameters.gait.height) - 1),
        sway=some("gait.sway"),
        landing_speed=some("gait.landing_speed"),
    )


def lacking(stages: Stages, asked: Stages) -> bool:
    """Return whether a stage that is asked for is missing."""
    return any(wanted and not there for there, wanted in zip(stages, asked, strict=True))


class Pace(NamedTuple):
    """Constants of a robot's delays, filter and control period; empty, or None, without such a stage."""

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
    """The hardware of one robot: the stages that it is compiled for, and its parameters."""

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
    """The hardware of a robot; values of its file's joints come beside the scenario's parameters.

    Frictions add up, the lower torque limit holds, and a joint that nothing drives has no gains.
    """
    period = share = servo_period = None
    if stages.control_period:
        period = period_steps(jnp.asarray(parameters.bus.control_period), time_step)
    if stages.force_filter or stages.sampled_filter:
        sampled = time_step if period is None or not stages.sampled_filter else time_step * period
        # share of an input held over a period that a first-order filter takes in: 1 - exp(-2 pi f h)
        share = -jnp.expm1(-2 * jnp.pi * sampled * parameters.force_sensor.filter)
    late: dict[str, Buffer] = {}
    for part, path in DELAYED.items():
        length = getattr(stages, f"{part}_delay")
        late[part] = weights(jnp.asarray(parameters.at(path)) / time_step, length) if length else ()
    if stages.servo_rate:
        servo_period = period_steps(1 / jnp.asarray(parameters.drive.rate), time_step)
    pace = Pace(**late, filter_share=share, period=period, servo_period=servo_period)
    parameters = _at_supply_voltage(parameters, stages)
    known: dict[str, Any] = parameters.values
    changed: dict[str, Any] = {}
    # under a voltage the torque limit is the motor's own, at standstill
    limit, stall = ("current_limit", "torque_limit") if stages.voltage else ("torque_limit", "")
    loop = SECTIONS["joint_loop"]
    for path, own, combined in (
        *((f"{loop}.{gain}", "driven", jnp.multiply) for gain in JOINT_GAINS),
        (f"{_SERVO}.{stall}", "driven", jnp.multiply), (f"{_SERVO}.{limit}", "torque_limit", jnp.minimum),
        (f"{_SERVO}.coulomb_friction", "friction", jnp.add), (f"{_SERVO}.viscous_friction", "damping", jnp.add),
    ):  # fmt: skip
        if path in known and robot is not None and getattr(robot, own) is not None:
            changed[path] = combined(changed.get(path, known[path]), getattr(robot, own))
    return Hardware(parameters.replace_alone(changed), pace, stages, time_step)


def _at_supply_voltage(parameters: Parameters, stages: Stages) -> Parameters:
    """Parameters with the motors' torque and speed at the supply voltage in place of the rated one.

    A loop that gives a share of the voltage has gains in N m/rad that grow with it, one that asks for torques does not.
    """
    if not stages.supply_voltage:
        return parameters
    servos = parameters.drive
    known = jnp.isfinite(servos.supply_voltage) & jnp.isfinite(servos.rated_voltage)
    supply, rated = (jnp.where(known, volts, 1.0) for volts in (servos.supply_voltage, servos.rated_voltage))
    paths = [f"{_SERVO}.torque_limit", f"{_SERVO}.no_load_speed"]
    paths += [f"{SECTIONS['joint_loop']}.{gain}" for gain in JOINT_GAINS] if stages.voltage else []
    return parameters.replace_alone({path: parameters.at(path) * (supply / rated) for path in paths})
