"""Random tables in the dialects of loggers, written cell by cell here, are read to the last bit."""

import datetime
import hashlib
import math
import struct

import numpy as np
import pytest

import mjx_climb as mc
from tests.tuning.identification.recorded import ROBOT
from tuning.identification.readers import read_log, record, write_csv
from tuning.identification.readers.log import Log, Signal, commanded, signals_of
from tuning.identification.readers.named import by_names, words_of
from tuning.identification.readers.signals import Signals, Source

EMPTY = ("", "nan", "NaN", "None", "null", "[]", " ")


class Table:
    """A table that is written, and the columns that it should be read as."""

    def __init__(self, seed):
        self.draw = np.random.default_rng(seed)
        self.count = int(self.draw.integers(2, 9))
        self.columns, self.fields, self.times, self.words = {}, {}, {}, {}

    def values(self, size, gaps=True):
        value = self.draw.normal(size=size) * 10.0 ** self.draw.integers(-9, 9, size)
        return np.where(self.draw.random(size) < 0.3 * gaps, np.nan, value)

    def cell(self, value):
        if math.isnan(value):
            return str(self.draw.choice(EMPTY))
        return self.draw.choice([repr(float(value)), f" {float(value)!r} ", f"{float(value):.17e}"])

    def numbers(self, name):
        value = self.values(self.count)
        if np.isnan(value).all():
            value[0] = 1.0
        self.columns[name], self.fields[name] = [self.cell(each) for each in value], value

    def truths(self, name):
        value = self.draw.integers(0, 2, self.count)
        self.columns[name] = [
            str(self.draw.choice([("false", "False", "0"), ("true", "TRUE", "1")][each])) for each in value
        ]
        self.fields[name] = value.astype(float)

    def lists(self, name):
        width = int(self.draw.integers(1, 5))
        value = self.values((self.count, width), gaps=False)
        opened, between, closed = self.draw.permutation(
            [
                ("[", ", ", "]"),
                ("(", ",", ")"),
                ("{", "; ", "}"),
                ("array('d', [", ", ", "])"),
                ("[[", " ", "]]"),
                ("x=[", ",", "]"),
            ]
        )[0]
        cells = [opened + between.join(map(repr, row)) + closed for row in value.tolist()]
        if width > 1 and self.draw.random() < 0.3:
            cells = [self.draw.choice([" ", ";", "  "]).join(map(repr, row)) for row in value.tolist()]
        for row in range(1, self.count):
            if self.draw.random() < 0.2:
                cells[row], value[row] = str(self.draw.choice(EMPTY[:-1])), np.nan
        self.columns[name] = cells
        self.fields |= {f"{name}.{n}": value[:, n] for n in range(width)}

    def dates(self, name):
        zones = [("Z", 0), ("", 0), ("+01:00", 60), ("-0530", -330), (" UTC", 0), ("+00:45", 45)]
        (zone, minutes), cells, seconds = zones[self.draw.integers(len(zones))], [], []
        for _ in range(self.count):
            day = datetime.datetime(2020, 1, 1, tzinfo=datetime.UTC) + datetime.timedelta(
                seconds=int(self.draw.integers(2e8))
            )
            part = str(self.draw.choice(["", ".5", ",250", ".000001"]))
            form = self.draw.choice(["%Y-%m-%dT%H:%M:%S", "%Y/%m/%d %H:%M:%S", "%Y-%m-%d %H:%M:%S"])
            cells.append(day.strftime(form) + part + zone)
            seconds.append(day.timestamp() - 60 * minutes + float("0" + part.replace(",", ".") if part else 0))
        self.columns[name], self.times[name] = cells, np.array(seconds)

    def pair(self, name):
        unit, size = self.draw.permutation([("nanosec", 1e-9), ("nsecs", 1e-9), ("usec", 1e-6), ("ns", 1e-9)])[0]
        size = float(size)
        whole, part = self.draw.integers(0, 2**31, self.count), self.draw.integers(0, round(1 / size), self.count)
        own = str(self.draw.choice(["sec", "secs", "Seconds", "s"]))
        for each, value in ((own, whole), (unit, part)):
            self.columns[f"{name}.{each}"], self.fields[f"{name}.{each}"] = [str(v) for v in value], value.astype(float)
        self.times[f"{name}.{own}+{name}.{unit}"] = whole + size * part

    def labels(self, name):
        cells = [str(self.draw.choice(["idle", "walks", "", "None", "stand up"])) for _ in range(self.count)]
        if all(cell in ("", "None") for cell in cells):
            cells[0] = "idle"
        if " " not in "".join(cells) or not cells[[c in ("", "None") for c in cells].index(False)].count(" "):
            self.words[name] = {"" if cell == "None" else cell for cell in cells}
            self.columns[name] = cells

    def write(self, path):
        delimiter = str(self.draw.choice([",", ";", "\t"]))
        names = [self.draw.choice([name, f" {name} "]) for name in self.columns]

        def quoted(cell):
            needs = delimiter in cell or '"' in cell or (delimiter == "," and ";" in cell)
            return '"' + cell.replace('"', '""') + '"' if needs or self.draw.random() < 0.1 else cell

        lines = [delimiter.join(map(quoted, row)) for row in zip(*self.columns.values(), strict=True)]
        lines = [line for each in lines for line in ([each, ""] if self.draw.random() < 0.2 else [each])]
        end, start = self.draw.choice(["\n", "\r\n"]), self.draw.choice([b"", b"\xef\xbb\xbf"])
        path.write_bytes(bytes(start) + end.join([delimiter.join(names), *lines, ""]).encode())


