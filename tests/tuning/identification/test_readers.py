"""Logs: each format read to the rounding of what was written, and what is odd about one is said."""

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.robot.constants import load_robot
from tuning.identification.readers import read_log, write_csv

ROBOT = load_robot("hubrobo_v3_2")


def test_csv_keeps_every_number_and_each_signal_has_its_own_times(tmp_path):
    time = np.arange(5) / 3
    position, force = np.pi * time, np.where(np.arange(5) % 2, np.nan, np.sqrt(time + 2))
    write_csv(tmp_path / "log.csv", {"time": time, "LF.coxa.position": position, "RH.force.z": force})
    log = read_log(tmp_path / "log.csv", ROBOT)
    np.testing.assert_array_equal(log.signals["LF.coxa.position"].value, position)
    np.testing.assert_array_equal(log.signals["RH.force.z"].time, time[::2])
    np.testing.assert_array_equal(log.signals["RH.force.z"].value, force[::2])
    assert log.duration == time[-1]


@pytest.mark.parametrize(("text", "expected"), [
    ("time,LF.coxa.position\n0,1\n1\n2,3\n", r"log.csv: line 3: expected 2 cells as in line 1, got 1"),
    ("time,LF.coxa.position\n0,1\n1,x\n2,3\n", r"log.csv: LF.coxa.position, line 3: expected a number or .*, got 'x'"),
    ("time,LF.coxa.position\n", r"log.csv: expected a line of names and two samples or more, got 1 lines"),
])  # fmt: skip
def test_a_broken_table_is_told_in_one_line(tmp_path, text, expected):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(mc.ConfigError, match=expected):
        read_log(tmp_path / "log.csv", ROBOT)
