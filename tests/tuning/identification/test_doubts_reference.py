"""Doubts about random logs, word by word, against a plain reading of each rule, joint by joint and lag by lag."""

import dataclasses

import numpy as np
import pytest

from tests.tuning.identification.recorded import ROBOT
from tuning.identification.readers.doubts import doubts
from tuning.identification.readers.log import Signal
from tuning.identification.readers.signals import Signals, Source

LIMBS, JOINTS = ("LF", "RH"), ("coxa", "femur", "tibia")
NAMES = [f"{limb}.{joint}" for limb in LIMBS for joint in JOINTS]
PLACES = {f"{limb}.{joint}": (ROBOT.limbs.index(limb), n) for limb in LIMBS for n, joint in enumerate(JOINTS)}
ALL_JOINTS = [f"{limb}.{joint}" for limb in ROBOT.limbs for joint in JOINTS]
PER_DEGREE = 180 / np.pi
STUCK = "suspected to be stuck (leave it out in signals.yaml)"
IN_DEGREES = "suspected to be degrees (unit: deg in signals.yaml, of the signal or of all)"


def together(pairs):
    """One line for all names under the same words."""
    by_words = {}
    for name, words in pairs:
        by_words.setdefault(words, []).append(name)
    return [
        (names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more") + ": " + words
        for words, names in by_words.items()
    ]


def spacing_by_hand(recorded, signals):
    for name, signal in recorded.items():
        steps = [b - a for a, b in zip(signal.time, signal.time[1:], strict=False)]
        if len(steps) < 2:
            continue
        rate = signals.signals[name].rate
        usual = 1 / rate if rate else float(np.median(steps))
        gaps = [n for n, step in enumerate(steps) if step > signals.longest_gap * usual]
        if gaps:
            longest = max(gaps, key=lambda n: steps[n])
            begin, end = signal.time[longest] - signal.time[0], signal.time[longest + 1] - signal.time[0]
            words = (
                f"{len(gaps)} gaps, the longest from {begin:.4g} to {end:.4g} s, where samples come every {usual:.3g} s"
            )
            yield name, f"{words} (longest_gap in signals.yaml says what is one)"
            continue
        near = [step for step in steps if step < 5 * usual]
        spread = np.sqrt(sum((step - sum(near) / len(near)) ** 2 for step in near) / len(near)) / usual
        if spread > 0.2:
            words = f"samples come every {usual:.3g} s with a jitter of {100 * spread:.0f} % (standard deviation; time:"
            yield name, f"{words} header in signals.yaml takes the sender's clock, if it has one)"


def clock_by_hand(recorded):
    usual = min(float(np.median(np.diff(signal.time))) for signal in recorded.values())
    if usual > 0.5:
        unit = "ms" if usual < 500 else "us" if usual < 5e5 else "ns"
        return [f"times: a sample every {usual:.4g} s, suspected to be {unit} (time_unit: {unit} in signals.yaml)"]
    if usual < 5e-5:
        return [f"times: a sample every {usual:.3g} s, suspected to be of a larger unit (time_unit in signals.yaml)"]
    return []


def range_by_hand(value, low, high):
    room = 0.1 * (high - low)
    least, most = min(value), max(value)
    if low - room <= least and most <= high + room:
        return None
    largest = max(abs(least) if least < 0 else least and -least, most)
    if all(float(each).is_integer() for each in value) and largest > 180:
        return (
            "whole numbers far beyond the joint's limits, suspected to be encoder counts (unit: counts in signals.yaml)"
        )
    if low - room <= least / PER_DEGREE and most / PER_DEGREE <= high + room and largest > 2 * np.pi:
        return f"beyond the joint's limits by some 57 times, {IN_DEGREES}"
    return (
        "beyond the joint's limits by more than a tenth of its range, suspected to have another zero or axis (zero, "
        "sign in signals.yaml)"
    )


def limits_by_hand(read, robot):
    for joint in ALL_JOINTS:
        place = robot.limbs.index(joint[:2]), JOINTS.index(joint[3:])
        if robot.sliding is not None and robot.sliding[place]:
            continue
        for name in (f"{joint}.position", f"{joint}.command"):
            if name in read:
                words = range_by_hand(read[name].value, robot.joint_lower[place], robot.joint_upper[place])
                if words:
                    yield name, words


def signs_by_hand(recorded, signals):
    """Of all where the numbers of the others are below the sign's place."""
    lost, raw = dict(lost_by_hand(recorded, signals)), {}
    for name, signal in recorded.items():
        if not (signals.signals[name].bits or signals.signals[name].sign_bit):
            raw[name] = max(signal.value / signals.signals[name].factor + signals.signals[name].zero)
    for name, (key, bits) in lost.items():
        unspoilt = all(most < 2 ** (bits - 1) for other, most in raw.items() if lost.get(other) != (key, bits))
        where = f"{key} in signals.yaml" + (", of the signal or of all" if unspoilt else "")
        yield name, f"suspected to be numbers of {bits} bits read without their sign ({where})"


def lost_by_hand(recorded, signals):
    for name, signal in recorded.items():
        source = signals.signals[name]
        number = signal.value / source.factor + source.zero
        whole = np.round(number)
        if name.endswith((".support", "control.kp", "torque_off")) or source.bits or source.sign_bit:
            continue
        if max(abs(number - whole)) > 1e-6 or min(whole) < 0 or not 128 <= max(whole) < 2.0**63:
            continue
        bits = len(f"{int(max(whole)):b}")
        if source.counts_per_turn == 2**bits:
            continue
        jump = max(abs(np.diff(whole)))
        of_two = [each - 2.0**bits if each >= 2.0 ** (bits - 1) else each for each in whole]
        of_sign = [2.0 ** (bits - 1) - each if each >= 2.0 ** (bits - 1) else each for each in whole]
        if max(abs(np.diff(of_two))) < jump / 4 or (bits >= 16 and max(map(abs, of_two)) < max(whole) / 10):
            yield name, (f"bits: {bits}", bits)
        elif max(abs(np.diff(of_sign))) < jump / 4:
            yield name, (f"sign_bit: {bits - 1}", bits)


def torque_by_hand(read, robot, known):
    for joint in ALL_JOINTS:
        name, place = f"{joint}.effort", (robot.limbs.index(joint[:2]), JOINTS.index(joint[3:]))
        if name in read and name not in known:
            limit = 100.0
            if robot.torque_limit is not None and 0 < robot.torque_limit[place] < np.inf:
                limit = robot.torque_limit[place]
            times = max(abs(read[name].value)) / limit
            if times > 3:
                least = 3 if times < 10 else 10 ** (len(str(int(times))) - 1)
                words = f"more than {least:g} times the torque that the joint's drive can have, suspected to be of"
                yield name, f"{words} another unit (unit: mA or A with torque_constant, mN m in signals.yaml)"


def scaled_by_hand(read, known):
    for joint in ALL_JOINTS:
        pair = f"{joint}.position", f"{joint}.command"
        if not all(name in read for name in pair) or any(name in known for name in pair):
            continue
        for name, other in (pair, pair[::-1]):
            own, of_other = np.std(read[name].value), np.std(read[other].value)
            if of_other < 1e-4:
                continue
            word = "command" if other == pair[1] else "position"
            if 0.8 * PER_DEGREE < own / of_other < 1.25 * PER_DEGREE:
                yield name, f"moves 57 times as far as its {word}, {IN_DEGREES}"
            elif own / of_other > 10 and own > 0.02:
                words = "suspected to be of another unit (unit in signals.yaml)"
                yield name, f"moves more than 10 times as far as its {word}, {words}"


def rates_by_hand(read):
    for joint in ALL_JOINTS:
        position, velocity = read.get(f"{joint}.position"), read.get(f"{joint}.velocity")
        if position is None or velocity is None or len(position.time) < 10:
            continue
        if np.ptp(position.value) < 0.02 or np.ptp(velocity.value) == 0:
            continue
        rate = np.interp(velocity.time, position.time, np.gradient(position.value, position.time))
        if max(rate) == min(rate):  # as where the two were not recorded at the same time
            continue
        a, b = rate - rate.mean(), velocity.value - velocity.value.mean()
        if abs(a @ b) < 0.8 * np.sqrt((a @ a) * (b @ b)):
            continue
        ratio, name = sum(rate * velocity.value) / sum(rate**2), f"{joint}.velocity"
        if 0.8 < -ratio < 1.25:
            yield name, "the other way round than the angle's rate, suspected axis (sign: -1 in signals.yaml)"
        if 0.8 < ratio / PER_DEGREE < 1.25:
            yield name, "57 times the angle's rate, suspected to be deg/s (unit: deg/s in signals.yaml)"
        if 0.8 < ratio / (60 / 2 / np.pi) < 1.25:
            yield name, "9.5 times the angle's rate, suspected to be rpm (unit: rpm in signals.yaml)"
        if 0.8 < ratio / 1000 < 1.25:
            yield name, "1000 times the angle's rate, suspected times in ms (time_unit: ms in signals.yaml)"


def stuck_by_hand(read):
    def way(name):
        return np.ptp(read[name].value) if name in read else None

    for joint in ALL_JOINTS:
        by = way(f"{joint}.command") or 0.0
        if by > 0.02 and f"{joint}.position" in read and way(f"{joint}.position") <= 1e-4:
            yield f"{joint}.position", f"the same all the time while its command moves by {by:.3g} rad, {STUCK}"
        elif by > 0.02 and f"{joint}.position" in read:
            position, command = read[f"{joint}.position"], read[f"{joint}.command"]
            runs = [[0, 0]]  # of equal samples, from the first to the last
            for n in range(1, len(position.value)):
                if position.value[n] == position.value[n - 1]:
                    runs[-1][1] = n
                else:
                    runs.append([n, n])
            first, last = max(runs, key=lambda run: run[1] - run[0])
            begin, end = position.time[first], position.time[last]
            sent = [v for t, v in zip(command.time, command.value, strict=True) if begin <= t <= end - 0.3]
            if sent and max(sent) - min(sent) > max(0.02, np.ptp(position.value) / 2):
                yield f"{joint}.position", f"the same from {begin:.4g} to {end:.4g} s while its command moves, {STUCK}"
    moving = [j for j in ALL_JOINTS if max(way(f"{j}.command") or 0, way(f"{j}.position") or 0) > 0.02]
    for what in ("velocity", "effort"):
        for joint in moving:
            if way(f"{joint}.{what}") == 0:
                yield f"{joint}.{what}", f"the same all the time while its joint moves, {STUCK}"
    for limb in [limb for limb in ROBOT.limbs if any(joint.startswith(limb) for joint in moving)]:
        for axis in "xyz":
            name = f"{limb}.force.{axis}"
            if way(name) == 0 and read[name].value[0] != 0:
                yield name, f"the same all the time while its limb moves, {STUCK}"


def beside_commands_by_hand(read):
    moved = [
        joint
        for joint in ALL_JOINTS
        if f"{joint}.position" in read and f"{joint}.command" in read
        and np.ptp(read[f"{joint}.command"].value) > 0.02 and np.ptp(read[f"{joint}.position"].value) >= 1e-4
    ]  # fmt: skip
    if not moved:
        return
    both = [read[f"{joint}.{what}"] for joint in moved for what in ("command", "position")]
    start, end = max(each.time[0] for each in both), min(each.time[-1] for each in both)
    if end < start:
        yield "commands and positions do not overlap in time, suspected clocks (time, shift in signals.yaml)"
    if end - start < 1.5:
        return
    step = max(min(float(np.median(np.diff(each.time))) for each in both), (end - start) / 8192)
    grid = np.arange(start, end, step)
    whole = round(0.75 / step)
    lags = list(range(-whole, whole + 1))

    def unit(values):
        values = values - values.mean()
        return values / np.linalg.norm(values)

    commands, positions = [], []
    for joint in moved:
        sent, seen = read[f"{joint}.command"], read[f"{joint}.position"]
        commands.append(unit(np.array([sent.value[sent.time <= t + 1e-6 * step][-1] for t in grid])))
        positions.append(unit(np.interp(grid, seen.time, seen.value)))

    def alike(command, position, lag):
        """A position that comes `lag` steps later."""
        size = len(grid) - abs(lag)
        return command[:size] @ position[-size:] if lag >= 0 else command[-size:] @ position[:size]

    table = np.array([[[alike(c, p, lag) for lag in lags] for p in positions] for c in commands])
    peaks, late = [], []
    for n in range(len(moved)):
        worth = [abs(c) * (1 - 0.05 * abs(lag * step)) for c, lag in zip(table[n, n], lags, strict=True)]
        peaks.append(table[n, n, int(np.argmax(worth))])
        late.append(step * lags[int(np.argmax(worth))])
    usual = float(np.median(late))
    near = [n for n, lag in enumerate(lags) if abs(lag * step - usual) < 0.15 + step]
    best = table[:, :, near].max(2)
    yield from together(
        (f"{joint}.position", "goes against its command, suspected to have the other axis (sign: -1 in signals.yaml)")
        for n, joint in enumerate(moved) if peaks[n] < -0.8 and best[n, n] < 0.8
    )  # fmt: skip
    follows = {}
    for n, joint in enumerate(moved):
        first = int(np.argmax(best[:, n]))
        if best[first, n] > 0.8 and best[n, n] < 0.5:
            follows[joint] = moved[first]
    for limb in ROBOT.limbs:
        for other in ROBOT.limbs:
            own = [joint for joint in moved if joint.startswith(limb)]
            leaders = [follows.get(joint, "") for joint in own]
            crossed = any(leader == other + joint[2:] for joint, leader in zip(own, leaders, strict=True))
            if len(own) > 1 and crossed and all(leader.startswith(other) for leader in leaders):
                yield (
                    f"{limb}: its positions follow the commands of {other}, suspected to be swapped limbs (exchange "
                    "them in signals.yaml)"
                )
                follows = {joint: leader for joint, leader in follows.items() if joint not in own}
    for joint, other in follows.items():
        yield f"{joint}.position: follows the command of {other}, suspected to be swapped (exchange in signals.yaml)"
    if (usual < -max(step, 0.002) or usual > 0.3) and np.median(np.abs(peaks)) > 0.8:
        way = "before" if usual < 0 else "after"
        yield (
            f"positions: come {abs(usual):.3g} s {way} their commands, suspected to be another clock (shift: "
            f"{-usual:.3g} of the positions in signals.yaml, or time: header)"
        )


def doubts_by_hand(read, recorded, robot, signals):
    unsigned, beyond = list(signs_by_hand(recorded, signals)), dict(limits_by_hand(read, robot))
    known = {name for name, _ in unsigned} | {*beyond}
    beyond |= dict(torque_by_hand(read, robot, known)) | dict(scaled_by_hand(read, known))
    found = [*together(spacing_by_hand(recorded, signals)), *clock_by_hand(recorded), *together(unsigned)]
    found += [*together(beyond.items()), *together(rates_by_hand(read)), *together(stuck_by_hand(read))]
    return (*found, *beside_commands_by_hand(read))


# ------------------------------------------------------------------------------------------------------ random logs


def clock(draw, count, rate):
    """Return times with jitter, gaps, or in another unit, as drawn."""
    time = np.arange(count) / rate
    kind = draw.choice(["even", "even", "jitter", "little jitter", "gap", "long"])
    if "jitter" in kind:
        time = time + draw.uniform(0, (0.3 if "little" in kind else 0.95) / rate, count)
    if kind == "gap":
        at = draw.integers(5, count - 5, 2)
        time = time + (draw.uniform(2, 9) / rate) * (np.arange(count) >= at[0])
        time = time + (draw.uniform(2, 9) / rate) * (np.arange(count) >= at[1])
    return time


def changed(draw, value, middle):
    """Return an angle's values as a driver may give them, now and then as they are."""
    kind = draw.choice(["same"] * 5 + "degrees small negative stuck still shifted counts far ten over tiny".split())
    moved = value - middle
    by_kind = {
        "degrees": np.degrees(value), "small": middle + PER_DEGREE * moved / draw.choice([1, 20]), "negative": -value,
        "stuck": np.full_like(value, middle), "still": middle + 4e-5 * moved / 0.1,
        "shifted": value + draw.uniform(-3, 3), "counts": np.round(value * draw.choice([300, 30])),
        "far": 1000 * value, "ten": middle + moved * draw.choice([0.05, 0.09, 0.11, 9.0, 11.0]),
        "over": middle + moved * draw.uniform(6, 20), "tiny": middle + 0.1 * moved,
    }  # fmt: skip
    return by_kind.get(kind, value)


def drawn(seed):
    """Return signals as read, as recorded, a robot and where the signals stand."""
    draw = np.random.default_rng(seed)
    count, rate = int(draw.integers(60, 260)), float(draw.choice([20.0, 50.0, 100.0]))
    clocks = [clock(draw, count, rate) for _ in range(2)]
    if draw.random() < 0.7:
        clocks = [clocks[0]] * 2
    lag, phases = float(draw.choice([0.0, 0.04, 0.1, -0.08, 0.35, 0.5])), draw.uniform(0, 60, len(NAMES))
    middles = np.array([ROBOT.stance_joints[PLACES[joint]] for joint in NAMES])
    size, order = float(draw.choice([0.004, 0.015, 0.1, 0.3])), np.arange(len(NAMES))
    swap, sound = draw.choice(["none", "joints", "limbs", "crossed"]), draw.random() < 0.5
    if swap == "joints":
        order[[0, 1]] = order[[1, 0]]
    if swap == "limbs":
        order = np.roll(order, 3)
    if swap == "crossed":
        order = np.array([4, 3, 5, 1, 0, 2])

    def course(n, t):
        return middles[n] + size * (np.sin(1.7 * t + phases[n]) + np.sin((5 + n) * t + phases[-1 - n]))

    read, noise = {}, float(draw.choice([0.0, 0.0, 0.05, 0.6]))
    lacking = {n for n in range(len(NAMES)) if draw.random() < 0.25}
    for n, joint in enumerate(NAMES):
        time = clocks[0]
        if n not in lacking:
            read[f"{joint}.command"] = Signal(
                time, course(n, time) if sound else changed(draw, course(n, time), middles[n])
            )
        other = clocks[1] + (time[-1] + draw.uniform(-1.7, 1) if seed % 29 == 0 else 0.0)
        seen = middles[n] + course(int(order[n]), other - lag) - middles[int(order[n])]
        plain = seen + noise * size * draw.standard_normal(count)
        if draw.random() < 0.15:  # it hangs for a while
            at, still = int(draw.integers(0, count // 2)), int(draw.integers(10, count // 2))
            plain[at : at + still] = plain[at]
        sign = middles[n] - (plain - middles[n]) if sound and draw.random() < 0.15 else plain
        read[f"{joint}.position"] = Signal(other, sign if sound else changed(draw, plain, middles[n]))
        if draw.random() < 0.6:
            rate_of = np.gradient(plain, other) * draw.choice([1.0, -1.0, PER_DEGREE, 9.55, 1e3, 70.0, 7.7, 0.0])
            spoilt = rate_of + draw.choice([0.0, 0.0, 0.9, 3.0]) * np.std(rate_of) * draw.standard_normal(count)
            read[f"{joint}.velocity"] = Signal(other, spoilt)
        if draw.random() < 0.6:
            effort = draw.choice([0.5, 4.0, 40.0, 400.0, 4e3, 4e5]) * np.sin(9 * other + n)
            lost = draw.choice(["no", "no", "bits", "sign", "few"])
            if lost != "no":
                bits, whole = int(draw.choice([8, 12, 16])), np.round({"few": 4}.get(lost, 60) * np.sin(2 * other + n))
                raised = 2.0 ** (bits - 1) - whole if lost == "sign" else whole + 2.0**bits
                effort = np.where(whole < 0, raised, whole)
            read[f"{joint}.effort"] = Signal(other, effort * (draw.random() > 0.1) + (draw.random() < 0.1))
    for limb in LIMBS:
        for axis in "xyz":
            if draw.random() < 0.7:
                value = draw.standard_normal(count) * (draw.random() < 0.6) + draw.choice([0.0, 2.5])
                read[f"{limb}.force.{axis}"] = Signal(clocks[0], value)
    slow = draw.choice([1.0] * 12 + [1e-4, 80.0, 3e3, 1e6, 1e9])
    read = {name: Signal(slow * each.time, each.value) for name, each in read.items()}
    sources = {
        name: Source(
            column=name, **({"rate": rate / slow * draw.choice([1.0, 2.0, 0.3])} if draw.random() < 0.2 else {}),
            **({"bits": 16} if draw.random() < 0.1 else {}),
            **({"zero": 3.0, "unit": "mN m"} if name.endswith("effort") and draw.random() < 0.2 else {}),
        )
        for name in read
    }  # fmt: skip
    limit = draw.choice([0.3, 1.0, 10.0, 0.0, np.inf], ROBOT.stance_joints.shape) if draw.random() < 0.6 else None
    slides = draw.random(ROBOT.stance_joints.shape) < (0.3 if draw.random() < 0.2 else 0.0)
    robot = dataclasses.replace(ROBOT, torque_limit=limit, slides=tuple(map(tuple, slides.tolist())))
    recorded = {n: Signal(s.time, s.value * sources[n].factor) if n.endswith("effort") else s for n, s in read.items()}
    return read, recorded, robot, Signals(signals=sources, longest_gap=float(draw.choice([3.0, 5.0, 6.5])))


@pytest.mark.parametrize("seed", range(48))
def test_what_is_said_of_a_log_is_what_each_rule_says_by_itself(seed):
    read, recorded, robot, signals = drawn(seed)
    assert list(doubts(read, recorded, robot, signals)) == list(doubts_by_hand(read, recorded, robot, signals))