@pytest.mark.parametrize("seed", range(30))
def test_a_table_is_read_to_the_last_bit(tmp_path, seed):
    table = Table(seed)
    for n in range(int(table.draw.integers(2, 7))):
        kind = str(table.draw.choice(["numbers", "numbers", "truths", "lists", "dates", "pair", "labels"]))
        getattr(table, kind)(f"{kind}_{'abcdefg'[n]}")
    table.numbers("last")
    table.write(tmp_path / "log.csv")
    (found,) = record(tmp_path / "log.csv").tables.values()
    assert {*found.fields} == {*table.fields}
    for name, value in table.fields.items():
        np.testing.assert_array_equal(found.fields[name], value, err_msg=name)
    assert {*found.times} == {*table.fields, *table.times}
    for name, value in table.times.items():
        np.testing.assert_allclose(found.times[name], value, rtol=0, atol=3e-7, err_msg=name)
    assert found.words == set().union(*table.words.values()) and not found.renamed
    assert found.unnamed == {name for name in table.fields if name.rpartition(".")[2].isdecimal()}


@pytest.mark.parametrize("seed", range(8))
def test_what_is_written_is_read_again(tmp_path, seed):
    draw = np.random.default_rng(seed)
    columns = {"time": np.cumsum(draw.uniform(0.01, 0.1, 20))}
    for name in ("LF.coxa.position", "LF.coxa.effort", "base.position.x"):
        columns[name] = np.where(draw.random(20) < 0.3, np.nan, draw.normal(size=20) * 10.0 ** draw.integers(-12, 12))
    assert write_csv(tmp_path / "log.csv", columns) == tmp_path / "log.csv"
    (found,) = record(tmp_path / "log.csv").tables.values()
    for name, value in columns.items():
        np.testing.assert_array_equal(found.fields[name], value)


# -------------------------------------------------------------------------------------------- numbers that have names


@pytest.mark.parametrize("seed", range(20))
def test_numbered_columns_go_to_the_names_beside_them(seed):
    """Names in an order that changes from row to row; some rows name fewer, some count from 1."""
    draw = np.random.default_rng(seed)
    joints = [
        str(each) for each in draw.permutation(["hip", "knee", "toe", "arm_2", "front left"])[: draw.integers(2, 6)]
    ]
    count, width = int(draw.integers(3, 7)), len(joints)
    parent = str(draw.choice(["", "states.", "/joint_states/", "a.b."]))
    form = str(draw.choice(["{p}{what}{n}", "{p}{what}.{n}", "{p}{what}[{n}]", "{p}{n}.{what}"]))
    first, start = int(draw.integers(0, 2)), int(draw.integers(0, 2))
    named, fields, expected = {}, {}, {}
    orders = [draw.permutation(width) for _ in range(count)]
    blank = draw.random((count, width)) < 0.15
    for n in range(width):
        key = form.format(p=parent, what="name", n=n + first)
        named[key] = ["" if blank[row, n] else joints[orders[row][n]] for row in range(count)]
    for what in ("position", "velocity"):
        values = draw.normal(size=(count, width))
        for n in range(width):
            field = form.format(p=parent, what=what, n=n + start)
            fields[field] = values[:, n]
            for row in range(count):
                if word := named[form.format(p=parent, what="name", n=n + first)][row]:
                    expected.setdefault((what, word), np.full(count, np.nan))[row] = values[row, n]
    # others of the same parent, of another number of entries, are not named by these
    fields |= {form.format(p=parent, what="lid", n=n): np.ones(count) for n in range(width + 1)}
    fields["time"] = np.arange(float(count))
    if not any(any(column) for column in named.values()):
        return
    made, used = by_names(fields, named)
    assert used == {field for field in fields if "position" in field or "velocity" in field}
    found = {}
    for name, value in made.items():
        what = "position" if "position" in name else "velocity"
        word = next(
            each
            for each in sorted(joints, key=len, reverse=True)
            if words_of(each) == words_of(name.replace(what, ""))[-len(words_of(each)) :] or each in name
        )
        found[what, word] = value
    assert {*found} == {*expected}
    for key, value in expected.items():
        np.testing.assert_array_equal(found[key], value, err_msg=str(key))


