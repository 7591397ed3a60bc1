"""Which stages of hardware a walk has, decided once before it is compiled, and what they need of its parameters."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_climb.hardware.signals import Buffer, buffer_length, period_steps, weights
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
        return any((self.force_delay, self.force_noise, self.force_bias, self.force_resolution, self.force_filter))


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
    filtered, by_law = _finite(parameters.force_filter), scenario.hardware.force_sensor.filtered_by == "law"
    limited, dry, viscous = (
        robot is not None and getattr(robot, name) is not None for name in ("torque_limit", "friction", "damping")
    )
    there = {name: given(value) for name, value in vars(parameters).items()}
    simple = ("force_noise", "force_bias", "force_resolution", "control_period", "armature", "backlash")
    found: dict[str, Any] = {name: there[name] for name in simple}
    found |= {f"{part}_delay": buffer_length(getattr(parameters, f"{part}_delay"), step) for part in _DELAYED}
    return Stages(
        **found,
        force_filter=filtered and not by_law,
        sampled_filter=filtered and by_law,
        base_noise=there["position_noise"] or there["velocity_noise"],
        linear=there["control_period"] and scenario.hardware.interpolation == "linear",
        torque_limit=limited or _finite(parameters.torque_limit),
        dry_friction=dry or there["coulomb_friction"] or there["load_friction"],
        viscous_friction=viscous or there["viscous_friction"],
        capture=_finite(parameters.capture_distance),
        rotational=there["rotational_stiffness"],
    )


def given(value: ArrayLike) -> bool:
    """Return whether any number of an array is not zero."""
    return bool(np.any(np.asarray(value) != 0))


def _finite(value: ArrayLike) -> bool:
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
    """Return the hardware of a robot; what its file says of its joints comes beside the scenario's parameters.

    Frictions add up, the lower torque limit holds, and a joint that nothing drives has no gains.
    """
    period: Any = ()
    if stages.control_period:
        period = period_steps(jnp.asarray(parameters.control_period), time_step)
    share: Any = ()
    if stages.force_filter or stages.sampled_filter:
        sampled = time_step * period if stages.sampled_filter and stages.control_period else time_step
        # what a first-order filter takes in of an input held over a period: 1 - exp(-2 pi f h)
        share = -jnp.expm1(-2 * jnp.pi * sampled * parameters.force_filter)
    late: dict[str, Buffer] = {}
    for part in _DELAYED:
        length, seconds = getattr(stages, f"{part}_delay"), getattr(parameters, f"{part}_delay")
        late[part] = weights(jnp.asarray(seconds) / time_step, length) if length else ()
    pace = Pace(**late, filter_share=share, period=period)
    changes: dict[str, Any] = {}
    for name, own, combined in (
        ("kp", "driven", jnp.multiply), ("kd", "driven", jnp.multiply), ("torque_limit", "torque_limit", jnp.minimum),
        ("coulomb_friction", "friction", jnp.add), ("viscous_friction", "damping", jnp.add),
    ):  # fmt: skip
        if robot is not None and getattr(robot, own) is not None:
            changes[name] = combined(getattr(parameters, name), getattr(robot, own))
    return Hardware(dataclasses.replace(parameters, **changes), pace, stages, time_step)
