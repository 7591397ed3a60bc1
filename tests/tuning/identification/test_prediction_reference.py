"""Samples between steps: motions that are parabolas are predicted exactly, with their derivatives, whenever sampled."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from tuning.identification.fit.prediction import Predicted, predicted
from tuning.identification.fit.problem import Problem
from tuning.identification.model.variables import Variable
from tuning.identification.model.windows import SHORTEST, Rows, Windows
from tuning.identification.readers.log import Signal

STEPS, STEP, COUNT = 20, 0.01, 4
PLACES = [(0, 0, 0), (0, 1, 0), (1, 0, 1), (1, 2, 1), (0, 2, 2), (1, 0, 2), (1, 2, 3), (0, 1, 4)]  # limb, joint, kind
NAMES = tuple(f"s{n}" for n in range(len(PLACES)))
OF_KIND = ("position", "velocity", "effort", "force", "base_position")


def variable(key, limb=None):
    return Variable(key, "s", 0.0, 0.0, 1.0, -1.0, 1.0, limb=limb)


class Model:
    """A model whose records are polynomials of time, cubic nowhere; each variable adds a polynomial of its own."""

    def __init__(self, seed, jump=None, leads=0.0):
        draw = np.random.default_rng(seed)
        self.LEADS, self.jump, self.forced = leads, jump, False
        self.LATE = {f"log.{kind}.delay": (kind,) for kind in ("velocity", "effort", "force")}
        self.variables = (
            variable("a"), variable("log.velocity.delay"), variable("b", limb=1), variable("log.effort.delay"),
            variable("log.force.delay"),
        )  # fmt: skip
        self.lanes, self.memory = [[0], [2]], ()
        count = 300
        window = np.sort(draw.integers(0, COUNT, count))
        signal, step, share = draw.integers(0, len(PLACES), count), draw.integers(0, STEPS, count), draw.random(count)
        limb, joint, kind = np.array(PLACES).T
        # rates stand half a step before angles, so that a window's first has a share of a half at least
        share = np.where((kind[signal] == 1) & (step == 0), 0.5 + share / 2, share)
        rows = Rows(window, signal, step, share, draw.normal(size=count), np.arange(count))
        times = np.array([0.0, 9.0]) if jump is None else np.array([0.0, jump])
        command = Signal(times, np.array([0.0, 0.0 if jump is None else 1.0]))
        self.windows = Windows(
            begin=0.2 * np.arange(COUNT), abuts=np.array([False, True, False, True]), held_out=np.zeros(COUNT, bool),
            steps=STEPS, time_step=STEP, names=NAMES, limb=limb, joint=joint, kind=kind, rows=rows,
            start=np.zeros((COUNT, 2, 3, 2)), commands={(n, j): command for n in range(2) for j in range(3)},
            commanded="command", resting=np.zeros((2, 3)), gains={}, unknown=np.zeros((0, 2)), pauses=np.zeros((0, 2)),
            constant=(),
        )  # fmt: skip
        self.parameters = SimpleNamespace(force_sensor=SimpleNamespace(delay=0.0))
        # of kind, limb, joint: constant, slope, bend; behind a jump another parabola
        self.course = draw.normal(size=(2, 5, 2, 3, 3)) * [1.0, 2.0, 3.0]
        self.tangent = draw.normal(size=(4, 5, 2, 3, 3))  # of two lanes and two states

    def moves(self, variable, limb):
        return variable.limb is None or variable.limb == limb

    def at(self, course, kind, time):
        """A record over time: an angle, its rate, or a line."""
        a, b, c = course[kind][..., 0], course[kind][..., 1], course[kind][..., 2] * (kind < 2)
        time = np.asarray(time)[..., None, None]
        return a + b * time + c * time**2 if kind != 1 else b + 2 * c * time + 0 * a

    def recorded(self, course, kind, times):
        """As a simulation has it: a rate is the mean over the step before the angle's."""
        return self.at(course, kind, times - STEP / 2 if kind == 1 else times)

    def evaluate(self, x, start):
        for which in (np.array([0, 2]), np.array([1, 3])):
            times = self.windows.begin[which][:, None] + (np.arange(2 * STEPS + 1) - STEPS) * STEP
            values, tangents = {}, {}
            for n, kind in enumerate(OF_KIND):
                values[kind] = self.recorded(self.course[0], n, times)
                if self.jump is not None and n == 1:
                    later = (times - STEP / 2 > self.jump)[..., None, None]
                    values[kind] = np.where(later, self.recorded(self.course[1], n, times), values[kind])
                tangents[kind] = np.stack([self.recorded(own, n, times) for own in self.tangent], 1)
            yield which, values, tangents

    def torque_delay(self, x):
        return 0.0


