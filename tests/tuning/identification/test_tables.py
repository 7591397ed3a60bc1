"""Tables in the layouts that loggers write: names in columns, stamps in two columns, dates, lists, many columns."""

import re

import numpy as np
import pytest

import mjx_climb as mc
from tests.tuning.identification.recorded import JOINTS, ROBOT, recorded
from tuning.identification.readers import read_log

IN_FILE = {name: f"{ROBOT.limbs[n]}.{ROBOT.joint_names[j]}" for name, (n, j) in ROBOT.places_in_file().items()}
NAMES = sorted(IN_FILE, key=lambda name: name[::-1])  # in an order of nobody's
COLUMNS = recorded()
ANGLES = np.column_stack([COLUMNS[f"{IN_FILE[name]}.position"] for name in NAMES])
TIME = COLUMNS["time"]


def written(tmp_path, heads, rows):
    """Write a table and return its path."""
    lines = [",".join(map(str, row)) for row in rows]
    (tmp_path / "log.csv").write_text("\n".join([",".join(heads), *lines]) + "\n")
    return tmp_path / "log.csv"


def numbered(form):
    return [form.format(number) for number in range(len(NAMES))]


def check(log, time=TIME):
    assert log.warnings == ()
    assert {*log.signals} == {f"{joint}.position" for joint in JOINTS}
    for name, angle in zip(NAMES, ANGLES.T, strict=True):
        signal = log.signals[f"{IN_FILE[name]}.position"]
        np.testing.assert_array_equal(signal.value, angle, err_msg=name)
        np.testing.assert_allclose(signal.time, time - time[0], atol=1e-6)


@pytest.mark.parametrize(("name", "position"), [
    ("field.name{}", "field.position{}"), ("name.{}", "position.{}"), ("joint_names[{}]", "actual.positions[{}]"),
    ("/joint_states/name.{}", "/joint_states/position.{}"), ("states_joint_name_{}", "states_position_{}"),
    ("motors.{}.name", "motors.{}.position"), ("actuator_labels_{}", "position_{}"),
])  # fmt: skip
def test_numbered_columns_are_of_the_joints_that_are_named_beside_them(tmp_path, name, position):
    rows = [(t, *NAMES, *angles) for t, angles in zip(TIME, ANGLES, strict=True)]
    log = read_log(written(tmp_path, ["time", *numbered(name), *numbered(position)], rows), ROBOT)
    check(log)
    again = read_log(tmp_path / "log.csv", ROBOT, log.guessed)
    assert all((again.signals[each].value == log.signals[each].value).all() for each in log.signals)


def test_names_may_be_counted_from_one_and_numbers_from_zero(tmp_path):
    rows = [(t, *NAMES, *angles) for t, angles in zip(TIME, ANGLES, strict=True)]
    heads = ["time", *(f"name{number + 1}" for number in range(12)), *numbered("position{}")]
    check(read_log(written(tmp_path, heads, rows), ROBOT))


def test_names_that_change_from_row_to_row_are_followed(tmp_path):
    """Two publishers of one topic, each with an order of its own, and one of other joints."""
    order, rows = np.arange(len(NAMES)), []
    for t, angles in zip(TIME, ANGLES, strict=True):
        order = order[::-1]
        rows += [(t, *(NAMES[n] for n in order), *angles[order]), (t + 0.001, "lid", *[""] * 11, 0.5, *[""] * 11)]
    check(read_log(written(tmp_path, ["time", *numbered("name.{}"), *numbered("position.{}")], rows), ROBOT))


@pytest.mark.parametrize("form", ["['{}']", '[""{}""]', "({})", "{}"])
def test_lists_in_cells_are_of_the_joints_that_a_list_beside_them_names(tmp_path, form):
    between = {"['{}']": "', '", '[""{}""]': '"", ""', "({})": " ", "{}": ";"}[form]
    names = form.format(between.join(NAMES))
    rows = [
        (t, f'"{names}"', f'"{angles.tolist()}"', f""" "array('d', {angles.tolist()})" """)
        for t, angles in zip(TIME, ANGLES, strict=True)
    ]
    log = read_log(written(tmp_path, ["time", "name", "position", "goal"], rows), ROBOT)
    assert log.warnings == () and len(log.signals) == 24
    for name, angle in zip(NAMES, ANGLES.T, strict=True):
        for what in ("position", "command"):
            np.testing.assert_array_equal(log.signals[f"{IN_FILE[name]}.{what}"].value, angle)


