"""Stale repeats, whole turns and outliers of random signals, against a plain reading of each rule, sample by sample.

Values are whole multiples of a power of two, so that thresholds between changes are met exactly.
"""

import dataclasses
import itertools

import numpy as np
import pytest

from tests.tuning.identification.recorded import ROBOT
from tuning.identification.readers.log import Signal
from tuning.identification.readers.outliers import without_outliers
from tuning.identification.readers.repairs import cleaned, without_turns, without_unmeasured
from tuning.identification.readers.signals import Signals, Source

TURN = 2 * np.pi
ALL_JOINTS = [f"{limb}.{joint}" for limb in ROBOT.limbs for joint in ROBOT.joint_names]


def several(names):
    return f"{names[0]} and {len(names) - 1} more" if len(names) > 1 else names[0]


def alike(found, expected):
    """Compare signals and lines."""
    assert list(found[0]) == list(expected[0])
    for name, signal in expected[0].items():
        np.testing.assert_array_equal(found[0][name].time, signal.time, err_msg=name)
        np.testing.assert_allclose(found[0][name].value, signal.value, atol=1e-12, err_msg=name)
    assert list(found[1]) == list(expected[1])


# ---------------------------------------------------------------------------------------------------- stale repeats


def stale_by_hand(rows):
    runs = []  # first row and length
    for n, row in enumerate(rows):
        if n and row == rows[n - 1]:
            runs[-1][1] += 1
        else:
            runs.append([n, 1])
    if len(runs) < 3:
        return set()
    usual = float(np.median([length for _, length in runs]))
    ways = [[b - a for a, b in zip(rows[r[0]], rows[s[0]], strict=True)] for r, s in itertools.pairwise(runs)]
    steps = [min([abs(w) for w in of_column if w], default=np.inf) for of_column in zip(*ways, strict=True)]
    found = set()
    for n, (start, length) in enumerate(runs):
        ahead = ways[min(n, len(ways) - 1)]
        rests = length > 5 * usual or all(abs(w) <= 2.5 * step for w, step in zip(ahead, steps, strict=True))
        rests |= n == 0 and length > 2 * usual
        if usual < 2 and 0 < n < len(runs) - 1:
            rests |= all(a * b <= 0 for a, b in zip(ways[n - 1], ways[n], strict=True))
        if not rests:
            found |= set(range(start + 1, start + length))
    return found


def cleaned_by_hand(raw, repeats):
    said, clean, together = {}, {}, {}
    for name, (signal, group) in raw.items():
        rows, latest = [], -np.inf
        for n, t in enumerate(signal.time):
            if t > latest:
                rows.append(n)
                latest = t
        clean[name] = Signal(signal.time[rows], signal.value[rows])
        if fewer := len(signal.time) - len(rows):
            words = f"{fewer} of {len(signal.time)} samples come no later than one before them: left out"
            said.setdefault(words, []).append(name)
        sent = name.endswith(("command", "support", "kp", "torque_off")) or name[:9] in ("base.forc", "base.mome")
        if not sent:
            kind = "base" if name.startswith("base") else "force" if "force" in name else "joint"
            together.setdefault((group, kind, len(rows)), []).append(name)
    for names in together.values() if repeats == "drop" else ():
        rows = list(zip(*(clean[name].value for name in names), strict=True))
        stale = stale_by_hand(rows)
        if ".force." in names[0]:
            stale = {n for n in stale if any(rows[n])}
        if stale:
            words = (
                f"{len(stale)} of {len(rows)} samples repeat the one before to the last bit: suspected to be stale, "
                "dropped (repeats: keep in signals.yaml keeps them)"
            )
            said.setdefault(words, []).extend(names)
            left = [n for n in range(len(rows)) if n not in stale]
            clean |= {name: Signal(clean[name].time[left], clean[name].value[left]) for name in names}
    return clean, [f"{several(names)}: {words}" for words, names in said.items()]


