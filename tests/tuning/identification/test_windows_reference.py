"""Windows of random logs against a plain reading of their rules: holes, pauses, stretches, samples, first guesses."""

import dataclasses
import itertools

import numpy as np
import pytest

from tests.tuning.identification.recorded import JOINTS, ROBOT
from tuning.identification.model.windows import KINDS, cut
from tuning.identification.readers.log import OFF, Log, Signal

MEASURED = ("position", "velocity", "effort")


def drawn(draw, count=None):
    """Return a random log: signals on several clocks, with lost commands, silences, and torque that is off."""
    duration, rate = draw.uniform(2.2, 7.5), float(draw.choice([10.0, 40.0, 100.0]))
    silences = [
        (start, start + draw.choice([0.06, 0.3, 0.8])) for start in draw.uniform(0.3, duration, draw.integers(0, 3))
    ]
    lost = [
        (start, start + draw.choice([1.3, 2.2, 4.0, 30.0]) / rate)
        for start in draw.uniform(0.3, duration, draw.integers(0, 4))
    ]

    def times(own_rate, holes):
        time = np.arange(draw.uniform(0, 0.05), duration, 1 / own_rate)
        if draw.random() < 0.3:
            time = time + draw.uniform(-0.3, 0.3, len(time)) / own_rate
        return time[[not any(a < t < b for a, b in holes) for t in time]]

    signals, limbs = {}, draw.permutation(ROBOT.limbs)[: draw.integers(1, 5)]
    together = draw.random() < 0.4
    measured = times(float(draw.choice([rate, 37.0])), silences)
    slower = times(9.0, silences) if draw.random() < 0.3 else measured
    for joint in JOINTS:
        limb, _, number = *joint.split("."), JOINTS.index(joint)
        if limb not in limbs or (limb != limbs[0] and draw.random() < 0.06):
            continue
        sent = measured if together else times(rate, silences + lost)
        if draw.random() < 0.05:
            sent = sent[:7]
        still = 1.0 if draw.random() < 0.8 else np.where(sent > duration / 2, 1.0, 0.0)
        signals[f"{joint}.command"] = Signal(sent, np.sin((1 + 0.1 * number) * sent) * still)
        for kind in MEASURED:
            if draw.random() < 0.6:
                own = slower if kind == "effort" else measured
                value = np.cos((2 + 0.1 * number) * own) * (draw.random() < 0.9)
                signals[f"{joint}.{kind}"] = Signal(own, value)
    if draw.random() < 0.4:
        off = np.arange(0.0, duration, 0.05)
        signals[OFF] = Signal(off, 1.0 * (np.sin(3 * off + draw.uniform(0, 6)) > 0))
    return Log(signals, "log.csv")


