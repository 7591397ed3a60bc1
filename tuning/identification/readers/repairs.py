"""Changes of a log before it is used, each said in one line: signals of drivers that do not measure
them are left out, and angles that jump by whole turns are made continuous.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from mjx_climb.robot.constants import Robot
from tuning.identification.readers.doubts import MOVES, motion, several
from tuning.identification.readers.log import KP, OFF, Signal, joints_of
from tuning.identification.readers.signals import Signals

TURN = 2 * np.pi
NOTHING = 1e-100  # SI units: no sensor measures less, but for 0
_LEFT = 1.0  # rad, that an angle may move by beside its jump, or be behind its command
_MOSTLY, _BEYOND = 0.9, 0.1  # quantile of samples; rad, noise of an angle that is cut at whole turns
_STALE = 5  # usual lengths of a run of equal samples: longer ones are of a robot at rest
_STEPS = 2.5  # of an encoder's smallest: by less it moves within a sample, or within two
_SENT = ("command", ".support", KP, OFF)  # these stay the same without being stale
_MEASURED = ("position", "velocity", "effort")

Repaired = tuple[dict[str, Signal], tuple[str, ...]]  # signals, and their changes in words


def increasing(signal: Signal) -> Signal:
    """Return a signal without the samples that come no later than one before them."""
    later = np.r_[True, signal.time[1:] > np.maximum.accumulate(signal.time)[:-1]]
    return Signal(signal.time[later], signal.value[later])


def cleaned(raw: Mapping[str, tuple[Signal, str]], signals: Signals) -> tuple[dict[str, Signal], tuple[str, ...]]:
    """Return signals with increasing times and without stale repeats, and the samples left out in words."""
    said: dict[str, list[str]] = {}
    clean = {}
    for name, (signal, _) in raw.items():
        clean[name] = increasing(signal)
        if fewer := len(signal.time) - len(clean[name].time):
            words = f"{fewer} of {len(signal.time)} samples come no later than one before them: left out"
            said.setdefault(words, []).append(name)
    if signals.repeats == "drop":
        together: dict[tuple[str, str, int], list[str]] = {}
        for name, (_, group) in raw.items():
            if not (name.endswith(_SENT) or name.startswith(("base.force.", "base.moment."))):
                kind = "force" if ".force." in name else "base" if name.startswith("base.") else "joint"
                together.setdefault((group, kind, len(clean[name].time)), []).append(name)
        for some in together.values():
            values = np.column_stack([clean[name].value for name in some])
            stale = _stale(values)
            if ".force." in some[0]:
                stale &= values.any(1)  # a foot in the air measures nothing, again and again
            if stale.any():
                words = (
                    f"{stale.sum()} of {len(stale)} samples repeat the one before to the last bit: suspected to be "
                    "stale, dropped (repeats: keep in signals.yaml keeps them)"
                )
                said.setdefault(words, []).extend(some)
                clean |= {name: Signal(clean[name].time[~stale], clean[name].value[~stale]) for name in some}
    return clean, tuple(f"{several(some)}: {words}" for words, some in said.items())


def _stale(values: np.ndarray) -> np.ndarray:
    """Return which rows repeat the one before, but for those of a robot that may not have moved further.

    Such are the first rows, runs far longer than most, those at which all that moves turns round, and those after which
    it moves by a step or two of its encoders: without them slow motion would seem to be ahead of itself by half a step.
    """
    changed = np.r_[True, (values[1:] != values[:-1]).any(1)]
    starts = np.flatnonzero(changed)
    if len(starts) < 3:
        return np.zeros(len(values), bool)
    way = np.diff(values[starts], axis=0)
    runs, moved = np.diff(np.r_[starts, len(values)]), np.abs(way)
    step = np.where(moved > 0, moved, np.inf).min(0)
    onwards = (moved > _STEPS * step).any(1)
    resting = (runs > _STALE * np.median(runs)) | ~np.r_[onwards, onwards[-1]]
    resting[0] |= runs[0] > 2 * np.median(runs)
    if np.median(runs) < 2:  # else a driver repeats its readings
        resting[1:-1] |= (way[:-1] * way[1:] <= 0).all(1)
    return np.asarray(~changed & ~np.repeat(resting, runs))


def without_unmeasured(read: Mapping[str, Signal], robot: Robot) -> Repaired:
    """Return signals without those that are 0 all along though their joint moves, and the signals left out in words."""
    moving = [joint for joint in joints_of(robot) if motion(read, joint, "command", "position") > MOVES]
    measured = [name for joint in moving for what in _MEASURED if (name := f"{joint}.{what}") in read]
    left_out = [name for name in measured if np.abs(read[name].value).max() < NOTHING]
    words = "0 all along while the joint moves, not measured: left out"
    return (
        {name: signal for name, signal in read.items() if name not in left_out},
        (f"{several(left_out)}: {words}",) if left_out else (),
    )


def without_turns(read: Mapping[str, Signal], robot: Robot) -> Repaired:
    """Return signals whose angles do not jump by whole turns, nor are whole turns off their command."""
    found, jumps, off = dict(read), [], []
    for joint, place in joints_of(robot).items():
        if robot.sliding is not None and robot.sliding[place]:
            continue
        for name in (f"{joint}.command", f"{joint}.position"):
            if name in read and (turns := _turns(read[name].value)).any():
                found[name] = Signal(read[name].time, read[name].value - TURN * turns)
                jumps.append((name, int(np.count_nonzero(np.diff(turns)))))
        position, command = found.get(f"{joint}.position"), found.get(f"{joint}.command")
        if position is not None and command is not None:
            apart = position.value - np.interp(position.time, command.time, command.value)
            whole = round(float(np.median(apart)) / TURN)
            if whole and np.quantile(np.abs(apart - TURN * whole), _MOSTLY) < _LEFT:
                found[f"{joint}.position"] = Signal(position.time, position.value - TURN * whole)
                off.append(f"{joint}.position")
    said = []
    if jumps:
        names, counts = zip(*jumps, strict=True)
        said.append(
            f"{several(names)}: {sum(counts)} jumps of 2 pi between neighbours, unwrapped (turns: keep in signals.yaml "
            "keeps them)"
        )
    if off:
        said.append(f"{several(off)}: whole turns off the command, taken away (turns: keep in signals.yaml keeps them)")
    return found, tuple(said)


def _turns(value: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Return by how many whole turns an angle in rad has jumped up to each sample; 0 where it was not cut at turns."""
    change = np.diff(value)
    if np.ptp(value) > TURN + _BEYOND:
        return np.zeros(len(value))
    turns = np.round(change / TURN)
    turns[np.abs(change - TURN * turns) > _LEFT] = 0.0
    return np.concatenate([[0.0], np.cumsum(turns)])
