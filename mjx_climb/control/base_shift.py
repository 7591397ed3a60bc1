"""The reference with its base shifted: the command of every law that lets the base give way."""

from jax import Array

from mjx_climb.control.law import Command, Reference
from mjx_climb.dynamics.spatial import (
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_to_matrix,
    rotate,
)


def shifted(reference: Reference, rotation: Array, displacement: Array, turn: Array) -> Command:
    """Return the reference with its base shifted by `displacement` (6, B), whose rotation is the quaternion `turn`."""
    return Command(
        base_position=reference.base_position + rotate(rotation, displacement[:3]),
        base_orientation=quaternion_multiply(reference.base_orientation, turn),
        foot_position=reference.foot_position,
        base_displacement=displacement,
    )


def shifted_by(reference: Reference, displacement: Array) -> Command:
    """Return the reference with its base shifted by `displacement` (6, B): a translation and a rotation vector."""
    rotation = quaternion_to_matrix(reference.base_orientation)
    return shifted(reference, rotation, displacement, quaternion_from_rotation_vector(displacement[3:]))