def by_hand(log, time_step, held_out, late):
    """Names, holes, pauses, windows as (begin, abuts, held out), and samples as (window, name, at, value, stamp)."""
    commands = {name[:-8]: signal for name, signal in log.signals.items() if name.endswith(".command")}
    whole = [limb for limb in ROBOT.limbs if all(f"{limb}.{joint}" in commands for joint in ROBOT.joint_names)]
    names = [f"{joint}.{kind}" for joint in JOINTS if joint[:2] in whole for kind in MEASURED]
    names = [name for name in names if name in log.signals]
    constant = [name for name in names if len({*log.signals[name].value}) == 1]
    names = [name for name in names if name not in constant]
    signals = [log.signals[name] for name in names]
    stamps = sorted({t for signal in signals for t in signal.time})

    def seen(start, end):
        return any(start <= t < end for t in stamps)

    own, spans, off = [signal for joint, signal in commands.items() if joint[:2] in whole], set(), log.signals.get(OFF)
    for signal in own:
        if len(signal.time) < 10:
            continue
        usual = float(np.quantile(np.diff(signal.time), 0.8))
        for a, b, u, v in zip(signal.time, signal.time[1:], signal.value, signal.value[1:], strict=False):
            if b - a <= 1.6 * usual or u == v:
                continue
            if b - a < 3 * usual and not seen(a + usual / 2, b - usual / 2):
                continue
            states = [] if off is None else [s for t, s in zip(off.time, off.value, strict=True) if a < t < b]
            if not states or min(states) <= 0.5:
                spans.add((a + usual, b))
    holes = [[-np.inf, max((signal.time[0] for signal in own), default=0.0)]]
    for a, b in sorted(spans):
        if a <= holes[-1][1]:
            holes[-1][1] = max(b, holes[-1][1])
        else:
            holes.append([a, b])
    period = max(float(np.median(np.diff(signal.time))) for signal in signals)
    pauses = [(a, b) for a, b in itertools.pairwise(stamps) if b - a > max(0.1, 5 * period)]

    stretches, before = [], None
    for t in stamps:
        inside = [n for n, (a, b) in enumerate(holes) if a < t - 1e-9 and t <= b + late - 1e-9]
        if inside:
            continue
        place = sum(a < t for a, _ in pauses), sum(a < t - 1e-9 for a, _ in holes)
        if place != before:
            stretches.append([t, t])
        stretches[-1][1], before = t, place
    length, windows = round(1 / time_step) * time_step, []
    for first, last in stretches:
        n = 0
        while last - first - n * length >= 0.2:
            end = min(first + (n + 1) * length, last + 1e-9)
            windows.append((first + n * length - time_step / 2, n > 0, end + time_step))
            n += 1
    count = len(windows)
    fitted = count - min(round(held_out * count), count - 1)

    rows = []
    for name, signal in zip(names, signals, strict=True):
        for t, value in zip(signal.time, signal.value, strict=True):
            begun = [n for n, (begin, *_) in enumerate(windows) if begin <= t + time_step / 2]
            if begun and t + time_step / 2 < windows[begun[-1]][2]:
                at = (t - windows[begun[-1]][0]) / time_step + (0.5 if name.endswith("velocity") else 0.0)
                rows.append((begun[-1], name, at, value, stamps.index(t)))
    ahead = [(begin, abuts, n >= fitted) for n, (begin, abuts, _) in enumerate(windows)]
    return names, constant, holes[1:], pauses, ahead, sorted(rows, key=lambda row: row[0])


def guess_by_hand(log, joint, begin):
    """Angle and rate at a moment."""
    rest = ROBOT.stance_joints[divmod(JOINTS.index(joint), 3)]
    position, velocity = (log.signals.get(f"{joint}.{kind}") for kind in ("position", "velocity"))
    position = position or log.signals.get(f"{joint}.command")
    angle, rate = rest, 0.0
    if position is not None:
        room = max(0.05, 2 * float(np.median(np.diff(position.time))))
        near = [n for n, t in enumerate(position.time) if abs(t - begin) <= room]
        angle = float(np.interp(begin, position.time, position.value))
        if len(near) >= 3:
            since = position.time[near] - begin
            powers = np.vander(since, 3 if len(near) >= 6 else 2, increasing=True)
            angle, rate, *_ = np.linalg.lstsq(powers, position.value[near], rcond=None)[0]
    if velocity is not None:
        rate = float(np.interp(begin, velocity.time, velocity.value))
    return angle, rate


@pytest.mark.parametrize("seed", range(24))
def test_windows_are_where_nothing_is_missing(seed):
    draw = np.random.default_rng(seed)
    log = drawn(draw)
    time_step, held_out, late = float(draw.choice([0.001, 0.004])), float(draw.choice([0.0, 0.2, 0.5, 1.0])), 0.02
    windows = cut(log, ROBOT, time_step, held_out, late=late)
    names, constant, holes, pauses, expected, rows = by_hand(log, time_step, held_out, late)
    assert (windows.names, windows.constant) == (tuple(names), tuple(constant))
    np.testing.assert_allclose(windows.unknown, np.reshape(holes, (-1, 2)), atol=1e-12)
    np.testing.assert_allclose(windows.pauses, np.reshape(pauses, (-1, 2)), atol=1e-12)
    missing = [(a, b) for a, b in holes if not any(a > c - 0.1 and b < d + 0.1 for c, d in pauses)]
    np.testing.assert_allclose(windows.missing, np.reshape(missing, (-1, 2)), atol=1e-12)
    found = list(zip(windows.begin, windows.abuts, windows.held_out, strict=True))
    np.testing.assert_allclose(np.array(found, float), np.array(expected, float), atol=1e-12)
    np.testing.assert_array_equal(windows.abuts, [abuts for _, abuts, _ in expected])
    assert windows.stretch[0] == 0
    np.testing.assert_array_equal(np.diff(windows.stretch), [0 if abuts else 1 for _, abuts, _ in expected[1:]])
    assert windows.kinds == tuple(kind for kind in KINDS if any(name.endswith(kind) for name in names))
    own = windows.rows
    assert [(names[n], stamp) for n, stamp in zip(own.signal, own.stamp, strict=True)] == [(r[1], r[4]) for r in rows]
    np.testing.assert_array_equal(own.window, [row[0] for row in rows])
    np.testing.assert_array_equal(own.value, [row[3] for row in rows])
    np.testing.assert_allclose(own.step + own.share, [row[2] for row in rows], atol=1e-9)
    assert (own.step >= 0).all() and (own.step < windows.steps).all()
    assert (own.share < 1)[own.step < windows.steps - 1].all() and (own.share >= 0)[own.step > 0].all()
    first = {}
    for window, name, at, _, stamp in rows:
        first.setdefault(stamp, expected[window][0] + (at - 0.5 * name.endswith("velocity")) * time_step)
    when = [first[stamp] for stamp in sorted(first)]
    assert windows.stamp_spacing == pytest.approx(float(np.median(np.diff(when))), rel=1e-9)
    for n, (begin, *_) in enumerate(expected):
        for joint in JOINTS:
            at = n, *divmod(JOINTS.index(joint), 3)
            np.testing.assert_allclose(windows.start[at], guess_by_hand(log, joint, begin), atol=1e-8, err_msg=joint)


