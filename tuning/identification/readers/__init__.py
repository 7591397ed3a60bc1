"""Logs of a robot: read, cleaned, doubted."""

import dataclasses
import functools
import os
from collections.abc import Mapping

import numpy as np

from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.messages import ConfigError, did_you_mean
from tuning.identification.readers.doubts import doubts, several
from tuning.identification.readers.formats import record
from tuning.identification.readers.formats.csv_file import write_csv as write_csv
from tuning.identification.readers.guess import clock_of, guess
from tuning.identification.readers.log import BASE, JOINT, Log, Meaning, Signal, joints_of, signals_of
from tuning.identification.readers.outliers import without_outliers
from tuning.identification.readers.repairs import cleaned, increasing, without_turns, without_unmeasured
from tuning.identification.readers.signals import SECONDS, UNITS, Signals, Source
from tuning.identification.readers.table import Recording, Table

_IN_DEGREES = {"rad": "deg", "rad/s": "deg/s"}
_LARGEST = 1e100  # of a number: squares and sums are finite
_SLIDING = {"rad": "m", "rad/s": "m/s", "N m": "N"}  # of a prismatic joint
_nearest = functools.partial(did_you_mean, alike=0.5)


def read_log(
    path: str | os.PathLike[str], robot: Robot, signals: Signals | str | os.PathLike[str] | None = None
) -> Log:
    """Return a robot's record in SI units, with doubts about it.

    Arguments:
        path: CSV, netCDF, MCAP (.mcap), an sqlite bag (.db3), or the folder of a bag.
        robot: whose limbs and joints the signals are named by.
        signals: where each signal stands, or the file that says so. Where it names no signal, columns are read by the
            names of `tuning.identification.readers.log`; without such names it is guessed, and `Log.guessed` says how.

    Raises:
        ConfigError: no such file, another format, or no signal of this robot in it; a signal where there is none; in
            one line.
    """
    recording = record(path)
    there, missing, place, guessed, notes = recording, "", "signals", None, recording.warnings
    doubtful: tuple[str, ...] = ()
    if isinstance(signals, str | os.PathLike):
        place, signals = os.fspath(signals), Signals.load(signals)
    if signals is None or not signals.signals:
        given = {} if signals is None else signals.model_dump(exclude_unset=True, exclude={"signals"})
        place = recording.source
        there, missing = _recorded(recording, robot)
        found, unknown = _by_own_names(there, robot)
        notes += (*(f"{recording.source}: {line}" for line in [missing] if line), *unknown)
        if not found.signals:
            found, doubtful = guess(there, robot)
            guessed = found.changed(given)
            notes += tuple(f"{recording.source}: {note}" for note in doubtful)
        signals = found.changed(given)
    if not signals.signals:
        why = "; ".join(filter(None, [missing, *doubtful]))
        got = f"{_columns(there)} ({why})" if why else _columns(there)
        raise ConfigError(recording.source, "", f"signals such as {', '.join([*signals_of(robot)][:3])}", got)
    meanings = signals_of(robot)
    signals = _each_in_full(signals, robot, meanings)
    slides = robot.sliding is not None
    raw = {name: _taken(recording, signals, name, meanings, place, slides=slides) for name in signals.signals}
    read, said = cleaned(raw, signals)
    read, more = without_outliers(read, robot, signals)
    said += more
    repairs = (without_unmeasured, without_turns) if signals.turns == "unwrap" else (without_unmeasured,)
    for repair in repairs:
        read, more = repair(read, robot)
        said += more
    start = min(float(signal.time[0]) for signal in read.values())
    read = {name: Signal(signal.time - start, signal.value) for name, signal in read.items()}
    said += doubts(read, {name: increasing(signal) for name, (signal, _) in raw.items()}, robot, signals)
    return Log(read, recording.source, notes + tuple(f"{recording.source}: {line}" for line in said), guessed)


def _recorded(recording: Recording, robot: Robot) -> tuple[Recording, str]:
    """Return a recording without the columns that hold no two numbers, and which signals these are, "" for none."""
    tables, empty = {}, dict[tuple[str, str], None]()
    for topic, table in recording.tables.items():
        fields = {name: column for name, column in table.fields.items() if np.isfinite(column).sum() >= 2}
        empty |= dict.fromkeys((topic, name) for name in table.fields if name not in fields)
        times = {name: column for name, column in table.times.items() if (topic, name) not in empty}
        tables[topic] = dataclasses.replace(table, fields=fields, times=times)
    if empty:
        known, sources = signals_of(robot), guess(recording, robot)[0].signals.values()
        guessed = {(source.topic or "", source.column or source.field) for source in sources}
        found = [f"{topic} {name}".strip() for topic, name in empty if name in known or (topic, name) in guessed]
        said = f"{several(found)}: fewer than two numbers were recorded, left out" if found else ""
    return dataclasses.replace(recording, tables=tables), said if empty else ""


