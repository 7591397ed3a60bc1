"""Pushes that walks bear: the force on the base that half and 95 % of them survive, by direction.

A push lasts for a given time and begins at an instant that is drawn. Of each draw the largest force that it survives is
found by bisection, on a scale of equal ratios: all draws, directions and lengths walk as one batch, round by round, and
every contestant meets the same draws. A walk is lost as in searches: a grip uses more than its limit, or it diverges.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.stats import binom

import mjx_climb as mc
from mjx_climb.disturbances.on_base import Push
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError
from tuning.comparisons import verdicts
from tuning.problem.objectives import lost

SHARES = {"half": 0.5, "95 %": 0.95}  # of the walks that survive
CONFIDENCE = 0.95
SMALLEST = 1 / 64  # of the largest push
EARLIEST = 0.25  # s, of a push
AFTER = 0.5  # s, that a walk goes on after a push at least
# ahead, left and up in the axes of the walk
DIRECTIONS: Mapping[str, tuple[float, float, float]] = {
    "up": (0, 0, 1), "down": (0, 0, -1), "ahead": (1, 0, 0), "back": (-1, 0, 0), "left": (0, 1, 0), "right": (0, -1, 0),
}  # fmt: skip
METRICS = mc.MetricTable(mc.METRICS[name] for name in ("peak_utilization", "diverged"))


class Walker(NamedTuple):
    """Whose walks are pushed."""

    law: mc.Law | None  # the scenario's where None
    gains: AnyGains
    parameters: mc.Parameters | None = None  # the scenario's where None


class Borne(NamedTuple):
    """A force that a share of the walks survives, N, with an interval; 0 and infinity where no push tried bounds it."""

    value: float
    low: float
    high: float


def find(
    scenario: mc.Scenario,
    walkers: Mapping[str, Walker],
    *,
    lengths: tuple[float, ...] = (0.2, 1.0),
    largest: float = 60.0,
    draws: int = 80,
    rounds: int = 5,
    seed: int = 0,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return between which forces each draw is lost, `survived` and `lost` (walker, length, direction, draw) in N.

    `survived` is 0 where the smallest push is lost already, `lost` infinite where the largest is survived.

    Arguments:
        walkers: by name.
        lengths: of a push, s.
        largest: force tried, N; the smallest is `SMALLEST` of it.
        draws: instants, and seeds of the hardware's noise, of each direction.
        rounds: of the bisection; each halves the ratio of both forces.
        progress: called with the number of walks done and of all.

    Raises:
        ConfigError: the walk is too short for the pushes.
    """
    start = instants(scenario, lengths, draws, seed)
    shape, told, bounds = (len(lengths), len(DIRECTIONS), draws), itertools.count(1), []
    walks = int(np.prod(shape))
    for walker in walkers.values():

        def survives(force: np.ndarray, walker: Walker = walker) -> np.ndarray:
            parameters = pushed(scenario, walker, force, np.array(lengths), start, seed)
            found = mc.rollout_metrics(
                scenario, walker.gains, parameters, law=walker.law, metrics=METRICS, engine=engine, unsteady=True
            )
            if progress is not None:
                progress(next(told) * walks, len(walkers) * (rounds + 2) * walks)
            return np.asarray(lost(found) == 0)

        bounds.append(_bisected(survives, shape, largest, rounds))
    dims = ("walker", "length", "direction", "draw")
    named = {
        "walker": list(walkers),
        "length": list(lengths),
        "direction": list(DIRECTIONS),
        "start": (("direction", "draw"), start),
    }
    both = zip(("survived", "lost"), zip(*bounds, strict=True), strict=True)
    data = {name: (dims, np.array(each), {"units": "N"}) for name, each in both}
    return xr.Dataset(data, named, {"smallest": SMALLEST * largest, "largest": largest})


def instants(scenario: mc.Scenario, lengths: tuple[float, ...], draws: int, seed: int) -> np.ndarray:
    """Return when pushes begin, (direction, draw) s.

    Raises:
        ConfigError: the walk is too short for the pushes.
    """
    latest = scenario.duration - max(lengths) - AFTER
    if latest <= EARLIEST:
        least = EARLIEST + max(lengths) + AFTER
        raise ConfigError("", "duration", f"more than {least:g} s for pushes of {max(lengths):g} s", scenario.duration)
    return np.random.default_rng(seed).uniform(EARLIEST, latest, (len(DIRECTIONS), draws)).round(3)


