"""Logs: each format read to the rounding of what was written, in three layouts of public drivers among them."""

import dataclasses
import shutil
import types
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from rosbags.rosbag2 import StoragePlugin

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.reading import readers_in
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.viz.recording import save_mcap
from tests.tuning.identification.recorded import JOINTS, ROBOT, bag, joint_state, number, recorded, wrench
from tuning.identification.readers import formats, read_log, record, write_csv
from tuning.identification.readers.formats import csv_file, netcdf_file, rosbag
from tuning.identification.readers.guess import guess
from tuning.identification.readers.log import signals_of
from tuning.identification.readers.signals import Signals
from tuning.identification.readers.table import Recording, Table

EPOCH = 1_764_000_000 * 10**9  # ns
TWELVE = ",".join(f"x{n}" for n in range(1, 12))  # beside their times


@pytest.fixture(scope="module")
def pushed():
    """A short walk with a push."""
    return mc.rollout(mc.Scenario().with_overrides({
        "duration": 0.3, "gait.cycle": 0.1, "gait.stride": 0.005, "gait.step_height": 0.005,
        "disturbance.pushes": [{"force": [-5.0, 0.0, 0.0], "moment": [0.0, 0.0, 1.0], "start": 0.05, "stop": 0.08}],
    }))  # fmt: skip


def test_csv_keeps_every_number_and_each_signal_has_its_own_times(tmp_path):
    time = np.arange(5) / 3
    position, force = np.pi * time / 10, np.where(np.arange(5) % 2, np.nan, np.sqrt(time + 2))
    write_csv(tmp_path / "log.csv", {"time": time, "LF.coxa.position": position, "RH.force.z": force})
    log = read_log(tmp_path / "log.csv", ROBOT)
    np.testing.assert_array_equal(log.signals["LF.coxa.position"].value, position)
    np.testing.assert_array_equal(log.signals["RH.force.z"].time, time[::2])
    np.testing.assert_array_equal(log.signals["RH.force.z"].value, force[::2])
    assert (log.duration, log.guessed, log.warnings) == (time[-1], None, ())


@pytest.mark.parametrize(("text", "expected"), [
    ("time,LF.coxa.position\n0,1\n1\n2,3\n", r"log.csv: line 3: expected 2 cells as in line 1, got 1"),
    ("time,LF.coxa.position\n0,1\n1,x\n2,3\n", r"log.csv: LF.coxa.position, line 3: expected a number or .*, got 'x'"),
    ("time,LF.coxa.position\n", r"log.csv: expected a line of names and two samples or more, got 1 lines"),
    ("when,LF.coxa.position\n0,1\n1,2\n", r"log.csv: time: expected a column of times in .*, got no time with"),
    (f"time,{TWELVE}\n0{',1' * 11}\n1{',2' * 11}\n", rf"log.csv: .*, got time, {TWELVE.replace(',', ', ')}$"),
    (f"time,{TWELVE},x12,x13\n0{',1' * 13}\n1{',2' * 13}\n", rf", got time, {TWELVE.replace(',', ', ')} and 2 more$"),
    ("time,colour\n0,1\n1,2\n", r"log.csv: expected signals such as LF.coxa.command, .*, got time, colour"),
])  # fmt: skip
def test_a_broken_table_is_told_in_one_line(tmp_path, text, expected):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(mc.ConfigError, match=expected):
        read_log(tmp_path / "log.csv", ROBOT)


@pytest.mark.slow
def test_a_walk_of_run_is_read_by_its_own_names(pushed, tmp_path):
    walk = pushed
    dataset.save(dataset.to_dataset(walk), tmp_path / "trajectory.nc")
    log = read_log(tmp_path / "trajectory.nc", ROBOT, Signals(time="time", repeats="keep", signals={
        name: {"column": name} for name in (
            "RH.femur.command", "RH.femur.position", "RH.femur.velocity", "RH.femur.effort", "LH.force.z", "LF.support",
            "base.orientation.w", "base.position.z", "base.linear_velocity.x", "base.force.x", "base.moment.z",
        )
    }))  # fmt: skip
    for name, values in {
        "RH.femur.command": walk.joint_targets[:, 2, 1], "RH.femur.position": walk.joint_angles[:, 2, 1],
        "RH.femur.velocity": walk.joint_rates[:, 2, 1], "RH.femur.effort": walk.joint_torque[:, 2, 1],
        "LH.force.z": walk.foot_force[:, 1, 2], "LF.support": walk.support[:, 0],
        "base.orientation.w": walk.base_orientation[:, 0], "base.position.z": walk.base_position[:, 2],
        "base.linear_velocity.x": walk.base_linear_velocity[:, 0], "base.force.x": walk.push[:, 0],
        "base.moment.z": walk.push[:, 5],
    }.items():  # fmt: skip
        np.testing.assert_array_equal(log.signals[name].value, values.astype(float), err_msg=name)
        np.testing.assert_array_equal(log.signals[name].time, walk.time)
    whole = read_log(tmp_path / "trajectory.nc", ROBOT)
    assert (whole.guessed, whole.warnings) == (None, ())
    late = dataclasses.replace(walk, scenario=walk.scenario.with_overrides({"hardware.command_delay": 0.004}))
    dataset.save(dataset.to_dataset(late), tmp_path / "late.nc")
    (said,) = read_log(tmp_path / "late.nc", ROBOT).warnings
    assert "commands are those that reached the servos, 0.004 s after they were sent" in said