def test_entries_of_a_list_may_be_printed_with_their_type(tmp_path):
    rows = [
        (t, f'"{list(map(str, NAMES))}"', f'"[{", ".join(f"np.float64({angle})" for angle in angles.tolist())}]"')
        for t, angles in zip(TIME, ANGLES, strict=True)
    ]
    check(read_log(written(tmp_path, ["time", "name", "position"], rows), ROBOT))


@pytest.mark.parametrize("between", [";", "\t"])
def test_a_comma_between_semicolons_or_tabs_is_a_decimal_point(tmp_path, between):
    rows = [[t, *angles] for t, angles in zip(TIME, ANGLES, strict=True)]
    lines = [between.join(f"{each!r}" for each in map(float, row)).replace(".", ",") for row in rows]
    head = between.join(["time", *(f"{name}.position" for name in NAMES)])
    (tmp_path / "log.csv").write_text("\n".join([head, *lines]))
    check(read_log(tmp_path / "log.csv", ROBOT))


@pytest.mark.parametrize(("before", "behind"), [([""], []), ([], ["", ""]), (["-"], [])])
def test_columns_without_a_name_are_none_of_the_robots(tmp_path, before, behind):
    """The number of a row, and the commas at the end of each line."""
    rows = [[*[n] * len(before), t, *angles, *behind] for n, (t, angles) in enumerate(zip(TIME, ANGLES, strict=True))]
    heads = [*before, "time", *(f"{name}.position" for name in NAMES), *behind]
    check(read_log(written(tmp_path, heads, rows), ROBOT))


def test_a_row_for_each_joint_is_read_by_its_column_of_names(tmp_path):
    rows = [
        (t, name, angle) for t, row in zip(TIME, ANGLES, strict=True) for name, angle in zip(NAMES, row, strict=True)
    ]
    check(read_log(written(tmp_path, ["time", "joint", "position"], rows), ROBOT))


def test_numbers_are_not_taken_in_order_where_names_stand_that_are_not_as_many(tmp_path):
    rows = [(t, *NAMES, "lid", *angles) for t, angles in zip(TIME, ANGLES, strict=True)]
    heads = ["time", *numbered("name.{}"), "name.12", *numbered("position.{}")]
    with pytest.raises(mc.ConfigError, match=r"position #: 12 numbers not read: names of joints stand in the file"):
        read_log(written(tmp_path, heads, rows), ROBOT)


EPOCH = 1_766_147_454_233_218_075  # ns
STAMPS = [EPOCH + round(1e9 * t) for t in TIME]


def date(stamp, form="{}Z", between="T"):
    text = str(np.datetime64(stamp, "ns")).replace("T", between)
    return form.format(text)


