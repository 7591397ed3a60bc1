"""Grid search: every pair of values of two gains, the same on all of their axes, walked in batches of one program."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr
import yaml
from numpy.typing import ArrayLike, DTypeLike

import mjx_climb as mc
from mjx_climb.compilation import devices
from mjx_climb.control import law_of
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.files import scenario_files
from mjx_climb.files.dataset import larger_is_better, sweep_dataset
from mjx_climb.rollouts.histories import LINES, stretches
from mjx_climb.rollouts.rollout import walks_in_pieces
from tuning.problem.spaces import JOINT
from tuning.searches import identity, shards
from tuning.searches.finished_parts import Parts
from tuning.searches.shards import Shard

Axes = Mapping[str, ArrayLike]  # two gains by name

KIND = "sweep"  # of shards
MOST = 10**9  # walks: their metrics alone are some 80 GB
HISTORIES = 256  # walks up to which a grid keeps time histories

# robots per part and environment steps per part: some seconds on two cores, and on one accelerator
_CPU = (64, 1024, 4_000_000)
_ACCELERATOR = (1024, 262_144, 3_000_000_000)


def default_batch_size(walks: int, steps: int, platform: str | None = None) -> int:
    """Return how many robots walk at a time: equal parts of a few seconds each, so that progress is seen and kept.

    Arguments:
        walks: in all.
        steps: of one walk.
        platform: "cpu" or an accelerator's name; JAX's default where None.
    """
    least, most, budget = _CPU if (platform or jax.default_backend()) == "cpu" else _ACCELERATOR
    return shards.even(walks, min(max(budget // steps, least), most))


def expected_duration(walks: int, steps: int, platform: str) -> float:
    """Return about how long some walks take, in s, by the rates that docs/performance.md measured."""
    rate = 2.2e6 * devices.usable_cores() if platform == "cpu" else 1e9  # environment steps a second
    return walks * steps / rate


def claim(
    scenario: mc.Scenario,
    stiffness: ArrayLike | None = None,
    damping: ArrayLike | None = None,
    *,
    out: Path,
    shard: Shard | None = None,
    **how: Any,
) -> int:
    """Prepare the folder of a sweep, or of a shard, and return how many of its walks are there already.

    Arguments are those of `sweep` and `sweep_shard`.

    Raises:
        ConfigError: more shards than walks.
        OutputError: the folder cannot be written, or holds an unfinished sweep of something else.
        RobotError: no such robot.
    """
    grid = of(scenario, stiffness, damping, **how)
    if shard is None:
        return shards.there(grid, Parts(out, grid.identity()), range(grid.rows))
    return shards.there(grid, shards.claim(grid, out, shard), shard.rows(grid.rows))


@dataclasses.dataclass(frozen=True)
class Grid:
    """What a sweep walks; `of` makes one of the arguments of `sweep`. A row is one pair of gains."""

    scenario: mc.Scenario
    law: mc.Law | None
    axes: Mapping[str, np.ndarray]
    size: int  # robots that walk at a time
    dtype: DTypeLike
    engine: str
    metrics: mc.MetricTable

    @property
    def shape(self) -> tuple[int, ...]:
        """How many values each axis has."""
        return tuple(values.size for values in self.axes.values())

    @property
    def rows(self) -> int:
        """How many walks."""
        return math.prod(self.shape)

    @property
    def keeps_histories(self) -> bool:
        """Whether the grid is small enough to keep time histories."""
        return self.rows <= HISTORIES

    @property
    def in_pieces(self) -> bool:
        """Whether their steps are compiled in pieces."""
        return walks_in_pieces(self.scenario, engine=self.engine)

    def walk(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the metrics of some rows, and their time histories where they are kept."""
        lengths = (law_of(self.scenario) if self.law is None else self.law).AXES
        places = np.unravel_index(rows, self.shape)
        values = {name: own[place] for (name, own), place in zip(self.axes.items(), places, strict=True)}
        gains = {name: own[:, None] if lengths.get(name) else own for name, own in values.items()}
        walk = mc.rollout_histories if self.keeps_histories else mc.rollout_metrics
        return walk(self.scenario, gains, law=self.law, metrics=self.metrics, dtype=self.dtype, engine=self.engine)

    def name(self, row: int) -> str:
        """Return a pair of gains in words."""
        places = np.unravel_index(row, self.shape)
        pairs = zip(self.axes.items(), places, strict=True)
        return " ".join(f"{name} {own[place]:.4g}" for (name, own), place in pairs)

    def dataset(self, arrays: Mapping[str, np.ndarray]) -> xr.Dataset:
        """Return what all rows gave, labelled, over both gains."""
        whole = {name: value.reshape(*self.shape, *value.shape[1:]) for name, value in arrays.items()}
        table = {name: whole[name] for name in self.metrics.names}
        data = sweep_dataset(table, _labelled(self.axes, self.law), self.scenario, self.metrics)
        data = data.assign(_histories(whole, self.scenario, tuple(self.axes)))
        return data.assign_attrs(engine=self.engine, dtype=np.dtype(self.dtype).name, batch_size=self.size)

    def identity(self) -> dict[str, Any]:
        """Return all that determines the numbers of a sweep, bit by bit."""
        return {
            "kind": KIND,
            "scenario": yaml.safe_load(scenario_files.identity(self.scenario)),
            "law": None if self.law is None else identity.identity(self.law, "law"),
            "axes": {name: values.tolist() for name, values in self.axes.items()},
            "dtype": np.dtype(self.dtype).name,
            "engine": self.engine,
            "metrics": identity.of_metrics(self.metrics),
            "batch_size": self.size,
            "histories": self.keeps_histories,
            **identity.of_surroundings(self.scenario),
        }


