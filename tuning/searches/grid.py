"""Grid search: every pair of values of two gains, the same on all of their axes, walked in batches of one program."""

import hashlib
import importlib.metadata
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, DTypeLike

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.files import scenario_files
from mjx_climb.files.dataset import PACKAGES, larger_is_better, sweep_dataset
from mjx_climb.robot.constants import model_path
from mjx_climb.rollouts.histories import LINES, stretches
from tuning.problem.spaces import JOINT
from tuning.searches import identity
from tuning.searches.finished_parts import Parts

Axes = Mapping[str, ArrayLike]  # two gains by name

HISTORIES = 256  # walks up to which a grid keeps time histories

# robots per part and environment steps per part: some seconds on two cores, and on one accelerator
_CPU = (64, 1024, 4_000_000)
_ACCELERATOR = (1024, 16_384, 130_000_000)


def default_batch_size(walks: int, steps: int, platform: str | None = None) -> int:
    """Return how many robots walk at a time: equal parts of a few seconds each, so that progress is seen and kept.

    Arguments:
        walks: in all.
        steps: of one walk.
        platform: "cpu" or an accelerator's name; JAX's default where None.
    """
    least, most, budget = _CPU if (platform or jax.default_backend()) == "cpu" else _ACCELERATOR
    size = min(max(budget // steps, least), most)
    return math.ceil(walks / math.ceil(walks / size))


def claim(
    scenario: mc.Scenario,
    stiffness: np.ndarray | None = None,
    damping: np.ndarray | None = None,
    *,
    axes: Axes | None = None,
    law: mc.Law | None = None,
    out: Path,
    batch_size: int | None = None,
    dtype: DTypeLike = np.float32,
    engine: str = DEFAULT_ENGINE,
    metrics: Iterable[mc.Metric] = mc.METRICS,
) -> int:
    """Prepare the folder of a sweep and return how many of its walks are there already; arguments as of `sweep`.

    Raises:
        OutputError: the folder cannot be written, or holds an unfinished sweep of something else.
        RobotError: no such robot.
    """
    lists = checked_axes(scenario, law, stiffness, damping, axes)
    walks = math.prod(values.size for values in lists.values())
    size = batch_size or default_batch_size(walks, scenario.steps)
    found = Parts(out, _identity(scenario, law, lists, size, dtype, engine, metrics)).count()
    return min(found * size, walks)


def checked_axes(
    scenario: mc.Scenario,
    law: mc.Law | None,
    stiffness: ArrayLike | None,
    damping: ArrayLike | None,
    axes: Axes | None,
) -> dict[str, np.ndarray]:
    """Return the values along both axes of a sweep, by the name of the gain; arguments as of `sweep`.

    Raises:
        ValueError: axes that are no lists of positive numbers, or no gains of the law.
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
        ValueError: axes that are no lists of positive numbers, or no gains of the law.
        OutputError: the folder cannot be written, or holds an unfinished sweep of something else.
    """
    table = mc.MetricTable(metrics)
    lists = checked_axes(scenario, law, stiffness, damping, axes)
    shape = tuple(values.size for values in lists.values())
    walks = math.prod(shape)
    size = batch_size or default_batch_size(walks, scenario.steps)
    kept = None if out is None else Parts(out, _identity(scenario, law, lists, size, dtype, engine, metrics))

    lengths = (law_of(scenario) if law is None else law).AXES
    mesh = zip(lists, np.meshgrid(*lists.values(), indexing="ij"), strict=True)
    varied = {name: values.reshape(-1, 1) if lengths.get(name) else values.ravel() for name, values in mesh}
    count = math.ceil(walks / size)
    walk = mc.rollout_histories if walks <= HISTORIES else mc.rollout_metrics
    found = {} if kept is None else {number: kept.load(number) for number in range(count)}
    parts = {number: part for number, part in found.items() if part is not None}
    done = sum(min(size, walks - number * size) for number in parts)
    if progress is not None:
        progress(done, walks)
    for number in range(count):
        if number in parts:
            continue
        # the last part is filled up with its last robot: every part has the shape that was compiled
        rows = np.minimum(np.arange(number * size, (number + 1) * size), walks - 1)
        gains = {name: values[rows] for name, values in varied.items()}
        part = walk(scenario, gains, law=law, metrics=table, dtype=dtype, engine=engine)
        parts[number] = part
        if kept is not None:
            kept.save(number, part)
        done += min(size, walks - number * size)
        if progress is not None:
            progress(done, walks)
    whole = {name: np.concatenate([parts[n][name] for n in range(count)])[:walks] for name in parts[0]}
    whole = {name: value.reshape(*shape, *value.shape[1:]) for name, value in whole.items()}
    dataset = sweep_dataset({name: whole[name] for name in table.names}, _labelled(lists, law), scenario, table)
    dataset = dataset.assign(_histories(whole, scenario, tuple(lists)))
    return dataset.assign_attrs(engine=engine, dtype=np.dtype(dtype).name, batch_size=size)


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


def _identity(
    scenario: mc.Scenario,
    law: mc.Law | None,
    axes: Mapping[str, np.ndarray],
    size: int,
    dtype: DTypeLike,
    engine: str,
    metrics: Iterable[mc.Metric],
) -> dict[str, Any]:
    """Return all that determines the numbers of a sweep, bit by bit."""
    versions: dict[str, str | None] = {}
    for name, distribution in PACKAGES.items():
        try:
            versions[name] = importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    return {
        "scenario": scenario_files.identity(scenario),
        "law": None if law is None else identity.identity(law, "law"),
        "axes": {name: values.tolist() for name, values in axes.items()},
        "dtype": np.dtype(dtype).name,
        "engine": engine,
        "metrics": identity.of_metrics(mc.MetricTable(metrics)),
        "batch_size": size,
        "histories": math.prod(values.size for values in axes.values()) <= HISTORIES,
        "platform": jax.default_backend(),
        "robot_model": hashlib.sha256(model_path(scenario.robot).read_bytes()).hexdigest(),
        "versions": versions,
    }
