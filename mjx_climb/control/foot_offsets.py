"""Common parts of laws that move single feet: offsets from the gait's footholds; a law of nothing but offsets."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from mjx_climb.control.law import Command, Law, Measurement, Reference, Start, scalar
from mjx_climb.physics.spatial import quaternion_conjugate, quaternion_multiply, quaternion_to_matrix

RELEASE = 0.05  # s, in which an offset fades once its gripper has opened
_SMALL = 1e-12  # m^2: a foot right under the base has no way outward
_SLOW = 4e-6  # m^2/s^2: below 2 mm/s a foot leads by less
LEAST = 0.02  # weight of a foot that stands: three of them can always take the wrench


class Offsets(NamedTuple):
    """How far the feet are from where the gait wants them."""

    displacement: Array  # (limb, 3) m, axes of the base reference
    period: Array  # () s, of the law; (limb, 1) where gains have the phases of limbs

    @staticmethod
    def begin(start: Start) -> "Offsets":
        """Return no offsets."""
        return Offsets(jnp.zeros_like(start.reference.foot_position), jnp.asarray(start.period))


def released(offsets: Offsets, aim: Array | float) -> Array:
    """Return the displacements (limb, 3) m of open grippers, which tend to `aim`."""
    return aim + (offsets.displacement - aim) * jnp.exp(-offsets.period / RELEASE)


def standing_forces(measured: Measurement, rotation: Array) -> Array:
    """Return the forces (limb, 3) N of feet that stand, along the columns of `rotation`; 0 of others."""
    # of rows: each row times R is R^T times it
    return jnp.where(measured.support[:, None], measured.foot_force, 0.0) @ rotation


def base_error(measured: Measurement, reference: Reference, rotation: Array) -> Array:
    """Return how far the base is from its reference, (6,) m, rad along the axes of the reference; small angles."""
    turn = quaternion_multiply(quaternion_conjugate(reference.base_orientation), measured.base_orientation)
    return jnp.concatenate([(measured.base_position - reference.base_position) @ rotation, 2 * turn[1:] * turn[0]])


def feet_shifted(reference: Reference, offsets: Offsets, rotation: Array) -> Command:
    """Return the reference with its feet shifted by their offsets, which are along the axes of the reference."""
    feet = reference.foot_position + offsets.displacement @ rotation.T
    no_shift = jnp.zeros_like(reference.base_position, shape=6)
    return Command(reference.base_position, reference.base_orientation, feet, no_shift)


class FootOffsets(Law):
    """Feet held off where the gait wants them, without a sensor: `FootOffsets@outward,upward` by gait phase.

    Dry friction holds joints back, so that feet stay behind on their way as the base sees it: `onward` leads them.
    """

    outward: Array = scalar("m", "offset away from the base", bounds=(-1e-2, 1e-2), default=0.0)
    upward: Array = scalar("m", "offset along the ground's normal", bounds=(-1e-2, 1e-2), default=0.0)
    onward: Array = scalar("m", "offset along the foot's way from the base", bounds=(0.0, 3e-3), default=0.0)

    LIMBWISE: ClassVar[frozenset[str]] = frozenset({"outward", "upward", "onward"})

    def init(self, start: Start) -> Offsets:
        """Return where the feet are from the base, and the law's period."""
        rotation = quaternion_to_matrix(start.reference.base_orientation)
        return Offsets(_lever(start.reference, rotation), jnp.asarray(start.period))

    def step(self, last: PyTree, measured: Measurement, reference: Reference) -> tuple[PyTree, Command]:
        """Return the reference with shifted feet."""
        rotation = quaternion_to_matrix(reference.base_orientation)
        flat, up = jnp.array([1.0, 1.0, 0.0], rotation.dtype), jnp.array([0.0, 0.0, 1.0], rotation.dtype)
        lever = _lever(reference, rotation)
        outward, onward = _direction(lever * flat, _SMALL), _direction((lever - last.displacement) / last.period, _SLOW)
        gains = map(jnp.atleast_1d, (self.outward, self.upward, self.onward))
        moved = sum(gain * way for gain, way in zip(gains, (outward, up, onward), strict=True))
        return last._replace(displacement=lever), feet_shifted(reference, last._replace(displacement=moved), rotation)


def _lever(reference: Reference, rotation: Array) -> Array:
    return (reference.foot_position - reference.base_position) @ rotation


def _direction(way: Array, small: float) -> Array:
    """Return rows of length 1, of less where a row's square is not far above a small one."""
    return way / jnp.sqrt((way * way).sum(1, keepdims=True) + small)
