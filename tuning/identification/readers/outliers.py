"""Samples that jump away from those beside them and back: messages of zeros, lost reads, two publishers."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from jaxtyping import Bool, Float

from mjx_climb.robot.constants import Robot
from tuning.identification.readers.doubts import MOVES, several
from tuning.identification.readers.log import Signal, joints_of
from tuning.identification.readers.signals import Signals

_FAR = 5.0  # usual changes: nothing moves by so much from one sample to the next
_AWAY = 0.1  # rad or m, of samples that are not 0
_LONGEST = 3  # samples of 0 of one joint alone: longer it may be at rest there
_MANY = 0.3  # share of samples beyond which they are no outliers but another's

Samples = Float[np.ndarray, " samples"]
Which = Bool[np.ndarray, " samples"]


def without_outliers(
    read: Mapping[str, Signal], robot: Robot, signals: Signals
) -> tuple[dict[str, Signal], tuple[str, ...]]:
    """Signals, without outliers if `signals` drop them, and the suspicions about them, a line each."""
    if signals.outliers == "keep":
        return dict(read), ()
    zero = {name: source.factor * (0.0 - source.zero) for name, source in signals.signals.items()}
    jumping = [f"{joint}.{what}" for what in ("position", "command") for joint in joints_of(robot)]
    jumping += [f"base.position.{axis}" for axis in "xyz"] + ["base.orientation.w"]
    rates = [f"{joint}.{what}" for what in ("velocity", "effort") for joint in joints_of(robot)]
    zeros: dict[str, Which] = {}
    others: dict[str, Which] = {}
    for (what, time), some in _together(read, jumping).items():
        values = np.array([read[name].value for name in some])
        none = values == np.array([[zero[name]] for name in some])
        whole = none.all(0) & (len(some) > 1)
        alone = np.array([_lone(*row, what == "command", whole) for row in zip(values, none, strict=True)])
        whole &= alone.any(0)
        for name, row, lone in zip(some, values, alone, strict=True):
            zeros[name] = lone | whole
            others[name] = np.zeros(len(row), bool)
            others[name][~zeros[name]] = _there_and_back(row[~zeros[name]])
        for name in filter(read.__contains__, rates):  # of the same messages
            if what == "position" and read[name].time.tobytes() == time:
                zeros[name] = whole & (read[name].value == zero[name])
    for name, which in _unmeasured_rates(read, rates, zero):
        zeros[name] = zeros.get(name, False) | which
    rare = {name: which for name, which in others.items() if which.mean() < _MANY}
    often = {name: which for name, which in others.items() if name not in rare}
    if signals.outliers == "drop":
        kept = {name: ~(zeros[name] | rare.get(name, False)) for name in zeros}
        read = {
            name: Signal(signal.time[kept[name]], signal.value[kept[name]]) if name in kept else signal
            for name, signal in read.items()
        }
        zeros, rare = {}, {}
    key = "outliers: drop in signals.yaml leaves them out, keep takes them"
    lines = (
        (zeros, f"are 0 and none beside them is near, suspected not to be measured, or of a second publisher ({key})"),
        (rare, f"jump away from those beside them and back, suspected not to be measured ({key})"),
        (often, "jump from one of two courses to the other, suspected to be of two publishers (take one of them out of "
         "the file; outliers: keep in signals.yaml takes both)"),
    )  # fmt: skip
    return dict(read), tuple(filter(None, (_line(which, words) for which, words in lines)))


def _together(read: Mapping[str, Signal], names: Iterable[str]) -> dict[tuple[str, bytes], list[str]]:
    """Return those of some signals that were read, by their quantity and times."""
    found: dict[tuple[str, bytes], list[str]] = {}
    for name in filter(read.__contains__, names):
        found.setdefault((name.rpartition(".")[2], read[name].time.tobytes()), []).append(name)
    return found


def _unmeasured_rates(
    read: Mapping[str, Signal], rates: Iterable[str], zero: Mapping[str, float]
) -> Iterator[tuple[str, Which]]:
    """Yield which rates and efforts are 0 in a message in which all are, and one of them far from those beside it.

    One alone may well pass 0, and all are 0 for longer where the robot is at rest.
    """
    for some in _together(read, rates).values():
        values = np.array([read[name].value for name in some])
        whole = (values == np.array([[zero[name]] for name in some])).all(0) & (len(some) > 1)
        none = np.zeros_like(whole)
        for value in values:
            none |= _lone(value, whole, True, none)
        yield from ((name, none) for name in some)


def _line(which: Mapping[str, Which], words: str) -> str:
    """Return the line on some samples of signals, "" where there are none."""
    counts = {name: int(each.sum()) for name, each in which.items() if each.any()}
    if not counts:
        return ""
    name = max(counts, key=lambda each: counts[each])
    return f"{several(counts)}: {counts[name]} of {len(which[name])} samples {words}"


def _lone(value: Samples, none: Which, sent: bool, whole: Which) -> Which:
    """Return which samples of 0 are far from the nearest others.

    A command may jump to 0 and stay there, and so may a joint alone; `whole`: messages in which all joints are 0.
    """
    found = np.zeros(len(value), bool)
    at = np.flatnonzero(~none)
    if not none.any() or len(at) < 3:
        return found
    change = np.abs(np.diff(value[at]))
    usual = float(np.quantile(change, 0.95))
    edges = np.flatnonzero(np.diff(np.r_[False, none, False]))
    for start, stop in edges.reshape(-1, 2):
        beside = value[[place for place in (start - 1, stop) if 0 <= place < len(value)]]
        back = len(beside) == 2 and np.ptp(beside) < np.abs(beside - value[start]).min() / 2
        short = stop - start <= _LONGEST
        possible = short and back if sent else whole[start:stop].all() or (short and back)
        before = int(np.searchsorted(at, start))  # of the others, how many
        near = np.r_[change[max(before - 3, 0) : max(before - 1, 0)], change[before : before + 2]]
        far = max(MOVES, _FAR * usual, _FAR * float(near.max(initial=0.0)))
        found[start:stop] = possible and bool((np.abs(beside - value[start]) > far).all())
    return found


def _there_and_back(value: Samples) -> Which:
    """Return which samples are far from both beside them, though these are near each other."""
    found = np.zeros(len(value), bool)
    if len(value) < 5:
        return found
    change, beside = np.diff(value), np.abs(value[2:] - value[:-2])
    away = np.minimum(np.abs(change[:-1]), np.abs(change[1:]))
    usual = float(np.median(beside))
    found[1:-1] = (change[:-1] * change[1:] < 0) & (away > max(_AWAY, 2 * _FAR * usual)) & (away > _FAR * beside)
    return found
