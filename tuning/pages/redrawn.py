"""The pictures of a result, drawn again from its folder: nothing is walked."""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mjx_climb.files import dataset
from mjx_climb.reading import read_found
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.viz import plots
from tuning.comparisons import paired
from tuning.comparisons.side_by_side import Compared
from tuning.pages.judge import plot_judged
from tuning.pages.laws import plot_laws
from tuning.pages.pareto import plot_front
from tuning.pages.schedule import plot_schedule
from tuning.pages.sweep import marks, sheet
from tuning.pages.tune import plot_convergence, plot_path
from tuning.results import tuned
from tuning.results.swept import axes_of

RESULTS = ("trajectory.nc", "sweep.nc", "map.nc", "search.nc", "judged.nc", "compared.nc", "front.nc", "schedule.nc")
OF_METRICS = ("sweep.nc", "map.nc", "judged.nc", "compared.nc")
MAPS = {"sweep.nc": ("maps", "comparison.json"), "map.nc": ("map", "summary.json")}  # picture, walks to mark on it


def figures(folder: Path, metrics: Sequence[str] = ()) -> Iterator[tuple[str, Figure]]:
    """Yield the name of every picture of a folder, without an ending, and the picture.

    Arguments:
        folder: of a walk, a sweep, or any search.
        metrics: the maps, or the panels of an ensemble, that are wanted; where there are none, those of the result.

    Raises:
        ConfigError: no result there, or none of a metric.
    """
    there = [name for name in RESULTS if os.path.isfile(folder / name)]
    if not there:
        raise ConfigError(folder, "", f"a folder with a result ({', '.join(RESULTS)})", "none")
    of_metrics = [name for name in there if name in OF_METRICS]
    if metrics and not of_metrics:
        raise ConfigError(folder, "", "a result with maps or an ensemble to draw metrics of", there[0])
    for name in of_metrics if metrics else there:
        if name == "trajectory.nc":
            trajectory = dataset.load_trajectory(folder / name)
            yield "walk", plots.plot_walk(trajectory)
            yield "feet", plots.plot_feet(trajectory)
            continue
        data = dataset.load(folder / name)
        if name in OF_METRICS:
            dims = axes_of(data) if name in MAPS else ("gains", "member")
            others = {*dims, "seed"}  # of the searches of laws that were compared
            of_both = [str(n) for n, v in data.items() if {*dims} <= {*v.dims} <= others and v.dtype.kind in "fi"]
            for metric in metrics:
                if metric not in of_both:
                    raise ConfigError("--metric", "", f"one of {', '.join(of_both)}", f"{metric!r}")
        if name in MAPS:
            stem, compared = MAPS[name][0], _compared(folder / MAPS[name][1])
            if not metrics:
                yield stem, sheet(data, compared)
            for metric in metrics:
                baseline = compared["pd"][1].get(metric) if "pd" in compared else None
                yield f"{stem}-{metric}", plots.plot_map(data, metric, marks(data, compared), baseline=baseline)
        elif name == "search.nc" and "law" not in data.attrs:  # the file of a law of your own is not here
            found = tuned.load(folder / name)
            yield "convergence", plot_convergence(found)
            if "map.nc" in there:
                yield "path", plot_path(found, dataset.load(folder / "map.nc"))
        elif name == "judged.nc":
            yield "judged", plot_judged(data, *([metrics] if metrics else []))
        elif name == "compared.nc" and metrics:
            yield "judged", plot_judged(data, metrics)
        elif name == "compared.nc":
            yield "compared", plot_laws(paired.taken(data))
        elif name == "front.nc":
            yield "front", plot_front(data)
        elif name == "schedule.nc":
            yield "schedule", plot_schedule(data)


def _compared(file: Path) -> Compared:
    """Return gains and metrics of the walks that a summary holds; none where it cannot be read."""
    try:
        found: dict[str, Any] = {}
        for name, entry in json.loads(read_found(file)).items():
            if isinstance(entry, dict) and "metrics" in entry:
                gains = entry.get("gains")
                arrays = None if gains is None else {n: np.asarray(v) for n, v in gains.items() if v is not None}
                found[name] = arrays, entry["metrics"]
        return found
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}
