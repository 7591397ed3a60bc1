"""Margins: how much later, slower or weaker a robot's hardware may be before gains tear a gripper off or stop paying.

Each quantity is made worse by itself, the scenario's other hardware as it is. Gains pay as long as they leave less
force variation than pd on the very same hardware. Each set of gains walks one batch, a grid over every quantity, and
then another one, between the last walks that were good and the first that were not.
"""

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import PD
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.parameter_types import path_of_gain
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.model import MAX_DELAY
from tuning.gains.gains_file import by_name

POINTS = 16  # values of a quantity that are walked at a time
FACTOR = 2  # by which hardware is to be better than where gains fail
_LONGEST_DELAY, _LONGEST_PERIOD = 0.03, 0.05  # s
_MOST_SAMPLES = 60  # of a delay: a buffer's length
_WEAKEST = 0.05  # share of the joint gains
_JOINT = ("kp", "kd", "ki")
_METRICS = mc.MetricTable(mc.METRICS[name] for name in ("force_variation", "detached_at", "diverged"))


class Quantity(NamedTuple):
    """What is made worse."""

    title: str
    paths: tuple[str, ...]  # of the values that all are it
    scales: bool = False  # a share of the scenario's own values, the worse the smaller


QUANTITIES: Mapping[str, Quantity] = {
    # what the law reads of the base is as old as the forces
    "force_delay": Quantity("force delay", ("hardware.force_sensor.delay", "hardware.base_estimate.delay")),
    "command_delay": Quantity("command delay", ("hardware.command_delay",)),
    "control_period": Quantity("control period", ("hardware.control_period",)),
    "joint_gains": Quantity("share of the joint gains", tuple(map(path_of_gain, _JOINT)), scales=True),
}


@dataclasses.dataclass(frozen=True)
class Margin:
    """How far one quantity may go, in its unit; None where gains fail at the best value already."""

    own: float  # the scenario's
    holds: float | None  # no gripper torn off, and nothing diverges
    better: float | None  # and less force variation than pd
    worst: float  # the worst value walked: a margin that reaches it may be larger


class Walker(NamedTuple):
    """Whose walks are compared."""

    law: mc.Law | None  # the scenario's where None
    gains: AnyGains


class Found(NamedTuple):
    """Margins by quantity, and what they were found from."""

    margins: dict[str, Margin]
    holds: bool  # on the scenario's own hardware: no gripper torn off, and nothing diverges
    better: bool  # and less force variation than pd
    walks: xr.Dataset  # by gains, quantity and point, each quantity from good to bad


