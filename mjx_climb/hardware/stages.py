"""Which stages of hardware a walk has, decided once before it is compiled, and what they need of its parameters."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_climb.hardware.signals import Buffer, buffer_length, filter_share, period_steps, weights
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.model import Scenario

_DELAYED = ("force", "base", "command", "servo")


class Stages(NamedTuple):
    """The stages that a walk has; lengths of buffers in samples, 0 without one. Static: a walk is compiled for them."""

    force_delay: int = 0
    force_noise: bool = False
    force_bias: bool = False
    force_resolution: bool = False
    force_filter: bool = False
    sampled_filter: bool = False  # the law filters what it samples
    base_delay: int = 0
    base_noise: bool = False
    control_period: bool = False
    linear: bool = False  # joint targets move linearly between two periods
    command_delay: int = 0
    servo_delay: int = 0
    torque_limit: bool = False
    armature: bool = False
    dry_friction: bool = False
    viscous_friction: bool = False
    backlash: bool = False
    capture: bool = False
    rotational: bool = False  # grips transmit moments

    @property
    def force(self) -> bool:
        """Whether the law reads other foot forces than act."""
        return bool(self.force_delay) or any(
            (self.force_noise, self.force_bias, self.force_resolution, self.force_filter)
        )


IDEAL = Stages()


def stages_of(scenario: Scenario, parameters: Parameters, robot: Robot | None = None) -> Stages:
    """Return the stages that some robot of a batch needs; buffers are as long as the longest delay needs.

    Raises:
        TypeError: parameters that are traced by JAX, so that nothing can be decided by them.
    """
    for name, value in vars(parameters).items():
        if isinstance(value, jax.core.Tracer):
            raise TypeError(f"parameters.{name}: expected an array, got one that JAX traces")
    step = scenario.time_step
    filtered, by_law = finite(parameters.force_filter), scenario.hardware.force_sensor.filtered_by == "law"
    limited, dry, viscous = (
        robot is not None and getattr(robot, name) is not None for name in ("torque_limit", "friction", "damping")
    )
    simple = ("force_noise", "force_bias", "force_resolution", "control_period", "armature", "backlash")
    found: dict[str, Any] = {name: given(getattr(parameters, name)) for name in simple}
    found |= {f"{part}_delay": buffer_length(getattr(parameters, f"{part}_delay"), step) for part in _DELAYED}
    return Stages(
        **found,
        force_filter=filtered and not by_law,
        sampled_filter=filtered and by_law,
        base_noise=given(parameters.position_noise) or given(parameters.velocity_noise),
        linear=found["control_period"] and scenario.hardware.interpolation == "linear",
        torque_limit=limited or finite(parameters.torque_limit),
        dry_friction=dry or given(parameters.coulomb_friction) or given(parameters.load_friction),
        viscous_friction=viscous or given(parameters.viscous_friction),
        capture=finite(parameters.capture_distance),
        rotational=given(parameters.rotational_stiffness),
    )


def given(value: ArrayLike) -> bool:
    """Return whether any number of an array is not zero."""
    return bool(np.any(np.asarray(value) != 0))


def finite(value: ArrayLike) -> bool:
    """Return whether any number of an array is finite: infinity stands for none."""
    return bool(np.any(np.isfinite(np.asarray(value))))


class Pace(NamedTuple):
    """What is worked out once of a robot's delays, filter and control period; empty where it has no such stage."""

    force: Buffer  # weights of the samples, see `signals.weights`
    base: Buffer
    command: Buffer
    servo: Buffer
    filter_share: Any  # () 1
    period: Any  # () time steps


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
        return self.time_step * self.pace.period if self.stages.control_period else self.time_step


def hardware_of(parameters: Parameters, stages: Stages, time_step: float, robot: Robot | None = None) -> Hardware:
    """Return the hardware of a robot; what its file says of its joints comes beside the scenario's parameters."""

    def buffer_weights(part: str) -> Buffer:
        length, seconds = getattr(stages, f"{part}_delay"), getattr(parameters, f"{part}_delay")
        return weights(jnp.asarray(seconds) / time_step, length) if length else ()

    period: Any = ()
    if stages.control_period:
        period = period_steps(jnp.asarray(parameters.control_period), time_step)
    share: Any = ()
    if stages.force_filter or stages.sampled_filter:
        sampled = time_step * period if stages.sampled_filter and stages.control_period else time_step
        share = filter_share(jnp.asarray(parameters.force_filter), sampled)
    late = {part: buffer_weights(part) for part in _DELAYED}
    pace = Pace(**late, filter_share=share, period=period)
    return Hardware(parameters if robot is None else _with_joints_of(robot, parameters), pace, stages, time_step)


def _with_joints_of(robot: Robot, parameters: Parameters) -> Parameters:
    """Return the parameters with what the robot's file says of its joints, (limb, joint) where it does.

    Frictions add up, the lower torque limit holds, and a joint that nothing drives has no gains.
    """
    changes: dict[str, Any] = {}
    if robot.driven is not None:
        changes |= {"kp": parameters.kp * robot.driven, "kd": parameters.kd * robot.driven}
    if robot.torque_limit is not None:
        changes["torque_limit"] = jnp.minimum(jnp.asarray(parameters.torque_limit), robot.torque_limit)
    if robot.friction is not None:
        changes["coulomb_friction"] = parameters.coulomb_friction + robot.friction
    if robot.damping is not None:
        changes["viscous_friction"] = parameters.viscous_friction + robot.damping
    return dataclasses.replace(parameters, **changes)