@pytest.mark.parametrize("form", ["folder", ".mcap", ".db3"])
def test_encoders_as_a_topic_each_at_ten_hertz_without_efforts(tmp_path, form):
    columns = recorded(rate=10.0)
    times = [EPOCH + round(1e9 * t) for t in columns["time"]]
    topics = {
        f"/{joint.split('.')[0]}/Joint{1 + place % 3}": (
            "std_msgs/msg/Float64", [(t, number(v)) for t, v in zip(times, columns[f"{joint}.position"], strict=True)],
        ) for place, joint in enumerate(JOINTS)
    }  # fmt: skip
    path = bag(tmp_path / "bag", topics, StoragePlugin.SQLITE3 if form == ".db3" else StoragePlugin.MCAP)
    path = path if form == "folder" else next(path.glob(f"*{form}"))
    log = read_log(path, ROBOT)
    assert set(log.signals) == {f"{joint}.position" for joint in JOINTS}
    for joint in JOINTS:
        np.testing.assert_array_equal(log.signals[f"{joint}.position"].value, columns[f"{joint}.position"])
        np.testing.assert_allclose(log.signals[f"{joint}.position"].time, columns["time"], atol=1e-9)
    assert "  LF.coxa.position: {topic: /LF/Joint1}\n" in log.guessed.to_yaml()


def test_one_message_without_a_stamp_leaves_a_topic_the_times_of_its_headers(tmp_path):
    stamps = [EPOCH, 0, EPOCH + 2 * 10**7]
    messages = [(EPOCH + 10**7 * n, joint_state(stamp, JOINTS, np.zeros(12))) for n, stamp in enumerate(stamps)]
    path = bag(tmp_path / "bag", {"/joint_states": ("sensor_msgs/msg/JointState", messages)})
    time = record(path).tables["/joint_states"].times["header"]
    assert time[2] - time[0] == pytest.approx(0.02)


def states_and_wrenches():
    """Joint states by number, whose recorder hears them late and unevenly, and wrenches at 60 Hz."""
    columns = recorded()
    generator = np.random.default_rng(1)
    times = [EPOCH + round(1e9 * t) for t in columns["time"]]
    late = np.sort(np.array(times) + generator.integers(0, 9_000_000, len(times)))
    rows = np.column_stack([columns[f"{joint}.position"] for joint in JOINTS])
    numbered = [f"joint_{place}" for place in range(12)]
    forces = generator.standard_normal((4, 600, 3))
    of_forces = [EPOCH + round(1e9 * place / 60) for place in range(600)]
    topics = {
        "/joint_states": ("sensor_msgs/msg/JointState", [
            (int(heard), joint_state(t, numbered, row)) for heard, t, row in zip(late, times, rows, strict=True)
        ]),
        **{f"/{limb}/wrench": ("geometry_msgs/msg/WrenchStamped", [
            (t, wrench(t, force)) for t, force in zip(of_forces, forces[place], strict=True)
        ]) for place, limb in enumerate(ROBOT.limbs)},
    }  # fmt: skip
    return columns, forces, topics


