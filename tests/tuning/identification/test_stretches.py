"""A log in windows: where stretches end, which step a sample belongs to, and the ends of an interval."""

import numpy as np
import pytest

from tuning.identification.fit import inference
from tuning.identification.model import windows
from tuning.identification.model.variables import Variable
from tuning.identification.readers.log import Signal

STEP = 1e-3


@pytest.mark.parametrize(("period", "missing", "stretches"), [(0.01, 8, 1), (0.01, 11, 2), (0.05, 3, 1), (0.05, 6, 2)])
def test_a_silence_is_a_gap_once_it_is_longer_than_a_tenth_of_a_second_and_five_periods(period, missing, stretches):
    time = np.arange(0.0, 4.0, period)
    at = len(time) // 2
    left = np.delete(time, np.s_[at : at + missing])
    signals = [Signal(left, left)]
    begin, abuts, ends = windows._stretches(signals, 1.0, np.zeros((0, 2)), windows._pauses(signals))
    assert (~abuts).sum() == stretches and begin[0] == 0.0
    assert (ends > begin).all() and (ends[:-1] <= begin[1:] + 1e-9).all()


def test_a_velocity_stands_half_a_step_before_the_angle_of_its_step():
    time = np.array([0.0104, 0.0502])
    both = [Signal(time, np.ones(2)), Signal(time, np.ones(2))]
    rows = windows._rows(both, np.array([False, True]), np.zeros(1), np.ones(1), 1000, STEP)
    where = rows.step + rows.share
    np.testing.assert_allclose(where[rows.signal == 0], time / STEP)
    np.testing.assert_allclose(where[rows.signal == 1], time / STEP + 0.5)
    assert rows.stamp.tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize("log", [True, False])
def test_an_interval_ends_at_the_bounds(log):
    variable = Variable("a", "1", 1.0, mean=0.0, sd=1.0, lower=0.5, upper=1.5, log=log)
    x = 0.0 if log else 1.0
    assert inference.interval(variable, x, 10.0) == (0.5, 1.5)
    low, high = inference.interval(variable, x, 0.1)
    expected = np.exp([-0.1959964, 0.1959964]) if log else [0.8040036, 1.1959964]
    np.testing.assert_allclose([low, high], expected)