def _by_own_names(recording: Recording, robot: Robot) -> tuple[Signals, tuple[str, ...]]:
    """The columns that have the names of signals, and a line on each that seems misspelt."""
    table, known = recording.tables.get(""), list(signals_of(robot))
    if table is None or not set(known) & set(table.fields):
        return Signals(), ()
    said = []
    filling = tuple(f"{limb}.{joint}." for limb in robot.limbs for joint in robot.joint_names)
    for name in set(table.fields) - set(known):
        if name.startswith(filling):  # a walk has joints that only fill up a limb, too
            continue
        *_, before, last = ("", *name.split("."))
        if (last in JOINT or last == "support" or before in ("force", *BASE)) and name.count(".") in (1, 2):
            said.append(f"{recording.source}: {name}: not read, the robot has no such signal{_nearest(name, known)}")
    own = {name: Source(column=name) for name in known if name in table.fields}
    time, unit, _ = clock_of(recording)
    return Signals(time=time, time_unit=unit, signals=own), tuple(sorted(said))


def _each_in_full(signals: Signals, robot: Robot, meanings: Mapping[str, Meaning]) -> Signals:
    """Return where signals stand, each with what the file says of all; its unit at those of turning joints alone."""
    sliding = {joint for joint, place in joints_of(robot).items() if robot.sliding is not None and robot.sliding[place]}
    turning = {f"{joint}.{what}" for joint in joints_of(robot).keys() - sliding for what in JOINT}
    in_degrees = {n: {"unit": unit} for n in turning if (unit := _IN_DEGREES.get(meanings[n].unit))}
    units, of_all = in_degrees if signals.unit == "deg" else {}, signals.of_all
    sources = {n: source.completed(of_all | units.get(n, {})) for n, source in signals.signals.items()}
    return signals.model_copy(update={"signals": sources})


def _taken(
    recording: Recording, signals: Signals, name: str, meanings: Mapping[str, Meaning], place: str, *, slides: bool
) -> tuple[Signal, str]:
    """Return a signal of a file in SI units, with the columns that were recorded with it.

    Raises:
        ConfigError: a signal that the robot does not have, a unit of another kind, or a place that is not there.
    """
    source, key = signals.signals[name], f"signals.{name}"
    if name not in meanings:
        raise ConfigError(place, key, "a signal of the robot", f"another name{_nearest(name, meanings)}")
    unit = meanings[name].unit
    if source.unit and UNITS[source.unit][0] not in (unit, _SLIDING.get(unit) if slides else unit):
        kind = [other for other, (si, _) in UNITS.items() if si == unit]
        raise ConfigError(place, f"{key}.unit", f"one of {', '.join(kind)}", source.unit)
    topic, field = source.topic or "", source.column or source.field
    if topic not in recording.tables:
        got = f"{topic}{_nearest(topic, recording.tables)}" if topic else "a recording of topics"
        raise ConfigError(place, f"{key}.topic", f"a topic of {recording.source}", got)
    table = recording.tables[topic]
    if field not in table.fields:
        which = "field" if topic else "column"
        where = f"a {which} of numbers in {topic or recording.source}"
        raise ConfigError(place, f"{key}.{which}", where, f"{field}{_nearest(field, table.fields)}")
    time, clock = _times(table, source, signals, recording, f"{place}: {key}")
    group = f"{table.topic} {clock}"
    value = table.fields[field]
    recorded = np.isfinite(time) & np.isfinite(value)
    if recorded.sum() < 2:
        raise ConfigError(place, key, "two samples or more", f"{recorded.sum()} in {field}")
    time, value = time[recorded], value[recorded]
    for what, numbers in ((f"{field}: numbers", value), (f"{group.strip()}: times", time)):
        if not np.abs(numbers).max() < _LARGEST:
            raise ConfigError(recording.source, what, f"below {_LARGEST:g}", f"{np.abs(numbers).max():g}")
    later = np.count_nonzero(time[1:] > np.maximum.accumulate(time)[:-1])
    if later == 0 or 3 * later < len(time) - 1:
        pair = next((name for name in table.times if clock in name.split("+") and name != clock), "")
        raise ConfigError(
            recording.source, f"time: {clock}", "times that increase" + f" (time: {pair} in signals.yaml)" * bool(pair),
            f"{len(time) - 1 - later} of {len(time)} that come no later than one before them",
        )  # fmt: skip
    return Signal(time, source.factor * (source.signed(value) - source.zero)), group


def _times(table: Table, source: Source, signals: Signals, recording: Recording, place: str) -> tuple[np.ndarray, str]:
    """Return the times of a table's samples, s, and the name of their clock."""
    clock = source.time or signals.time
    if table.topic:
        clock = clock if clock in table.times else "log"
        unit = 1.0
    else:
        unit = SECONDS[source.time_unit or signals.time_unit]
        if clock not in table.times:
            expected = f"a column of times in {recording.source} (time: NAME in signals.yaml)"
            got = f"no {clock} with numbers or dates{_nearest(clock, table.times)}"
            raise ConfigError(place if source.time else recording.source, "time", expected, got)
    return unit * table.times[clock] + source.shift, clock


def _columns(recording: Recording) -> str:
    places = [f"{topic} {field}".strip() for topic, table in recording.tables.items() for field in table.fields]
    return ", ".join(places[:12]) + (f" and {len(places) - 12} more" if len(places) > 12 else "") or "nothing"
