"""What a walk works out of its hardware's numbers once: how late, how often, how much of the new."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from mjx_climb.hardware import control_period, delay, force_sensor
from mjx_climb.hardware.stages import Stages
from mjx_climb.quantities.parameters import Parameters


class Pace(NamedTuple):
    """Weights of buffers, the filter's share, steps of a control period; empty where a walk has no such stage."""

    force: Any  # `delay.weights`
    base: Any
    command: Any
    servo: Any
    filter_share: Any  # (B,) 1
    period: Any  # (B,) steps


def pace(numbers: Parameters, stages: Stages, time_step: float) -> Pace:
    """Return the pace of a walk in time steps of `time_step` s."""

    def weights(seconds: Any, length: int) -> tuple[Any, ...]:
        return delay.weights(jnp.asarray(seconds) / time_step, length) if length else ()

    period: Any = ()
    if stages.control_period:
        period = control_period.period_steps(jnp.asarray(numbers.control_period), time_step)
    filter_share: Any = ()
    if stages.force_filter or stages.sampled_filter:
        step = time_step * period if stages.sampled_filter and stages.control_period else time_step
        filter_share = force_sensor.share(jnp.asarray(numbers.force_filter), step)
    return Pace(
        force=weights(numbers.force_delay, stages.force_delay),
        base=weights(numbers.base_delay, stages.base_delay),
        command=weights(numbers.command_delay, stages.command_delay),
        servo=weights(numbers.servo_delay, stages.servo_delay),
        filter_share=filter_share,
        period=period,
    )
