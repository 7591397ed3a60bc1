"""The page of a Pareto front."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

import mjx_climb as mc
from tuning.report import comparison
from tuning.report.explorer import explorer, listed_points
from tuning.report.page import Origin, Page, Table


def page(
    front: xr.Dataset,
    knee: int,
    histories: Mapping[str, np.ndarray],
    walks: Mapping[str, mc.Trajectory],
    table: Table,
    scenario: mc.Scenario,
    *,
    origin: Origin,
    seed: int,
    pictures: Mapping[str, Path],
) -> Page:
    """Return the page of a front.

    Arguments:
        front: see `tuning.searches.pareto.front`.
        knee: index of the point where it bends.
        histories: of the walks on the front, as `mjx_climb.rollout_histories` gives them.
        walks: config and pd in double precision.
        table: the front.
        scenario: of all walks.
        origin, pictures: as of `tuning.report.sweep.page`.
        seed: of the search.
    """
    better, against = front.attrs["better"], front.attrs["against"]
    metrics = {walk: mc.metrics(trajectory) for walk, trajectory in walks.items()}
    at_knee = {n: front[n].values[knee].item() for n in (better, against)}
    texts = [
        f"{n.replace('_', ' ')} {comparison.against(n, value, {w: m[n] for w, m in metrics.items()})}"
        for n, value in at_knee.items()
    ]
    return Page(
        title=f"What {better} costs in {against}: {origin.name}",
        origin=origin,
        verdict=f"The front of {front.sizes['front']} points bends at {'; '.join(texts)}.",
        notes=[],
        scenario=scenario,
        explorers=[
            explorer(
                "The front", walks, metrics, shown=("pd",),
                points=listed_points(front, histories, knee, trade=(against, better)),
            )
        ],
        tables=[table],
        pictures=pictures,
        facts={"precision": "float32 (search), float64 (front)", "seed": seed},
    )  # fmt: skip
