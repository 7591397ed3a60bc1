"""Where the signals of a log stand, guessed from the names of topics, fields and columns.

The guess is shown: `Signals.to_yaml` is a file to save and correct.
"""

import dataclasses
import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from mjx_climb.robot.constants import Robot
from tuning.identification.readers.log import signals_of
from tuning.identification.readers.named import words_of
from tuning.identification.readers.signals import Signals, Source, TimeUnit
from tuning.identification.readers.table import Recording, Table

_MEANING = {
    "command": "command commands commanded cmd target targets goal goals desired des reference references ref setpoint",
    "velocity": "velocity velocities vel rate rates speed speeds qd dq",
    "effort": "effort efforts torque torques tau",
    "position": "position positions pos angle angles q",
    # a feed-forward is sent beside a target and is none itself
    "": "error errors output acceleration accelerations temperature voltage current covariance limit min max gain "
    "ff feedforward kp ki kd ddq qdd mode lost reserve",
}
_QUANTITY = {word: meaning for meaning, words in _MEANING.items() for word in words.split(" ")}
_DESIRED = {(what, "d") for what in ("q", "qd", "dq", "tau")}
_JOINT = {"joint", "joints", "encoder", "encoders", "motor", "servo"}  # a position, if no other word stands there
_BASE = {"base", "body", "trunk", "pose", "mocap"}
_OF_BASE = {
    ("position",): "position", ("translation",): "position", ("orientation",): "orientation",
    ("rotation",): "orientation", ("quaternion",): "orientation", ("twist", "linear"): "linear_velocity",
    ("linear", "velocity"): "linear_velocity", ("twist", "angular"): "angular_velocity",
    ("angular", "velocity"): "angular_velocity",
}  # fmt: skip
_TIMES = ("time", "timestamp", "stamp", "t", "secs", "seconds")
_UNITS = {"deg": "deg", "degrees": "deg", "degree": "deg", "rpm": "rpm", "mnm": "mN m", "mm": "mm"}
_TIME_UNITS: dict[str, TimeUnit] = {
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "usecs", "utime", "micros", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanosec", "nanosecs", "nanos", "nanoseconds"), "ns"),
}
# numbers beyond are so many since 1970
_EPOCHS: tuple[tuple[float, TimeUnit], ...] = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
_NO_EPOCH = 1e20
_SPARE = 4  # numbers for each joint, in a list with empty places
_APART = 5.0  # s between the clocks of header and recording: not the same clock


@dataclasses.dataclass(frozen=True)
class _Place:
    """A column and the meaning of its name; None where it has none."""

    source: Source
    words: tuple[str, ...]
    quantity: str  # of a joint
    limb: str | None
    joint: str | None
    number: int | None  # the last in its name
    own: bool = False  # the name of its joint in the robot's file stands there

    @property
    def pattern(self) -> str:
        """Its words, with a sign for each number."""
        return " ".join("#" if word.isdecimal() else word for word in self.words)


def guess(recording: Recording, robot: Robot) -> tuple[Signals, tuple[str, ...]]:
    """Return where the signals of a recording seem to stand, and the doubts about that, a line each."""
    time, unit, notes = clock_of(recording)
    ordered = sorted(recording.tables.values(), key=lambda table: "transforms" in next(iter(table.fields), ""))
    places = [place for table in ordered for place in _places(table, robot, time)]
    found: dict[str, Source] = {}
    in_file = {words_of(name) for name in robot.places_in_file()}
    words = {table.topic for table in ordered if not in_file.isdisjoint(map(words_of, table.words))}
    for name, place in (*_named(places), *_numbered(places, robot, words, notes)):
        if name not in found:
            found[name] = place.source
        elif (first := found[name].topic) != place.source.topic and "transforms" not in place.words:
            notes.append(f"{place.source.topic}: not read where {first} has the same signal")
    frames = {
        recording.tables[source.topic].frame for name, source in found.items() if source.topic and "force" in name
    }
    if frames - {"world"}:
        notes.append(
            f"forces: taken as along world axes, their frame is {', '.join(sorted(map(repr, frames)))}; turn them "
            "before, if it is not the world's"
        )
    in_order = {name: found[name] for name in signals_of(robot) if name in found}
    return Signals(time=time, time_unit=unit, signals=in_order), tuple(dict.fromkeys(notes))


