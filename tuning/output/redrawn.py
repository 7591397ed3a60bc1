"""The pictures of a result, drawn again from its folder: nothing is walked."""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from mjx_climb import plots
from mjx_climb.files import dataset
from mjx_climb.scenario.messages import ConfigError
from tuning.output import results
from tuning.report import pictures
from tuning.report.comparison import Compared
from tuning.report.explorer import axes_of
from tuning.searches import result

Drawn = Iterator[tuple[str, Figure]]
RESULTS = ("trajectory.nc", "sweep.nc", "map.nc", "search.nc", "judged.nc", "front.nc", "schedule.nc")
OF_METRICS = ("sweep.nc", "map.nc", "judged.nc")
SUMMARIES = {"sweep.nc": "comparison.json", "map.nc": "summary.json"}


def figures(folder: Path, metrics: Sequence[str] = ()) -> Drawn:
    """Yield every picture of a folder and what its file is called, without an ending.

    Arguments:
        folder: of a walk, a sweep, or any search.
        metrics: the maps, or the panels of an ensemble, that are wanted; where there are none, what the result drew.

    Raises:
        ConfigError: no result there, or none of a metric.
    """
    there = [name for name in RESULTS if os.path.isfile(folder / name)]
    if not there:
        raise ConfigError(f"{folder}: expected a folder with a result ({', '.join(RESULTS)}), got none")
    of_metrics = [name for name in there if name in OF_METRICS]
    if metrics and not of_metrics:
        raise ConfigError(f"{folder}: expected a result with maps or an ensemble to draw metrics of, got {there[0]}")
    for name in of_metrics if metrics else there:
        if name == "trajectory.nc":
            trajectory = dataset.load_trajectory(folder / name)
            yield "walk", plots.plot_walk(trajectory)
            yield "feet", plots.plot_feet(trajectory)
            continue
        data = dataset.load(folder / name)
        if name in SUMMARIES:
            yield from _maps(data, _compared(folder / SUMMARIES[name]), metrics, "map" if name == "map.nc" else "maps")
        elif name == "search.nc":
            yield from _search(folder, data)
        elif name == "judged.nc":
            _check(metrics, data, ("gains", "member"))
            yield "judged", pictures.plot_judged(data, *([metrics] if metrics else []))
        elif name == "front.nc":
            yield "front", pictures.plot_front(data)
        else:
            yield "schedule", pictures.plot_schedule(data)


def _maps(data: xr.Dataset, compared: Compared, metrics: Sequence[str], sheet: str) -> Drawn:
    """Yield the sheet of all maps, or a map of each metric."""
    if not metrics:
        yield sheet, results.sheet(data, compared)
    _check(metrics, data, axes_of(data))
    for name in metrics:
        baseline = compared["pd"][1].get(name) if "pd" in compared else None
        yield f"{sheet}-{name}", plots.plot_map(data, name, results.marks(data, compared), baseline=baseline)


def _search(folder: Path, data: xr.Dataset) -> Drawn:
    if "law" in data.attrs:
        return  # its file is not here
    found = result.load(folder / "search.nc")
    yield "convergence", pictures.plot_convergence(found)
    if (folder / "map.nc").is_file():
        yield "path", pictures.plot_path(found, dataset.load(folder / "map.nc"))


def _check(metrics: Sequence[str], data: xr.Dataset, dims: tuple[str, str]) -> None:
    known = [str(name) for name, values in data.items() if set(values.dims) == set(dims) and values.dtype.kind in "fi"]
    for metric in metrics:
        if metric not in known:
            raise ConfigError(f"--metric: expected one of {', '.join(known)}, got {metric!r}")


def _compared(file: Path) -> Compared:
    """Return gains and metrics of the walks that a summary holds; none where it cannot be read."""
    try:
        found: dict[str, Any] = json.loads(file.read_text())
        walks = {name: entry for name, entry in found.items() if isinstance(entry, dict) and "metrics" in entry}
        return {name: (_numbers(entry.get("gains")), entry["metrics"]) for name, entry in walks.items()}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}


def _numbers(gains: dict[str, Any] | None) -> dict[str, Any] | None:
    return None if gains is None else {name: np.asarray(value) for name, value in gains.items() if value is not None}