def _bisected(
    survives: Callable[[np.ndarray], np.ndarray], shape: tuple[int, ...], largest: float, rounds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest forces that are survived and the smallest that are not, of `shape`."""
    low, high = np.full(shape, SMALLEST * largest), np.full(shape, largest)
    bears = survives(low)
    endless = bears & survives(high)
    for _ in range(rounds):
        middle = np.sqrt(low * high)
        good = survives(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    low = np.where(endless, largest, np.where(bears, low, 0.0))
    return low, np.where(endless, np.inf, np.where(bears, high, SMALLEST * largest))


def pushed(
    scenario: mc.Scenario, walker: Walker, force: np.ndarray, length: np.ndarray, start: np.ndarray, seed: int
) -> mc.Parameters:
    """Return the parameters with one push in place of the scenario's, of forces (..., length, direction, draw) N."""
    own = own_parameters(scenario) if walker.parameters is None else walker.parameters
    heading = float(np.asarray(own.at("gait.heading")))
    ahead, left = np.array([np.cos(heading), np.sin(heading), 0]), np.array([-np.sin(heading), np.cos(heading), 0])
    ways = np.array([*DIRECTIONS.values()]) @ np.array([ahead, left, [0, 0, 1]])
    vector = force[..., None] * ways[:, None]
    begin: Any = np.broadcast_to(start, force.shape)
    values: dict[str, Any] = {"force": vector, "moment": 0 * vector}
    push = Push(**values, start=begin, stop=begin + length[:, None, None])
    others = tuple(each for each in own.disturbances if not isinstance(each, Push))
    seeds = np.broadcast_to(seed + np.arange(start.size).reshape(start.shape), force.shape)
    return dataclasses.replace(own, disturbances=(*others, push)).replace({"hardware.seed": seeds})


def borne(found: xr.Dataset, share: float) -> Borne:
    """Return the force that a share of the draws survives, of one walker and length; several directions are pooled.

    The interval is that of order statistics: it holds with `CONFIDENCE` at least whatever the draws' distribution.
    """
    low, high = (np.sort(found[name].values.ravel()) for name in ("survived", "lost"))
    count, tail = len(low), (1 - CONFIDENCE) / 2
    # of walks that are lost first, as many as the share that does not survive
    place = min(int(np.floor((1 - share) * count)), count - 1)
    below = int(binom.ppf(tail, count, 1 - share))
    above = int(binom.ppf(1 - tail, count, 1 - share))
    least = low[below - 1] if below > 0 else 0.0
    most = high[above] if above < count else np.inf
    return Borne(_middle(low[place], high[place]), float(least), float(most))


def weakest(found: xr.Dataset, share: float) -> tuple[str, Borne]:
    """Return the direction of the least force that a share survives, and that in every direction, of one walker."""
    ways = found["direction"].values.tolist()
    each = [borne(found.sel(direction=way), share) for way in ways]
    least = Borne(*np.min(each, axis=0).tolist())
    return ways[[one.value for one in each].index(least.value)], least


def _middle(low: float, high: float) -> float:
    """Return the force between two, in equal ratios; 0 or infinity where only one of them was tried."""
    return float(low if low == 0 or np.isinf(high) else np.sqrt(low * high)) if np.isfinite(high) else np.inf


def verdict(found: xr.Dataset) -> str:
    """Return in a sentence how the first walker does in its weakest direction, beside the best of the others in theirs.

    Forces whose intervals overlap are not told apart.
    """
    length, share = float(found["length"].max()), "95 %"
    own = {name: found.sel(length=length, walker=name) for name in found["walker"].values.tolist()}
    each = {name: weakest(walks, SHARES[share]) for name, walks in own.items()}
    walked = {name: _walked(found, force.value) for name, (_, force) in each.items()}
    (first, (way, force)), *_ = each.items()
    what = f"{share} of the walks survive a push of {length:g} s in its weakest direction, {way}, of"
    said = verdicts.against_best(first, walked, what, "N", larger_is_better=True)
    if (best := verdicts.best_rival(walked, larger_is_better=True)) is None:
        return said
    theirs, rival = each[best]
    apart = force.low > rival.high or force.high < rival.low
    untold = "" if apart else f"; {found.sizes['draw']} walks in each direction do not tell them apart"
    return f"{said}, in its own, {theirs}{untold}"


def _walked(found: xr.Dataset, force: float) -> verdicts.Walked:
    """Return a force as a score, with the digits that tables show."""
    bound = "" if 0 < force < np.inf else in_words(found, force)
    return verdicts.Walked(float(f"{min(force, found.attrs['largest']):.3g}"), bound=bound)


def in_words(found: xr.Dataset, force: float) -> str:
    """Return a force; where no push tried bounds it, the last one tried."""
    if np.isinf(force):
        return f"more than {found.attrs['largest']:.3g} N, the largest tried"
    return f"less than {found.attrs['smallest']:.3g} N, the smallest tried" if force == 0 else f"{force:.3g} N"
