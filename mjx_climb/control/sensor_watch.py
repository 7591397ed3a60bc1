"""Which force sensors are believed; without one no law gets forces, and the joints are stiff.

The load of a foot without a sensor cannot be inferred from the others. So a law that reads forces gets none at all once
the sensor of a foot that stands is dead, and its shifts fade as its gains have it. Gains that were searched with forces
may leave joints so soft that the gait alone tears grippers off. So kp rises to the safe value once a sensor is lost,
slowly, as a robot that sags is lifted by it, and falls as slowly once all sensors read.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

# s without a reading, after which a sensor is not believed; after as much again it counts as lost
SILENCE = 0.1
# s, in which kp rises to its safe value once a sensor is lost, and falls once all read
STIFFENING = 0.5
_NOTHING = 1e-6  # N, below the resolution of any sensor
_LOADED = 1.0  # N, least sum of readings of a robot each of whose standing feet bears something


class SensorWatch(NamedTuple):
    """Last readings of the force sensors, and since when they are silent."""

    heard: Array  # (limb, 3) N, world axes: the last reading of a foot's sensor since it stands, 0 without one
    # (limb,) s, from -SILENCE, as a sensor reads something; 0: it has not read anything yet; beyond it is not believed
    doubt: Array
    kp_rise: Array  # () 1, how far kp has risen to the safe value

    @property
    def lost(self) -> Array:
        """The sensors that have been dead for a while, (limb,) bool."""
        return self.doubt >= SILENCE


def begin(feet: Array) -> SensorWatch:
    """Return the watch of sensors of feet (limb, 3) m before their first reading."""
    none = jnp.zeros_like(feet)
    return SensorWatch(none, none[:, 0], none[0, 0])


def watched(
    watch: SensorWatch, readings: Array, support: Array, period: float | Array
) -> tuple[SensorWatch, Array, Array]:
    """Return the watch a period later, in s, forces (limb, 3) N to believe, and whether they can be, () bool.

    A sensor reads nothing where it says exactly 0, or no number. Its last reading since the foot stands then
    takes the place, 0 where there is none: a sensor with a resolution reads 0 of a foot that bears next to nothing.
    Once a foot that stands among others that bear something has read nothing for `SILENCE`, its sensor is dead, also
    in later stances, until it reads something. The same holds at the start, until its first reading.
    """
    size = jnp.abs(readings).sum(1)
    reads = (size > _NOTHING) & jnp.isfinite(size)
    heard = jnp.where(reads[:, None], readings, jnp.where(support[:, None], watch.heard, 0.0))
    loaded = jnp.abs(heard).sum() > _LOADED
    grown = jnp.minimum(watch.doubt + period, 2 * SILENCE)
    doubt = jnp.where(support & (loaded | (watch.doubt > 0)), grown, watch.doubt)
    doubt = jnp.where(reads, -SILENCE, doubt)
    believed = (doubt < 0) | ((doubt == 0) & ~loaded)
    lost = doubt >= SILENCE
    known = ((believed | ~support) & ~lost).all()
    change = jnp.where(lost.any(), period, -period) / STIFFENING
    kp_rise = jnp.clip(watch.kp_rise + change, 0.0, 1.0)
    return SensorWatch(heard, doubt, kp_rise), jnp.where(known, heard, 0.0), known


def raised_kp(kp: Array, safe_kp: Array, kp_rise: Array) -> Array:
    """Return kp, () or (limb, joint) N m/rad, raised to `safe_kp` as far as the watch says."""
    return kp + kp_rise * jnp.maximum(safe_kp - kp, 0.0)
