"""What is wrong with a log is said in one line each, with how to say otherwise; of a sound log nothing is."""

import dataclasses
import re

import numpy as np
import pytest

from mjx_climb.scenario.messages import ConfigError
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


def zeros(columns, every=50):
    none = np.arange(1000) % every == 7 % every
    return columns | {name: np.where(none, 0.0, columns[name]) for name in POSITIONS}


def every_stamp_twice(columns):
    return {
        name: np.repeat(values, 2) + 0.05 * (name != "time") * (np.arange(2000) % 2) for name, values in columns.items()
    }


def zeros_every_other_row(columns):
    return zeros(columns, 2)


def zeros_before_the_first_read(columns):
    return columns | {name: np.where(np.arange(1000) < 30, 0.0, columns[name]) for name in POSITIONS}


def lost_reads_of_one_joint(columns):
    return columns | {"RH.tibia.position": np.where(np.arange(1000) % 90 == 5, 0.0, columns["RH.tibia.position"])}


def efforts_of_zero(columns):
    """Beside positions that are measured."""
    effort = 2.0 + np.sin(np.arange(1000) / 50)
    return columns | {f"{joint}.effort": np.where(np.arange(1000) % 50 == 7, 0.0, effort) for joint in JOINTS}


def frozen(columns):
    """Its driver lost the joint after 7 s."""
    return columns | {"RF.coxa.position": columns["RF.coxa.position"][np.minimum(np.arange(1000), 700)]}


def spikes(columns):
    return columns | {"LF.coxa.position": columns["LF.coxa.position"] + 0.9 * (np.arange(1000) % 111 == 60)}


def two_publishers(columns):
    """Of the robot, and of a copy of it that stands still 0.5 rad away."""
    other = np.arange(1000) % 2 == 1
    return columns | {name: np.where(other, columns[name][0] + 0.5, columns[name]) for name in POSITIONS}


def currents(bits=16, sign_bit=None):
    """Return columns with whole efforts whose negative ones lost their sign."""

    def of(columns):
        current = np.round(30 * np.sin(np.arange(1000) / 50) + 3)
        lost = 2.0**sign_bit - current if sign_bit else current + 2.0**bits
        return columns | {f"{joint}.effort": np.where(current < 0, lost, current) for joint in JOINTS}

    of.__name__ = f"current_{bits}_{sign_bit}"
    return of


CURRENTS = {bits: currents(bits) for bits in (12, 16, 32)}
SIGN_BIT = currents(sign_bit=10)


def loads(columns):
    """As AX-12 give them: 11 bits, of which the highest is the sign."""
    load = np.round(900 * np.sin(np.arange(1000) / 50))
    return columns | {"LF.coxa.effort": np.where(load < 0, 1024 - load, load)}


def small_degrees(columns):
    """Motions that stay within the joint's limits in either unit."""
    middle = {name: columns[name].mean() for name in columns}
    small = {name: middle[name] + (columns[name] - middle[name]) / 100 for name in columns if name != "time"}
    small |= {name: middle[name] + np.degrees(small[name] - middle[name]) for name in POSITIONS}
    return columns | {name: small[name] for name in small}


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
WRONG |= {
    zeros: "LF.coxa.position and 11 more: 20 of 1000 samples are 0 and none beside them is near, .*outliers: drop",
    zeros_every_other_row: "LF.coxa.position and 11 more: 500 of 1000 samples are 0 and none beside them is near",
    zeros_before_the_first_read: "LF.coxa.position and 11 more: 30 of 1000 samples are 0 and none beside",
    lost_reads_of_one_joint: "RH.tibia.position: 12 of 1000 samples are 0 and none beside them is near",
    every_stamp_twice: "LF.coxa.command and 23 more: 1000 of 2000 samples come no later than one before them: left out",
    efforts_of_zero: "LF.coxa.effort and 11 more: 20 of 1000 samples are 0 and none beside them is near",
    frozen: "RF.coxa.position: the same from 7 to 9.99 s while its command moves, suspected to be stuck",
    spikes: "LF.coxa.position: 9 of 1000 samples jump away from those beside them and back, .*outliers: drop",
    two_publishers: "LF.coxa.position and 11 more: 9.. of 1000 samples .*suspected to be of two publishers .take one",
    **{of: f"LF.coxa.effort and 11 more: suspected to be numbers of {bits} bits .*bits: {bits} in signals.yaml, .*all"
       for bits, of in CURRENTS.items()},
    SIGN_BIT: "LF.coxa.effort and 11 more: suspected to be .* 11 bits read without their sign .sign_bit: 10 in",
    loads: "LF.coxa.effort: suspected to be numbers of 11 bits read without their sign .sign_bit: 10 in signals.yaml",
    small_degrees: "LF.coxa.position and 11 more: moves 57 times as far as its command, suspected to be degrees",
}  # fmt: skip
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


