"""Grid search: every pair of values of two gains, the same on all axes, in batches of one program: `tuning.sweep`."""

import dataclasses
import functools
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
from numpy.typing import ArrayLike

import mjx_climb as mc
from mjx_climb import execution, trajectory
from mjx_climb.control import law_of
from mjx_climb.execution import devices
from mjx_climb.files.dataset import sweep_dataset
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import AnyGains, resolve_in
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.walks import LINES, stretches
from tuning.gains import gains_file
from tuning.methods.parts import identity_of
from tuning.problem.evaluation import RIGID, Problem
from tuning.problem.search import Precision
from tuning.problem.spaces import INTEGRAL, JOINT
from tuning.problem.variations import as_walked, checked
from tuning.results.config_file import write_config
from tuning.results.swept import HISTORIES, Swept
from tuning.searches.shards import Counted, Kept, Rows, walk_shard

Axes = Mapping[str, ArrayLike]  # two gains by name, or values by path

MOST = 10**9  # walks: their metrics alone are some 80 GB
GAINS_FILE = "gains.yaml"  # beside a shard

# robots per part and environment steps per part: some seconds on two cores, and on one accelerator
_CPU = (64, 1024, 4_000_000)
_ACCELERATOR = (1024, 262_144, 3_000_000_000)


def sweep(
    scenario: mc.Scenario,
    axes: Axes,
    *,
    law: mc.Law | None = None,
    gains: AnyGains | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    precision: Precision = "float32",
    batch_size: int | None = None,
    out: str | os.PathLike[str] | None = None,
    progress: Counted | None = None,
) -> Swept:
    """Simulate a grid of two gains, the same on all axes of one walk, or values at paths.

    `tuning.write(tuning.sweep(scenario, {"stiffness": k, "damping": d}, out="results/mine"), "results/mine")` is
    `mjx-climb sweep`.

    Arguments:
        scenario: robot, gait and ground.
        axes: a list of values for each of two gains of the law, or paths as `contact.stiffness`, SI units; that of the
            horizontal axis first.
        law: the control law, the scenario's where None.
        gains: in place of the scenario's or the law's own, for those that are not swept, and for a further walk to
            compare with.
        metrics: of the walks, as `mjx_climb.METRICS + (mine,)`.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        precision: of the simulation, "float32" or "float64".
        batch_size: robots that walk at a time, all parts by one compiled program; see `default_batch_size`.
        out: a folder that keeps each finished part, so that an interrupted sweep goes on from there, bit by bit; until
            the result is written there, or `tuning.methods.parts.clear(out)`.
        progress: called with the number of walks done and the number in all: first with those that `out` holds already,
            then after each part.

    Raises:
        ConfigError: a path that the walk does not have, or values that it cannot have there.
        ValueError: another precision, axes that are no lists of positive numbers, too many, or no gains of the law.
        OutputError: `out` cannot be written, or holds an unfinished sweep of something else.
    """
    how: dict[str, Any] = {"law": law, "metrics": mc.MetricTable(metrics), "engine": engine}
    grid = grid_of(_problem(scenario, precision, **how), axes, gains, batch_size)
    return grid.result(Rows(grid, out).walk(progress))


def sweep_shard(
    scenario: mc.Scenario,
    axes: Axes,
    shard: tuple[int, int],
    *,
    out: str | os.PathLike[str],
    gains: AnyGains | None = None,
    precision: Precision = "float32",
    batch_size: int | None = None,
    progress: Counted | None = None,
    **walks: Any,
) -> Path:
    """Simulate a shard of a `sweep`, for `merge`, and return its own folder; `mjx-climb sweep --shard 3/16`.

    The arguments that are not listed, `walks` among them, are those of `sweep`.

    Arguments:
        shard: which one, from 1, and how many there are.
        out: the folder below which all shards are kept, each in a folder of its own. A shard that was interrupted goes
            on from there.
        progress: called with the number of walks of the shard that are done, and the number of its walks.

    Raises:
        ConfigError: no such shard, or more shards than walks.
        ValueError, OutputError: as of `sweep`.
    """
    walks["metrics"] = mc.MetricTable(walks.get("metrics", mc.METRICS))
    grid = grid_of(_problem(scenario, precision, **walks), axes, gains, batch_size)
    return walk_shard(grid, shard, out, progress)


def _problem(scenario: mc.Scenario, precision: Precision, **walks: Any) -> Problem:
    if precision not in (known := get_args(Precision)):
        raise ValueError(f"precision: expected {' or '.join(known)}, got {precision!r}")
    return Problem(scenario, dtype=np.dtype(precision).type, **walks)


