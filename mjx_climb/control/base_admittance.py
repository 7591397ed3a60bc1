"""Base admittance, the paper's Eq. 3: `M dxdd + D dxd + K dx = w`, in two readings.

w = J_b^T F_e is the wrench of the foot forces on the base, dx the shift of the base in its six axes. Gains and shift
are taken along the axes of the base reference, so a walk turned about z is the same walk.
"""

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.law import Command, Law, Measurement, Reference
from mjx_climb.control.virtual_model import VirtualState, advance, discretize, rest
from mjx_climb.dynamics.spatial import (
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_to_matrix,
    rotate,
    rotate_back,
)
from mjx_climb.quantities.parameters import Gains


def _in_reference_axes(rotation: Array, vector: Array) -> Array:
    """Turn the two halves of a six-vector (6, B) from world axes into those of the base reference."""
    return jnp.concatenate([rotate_back(rotation, vector[:3]), rotate_back(rotation, vector[3:])])


def _shifted(reference: Reference, rotation: Array, displacement: Array, turn: Array) -> Command:
    """Return the reference with its base shifted by `displacement` (6, B), whose rotation is the quaternion `turn`."""
    return Command(
        base_position=reference.base_position + rotate(rotation, displacement[:3]),
        base_orientation=quaternion_multiply(reference.base_orientation, turn),
        foot_position=reference.foot_position,
        base_displacement=displacement,
    )


def build_virtual_model(gains: Gains, time_step: float | Array) -> Law:
    """Return Eq. 3 as a virtual mass, spring and damper, integrated exactly, that yields to the wrench.

    The ground pushes the feet with w where something pushes the base with -w, so dx is driven by -w.
    """
    transition = discretize(gains, time_step)

    def command(state: VirtualState, measurement: Measurement, reference: Reference) -> tuple[VirtualState, Command]:
        rotation = quaternion_to_matrix(reference.base_orientation)
        state = advance(transition, state, -_in_reference_axes(rotation, measurement.wrench))
        turn = quaternion_from_rotation_vector(state.displacement[3:])
        return state, _shifted(reference, rotation, state.displacement, turn)

    return Law(initial=rest(gains.stiffness), command=command)


def build_measured_pose(gains: Gains, time_step: float | Array) -> Law:
    """Return Eq. 3 with dx and its rate measured: one step of the virtual mass from where the base is.

    `a = (w - D dxd - K dx) / M`, target `x_b + dt dxd + dt^2 a`; dx is the base's offset from its reference, dxd the
    base's own velocity. Rotations are twice the vector part of the quaternion.
    """

    def command(state: tuple[()], measurement: Measurement, reference: Reference) -> tuple[tuple[()], Command]:
        rotation = quaternion_to_matrix(reference.base_orientation)
        turn = quaternion_multiply(quaternion_conjugate(reference.base_orientation), measurement.base_orientation)
        turn = jnp.where(turn[0] < 0, -turn, turn)
        offset = jnp.concatenate(
            [rotate_back(rotation, measurement.base_position - reference.base_position), 2 * turn[1:]]
        )
        rate = _in_reference_axes(
            rotation, jnp.concatenate([measurement.base_linear_velocity, measurement.base_angular_velocity])
        )
        wrench = _in_reference_axes(rotation, measurement.wrench)
        acceleration = (wrench - gains.damping * rate - gains.stiffness * offset) / gains.inertia
        target = offset + time_step * rate + time_step**2 * acceleration
        half = target[3:] / 2
        length = jnp.minimum(jnp.sum(half * half, axis=0), 1.0)
        # a demand beyond half a turn keeps its axis and saturates there
        real = jnp.sqrt(jnp.where(length < 1, 1 - length, 1.0)) * (length < 1)
        vector = half / jnp.sqrt(jnp.maximum(jnp.sum(half * half, axis=0), 1.0))
        return state, _shifted(reference, rotation, target, jnp.concatenate([real[None], vector]))

    return Law(initial=(), command=command)
