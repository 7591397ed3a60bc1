"""Margins of the linearised loop: how far hardware may get worse before a small disturbance of the stance grows.

The loop is that of `tuning.judged.stability_limit`, with delays, filter and control period in it. Walks say what
happens until they end; this says where shaking begins that would never end.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.quantities.parameters import own_numbers
from mjx_climb.rollouts.given import AnyGains
from tuning.judged import stability_limit
from tuning.judged.margins import (
    QUANTITIES,
    Margin,
    changes,
    joint_gains,
    needed,
    reaches,
    up_to,
    values_of,
    whole_steps,
    with_unit,
    without_joint,
)

POINTS = 9  # values of a quantity
_BEYOND = 1.5  # times what a walk bears: a loop that is hardly unstable takes longer than a walk to tear a gripper off


class Stable(NamedTuple):
    """How far one quantity may go, in its unit."""

    up_to: float | None  # None: not even at the best value
    tried: float  # the worst value: what reaches it may go on


def find(
    scenario: mc.Scenario,
    gains: AnyGains,
    margins: Mapping[str, Margin],
    *,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Stable]:
    """Return up to where the loop is stable, by quantity.

    Arguments:
        scenario: what walks where, on which hardware.
        gains: those in question; kp and kd replace the scenario's where given.
        margins: of walks with these gains: they say how far to look.
        law: whose gains they are, the scenario's where None.
        engine: the dynamics.
        progress: called with the number of quantities done and of all.
    """
    own, joint, found = own_numbers(scenario), joint_gains(scenario, gains), {}
    for done, (name, margin) in enumerate(margins.items()):
        values = _values(scenario, name, margin)
        numbers = changes(own, name, values, joint)
        radius = stability_limit.spectral_radius(scenario, without_joint(gains), numbers, law=law, engine=engine)
        found[name] = Stable(crossing(values, radius), float(values[-1]))
        if progress is not None:
            progress(done + 1, len(margins))
    return found


def warnings(margins: Mapping[str, Margin], stable: Mapping[str, Stable]) -> list[str]:
    """Return in words where the loop is stable up to less than twice the hardware, though walks hold so far."""
    lines = []
    for name, margin in margins.items():
        wanted, reached = needed(name, margin.own), stable[name]
        if reaches(name, margin.holds, wanted) and not reaches(name, reached.up_to, wanted):
            lines.append(
                f"{QUANTITIES[name].title}: the linearised loop is stable {up_to(name, reached.up_to)}, the hardware "
                f"has {with_unit(name, margin.own)}, {with_unit(name, wanted)} would be safe"
            )
    return lines


def crossing(values: np.ndarray, radius: np.ndarray) -> float | None:
    """Return where radii (N,) over values (N,) rise above 1, between two of them on a line; None: from the first on."""
    stable = radius <= 1 + stability_limit.ROUNDING
    bad = int(np.argmin([*stable, False]))
    if bad in (0, len(values)):
        return float(values[-1]) if bad else None
    before, after = radius[bad - 1], radius[bad]
    share = (1 - before) / (after - before) if np.isfinite(after) else 0.0
    return float(values[bad - 1] + share * (values[bad] - values[bad - 1]))


def _values(scenario: mc.Scenario, name: str, margin: Margin) -> np.ndarray:
    grid = values_of(scenario, name)
    if QUANTITIES[name].scales:
        worst = margin.worst if margin.holds is None else max(margin.worst, margin.holds / _BEYOND)
        return np.geomspace(grid[0], worst, POINTS)
    worst = min(margin.worst, _BEYOND * max(margin.holds or 0.0, grid[POINTS // 2]))
    values = np.linspace(grid[0], worst, POINTS)
    return whole_steps(values, scenario.time_step) if name == "control_period" else values