def test_joint_states_by_number_and_wrenches_at_sixty_hertz(tmp_path):
    columns, forces, topics = states_and_wrenches()
    log = read_log(bag(tmp_path / "bag", topics), ROBOT)
    for joint in JOINTS:
        np.testing.assert_array_equal(log.signals[f"{joint}.position"].value, columns[f"{joint}.position"])
        np.testing.assert_allclose(log.signals[f"{joint}.position"].time, columns["time"], atol=1e-9)
    for place, limb in enumerate(ROBOT.limbs):
        for axis in range(3):
            np.testing.assert_array_equal(log.signals[f"{limb}.force.{'xyz'[axis]}"].value, forces[place, :, axis])
    assert "LF.coxa.position: {topic: /joint_states, field: position.joint_0}" in log.guessed.to_yaml()
    assert [line for line in log.warnings if "taken as along world axes" in line]
    again = Signals.parse(log.guessed.to_yaml())
    assert again == log.guessed
    assert set(read_log(tmp_path / "bag", ROBOT, again).signals) == set(log.signals)
    # by the clock of the recorder there is jitter
    assert not [line for line in log.warnings if "jitter" in line]
    by_recorder = read_log(tmp_path / "bag", ROBOT, again.changed({"time": "log"}))
    assert [line for line in by_recorder.warnings if "with a jitter of" in line and "time: header" in line]


@pytest.mark.parametrize(("count", "width"), [(11, None), (12, 3), (20, 5), (28, 7), (13, 0), (8, 0), (52, 0)])
def test_a_limb_has_as_many_numbers_as_the_longest_or_a_few_more(tmp_path, count, width):
    """Of limbs of 3, 3, 2 and 3 joints: 11 numbers are one after the other, else each limb has as many."""
    uneven = tuple((name, joints[: 2 + (name != "RH")]) for name, joints in ROBOT.joints_in_file)
    head = ",".join(f"position[{n}]" for n in range(count))
    lines = [f"{0.01 * n},{','.join(str(0.01 * n + place) for place in range(count))}" for n in range(50)]
    (tmp_path / "log.csv").write_text("\n".join([f"t,{head}", *lines]))
    robot = dataclasses.replace(ROBOT, joints_in_file=uneven)
    if width == 0:
        with pytest.raises(ConfigError):
            read_log(tmp_path / "log.csv", robot)
        return
    signals = read_log(tmp_path / "log.csv", robot).signals
    place = 0
    for limb, joints in uneven:
        for joint, name in enumerate(ROBOT.joint_names[: len(joints)]):
            assert signals[f"{limb}.{name}.position"].value[0] == place + joint
        place += width or len(joints)


@pytest.mark.parametrize("date", ["2026-02-30T12:00:05.000Z", "2026-02-27T25:00:05.000Z"])
def test_a_row_whose_date_there_is_not_is_left_out(tmp_path, date):
    names = [f"{joint}.position" for joint in JOINTS]
    dates = [f"2026-02-27T12:00:{0.5 * n:06.3f}Z" for n in range(50)]
    rows = [[date if n in (0, 10) else dates[n], *(f"{0.01 * n}" for _ in names)] for n in range(50)]
    (tmp_path / "log.csv").write_text("\n".join(",".join(row) for row in [["time", *names], *rows]))
    signal = read_log(tmp_path / "log.csv", ROBOT).signals["LF.coxa.position"]
    there = np.delete(np.arange(50), [0, 10])
    np.testing.assert_allclose(signal.time, 0.5 * (there - 1), atol=1e-6)
    np.testing.assert_allclose(signal.value, 0.01 * there)


def test_a_column_of_words_is_none_of_names_for_a_motor_in_its_name(tmp_path):
    """A row for each joint, whose name stands in a column behind another one of words."""
    rows = [[f"{0.01 * n}", ("run", "hold")[n % 2], joint, f"{n + place}"]
            for n in range(50) for place, joint in enumerate(JOINTS)]  # fmt: skip
    head = ["time", "motor_mode", "joint", "position"]
    (tmp_path / "log.csv").write_text("\n".join(",".join(row) for row in [head, *rows]))
    signals = read_log(tmp_path / "log.csv", ROBOT).signals
    for place, joint in enumerate(JOINTS):
        np.testing.assert_array_equal(signals[f"{joint}.position"].value, np.arange(50) + place)