@pytest.mark.parametrize("seed", range(40))
def test_samples_that_repeat_the_one_before_are_dropped_where_the_robot_moves(seed):
    draw = np.random.default_rng(seed)
    names = [
        "LF.coxa.position", "LF.femur.velocity", "RH.coxa.effort", "LF.force.x", "LF.force.y", "RH.support",
        "base.position.x", "base.force.x", "base.moment.z", "LF.coxa.command", "control.kp", "torque_off",
    ]  # fmt: skip
    names = list(draw.permutation(names)[: draw.integers(1, len(names) + 1)])
    count, raw = int(draw.integers(4, 60)), {}
    fresh = draw.random(count) < draw.choice([0.35, 0.5, 0.9])
    for n in draw.integers(0, count, 2):
        fresh[n : n + int(draw.choice([0, 4, 12, 30]))] = False  # at rest
    fresh[0] = True
    time = np.arange(count) / 10
    if draw.random() < 0.4:
        time = time + draw.choice([0.0, 0.15, -0.15], count)
    reads = np.maximum.accumulate(np.where(fresh, np.arange(count), 0))
    for name in names:
        steps = draw.choice([0, 1, 2, 3, 5, 8, -1, -4], count) * draw.choice([1, 1, -1], count)
        value = np.cumsum(np.where(draw.random(count) < draw.choice([0.0, 0.3, 1.0]), steps, abs(steps))) / 8
        if "force" in name and draw.random() < 0.7:
            value[: count // 3] = 0.0
        own = time if draw.random() < 0.8 else time[:-1]
        raw[name] = Signal(own, value[reads][: len(own)]), draw.choice(["a", "a", "b"])
    repeats = draw.choice(["drop", "drop", "drop", "keep"])
    alike(cleaned(raw, Signals(repeats=repeats)), cleaned_by_hand(raw, repeats))


# ------------------------------------------------------------------------------------------------------ whole turns


def turns_by_hand(read, robot):
    found, jumped, count, off = dict(read), [], 0, []
    for n, joint in enumerate(ALL_JOINTS):
        if robot.sliding is not None and robot.sliding[divmod(n, 3)]:
            continue
        for name in (f"{joint}.command", f"{joint}.position"):
            if name not in read:
                continue
            value, turns = read[name].value, [0]
            for a, b in itertools.pairwise(value):
                whole = round((b - a) / TURN)
                turns.append(turns[-1] + (whole if abs(b - a - TURN * whole) <= 1 else 0))
            if max(value) - min(value) <= TURN + 0.1 and any(turns):
                found[name] = Signal(read[name].time, value - TURN * np.array(turns))
                jumped.append(name)
                count += sum(a != b for a, b in itertools.pairwise(turns))
        pair = found.get(f"{joint}.position"), found.get(f"{joint}.command")
        if None not in pair:
            apart = pair[0].value - np.interp(pair[0].time, pair[1].time, pair[1].value)
            whole = round(float(np.median(apart)) / TURN)
            beyond = np.quantile([abs(each - TURN * whole) for each in apart], 0.9)
            if whole and beyond < 1:
                found[f"{joint}.position"] = Signal(pair[0].time, pair[0].value - TURN * whole)
                off.append(f"{joint}.position")
    said = []
    if jumped:
        said.append(
            f"{several(jumped)}: {count} jumps of 2 pi between neighbours, unwrapped (turns: keep in signals.yaml "
            "keeps them)"
        )
    if off:
        said.append(f"{several(off)}: whole turns off the command, taken away (turns: keep in signals.yaml keeps them)")
    return found, said


@pytest.mark.parametrize("seed", range(20))
def test_whole_turns_are_taken_away(seed):
    draw = np.random.default_rng(seed)
    slides = draw.random(ROBOT.stance_joints.shape) < draw.choice([0.0, 0.4])
    robot = dataclasses.replace(ROBOT, slides=tuple(map(tuple, slides.tolist())) if slides.any() else ())
    count, read = 30, {}
    for joint in draw.permutation(ALL_JOINTS)[:6]:
        course = np.cumsum(draw.uniform(-0.3, 0.3, count)) + draw.choice([0.0, 3.0])
        for what in ("command", "position"):
            if draw.random() < 0.85:
                value = course + draw.choice([0.0, TURN, -2 * TURN, 0.95, 1.05, TURN / 2, TURN + 0.8])
                value = value + np.where(np.arange(count) >= count - draw.integers(0, 6), draw.uniform(0.5, 1.5), 0)
                if draw.random() < 0.5:
                    value = (value + np.pi) % TURN - np.pi
                if draw.random() < 0.3:
                    value[draw.integers(1, count)] += draw.choice([3.0, TURN + 0.97, TURN - 0.5, 2 * TURN])
                read[f"{joint}.{what}"] = Signal(np.arange(count) / 10, value)
    alike(without_turns(read, robot), turns_by_hand(read, robot))


@pytest.mark.parametrize("seed", range(20))
def test_columns_of_zeros_of_joints_that_move_are_left_out(seed):
    draw, read, zeros = np.random.default_rng(seed), {}, []
    for joint in ALL_JOINTS[:6]:
        moves = 0.0
        for what in draw.permutation(["command", "position", "velocity", "effort"])[: draw.integers(2, 5)]:
            size = draw.choice([0.0, 0.0, 1e-200, 0.019, 0.03])
            read[f"{joint}.{what}"] = Signal(np.arange(5.0), np.array([0, size, size / 2, 0, 0]))
            moves = max(moves, size if what in ("command", "position") else 0.0)
        own = [f"{joint}.{what}" for what in ("position", "velocity", "effort") if f"{joint}.{what}" in read]
        zeros += [name for name in own if moves > 0.02 and read[name].value.max() < 1e-100]
    words = "0 all along while the joint moves, not measured: left out"
    left = {name: signal for name, signal in read.items() if name not in zeros}
    alike(without_unmeasured(read, ROBOT), (left, [f"{several(zeros)}: {words}"] if zeros else []))


# --------------------------------------------------------------------------------------------------------- outliers


def lone_by_hand(value, zero, sent, whole):
    """Samples of 0, run by run, that are far from those beside them."""
    others = [n for n in range(len(value)) if not zero[n]]
    if len(others) < 3:
        return set()
    changes = {b: abs(value[b] - value[a]) for a, b in itertools.pairwise(others)}
    usual, found, start = float(np.quantile([*changes.values()], 0.95)), set(), 0
    while start < len(value):
        if not zero[start]:
            start += 1
            continue
        stop = start
        while stop < len(value) and zero[stop]:
            stop += 1
        beside = [value[n] for n in (start - 1, stop) if 0 <= n < len(value)]
        back = len(beside) == 2 and abs(beside[0] - beside[1]) < min(abs(each - value[start]) for each in beside) / 2
        may = (stop - start <= 3 and back) or (not sent and all(whole[start:stop]))
        # the changes among the three samples before, and among the three behind
        before, behind = [n for n in others if n < start][-3:], [n for n in others if n >= stop][:3]
        near = [changes[n] for n in (*before[1:], *behind[1:])]
        far = max(0.02, 5 * usual, 5 * max(near, default=0.0))
        if may and all(abs(each - value[start]) > far for each in beside):
            found |= set(range(start, stop))
        start = stop
    return found


def spikes_by_hand(value):
    if len(value) < 5:
        return set()
    usual = float(np.median([abs(b - a) for a, b in zip(value, value[2:], strict=False)]))
    found = set()
    for n in range(1, len(value) - 1):
        to, back = value[n] - value[n - 1], value[n + 1] - value[n]
        away, beside = min(abs(to), abs(back)), abs(value[n + 1] - value[n - 1])
        if (to > 0) != (back > 0) and to and back and away > max(0.1, 10 * usual) and away > 5 * beside:
            found.add(n)
    return found


def outliers_by_hand(read, signals):
    zero = {name: -source.factor * source.zero for name, source in signals.signals.items()}
    order = [f"{joint}.{what}" for what in ("position", "command") for joint in ALL_JOINTS]
    order += [f"base.position.{axis}" for axis in "xyz"] + ["base.orientation.w"]
    messages, zeros, spikes = {}, {}, {}
    for name in order:
        if name in read:
            key = name.rpartition(".")[2], tuple(read[name].time)
            messages.setdefault(key, []).append(name)
    for (what, time), names in messages.items():
        none = {name: read[name].value == zero[name] for name in names}
        whole = [len(names) > 1 and all(none[name][n] for name in names) for n in range(len(time))]
        lone = {name: lone_by_hand(read[name].value, none[name], what == "command", whole) for name in names}
        dropped = {n for n in set().union(*lone.values()) if whole[n]}
        for name in names:
            zeros[name] = lone[name] | dropped
            left = [n for n in range(len(time)) if n not in zeros[name]]
            spikes[name] = {left[n] for n in spikes_by_hand(read[name].value[left])}
        for name, signal in read.items():
            if name.endswith(("velocity", "effort")) and tuple(signal.time) == time and what == "position":
                zeros[name] = {n for n in dropped if signal.value[n] == zero[name]}
    rare = {name: which for name, which in spikes.items() if len(which) < 0.3 * len(read[name].value)}
    often = {name: which for name, which in spikes.items() if name not in rare}
    found = dict(read)
    if signals.outliers == "drop":
        for name, which in zeros.items():
            out = which | rare.get(name, set())
            left = [n for n in range(len(read[name].value)) if n not in out]
            found[name] = Signal(read[name].time[left], read[name].value[left])
        zeros = rare = {}
    key = "outliers: drop in signals.yaml leaves them out, keep takes them"
    said = []
    for each, words in (
        (zeros, f"are 0 and none beside them is near, suspected not to be measured, or of a second publisher ({key})"),
        (rare, f"jump away from those beside them and back, suspected not to be measured ({key})"),
        (often, "jump from one of two courses to the other, suspected to be of two publishers (take one of them out of "
         "the file; outliers: keep in signals.yaml takes both)"),
    ):  # fmt: skip
        some = {name: len(which) for name, which in each.items() if which}
        if some:
            name = max(some, key=some.get)
            count = len(read[name].value)
            said.append(f"{several(list(some))}: {some[name]} of {count} samples {words}")
    return found, said


def drawn(draw):
    """Return signals with zeros, spikes and second publishers, and where they stand."""
    names = [
        "LF.coxa.position", "LF.femur.position", "LH.coxa.position", "LF.coxa.command", "LF.femur.command",
             "base.position.x", "base.position.y", "base.orientation.w"]  # fmt: skip
    names = list(draw.permutation(names)[: draw.integers(1, len(names) + 1)])
    names += [f"LF.coxa.{what}" for what in ("velocity", "effort") if draw.random() < 0.5]
    count = int(draw.choice([3, 4, 5, 12, 40, 60]))
    message = np.zeros(count, bool)
    for n in draw.integers(0, count, int(draw.choice([0, 1, 3]))):
        message[n : n + draw.choice([1, 2, 5])] = True
    read, sources = {}, {}
    for name in names:
        slow = draw.choice([1, 1, 3])
        value = draw.choice([-40, 12, 64, 200]) + np.cumsum(slow * draw.integers(-1, 3, count)).astype(float)
        value += np.where(np.arange(count) > draw.integers(count), draw.choice([0, 0, 40, 90]), 0)
        for n in draw.integers(0, count, int(draw.choice([0, 0, 1, 2, 6]))):
            value[n : n + draw.choice([1, 1, 1, 2])] += draw.choice([8, -15, 60, -70, 300])
        if draw.random() < 0.15:
            value[draw.choice([0, 1]) :: 2] = draw.choice([300.0, 0.0])
        value[message & (draw.random() < 0.85)] = 0.0
        for n in draw.integers(0, count, int(draw.choice([0, 0, 1, 2]))):
            value[n : n + draw.choice([1, 2, 3, 4, 7])] = 0.0
        step, zero = draw.choice([1 / 64, 1 / 16, 1 / 1024]), float(draw.choice([0.0, 0.0, 32.0]))
        sources[name] = Source(column=name, unit="mm", zero=1000 * zero) if "x" in name else Source(column=name)
        shift = sources[name].factor * (0.0 - sources[name].zero)
        time = np.arange(count) / 10 + (draw.random() < 0.1)
        read[name] = Signal(time, shift + value * step)
    how = draw.choice(["suspect", "suspect", "drop", "keep"])
    return read, Signals(signals=sources, outliers=how)


@pytest.mark.parametrize("seed", range(6))
def test_samples_that_jump_away_and_back_are_outliers(seed):
    draw = np.random.default_rng(seed)
    for _ in range(25):
        read, signals = drawn(draw)
        expected = (dict(read), []) if signals.outliers == "keep" else outliers_by_hand(read, signals)
        alike(without_outliers(read, ROBOT, signals), expected)