def test_a_reading_at_a_reversal_is_not_stale(tmp_path):
    """Counts 1127, 1130, 1130, 1127: where a joint turns round, friction shows most."""
    turning = np.r_[np.arange(1100, 1131, 3), np.arange(1130, 1099, -3)]
    counts = np.concatenate([np.arange(1080, 1100), *[turning] * 10])
    time = np.arange(len(counts)) / 200
    position = 2 * np.pi / 4096 * (counts - 2048)
    log = read(tmp_path, {"time": time, "LF.coxa.command": np.sin(20 * time), "LF.coxa.position": position})
    assert len(log.signals["LF.coxa.position"].time) == len(time)


@pytest.mark.parametrize("break_it", WRONG, ids=lambda function: function.__name__)
def test_what_is_wrong_is_said_in_one_line(tmp_path, break_it):
    columns = break_it(recorded())
    log = read(tmp_path, columns)
    assert len(log.warnings) == ONLY.get(break_it, 1), log.warnings
    for line in log.warnings:
        assert "\n" not in line and line.startswith(str(tmp_path / "log.csv")) and len(line) < 400
    assert all(re.search(WRONG[break_it], line) for line in log.warnings), log.warnings
    # never a silent correction
    for name in set(log.signals) & set(columns) if break_it != every_stamp_twice else ():
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
    (degrees, {f"{joint}.command": {"column": f"{joint}.command", "unit": "rad"} for joint in JOINTS}, {"unit": "deg"}),
    (zeros, {}, {"outliers": "drop"}),
    (zeros_every_other_row, {}, {"outliers": "keep"}),
    (efforts_of_zero, {}, {"outliers": "drop"}),
    (spikes, {}, {"outliers": "drop"}),
    (two_publishers, {}, {"outliers": "keep"}),
    *((of, {f"{joint}.effort": {"bits": bits} for joint in JOINTS}, {}) for bits, of in CURRENTS.items()),
    (SIGN_BIT, {f"{joint}.effort": {"sign_bit": 10} for joint in JOINTS}, {}),
    (CURRENTS[16], {}, {"bits": 16}),
    (SIGN_BIT, {f"{joint}.position": {"bits": 12} for joint in JOINTS}, {"sign_bit": 10}),
    (gap, {}, {"rate": 100 / 250}),
    (swapped, {f"{a}.{joint}.position": {"column": f"{b}.{joint}.position"} for a, b in (("LF", "RF"), ("RF", "LF"))
               for joint in ROBOT.joint_names}, {}),
])  # fmt: skip
def test_the_answer_that_a_line_asks_for_settles_it(tmp_path, break_it, answer, top):
    columns = break_it(recorded())
    sources = {name: {"column": name, **answer.get(name, {})} for name in columns if name != "time"}
    assert read(tmp_path, columns, Signals.make({"time": "time", "signals": sources, **top})).warnings == ()


@pytest.mark.parametrize(("length", "kept"), [(3, 997), (4, 1000)])
def test_a_joint_alone_is_at_rest_where_it_reads_0_for_long(tmp_path, length, kept):
    """A lost read, or two, or three, are none of it: of four samples it may be at rest there."""
    columns = recorded()
    columns["RH.tibia.position"][500 : 500 + length] = 0.0
    log = read(tmp_path, columns, Signals.make({"outliers": "drop"}))
    assert len(log.signals["RH.tibia.position"].time) == kept


