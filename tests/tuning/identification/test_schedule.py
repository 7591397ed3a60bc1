"""P gains over time: the targets of steps against quadrature of gain times command, by NumPy."""

import numpy as np
import pytest

from tuning.identification.model.schedule import Schedule, schedule_of
from tuning.identification.readers.log import KP, OFF, Signal

STEP = 1e-3


def weighed(schedule, command, at):
    """Return the mean of share times command over that of the share, by a triangle about a moment."""
    time = at + STEP * (np.arange(20000) + 0.5 - 10000) / 10000
    near = 1 - np.abs(time - at) / STEP
    share, sent = (
        value[np.maximum(np.searchsorted(begin, time, side="right") - 1, 0)]
        for begin, value in ((schedule.time, schedule.share), (command.time, command.value))
    )
    return (near * share * sent).sum() / (near * share).sum()


def test_targets_are_weighed_by_the_gain_where_both_change_at_once():
    schedule = Schedule(np.array([0.0, 0.02, 0.03]), np.array([1.0, 0.0, 0.5]), np.array([1.0, 0.0, 1.0]))
    command = Signal(np.arange(5) / 100, np.array([0.1, 0.2, -0.3, 0.4, 0.5]))
    for at in (0.0103, 0.0196, 0.0204, 0.0297, 0.0306, 0.0395):
        value, rate = schedule.targets(command, np.array([at]), STEP)
        assert value[0] == pytest.approx(weighed(schedule, command, at), abs=1e-4)
        ends = [schedule.targets(command, np.array([at + s]), STEP)[0][0] for s in (1e-8, -1e-8)]
        assert rate[0] == pytest.approx((ends[0] - ends[1]) / 2e-8, rel=1e-4, abs=1e-3)
    assert schedule.targets(command, np.array([0.025]), STEP)[0][0] == pytest.approx(-0.3)  # no torque asks for it


def test_a_gain_holds_until_the_next_and_is_none_while_the_torque_is_off():
    kp = Signal(np.array([0.0, 0.2]), np.array([50.0, 25.0]))
    off = Signal(np.array([0.1, 0.3, 0.4]), np.array([1.0, 0.0, 1.0]))
    found = schedule_of({KP: kp, OFF: off}, 100.0)
    np.testing.assert_array_equal(found.time, [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(found.on, [0, 0, 0, 1, 0])  # before its first sample a signal has that one's value
    np.testing.assert_array_equal(found.share, [0, 0, 0, 0.25, 0])
    assert schedule_of({KP: Signal(kp.time, np.full(2, 100.0))}, 100.0) is schedule_of({}, 100.0) is None
