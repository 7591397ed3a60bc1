"""What the robot's sensors tell its control law: foot forces and the base's pose, late, noisy and filtered."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.dynamics.spatial import quaternion_normalize
from mjx_climb.dynamics.state import State
from mjx_climb.hardware import signals
from mjx_climb.hardware.noise import normal
from mjx_climb.hardware.stages import Hardware, Stages

BASE_CHANNELS = 1000  # of the noise of the base estimate, the first; the force sensors have those before


class ForceSensor(NamedTuple):
    """What the feet's force sensors remember; empty where they have no such stage."""

    buffer: signals.Buffer  # of (limb, 3) N
    filtered: Any  # (limb, 3) N


def resting_force_sensor(force: Array, stages: Stages) -> ForceSensor:
    """Return sensors that have always read `force` (limb, 3) N."""
    return ForceSensor(signals.filled(force, stages.force_delay), force if stages.force_filter else ())


def measured_force(sensor: ForceSensor, force: Array, step: Array, hardware: Hardware) -> tuple[ForceSensor, Array]:
    """Return the sensors after this step and what they read of `force` (limb, 3) N.

    The order is that of a real sensor's chain: delay, bias, noise, resolution, filter.
    """
    buffer, filtered = sensor
    parameters, stages = hardware.parameters, hardware.stages
    if stages.force_delay:
        buffer, force = signals.delayed(buffer, force, hardware.pace.force)
    if stages.force_bias:
        force = force + parameters.force_bias
    if stages.force_noise:
        limbs = len(force)
        channels = jnp.arange(limbs)[:, None] + limbs * jnp.arange(3)
        force = force + parameters.force_noise * normal(jnp.asarray(parameters.seed), step, channels, force.dtype)
    if stages.force_resolution:
        force = signals.rounded(force, jnp.asarray(parameters.force_resolution))
    if stages.force_filter:
        force = filtered = signals.low_passed(filtered, force, hardware.pace.filter_share)
    return ForceSensor(buffer, filtered), force


class Base(NamedTuple):
    """Pose and rates of the base, world axes."""

    position: Array  # (3,) m
    orientation: Array  # (4,) wxyz
    linear_velocity: Array  # (3,) m/s
    angular_velocity: Array  # (3,) rad/s


def true_base(state: State) -> Base:
    """Return the base of a state."""
    return Base(state.base_position, state.base_orientation, state.base_linear_velocity, state.base_angular_velocity)


def resting_estimate(base: Base, stages: Stages) -> Any:
    """Return the buffers of the estimate of a base that has always been so."""
    return tuple(signals.filled(value, stages.base_delay) for value in base) if stages.base_delay else ()


def estimated_base(buffers: Any, base: Base, step: Array, hardware: Hardware) -> tuple[Any, Base]:
    """Return the buffers after this step and the estimate; orientation and turning rate are late but not noisy."""
    parameters, stages = hardware.parameters, hardware.stages
    if stages.base_delay:
        pairs = [
            signals.delayed(buffer, value, hardware.pace.base) for buffer, value in zip(buffers, base, strict=True)
        ]
        buffers = tuple(buffer for buffer, _ in pairs)
        base = Base(*(late for _, late in pairs))
        base = base._replace(orientation=quaternion_normalize(base.orientation))
    if stages.base_noise:
        noise = normal(jnp.asarray(parameters.seed), step, BASE_CHANNELS + jnp.arange(6), base.position.dtype)
        base = base._replace(
            position=base.position + parameters.position_noise * noise[:3],
            linear_velocity=base.linear_velocity + parameters.velocity_noise * noise[3:],
        )
    return buffers, base
