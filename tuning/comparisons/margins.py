"""Margins: how much later, slower or weaker a robot's hardware may be before gains tear a gripper off or stop paying.

Each quantity is made worse by itself, the scenario's other hardware as it is. Gains pay as long as they leave less
force variation than their rival on the very same hardware: pd retuned where it walks too, else pd. Each set of gains
walks one batch, a grid over every quantity, and then another one, between the last walks that were good and the first
that were not.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import PD
from mjx_climb.hardware.stages import DELAYED
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.parameter_types import path_of_gain
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import MAX_DELAY
from mjx_climb.walk.structure import structure
from tuning.gains.gains_file import Whole, by_name
from tuning.problem.evaluation import RIGID
from tuning.problem.variations import PERIOD, Factor, changed, checked, scalable, scaled, whole_periods

POINTS = 16  # values of a quantity that are walked at a time
FACTOR = 2  # between the hardware and a value where gains fail
RETUNED = "retuned pd"  # the name of the rival in place of pd
_MOST_SAMPLES = 60  # of a delay: a buffer's length
_JOINT = ("kp", "kd", "ki")
_METRICS = mc.MetricTable(mc.METRICS[name] for name in ("force_variation", "detached_at", "diverged"))


class Quantity(NamedTuple):
    """One thing that is made worse: one value at all of its paths, or one factor on their own values."""

    title: str
    paths: tuple[str, ...]
    worst: float  # value or factor up to which it is walked, further on hardware that is nearly as bad
    factor: bool = False
    ideal: float | None = None  # the value that is walked first; None: the scenario's own

    def own(self, parameters: mc.Parameters, step: float) -> float:
        """The value of the scenario's hardware at its time step, or a factor of 1."""
        value = 1.0 if self.factor else float(parameters.at(self.paths[0]))
        return step if PERIOD in self.paths and not value else value

    def on_steps(self, values: np.ndarray, step: float) -> np.ndarray:
        """The nearest values that a walk has: whole time steps for a control period."""
        return whole_periods(values, step) if PERIOD in self.paths and not self.factor else values

    def values(self, parameters: mc.Parameters, step: float) -> np.ndarray:
        """The values (POINTS,) that are walked, from good to bad, closer together where the hardware is good."""
        own, worst, samples = self.own(parameters, step), self.worst, step * np.array([_MOST_SAMPLES, MAX_DELAY])
        late = not {*self.paths}.isdisjoint(DELAYED.values()) and not self.factor
        if self.factor:
            values = np.geomspace(own, worst, POINTS)
        elif self.ideal is None:
            values = own + (worst - own) * np.linspace(0, 1, POINTS) ** 2
        else:
            longest = max(min(worst, samples[0]) if late else worst, 2 * FACTOR * own)
            values = self.ideal + (longest - self.ideal) * np.linspace(0, 1, POINTS) ** 2
        for wanted in (own, needed(own, values[-1])):  # the values asked of gains are walked themselves
            if min(values) <= wanted <= max(values):
                values[np.abs(values - wanted).argmin()] = wanted
        return self.on_steps(np.minimum(values, samples[1]) if late else values, step)


QUANTITIES: Mapping[str, Quantity] = {
    # the law's estimate of the base is as old as the forces
    "force_delay": Quantity("force delay", (DELAYED["force"], DELAYED["base"]), 0.03, ideal=0.0),
    "command_delay": Quantity("command delay", (DELAYED["command"],), 0.03, ideal=0.0),
    "control_period": Quantity("control period", (PERIOD,), 0.05, ideal=0.0),
    "joint_gains": Quantity("share of the joint gains", tuple(map(path_of_gain, _JOINT)), 0.05, factor=True),
}


