"""Motions of an excitation, written again sample by sample with the same draws."""

import math

import numpy as np
import pytest

from tuning.identification.plan import motions

TIME = np.arange(400) / 100
AXES = motions.Axes(np.array([0.3, 0.5, 0.2]), np.array([2.0, np.inf, 0.9]), np.array([30.0, 8.0, np.inf]))
BAND = motions.Band(0.2, 4.0)
TWICE = 2 * math.pi


def amplitude(axis, frequency):
    room, speed, acceleration = (float(limit[axis]) for limit in AXES)
    return min(room, speed / (TWICE * frequency), acceleration / (TWICE * frequency) ** 2)


def chirp(draw):
    start = (draw.permutation(3) + draw.uniform()) / 3
    phase, moved = draw.uniform(0, TWICE, 3), np.zeros((400, 3))
    for axis in range(3):
        angle = phase[axis]
        for row in range(400):
            share = (row / 400 + start[axis]) % 1
            frequency = 0.2 * 20 ** (1 - 2 * share if share < 0.5 else 2 * share - 1)
            angle += TWICE * frequency * 0.01 if row else 0.0
            moved[row, axis] = amplitude(axis, frequency) * math.sin(angle)
    return moved


def plain_chirp(_):
    moved, angle = np.zeros((400, 3)), 0.0
    for row in range(400):
        angle += TWICE * 0.2 * 20 ** (row / 400) * 0.01 if row else 0.0
        moved[row] = [amplitude(axis, 4.0) * math.sin(angle) for axis in range(3)]
    return moved


def multisine(draw):
    """Nine sines an axis: of 27 places of the band's logarithm each axis has one in each row of three."""
    places = np.arange(27).reshape(9, 3) + draw.uniform(0, 1, (9, 3))
    frequencies = draw.permuted(0.2 * 20 ** (places / 27), axis=1)
    phase, moved = draw.uniform(0, TWICE, (9, 3)), np.zeros((400, 3))
    for axis in range(3):
        for n in range(9):
            f = frequencies[n, axis]
            moved[:, axis] += amplitude(axis, f) * np.sin(TWICE * f * TIME + phase[n, axis]) / 3
        moved[:, axis] *= min(1.0, AXES.room[axis] / abs(moved[:, axis]).max())
    return moved


def steps(draw):
    """As quick as speed, acceleration and the highest frequency allow, then six tenths of a second at rest or so."""
    moved = np.zeros((400, 3))
    for axis in range(3):
        begin, level, side = draw.uniform(0, 0.6), 0.0, draw.choice([-1, 1])
        while begin < TIME[-1]:
            side *= -1
            goal = side * AXES.room[axis] * draw.uniform(0.1, 0.6)
            way = abs(goal - level)
            lasts = max(1.88 * way / AXES.speed[axis], math.sqrt(5.78 * way / AXES.acceleration[axis]), 1 / 4.0)
            for row in np.flatnonzero(TIME > begin):
                x = min((TIME[row] - begin) / lasts, 1.0)
                moved[row, axis] = level + (goal - level) * (10 * x**3 - 15 * x**4 + 6 * x**5)
            begin, level = begin + lasts + 0.6 * draw.uniform(0.8, 1.4), goal
    return moved


def reversals(draw):
    rate = 0.2 * draw.permutation([0.8, 1.4, 2.0])
    cycle = TIME[:, None] * rate + draw.choice([0.0, 0.5], 3)
    return AXES.room * np.arcsin(0.99 * np.sin(TWICE * cycle)) / math.asin(0.99)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("family", [chirp, plain_chirp, multisine, steps, reversals])
def test_motions_are_those_of_their_definition(family, seed):
    found = getattr(motions, family.__name__)(AXES, TIME, BAND, np.random.default_rng(seed))
    np.testing.assert_allclose(found, family(np.random.default_rng(seed)), atol=1e-9)
    assert (abs(found) <= AXES.room * (1 + 1e-9)).all()
    assert motions.FAMILIES.get(family.__name__, motions.plain_chirp) is getattr(motions, family.__name__)


def test_reversals_are_no_slower_than_once_in_twenty_seconds():
    moved = motions.reversals(AXES, TIME, motions.Band(0.001, 4.0), np.random.default_rng(0))
    rate = 0.05 * np.random.default_rng(0).permutation([0.8, 1.4, 2.0])
    slope = abs(np.diff(moved, axis=0)[20:40]).mean(0) * 100 / AXES.room
    np.testing.assert_allclose(slope, 4 * rate, rtol=0.15)


@pytest.mark.parametrize(("length", "taper"), [(4.0, 0.5), (1.0, 0.25)])
def test_motions_rise_from_the_centre_and_go_back_to_it_in_half_a_second_or_a_quarter_of_the_time(length, taper):
    time = np.arange(0, length + 1e-9, 0.01)
    found = motions.tapered(np.ones((len(time), 2)), time)
    x = np.clip(np.minimum(time, length - time) / taper, 0.0, 1.0)
    np.testing.assert_allclose(found, np.repeat((10 * x**3 - 15 * x**4 + 6 * x**5)[:, None], 2, axis=1), atol=1e-9)