@pytest.mark.parametrize("seed", range(4))
def test_targets_are_means_over_the_steps_about_their_moments(seed):
    """The command as it holds, with a triangle of a step's width to either side; at rest where a joint has none."""
    draw = np.random.default_rng(seed)
    log = drawn(draw)
    windows = cut(log, ROBOT, 0.004, 0.0)
    which, delay, before = np.arange(len(windows.begin))[-2:], float(draw.uniform(0, 0.03)), int(draw.integers(0, 4))
    values, rates = windows.targets(which, delay, before)
    steps = before + windows.steps + 1
    moments = windows.begin[which][:, None] + (np.arange(steps) - before) * 0.004
    np.testing.assert_allclose(windows.moments(which, steps, before), moments, atol=1e-12)
    fine = (np.arange(400) + 0.5 - 200) / 200
    for joint in JOINTS:
        limb, place = divmod(JOINTS.index(joint), 3)
        signal = log.signals.get(f"{joint}.command")
        if signal is None:
            assert (values[..., limb, place] == ROBOT.stance_joints[limb, place]).all()
            assert not rates[..., limb, place].any()
            continue
        for step in draw.integers(0, steps, 12):
            at = moments[0, step] - delay

            def mean(at, signal=signal):
                held = signal.value[np.maximum(np.searchsorted(signal.time, at + 0.004 * fine, side="right") - 1, 0)]
                return (held * (1 - abs(fine))).sum() / (1 - abs(fine)).sum()

            assert values[0, step, limb, place] == pytest.approx(mean(at), abs=3e-4)
            slope = (windows.targets(which, delay - 1e-7, before)[0] - values)[0, step, limb, place] / 1e-7
            assert rates[0, step, limb, place] == pytest.approx(slope, abs=1e-3 + 1e-3 * abs(slope))


@pytest.mark.parametrize("seed", range(4))
def test_torques_jump_where_a_command_or_a_gain_changes(seed):
    draw = np.random.default_rng(seed)
    log = drawn(draw)
    gains = Signal(np.arange(0, 6, 0.7), np.round(draw.uniform(0, 2, 9)))
    log = dataclasses.replace(log, signals=log.signals | {"control.kp": gains})
    windows = cut(log, ROBOT, 0.001, 0.0)
    signal, moments = draw.integers(0, len(windows.names), 60), draw.uniform(-0.5, 8, 60)
    before, after = windows.jumps(signal, moments)
    for n, (number, moment) in enumerate(zip(signal, moments, strict=True)):
        joint = windows.names[number].rpartition(".")[0]
        each = [log.signals[f"{joint}.command"], gains, *[log.signals[name] for name in (OFF,) if name in log.signals]]
        jumps = [t for s in each for t, a, b in zip(s.time[1:], s.value, s.value[1:], strict=False) if a != b]
        past, later = [t - moment for t in jumps if t < moment], [t - moment for t in jumps if t >= moment]
        assert (before[n], after[n]) == pytest.approx((max(past, default=-np.inf), min(later, default=np.inf)))
