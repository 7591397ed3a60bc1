"""Which stages of hardware a walk has: decided once, before it is compiled. Their numbers are `Parameters`."""

from typing import NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike

from mjx_climb.hardware.delay import samples
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.scenario.model import Scenario


class Stages(NamedTuple):
    """The stages that a walk has; lengths of buffers in samples, 0 without one. Hashable."""

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


def stages_of(scenario: Scenario, numbers: Parameters) -> Stages:
    """Return the stages that some environment of a batch needs.

    Arguments:
        scenario: says how targets move between two periods, and who filters.
        numbers: with any leading batch axes; buffers are as long as the longest delay needs.

    Raises:
        TypeError: numbers that are traced by JAX, so that nothing can be decided by them.
    """
    for name, value in vars(numbers).items():
        if isinstance(value, jax.core.Tracer):
            raise TypeError(f"numbers.{name}: expected an array, got one that JAX traces")
    step = scenario.time_step
    period, filtered = given(numbers.control_period), finite(numbers.force_filter)
    by_law = scenario.hardware.force_sensor.filtered_by == "law"
    return Stages(
        force_delay=samples(numbers.force_delay, step),
        force_noise=given(numbers.force_noise),
        force_bias=given(numbers.force_bias),
        force_resolution=given(numbers.force_resolution),
        force_filter=filtered and not by_law,
        sampled_filter=filtered and by_law,
        base_delay=samples(numbers.base_delay, step),
        base_noise=given(numbers.position_noise) or given(numbers.velocity_noise),
        control_period=period,
        linear=period and scenario.hardware.interpolation == "linear",
        command_delay=samples(numbers.command_delay, step),
        servo_delay=samples(numbers.servo_delay, step),
        torque_limit=finite(numbers.torque_limit),
        armature=given(numbers.armature),
        dry_friction=given(numbers.coulomb_friction) or given(numbers.load_friction),
        viscous_friction=given(numbers.viscous_friction),
        backlash=given(numbers.backlash),
        capture=finite(numbers.capture_distance),
        rotational=given(numbers.rotational_stiffness),
    )


def given(value: ArrayLike) -> bool:
    """Return whether any number of an array is not zero."""
    return bool(np.any(np.asarray(value) != 0))


def finite(value: ArrayLike) -> bool:
    """Return whether any number of an array is finite: infinity stands for none."""
    return bool(np.any(np.isfinite(np.asarray(value))))
