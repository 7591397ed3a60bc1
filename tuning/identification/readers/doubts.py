"""Suspicions about a log, each in one line with its evidence and the setting that answers it.

Nothing is corrected here: the user does, in `signals.yaml`.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

import numpy as np
from jaxtyping import Float

from mjx_climb.robot.constants import Robot
from tuning.identification.readers.log import KP, OFF, Signal, joints_of
from tuning.identification.readers.signals import Signals, Source

MOVES = 0.02  # rad: a command that moves by less tells nothing
STILL = 1e-4  # rad: less than the resolution of any encoder
FOLLOWS, APART = 0.8, 0.5  # correlations: position follows this command; it does not
LONGEST_LAG = 0.3  # s, that a joint is late by
PENALTY = 0.05  # of a second of lag, in correlation
SHORTEST = 5 * LONGEST_LAG  # s, of a log in which commands and positions are set beside each other
SLOWEST, FASTEST = 2.0, 2e4  # samples per second that logs have
DEGREES = 180 / np.pi
_STRONGEST, _STRONGER = 100.0, 3.0  # N m, of a joint that has no torque limit; times its limit
_FEWEST = 8  # bits
_SWITCHED = (".support", KP, OFF)  # whole numbers that jump
_MOST = 8192  # samples that are correlated
_IS_STUCK = "suspected to be stuck (leave it out in signals.yaml)"
_IS_DEGREES = "suspected to be degrees (unit: deg in signals.yaml, of the signal or of all)"
_IS_OTHER = "suspected to be of another unit (unit in signals.yaml)"

Read = Mapping[str, Signal]


def doubts(read: Read, recorded: Read, robot: Robot, signals: Signals) -> tuple[str, ...]:
    """Return the doubts about signals, a line each.

    Arguments:
        read: by their names, SI units.
        recorded: the same with stale repeats.
        robot: whose joints they are, for their limits.
        signals: where they stand, for the rates that the user knows.
    """
    joints = list(joints_of(robot))
    unsigned, beyond = dict(_without_sign(recorded, signals)), dict(_beyond_limits(read, robot))
    known = unsigned.keys() | beyond.keys()
    beyond |= dict(_beyond_torque(read, robot, known)) | dict(_scaled(read, joints, known))
    found = [*_together(_spacing(recorded, signals)), *_clock_unit(recorded)]
    for lines in (unsigned.items(), beyond.items(), _rates(read, joints), _stuck(read, robot)):
        found += _together(lines)
    return (*found, *_against_commands(read, joints))


def several(some: Iterable[str]) -> str:
    """Return the first of some names, and how many others there are."""
    first, *others = some
    return f"{first} and {len(others)} more" if others else first


def motion(read: Read, joint: str, *kinds: str) -> float:
    """Return how far a joint moves by the farthest of some of its signals that are there, rad."""
    there = [read[name].value for kind in kinds if (name := f"{joint}.{kind}") in read]
    return max((float(np.ptp(value)) for value in there), default=0.0)


def _together(lines: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield one line for all signals under the same suspicion."""
    by_words: dict[str, list[str]] = {}
    for name, words in lines:
        by_words.setdefault(words, []).append(name)
    yield from (f"{several(some)}: {words}" for words, some in by_words.items())


def _spacing(recorded: Read, signals: Signals) -> Iterator[tuple[str, str]]:
    for name, signal in recorded.items():
        if len(signal.time) < 3:
            continue
        spacing, rate = np.diff(signal.time), signals.signals[name].rate
        usual = float(np.median(spacing)) if rate is None else 1 / rate
        gaps = spacing > signals.longest_gap * usual
        if gaps.any():
            at = int(np.argmax(spacing))
            start, end = signal.time[at : at + 2] - signal.time[0]
            yield (
                name,
                f"{gaps.sum()} gaps, the longest from {start:.4g} to {end:.4g} s, where samples come every "
                f"{usual:.3g} s (longest_gap in signals.yaml says what is one)",
            )
        elif (spread := float(np.std(spacing[spacing < 5 * usual]) / usual)) > 0.2:
            yield (
                name,
                f"samples come every {usual:.3g} s with a jitter of {100 * spread:.0f} % (standard deviation; "
                "time: header in signals.yaml takes the sender's clock, if it has one)",
            )


