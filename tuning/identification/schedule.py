"""What a log says of its servos over time: their P gain, and whether their torque is off. Data of a fit, not fitted."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_climb.walk.stand import targets_of
from tuning.identification.log import KP, OFF, Signal

Gains = dict[str, np.ndarray]  # share and on, as of a Schedule


class Schedule(NamedTuple):
    """P gains by time; each holds until the next one."""

    time: Float[np.ndarray, " samples"]  # s
    share: Float[np.ndarray, " samples"]  # 1, of the config's P gain; 0: torque off
    on: Float[np.ndarray, " samples"]  # 1, or 0: torque off

    def at(self, moments: np.ndarray, time_step: float) -> tuple[Gains, Gains]:
        """Return the means over the time steps about moments (...) s, and their rates over time; see `targets_of`."""
        share, on = (targets_of(self.time, value, moments, time_step) for value in (self.share, self.on))
        return {"share": share[0], "on": on[0]}, {"share": share[1], "on": on[1]}


def schedule_of(signals: Mapping[str, Signal], kp: float) -> Schedule | None:
    """Return what the signals of a log say of P gains and torque; None where they are the config's `kp`, N m/rad."""
    there = [signals[name] for name in (KP, OFF) if name in signals]
    if not there:
        return None
    time = np.unique(np.concatenate([signal.time for signal in there]))

    def held(name: str, otherwise: float) -> np.ndarray:
        signal = signals.get(name, Signal(time[:1], np.array([otherwise])))
        return signal.value[np.maximum(np.searchsorted(signal.time, time, side="right") - 1, 0)]

    on = np.where(held(OFF, 0.0) > 0.5, 0.0, 1.0)
    share = held(KP, kp) / kp * on
    return None if (share == 1).all() else Schedule(time, share, on)


def without_jumps(command: Signal, signals: Mapping[str, Signal]) -> Signal:
    """Return a command that changes in the middle of a time without torque, where the log has none of it.

    Else it would jump as the torque comes back, within a step that has the means of both.
    """
    off = signals.get(OFF)
    if off is None:
        return command
    moments = off.time[off.value > 0.5]
    after = np.searchsorted(command.time, moments, side="right")  # the next command
    places, counts = np.unique(after, return_counts=True)
    places = places[(counts > 2) & (places > 0) & (places < len(command.time))]
    middle = [float(np.median(moments[after == place])) for place in places]
    return Signal(np.insert(command.time, places, middle), np.insert(command.value, places, command.value[places]))