def clock_of(recording: Recording) -> tuple[str, TimeUnit, list[str]]:
    """Where times stand, their unit, and the doubts about that."""
    table = recording.tables.get("")
    if table is None:
        stamped = [each.times for each in recording.tables.values() if "header" in each.times]
        apart = max((abs(float(np.median(each["header"] - each["log"]))) for each in stamped), default=0.0)
        if apart > _APART and len(stamped) < len(recording.tables):
            return "log", "s", [f"time: log, since headers have another clock, {apart:.3g} s away"]
        return "header", "s", []
    words = {name: words_of(name) for name in table.times}
    named = [name for word in (*_TIMES, *_TIME_UNITS) for name in words if word in words[name]]
    # dates, and pairs of columns, are times and nothing else
    named = [name for name in ("time", *(each for each in words if each not in table.fields), *named) if name in words]
    column = next((name for name in named if _increases(table.times[name])), named[0] if named else "time")
    said = words_of(column) if column in table.fields else ()
    unit: TimeUnit = next((_TIME_UNITS[word] for word in said if word in _TIME_UNITS), "s")
    if unit == "s" and column in table.times:
        largest = float(np.nanmax(table.times[column]))
        unit = next((unit for least, unit in _EPOCHS if least < largest < _NO_EPOCH), "s")
    return column, unit, []


def _increases(time: np.ndarray) -> bool:
    """Whether a third of some times or more come after those before them."""
    time = time[np.isfinite(time)]
    return bool(3 * np.count_nonzero(time[1:] > time[:-1]) >= len(time) > 1)


def _places(table: Table, robot: Robot, time: str) -> Iterator[_Place]:
    """Yield the meanings of a table's columns by their names."""
    in_file = {
        words: (robot.limbs[n], robot.joint_names[j])
        for name, (n, j) in robot.places_in_file().items()
        if (words := words_of(name))
    }
    for field in table.fields:
        if field == time or field in table.renamed:
            continue
        source = Source(topic=table.topic, field=field) if table.topic else Source(column=field)
        topic = words_of(table.topic)
        if not (words := (*topic, *words_of(field))):
            continue
        unit = next((_UNITS[word] for word in words if word in _UNITS), None)
        source = source.changed({"unit": unit}) if unit else source
        numbers = [int(word) for word in words if word.isdecimal()]
        number = numbers[-1] if numbers else None
        limb = max((limb for limb in robot.limbs if _within(words_of(limb), words)), key=len, default=None)
        joint = max((joint for joint in robot.joint_names if _within(words_of(joint), words)), key=len, default=None)
        quantity = _quantity(words, words)
        told = words_of(_without_numbers(field) if field in table.unnamed else field)
        name = _name_in(topic, told, words_of(limb or ""), in_file)
        own = _quantity(_without(name, (*topic, *told)), words) if name else ""
        if own:
            (limb, joint), quantity = in_file[name], own
        yield _Place(source, words, quantity, limb, joint, number, own=bool(own))


def _without_numbers(field: str) -> str:
    return ".".join(part for part in field.split(".") if not part.isdecimal())


def _name_in(
    topic: tuple[str, ...], field: tuple[str, ...], limb: tuple[str, ...], names: Collection[tuple[str, ...]]
) -> tuple[str, ...]:
    """Return which of some names, as words, stands in a topic and field: the longest, the last of several, () for none.

    A name of numbers alone must be all numbers that the field has beside a limb's name, or else the topic's, where
    the topic names a joint.
    """
    words, numbers = (*topic, *field), tuple(filter(str.isdecimal, _without(limb, field)))
    if not numbers and _JOINT & {before for before, word in itertools.pairwise(topic) if word.isdecimal()}:
        numbers = tuple(filter(str.isdecimal, topic))
    there = [name for name in names if (numbers == name if all(map(str.isdecimal, name)) else _within(name, words))]
    return max(there, key=lambda name: (_within(name, field), len(name), _starts(name, words)), default=())


def _starts(part: Sequence[str], words: Sequence[str]) -> list[int]:
    """Return where words stand in a row in others, the last place first."""
    last = len(words) - len(part) if part else -1
    return [at for at in range(last, -1, -1) if tuple(words[at : at + len(part)]) == tuple(part)]


def _within(part: Sequence[str], words: Sequence[str]) -> bool:
    return bool(_starts(part, words))


def _without(part: Sequence[str], words: Sequence[str]) -> tuple[str, ...]:
    """Return words without some that stand in a row among them."""
    first = next(iter(_starts(part, words)), len(words))
    return (*words[:first], *words[first + len(part) :])


