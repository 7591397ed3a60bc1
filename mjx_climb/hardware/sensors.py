"""The measurements that the control law gets: foot forces and the base's pose, late, noisy and filtered."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import Component, parameter
from mjx_climb.hardware import bus as signals
from mjx_climb.hardware.stages import Hardware
from mjx_climb.parameter_types import whole_steps
from mjx_climb.physics.inverse_dynamics import load_torque
from mjx_climb.physics.kinematics import LimbFrames, foot_jacobian
from mjx_climb.physics.noise import normal
from mjx_climb.physics.spatial import quaternion_normalize, quaternion_to_matrix, solve_symmetric
from mjx_climb.physics.state import Loads, State
from mjx_climb.robot.constants import Robot
from mjx_climb.scenario import declared
from mjx_climb.value_field import UNLIMITED

# of noise, the first of the base estimate and of the drift; the force sensors have those before
BASE_CHANNELS, DRIFT_CHANNELS = 1000, 2000
REGULARIZATION = 8.0  # in units of rounding: a stretched limb feels no force along itself


class ForceSensors(declared.ForceSensors, Component):
    """The force sensors of the feet; `filtered_by` the "sensor" every time step, or the "law" at its samples.

    The `source` of forces is a "sensor", or "joint_effort": see `effort_force`. `axes`: "xyz", or "z" alone.
    """

    # (limb,) from when on a sensor reads 0; infinite: never
    dead: Array = parameter(
        "s",
        shape=(None,),
        bounds=UNLIMITED,
        default=np.full(1, np.inf),
        long_name="end of a force sensor",
        in_steps=True,
    )
    source: str = "sensor"
    axes: str = "xyz"
    filtered_by: str = "sensor"


class BaseEstimate(declared.BaseEstimate, Component):
    """The law's knowledge of the base's pose and rates."""


class ForceSensor(NamedTuple):
    """Memory of the feet's force sensors; empty, or None, where they have no such stage."""

    buffer: signals.Buffer  # of (limb, 3) N
    filtered: Array | None = None  # (limb, 3) N
    drift: Array | None = None  # (limb, 3) N


def effort_force(robot: Robot, frames: LimbFrames, state: State, torque: Array, gravity: Array) -> Array:
    """Return the forces (limb, 3) N, world axes, that hold limbs still: `J^T F + tau = g`, by least squares.

    Arguments:
        frames: of the limbs, in the base's axes.
        torque: of the motors, (limb, joint) N m: friction of the joints and motion of the limbs are taken for force.
        gravity: (3,) m/s^2, under which the links have the masses of the robot's file.
    """
    none = jnp.zeros_like(gravity)
    still = State(state.base_position, state.base_orientation, none, none, state.joint_angles, jnp.zeros_like(torque))
    loads = Loads(torque, jnp.zeros_like(frames.foot), jnp.zeros_like(none, shape=6), none[0], gravity)
    missing = -load_torque(robot, still, loads)
    jacobian = foot_jacobian(robot, frames)
    square = jacobian @ jacobian.mT
    rounding = REGULARIZATION * float(jnp.finfo(square.dtype).eps) * jnp.trace(square, axis1=1, axis2=2)
    square = square + rounding[:, None, None] * jnp.eye(3, dtype=square.dtype)
    force = solve_symmetric(square, jnp.matvec(jacobian, missing)[..., None])[..., 0]
    return jnp.asarray(force @ quaternion_to_matrix(state.base_orientation).T)


def measured_force(sensor: ForceSensor, force: Array, step: Array, hardware: Hardware) -> tuple[ForceSensor, Array]:
    """The sensors after this step and their readings of `force` (limb, 3) N.

    The order is that of a real sensor's chain: axes, delay, bias and drift, noise, resolution, filter; one that is dead
    reads 0.
    """
    buffer, filtered, drift = sensor
    limbs, seed = len(force), jnp.asarray(hardware.parameters.bus.seed)
    channels = jnp.arange(limbs)[:, None] + limbs * jnp.arange(3)
    own, stages, share = hardware.parameters.force_sensor, hardware.stages, hardware.pace.filter_share
    if stages.force_along_normal:
        force = force * jnp.array([0.0, 0.0, 1.0], force.dtype)
    if stages.force_delay:
        buffer, force = signals.delayed(buffer, force, hardware.pace.force)
    if stages.force_bias:
        force = force + own.bias
    if drift is not None:
        grown = own.drift * hardware.time_step**0.5
        drift = drift + grown * normal(seed, step, DRIFT_CHANNELS + channels, force.dtype)
        force = force + drift
    if stages.force_noise:
        force = force + own.noise * normal(seed, step, channels, force.dtype)
    if stages.force_resolution:
        force = signals.rounded(force, jnp.asarray(own.resolution))
    if stages.force_filter and filtered is not None and share is not None:
        force = filtered = filtered + share * (force - filtered)
    if stages.force_dead:
        dead = step >= whole_steps(jnp.asarray(own.dead), hardware.time_step)
        force = jnp.where(dead[:, None], 0.0, force)
    return ForceSensor(buffer, filtered, drift), force


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
