"""What laws share that move single feet: offsets from where the gait wants them, and which forces to trust."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.law import Command, Measurement, Reference, Start
from mjx_climb.dynamics.spatial import quaternion_conjugate, quaternion_multiply

RELEASE = 0.05  # s, in which an offset fades once its gripper has opened
LEAST = 0.02  # weight of a foot that stands: three of them can always take the wrench


class Offsets(NamedTuple):
    """How far the feet are from where the gait wants them."""

    displacement: Array  # (limb, 3) m, axes of the base reference
    period: Array  # () s, of the law

    @staticmethod
    def begin(start: Start) -> "Offsets":
        """Return no offsets."""
        return Offsets(jnp.zeros_like(start.reference.foot_position), jnp.asarray(start.period))


class Sensed(NamedTuple):
    """Forces that can be trusted."""

    force: Array  # (limb, 3) N, axes of the base reference; 0 of other feet
    trusted: Array  # (limb,) bool: the foot stands, and its sensor says something


def released(offsets: Offsets, aim: Array | float) -> Array:
    """Return the displacements (limb, 3) m of open grippers, which tend to `aim`."""
    return aim + (offsets.displacement - aim) * jnp.exp(-offsets.period / RELEASE)


def trusted_forces(measured: Measurement, rotation: Array) -> Sensed:
    """Return the forces of feet that stand, along the columns of `rotation`, where the sensor is not dead.

    A dead sensor says exactly nothing, or what is no number: its foot is then left as it is.
    """
    size = jnp.abs(measured.foot_force).sum(1)
    trusted = measured.support & (size > 0) & jnp.isfinite(size)
    # of rows: each row times R is R^T times it
    return Sensed(jnp.where(trusted[:, None], measured.foot_force, 0.0) @ rotation, trusted)


def base_error(measured: Measurement, reference: Reference, rotation: Array) -> Array:
    """Return how far the base is from its reference, (6,) m, rad along the axes of the reference; small angles."""
    turn = quaternion_multiply(quaternion_conjugate(reference.base_orientation), measured.base_orientation)
    return jnp.concatenate([(measured.base_position - reference.base_position) @ rotation, 2 * turn[1:] * turn[0]])


def feet_shifted(reference: Reference, displacement: Array, rotation: Array) -> Command:
    """Return the reference with its feet shifted by `displacement` (limb, 3) m along the axes of the reference."""
    feet = reference.foot_position + displacement @ rotation.T
    no_shift = jnp.zeros_like(reference.base_position, shape=6)
    return Command(reference.base_position, reference.base_orientation, feet, no_shift)
