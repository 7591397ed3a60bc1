"""Margins: how much later, slower or weaker a robot's hardware may be before gains tear a gripper off or stop paying.

Each quantity is made worse by itself, the scenario's other hardware as it is. Gains pay as long as they leave less
force variation than pd on the very same hardware. Each set of gains walks one batch, a grid over every quantity, and
then another one, between the last walks that were good and the first that were not.
"""

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import PD
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.quantities.parameters import own_parameters
from mjx_climb.rollouts.resolve import AnyGains
from mjx_climb.scenario.model import MAX_DELAY
from tuning.gains.gains_file import by_name

POINTS = 16  # values of a quantity that are walked at a time
FACTOR = 2  # by which hardware is to be better than where gains fail
_LONGEST_DELAY, _LONGEST_PERIOD = 0.03, 0.05  # s
_MOST_SAMPLES = 60  # of a delay: a buffer's length
_WEAKEST = 0.05  # share of the joint gains
_JOINT = ("kp", "kd")
_METRICS = mc.MetricTable(mc.METRICS[name] for name in ("force_variation", "detached_at", "diverged"))


class Quantity(NamedTuple):
    """What is made worse."""

    title: str
    unit: str
    parameters: tuple[str, ...]  # of `mjx_climb.Parameters`, which all have its value
    scales: bool = False  # a share of the scenario's own values, the worse the smaller