@dataclasses.dataclass
class Expected:
    value: float
    along: dict
    rate: float


def by_hand(model, x, n):
    rows, windows = model.windows.rows, model.windows
    number = rows.signal[n]
    limb, joint, kind = PLACES[number]
    late = {1: x[1], 2: x[3], 3: x[4]}.get(kind, 0.0) + (0.004 if kind == 3 and model.forced else 0.0)
    time = windows.begin[rows.window[n]] + (rows.step[n] + rows.share[n] - (kind == 1) / 2) * STEP - late
    which = int(model.jump is not None and kind == 1 and time > model.jump)
    course = model.course[which]

    def value(own, moment):
        return float(model.at(own, kind, moment)[limb, joint])

    rate = (value(course, time + 1e-4) - value(course, time - 1e-4)) / 2e-4
    tangents = [value(own, time) for own in model.tangent]
    return time, Expected(value(course, time), tangents, rate)


@pytest.mark.parametrize("seed", range(4))
def test_parabolas_are_predicted_exactly(seed):
    model = Model(seed, leads=0.5)
    x, start = np.array([0.3, 0.0031, 0.1, -0.0024, 0.0055]), np.zeros((2, 2, 1, 2))
    found = predicted(model, x, start)
    assert found.finite
    stretch = model.windows.stretch[model.windows.rows.window]
    for n in range(len(found.value)):
        number = model.windows.rows.signal[n]
        limb, _, kind = PLACES[number]
        _, expected = by_hand(model, x, n)
        assert found.value[n] == pytest.approx(expected.value, abs=1e-9)
        assert found.rate[n] == pytest.approx(expected.rate, abs=1e-6)
        columns = np.zeros(5 + start.size)
        columns[0] = expected.along[0]
        columns[2] = expected.along[1] if limb == 1 else 0.0
        for place, of in ((1, 1), (3, 2), (4, 3)):
            columns[place] = -expected.rate if kind == of else 0.0
        first = 5 + (stretch[n] * 2 + limb) * 2
        columns[first : first + 2] = expected.along[2:]
        np.testing.assert_allclose(found.along[n], columns, atol=1e-6)


def test_a_force_is_late_by_its_sensor_too_where_that_is_not_fitted():
    model = Model(0, leads=0.5)
    model.forced, model.parameters.force_sensor.delay = True, 0.004
    found = predicted(model, np.zeros(5), np.zeros((2, 2, 1, 2)))
    for n in np.flatnonzero(np.isin(model.windows.rows.signal, [6, 4])):
        assert found.value[n] == pytest.approx(by_hand(model, np.zeros(5), n)[1].value, abs=1e-9)
    keyed = Model(0, leads=0.5)
    keyed.variables = (*keyed.variables[:4], variable("hardware.force_sensor.delay"))
    keyed.LATE = {"hardware.force_sensor.delay": ("force",)}
    keyed.parameters.force_sensor.delay = 0.004
    x = np.array([0, 0, 0, 0, 0.002])
    found = predicted(keyed, x, np.zeros((2, 2, 1, 2)))
    for n in np.flatnonzero(keyed.windows.rows.signal == 6):
        assert found.value[n] == pytest.approx(by_hand(keyed, x, n)[1].value, abs=1e-9)


