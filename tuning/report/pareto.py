"""The page of a Pareto front."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

import mjx_climb as mc
from tuning.report import comparison
from tuning.report.explorer import explorer, listed_points
from tuning.report.numbers import gain, number, unit
from tuning.report.page import Origin, Page, Table
from tuning.searches.pareto import without_sensor

ROWS = 20


def front_table(front: xr.Dataset, knee: int, about: mc.MetricTable = mc.METRICS) -> Table:
    """Return some twenty points of a front, the knee among them, with the config's gains, pd and pd retuned below."""
    shown_metrics, names = (front.attrs["against"], front.attrs["better"]), front.attrs["searched"].split()
    columns = ["", *(f"{about.in_words(name)} {unit(name, about)}".strip() for name in shown_metrics), *names]
    count, on = front.sizes["front"], []
    for i in sorted({*np.linspace(0, count - 1, min(count, ROWS)).round().astype(int).tolist(), knee}):
        gains = {name: front[name].values[i] for name in names}
        values = (number(front[n].values[i]) for n in shown_metrics)
        on.append(["knee" if i == knee else "", *values, *(gain(gains, name) for name in names)])
    references = []
    for name in ("config", "pd"):
        row = [number(front[f"reference_{n}"].sel(reference=name).item()) for n in shown_metrics]
        references.append([name, *row, *("" for _ in names)])
    rival = without_sensor(front, knee, about)
    if rival is not None:
        joint = ", ".join(f"{name} {number(rival[f'without_{name}'].item())}" for name in ("kp", "kd"))
        row = [number(rival[f"without_{n}"].item()) for n in shown_metrics]
        references.append([f"pd, {joint}", *row, *("" for _ in names)])
    return Table("The front", columns, [("", on), ("", references)], 1)


def page(
    front: xr.Dataset,
    knee: int,
    histories: Mapping[str, np.ndarray],
    walks: Mapping[str, mc.Trajectory],
    scenario: mc.Scenario,
    *,
    origin: Origin,
    seed: int,
    worth: str,
    pictures: Mapping[str, Path],
    about: mc.MetricTable = mc.METRICS,
) -> Page:
    """Return the page of a front.

    Arguments:
        front: see `tuning.searches.pareto.front`.
        knee: index of the point where it bends.
        histories: of the walks on the front, as `mjx_climb.rollout_histories` gives them.
        walks: config and pd in double precision.
        scenario: of all walks.
        origin, pictures: as of `tuning.report.sweep.page`.
        seed: of the search.
        worth: what the force sensor is worth, in words.
        about: the metrics of the walks.
    """
    better, against = front.attrs["better"], front.attrs["against"]
    metrics = {walk: mc.metrics(trajectory, about) for walk, trajectory in walks.items()}
    at_knee = {n: front[n].values[knee].item() for n in (better, against)}
    texts = [
        f"{about.in_words(n)} {comparison.against(n, value, {w: m[n] for w, m in metrics.items()}, about)}"
        for n, value in at_knee.items()
    ]
    return Page(
        title=f"What {about.in_words(better)} costs in {about.in_words(against)}: {origin.name}",
        origin=origin,
        verdict=f"The front of {front.sizes['front']} points bends at {'; '.join(texts)}.",
        notes=[f"{worth[0].upper()}{worth[1:]}."],
        scenario=scenario,
        explorers=[
            explorer(
                "The front", walks, metrics, shown=("pd",),
                points=listed_points(front, histories, knee, trade=(against, better), about=about), about=about,
            )
        ],
        tables=[front_table(front, knee, about)],
        pictures=pictures,
        facts={"precision": "float32 (search), float64 (front)", "seed": seed},
    )  # fmt: skip