def of(
    scenario: mc.Scenario,
    stiffness: ArrayLike | None = None,
    damping: ArrayLike | None = None,
    *,
    axes: Axes | None = None,
    law: mc.Law | None = None,
    batch_size: int | None = None,
    dtype: DTypeLike = np.float32,
    engine: str = DEFAULT_ENGINE,
    metrics: Iterable[mc.Metric] = mc.METRICS,
) -> Grid:
    """Return what `sweep` walks, whose arguments these are.

    Raises:
        ValueError: axes that are no lists of positive numbers, too many, or no gains of the law.
    """
    lists = checked_axes(scenario, law, stiffness, damping, axes)
    devices.check_batch_size(batch_size)
    size = batch_size or default_batch_size(math.prod(values.size for values in lists.values()), scenario.steps)
    return Grid(scenario, law, lists, size, dtype, engine, mc.MetricTable(metrics))


def checked_axes(
    scenario: mc.Scenario,
    law: mc.Law | None,
    stiffness: ArrayLike | None,
    damping: ArrayLike | None,
    axes: Axes | None,
) -> dict[str, np.ndarray]:
    """Return the values along both axes of a sweep, by the name of the gain; arguments as of `sweep`.

    Raises:
        ValueError: axes that are no lists of positive numbers, too many, or no gains of the law.
    """
    given = {"stiffness": stiffness, "damping": damping} if axes is None else axes
    own = law_of(scenario) if law is None else law
    if not own.GAINS:
        raise ValueError("control.controller: expected an admittance law, got pd, which has no gains to sweep")
    known = [*own.GAINS, *JOINT]
    for name in given:
        if name not in known:
            raise ValueError(f"axes.{name}: expected a gain of the law, one of {', '.join(known)}")
    if len(given) != 2:
        raise ValueError(f"axes: expected two gains, got {len(given)}")
    lists = {name: np.asarray(values, float) for name, values in given.items()}
    for name, values in lists.items():
        if values.ndim != 1 or not values.size or not (np.isfinite(values).all() and (values > 0).all()):
            raise ValueError(f"{name}: expected a list of finite numbers above 0")
    if (walks := math.prod(values.size for values in lists.values())) > MOST:
        raise ValueError(f"axes: expected at most {MOST} walks in all, got {walks}")
    return lists


def _labelled(axes: Mapping[str, np.ndarray], law: mc.Law | None) -> dict[str, np.ndarray | xr.DataArray]:
    """Return the values along the axes of a sweep, those of a law of one's own with their units and names."""
    labelled: dict[str, np.ndarray | xr.DataArray] = dict(axes)
    for name, field in ({} if law is None else law.GAINS).items():
        if name in axes:
            about = {"units": field.unit, "long_name": field.long_name or name.replace("_", " ")}
            labelled[name] = xr.DataArray(axes[name], dims=name, attrs=about)
    return labelled