@pytest.mark.parametrize("jump", [0.1, 0.305, 0.5512])
def test_rates_are_of_their_own_side_of_a_jump(jump):
    """Also beside it: a parabola never mixes steps of both sides."""
    model = Model(1, jump=jump, leads=0.5)
    found = predicted(model, np.zeros(5), np.zeros((2, 2, 1, 2)))
    near = 0
    for n in np.flatnonzero(np.isin(model.windows.rows.signal, [2, 3])):
        time, expected = by_hand(model, np.zeros(5), n)
        if abs(time - jump) > STEP / 2:  # the step in which it jumps has a part of it
            assert found.value[n] == pytest.approx(expected.value, abs=1e-9)
            near += abs(time - jump) < 2 * STEP
    assert near >= 3


def test_a_stretch_begins_without_the_window_before_it():
    """Samples are extrapolated from its own steps, and those of later windows go on across."""
    model = Model(2)
    plain = predicted(model, np.zeros(5), np.zeros((2, 2, 1, 2)))

    class Broken(Model):
        def evaluate(self, x, start):
            for which, values, tangents in super().evaluate(x, start):
                for kind in values:
                    first = np.isin(which, [0, 2])
                    values[kind][np.ix_(first, np.arange(STEPS))] = np.nan
                yield which, values, tangents

    broken = Broken(2)
    found = predicted(broken, np.zeros(5), np.zeros((2, 2, 1, 2)))
    rows, kind = model.windows.rows, np.array(PLACES)[:, 2]
    early = (kind[rows.signal] == 1) & (rows.step == 0) & np.isin(rows.window, [0, 2])
    np.testing.assert_allclose(found.value[~early], plain.value[~early], atol=1e-9)
    assert plain.finite and not plain._replace(value=plain.value * 1e30).finite
    assert not plain._replace(rate=np.full_like(plain.rate, np.nan)).finite


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize(("value", "finite"), [(0.9e20, True), (-0.9e20, True), (1.1e20, False), (-1.1e20, False),
                                               (np.nan, False), (-np.inf, False)])  # fmt: skip
def test_a_model_diverged_where_a_value_a_derivative_or_a_rate_is_huge(place, value, finite):
    made = [np.zeros(3), np.zeros((3, 2)), np.zeros(3)]
    made[place].flat[-1] = value
    assert Predicted(*made).finite is finite


@pytest.mark.parametrize("states", [0, 2])
@pytest.mark.parametrize("leads", [0.0, 0.004])
def test_what_is_fitted_and_what_is_predicted_by_loops(states, leads):
    """Behind a hole the first samples are fitted, and none that was recorded before the robot is known to be there."""
    rng = np.random.default_rng(0)
    rows = SimpleNamespace(step=rng.integers(0, 60, 400), share=rng.uniform(size=400), window=rng.integers(0, 4, 400),
                           signal=rng.integers(0, 3, 400))  # fmt: skip
    windows = SimpleNamespace(rows=rows, abuts=np.array([False, True, False, True]), kind=np.array([0, 1, 4]),
                              held_out=np.array([False, False, True, True]), time_step=0.001)  # fmt: skip
    found = SimpleNamespace(model=SimpleNamespace(windows=windows, guess=np.zeros(states), LEADS=leads))
    Problem.__post_init__(found)
    for row in range(400):
        since, window = 0.001 * (rows.step[row] + rows.share[row]), rows.window[row]
        early = (leads or (0.02 if windows.kind[rows.signal[row]] else 0.0)) > since and not windows.abuts[window]
        first = states > 0 and not windows.abuts[window] and since < SHORTEST
        assert found.fitted[row] == ((window < 2 or first) and not early)
        assert found.predicted[row] == (window >= 2 and not first and not early)
    assert found.fitted.any() and found.predicted.any()
