"""Families of motions that excite a robot's parameters: how far each axis is from its centre over time.

An axis is a joint, or a translation or rotation of the base. How far it may go at a frequency f is
`min(room, speed / (2 pi f), acceleration / (2 pi f)^2)`; the limits of the whole robot scale these motions.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

COMPONENTS = 9  # sines of a multi-sine, for each axis
TAPER = 0.5  # s, of a rise from the centre and of the way back to it
SLOWEST = 0.05  # Hz, of slow reversals
DWELL = 0.6  # s, at a step's level

_Samples = Float[np.ndarray, "time axis"]


class Axes(NamedTuple):
    """How far, how fast and with which acceleration each axis may move, rad or m, per s, per s^2; infinite: any."""

    room: Float[np.ndarray, " axis"]
    speed: Float[np.ndarray, " axis"]
    acceleration: Float[np.ndarray, " axis"]

    def amplitude(self, frequency: np.ndarray) -> np.ndarray:
        """Return the amplitude of a sine at frequencies (..., axis) Hz."""
        turning = 2 * np.pi * frequency
        amplitude: np.ndarray = np.minimum(self.room, np.minimum(self.speed / turning, self.acceleration / turning**2))
        return amplitude


class Band(NamedTuple):
    """Lowest and highest frequency, Hz."""

    low: float
    high: float


def chirp(axes: Axes, time: np.ndarray, band: Band, draw: np.random.Generator) -> _Samples:
    """Return sines whose frequencies go up and down the band, no two axes at the same place of it."""
    count, length = len(axes.room), time[-1] + time[1]
    start = (draw.permutation(count) + draw.uniform()) / count
    place = np.abs(1 - 2 * ((time[:, None] / length + start) % 1))  # of the band, logarithmically
    frequency = band.low * (band.high / band.low) ** place
    return np.asarray(axes.amplitude(frequency) * _sines(time, frequency, draw.uniform(0, 2 * np.pi, count)))


def plain_chirp(axes: Axes, time: np.ndarray, band: Band, draw: np.random.Generator) -> _Samples:
    """Return the usual motion: one sine from the lowest to the highest frequency, of one amplitude."""
    frequency = band.low * (band.high / band.low) ** (time[:, None] / (time[-1] + time[1]))
    amplitude = axes.amplitude(np.full(len(axes.room), band.high))
    return np.asarray(amplitude * _sines(time, frequency, np.zeros(1)))


def multisine(axes: Axes, time: np.ndarray, band: Band, draw: np.random.Generator) -> _Samples:
    """Return sums of sines, each axis with frequencies of its own, spread evenly over the band's logarithm."""
    count = len(axes.room)
    places = np.arange(COMPONENTS * count).reshape(COMPONENTS, count) + draw.uniform(0, 1, (COMPONENTS, count))
    each = draw.permuted(band.low * (band.high / band.low) ** (places / places.size), axis=1)
    phase = draw.uniform(0, 2 * np.pi, each.shape)
    parts = axes.amplitude(each) * np.sin(2 * np.pi * each * time[:, None, None] + phase)
    total = parts.sum(1) / np.sqrt(COMPONENTS)
    return np.asarray(total / np.maximum(np.abs(total).max(0) / np.maximum(axes.room, 1e-9), 1.0))


def steps(axes: Axes, time: np.ndarray, band: Band, draw: np.random.Generator) -> _Samples:
    """Return levels at which the axes rest in turn, each reached as fast as the axis may go."""
    moved = np.zeros((len(time), len(axes.room)))
    for axis, (room, speed, acceleration) in enumerate(zip(*axes, strict=True)):
        begin, level, side = draw.uniform(0, DWELL), 0.0, draw.choice([-1, 1])
        while begin < time[-1]:
            side = -side  # across the centre, so that the gears' play is crossed
            way = side * room * draw.uniform(0.1, 0.6) - level
            # by `smooth`, the speed is at most 1.88 of the mean one, the acceleration 5.78 of the mean one's per time
            lasts = max(1.88 * abs(way) / speed, np.sqrt(5.78 * abs(way) / acceleration), 1 / band.high)
            moved[:, axis] += way * smooth((time - begin) / lasts)
            begin, level = begin + lasts + DWELL * draw.uniform(0.8, 1.4), level + way
    return moved


def reversals(axes: Axes, time: np.ndarray, band: Band, draw: np.random.Generator) -> _Samples:
    """Return slow ways to and fro, each axis at a constant speed of its own, so that friction alone changes."""
    count = len(axes.room)
    rate = max(band.low, SLOWEST) * draw.permutation(np.linspace(0.8, 2.0, count))  # Hz
    cycle = time[:, None] * rate + draw.choice([0.0, 0.5], count)
    triangles = np.arcsin(0.99 * np.sin(2 * np.pi * cycle)) / np.arcsin(0.99)  # with round tips
    return np.asarray(axes.room * triangles)


Family = Callable[[Axes, np.ndarray, Band, np.random.Generator], _Samples]
FAMILIES: dict[str, Family] = {"chirp": chirp, "multisine": multisine, "steps": steps, "reversals": reversals}


def tapered(moved: _Samples, time: np.ndarray) -> _Samples:
    """Return a motion that begins and ends at the centre, at rest."""
    taper = min(TAPER, time[-1] / 4)
    return np.asarray(moved * (smooth(time / taper) * smooth((time[-1] - time) / taper))[:, None])


def smooth(share: np.ndarray) -> np.ndarray:
    """Return 0 to 1 for 0 to 1, at rest at both ends and without acceleration there: the minimum-jerk quintic."""
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(x**3 * (10 - 15 * x + 6 * x * x))


def _sines(time: np.ndarray, frequency: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return sines of changing frequencies (time, axis) Hz."""
    turned = np.cumsum(2 * np.pi * frequency, axis=0) * time[1]
    return np.asarray(np.sin(turned - turned[0] + phase))