def sweep(
    scenario: mc.Scenario,
    stiffness: np.ndarray | None = None,
    damping: np.ndarray | None = None,
    *,
    axes: Axes | None = None,
    law: mc.Law | None = None,
    progress: Callable[[int, int], None] | None = None,
    batch_size: int | None = None,
    dtype: DTypeLike = np.float32,
    engine: str = DEFAULT_ENGINE,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    out: Path | None = None,
) -> xr.Dataset:
    """Walk the whole grid and return the metrics over (stiffness, damping), or over two other gains.

    A grid of up to `HISTORIES` walks keeps time histories as well: for each name in
    `mjx_climb.rollouts.histories.LINES` the least and the largest value in each stretch of time, over both gains,
    extreme and stretch.

    Arguments:
        scenario: what walks where; its control section gives the inertia and the joint gains.
        stiffness: (n,) N/m and N m/rad, the same on all axes of one walk.
        damping: (m,) N s/m and N m s/rad.
        axes: in place of these two, a list of values for each of two gains of the law, the same on all of its axes.
        law: the control law, whose gains that are not swept stay as they are; the scenario's where None.
        progress: called with the number of walks done and the number in all: first with what `out` holds already,
            then after each part.
        batch_size: robots that walk at a time, all parts by one compiled program; see `default_batch_size`.
        dtype: precision of the simulation.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        metrics: what the walks are judged by, as `mjx_climb.METRICS + (mine,)`.
        out: a folder that keeps each finished part, so that an interrupted sweep goes on from there with the same
            result, bit by bit. The parts stay until `finished_parts.clear(out)`.

    Raises:
        ValueError: axes that are no lists of positive numbers, too many, or no gains of the law.
        OutputError: the folder cannot be written, or holds an unfinished sweep of something else.
    """
    how: dict[str, Any] = {"batch_size": batch_size, "dtype": dtype, "engine": engine, "metrics": metrics}
    grid = of(scenario, stiffness, damping, axes=axes, law=law, **how)
    kept = None if out is None else Parts(out, grid.identity())
    return grid.dataset(shards.walk(grid, kept, progress))


def sweep_shard(
    scenario: mc.Scenario,
    shard: Shard,
    *,
    out: Path,
    progress: Callable[[int, int], None] | None = None,
    **how: Any,
) -> None:
    """Walk a shard of the grid and keep it below `out`; it goes on where it stopped. Arguments are those of `sweep`.

    Raises:
        ConfigError: more shards than walks.
        ValueError, OutputError: as of `sweep`; or `out` holds shards of another number.
    """
    grid = of(scenario, **how)
    shards.walk(grid, shards.claim(grid, out, shard), progress, shard)


def merged(
    found: Sequence[shards.Kept], scenario: mc.Scenario, law: mc.Law | None, metrics: mc.MetricTable
) -> xr.Dataset:
    """Return what `sweep` returns, from the shards of a grid of this scenario and law.

    Raises:
        ConfigError: shards of something else, or not all of them.
    """
    told = found[0].identity
    how = {"batch_size": told["batch_size"], "dtype": told["dtype"], "engine": told["engine"], "metrics": metrics}
    grid = of(scenario, axes=told["axes"], law=law, **how)
    return grid.dataset(shards.joined(grid, found))


def _histories(
    arrays: Mapping[str, np.ndarray], scenario: mc.Scenario, axes: tuple[str, ...]
) -> dict[str, xr.DataArray]:
    """Return the time histories among the arrays, labelled; their coordinate `stretch` says when each one starts."""
    count, steps = stretches(scenario.steps)
    start = np.arange(count) * steps * scenario.time_step
    coords = {
        "extreme": ["least", "largest"],
        "stretch": ("stretch", start, {"units": "s", "long_name": "start of a stretch of time"}),
    }
    dims = (*axes, "extreme", "stretch")
    return {
        name: xr.DataArray(arrays[name], coords, dims, attrs={"units": unit, "long_name": text})
        for name, (unit, text, _) in LINES.items()
        if name in arrays
    }


def best_cell(dataset: xr.Dataset, objective: str = "force_variation") -> xr.Dataset | None:
    """Return the cell with the least `objective` among those that neither let go nor diverge, None where all fail.

    The result has no axes; its coordinates are the best gains. Margins and other metrics that should be large are
    maximised.
    """
    values = dataset[objective].where((dataset["detached_limb"] < 0) & ~dataset["diverged"].astype(bool))
    if not np.isfinite(values).any():
        return None
    values = -values if larger_is_better(dataset[objective]) else values
    return dataset.isel(values.argmin(dim=...))
