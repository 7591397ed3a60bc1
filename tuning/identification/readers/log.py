"""A robot's record: signals in SI units, each at its own times.

Names: `LF.coxa.command` and `.position` in rad, `.velocity` rad/s, `.effort` N m (limb and joint as `mjx-climb robot`
prints them); in place of a command of the angle `.velocity_command` rad/s, `.effort_command` N m, or `.pwm_command`,
the share of the supply voltage; `LF.force.x` N, world axes; `LF.support` 1; `base.position.x` m,
`base.orientation.w` 1; `base.force.x` N and `base.moment.x` N m, world axes, pushes on the base from outside;
`control.kp` N m/rad and `torque_off` 1, of all servos.
"""

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.readers.signals import Signals

KP, OFF = "control.kp", "torque_off"  # P gain that the servos were given; 1 where their torque is off
COMMANDS = ("command", "velocity_command", "effort_command", "pwm_command")  # a log has one kind
JOINT = dict(zip(COMMANDS, ("rad", "rad/s", "N m", "1"), strict=True)) | {  # units
    "position": "rad", "velocity": "rad/s", "effort": "N m",
}  # fmt: skip
BASE = {
    "position": "m", "orientation": "1", "linear_velocity": "m/s", "angular_velocity": "rad/s", "force": "N",
    "moment": "N m",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Signal:
    """One recorded number over time; times increase, missing samples are not there."""

    time: Float[np.ndarray, " samples"]  # s, from the log's first sample
    value: Float[np.ndarray, " samples"]  # SI units

    def held(self, moments: np.ndarray) -> np.ndarray:
        """Return the values at moments (...) s, each held until the next sample; before the first that one holds."""
        return np.asarray(self.value[np.maximum(np.searchsorted(self.time, moments, side="right") - 1, 0)])


@dataclasses.dataclass(frozen=True)
class Log:
    """The signals of one recording, by name."""

    signals: Mapping[str, Signal]
    source: str  # the file, as the user named it
    warnings: tuple[str, ...] = ()  # doubts on reading, a line each
    guessed: Signals | None = None  # where each signal was taken from, if the file's own names did not say

    @property
    def digest(self) -> str:
        """SHA-256 of all samples and their names."""
        found = hashlib.sha256()
        for name, signal in sorted(self.signals.items()):
            found.update(name.encode() + np.asarray([signal.time, signal.value], "<f8").tobytes())
        return found.hexdigest()

    @property
    def duration(self) -> float:
        """Time of the last sample, s."""
        return max(float(signal.time[-1]) for signal in self.signals.values())


class Meaning(NamedTuple):
    """The meaning of a signal's name."""

    unit: str  # SI
    kind: str  # of a joint, of a foot, or as base_position
    place: tuple[int, ...]  # limb and joint, limb and axis, or an axis of the base


def signals_of(robot: Robot) -> dict[str, Meaning]:
    """Return all signals that a robot can record, by name: limb after limb, then base and servos."""
    own, found = joints_of(robot), dict[str, Meaning]()
    for n, limb in enumerate(robot.limbs):
        joints = {joint: place for joint, place in own.items() if place[0] == n}
        found |= {f"{j}.{what}": Meaning(JOINT[what], what, at) for j, at in joints.items() for what in JOINT}
        found |= {f"{limb}.force.{axis}": Meaning("N", "force", (n, column)) for column, axis in enumerate("xyz")}
        found[f"{limb}.support"] = Meaning("1", "support", (n,))
    for what, unit in BASE.items():
        axes = enumerate("wxyz" if what == "orientation" else "xyz")
        found |= {f"base.{what}.{axis}": Meaning(unit, f"base_{what}", (column,)) for column, axis in axes}
    return found | {KP: Meaning("N m/rad", KP, ()), OFF: Meaning("1", OFF, ())}


def joints_of(robot: Robot) -> dict[str, tuple[int, int]]:
    """Return limb and joint of each joint, by its name in a log; of none that only fill up a limb."""
    places = sorted(robot.places_in_file().values())
    return {f"{robot.limbs[n]}.{robot.joint_names[j]}": (n, j) for n, j in places}


def commanded(log: Log) -> str:
    """The kind of commands that a log has, of COMMANDS.

    Raises:
        ConfigError: several kinds.
    """
    kinds = {kind: name for name in log.signals for kind in COMMANDS if name.endswith(f".{kind}")}
    if len(kinds) > 1:
        raise ConfigError(log.source, "", "commands of one kind", ", ".join(kinds.values()))
    return next(iter(kinds), COMMANDS[0])