@dataclasses.dataclass(frozen=True)
class Grid:
    """The walks of a sweep: a `tuning.searches.shards.Work`. A row is one pair of gains."""

    problem: Problem
    gains: AnyGains | None  # in place of the scenario's or the law's own
    walked: Problem  # with these
    axes: Mapping[str, np.ndarray]
    size: int  # robots that walk at a time
    # results of `points`, once they have walked
    _beside: dict[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)

    @property
    def rows(self) -> int:
        """How many walks there are."""
        return math.prod(self.shape)

    @property
    def shape(self) -> tuple[int, ...]:
        """How many values each axis has."""
        return tuple(values.size for values in self.axes.values())

    def _values(self, rows: np.ndarray | int) -> dict[str, np.ndarray]:
        places = np.unravel_index(rows, self.shape)
        return {name: own[place] for (name, own), place in zip(self.axes.items(), places, strict=True)}

    def walk(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the metrics of some rows, and their time histories where they are kept.

        The `points` walk in places that the rows leave free in the last share of a program, where there are enough.
        """
        values, points, count = self._values(rows), {} if self._beside else self.points, len(rows)
        if count + len(points) <= len(execution.walking_with(range(count), count)):
            values = {name: np.append(own, [point[name] for point in points.values()]) for name, own in values.items()}
        found = self._walk(values)
        self._beside.update({name: own[count:] for name, own in found.items() if len(own) > count})
        return {name: own[:count] for name, own in found.items()}

    def _walk(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        walked = self.walked
        robots = as_walked(walked.scenario, walked.law or law_of(walked.scenario), values)
        walk = mc.rollout_histories if self.rows <= HISTORIES else mc.rollout_metrics
        return walk(walked.scenario, *robots, dtype=walked.dtype, **walked.walks)

    @functools.cached_property
    def points(self) -> dict[str, dict[str, float]]:
        """The config's gains and pd, as far as they are points of the plane of the grid.

        They walk by the grid's compiled program, which is quick on a CPU: on others there are none.
        """
        control, points = self.problem.scenario.control, dict[str, dict[str, float]]()
        law = (control.controller, control.reading)
        if self.problem.law is not None or self.gains is not None or jax.default_backend() != "cpu":
            return {}
        own = {name: np.unique(np.asarray(value, float)) for name, value in own_values(self.problem, self.axes).items()}
        if all(values.size == 1 and values.item() > 0 for values in own.values()):
            points["config"] = {name: values.item() for name, values in own.items()}
        if {*self.axes} == {"stiffness", "damping"} and law == ("base_admittance", "virtual_model"):
            points["pd"] = dict.fromkeys(self.axes, RIGID)
        return points

    def named(self) -> dict[str, dict[str, Any]]:
        """Return the metrics of `points`."""
        if self.points and not self._beside:
            count = len(execution.walking_with(range(len(self.points)), min(self.size, self.rows)))
            each = [*self.points.values()]
            self._beside.update(self._walk({name: np.resize([p[name] for p in each], count) for name in self.axes}))
        limbs, names = self.walked.scenario.limbs, self.walked.metrics.names
        return {
            name: trajectory.named({key: self._beside[key][place].item() for key in names}, limbs)
            for place, name in enumerate(self.points)
        }

    def name(self, row: int) -> str:
        return " ".join(f"{name} {value:.4g}" for name, value in self._values(row).items())

    def result(self, arrays: Mapping[str, np.ndarray]) -> Swept:
        """Return the results of all rows, labelled, over both gains.

        The coordinate `stretch` of time histories says when each stretch of time starts.
        """
        # walks do not wait for it
        import xarray as xr

        walked, scenario, metrics = self.walked, self.walked.scenario, self.walked.metrics
        cells = {name: value.reshape(*self.shape, *value.shape[1:]) for name, value in arrays.items()}
        axes: dict[str, np.ndarray | xr.DataArray] = dict(self.axes)
        for name, field in ({} if walked.law is None else walked.law.GAINS).items():
            if name in axes:
                about = {"units": field.unit, "long_name": field.long_name or name.replace("_", " ")}
                axes[name] = xr.DataArray(self.axes[name], dims=name, attrs=about)
        data = sweep_dataset({name: cells[name] for name in metrics.names}, axes, scenario, metrics)
        count, steps = stretches(scenario.steps)
        start = np.arange(count) * steps * scenario.time_step
        about = {"units": "s", "long_name": "start of a stretch of time"}
        coords = {"extreme": ["least", "largest"], "stretch": ("stretch", start, about)}
        for name, (unit, text, _) in LINES.items():
            if name in cells:
                about = {"units": unit, "long_name": text}
                data[name] = xr.DataArray(cells[name], coords, (*self.axes, "extreme", "stretch"), attrs=about)
        data = data.assign_attrs(engine=walked.engine, dtype=np.dtype(walked.dtype).name, batch_size=self.size)
        return Swept(data, self.problem, gains=self.gains)

    def identity(self) -> dict[str, Any]:
        axes = {name: values.tolist() for name, values in self.axes.items()}
        how: dict[str, Any] = {
            "order": [*axes],
            "precision": np.dtype(self.walked.dtype).name,
            "batch_size": self.size,
            "histories": self.rows <= HISTORIES,
        }
        return {"kind": Swept.KIND, **identity_of(self.walked), "axes": axes, **how}

    def write_asked(self, folder: Path) -> None:
        """Write scenario, law and gains for `read_asked`."""
        write_config(self.problem.scenario, folder, self.problem.law, self.problem.metrics)
        if self.gains is not None:
            whole = gains_file.in_whole(self.problem.scenario, self.problem.law, self.gains)
            gains_file.save(whole, folder / GAINS_FILE, "of the sweep in this folder", self.problem.law)


def read_asked(kept: Kept, scenario: mc.Scenario, law: mc.Law | None, metrics: mc.MetricTable) -> Grid:
    """Return the grid that a shard is of, from the files of `Grid.write_asked` in its folder."""
    file, asked = kept.folder / GAINS_FILE, kept.identity
    gains = gains_file.load(file, law) if file.is_file() else None
    how: dict[str, Any] = {"law": law, "metrics": metrics, "engine": asked["engine"]}
    return grid_of(_problem(scenario, asked["precision"], **how), asked["axes"], gains, asked["batch_size"])


def own_values(problem: Problem, names: Iterable[str]) -> dict[str, Any]:
    """Return the values that a scenario itself has of gains and at paths, None of a gain that it does not have."""
    parameters, control = own_parameters(problem.scenario), problem.scenario.control
    return {name: parameters.at(name) if "." in name else getattr(control, name, None) for name in names}


def grid_of(problem: Problem, axes: Axes, gains: AnyGains | None = None, batch_size: int | None = None) -> Grid:
    """Return the work of `sweep`, whose arguments and errors these are."""
    own = problem.law or law_of(problem.scenario)
    known, gains_swept = [*own.GAINS, *JOINT, INTEGRAL], [name for name in axes if "." not in name]
    if gains_swept and not own.GAINS:
        raise ValueError("control.controller: expected an admittance law, got pd, which has no gains to sweep")
    if unknown := [name for name in gains_swept if name not in known]:
        raise ValueError(f"axes.{unknown[0]}: expected a gain of the law, one of {', '.join(known)}, or a path")
    if whole := [name for name in axes if name in own.GAINS and own.GAINS[name].shape not in ((), (3,), (6,))]:
        shape = own.GAINS[whole[0]].shape
        raise ValueError(f"axes.{whole[0]}: expected a gain of one number or of axes, got an array of shape {shape}")
    if len(axes) != 2:
        raise ValueError(f"axes: expected two gains, got {len(axes)}")
    lists = {name: np.asarray(values, float) for name, values in axes.items()}
    for name, values in lists.items():
        if values.ndim != 1 or not values.size or not (np.isfinite(values).all() and (values > 0).all()):
            raise ValueError(f"{name}: expected a list of finite numbers above 0")
    paths = {name: values for name, values in lists.items() if "." in name}
    parameters = own_parameters(problem.scenario)
    if arrays := [path for path in paths if path in parameters.paths and parameters.paths[path].shape]:
        raise ValueError(f"axes.{arrays[0]}: expected a path of one number, got that of an array")
    checked(problem.scenario, parameters, paths, "axes.{}")
    for ends in zip(*(values[[0, -1]].tolist() for values in paths.values()), strict=True):
        gains_file.applied(problem.scenario, dict(zip(paths, ends, strict=True)))  # refused before anything walks
    if (walks := math.prod(values.size for values in lists.values())) > MOST:
        raise ValueError(f"axes: expected at most {MOST} walks in all, got {walks}")
    devices.check_batch_size(batch_size)
    size, walked = batch_size or default_batch_size(walks, problem.scenario.steps), problem.with_gains(gains)
    corners = np.meshgrid(*([values.min(), values.max()] for values in lists.values()))
    law, place = walked.law or law_of(walked.scenario), walked.scenario
    robots = as_walked(place, law, dict(zip(lists, map(np.ravel, corners), strict=True)))
    check_time_step(place, parameters=resolve_in(place, law, *robots, walked.dtype).walked)
    return Grid(problem, gains, walked, lists, size)


def default_batch_size(walks: int, steps: int, platform: str | None = None) -> int:
    """Return how many robots of so many walk at a time: equal parts of seconds each, so that progress is seen and kept.

    `steps` are those of one walk, `platform` is "cpu" or an accelerator's name, JAX's default where None.
    """
    least, most, budget = _CPU if (platform or jax.default_backend()) == "cpu" else _ACCELERATOR
    parts = math.ceil(walks / min(max(budget // steps, least), most))
    return math.ceil(walks / parts)


def expected_duration(walks: int, steps: int, platform: str) -> float:
    """Return about how long some walks take, in s, by the rates that docs/studies/speed.md measured."""
    rate = 2.2e6 * devices.usable_cores() if platform == "cpu" else 1e9  # environment steps a second
    return walks * steps / rate
