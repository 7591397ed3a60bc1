"""A log cut into windows of equal length, and its samples as rows by window."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.model.schedule import Schedule, sent_targets
from tuning.identification.readers.doubts import several
from tuning.identification.readers.log import COMMANDS, KP, OFF, Log, Signal, commanded, joints_of, signals_of

LENGTH = 1.0  # s, of a window
SHORTEST = 0.2  # s, of the last window of a stretch
KINDS = (  # of records: of a joint, of a foot, of the base
    "position", "velocity", "effort", "force", "base_position", "base_orientation", "base_linear_velocity",
    "base_angular_velocity",
)  # fmt: skip
_GAP, _PERIODS = 0.1, 5  # s, and periods of the log: a longer silence is a gap
_USUAL, _FEW = 0.8, 10  # quantile of the spacing of commands, least commands
_MISSED, _LATE = 1.6, 3.0  # spacings that lack a command: where something else was recorded, where nothing was
_NEAR = 0.05  # s, samples by which a rate is guessed


class Rows(NamedTuple):
    """The samples of all windows, in the order of windows; a window's end belongs to the next one."""

    window: Int[np.ndarray, " rows"]
    signal: Int[np.ndarray, " rows"]  # index into `Windows.names`
    step: Int[np.ndarray, " rows"]  # of the window, before the sample
    share: Float[np.ndarray, " rows"]  # of the way to the next step; the steps' rates stand half a step before angles
    value: Float[np.ndarray, " rows"]
    stamp: Int[np.ndarray, " rows"]  # which time of the log; signals that were sampled at once share one