@pytest.mark.parametrize(("heads", "cells"), [
    (["header.stamp.sec", "header.stamp.nanosec"], lambda t: divmod(t, 10**9)),
    (["header.stamp.secs", "header.stamp.nsecs"], lambda t: divmod(t, 10**9)),
    (["sequence", "nanosec", "sec"], lambda t: (t // 10**7, t % 10**9, t // 10**9)),
    (["sec", "msec"], lambda t: (t // 10**9, t % 10**9 // 10**6)),
    (["tv_sec", "tv_usec"], lambda t: (t // 10**9, t % 10**9 // 1000)),
    (["log_time"], lambda t: (date(t),)),
    (["recorded"], lambda t: (date(t, "{}+01:00", " "),)),
    (["Timestamp", "frame_id"], lambda t: (date(t, "{}"), "")),
    (["nanoseconds"], lambda t: (t,)),
    (["stamp_ns"], lambda t: (t - EPOCH,)),
    (["utime"], lambda t: (t // 1000,)),
], ids=range(11))  # fmt: skip
def test_clocks_of_loggers_are_read_to_a_microsecond(tmp_path, heads, cells):
    rows = [(*cells(stamp), *angles) for stamp, angles in zip(STAMPS, ANGLES, strict=True)]
    log = read_log(written(tmp_path, [*heads, *(f"{name}.position" for name in NAMES)], rows), ROBOT)
    check(log)


@pytest.mark.parametrize(("heads", "cells"), [
    (["time"], lambda t: (date(t),)),
    (["time"], lambda t: (t,)),
    (["stamp.sec", "stamp.nanosec"], lambda t: divmod(t, 10**9)),
], ids=["date", "ns", "two"])  # fmt: skip
def test_the_clock_is_known_where_columns_have_the_names_of_signals(tmp_path, heads, cells):
    rows = [(*cells(stamp), *angles) for stamp, angles in zip(STAMPS, ANGLES, strict=True)]
    check(read_log(written(tmp_path, [*heads, *(f"{IN_FILE[name]}.position" for name in NAMES)], rows), ROBOT))


def test_a_clock_that_loses_most_samples_is_refused_with_the_one_that_does_not(tmp_path):
    rows = [(*divmod(stamp, 10**9), *angles) for stamp, angles in zip(STAMPS, ANGLES, strict=True)]
    path = written(tmp_path, ["sec", "nanosec", *(f"{name}.position" for name in NAMES)], rows)
    (tmp_path / "signals.yaml").write_text(f"time: sec\nsignals: {{LF.coxa.position: {{column: {NAMES[0]}.position}}}}")
    expected = r"log.csv: time: sec: expected times that increase \(time: sec\+nanosec in signals.yaml\), got 989 of"
    with pytest.raises(mc.ConfigError, match=expected):
        read_log(path, ROBOT, tmp_path / "signals.yaml")


@pytest.mark.parametrize(("text", "expected"), [
    ("0.0,0.1,0.2\n0.1,0.1,0.2\n0.2,0.3,0.3\n", r"log.csv: line 1: expected the names of the columns .*, got the num"),
    ("0,1,2\n1,1,2\n2,3,3\n", r"log.csv: line 1: expected the names of the columns .*, got the number 0"),
    ("2025-12-19T12:30:54Z,x,0.1\n" * 3, r"log.csv: line 1: expected the names of the columns"),
    ("time,LF.coxa.position\n0,1\n6e307,2\n9e307,3\n", r"log.csv: time: times: expected below 1e\+100, got 9e\+307"),
    ("time,LF.coxa.position\n0,1\n1,2e300\n2,3\n", r"log.csv: LF.coxa.position: numbers: expected below 1e\+100, got"),
    ('time,q\n0,"[1, 2]"\n1,"[3]"\n2,"[3, 4]"\n', r"log.csv: q, line 3: expected a list of 2 numbers as in the first"),
    ("time,q\n" + f'0,"{[1] * 10_001}"\n' * 2, r"log.csv: q: expected lists of 10000 numbers at most, got 10001"),
    ("time,LF.coxa.position\n0,-\n1,2\n2,3\n", r"log.csv: LF.coxa.position, line 2: expected a number .*, got '-'"),
])  # fmt: skip
def test_a_table_that_cannot_be_read_is_told_in_one_line(tmp_path, text, expected):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(mc.ConfigError, match=expected) as refused:
        read_log(tmp_path / "log.csv", ROBOT)
    assert len(str(refused.value)) < 400 and "\n" not in str(refused.value)


@pytest.mark.parametrize("count", [9_999, 10_000])
def test_a_cell_of_ten_thousand_numbers_is_not_of_this_robot(tmp_path, count):
    (tmp_path / "log.csv").write_text("time,q\n" + "".join(f'{n},"{[1] * count}"\n' for n in range(3)))
    with pytest.raises(mc.ConfigError, match=re.escape(f"and {count - 11} more")):
        read_log(tmp_path / "log.csv", ROBOT)