def quantities(scenario: mc.Scenario, texts: Iterable[str]) -> dict[str, Quantity]:
    """Return quantities by their paths, read from "contact.spread=0.8", up to a value, or "contact.damping=x0.1".

    Raises:
        ConfigError: in one line, no such text, a path that the walk does not have, or a value that it cannot have.
    """
    own, found = own_parameters(scenario), dict[str, Quantity]()
    for text in texts:
        path, equals, worst = (part.strip() for part in text.partition("="))
        try:
            factor = scaled(worst)
            value = float(worst) if factor is None and equals else factor
        except ValueError:
            value = None
        if value is None or path in found:
            raise ConfigError("", "", "PATH=VALUE or PATH=xFACTOR, each path once", repr(text))
        if factor is None and path in own.paths and own.paths[path].shape:
            raise ConfigError("", path, "a factor, as x0.1, as the value is an array", worst)
        checked(scenario, own, {path: value if factor is None else Factor(value)}, "{}")
        if (factor is not None and not scalable(own, [path])) or value == (own.at(path) if factor is None else 1.0):
            raise ConfigError("", path, f"another value than the scenario's own, {own.at(path):g}", worst)
        found[path] = Quantity(path, (path,), value, factor is not None)
    return found


@dataclasses.dataclass(frozen=True)
class Margin:
    """How far one quantity may go, in its unit; None where gains fail at the best value already."""

    own: float  # the scenario's
    holds: float | None  # no gripper torn off, and nothing diverges
    better: float | None  # and less force variation than the rival
    worst: float  # the worst value walked: a margin that reaches it may be larger
    title: str = ""
    unit: str = "s"  # x of a factor
    rival: str = "pd"

    @property
    def sentence(self) -> str:
        """How far gains hold, and up to where they are better than their rival, if anywhere: `warnings` tells."""
        holds, better = ("at no value" if n is None else f"up to {self.in_words(n)}" for n in (self.holds, self.better))
        return f"{self.title}: holds {holds}" + ("" if self.better is None else f", better than {self.rival} {better}")

    @property
    def needed(self) -> float:
        """How far gains should hold: half the joint gains, twice the delay or period that the hardware has."""
        return needed(self.own, self.worst)

    def with_unit(self, value: float) -> str:
        """Return a value as people read it."""
        if self.unit == "s":
            return f"{1e3 * value:.3g} ms"
        return f"x {value:.2g}" if self.unit == "x" else f"{value:.3g} {self.unit}".removesuffix(" 1")

    def in_words(self, reached: float | None, worst: float | None = None) -> str:
        """Return a value that was reached, of a `worst` one that was tried: "7.03 ms", "30 ms or more", "none"."""
        beyond = " or less" if self.worst < self.own else " or more"
        last = self.worst if worst is None else worst
        return "none" if reached is None else self.with_unit(reached) + beyond * (reached == last)

    def falls_short(self, what: str, reached: float | None) -> list[str]:
        """Return a line on a margin that is short of the values that gains should hold at, none otherwise."""
        if reached == self.worst:  # no worse value walked
            return []
        if reached is not None and (reached <= self.needed if self.worst < self.own else reached >= self.needed):
            return []
        limit = "at no value" if reached is None else f"up to {self.with_unit(reached)} only"
        has, safe = self.with_unit(self.own), self.with_unit(self.needed)
        return [f"{self.title}: {what} {limit}, the hardware has {has}, {safe} would be safe"]


def needed(own: float, worst: float) -> float:
    """Return how far gains should hold on hardware that gets worse towards a value."""
    return own * FACTOR if worst > own else own / FACTOR


class Found(NamedTuple):
    """Margins by quantity, and their walks."""

    margins: dict[str, Margin]
    holds: bool  # on the scenario's own hardware: no gripper torn off, and nothing diverges
    better: bool  # and less force variation than the rival
    walks: xr.Dataset  # by gains, quantity and point, each quantity from good to bad
    rival: str = "pd"  # in words


