"""What is wrong with a log is said in one line each, with how to say otherwise; of a sound log nothing is."""

import re

import numpy as np
import pytest

from tests.tuning.identification.recorded import JOINTS, ROBOT, recorded
from tuning.identification.readers import read_log, write_csv
from tuning.identification.readers.signals import Signals

POSITIONS = [f"{joint}.position" for joint in JOINTS]


def gap(columns):
    return {name: np.delete(values, np.s_[300:420]) for name, values in columns.items()}


def flipped(columns):
    return columns | {"RH.femur.position": -columns["RH.femur.position"]}


def degrees(columns):
    return columns | {name: np.degrees(columns[name]) for name in POSITIONS}


def counts(columns):
    return columns | {name: (2048 + columns[name] / (2 * np.pi) * 4096).round() for name in POSITIONS}


def milliseconds(columns):
    return columns | {"time": 1e3 * columns["time"]}


def wrong_name(columns):
    return {name.replace("LH.tibia.pos", "LH.tibja.pos"): values for name, values in columns.items()}


def stuck(columns):
    return columns | {"RF.coxa.position": np.full(1000, 0.25)}


def stuck_rate(columns):
    return columns | {f"{joint}.velocity": np.full(1000, 0.1) for joint in JOINTS}


def stuck_force(columns):
    return columns | {f"LF.force.{axis}": np.full(1000, 2.5) for axis in "xyz"}


def swapped(columns):
    limbs = {"LF": "RF", "RF": "LF"}
    return {
        f"{limbs.get(name[:2], name[:2])}{name[2:]}" if name.endswith("position") else name: values
        for name, values in columns.items()
    }


def jitter(columns):
    return columns | {"time": columns["time"] + 0.009 * np.random.default_rng(2).random(1000)}


def early(columns):
    rows = 25  # the position's clock is 0.25 s behind
    return {
        name: values[:-rows] if name == "time" or name.endswith("command") else values[rows:]
        for name, values in columns.items()
    }


def rates(columns):
    return columns | {
        f"{joint}.velocity": np.degrees(np.gradient(columns[f"{joint}.position"], columns["time"])) for joint in JOINTS
    }


WRONG = {
    gap: "LF.coxa.command and 23 more: 1 gaps, the longest from 2.99 to 4.2 s, where samples come every 0.01 s",
    flipped: "RH.femur.position: goes against its command, .*sign: -1",
    degrees: "LF.coxa.position and 11 more: .*suspected to be degrees .unit: deg",
    counts: "LF.coxa.position and 11 more: .*suspected to be encoder counts .unit: counts",
    milliseconds: "times: a sample every 10 s, suspected to be ms .time_unit: ms",
    wrong_name: "LH.tibja.position: not read, the robot has no such signal .did you mean LH.tibia.position",
    stuck: "RF.coxa.position: the same all the time while its command moves by 0.4 rad, suspected to be stuck",
    stuck_rate: "LF.coxa.velocity and 11 more: the same all the time while its joint moves, suspected to be stuck",
    stuck_force: "LF.force.x and 2 more: the same all the time while its limb moves, suspected to be stuck",
    swapped: "(LF: its positions follow the commands of RF|RF: its .* commands of LF), suspected to be swapped limbs",
    jitter: "LF.coxa.command and 23 more: samples come every 0.0[0-9]* s with a jitter of 3. %",
    early: "positions: come 0.22 s before their commands, suspected to be another clock .shift: 0.22",
    rates: "LF.coxa.velocity and 11 more: 57 times the angle's rate, suspected to be deg/s .unit: deg/s",
}
ONLY = {swapped: 2, degrees: 1}


def read(tmp_path, columns, signals=None):
    write_csv(tmp_path / "log.csv", columns)
    return read_log(tmp_path / "log.csv", ROBOT, signals)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2])
def test_of_a_sound_log_nothing_is_said(tmp_path, noise):
    assert read(tmp_path, recorded(noise=noise)).warnings == ()
    assert read(tmp_path, recorded(rate=10.0, duration=30.0, noise=noise)).warnings == ()


