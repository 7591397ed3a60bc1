"""What laws share that move single feet: offsets from where the gait wants them, and which forces to trust."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.law import Command, JointGains, Measurement, Reference, Start
from mjx_climb.dynamics.spatial import quaternion_conjugate, quaternion_multiply

RELEASE = 0.05  # s, in which an offset fades once its gripper has opened
LEAST = 0.02  # weight of a foot that stands: three of them can always take the wrench
SILENCE = 0.1  # s without a reading, after which a sensor is not believed; after as much again it is said to be lost
STIFFENING = 0.5  # s, in which the joint loop becomes stiffer after a sensor has been said to be lost
SAFE_KP = 50.0  # N m/rad, the joint gain of the shipped configs of HubRobo, with which pd walks without force sensors
_NOTHING = 1e-6  # N, finer than any sensor tells
_LOADED = 1.0  # N in all, with which a robot stands so firmly that a foot has something to bear


class Offsets(NamedTuple):
    """How far the feet are from where the gait wants them, and what their sensors said."""

    displacement: Array  # (limb, 3) m, axes of the base reference
    period: Array  # () s, of the law; (limb, 1) where gains have the phases of limbs
    heard: Array  # (limb, 3) N, world axes: the last reading of a foot's sensor since it stands, 0 without one
    # (limb,) s, from -SILENCE, as a sensor reads something; from 0 on it is not believed, from SILENCE on it is lost
    doubt: Array
    stiffer: Array  # shape of the period; by which factor kp is multiplied without a sensor, 1 or more

    @staticmethod
    def begin(start: Start, safe_kp: float) -> "Offsets":
        """Return no offsets, of feet whose sensors have not read anything yet; `safe_kp` N m/rad is kp without one."""
        none = jnp.zeros_like(start.reference.foot_position)
        stiffer = jnp.maximum(safe_kp / jnp.max(jnp.asarray(start.kp)), 1.0)
        return Offsets(none, jnp.asarray(start.period), none, none[:, 0], stiffer)


class Sensed(NamedTuple):
    """Forces that can be trusted."""

    force: Array  # (limb, 3) N, axes of the base reference; 0 of other feet
    trusted: Array  # (limb,) bool: the foot stands, and its sensor is not dead
    lost: Array  # (limb,) bool: the sensor has been dead for a while
    whole: Array  # () bool: all that stands is trusted, and no sensor is lost


def released(offsets: Offsets, aim: Array | float) -> Array:
    """Return the displacements (limb, 3) m of open grippers, which tend to `aim`."""
    return aim + (offsets.displacement - aim) * jnp.exp(-offsets.period / RELEASE)


def trusted_forces(offsets: Offsets, measured: Measurement, rotation: Array) -> tuple[Offsets, Sensed]:
    """Return the forces of feet that stand, along the columns of `rotation`, where the sensor is not dead.

    A sensor reads nothing where it says exactly 0, or what is no number. Its last reading since the foot stands then
    takes the place, 0 where there is none: a sensor with a resolution reads 0 of a foot that bears next to nothing.
    Once a foot that stands among others that bear something has read nothing for `SILENCE`, its sensor is dead, also
    in later stances, until it reads something. So it is at the start, until it first does.
    """
    size, support = jnp.abs(measured.foot_force).sum(1), measured.support
    reads = (size > _NOTHING) & jnp.isfinite(size)
    heard = jnp.where(reads[:, None], measured.foot_force, jnp.where(support[:, None], offsets.heard, 0.0))
    counts = support & ((jnp.abs(heard).sum() > _LOADED) | (offsets.doubt >= 0))
    longest = SILENCE + STIFFENING
    grown = jnp.where(counts, jnp.minimum(offsets.doubt + jnp.ravel(offsets.period), longest), offsets.doubt)
    doubt = jnp.where(reads, -SILENCE, grown)
    trusted, lost = support & (doubt < 0), doubt >= SILENCE
    # of rows: each row times R is R^T times it
    force = jnp.where(trusted[:, None], heard, 0.0) @ rotation
    sensed = Sensed(force, trusted, lost, ((trusted | ~support) & ~lost).all())
    return offsets._replace(heard=heard, doubt=doubt), sensed


def base_error(measured: Measurement, reference: Reference, rotation: Array) -> Array:
    """Return how far the base is from its reference, (6,) m, rad along the axes of the reference; small angles."""
    turn = quaternion_multiply(quaternion_conjugate(reference.base_orientation), measured.base_orientation)
    return jnp.concatenate([(measured.base_position - reference.base_position) @ rotation, 2 * turn[1:] * turn[0]])


def feet_shifted(reference: Reference, offsets: Offsets, rotation: Array, lost_sensors: Array) -> Command:
    """Return the reference with its feet shifted by their offsets, which are along the axes of the reference.

    Gains that were searched with forces may leave joints so soft that pd tears grippers off with them. So once a sensor
    is lost all kp rise to what is safe without, slowly: a robot that sags is lifted by it.
    """
    feet = reference.foot_position + offsets.displacement @ rotation.T
    no_shift = jnp.zeros_like(reference.base_position, shape=6)
    share = jnp.clip((offsets.doubt.max() - SILENCE) / STIFFENING, 0.0, 1.0)
    kp = jnp.ones_like(offsets.doubt) + (jnp.ravel(offsets.stiffer) - 1) * share
    command = Command(reference.base_position, reference.base_orientation, feet, no_shift, JointGains(kp))
    return command._replace(lost_sensors=lost_sensors)
