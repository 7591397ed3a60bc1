"""Margins of the linearised loop: how far hardware may get worse before a small disturbance of the stance grows.

The loop is that of `tuning.comparisons.stability_limit`, with delays, filter and control period in it. Walks tell
of failures until they end; this tells where shaking begins that would never end.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from tuning.comparisons import stability_limit
from tuning.comparisons.margins import (
    QUANTITIES,
    Margin,
    Quantity,
    changes,
    count_good,
    joint_gains,
    without_joint,
)
from tuning.problem.variations import PERIOD, whole_periods

POINTS = 9  # values of a quantity that are looked at first
_FINER, _PRECISION = 4, 1e-3  # values between a good and a bad one, until these are as close together
_BEYOND = 1.5  # times a walk's margin: a loop that is hardly unstable takes longer than a walk to tear a gripper off


class Stable(NamedTuple):
    """How far one quantity may go, in its unit."""

    up_to: float | None  # None: not even at the best value
    tried: float  # the worst value: a margin that reaches it may be larger


def find(
    scenario: mc.Scenario,
    gains: AnyGains,
    margins: Mapping[str, Margin],
    *,
    law: mc.Law | None = None,
    asked: Mapping[str, Quantity] = QUANTITIES,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Stable]:
    """Return up to where the loop is stable, by quantity.

    Arguments:
        gains: those in question; kp, kd and ki replace the scenario's where given.
        margins: of walks with these gains: they say how far to look.
        law: whose gains they are, the scenario's where None.
        asked: the quantities of the margins.
        progress: called with the number of quantities done and of all.
    """
    own, joint, found = own_parameters(scenario), joint_gains(scenario, gains), {}
    for done, (name, margin) in enumerate(margins.items()):
        quantity, down = asked[name], margin.worst < margin.own
        grid = quantity.values(own, scenario.time_step)
        step = scenario.time_step if PERIOD in quantity.paths else 0.0
        reached = (min if down else max)(grid[POINTS // 2], grid[0] if margin.holds is None else margin.holds)
        worst = max(margin.worst, reached / _BEYOND) if down else min(margin.worst, reached * _BEYOND)
        spaced = np.geomspace if quantity.factor else np.linspace
        values = quantity.on_steps(spaced(grid[0], worst, POINTS), scenario.time_step)

        def radii(some: np.ndarray, only: int | None = None, quantity: Quantity = quantity) -> np.ndarray:
            found = stability_limit.by_stance(
                scenario, without_joint(gains), changes(own, quantity, some, joint),
                only=only, hardware=stability_limit.HARDWARE, law=law, engine=engine,
            )  # fmt: skip
            return np.broadcast_to(found, (len(some), found.shape[-1]))  # no disturbance but cargo is in the loop

        found[name] = Stable(crossing(values, radii, step), float(values[-1]))
        if progress is not None:
            progress(done + 1, len(margins))
    return found


def warnings(margins: Mapping[str, Margin], stable: Mapping[str, Stable]) -> list[str]:
    """Return in words where the loop is stable up to less than twice the hardware, though walks hold so far."""
    lines = []
    for name, margin in margins.items():
        if not margin.falls_short("gains hold", margin.holds):
            lines += margin.falls_short("the linearised loop is stable", stable[name].up_to)
    return lines


def crossing(values: np.ndarray, radii: Callable[..., np.ndarray], step: float = 0.0) -> float | None:
    """Return how far from the first of some values (N,) on a loop is stable, to a thousandth; None: nowhere.

    `radii` gives those of values (N,) in each stance (N, S), or in the `only` one whose number is its second argument.
    Of values that are whole steps, where there is a `step`, the last stable one is returned.
    """

    def stable(some: np.ndarray) -> int:
        return count_good(some.max(1) <= 1 + stability_limit.ROUNDING)

    found = radii(values)
    bad = stable(found)
    if bad in (0, len(values)):
        return float(values[-1]) if bad else None
    good, worse, there = float(values[bad - 1]), float(values[bad]), found[bad]
    while True:  # the worst stance alone: others are seldom worse where it begins to be stable
        reached = good
        while abs(worse - reached) > max(1.5 * step, _PRECISION * abs(worse)):
            some = np.linspace(reached, worse, _FINER + 1)
            some = np.unique(whole_periods(some, step)) if step else some
            bad = 1 + stable(radii(some[1:-1], int(there.argmax())))
            reached, worse = float(some[bad - 1]), float(some[bad])
        worse, there = reached, radii(np.array([reached]))[0]
        if reached == good or stable(there[None]):
            return reached
