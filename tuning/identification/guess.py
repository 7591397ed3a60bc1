"""Where the signals of a log stand, guessed from the names of topics, fields and columns.

What is guessed is shown: `Signals.to_yaml` is a file to save and correct.
"""

import dataclasses
import itertools
import re
from collections.abc import Iterator, Sequence

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.constants import Robot
from tuning.identification.log import names
from tuning.identification.signals import Signals, Source, TimeUnit
from tuning.identification.table import Recording, Table

_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_MEANING = {
    "command": "command commands commanded cmd target targets goal goals desired reference references ref setpoint",
    "velocity": "velocity velocities vel rate rates speed speeds qd dq",
    "effort": "effort efforts torque torques tau",
    "position": "position positions pos angle angles q",
    "": "error errors output acceleration accelerations temperature voltage current covariance limit min max gain",
}
_QUANTITY = {word: meaning for meaning, words in _MEANING.items() for word in words.split(" ")}
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
    "ms": "ms",
    "msec": "ms",
    "us": "us",
    "usec": "us",
    "ns": "ns",
    "nsec": "ns",
    "nanosec": "ns",
}
_EPOCHS: tuple[tuple[float, TimeUnit], ...] = (
    (1e17, "ns"),
    (1e14, "us"),
    (1e11, "ms"),
)  # numbers beyond are so many since 1970
_APART = 5.0  # s between the clocks of header and recording: not the same clock


@dataclasses.dataclass(frozen=True)
class _Place:
    """A column and what its name says; what it does not say is None."""

    source: Source
    words: tuple[str, ...]
    quantity: str  # of a joint
    limb: str | None
    joint: str | None
    number: int | None  # the last in its name


def guess(recording: Recording, robot: Robot) -> tuple[Signals, tuple[str, ...]]:
    """Return where the signals of a recording seem to stand, and what is doubtful about that, a line each."""
    time, unit, notes = _clock(recording)
    ordered = sorted(recording.tables.values(), key=lambda table: "transforms" in next(iter(table.fields), ""))
    places = [place for table in ordered for place in _places(table, robot, time)]
    found: dict[str, Source] = {}
    for name, place in (*_named(places), *_numbered(places, robot, notes)):
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
    in_order = {name: found[name] for name in names(robot) if name in found}
    return Signals(time=time, time_unit=unit, signals=in_order), tuple(dict.fromkeys(notes))


def words_of(text: str) -> tuple[str, ...]:
    """Return the words and numbers in a name, in small letters."""
    return tuple(word.lower() for word in _WORD.findall(text))


def _clock(recording: Recording) -> tuple[str, TimeUnit, list[str]]:
    """Return where times stand, their unit, and what is doubtful about that."""
    table = recording.tables.get("")
    if table is None:
        stamped = [each.times for each in recording.tables.values() if "header" in each.times]
        apart = max((abs(float(np.median(each["header"] - each["log"]))) for each in stamped), default=0.0)
        if apart > _APART and len(stamped) < len(recording.tables):
            return "log", "s", [f"time: log, since headers have another clock, {apart:.3g} s away"]
        return "header", "s", []
    named = [name for word in _TIMES for name in table.times if word in words_of(name)]
    column = "time" if "time" in table.times or not named else named[0]
    unit: TimeUnit = next((_TIME_UNITS[word] for word in words_of(column) if word in _TIME_UNITS), "s")
    if unit == "s" and column in table.times:
        largest = float(np.nanmax(table.times[column]))
        unit = next((unit for least, unit in _EPOCHS if largest > least), "s")
    return column, unit, []


def _places(table: Table, robot: Robot, time: str) -> Iterator[_Place]:
    """Yield what the names of a table's columns say."""
    of_model = {words_of(name): both for name, both in _joints_of_model(robot).items()}
    for field in table.fields:
        if field == time:
            continue
        source = Source(topic=table.topic, field=field) if table.topic else Source(column=field)
        words = (*words_of(table.topic), *words_of(field))
        limb = max((limb for limb in robot.limbs if _within(words_of(limb), words)), key=len, default=None)
        joint = max((joint for joint in robot.joint_names if _within(words_of(joint), words)), key=len, default=None)
        limb, joint = next((both for name, both in of_model.items() if _within(name, words)), (limb, joint))
        unit = next((_UNITS[word] for word in words if word in _UNITS), None)
        numbers = [int(word) for word in words if word.isdecimal()]
        source = source.changed({"unit": unit}) if unit else source
        yield _Place(source, words, _quantity(words), limb, joint, numbers[-1] if numbers else None)


def _joints_of_model(robot: Robot) -> dict[str, tuple[str, str]]:
    """Return limb and joint by the names of the joints in the robot's model, which come limb after limb."""
    kind = mujoco.mjtObj.mjOBJ_JOINT
    named = [mujoco.mj_id2name(robot.model, kind, joint) for joint in range(1, robot.model.njnt)]
    return dict(zip(named, itertools.product(robot.limbs, robot.joint_names), strict=False))


def _within(part: Sequence[str], words: Sequence[str]) -> bool:
    """Return whether words stand in a row in others."""
    return any(tuple(words[at : at + len(part)]) == tuple(part) for at in range(len(words) - len(part) + 1))


def _quantity(words: Sequence[str]) -> str:
    """Return what a joint's column holds, by the last word that says it; "" for nothing that is read."""
    meanings = [_QUANTITY[word] for word in words if word in _QUANTITY]
    what = [meaning for meaning in meanings if meaning != "command"]
    last = what[-1] if what else "position" if "command" in meanings or _JOINT & {*words} else ""
    if "" in what or ("command" in meanings and last != "position"):  # a velocity that is commanded
        return ""
    return "command" if "command" in meanings else last


def _named(places: Sequence[_Place]) -> Iterator[tuple[str, _Place]]:
    """Yield what names say outright: of joints, foot forces, supports and the base."""
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


def _numbered(places: Sequence[_Place], robot: Robot, notes: list[str]) -> Iterator[tuple[str, _Place]]:
    """Yield the joints that have numbers: within a limb that is named, or limb after limb."""
    groups: dict[tuple[str | None, str, str], dict[int, _Place]] = {}
    for place in places:
        if place.quantity and place.joint is None and place.number is not None:
            pattern = " ".join("#" if word.isdecimal() else word for word in place.words)
            groups.setdefault((place.limb, place.quantity, pattern), {})[place.number] = place
    for (limb, quantity, pattern), numbered in groups.items():
        limbs = robot.limbs if limb is None else (limb,)
        each, rest = divmod(len(numbered), len(limbs))
        if each < robot.joints or rest:
            continue
        if each > robot.joints:
            notes.append(
                f"{pattern}: {len(numbered)} numbers for {len(limbs)} limbs of {robot.joints} joints, taken as "
                f"{each} a limb, of which the first {robot.joints} are its joints"
            )
        ordered = [numbered[number] for number in sorted(numbered)]
        for row, name in enumerate(limbs):
            for joint, place in zip(robot.joint_names, ordered[row * each :], strict=False):
                yield f"{name}.{joint}.{quantity}", place