def test_one_cell_that_packs_28_joints_with_stale_repeats(tmp_path):
    columns = recorded()
    fresh = np.arange(len(columns["time"])) % 3 != 1  # the second of three repeats the first
    read = np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), 0))
    packed = np.zeros((len(read), 28))
    for place, joint in enumerate(JOINTS):
        packed[:, 7 * (place // 3) + place % 3] = columns[f"{joint}.position"][read]
    lines = [f'{t!r},"{row}"' for t, row in zip(columns["time"].tolist(), packed.tolist(), strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["t,joint_positions", *lines]))
    log = read_log(tmp_path / "log.csv", ROBOT)
    for joint in JOINTS:
        np.testing.assert_array_equal(
            log.signals[f"{joint}.position"].value, columns[f"{joint}.position"][fresh], err_msg=joint
        )
        np.testing.assert_array_equal(log.signals[f"{joint}.position"].time, columns["time"][fresh])
    (said,) = [line for line in log.warnings if "stale" in line]
    assert f"LF.coxa.position and 11 more: {(~fresh).sum()} of 1000 samples repeat" in said
    assert [line for line in log.warnings if "28 numbers for 4 limbs of 3 joints, taken as 7 a limb" in line]
    assert "LH.femur.position: {column: joint_positions.8}" in log.guessed.to_yaml()
    kept = read_log(tmp_path / "log.csv", ROBOT, log.guessed.changed({"repeats": "keep"}))
    assert len(kept.signals["LF.coxa.position"].time) == 1000


def test_units_signs_and_counts_become_si(tmp_path):
    columns = recorded()
    angle, time = columns["LF.coxa.position"], columns["time"]
    rate = np.gradient(angle, time)
    write_csv(tmp_path / "log.csv", {
        "t": 1e3 * time, "deg": -np.degrees(angle), "counts": 2048 + angle / (2 * np.pi) * 4096,
        "rpm": rate * 30 / np.pi, "mA": 1e3 * rate / 0.8, "kgf": rate / 9.80665,
    })  # fmt: skip
    log = read_log(tmp_path / "log.csv", ROBOT, Signals.make({"time": "t", "time_unit": "ms", "signals": {
        "LF.coxa.position": {"column": "deg", "unit": "deg", "sign": -1},
        "LF.coxa.command": {"column": "counts", "unit": "counts", "counts_per_turn": 4096, "zero": 2048, "shift": -0.5},
        "LF.coxa.velocity": {"column": "rpm", "unit": "rpm"},
        "LF.coxa.effort": {"column": "mA", "unit": "mA", "torque_constant": 0.8},
        "LF.force.z": {"column": "kgf", "unit": "kgf"},
    }}))  # fmt: skip
    for name, expected in {
        "LF.coxa.position": angle, "LF.coxa.command": angle, "LF.coxa.velocity": rate, "LF.coxa.effort": rate,
        "LF.force.z": rate,
    }.items():  # fmt: skip
        np.testing.assert_allclose(log.signals[name].value, expected, rtol=1e-12, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(log.signals["LF.coxa.position"].time, time + 0.5, atol=1e-12)
    np.testing.assert_allclose(log.signals["LF.coxa.command"].time, time, atol=1e-12)


@pytest.mark.parametrize(("source", "expected"), [
    ("LF.cxa.position: {column: a}", r"LF.cxa.position: expected a signal of the robot, .*mean LF.coxa.position"),
    ("LF.coxa.position: {column: b}", r"LF.coxa.position.column: expected a column of numbers in .*log.csv, got b"),
    ("LF.coxa.position: {topic: /a}", r"LF.coxa.position.topic: expected a topic of .*log.csv, got /a"),
    ("LF.coxa.position: {column: a, unit: N}", r"LF.coxa.position.unit: expected one of rad, deg, counts, got N"),
    ("LF.coxa.position: {column: a, unit: m}", r"LF.coxa.position.unit: expected one of rad, deg, counts, got m"),
    ("LF.coxa.effort: {column: a, unit: N}", r"LF.coxa.effort.unit: expected one of N m, mN m, kgf cm, A, mA, got N"),
    ("LF.coxa.position: {column: a, time: when}",
     r"LF.coxa.position: time: expected a column of times in .*log.csv \(time: NAME in signals.yaml\), got no when"),
    ("LF.coxa.position: {column: a, unit: counts}", r"LF.coxa.position: expected counts_per_turn with the unit counts"),
    ("LF.coxa.position: {column: a, sign: 2}", r"LF.coxa.position.sign: expected 1 or -1, got 2"),
    ("LF.coxa.position: {}", r"LF.coxa.position: expected a topic or a column, one of the two"),
])  # fmt: skip
def test_a_wrong_map_is_told_in_one_line(tmp_path, source, expected):
    (tmp_path / "log.csv").write_text("time,a\n0,1\n1,2\n2,3\n")
    (tmp_path / "signals.yaml").write_text(f"time: time\nsignals: {{{source}}}\n")
    with pytest.raises(mc.ConfigError, match=rf"signals.yaml: signals.{expected}") as refused:
        read_log(tmp_path / "log.csv", ROBOT, tmp_path / "signals.yaml")
    assert "\n" not in str(refused.value)


def test_what_is_no_recording_is_told_in_one_line(tmp_path):
    _, _, topics = states_and_wrenches()
    whole = next(bag(tmp_path / "bag", {"/joint_states": topics["/joint_states"]}).glob("*.mcap")).read_bytes()
    for name, content, expected in (
        (
            "log.mcap",
            whole[: len(whole) // 2],
            r"expected a recording .* \(.*: mcap recover \S+/log.mcap -o whole.mcap\)",
        ),
        ("text.mcap", b"no recording", "expected a recording of ROS 2 .*, got '"),
        ("text.db3", b"no recording", "expected a recording of ROS 2 .*, got "),
        ("log.mcap.zstd", whole, r"expected a log that is not packed \(unpack it before: zstd -d log.mcap.zstd\), got"),
        ("log.txt", b"", "expected a log: .csv, .tsv, .nc, .mcap, .db3 or the folder of a bag, got .txt"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(mc.ConfigError, match=f"{name}: {expected}") as refused:
            read_log(tmp_path / name, ROBOT)
        assert "\n" not in str(refused.value)
    metadata = tmp_path / "bag" / "metadata.yaml"
    text = metadata.read_text()
    assert "storage_identifier: mcap" in text
    metadata.write_text(text.replace("storage_identifier: mcap", "storage_identifier: ''"))
    cure = r"\(name \S+/bag.mcap itself, or write storage_identifier: mcap, or sqlite3, in metadata.yaml\)$"
    with pytest.raises(mc.ConfigError, match=f"bag: expected a recording of ROS 2 .* {cure}"):
        read_log(tmp_path / "bag", ROBOT)
    metadata.unlink()
    with pytest.raises(
        mc.ConfigError, match=r"\(name the .mcap or .db3 in it, as \S+/bag.mcap, or ros2 bag reindex \S+/bag\)$"
    ):
        read_log(tmp_path / "bag", ROBOT)
    assert read_log(tmp_path / "bag" / "bag.mcap", ROBOT).signals
    shutil.rmtree(tmp_path / "bag")
    with pytest.raises(mc.ConfigError, match="bag: expected a log, got no such file or folder"):
        read_log(tmp_path / "bag", ROBOT)


@pytest.mark.slow
def test_a_walk_is_read_back_from_its_mcap_to_the_last_digit(pushed, tmp_path):
    log = read_log(save_mcap(pushed, tmp_path / "walk.mcap"), ROBOT)
    expected = {
        f"{joint}.{what}": values.reshape(len(pushed.time), 12)[:, place]
        for what, values in {
            "command": pushed.joint_targets, "position": pushed.joint_angles, "velocity": pushed.joint_rates,
            "effort": pushed.joint_torque,
        }.items()
        for place, joint in enumerate(JOINTS)
    }  # fmt: skip
    for place, limb in enumerate(ROBOT.limbs):
        expected |= {f"{limb}.force.{axis}": pushed.foot_force[:, place, n] for n, axis in enumerate("xyz")}
        expected[f"{limb}.support"] = pushed.support[:, place].astype(float)
    for what, values in {
        "position": pushed.base_position, "linear_velocity": pushed.base_linear_velocity,
        "angular_velocity": pushed.base_angular_velocity, "force": pushed.push[:, :3], "moment": pushed.push[:, 3:],
    }.items():  # fmt: skip
        expected |= {f"base.{what}.{axis}": values[:, n] for n, axis in enumerate("xyz")}
    expected |= {f"base.orientation.{axis}": pushed.base_orientation[:, n] for n, axis in enumerate("wxyz")}
    assert (
        set(log.signals)
        == set(expected)
        == ({name for name in signals_of(ROBOT) if not name.endswith("_command")} - {"control.kp", "torque_off"})
    )
    for name, values in expected.items():
        np.testing.assert_array_equal(log.signals[name].value, values, err_msg=name)
        np.testing.assert_allclose(log.signals[name].time, pushed.time, rtol=0, atol=1e-9, err_msg=name)
    assert log.guessed is not None and log.warnings == ()


@pytest.mark.slow
def test_the_same_walk_gives_the_same_mcap_with_base_and_feet_as_transforms(pushed, tmp_path):
    one, other = save_mcap(pushed, tmp_path / "a.mcap"), save_mcap(pushed, tmp_path / "b.mcap")
    assert one.read_bytes() == other.read_bytes()
    table = record(one).tables["/tf"]
    rows = np.round(table.times["log"] / pushed.scenario.time_step).astype(int)
    np.testing.assert_array_equal(np.diff(rows), 10)  # 100 in a second
    for child, values in {"base": pushed.base_position, "RH_foot": pushed.foot_position[:, 2]}.items():
        found = np.column_stack([table.fields[f"transforms.{child}.transform.translation.{axis}"] for axis in "xyz"])
        np.testing.assert_array_equal(found, values[rows])


@pytest.mark.slow
def test_every_channel_is_decoded_by_the_readers_of_mcap_themselves(pushed, tmp_path):
    """Those of Foxglove: by the definitions of the messages that the file itself holds."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found = {}
    with save_mcap(pushed, tmp_path / "walk.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
        assert {channel.topic for channel in reader.get_summary().channels.values()} == set(found)
    feet = {f"/{limb}/{what}" for limb in ROBOT.limbs for what in ("force", "support")}
    assert set(found) == feet | {"/joint_states", "/joint_commands", "/base_pose", "/base_twist", "/push", "/tf"}
    row = len(pushed.time) - 1
    assert all(len(each) == row + 1 for topic, each in found.items() if topic != "/tf")
    last = {topic: each[-1][1] for topic, each in found.items()}
    stamp = last["/joint_states"].header.stamp
    assert (stamp.sec, stamp.nanosec, found["/push"][-1][0]) == (0, *[round(1e9 * pushed.time[row])] * 2)
    assert last["/joint_states"].name == [joint.replace(".", "_") for joint in JOINTS]
    twist, force, push = last["/base_twist"].twist, last["/RH/force"].wrench.force, last["/push"].wrench.force
    pose, (base, *_) = last["/base_pose"].pose, found["/tf"][0][1].transforms
    assert (base.header.frame_id, base.child_frame_id) == ("world", "base") and last["/RH/support"].data
    for ours, theirs in (
        (pushed.joint_angles[row], last["/joint_states"].position), (pushed.foot_force[row, 2], xyz(force)),
        (pushed.joint_rates[row], last["/joint_states"].velocity), (pushed.base_position[row], xyz(pose.position)),
        (pushed.joint_torque[row], last["/joint_states"].effort), (pushed.push[row, :3], xyz(push)),
        (pushed.joint_targets[row], last["/joint_commands"].position),
        (pushed.base_position[0], xyz(base.transform.translation)),
        (pushed.base_orientation[row], [pose.orientation.w, *xyz(pose.orientation)]),
        (pushed.base_linear_velocity[row], xyz(twist.linear)), (pushed.base_angular_velocity[row], xyz(twist.angular)),
    ):  # fmt: skip
        np.testing.assert_array_equal(np.ravel(ours), theirs)


def xyz(message):
    return [message.x, message.y, message.z]


def test_times_that_do_not_increase_are_left_out_and_counted(tmp_path):
    (tmp_path / "log.csv").write_text(
        "time;LF.coxa.position\n0;0.1\n1e-2;0.2\n5e-3;0.9\n1e-2;0.8\n2e-2;0.3\n3e-2;0.4\n"
    )
    log = read_log(tmp_path / "log.csv", ROBOT)
    np.testing.assert_array_equal(log.signals["LF.coxa.position"].value, [0.1, 0.2, 0.3, 0.4])
    assert "LF.coxa.position: 2 of 6 samples come no later than one before them: left out" in log.warnings[0]


def test_a_foot_in_the_air_measures_nothing_again_and_again(tmp_path):
    force = np.random.default_rng(0).standard_normal(100)
    force[40:43] = 0.0
    write_csv(tmp_path / "log.csv", {"time": np.arange(100) / 100, "LF.force.z": force})
    log = read_log(tmp_path / "log.csv", ROBOT)
    assert log.warnings == () and len(log.signals["LF.force.z"].value) == 100


@pytest.mark.parametrize(("stamped", "clock"), [(1, "log"), (2, "header")])
def test_times_are_those_of_the_recording_where_only_some_headers_have_a_clock_of_their_own(stamped, clock):
    now, fields = np.arange(5.0), {"data.x": np.arange(5.0)}
    times = [{"log": now, "header": now - 1e3}] * stamped + [{"log": now}] * (2 - stamped)
    tables = {f"/{n}": Table(f"/{n}", each, fields) for n, each in enumerate(times)}
    found, notes = guess(Recording(tables, "log"), ROBOT)
    assert found.time == clock and bool(notes) == (clock == "log")


def test_the_twist_of_an_odometry_has_the_axes_of_the_body_and_is_not_taken():
    time = {"log": np.arange(5.0)}
    fields = {f"{part}.{what}": time["log"] for part, what in (
        ("pose.pose.position", "x"), ("twist.twist.linear", "x"), ("twist.twist.angular", "z"),
    )}  # fmt: skip
    found, _ = guess(Recording({"/base/odom": Table("/base/odom", time, fields)}, "log"), ROBOT)
    assert list(found.signals) == ["base.position.x"]


def test_files_of_a_log_are_named_as_they_are_found_from_the_folder_of_a_result(tmp_path, monkeypatch):
    from tuning.command_line.logs import Recorded

    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").touch()
    option, path = Recorded(log=Path("log.csv")).files_from(Path("results/found"))
    assert option == "--log" and (tmp_path / "results/found" / path).resolve() == tmp_path / "log.csv"
    both = Recorded(log=tmp_path / "log.csv", signals=tmp_path / "signals.yaml").files_from(tmp_path / "found")
    assert both == ["--log", "../log.csv", "--signals", "../signals.yaml"]


def test_a_format_of_ones_own_is_one_file_in_the_folder_of_formats(tmp_path, monkeypatch):
    (tmp_path / "of_my_robot.py").write_text('SUFFIXES = (".robot",)\n\n\ndef read(path):\n    return f"read {path}"\n')
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(tmp_path)])
    readers = readers_in(formats.__name__, formats.__path__)
    assert readers.keys() - formats.READERS.keys() == {".robot"}
    assert readers[".robot"]("walk.robot") == "read walk.robot"


def test_a_walk_in_netcdf_has_its_signals_by_name_and_place_and_other_arrays_by_their_own(tmp_path):
    """What is not over time, or no number, is no signal; a place without labels has none in its name."""
    rng, steps, limbs, joints = np.random.default_rng(0), 5, ["LF", "RH"], ["coxa", "tibia"]
    over = {
        "joint_targets": ("limb", "joint"), "joint_angles": ("limb", "joint"), "joint_rates": ("limb", "joint"),
        "joint_torque": ("limb", "joint"), "foot_force": ("limb", "axis"), "support": ("limb",), "push": ("wrench",),
        "base_position": ("axis",), "base_orientation": ("quaternion",), "base_linear_velocity": ("axis",),
        "base_angular_velocity": ("axis",), "voltage": (), "mine": ("limb", "unlabelled"), "foot_target": ("limb",),
    }  # fmt: skip
    labels = {"limb": limbs, "joint": joints, "axis": [*"xyz"], "wrench": ["x", "ry"], "quaternion": [*"wxyz"]}
    sizes = {name: len(values) for name, values in labels.items()} | {"unlabelled": 2}
    made = {name: (("time", *dims), rng.normal(size=(steps, *(sizes[d] for d in dims)))) for name, dims in over.items()}
    made["support"] = (made["support"][0], made["support"][1] > 0)
    made |= {
        "words": ("time", [*"abcde"]),
        "mass": ("limb", [1.0, 2.0]),
        "late": (("limb", "time"), np.ones((2, steps))),
    }
    data = xr.Dataset(made, {"time": np.arange(steps) / 10, **labels})
    late, prompt = (mc.Scenario().with_overrides({"hardware.command_delay": delay}).to_yaml() for delay in (0.004, 0.0))
    dataset.save(data.assign_attrs(scenario=late), tmp_path / "walk.nc")
    found = netcdf_file.read(tmp_path / "walk.nc")
    (table,) = found.tables.values()
    words = {
        "joint_targets": "command",
        "joint_angles": "position",
        "joint_rates": "velocity",
        "joint_torque": "effort",
    }
    expected = {f"{limb}.{joint}.{word}": data[name].sel(limb=limb, joint=joint) for name, word in words.items()
                for limb in limbs for joint in joints}  # fmt: skip
    expected |= {
        f"{limb}.force.{axis}": data["foot_force"].sel(limb=limb, axis=axis) for limb in limbs for axis in "xyz"
    }
    expected |= {f"{limb}.support": data["support"].sel(limb=limb).astype(float) for limb in limbs}
    expected |= {"base.force.x": data["push"].sel(wrench="x"), "base.moment.y": data["push"].sel(wrench="ry")}
    expected |= {f"base.orientation.{axis}": data["base_orientation"].sel(quaternion=axis) for axis in "wxyz"}
    for what in ("position", "linear_velocity", "angular_velocity"):
        expected |= {f"base.{what}.{axis}": data[f"base_{what}"].sel(axis=axis) for axis in "xyz"}
    unlabelled = {f"mine.{limb}.{n}": data["mine"].sel(limb=limb, unlabelled=n) for limb in limbs for n in range(2)}
    expected |= {"voltage": data["voltage"]} | unlabelled
    expected |= {f"foot_target.{limb}": data["foot_target"].sel(limb=limb) for limb in limbs}
    assert table.fields.keys() == expected.keys() and table.unnamed == unlabelled.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(table.fields[name], values)
    np.testing.assert_array_equal(table.times["time"], np.arange(steps) / 10)
    (note,) = found.warnings
    assert "commands are those that reached the servos, 0.004 s after they were sent" in note
    dataset.save(data[["voltage"]].assign_attrs(scenario=prompt), tmp_path / "prompt.nc")
    assert not netcdf_file.read(tmp_path / "prompt.nc").warnings
    dataset.save(data[["mass"]], tmp_path / "still.nc")
    with pytest.raises(ConfigError, match="expected variables over time, got none"):
        netcdf_file.read(tmp_path / "still.nc")


def test_a_column_of_nothing_is_no_column_of_words(tmp_path):
    (tmp_path / "log.csv").write_text("time,none,state,LF.coxa.position\n0.0,,on,0.1\n0.1,nan,off,0.2\n")
    (table,) = csv_file.read(tmp_path / "log.csv").tables.values()
    assert np.isnan(table.fields["none"]).all() and "none" not in table.words
    assert not any("state" in name for name in table.fields)


@pytest.mark.parametrize(("names", "found"), [(["b", "a"], ["p.position.b", "p.position.a"]),
                                              (["a", "a"], ["p.position.0", "p.position.1"]),
                                              (["a", "b", "c"], ["p.position.0", "p.position.1"])])  # fmt: skip
def test_entries_of_a_list_have_the_names_beside_them_where_each_has_one(names, found):
    message = types.SimpleNamespace(name=names, position=np.array([1.0, 2.0]), count=3.0)
    entries = [entry for entry in rosbag._numbers(message, "p", {}) if ".name" not in entry[0]]
    named = "0" not in found[0]
    assert entries == [(found[0], 1.0, named), (found[1], 2.0, named), ("p.count", 3.0, True)]


def test_names_that_seem_misspelt_are_not_read_and_said(tmp_path):
    """Those of one or two dots that end as a signal does; others are no signals of a robot."""
    seem = ("LX.support", "coxa.velocity", "base.force.q", "LF.forces.x", "LF.cxa.position", "base.positions.x")
    columns = recorded(duration=2.0)
    path = write_csv(tmp_path / "log.csv", columns | dict.fromkeys(
        (*seem, "position", "a.b.c.position", "other.x", "LF.colour"), columns["LF.coxa.position"]
    ))  # fmt: skip
    log = read_log(path, ROBOT)
    lines = [line.removeprefix(f"{path}: ") for line in log.warnings]
    said = [line.partition(": not read, the robot has no such signal")[0] for line in lines]
    assert said == ["LF.cxa.position", "LX.support", "base.force.q", "coxa.velocity"]
    assert {*log.signals} == columns.keys() - {"time"}


@pytest.mark.parametrize("frame", ["world", "", "LF_foot"])
def test_forces_of_another_frame_than_the_worlds_are_doubted(frame):
    time = {"log": np.arange(5.0)}
    tables = {
        f"/{limb}/wrench": Table(f"/{limb}/wrench", time, {f"wrench.force.{a}": np.ones(5) for a in "xyz"}, own)
        for limb, own in (("LF", "world"), ("RH", frame))
    }
    signals, notes = guess(Recording(tables, "bag"), ROBOT)
    assert {*signals.signals} == {f"{limb}.force.{axis}" for limb in ("LF", "RH") for axis in "xyz"}
    told = [line for line in notes if line.startswith("forces: taken as along world axes")]
    named = ", ".join(sorted({"'world'", repr(frame)}))
    assert told == [] if frame == "world" else f"their frame is {named}; turn them before" in told[0]


def test_two_samples_are_a_log(tmp_path):
    log = read_log(write_csv(tmp_path / "log.csv", {"time": [1.0, 1.01], "LF.coxa.position": [0.1, 0.2]}), ROBOT)
    np.testing.assert_allclose(log.signals["LF.coxa.position"].time, [0.0, 0.01])
    np.testing.assert_allclose(log.signals["LF.coxa.position"].value, [0.1, 0.2])


def test_a_topic_has_the_frame_of_its_headers(tmp_path):
    messages = [(EPOCH + n, wrench(EPOCH + n, (1.0, 2.0, 3.0), "foot")) for n in range(3)]
    read = record(bag(tmp_path / "bag", {"/wrench": ("geometry_msgs/msg/WrenchStamped", messages)}))
    assert read.tables["/wrench"].frame == "foot"