@pytest.mark.parametrize(("text", "words"), [
    ("LF_coxaPosition", "lf coxa position"), ("joint12Vel", "joint 12 vel"), ("/a/bCD.e[3]", "a b cd e 3"),
    ("HTTPServer", "http server"), ("Füße", "f üß e"), ("__", ""), ("ABC", "abc"), ("q1d", "q 1 d"),
])  # fmt: skip
def test_a_name_is_words_and_numbers(text, words):
    assert words_of(text) == tuple(words.split())


# ------------------------------------------------------------------------------------ from columns to signals, in SI


@pytest.mark.parametrize("seed", range(10))
def test_signals_of_a_file_are_what_their_sources_say(tmp_path, seed):
    """Units, zeros, signs, clocks and shifts of each signal; times begin at the first sample of all."""
    draw, count = np.random.default_rng(seed), 12
    units = {
        "position": {None: 1, "deg": math.pi / 180, "counts": 2 * math.pi / 512},
        "velocity": {None: 1, "rpm": math.pi / 30}, "effort": {None: 1, "mN m": 1e-3, "A": 0.7, "mA": 0.7e-3},
    }  # fmt: skip
    columns, sources, expected = (
        {"t": np.cumsum(draw.uniform(0.5, 1.5, count)), "clock": np.cumsum(draw.uniform(0.5, 1.5, count))},
        {},
        {},
    )
    in_degrees = draw.random() < 0.5
    for n, joint in enumerate(("LF.coxa", "RH.tibia", "LH.femur")):
        for what, known in units.items():
            unit = list(known)[draw.integers(len(known))]
            raw = np.where(draw.random(count) < 0.2, np.nan, np.round(draw.normal(size=count), 3) + np.arange(count))
            name, column = f"{joint}.{what}", f"c{n}{what}"
            zero, sign, shift = (
                float(draw.choice([0.0, 3.0])),
                int(draw.choice([1, -1])),
                float(draw.choice([0.0, -0.25])),
            )
            own, size = (str(draw.choice(["ms", "s"])), draw.random() < 0.4) if draw.random() < 0.5 else (None, False)
            sources[name] = Source(
                column=column, unit=unit, zero=zero, sign=sign, shift=shift,
                counts_per_turn=512 if unit == "counts" else None, torque_constant=0.7 if unit in ("A", "mA") else None,
                time="clock" if size else None, time_unit=own,
            )  # fmt: skip
            columns[column] = raw
            factor = known[unit]
            if unit is None and in_degrees and what in ("position", "velocity"):
                factor = math.pi / 180
            second = {"ms": 1e-3, "s": 1.0, None: 1e-6}[own]
            there = ~np.isnan(raw)
            time = columns["clock" if size else "t"][there] * second + shift
            expected[name] = time, sign * factor * (raw[there] - zero)
    write_csv(tmp_path / "log.csv", columns)
    as_it_is = dict.fromkeys(("repeats", "turns", "outliers"), "keep")
    unit = "deg" if in_degrees else "rad"
    signals = Signals(time="t", time_unit="us", unit=unit, signals=sources, **as_it_is)
    log = read_log(tmp_path / "log.csv", ROBOT, signals)
    start = min(time[0] for time, _ in expected.values())
    assert {*log.signals} == {*expected} and log.guessed is None and log.source == str(tmp_path / "log.csv")
    for name, (time, value) in expected.items():
        np.testing.assert_allclose(log.signals[name].time, time - start, atol=1e-12, err_msg=name)
        np.testing.assert_allclose(log.signals[name].value, value, rtol=1e-12, err_msg=name)
    assert log.duration == max(time[-1] for time, _ in expected.values()) - start
    again = Signals.parse(signals.to_yaml())
    assert again == signals