def _clock_unit(recorded: Read) -> Iterator[str]:
    usual = min(float(np.median(np.diff(signal.time))) for signal in recorded.values())
    if usual > 1 / SLOWEST:
        smaller = next((unit for unit, size in (("ms", 1e-3), ("us", 1e-6)) if usual * size < 1 / SLOWEST), "ns")
        yield f"times: a sample every {usual:.4g} s, suspected to be {smaller} (time_unit: {smaller} in signals.yaml)"
    elif usual < 1 / FASTEST:
        yield f"times: a sample every {usual:.3g} s, suspected to be of a larger unit (time_unit in signals.yaml)"


def _beyond_limits(read: Read, robot: Robot) -> Iterator[tuple[str, str]]:
    for joint, place in joints_of(robot).items():
        if robot.sliding is not None and robot.sliding[place]:
            continue
        for name in (f"{joint}.position", f"{joint}.command"):
            if (signal := read.get(name)) is not None:
                if words := _range(signal.value, float(robot.joint_lower[place]), float(robot.joint_upper[place])):
                    yield name, words


def _range(value: Float[np.ndarray, " samples"], low: float, high: float) -> str:
    """Return the fault in the range of a joint angle, "" for none."""
    span, least, most = high - low, float(value.min()), float(value.max())
    if least >= low - 0.1 * span and most <= high + 0.1 * span:
        return ""
    if np.array_equal(value, value.round()) and max(-least, most) > 180:
        return (
            "whole numbers far beyond the joint's limits, suspected to be encoder counts (unit: counts in signals.yaml)"
        )
    if least / DEGREES >= low - 0.1 * span and most / DEGREES <= high + 0.1 * span and max(-least, most) > 2 * np.pi:
        return f"beyond the joint's limits by some 57 times, {_IS_DEGREES}"
    return (
        "beyond the joint's limits by more than a tenth of its range, suspected to have another zero or axis (zero, "
        "sign in signals.yaml)"
    )


def _without_sign(recorded: Read, signals: Signals) -> Iterator[tuple[str, str]]:
    """Yield which whole numbers are smooth, or small, only where the highest bit is taken for their sign.

    The key may stand once for all where it leaves the numbers of other signals as they are.
    """
    sources = {name: signals.signals[name] for name in recorded}
    read = {name: each.value / sources[name].factor + sources[name].zero for name, each in recorded.items()}
    read = {name: numbers for name, numbers in read.items() if not (sources[name].bits or sources[name].sign_bit)}
    found = {name: key for name, numbers in read.items() if (key := _lost_sign(name, numbers, sources[name]))}
    for name, (bits, words) in found.items():
        others = (numbers for other, numbers in read.items() if found.get(other) != found[name])
        of_all = all(numbers.max() < 2.0 ** (bits - 1) for numbers in others)
        where = f"{words} in signals.yaml" + ", of the signal or of all" * of_all
        yield name, f"suspected to be numbers of {bits} bits read without their sign ({where})"


def _lost_sign(name: str, numbers: Float[np.ndarray, " samples"], source: Source) -> tuple[int, str] | None:
    """Return the bits of numbers that were read without their sign, and the key that gives it back, None for others."""
    whole = numbers.round()
    if name.endswith(_SWITCHED) or np.abs(numbers - whole).max() > 1e-6:
        return None
    if whole.min() < 0 or not 2.0 ** (_FEWEST - 1) <= whole.max() < 2.0**63:
        return None
    bits = int(whole.max()).bit_length()
    if source.counts_per_turn == 2**bits:
        return None
    as_read = float(np.abs(np.diff(whole)).max())
    for key, value in (("bits", bits), ("sign_bit", bits - 1)):
        signed = source.model_copy(update={key: value}).signed(whole)
        smooth = np.abs(np.diff(signed)).max() < as_read / 4
        if smooth or (key == "bits" and bits >= 16 and np.abs(signed).max() < whole.max() / 10):
            return bits, f"{key}: {value}"
    return None