def _quantity(said: Sequence[str], words: Sequence[str]) -> str:
    """Return the kind of a joint's column, by the last word that says it; "" for none that is read.

    `said` are the words of its name but for those of the joint's own, which say nothing about it.
    """
    # q_d is the q that is desired
    said = ["desired" if (before, word) in _DESIRED else word for before, word in itertools.pairwise(("", *said))]
    meanings = [_QUANTITY[word] for word in said if word in _QUANTITY]
    what = [meaning for meaning in meanings if meaning != "command"]
    last = what[-1] if what else "position" if "command" in meanings or _JOINT & {*words} or not said else ""
    if "" in what or ("command" in meanings and last != "position"):  # a velocity that is commanded
        return ""
    return "command" if "command" in meanings else last


def _named(places: Sequence[_Place]) -> Iterator[tuple[str, _Place]]:
    """Yield the plain meanings of names: of joints, foot forces, supports and the base."""
    for place in places:
        words, limb = place.words, place.limb
        axis = words[-1]
        if limb and place.joint and place.quantity:
            yield f"{limb}.{place.joint}.{place.quantity}", place
        elif limb and {"force", "forces"} & {*words} and "torque" not in words[-2:] and axis in ("x", "y", "z"):
            yield f"{limb}.force.{axis}", place
        elif limb and {"support", "gripped"} & {*words}:
            yield f"{limb}.support", place
        elif not limb and "push" in words and axis in ("x", "y", "z"):
            yield f"base.{'moment' if 'torque' in words else 'force'}.{axis}", place
        elif not limb and {*words} & _BASE and "twist.twist" not in place.source.field:  # that has the body's axes
            what = next((what for key, what in _OF_BASE.items() if _within(key, words)), None)
            if what and axis in (*"xyz", *("w" if what == "orientation" else "")):
                yield f"base.{what}.{axis}", place


def _numbered(
    places: Sequence[_Place], robot: Robot, with_names: Collection[str], notes: list[str]
) -> Iterator[tuple[str, _Place]]:
    """Yield the joints that have numbers: within a limb that is named, or limb after limb in the file's order.

    Columns that are alike but for their numbers, some with the names of joints, are read by names alone;
    so are those of a topic of `with_names`, in which the names of joints stand as words.
    """
    groups: dict[tuple[str | None, str, str], dict[int, _Place]] = {}
    named = {place.pattern for place in places if place.own}
    for place in places:
        if place.quantity and not (place.limb and place.joint) and place.number is not None:
            groups.setdefault((place.limb, place.quantity, place.pattern), {})[place.number] = place
    for (limb, quantity, pattern), numbered in groups.items():
        limbs = {name: len(own) for name, own in robot.joints_in_file if limb in (None, name)}
        if pattern in named and limb is None:
            which = ", ".join(str(number) for number in sorted(numbered))
            notes.append(
                f"{pattern}: {which} not read, since others of these are names of joints and none of a limb is"
            )
            continue
        if limb is None and (next(iter(numbered.values())).source.topic or "") in with_names:
            notes.append(
                f"{pattern}: {len(numbered)} numbers not read: names of joints stand in the file, but not as many "
                "beside them (signals.yaml says whose they are)"
            )
            continue
        if not (widths := _widths(len(numbered), limbs)):
            continue
        if widths != limbs:
            joints, each = " or ".join(map(str, sorted({*limbs.values()}))), next(iter(widths.values()))
            notes.append(
                f"{pattern}: {len(numbered)} numbers for {len(limbs)} limbs of {joints} joints, taken as {each} a "
                "limb, of which the first are its joints"
            )
        if limb is None:
            notes.append(
                f"{pattern}: no names of joints, taken limb after limb, {', '.join(limbs)}, as the robot's file has "
                "them (signals.yaml says otherwise)"
            )
        ordered = iter([numbered[number] for number in sorted(numbered)])
        for name, width in widths.items():
            of_limb = [*itertools.islice(ordered, width)][: limbs[name]]
            for joint, place in zip(robot.joint_names, of_limb, strict=False):
                yield f"{name}.{joint}.{quantity}", place


def _widths(count: int, limbs: Mapping[str, int]) -> Mapping[str, int]:
    """Return how many of some numbers each limb has, whose joints are given: those, or as many each; or none.

    Of spare ones a limb has a few: more numbers are no joints.
    """
    if count == sum(limbs.values()):
        return limbs
    each, rest = divmod(count, len(limbs))
    most = max(limbs.values())
    return {} if rest or not most <= each <= _SPARE * most else dict.fromkeys(limbs, each)
