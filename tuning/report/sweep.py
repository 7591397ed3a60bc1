"""The page of a sweep."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

import mjx_climb as mc
from mjx_climb.rollouts.histories import LINES
from tuning.report import comparison
from tuning.report.explorer import MOST_CELLS, axes_of, coarser_grid, explorer, grid_points
from tuning.report.page import Origin, Page
from tuning.report.remarks import remarks
from tuning.searches import grid


def with_histories(result: xr.Dataset, scenario: mc.Scenario, best: xr.Dataset | None, **how: Any) -> xr.Dataset:
    """Return a sweep that has time histories: itself, or of a larger one a coarser grid with the best cell in it."""
    if all(name in result for name in LINES):
        return result
    # out of the cells that the page shows
    kept = coarser_grid(coarser_grid(result, best, MOST_CELLS), best, grid.HISTORIES)
    return grid.sweep(scenario, axes={name: kept[name].values for name in axes_of(kept)}, **how)


def page(
    result: xr.Dataset,
    histories: xr.Dataset,
    walks: Mapping[str, mc.Trajectory],
    compared: comparison.Compared,
    marks: Mapping[str, tuple[float, float]],
    scenario: mc.Scenario,
    *,
    warnings: list[str],
    origin: Origin,
    pictures: Mapping[str, Path],
    about: mc.MetricTable = mc.METRICS,
    law: mc.Law | None = None,
) -> Page:
    """Return the page of a sweep.

    Arguments:
        result: the grid.
        histories: what `with_histories` gave.
        walks: the best, the config's own and pd in double precision, by their name for people.
        compared: their gains and metrics.
        marks: gains to mark on the maps.
        scenario: of the grid.
        warnings: the first of the notes.
        origin: of the page.
        pictures: PNG files by their captions.
        about: the metrics of the walks.
        law: the user's own, for the units of its gains.
    """
    best = grid.best_cell(result)
    metrics = {walk: numbers for walk, (_, numbers) in compared.items()}
    failed = int(((result["detached_limb"] >= 0) | result["diverged"].astype(bool)).sum())
    count = result["diverged"].size
    if best is None:
        verdict = f"None of the {count} walks held: every one lost a gripper or diverged."
        notes = []
    else:
        won = metrics["best"]
        others = {walk: numbers["force_variation"] for walk, numbers in metrics.items() if walk != "best"}
        text = comparison.against("force_variation", won["force_variation"], others)
        verdict = (
            f"Of {count} walks, {' and '.join(f'{name} {best[name].item():.4g}' for name in axes_of(result))} "
            f"are best: force variation {text}; {comparison.held(won)}."
        )
        notes = [f"{failed} of the {count} walks lost a gripper or diverged."]
        if worse := comparison.differences(won, metrics["pd"], about)[0]:
            notes.append(f"Worse than pd: {', '.join(worse)}.")
    notes += [f"{line[0].upper()}{line[1:]}." for line in remarks(metrics)]
    kept = histories["diverged"].size
    if kept < count:
        notes.append(f"The page holds the time histories of {kept} of the cells; a click shows the nearest of them.")
    chosen = best if best is not None else result.isel(dict.fromkeys(axes_of(result), 0))
    return Page(
        title=f"Sweep of {origin.name}, {' by '.join(str(result.sizes[name]) for name in axes_of(result))} gains",
        origin=origin,
        verdict=verdict,
        notes=[*warnings, *notes],
        scenario=scenario,
        explorers=[
            explorer(
                "Maps and walks", dict(reversed(list(walks.items()))), metrics, shown=("pd",),
                points=grid_points(result, histories, metrics["pd"], marks, chosen), about=about,
            )
        ],
        tables=[comparison.table(compared, "Walks in double precision", about, law)],
        pictures=pictures,
        facts={
            "precision": f"{result.attrs['dtype']} (grid), float64 (named walks)",
            "engine": result.attrs["engine"],
            "robots at a time": result.attrs["batch_size"],
            "seed": "none: nothing is drawn at random",
        },
    )  # fmt: skip
