"""The servos' P gain and torque off over time, as logged: data of a fit, not fitted."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.identification.model.held_base import targets_of
from tuning.identification.readers.log import KP, OFF, Signal

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

    def targets(self, command: Signal, moments: np.ndarray, time_step: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the targets of time steps about moments (...) s, rad, and their rates over time, as `targets_of` does.

        They are means weighed by the share of the P gain. A command often changes as the gain or the torque does, and
        the mean of gain times target is not that of one times that of the other: with 40 N m/rad, 0.03 rad and 1 ms a
        kick of 0.3 N m ms was too much, 0.02 rad/s of a joint.
        """
        time = np.union1d(self.time, command.time)
        share, sent = Signal(self.time, self.share).held(time), command.held(time)
        (mean, rate), (weight, change), (product, its_rate) = (
            targets_of(time, value, moments, time_step) for value in (sent, share, share * sent)
        )
        there = weight > 1e-9  # else nothing asks for the target
        divided = np.where(there, weight, 1.0)
        target = np.where(there, product / divided, mean)
        return target, np.where(there, (its_rate - target * change) / divided, rate)


def sent_targets(
    command: Signal, moments: np.ndarray, time_step: float, schedule: Schedule | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return targets of time steps about moments (...) s, and their rates over time, weighed where there is a schedule.

    See `targets_of` and `Schedule.targets`.
    """
    if schedule is None:
        return targets_of(command.time, command.value, moments, time_step)
    return schedule.targets(command, moments, time_step)


def schedule_of(signals: Mapping[str, Signal], kp: float) -> Schedule | None:
    """Return the logged schedule of P gains and torque; None where they are the config's `kp`, N m/rad."""
    there = [signals[name] for name in (KP, OFF) if name in signals and len(signals[name].time)]
    if not there:
        return None
    time = np.unique(np.concatenate([signal.time for signal in there]))

    def held(name: str, otherwise: float) -> np.ndarray:
        signal = signals.get(name, Signal(time[:0], time[:0]))
        return signal.held(time) if len(signal.time) else np.full(len(time), otherwise)

    on = np.where(held(OFF, 0.0) > 0.5, 0.0, 1.0)
    share = held(KP, kp) / kp * on
    return None if (share == 1).all() else Schedule(time, share, on)