def find(
    scenario: mc.Scenario,
    gains: AnyGains,
    *,
    law: mc.Law | None = None,
    others: Mapping[str, Whole] = MappingProxyType({}),
    walked: Mapping[str, xr.Dataset] = MappingProxyType({}),
    asked: Mapping[str, Quantity] = QUANTITIES,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
    retuned_step: float | None = None,
) -> Found:
    """Return the margins of one set of gains.

    Arguments:
        scenario: its joint gains are pd's too.
        gains: those in question; kp, kd and ki replace the scenario's where given.
        law: whose gains they are, the scenario's where None.
        others: further ones to walk on the same hardware, by name, for the picture; `RETUNED` is the rival in place of
            pd.
        walked: the result of `on_the_grid` for pd and others, by name, where it has walked already.
        asked: the quantities, see `quantities` for those at other paths.
        progress: called with the number of walks done and of all.
        retuned_step: the time step of pd retuned, s, where it walks at one of its own: on other hardware, as a control
            period of 0 is one step, so that pd is the rival, and the margins say so.
    """
    walkers = {"given": Whole(law, gains), "pd": pd_of(scenario), **others}
    both = ["given", RETUNED if RETUNED in others else "pd"]
    pd = "pd" if retuned_step is None else f"pd not retuned (pd retuned walks at steps of {retuned_step:g} s)"
    rival = RETUNED if RETUNED in others else pd
    parameters, step = own_parameters(scenario), scenario.time_step
    grid = np.stack([quantity.values(parameters, step) for quantity in asked.values()])
    total = 2 * len(walkers) * grid.size

    def walk(values: np.ndarray, done: int, known: Mapping[str, xr.Dataset]) -> xr.Dataset:
        found = []
        for name, walker in walkers.items():
            given = known[name] if name in known else on_the_grid(scenario, walker, engine, values=values, asked=asked)
            found.append(given)
            if progress is not None:
                progress(done + len(found) * values.size, total)
        return xr.concat(found, xr.Variable("gains", list(walkers)), coords="minimal", compat="override")

    coarse = walk(grid, 0, walked)
    between = np.stack([_between(each, step, coarse.sel(quantity=name, gains=both)) for name, each in asked.items()])
    walks = xr.concat([coarse, walk(between, total // 2, {})], "point", coords="minimal", compat="override")
    own = {name: quantity.own(parameters, step) for name, quantity in asked.items()}
    badness = walks["value"] * np.where(grid[:, -1:] < grid[:, :1], -1.0, 1.0)
    walks = walks.isel(point=badness.copy(data=np.argsort(badness.values, axis=1, kind="stable")))
    walks = walks.transpose("gains", "quantity", "point").reset_coords("value")
    margins: dict[str, Margin] = {}
    for name, quantity in asked.items():
        some = walks.sel(quantity=name, gains=both)
        values = some["value"].values
        counts = map(count_good, _verdicts(some))
        holds, better = (float(values[count - 1]) if count else None for count in counts)
        unit = "x" if quantity.factor else parameters.units[quantity.paths[0]][0]
        margins[name] = Margin(own[name], holds, better, float(values[-1]), quantity.title, unit, rival)
    first = next(iter(asked))
    here = int(np.abs(grid[0] - own[first]).argmin())
    holds, better = (bool(good[here]) for good in _verdicts(coarse.sel(quantity=first, gains=both)))
    return Found(margins, holds, better, walks, rival)


def on_the_grid(
    scenario: mc.Scenario,
    walker: Whole,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
    values: np.ndarray | None = None,
    asked: Mapping[str, Quantity] = QUANTITIES,
) -> xr.Dataset:
    """Return the metrics on hardware with one quantity changed at a time, to values (Q, N).

    Without `values` they are the first walks of one set of gains in `find`, the same for all gains in question.
    """
    own, joint = own_parameters(scenario), joint_gains(scenario, walker.gains)
    if values is None:
        values = np.stack([quantity.values(own, scenario.time_step) for quantity in asked.values()])
    each = [changes(own, quantity, row, joint) for quantity, row in zip(asked.values(), values, strict=True)]
    batch = {
        path: np.stack([_of_points(changed, path, values.shape[1]) for changed in each])
        for quantity in asked.values()
        for path in quantity.paths
    }
    rigid = _rigid(scenario, engine) if isinstance(walker.law, PD) else None
    law, gains = (walker.law, without_joint(walker.gains)) if rigid is None else (None, rigid)
    found = mc.rollout_metrics(
        scenario, gains, own.replace(batch), law=law, metrics=_METRICS, engine=engine, progress=progress
    )
    dims = ("quantity", "point")
    data = {name: (dims, value) for name, value in found.items()}
    return xr.Dataset(data, {"quantity": list(asked), "value": (dims, values)})


def _rigid(scenario: mc.Scenario, engine: str) -> mc.Gains | None:
    """Return gains with which the scenario's law is pd, whose walks then need no program of their own.

    None of laws other than base admittance, and where force sensors may fall silent, which it would notice.
    """
    control = scenario.control
    if (control.controller, control.reading) != ("base_admittance", "virtual_model"):
        return None
    if structure(scenario, engine, own_parameters(scenario)).stages.silent_sensors:
        return None
    return mc.Gains(*(np.full(6, value) for value in (RIGID, control.damping, control.stiffness)))


def pd_of(scenario: mc.Scenario) -> Whole:
    """Return pd with the scenario's joint gains."""
    return Whole(PD(), joint_gains(scenario, {}))


def warnings(found: Found) -> list[str]:
    """Return the objections to gains in words: no use on their hardware, or margins of less than twice as much."""
    if not found.holds:
        return ["on the hardware itself the walk fails: a gripper is torn off, or it diverges"]
    lines = [] if found.better else [f"on the hardware itself the force varies no less than under {found.rival}"]
    nowhere = []  # where the best hardware is better than the robot's own
    for margin in found.margins.values():
        short = margin.falls_short("gains hold", margin.holds)
        if not short and found.better and margin.better is None:
            nowhere.append(margin.title)
        elif not short and found.better:
            short = margin.falls_short(f"gains stay better than {found.rival}", margin.better)
        lines += short
    if nowhere:
        lines.append(f"with less {' or '.join(nowhere)} the force varies no less than under {found.rival}")
    return lines


def joint_gains(scenario: mc.Scenario, gains: AnyGains) -> dict[str, float]:
    """Return kp, kd and ki that gains come with, the scenario's where they have none."""
    values = by_name(gains)
    return {name: float(np.asarray(values.get(name, getattr(scenario.control, name)))) for name in _JOINT}


def without_joint(gains: AnyGains) -> AnyGains:
    """Return gains without kp, kd and ki, which then are those of the walk's parameters."""
    if isinstance(gains, mc.Gains):
        return dataclasses.replace(gains, kp=None, kd=None, ki=None)
    return {name: value for name, value in by_name(gains).items() if name not in _JOINT}


def changes(own: mc.Parameters, quantity: Quantity, values: np.ndarray, joint: Mapping[str, float]) -> mc.Parameters:
    """Return parameters with one quantity changed to values (N,), on joints with the gains `joint`."""
    there = own.replace({path_of_gain(name): np.asarray(value) for name, value in joint.items()})
    change: Any = Factor(values) if quantity.factor else values
    return changed(there, dict.fromkeys(quantity.paths, change))


def _of_points(parameters: mc.Parameters, path: str, count: int) -> np.ndarray:
    """Return a value of each of so many robots."""
    shape = np.shape(own := parameters.at(path))
    return np.broadcast_to(own, (count, *shape[len(shape) - len(parameters.paths[path].shape) :]))


def count_good(good: np.ndarray) -> int:
    """Return how many of points (N,) come before the first that is not good."""
    return int(np.argmin([*good, False]))


def _verdicts(walks: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return which points (N,) of a quantity hold with the first of two gains, and which of them pay."""
    holds, variation = (walks["detached_at"].isnull() & ~walks["diverged"]).values, walks["force_variation"].values
    return holds[0], holds[0] & ((variation[0] < variation[1]) | ~holds[1])


def _between(quantity: Quantity, step: float, walks: xr.Dataset) -> np.ndarray:
    """Return values (N,) of a quantity about where gains stop to hold, and where they stop to pay.

    The last one is the worst of the grid again: it keeps the delays' buffers as long, and so the compiled program.
    """
    values = walks["value"].values
    finer = []
    for good, points in zip(_verdicts(walks), (POINTS // 2, POINTS - POINTS // 2 - 1), strict=True):
        bad = min(max(count_good(good), 1), len(values) - 1)
        finer.append(np.linspace(values[bad - 1], values[bad], points + 2)[1:-1])
    return quantity.on_steps(np.concatenate([*finer, values[-1:]]), step)