@pytest.mark.parametrize(("shift", "kept"), [(0.0, 999), (1.5, 1000)])
def test_a_sample_between_two_that_are_far_apart_is_no_outlier(tmp_path, shift, kept):
    """It jumps away and back alike; a joint that overshoots where it is moved does so too."""
    columns = recorded()
    columns["RH.tibia.position"][501:] += shift
    columns["RH.tibia.position"][500] += 3.0
    log = read(tmp_path, columns, Signals.make({"outliers": "drop"}))
    assert len(log.signals["RH.tibia.position"].time) == kept


def test_dropped_zeros_leave_the_rest_of_their_messages_as_it_was(tmp_path):
    columns = recorded() | {"base.force.x": np.arange(1000.0)}
    broken = zeros(columns | {"LF.coxa.velocity": np.gradient(columns["LF.coxa.position"], columns["time"])})
    none = broken["RH.femur.position"] == 0
    broken |= {"LF.coxa.velocity": np.where(none, 0.0, broken["LF.coxa.velocity"])}
    log = read(tmp_path, broken, Signals.make({"outliers": "drop"}))
    assert log.warnings == () and none.sum() == 20
    for name in (*POSITIONS, "LF.coxa.velocity"):
        np.testing.assert_array_equal(log.signals[name].value, broken[name][~none])
        np.testing.assert_array_equal(log.signals[name].time, columns["time"][~none])
    assert len(log.signals["LF.coxa.command"].time) == len(log.signals["base.force.x"].time) == 1000


@pytest.mark.parametrize("of", [*CURRENTS.values(), SIGN_BIT], ids=lambda of: of.__name__)
def test_signs_come_back_to_the_last_bit(tmp_path, of):
    key = {"sign_bit": 10} if of is SIGN_BIT else {"bits": next(bits for bits in CURRENTS if CURRENTS[bits] is of)}
    source = {"column": "LF.coxa.effort", "unit": "mA", "torque_constant": 2.0, "zero": 3, **key}
    columns = of(recorded())
    log = read(tmp_path, columns, Signals.make({"time": "time", "signals": {"LF.coxa.effort": source}}))
    expected = 2e-3 * np.round(30 * np.sin(np.arange(1000) / 50))
    np.testing.assert_allclose(log.signals["LF.coxa.effort"].value, expected, atol=1e-12)


def test_where_the_sign_of_all_would_spoil_another_signal_it_is_said_of_the_signal(tmp_path):
    """As a load with a sign bit beside a position of 0 to 4095 counts."""
    columns = SIGN_BIT(recorded())
    for name, most in (("LF.coxa.position", 1023), ("RH.tibia.position", 4095)):
        columns[name] = np.round(np.linspace(0, most, 1000))
        (said,) = [line for line in read(tmp_path, columns).warnings if "without their sign" in line]
        assert said.endswith("sign_bit: 10 in signals.yaml" + (", of the signal or of all)" if most == 1023 else ")"))


def test_what_a_signal_says_goes_before_what_the_file_says_of_all(tmp_path):
    raw = {"time": np.arange(9.0), "LF.force.x": np.r_[np.zeros(8), 65527], "LF.force.y": np.r_[np.zeros(8), 4095]}
    raw["LF.force.z"] = np.r_[np.zeros(8), 32777]
    (tmp_path / "signals.yaml").write_text(
        "time: time\nbits: 16\nsignals:\n  LF.force.x: {column: LF.force.x}\n"
        "  LF.force.y: {column: LF.force.y, bits: 12}\n  LF.force.z: {column: LF.force.z, sign_bit: 15}\n"
    )
    found = read(tmp_path, raw, tmp_path / "signals.yaml").signals
    assert [found[f"LF.force.{axis}"].value[-1] for axis in "xyz"] == [-9, -1, -9]
    with pytest.raises(ConfigError, match=r"expected bits or sign_bit, one of the two, got 'bits 16, sign_bit 10'"):
        Signals.make({"bits": 16, "sign_bit": 10})