def test_slow_motion_between_the_steps_of_an_encoder_is_not_stale(tmp_path):
    time, step = np.arange(3000) / 100, 2 * np.pi / 4096
    slow = 0.05 * np.sin(2 * np.pi * 0.2 * time)
    columns = {"time": time, "LF.coxa.command": slow, "LF.coxa.position": np.round(slow / step) * step}
    log = read(tmp_path, columns)
    assert (np.diff(columns["LF.coxa.position"]) == 0).mean() > 0.5
    np.testing.assert_array_equal(log.signals["LF.coxa.position"].value, columns["LF.coxa.position"])
    held = {**columns, "LF.coxa.position": columns["LF.coxa.position"][np.arange(3000) // 20 * 20]}  # read at 5 Hz
    (said,) = [line for line in read(tmp_path, held).warnings if "stale" in line]
    assert int(re.search(r"(\d+) of 3000", said)[1]) > 2000


@pytest.mark.parametrize("break_it", WRONG, ids=lambda function: function.__name__)
def test_what_is_wrong_is_said_in_one_line(tmp_path, break_it):
    columns = break_it(recorded())
    log = read(tmp_path, columns)
    assert len(log.warnings) == ONLY.get(break_it, 1), log.warnings
    for line in log.warnings:
        assert "\n" not in line and line.startswith(str(tmp_path / "log.csv")) and len(line) < 400
    assert all(re.search(WRONG[break_it], line) for line in log.warnings), log.warnings
    # never a silent correction
    for name in set(log.signals) & set(columns):
        np.testing.assert_array_equal(log.signals[name].value, columns[name])


@pytest.mark.parametrize("value", [0.0, -0.0, 1e-308])
@pytest.mark.parametrize("kind", ["velocity", "effort"])
def test_what_no_sensor_measured_is_left_out_by_name(tmp_path, kind, value):
    """NumPy's warnings are errors here: none comes of such columns."""
    none = {f"{joint}.{kind}": np.full(1000, value) for joint in JOINTS}
    log = read(tmp_path, recorded() | none)
    assert not any(name.endswith(kind) for name in log.signals) and len(log.signals) == 24
    assert [line.partition(": ")[2] for line in log.warnings] == [
        f"LF.coxa.{kind} and 11 more: 0 all along while the joint moves, not measured: left out"
    ]


def test_a_joint_at_rest_at_zero_is_measured(tmp_path):
    still = {f"RF.coxa.{kind}": np.zeros(1000) for kind in ("command", "position", "velocity")}
    log = read(tmp_path, recorded() | still)
    assert not log.signals["RF.coxa.velocity"].value.any() and log.warnings == ()


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


@pytest.mark.parametrize("which", [("position",), ("command",), ("command", "position")])
def test_jumps_by_a_turn_are_unwrapped_and_named(tmp_path, which):
    columns = recorded()
    beyond = 3.1 - ROBOT.stance_joints[0, 0]
    columns |= {f"LF.coxa.{kind}": columns[f"LF.coxa.{kind}"] + beyond for kind in ("command", "position")}
    cut = columns | {f"LF.coxa.{kind}": wrapped(columns[f"LF.coxa.{kind}"]) for kind in which}
    log = read(tmp_path, cut)
    apart = log.signals["LF.coxa.position"].value - columns["LF.coxa.position"]
    np.testing.assert_allclose(apart, np.broadcast_to(2 * np.pi * np.round(apart[0] / 2 / np.pi), 1000), atol=1e-9)
    np.testing.assert_allclose(
        log.signals["LF.coxa.command"].value - columns["LF.coxa.command"], apart, atol=1e-9
    )  # the two go together
    (said,) = [line for line in log.warnings if "jumps of 2 pi" in line]
    counts = [int((np.abs(np.diff(cut[f"LF.coxa.{kind}"])) > 3).sum()) for kind in which]
    more = " and 1 more" if len(which) > 1 else ""
    assert f"LF.coxa.{which[0]}{more}: {sum(counts)} jumps of 2 pi between neighbours, unwrapped (turns: keep" in said
    sources = {name: {"column": name} for name in cut if name != "time"}
    kept = read(tmp_path, cut, Signals.make({"time": "time", "turns": "keep", "signals": sources}))
    np.testing.assert_array_equal(kept.signals[f"LF.coxa.{which[0]}"].value, cut[f"LF.coxa.{which[0]}"])
    assert not any("2 pi" in line for line in kept.warnings)


def test_a_position_that_is_a_turn_off_its_command_is_named(tmp_path):
    columns = recorded()
    log = read(tmp_path, columns | {"LF.coxa.position": columns["LF.coxa.position"] - 2 * np.pi})
    np.testing.assert_allclose(log.signals["LF.coxa.position"].value, columns["LF.coxa.position"], atol=1e-9)
    assert [line.partition(": ")[2][:60] for line in log.warnings] == [
        "LF.coxa.position: whole turns off the command, taken away (turns: keep in signals.yaml keeps them)"[:60]
    ]


@pytest.mark.parametrize(("break_it", "answer", "top"), [
    (flipped, {"RH.femur.position": {"sign": -1}}, {}),
    (degrees, {name: {"unit": "deg"} for name in POSITIONS}, {}),
    (counts, {name: {"unit": "counts", "counts_per_turn": 4096, "zero": 2048} for name in POSITIONS}, {}),
    (milliseconds, {}, {"time_unit": "ms"}),
    (early, {name: {"shift": 0.25} for name in POSITIONS}, {}),
    (rates, {f"{joint}.velocity": {"unit": "deg/s"} for joint in JOINTS}, {}),
    (gap, {}, {"longest_gap": 200}),
    (swapped, {f"{a}.{joint}.position": {"column": f"{b}.{joint}.position"} for a, b in (("LF", "RF"), ("RF", "LF"))
               for joint in ROBOT.joint_names}, {}),
])  # fmt: skip
def test_the_answer_that_a_line_asks_for_settles_it(tmp_path, break_it, answer, top):
    columns = break_it(recorded())
    sources = {name: {"column": name, **answer.get(name, {})} for name in columns if name != "time"}
    assert read(tmp_path, columns, Signals.make({"time": "time", "signals": sources, **top})).warnings == ()
