"""What the robot believes of its base: pose and rates that come late, position and velocity with noise."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.dynamics.spatial import quaternion_normalize
from mjx_climb.dynamics.state import State
from mjx_climb.hardware import delay
from mjx_climb.hardware.noise import normal
from mjx_climb.hardware.stages import Stages
from mjx_climb.quantities.parameters import Parameters

FIRST_CHANNEL = 1000  # the force sensors have those before


class Base(NamedTuple):
    """Pose and rates of the base, world axes."""

    position: Array  # (3, B) m
    orientation: Array  # (4, B) wxyz
    linear_velocity: Array  # (3, B) m/s
    angular_velocity: Array  # (3, B) rad/s


def true_base(state: State) -> Base:
    """Return the base of a state."""
    return Base(state.base_position, state.base_orientation, state.base_linear_velocity, state.base_angular_velocity)


def start(base: Base, stages: Stages) -> Any:
    """Return the buffers of a base that has always been so."""
    return tuple(delay.start(value, stages.base_delay) for value in base) if stages.base_delay else ()


def estimated(
    buffers: Any, base: Base, step: Array, numbers: Parameters, stages: Stages, weights: tuple[Array, ...]
) -> tuple[Any, Base]:
    """Return the buffers after this step and the estimate; orientation and turning rate are late but not noisy."""
    if stages.base_delay:
        pairs = [delay.delayed(buffer, value, weights) for buffer, value in zip(buffers, base, strict=True)]
        buffers = tuple(buffer for buffer, _ in pairs)
        base = Base(*(late for _, late in pairs))
        base = base._replace(orientation=quaternion_normalize(base.orientation))
    if stages.base_noise:
        channels = FIRST_CHANNEL + jnp.arange(6)[:, None]
        noise = normal(jnp.asarray(numbers.seed), step, channels, base.position.dtype)
        base = base._replace(
            position=base.position + numbers.position_noise * noise[:3],
            linear_velocity=base.linear_velocity + numbers.velocity_noise * noise[3:],
        )
    return buffers, base