@pytest.mark.parametrize(("count", "later", "taken"), [(10, 2, False), (10, 3, True), (4, 1, True), (31, 9, False)])
def test_times_of_which_a_third_increase_are_times(tmp_path, count, later, taken):
    time = np.array([*range(1, later + 1), *[0.5] * (count - later - 1)], float)
    time = np.concatenate([[0.0], time])
    write_csv(tmp_path / "log.csv", {"time": time, "LF.coxa.position": np.sin(np.arange(count))})
    if taken:
        assert len(read_log(tmp_path / "log.csv", ROBOT).signals["LF.coxa.position"].time) == later + 1
        return
    with pytest.raises(
        mc.ConfigError, match=rf"times that increase, got {count - 1 - later} of {count} that come no later"
    ):
        read_log(tmp_path / "log.csv", ROBOT)


def test_a_log_is_known_by_all_its_samples_and_names_in_any_order():
    time, value = np.arange(4.0), np.sin(np.arange(4.0))
    signals = {"LF.coxa.position": Signal(time, value), "base.force.x": Signal(time[:3], value[1:])}
    log = Log(signals, "a.csv")
    assert Log(dict(reversed(signals.items())), "b.csv", ("warning",)).digest == log.digest and log.duration == 3.0
    later = np.r_[time[:-1], 3.5]
    for changed in (
        {"LF.coxa.position": Signal(time, value + np.r_[0, 0, 0, 1e-16])}, {"LF.coxa.position": Signal(later, value)},
        {"RF.coxa.position": signals["LF.coxa.position"]}, {"base.force.x": Signal(time[1:], value[1:])},
    ):  # fmt: skip
        other = (
            {**signals, **changed}
            if changed.keys() <= signals.keys()
            else {**changed, "base.force.x": signals["base.force.x"]}
        )
        assert Log(other, "a.csv").digest != log.digest
    content = b""
    for name in ("LF.coxa.position", "base.force.x"):
        numbers = [*signals[name].time, *signals[name].value]
        content += name.encode() + struct.pack(f"<{len(numbers)}d", *numbers)
    assert log.digest == hashlib.sha256(content).hexdigest()


def test_signals_of_a_robot_have_their_units():
    units = {"command": "rad", "velocity_command": "rad/s", "effort_command": "N m", "pwm_command": "1"}
    units |= {"position": "rad", "velocity": "rad/s", "effort": "N m"}
    expected = {}
    for limb in ROBOT.limbs:
        expected |= {f"{limb}.{joint}.{what}": unit for joint in ROBOT.joint_names for what, unit in units.items()}
        expected |= {f"{limb}.force.{axis}": "N" for axis in "xyz"} | {f"{limb}.support": "1"}
    of_base = {"position": "m", "orientation": "1", "linear_velocity": "m/s", "angular_velocity": "rad/s"}
    for what, unit in {**of_base, "force": "N", "moment": "N m"}.items():
        axes = "wxyz" if what == "orientation" else "xyz"
        expected |= {f"base.{what}.{axis}": unit for axis in axes}
    expected |= {"control.kp": "N m/rad", "torque_off": "1"}
    assert [(name, each.unit) for name, each in signals_of(ROBOT).items()] == [*expected.items()]
    signal = Signal(np.arange(2.0), np.arange(2.0))
    assert commanded(Log({"LF.coxa.pwm_command": signal, "LF.coxa.position": signal}, "a")) == "pwm_command"
    assert commanded(Log({"LF.coxa.position": signal}, "a")) == "command"
    with pytest.raises(mc.ConfigError, match=r"a: expected commands of one kind, got LF.coxa.command, RF.coxa.eff"):
        commanded(Log({"LF.coxa.command": signal, "RF.coxa.effort_command": signal}, "a"))


@pytest.mark.parametrize(("said", "named"), [(("left", "right"), {"left", "right"}), (("idle", "idle"), set())])
def test_words_that_two_places_share_in_a_row_are_no_names(said, named):
    fields = {"position0": np.arange(3.0), "position1": np.arange(3.0) + 9}
    made, used = by_names(fields, {f"mode_{number}": [word] * 3 for number, word in enumerate(said)})
    assert {word for name in made for word in said if word in name} == named
    assert bool(used) == bool(named)


@pytest.mark.parametrize(("tail", "named"), [("name", True), ("name_of_day", False), ("joint_name", True)])
def test_columns_name_others_where_all_words_behind_their_number_say_so(tail, named):
    fields = {f"joint{n}_pos": np.arange(3.0) + n for n in range(2)}
    made, used = by_names(fields, {f"joint{n}_{tail}": ["ab"[n]] * 3 for n in range(2)})
    assert (used == {*fields}, len(made)) == (named, 2 * named)