def _beyond_torque(read: Read, robot: Robot, known: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield the efforts that no drive has, but for those with a known fault."""
    for joint, place in joints_of(robot).items():
        if (name := f"{joint}.effort") not in read or name in known:
            continue
        limit = _STRONGEST if robot.torque_limit is None else float(robot.torque_limit[place])
        limit = limit if 0 < limit < np.inf else _STRONGEST
        times = float(np.abs(read[name].value).max()) / limit
        if times > _STRONGER:
            least = max(_STRONGER, 10.0 ** np.floor(np.log10(times)))
            yield (
                name,
                f"more than {least:g} times the torque that the joint's drive can have, suspected to be of another "
                "unit (unit: mA or A with torque_constant, mN m in signals.yaml)",
            )


def _scaled(read: Read, joints: Iterable[str], known: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield which positions move by a multiple of their commands, or by a part, but for those of a known fault."""
    for joint in joints:
        command, position = f"{joint}.command", f"{joint}.position"
        if not {command, position} <= read.keys() or {command, position} & {*known}:
            continue
        moved = {name: float(np.std(read[name].value)) for name in (command, position)}
        for name, other in ((position, command), (command, position)):
            if moved[other] < STILL:
                continue
            times = moved[name] / moved[other]
            if 0.8 < times / DEGREES < 1.25:
                yield name, f"moves 57 times as far as its {other.rpartition('.')[2]}, {_IS_DEGREES}"
            elif times > 10 and moved[name] > MOVES:
                yield name, f"moves more than 10 times as far as its {other.rpartition('.')[2]}, {_IS_OTHER}"


def _rates(read: Read, joints: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield where recorded rates are not those of the recorded angles."""

    for joint in joints:
        position, velocity = read.get(f"{joint}.position"), read.get(f"{joint}.velocity")
        if position is None or velocity is None or np.ptp(position.value) < MOVES or len(position.time) < 10:
            continue
        rate = np.interp(velocity.time, position.time, np.gradient(position.value, position.time))
        if not np.ptp(velocity.value) or not np.ptp(rate):
            continue
        ratio = float(rate @ velocity.value / (rate @ rate))
        if np.corrcoef(rate, velocity.value)[0, 1] ** 2 < FOLLOWS**2:
            continue
        for factor, words in (
            (-1.0, "the other way round than the angle's rate, suspected axis (sign: -1 in signals.yaml)"),
            (DEGREES, "57 times the angle's rate, suspected to be deg/s (unit: deg/s in signals.yaml)"),
            (30 / np.pi, "9.5 times the angle's rate, suspected to be rpm (unit: rpm in signals.yaml)"),
            (1e3, "1000 times the angle's rate, suspected times in ms (time_unit: ms in signals.yaml)"),
        ):
            if 0.8 < ratio / factor < 1.25:
                yield f"{joint}.velocity", words


def _stuck(read: Read, robot: Robot) -> Iterator[tuple[str, str]]:
    """Yield the measured signals that stay the same while their cause moves."""

    def same(name: str, resolution: float = 0.0) -> bool:
        return name in read and float(np.ptp(read[name].value)) <= resolution

    for joint in (joints := list(joints_of(robot))):
        by = motion(read, joint, "command")
        if by > MOVES and same(f"{joint}.position", STILL):
            yield f"{joint}.position", f"the same all the time while its command moves by {by:.3g} rad, {_IS_STUCK}"
        elif by > MOVES and (stretch := _frozen(read, joint)):
            start, end = stretch
            yield (
                f"{joint}.position",
                f"the same from {start:.4g} to {end:.4g} s while its command moves, {_IS_STUCK}",
            )
    moving = [joint for joint in joints if motion(read, joint, "command", "position") > MOVES]
    for name in (f"{joint}.{kind}" for kind in ("velocity", "effort") for joint in moving):
        if same(name):
            yield name, f"the same all the time while its joint moves, {_IS_STUCK}"
    limbs = dict.fromkeys(joint.rpartition(".")[0] for joint in moving)
    for name in (f"{limb}.force.{axis}" for limb in limbs for axis in "xyz"):
        if same(name) and read[name].value[0] != 0:  # of a foot in the air
            yield name, f"the same all the time while its limb moves, {_IS_STUCK}"


def _frozen(read: Read, joint: str) -> tuple[float, float] | None:
    """Return the longest stretch of time, s, in which a position is the same although its command moves far.

    Far is half of all that the position moves by, and the last of a stretch does not count: a joint follows late.
    """
    if not {f"{joint}.command", f"{joint}.position"} <= read.keys() or OFF in read:
        return None
    command, position = read[f"{joint}.command"], read[f"{joint}.position"]
    edges = np.flatnonzero(np.r_[True, np.diff(position.value) != 0, True])
    start = int(np.argmax(np.diff(edges)))
    begin, end = position.time[[edges[start], edges[start + 1] - 1]].tolist()
    sent = command.value[(command.time >= begin) & (command.time <= end - LONGEST_LAG)]
    return (begin, end) if sent.size and np.ptp(sent) > max(MOVES, float(np.ptp(position.value)) / 2) else None


def _against_commands(read: Read, joints: Iterable[str]) -> Iterator[str]:
    """Yield the doubts by positions beside commands: axes, swapped limbs, clocks."""
    both = [joint for joint in joints if f"{joint}.position" in read and f"{joint}.command" in read]
    moved = [joint for joint in both if np.ptp(read[f"{joint}.command"].value) > MOVES]
    moved = [joint for joint in moved if np.ptp(read[f"{joint}.position"].value) >= STILL]
    if not moved:
        return
    start, end = _overlap(read, moved)
    if end < start:
        yield "commands and positions do not overlap in time, suspected clocks (time, shift in signals.yaml)"
    if end - start < SHORTEST:
        return
    step, table = _correlations(read, moved, start, end)
    lags = np.arange(-round(SHORTEST / 2 / step), round(SHORTEST / 2 / step) + 1)
    own = np.array([table[place, place, lags] for place in range(len(moved))])
    best = np.argmax(np.abs(own) * (1 - PENALTY * np.abs(step * lags)), axis=1)  # of two alike the one nearer to none
    peak, lag = own[np.arange(len(moved)), best], step * lags[best]
    usual = float(np.median(lag))
    near = table[:, :, lags[np.abs(step * lags - usual) < LONGEST_LAG / 2 + step]].max(2)
    yield from _together(
        (f"{joint}.position", "goes against its command, suspected to have the other axis (sign: -1 in signals.yaml)")
        for place, joint in enumerate(moved)
        if peak[place] < -FOLLOWS and near[place, place] < FOLLOWS
    )
    yield from _swapped(near, moved)
    if (usual < -max(step, 0.002) or usual > LONGEST_LAG) and np.median(np.abs(peak)) > FOLLOWS:
        way = "before" if usual < 0 else "after"
        yield (
            f"positions: come {abs(usual):.3g} s {way} their commands, suspected to be another clock (shift: "
            f"{-usual:.3g} of the positions in signals.yaml, or time: header)"
        )


def _overlap(read: Read, joints: list[str]) -> tuple[float, float]:
    """Return from when to when commands and positions are all there, s."""
    times = [read[f"{joint}.{what}"].time for joint in joints for what in ("command", "position")]
    return float(max(time[0] for time in times)), float(min(time[-1] for time in times))


def _correlations(read: Read, joints: list[str], start: float, end: float) -> tuple[float, np.ndarray]:
    """Return a time step, s, and the correlations of commands and positions, (command, position, lag in steps).

    A lag is how much later the position comes; negative ones stand at the end, as in `np.fft`.
    """
    signals = [read[f"{joint}.{what}"] for joint in joints for what in ("command", "position")]
    step = min(float(np.median(np.diff(signal.time))) for signal in signals)
    step = max(step, (end - start) / _MOST)
    grid = np.arange(start, end, step)

    def spectrum(what: str, sampled: Callable[[Signal], np.ndarray]) -> np.ndarray:
        values = np.array([sampled(read[f"{joint}.{what}"]) for joint in joints])
        values = values - values.mean(1, keepdims=True)
        values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)
        return np.fft.rfft(values, 2 * len(grid))

    command = spectrum("command", lambda signal: signal.held(grid + 1e-6 * step))
    position = spectrum("position", lambda signal: np.interp(grid, signal.time, signal.value))
    return step, np.fft.irfft(command.conj()[:, None] * position, 2 * len(grid), axis=2)


def _swapped(best: np.ndarray, joints: list[str]) -> Iterator[str]:
    """Yield which positions follow the commands of others, and not their own; by limbs where limbs do."""
    follows = {}
    for place, joint in enumerate(joints):
        first = int(np.argmax(best[:, place]))
        if best[first, place] > FOLLOWS and best[place, place] < APART:
            follows[joint] = joints[first]
    limbs = {(a.split(".")[0], b.split(".")[0]) for a, b in follows.items() if a.split(".")[1] == b.split(".")[1]}
    for limb, other in sorted(limbs):
        pairs = [joint for joint in joints if joint.split(".")[0] == limb]
        if len(pairs) > 1 and all(follows.get(joint, "").split(".")[0] == other for joint in pairs):
            yield (
                f"{limb}: its positions follow the commands of {other}, suspected to be swapped limbs (exchange them "
                "in signals.yaml)"
            )
            follows = {joint: leader for joint, leader in follows.items() if joint not in pairs}
    for joint, other in follows.items():
        yield f"{joint}.position: follows the command of {other}, suspected to be swapped (exchange in signals.yaml)"