def test_counts_of_32_bits_are_both_counts_and_without_their_sign(tmp_path):
    columns = recorded()
    turned = np.round((columns["LF.coxa.position"] - columns["LF.coxa.position"].mean()) / (2 * np.pi) * 4096)
    said = read(tmp_path, columns | {"LF.coxa.position": np.where(turned < 0, turned + 2.0**32, turned)}).warnings
    assert any("bits: 32" in line for line in said) and any("unit: counts" in line for line in said)


@pytest.mark.parametrize(("efforts", "expected"), [(0.6, ()), (4.0, ("more than 3 times",)), (600.0, ("than 100 ",))])
def test_torques_that_no_drive_has_are_of_another_unit(tmp_path, efforts, expected):
    columns = recorded()
    columns |= {f"{joint}.effort": efforts * np.sin(9 * columns["time"]) for joint in JOINTS}
    write_csv(tmp_path / "log.csv", columns)
    robot = dataclasses.replace(ROBOT, torque_limit=np.ones((4, 3)))
    said = read_log(tmp_path / "log.csv", robot).warnings
    assert len(said) == len(expected) and all(f" {words}" in line for words, line in zip(expected, said, strict=True))


@pytest.mark.parametrize("form", ["{}.{}", "{}_{}_pos"])
def test_one_unit_does_for_a_whole_file(tmp_path, form):
    """By the names of signals, and guessed; rates are in degrees a second then, and no force is."""
    columns = recorded()
    columns |= {f"{joint}.velocity": np.gradient(columns[f"{joint}.position"], columns["time"]) for joint in JOINTS}
    names = {f"{joint}.{what}": f"{joint}.{what}" if "{}.{}" == form else f"{joint.replace('.', '_')}_{what}"
             for joint in JOINTS for what in ("command", "position", "velocity")}  # fmt: skip
    file = {"time": columns["time"]} | {names[name]: np.degrees(columns[name]) for name in names}
    (tmp_path / "signals.yaml").write_text("unit: deg\n")
    log = read(tmp_path, file | {"LF.force.z" if form == "{}.{}" else "LF_force_z": columns["time"]},
               tmp_path / "signals.yaml")  # fmt: skip
    assert log.warnings == ()
    for name in names:
        np.testing.assert_allclose(log.signals[name].value, columns[name], rtol=1e-12, err_msg=name)
    np.testing.assert_array_equal(log.signals["LF.force.z"].value, columns["time"])
    assert log.guessed is None or log.guessed.to_yaml().startswith("time: time\nunit: deg\n")


@pytest.mark.parametrize("late", [20, 40])
def test_a_joint_that_follows_a_step_late_is_not_stuck_before_it(tmp_path, late):
    time = np.arange(1000) / 100
    columns = {"time": time, "LF.coxa.command": np.where(time < 5, 0.0, 0.5)}
    said = read(tmp_path, columns | {"LF.coxa.position": np.where(time < 5 + late / 100, 0.0, 0.4)}).warnings
    assert any("the same from 0 to" in line for line in said) == (late > 30)


@pytest.mark.parametrize("steps", ["square", "rest"])
def test_commands_of_zero_and_joints_at_rest_there_are_no_outliers(tmp_path, steps):
    time = np.arange(1000) / 100
    command = np.where(time % 2 < 1, 0.5, 0.0) if steps == "square" else np.where(time < 5, 0.0, 0.5)
    late = np.concatenate([np.full(8, command[0]), np.convolve(command, np.ones(8) / 8, "valid")])[:1000]
    columns = {"time": time}
    for joint in JOINTS:
        columns |= {f"{joint}.command": command, f"{joint}.position": late}
    said = [line for line in read(tmp_path, columns).warnings if "samples" in line and "repeat" not in line]
    assert said == []


def test_what_is_suspected_is_said_before_anything_is_fitted(tmp_path, capsys):
    from tuning.command_line import program

    write_csv(tmp_path / "log.csv", degrees(recorded()))
    typed = ["identify", "case_1_1", "--log", str(tmp_path / "log.csv"), "--fit", "no.such.key"]
    assert program.run(typed) == 2
    warned, _, refused = capsys.readouterr().err.partition("error: ")
    assert "suspected to be degrees (unit: deg in signals.yaml" in warned and "no.such.key" in refused
