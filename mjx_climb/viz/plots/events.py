"""Events of a walk for its pictures: how far it goes, torn grippers, changes of grip, disturbances."""

import math

import numpy as np

from mjx_climb.files.dataset import AXES
from mjx_climb.trajectory import Trajectory
from mjx_climb.viz.plots.styling import CARGO, PUSH

HUBROBO = 0.23  # m, between HubRobo's base and its feet, for which all lengths of pictures are written


def finite_rows(trajectory: Trajectory) -> int:
    """Return how many rows there are before the state stops being finite."""
    walk = trajectory
    series = (walk.base_position, walk.joint_angles, walk.joint_rates, walk.foot_position, walk.foot_force)
    finite = np.all([np.isfinite(values).reshape(len(values), -1).all(1) for values in series], axis=0)
    return int(finite.size if finite.all() else finite.argmin())


def whole(trajectory: Trajectory) -> int:
    """Return how many rows can be shown: those before the state stops being finite, at least one."""
    return max(finite_rows(trajectory), 1)


def row_at(trajectory: Trajectory, time: float) -> int:
    """Return the row nearest to a time, s; the last finite one where the walk ended or diverged before."""
    row = round((time - float(trajectory.time[0])) / trajectory.scenario.time_step)
    return min(max(row, 0), whole(trajectory) - 1)


def end_of(trajectory: Trajectory) -> float:
    """Return where the time axis ends, s: with the walk, or soon after it diverged."""
    end = float(trajectory.time[-1]) + trajectory.scenario.time_step
    rows = finite_rows(trajectory)
    # one that diverged at once has no time to show
    return end if rows == trajectory.time.size else min(end, 1.1 * float(trajectory.time[rows])) or end


def failure_time(trajectory: Trajectory) -> float:
    """Return when a gripper was torn off or, failing that, the state grew without bound, s; else infinity."""
    if torn := detachments(trajectory):
        return torn[0][0]
    rows = finite_rows(trajectory)
    # a state that overflows has grown from step to step for a while before
    return math.inf if rows == trajectory.time.size else 0.5 * float(trajectory.time[rows])


def detachments(trajectory: Trajectory) -> list[tuple[float, str]]:
    """Return when (s) and which limbs were torn off, in order of time."""
    torn = trajectory.torn_off & ~trajectory.detached
    rows, limbs = np.nonzero(torn[: finite_rows(trajectory)])
    return [(float(trajectory.time[row]), trajectory.limbs[limb]) for row, limb in zip(rows, limbs, strict=True)]


def grip_changes(trajectory: Trajectory) -> np.ndarray:
    """Return the times at which a gripper opens or shuts, s; not those at which it is torn off."""
    support = trajectory.support | trajectory.detached | trajectory.torn_off
    return np.asarray(trajectory.time[1:][(support[1:] != support[:-1]).any(1)])


def disturbances(trajectory: Trajectory) -> list[tuple[float, float, str, str]]:
    """Return the disturbances as (start s, stop s, label, colour)."""
    disturbance, end = trajectory.scenario.disturbance, end_of(trajectory)
    windows: list[tuple[float, float | None, str, str]] = []
    if (cargo := disturbance.cargo).mass > 0:
        windows.append((cargo.start, cargo.stop, f"cargo {cargo.mass:g} kg", CARGO))
    for push in disturbance.pushes:
        words = []
        for vector, unit in ((push.force, "N"), (push.moment, "N m")):
            used = [axis for axis in range(3) if vector[axis]]
            if len(used) == 1:
                words.append(f"{vector[used[0]]:+g} {unit} {AXES[used[0]]}".replace("-", "\N{MINUS SIGN}"))
            elif used:
                words.append(f"{math.hypot(*vector):.3g} {unit}")
        windows.append((push.start, push.stop, ", ".join(words) or "push", PUSH))
    cut = [(start, end if stop is None else min(stop, end), label, color) for start, stop, label, color in windows]
    return [window for window in cut if window[0] < window[1]]


def largest_foot_force(trajectory: Trajectory) -> np.ndarray:
    """Return the largest foot force over time, (T,) N."""
    return np.asarray(lengths(trajectory.foot_force).max(1))


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths (...) of vectors (..., 3)."""
    with np.errstate(over="ignore", invalid="ignore"):  # a walk that diverges
        return np.asarray(np.linalg.norm(vectors, axis=-1))


def size_of(trajectory: Trajectory) -> float:
    """Return the robot's size in HubRobos: by the mean distance between base and feet where the walk begins."""
    away = np.linalg.norm(trajectory.foot_position[0] - trajectory.base_position[0], axis=-1)
    return float(away.mean()) / HUBROBO


def thin(time: np.ndarray, values: np.ndarray, points: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Return about `points` samples of a line that look like all of it: both extremes of every stretch."""
    if time.size <= points:
        return time, values
    size = math.ceil(2 * time.size / points)
    rows = np.arange(time.size + -time.size % size).clip(max=time.size - 1).reshape(-1, size)
    stretches = values[rows]
    low = np.where(np.isfinite(stretches), stretches, np.inf).argmin(1)
    high = np.where(np.isfinite(stretches), stretches, -np.inf).argmax(1)
    first = np.arange(len(rows))
    chosen = np.unique(np.concatenate([[0, time.size - 1], rows[first, low], rows[first, high]]))
    return time[chosen], values[chosen]