QUANTITIES: Mapping[str, Quantity] = {
    # what the law reads of the base is as old as the forces
    "force_delay": Quantity("force delay", "s", ("force_delay", "base_delay")),
    "command_delay": Quantity("command delay", "s", ("command_delay",)),
    "control_period": Quantity("control period", "s", ("control_period",)),
    "joint_gains": Quantity("share of the joint gains", "1", _JOINT, scales=True),
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
        scenario: what walks where, on which hardware; pd has its joint gains.
        gains: those in question; kp and kd replace the scenario's where given.
        law: whose gains they are, the scenario's where None.
        others: further ones to walk on the same hardware, by name, for the picture.
        walked: what `on_the_grid` gave of pd and others, by name, where it has walked already.
        engine: the dynamics.
        progress: called with the number of walks done and of all.
    """
    walkers = {"given": Walker(law, gains), "pd": pd_of(scenario), **others}
    grid = _grid(scenario)
    total = 2 * len(walkers) * grid.size

    def walk(values: np.ndarray, done: int, known: Mapping[str, xr.Dataset]) -> xr.Dataset:
        found = []
        for name, walker in walkers.items():
            found.append(known[name] if name in known else _walked(scenario, walker, values, engine))
            if progress is not None:
                progress(done + len(found) * values.size, total)
        return xr.concat(found, xr.Variable("gains", list(walkers)))

    coarse = walk(grid, 0, walked)
    between = np.stack([_between(scenario, coarse.sel(quantity=name)) for name in QUANTITIES])
    fine = walk(between, total // 2, {})
    walks = xr.concat([_ordered(coarse, fine, name) for name in QUANTITIES], "quantity")
    margins = {}
    for name in QUANTITIES:
        some = walks.sel(quantity=name)
        values = some["value"].values
        holds, better = (_last_good(values, good) for good in _verdicts(some))
        margins[name] = Margin(own_value(scenario, name), holds, better, float(values[-1]))
    holds, better = (bool(good[0]) for good in _verdicts(coarse.sel(quantity="joint_gains")))  # all of them
    return Found(margins, holds, better, walks)


def on_the_grid(
    scenario: mc.Scenario,
    walker: Walker,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return the first walks of one set of gains in `find`, which are the same whatever gains are in question."""
    return _walked(scenario, walker, _grid(scenario), engine, progress)


def pd_of(scenario: mc.Scenario) -> Walker:
    """Return what gains are compared with: pd, with the scenario's joint gains."""
    return Walker(PD(), joint_gains(scenario, {}))


def warnings(found: Found) -> list[str]:
    """Return in words what speaks against gains: no use on their hardware, or margins of less than twice as much."""
    if not found.holds:
        return ["on the hardware itself the walk fails: a gripper is torn off, or it diverges"]
    lines = [] if found.better else ["on the hardware itself the force varies no less than under pd"]
    for name, margin in found.margins.items():
        wanted = needed(name, margin.own)
        if not reaches(name, margin.holds, wanted):
            failing = f"gains hold {up_to(name, margin.holds)}"
        elif found.better and not reaches(name, margin.better, wanted):
            failing = f"gains stay better than pd {up_to(name, margin.better)}"
        else:
            continue
        own, safe = with_unit(name, margin.own), with_unit(name, wanted)
        lines.append(f"{QUANTITIES[name].title}: {failing}, the hardware has {own}, {safe} would be safe")
    return lines


def up_to(quantity: str, reached: float | None) -> str:
    """Return how far something goes, in words: "up to 7.03 ms only", "at no value"."""
    return "at no value" if reached is None else f"up to {with_unit(quantity, reached)} only"


def in_words(quantity: str, worst: float, reached: float | None) -> str:
    """Return what a margin reaches of the `worst` value tried, with its unit: "7.03 ms", "30 ms or more", "none"."""
    if reached is None:
        return "none"
    beyond = " or less" if QUANTITIES[quantity].scales else " or more"
    return with_unit(quantity, reached) + (beyond if reached == worst else "")


def with_unit(quantity: str, value: float) -> str:
    """Return a value of a quantity as people read it."""
    return f"x {value:.2g}" if QUANTITIES[quantity].scales else f"{1e3 * value:.3g} ms"


def reaches(quantity: str, reached: float | None, wanted: float) -> bool:
    """Return whether a margin that reaches so far is as far as wanted or farther."""
    if reached is None:
        return False
    return reached <= wanted if QUANTITIES[quantity].scales else reached >= wanted


def own_value(scenario: mc.Scenario, quantity: str) -> float:
    """Return what the scenario's own hardware has of a quantity, in its unit."""
    hardware = scenario.hardware
    return {
        "force_delay": hardware.force_sensor.delay,
        "command_delay": hardware.command_delay,
        "control_period": hardware.control_period or scenario.time_step,
        "joint_gains": 1.0,
    }[quantity]


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
    """Return kp and kd that gains come with, the scenario's where they have none."""
    values = by_name(gains)
    return {name: float(np.asarray(values.get(name, getattr(scenario.control, name)))) for name in _JOINT}


def without_joint(gains: AnyGains) -> AnyGains:
    """Return gains without kp and kd, which then are those of the walk's parameters."""
    if isinstance(gains, mc.Gains):
        return dataclasses.replace(gains, kp=None, kd=None)
    return {name: value for name, value in by_name(gains).items() if name not in _JOINT}


def changes(own: mc.Parameters, quantity: str, values: np.ndarray, joint: Mapping[str, float]) -> mc.Parameters:
    """Return parameters with one quantity changed to values (N,), on joints with the gains `joint`."""
    changed: dict[str, Any] = {name: np.asarray(value) for name, value in joint.items()}
    for name in QUANTITIES[quantity].parameters:
        changed[name] = values * joint[name] if QUANTITIES[quantity].scales else values
    return dataclasses.replace(own, **changed)


def _grid(scenario: mc.Scenario) -> np.ndarray:
    return np.stack([values_of(scenario, name) for name in QUANTITIES])


def _walked(
    scenario: mc.Scenario,
    walker: Walker,
    values: np.ndarray,
    engine: str,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return what walks are worth on hardware with one quantity (Q, N) changed at a time."""
    own, joint = own_parameters(scenario), joint_gains(scenario, walker.gains)
    each = [changes(own, name, row, joint) for name, row in zip(QUANTITIES, values, strict=True)]
    varied = {name for quantity in QUANTITIES.values() for name in quantity.parameters}
    batch = {
        name: np.stack([np.broadcast_to(getattr(changed, name), values.shape[1]) for changed in each])
        for name in varied
    }
    found = mc.rollout_metrics(
        scenario, without_joint(walker.gains), dataclasses.replace(own, **batch), law=walker.law, metrics=_METRICS,
        engine=engine, progress=progress,
    )  # fmt: skip
    dimensions = ("quantity", "point")
    walks = xr.Dataset({name: (dimensions, value) for name, value in found.items()}, {"quantity": list(QUANTITIES)})
    return walks.assign(value=(dimensions, values))


def _verdicts(walks: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return which points (N,) of a quantity hold with the given gains, and which of them pay."""
    holds = (walks["detached_at"].isnull() & ~walks["diverged"]).sel(gains=["given", "pd"]).values
    variation = walks["force_variation"].sel(gains=["given", "pd"]).values
    return holds[0], holds[0] & ((variation[0] < variation[1]) | ~holds[1])


def _last_good(values: np.ndarray, good: np.ndarray) -> float | None:
    """Return the last of the values (N,) before the first that is not good, None where that is the first of all."""
    count = int(np.argmin([*good, False]))
    return float(values[count - 1]) if count else None


def _between(scenario: mc.Scenario, walks: xr.Dataset) -> np.ndarray:
    """Return values (N,) of a quantity about where gains stop to hold, and where they stop to pay.

    The last one is the worst of the grid again: it keeps the delays' buffers as long, and so the compiled program.
    """
    quantity, values = str(walks["quantity"].item()), walks["value"].isel(gains=0).values
    finer = [values[-1:]]
    for good, points in zip(_verdicts(walks), (POINTS // 2, POINTS - POINTS // 2 - 1), strict=True):
        bad = min(max(int(np.argmin([*good, False])), 1), len(values) - 1)
        finer.insert(-1, np.linspace(values[bad - 1], values[bad], points + 2)[1:-1])
    found = np.concatenate(finer)
    return whole_steps(found, scenario.time_step) if quantity == "control_period" else found


def _ordered(coarse: xr.Dataset, fine: xr.Dataset, quantity: str) -> xr.Dataset:
    """Return the walks of a quantity over both grids, from good to bad."""
    both = xr.concat([walks.sel(quantity=[quantity]) for walks in (coarse, fine)], "point")
    values = both["value"].isel(gains=0, quantity=0).values
    order = np.argsort(-values if QUANTITIES[quantity].scales else values, kind="stable")
    both = both.isel(point=order)
    return both.assign(value=both["value"].isel(gains=0, drop=True))