def find(
    scenario: mc.Scenario,
    gains: AnyGains,
    *,
    law: mc.Law | None = None,
    others: Mapping[str, Walker] = MappingProxyType({}),
    walked: Mapping[str, xr.Dataset] = MappingProxyType({}),
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
) -> Found:
    """Return the margins of one set of gains.

    Arguments:
        scenario: its joint gains are pd's too.
        gains: those in question; kp, kd and ki replace the scenario's where given.
        law: whose gains they are, the scenario's where None.
        others: further ones to walk on the same hardware, by name, for the picture.
        walked: what `on_the_grid` gave of pd and others, by name, where it has walked already.
        progress: called with the number of walks done and of all.
    """
    walkers = {"given": Walker(law, gains), "pd": pd_of(scenario), **others}
    grid = np.stack([values_of(scenario, name) for name in QUANTITIES])
    total = 2 * len(walkers) * grid.size

    def walk(values: np.ndarray, done: int, known: Mapping[str, xr.Dataset]) -> xr.Dataset:
        found = []
        for name, walker in walkers.items():
            given = known[name] if name in known else on_the_grid(scenario, walker, engine, values=values)
            found.append(given)
            if progress is not None:
                progress(done + len(found) * values.size, total)
        return xr.concat(found, xr.Variable("gains", list(walkers)), coords="minimal", compat="override")

    coarse = walk(grid, 0, walked)
    between = np.stack([_between(scenario, coarse.sel(quantity=name)) for name in QUANTITIES])
    walks = xr.concat([coarse, walk(between, total // 2, {})], "point", coords="minimal", compat="override")
    badness = walks["value"] * [[-1.0 if quantity.scales else 1.0] for quantity in QUANTITIES.values()]
    walks = walks.isel(point=badness.copy(data=np.argsort(badness.values, axis=1, kind="stable")))
    walks = walks.transpose("gains", "quantity", "point").reset_coords("value")
    margins = {}
    for name in QUANTITIES:
        some = walks.sel(quantity=name)
        values = some["value"].values
        counts = map(count_good, _verdicts(some))
        holds, better = (float(values[count - 1]) if count else None for count in counts)
        margins[name] = Margin(own_value(scenario, name), holds, better, float(values[-1]))
    holds, better = (bool(good[0]) for good in _verdicts(coarse.sel(quantity="joint_gains")))  # all of them
    return Found(margins, holds, better, walks)


def on_the_grid(
    scenario: mc.Scenario,
    walker: Walker,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
    values: np.ndarray | None = None,
) -> xr.Dataset:
    """Return the metrics on hardware with one quantity changed at a time, to values (Q, N).

    Without `values` they are the first walks of one set of gains in `find`, the same whatever gains are in question.
    """
    if values is None:
        values = np.stack([values_of(scenario, name) for name in QUANTITIES])
    own, joint = own_parameters(scenario), joint_gains(scenario, walker.gains)
    each = [changes(own, name, row, joint) for name, row in zip(QUANTITIES, values, strict=True)]
    batch = {
        path: np.stack([np.broadcast_to(changed.at(path), values.shape[1]) for changed in each])
        for quantity in QUANTITIES.values()
        for path in quantity.paths
    }
    found = mc.rollout_metrics(
        scenario, without_joint(walker.gains), own.replace(batch), law=walker.law, metrics=_METRICS,
        engine=engine, progress=progress,
    )  # fmt: skip
    dims = ("quantity", "point")
    data = {name: (dims, value) for name, value in found.items()}
    return xr.Dataset(data, {"quantity": list(QUANTITIES), "value": (dims, values)})


def pd_of(scenario: mc.Scenario) -> Walker:
    """Return the rival of all gains: pd, with the scenario's joint gains."""
    return Walker(PD(), joint_gains(scenario, {}))


def warnings(found: Found) -> list[str]:
    """Return in words what speaks against gains: no use on their hardware, or margins of less than twice as much."""
    if not found.holds:
        return ["on the hardware itself the walk fails: a gripper is torn off, or it diverges"]
    lines = [] if found.better else ["on the hardware itself the force varies no less than under pd"]
    for name, margin in found.margins.items():
        short = falls_short(name, margin.own, "gains hold", margin.holds)
        if not short and found.better:
            short = falls_short(name, margin.own, "gains stay better than pd", margin.better)
        lines += short
    return lines


def falls_short(quantity: str, own: float, what: str, reached: float | None) -> list[str]:
    """Return a line that says what reaches less far than gains should hold on the `own` hardware, none otherwise."""
    wanted, scales = needed(quantity, own), QUANTITIES[quantity].scales
    if reached is not None and (reached <= wanted if scales else reached >= wanted):
        return []
    limit = "at no value" if reached is None else f"up to {with_unit(quantity, reached)} only"
    has, safe = with_unit(quantity, own), with_unit(quantity, wanted)
    return [f"{QUANTITIES[quantity].title}: {what} {limit}, the hardware has {has}, {safe} would be safe"]


def in_words(quantity: str, worst: float, reached: float | None) -> str:
    """Return the value that a margin reaches, `worst` at most, with its unit: "7.03 ms", "30 ms or more", "none"."""
    beyond = " or less" if QUANTITIES[quantity].scales else " or more"
    return "none" if reached is None else with_unit(quantity, reached) + beyond * (reached == worst)


def with_unit(quantity: str, value: float) -> str:
    """Return a value of a quantity as people read it."""
    return f"x {value:.2g}" if QUANTITIES[quantity].scales else f"{1e3 * value:.3g} ms"


def own_value(scenario: mc.Scenario, quantity: str) -> float:
    """Return a quantity of the scenario's own hardware, in its unit."""
    hardware = scenario.hardware
    values: dict[str, float] = {
        "force_delay": hardware.force_sensor.delay,
        "command_delay": hardware.command_delay,
        "control_period": hardware.control_period or scenario.time_step,
        "joint_gains": 1.0,
    }
    return values[quantity]


def needed(quantity: str, own: float) -> float:
    """Return how far gains should hold: half the joint gains, twice the delay or period that the hardware has."""
    return own / FACTOR if QUANTITIES[quantity].scales else own * FACTOR


def values_of(scenario: mc.Scenario, quantity: str) -> np.ndarray:
    """Return the values (POINTS,) of a quantity that are walked, from good to bad, closer together where it is good."""
    step, own = scenario.time_step, own_value(scenario, quantity)
    if QUANTITIES[quantity].scales:
        values = np.geomspace(1.0, _WEAKEST, POINTS)
    else:
        longest = _LONGEST_PERIOD if quantity == "control_period" else min(_LONGEST_DELAY, _MOST_SAMPLES * step)
        values = max(longest, 2 * FACTOR * own) * np.linspace(0, 1, POINTS) ** 2
    for wanted in (own, needed(quantity, own)):  # what is asked of gains is walked itself
        values[np.abs(values - wanted).argmin()] = wanted
    if quantity == "control_period":
        return whole_steps(values, step)
    return values if QUANTITIES[quantity].scales else np.minimum(values, MAX_DELAY * step)


def whole_steps(periods: np.ndarray, step: float) -> np.ndarray:
    """Return the nearest periods of one time step or more, s."""
    return np.maximum(np.round(periods / step), 1) * step


def joint_gains(scenario: mc.Scenario, gains: AnyGains) -> dict[str, float]:
    """Return kp, kd and ki that gains come with, the scenario's where they have none."""
    values = by_name(gains)
    return {name: float(np.asarray(values.get(name, getattr(scenario.control, name)))) for name in _JOINT}


def without_joint(gains: AnyGains) -> AnyGains:
    """Return gains without kp, kd and ki, which then are those of the walk's parameters."""
    if isinstance(gains, mc.Gains):
        return dataclasses.replace(gains, kp=None, kd=None, ki=None)
    return {name: value for name, value in by_name(gains).items() if name not in _JOINT}


def changes(own: mc.Parameters, quantity: str, values: np.ndarray, joint: Mapping[str, float]) -> mc.Parameters:
    """Return parameters with one quantity changed to values (N,), on joints with the gains `joint`."""
    gains = {path_of_gain(name): np.asarray(value) for name, value in joint.items()}
    paths, scales = QUANTITIES[quantity].paths, QUANTITIES[quantity].scales
    return own.replace(gains | {path: values * gains[path] if scales else values for path in paths})


def count_good(good: np.ndarray) -> int:
    """Return how many of points (N,) come before the first that is not good."""
    return int(np.argmin([*good, False]))


def _verdicts(walks: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return which points (N,) of a quantity hold with the given gains, and which of them pay."""
    walks = walks.sel(gains=["given", "pd"])
    holds, variation = (walks["detached_at"].isnull() & ~walks["diverged"]).values, walks["force_variation"].values
    return holds[0], holds[0] & ((variation[0] < variation[1]) | ~holds[1])


def _between(scenario: mc.Scenario, walks: xr.Dataset) -> np.ndarray:
    """Return values (N,) of a quantity about where gains stop to hold, and where they stop to pay.

    The last one is the worst of the grid again: it keeps the delays' buffers as long, and so the compiled program.
    """
    values = walks["value"].values
    finer = []
    for good, points in zip(_verdicts(walks), (POINTS // 2, POINTS - POINTS // 2 - 1), strict=True):
        bad = min(max(count_good(good), 1), len(values) - 1)
        finer.append(np.linspace(values[bad - 1], values[bad], points + 2)[1:-1])
    found = np.concatenate([*finer, values[-1:]])
    return whole_steps(found, scenario.time_step) if walks["quantity"] == "control_period" else found
