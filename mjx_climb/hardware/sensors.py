"""The measurements that the control law gets: foot forces and the base's pose, late, noisy and filtered."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import Component, parameter
from mjx_climb.hardware import bus as signals
from mjx_climb.hardware.stages import Hardware
from mjx_climb.parameter_types import whole_steps
from mjx_climb.physics.noise import normal
from mjx_climb.physics.spatial import quaternion_normalize
from mjx_climb.physics.state import State
from mjx_climb.scenario import declared
from mjx_climb.value_field import UNLIMITED

BASE_CHANNELS = 1000  # of the noise of the base estimate, the first; the force sensors have those before


class ForceSensors(declared.ForceSensors, Component):
    """The force sensors of the feet; `filtered_by` the "sensor" every time step, or the "law" what it samples."""

    # (limb,) from when on a sensor reads 0; infinite: never
    dead: Array = parameter(
        "s",
        shape=(None,),
        bounds=UNLIMITED,
        default=np.full(1, np.inf),
        long_name="end of a force sensor",
        in_steps=True,
    )
    filtered_by: str = "sensor"


class BaseEstimate(declared.BaseEstimate, Component):
    """What the law knows of the base's pose and rates."""


class ForceSensor(NamedTuple):
    """What the feet's force sensors remember; empty, or None, where they have no such stage."""

    buffer: signals.Buffer  # of (limb, 3) N
    filtered: Array | None = None  # (limb, 3) N


def measured_force(sensor: ForceSensor, force: Array, step: Array, hardware: Hardware) -> tuple[ForceSensor, Array]:
    """Return the sensors after this step and what they read of `force` (limb, 3) N.

    The order is that of a real sensor's chain: delay, bias, noise, resolution, filter; one that is dead reads 0.
    """
    buffer, filtered = sensor
    own, stages, share = hardware.parameters.force_sensor, hardware.stages, hardware.pace.filter_share
    if stages.force_delay:
        buffer, force = signals.delayed(buffer, force, hardware.pace.force)
    if stages.force_bias:
        force = force + own.bias
    if stages.force_noise:
        limbs = len(force)
        channels = jnp.arange(limbs)[:, None] + limbs * jnp.arange(3)
        seed = jnp.asarray(hardware.parameters.bus.seed)
        force = force + own.noise * normal(seed, step, channels, force.dtype)
    if stages.force_resolution:
        force = signals.rounded(force, jnp.asarray(own.resolution))
    if stages.force_filter and filtered is not None and share is not None:
        force = filtered = filtered + share * (force - filtered)
    if stages.force_dead:
        dead = step >= whole_steps(jnp.asarray(own.dead), hardware.time_step)
        force = jnp.where(dead[:, None], 0.0, force)
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


def estimated_base(
    buffers: tuple[signals.Buffer, ...], base: Base, step: Array, hardware: Hardware
) -> tuple[tuple[signals.Buffer, ...], Base]:
    """Return the buffers after this step and the estimate; orientation and turning rate are late but not noisy."""
    own, stages = hardware.parameters.base_estimate, hardware.stages
    if stages.base_delay:
        late = [signals.delayed(buffer, value, hardware.pace.base) for buffer, value in zip(buffers, base, strict=True)]
        buffers, values = zip(*late, strict=True)
        base = Base(*values)._replace(orientation=quaternion_normalize(values[1]))
    if stages.base_noise:
        noise = normal(
            jnp.asarray(hardware.parameters.bus.seed), step, BASE_CHANNELS + jnp.arange(6), base.position.dtype
        )
        base = base._replace(
            position=base.position + own.position_noise * noise[:3],
            linear_velocity=base.linear_velocity + own.velocity_noise * noise[3:],
        )
    return buffers, base