@dataclasses.dataclass(frozen=True)
class Windows:
    """A log as the fit sees it."""

    begin: Float[np.ndarray, " windows"]  # s
    abuts: np.ndarray  # (windows,) bool: it goes on where the one before ends
    held_out: np.ndarray  # (windows,) bool: predicted, not fitted
    steps: int  # of each window
    time_step: float  # s
    names: tuple[str, ...]  # of the signals that are predicted
    limb: Int[np.ndarray, " signals"]  # 0 of the base
    joint: Int[np.ndarray, " signals"]  # or the axis
    kind: Int[np.ndarray, " signals"]  # index into KINDS
    rows: Rows
    start: Float[np.ndarray, "windows limb joint 2"]  # rad, rad/s: first guesses of angles and rates
    commands: Mapping[tuple[int, int], Signal]  # by limb and joint
    commanded: str  # kind of the commands, of COMMANDS
    resting: Float[np.ndarray, "limb joint"]  # rad, targets of joints without commands; 0 of other commands
    gains: Mapping[str, Signal]  # P gains and torque off, as logged
    unknown: Float[np.ndarray, "holes 2"]  # s, from when to when commands are missing, in pauses too
    pauses: Float[np.ndarray, "pauses 2"]  # s, from when to when nothing was measured
    constant: tuple[str, ...]  # signals that never change: they say nothing of their noise, and are not predicted

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the records, in the order of KINDS."""
        return tuple(KINDS[k] for k in sorted(set(self.kind)))

    @property
    def missing(self) -> Float[np.ndarray, "holes 2"]:
        """From when to when commands are missing, s, outside of pauses."""
        (begin, end), (start, stop) = np.expand_dims(self.unknown.T, 2), self.pauses.T
        paused = (begin < stop) & (end > start) & (begin > start - _GAP) & (end < stop + _GAP)
        return np.asarray(self.unknown[~paused.any(axis=1)])

    @property
    def stamp_spacing(self) -> float:
        """Median time between two stamps, s."""
        rows = self.rows
        _, first = np.unique(rows.stamp, return_index=True)
        late = (rows.step + rows.share - (self.kind[rows.signal] == 1) / 2)[first]  # rates stand half a step before
        return float(np.median(np.diff(self.begin[rows.window[first]] + late * self.time_step)))

    @property
    def stretch(self) -> Int[np.ndarray, " windows"]:
        """The stretch of each window."""
        return np.asarray(np.cumsum(~self.abuts) - 1)

    def moments(self, which: np.ndarray, count: int, before: int = 0) -> np.ndarray:
        """Return when steps of some windows begin, (windows, count) s, from `before` steps before each."""
        return np.asarray(self.begin[which, None] + (np.arange(count) - before) * self.time_step)

    def targets(
        self, which: np.ndarray, delay: float, before: int = 0, schedule: Schedule | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return joint targets of some windows `delay` s late, rad, and their rates, rad/s.

        Both are (windows, before + steps + 1, limb, joint), from `before` steps before each window. With a schedule of
        gains they are weighed by it.
        """
        count = before + self.steps + 1
        at = self.moments(which, count, before) - delay
        values = np.broadcast_to(self.resting, (*at.shape, *self.resting.shape)).copy()
        rates = np.zeros_like(values)
        for (limb, joint), signal in self.commands.items():
            found = sent_targets(signal, at, self.time_step, schedule)
            values[..., limb, joint], rates[..., limb, joint] = found
        return values, rates

    def jumps(self, signal: np.ndarray, moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how long before (negative) and after moments (rows,) s the torque of their signal's joint jumps, s.

        It does where its command or a gain changes; infinite where it never does.
        """
        before, after = np.full((2, len(moments)), np.inf) * [[-1], [1]]
        for number in np.unique(signal):
            own, command = signal == number, self.commands[int(self.limb[number]), int(self.joint[number])]
            each = (command, *self.gains.values())
            changes = [s.time[1:][np.diff(s.value) != 0] for s in each]
            jumps = np.concatenate([[-np.inf], np.unique(np.concatenate(changes)), [np.inf]])
            next_one = np.searchsorted(jumps, moments[own] - 1e-6 * self.time_step)
            before[own], after[own] = (jumps[next_one + n] - moments[own] for n in (-1, 0))
        return before, after


def cut(
    log: Log, robot: Robot, time_step: float, held_out: float, kinds: Sequence[str] = KINDS[:3], late: float = 0.0
) -> Windows:
    """The windows of a log; the last share `held_out` is not fitted.

    No window runs through a hole of the commands: the next one begins when the first command behind it has arrived.

    Arguments:
        log: its joints count where all of their limb have commands.
        robot: whose log it is.
        time_step: of the model, s.
        held_out: share of the windows.
        kinds: those of KINDS that are predicted.
        late: the longest time that a command takes to the motors, s.

    Raises:
        ConfigError: a log without commands, without anything that can be predicted, or too short.
    """
    kind_of_command = commanded(log)
    commands = {
        place: log.signals[name]
        for joint, place in joints_of(robot).items()
        if (name := f"{joint}.{kind_of_command}") in log.signals
    }
    lacking = {limb for limb, joint in joints_of(robot).values() if (limb, joint) not in commands}
    whole = set(range(len(robot.limbs))) - lacking
    placed = {name: each for name, each in signals_of(robot).items() if name in log.signals and each.kind in kinds}
    beside = {name: each for name, each in placed.items() if each.kind not in KINDS[:3]}
    placed = {name: each for name, each in placed.items() if name not in beside and each.place[0] in whole} | beside
    constant = tuple(name for name in placed if not np.ptp(log.signals[name].value))
    placed = {name: place for name, place in placed.items() if name not in constant}
    names = tuple(placed)
    if constant and not names:
        raise ConfigError(log.source, "", "signals that change", f"{several(constant)}, the same all the time")
    if not names:
        missing = "the commands of all joints of a limb" if not whole else "positions, velocities or efforts"
        first = f"{robot.limbs[0]}.{robot.joint_names[0]}.{'position' if whole else kind_of_command}"
        raise ConfigError(log.source, "", f"{missing}, as {first}", ", ".join(list(log.signals)[:4]))
    signals, steps = [log.signals[name] for name in names], round(LENGTH / time_step)
    length = steps * time_step
    unknown = _unknown([each for place, each in commands.items() if place[0] in whole], signals, log.signals.get(OFF))
    pauses = _pauses(signals)
    begin, abuts, ends = _stretches(signals, length, unknown + np.array([0.0, late]), pauses)
    # commands change when samples are taken, and a step holds one target: samples fall between steps
    begin, ends = begin - time_step / 2, ends + time_step
    if len(begin) < 2:
        known = f"{(ends - begin).sum():.3g} s of {log.duration:.3g} s in stretches of {SHORTEST:g} s or more"
        lost = f" (commands are missing in {len(unknown) - 1} holes)" if len(unknown) > 1 else ""
        raise ConfigError(log.source, "", "two seconds or more without gaps", f"{known}{lost}")
    count = len(begin) - min(round(held_out * len(begin)), len(begin) - 1)
    limb, joint, kind = np.array([(*(0, *each.place)[-2:], KINDS.index(each.kind)) for each in placed.values()]).T
    rows = _rows(signals, kind == 1, begin, ends, steps, time_step)
    return Windows(
        begin=begin, abuts=abuts, held_out=np.arange(len(begin)) >= count, steps=steps, time_step=time_step,
        names=names, limb=limb, joint=joint, kind=kind, rows=rows,
        start=_start(log, robot, begin), commands=commands, commanded=kind_of_command,
        resting=np.asarray(robot.stance_joints, float) * (kind_of_command == COMMANDS[0]),
        gains={name: log.signals[name] for name in (KP, OFF) if name in log.signals},
        unknown=unknown[1:], pauses=pauses, constant=constant,
    )  # fmt: skip


def _unknown(
    commands: Sequence[Signal], measured: Sequence[Signal], off: Signal | None
) -> Float[np.ndarray, "holes 2"]:
    """Return from when to when commands are not known, s: before the first one, and where some are missing.

    A command that is the same after a silence was held. A loop that commands and measures by turns may come late: then
    nothing was measured in between either. Where the torque is off, by the signal `off`, no command is needed.
    """
    spans = []
    seen = np.unique(np.concatenate([signal.time for signal in measured])) if measured else np.zeros(0)
    for time, value in ((signal.time, signal.value) for signal in commands if len(signal.time) >= _FEW):
        spacing = np.diff(time)
        usual = float(np.quantile(spacing, _USUAL))  # a rate that the log's clock rounds has spacings of two kinds
        for n in np.flatnonzero((spacing > _MISSED * usual) & (np.diff(value) != 0)).tolist():
            start, end = time[n] + usual / 2, time[n + 1] - usual / 2
            if spacing[n] < _LATE * usual and np.searchsorted(seen, start) == np.searchsorted(seen, end):
                continue
            between = [] if off is None else off.value[(off.time > time[n]) & (off.time < time[n + 1])] > 0.5
            if not len(between) or not np.all(between):
                spans.append((float(time[n]) + usual, float(time[n + 1])))
    found = [(-np.inf, max(float(signal.time[0]) for signal in commands))] if commands else []
    for start, end in sorted(set(spans)):
        if start <= found[-1][1]:
            found[-1] = (found[-1][0], max(end, found[-1][1]))
        else:
            found.append((start, end))
    return np.reshape(found, (-1, 2))


def _pauses(signals: Sequence[Signal]) -> Float[np.ndarray, "pauses 2"]:
    """From when to when no signal has samples, s."""
    time = np.unique(np.concatenate([signal.time for signal in signals]))
    period = max(float(np.median(np.diff(signal.time))) for signal in signals)
    last = np.flatnonzero(np.diff(time) > max(_GAP, _PERIODS * period))
    return np.column_stack([time[last], time[last + 1]])


def _stretches(
    signals: Sequence[Signal], length: float, unknown: Float[np.ndarray, "holes 2"],
    pauses: Float[np.ndarray, "pauses 2"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return begins of windows, which of them go on, and where their samples end, s; none is in a hole or a pause."""
    time = np.unique(np.concatenate([signal.time for signal in signals]))
    stretch = np.searchsorted(pauses[:, 0], time)  # of each time
    hole = np.searchsorted(unknown[:, 0], time - 1e-9, side="left")
    known = time > np.r_[-np.inf, unknown[:, 1]][hole] - 1e-9
    time, stretch, hole = time[known], stretch[known], hole[known]
    breaks = np.flatnonzero((np.diff(stretch) != 0) | (np.diff(hole) != 0))
    if not len(time):
        return np.zeros(0), np.zeros(0, bool), np.zeros(0)
    firsts, lasts = time[np.r_[0, breaks + 1]], time[np.r_[breaks, len(time) - 1]]
    count = np.maximum((lasts - firsts - SHORTEST) // length + 1, 0).astype(int)
    first, last = np.repeat(firsts, count), np.repeat(lasts, count)
    number = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    return first + number * length, number > 0, np.minimum(first + (number + 1) * length, last + 1e-9)


def _rows(
    signals: Sequence[Signal], rates: np.ndarray, begin: np.ndarray, ends: np.ndarray, steps: int, time_step: float
) -> Rows:
    parts, stamps = [], np.unique(np.concatenate([signal.time for signal in signals]))
    for number, signal in enumerate(signals):
        window = np.searchsorted(begin, signal.time + time_step / 2, side="right") - 1
        inside = (window >= 0) & (signal.time + time_step / 2 < ends[window])
        window, time, value = window[inside], signal.time[inside], signal.value[inside]
        at = (time - begin[window]) / time_step + (0.5 if rates[number] else 0.0)  # rates stand half a step before
        step = np.clip(np.floor(at), 0, steps - 1).astype(int)
        parts.append((window, np.full(len(window), number), step, at - step, value, np.searchsorted(stamps, time)))
    window, *rest = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(window, kind="stable")
    return Rows(window[order], *(column[order] for column in rest))


def _start(log: Log, robot: Robot, begin: np.ndarray) -> np.ndarray:
    """Return first guesses of angles and rates, (window, limb, joint, 2): of the log, or at rest where it has none."""
    start = np.zeros((len(begin), *robot.stance_joints.shape, 2))
    start[..., 0] = robot.stance_joints
    for joint, (n, j) in joints_of(robot).items():
        position = log.signals.get(f"{joint}.position", log.signals.get(f"{joint}.command"))
        velocity = log.signals.get(f"{joint}.velocity")
        if position is not None:
            start[:, n, j] = [_near(position, moment) for moment in begin]
        if velocity is not None:
            start[:, n, j, 1] = np.interp(begin, velocity.time, velocity.value)
    return start


def _near(signal: Signal, moment: float) -> tuple[float, float]:
    """Return value and rate of a signal at a moment, by a parabola through the samples near it."""
    near = np.abs(signal.time - moment) <= max(_NEAR, 2 * float(np.median(np.diff(signal.time))))
    time, value = signal.time[near] - moment, signal.value[near]
    if len(time) < 3:
        return float(np.interp(moment, signal.time, signal.value)), 0.0
    *_, rate, at = np.polyfit(time, value, 2 if len(time) > 5 else 1)
    return float(at), float(rate)
