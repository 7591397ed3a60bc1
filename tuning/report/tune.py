"""The page of a search for gains."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

import mjx_climb as mc
from tuning.gains.gains_file import by_name
from tuning.judged.verification import Verification
from tuning.report import comparison
from tuning.report.explorer import axes_of, explorer, grid_points
from tuning.report.numbers import axis_values, number
from tuning.report.page import Origin, Page, Table
from tuning.searches.result import Result


def page(
    found: Result,
    checked: Verification,
    over: xr.Dataset | None,
    walks: Mapping[str, mc.Trajectory],
    compared: comparison.Compared,
    *,
    outcome: list[str],
    tests: list[str],
    origin: Origin,
    pictures: Mapping[str, Path],
) -> Page:
    """Return the page of a search.

    Arguments:
        found: the result.
        checked: what verification said of it.
        over: the map around it, see `tuning.judged.verification.map_of`.
        walks: tuned, config and pd in double precision.
        compared: their gains and metrics, tuned first.
        outcome: what matters most, in lines.
        tests: what else the verification found.
        origin, pictures: as of `tuning.report.sweep.page`.
    """
    metrics = {walk: numbers for walk, (_, numbers) in compared.items()}
    tuned, search = metrics["tuned"], found.search
    parts = []
    for metric in [m for m, weight in search.weights.items() if weight]:
        others = {walk: metrics[walk][metric] for walk in ("pd", "config")}
        parts.append(
            f"{found.judged_by.in_words(metric)} {comparison.against(metric, tuned[metric], others, found.judged_by)}"
        )
    limits = "every limit is kept" if checked.passed else f"limits are broken: {', '.join(checked.broken_limits)}"
    scores = {"tuned": {"objective": checked.value}, "pd": {"objective": 1.0}}
    points = None
    if over is not None:
        control = found.scenario.control
        x, y = axes_of(over)
        places = {"tuned": by_name(found.gains)} | ({"config": vars(control)} if found.law is None else {})
        marks = {name: at for walk, gains in places.items() for name, at in _marks(walk, gains[x], gains[y]).items()}
        value = over["objective"].where(over["feasible"])
        best = over.isel(value.argmin(dim=...)) if np.isfinite(value).any() else over.isel({x: 0, y: 0})
        points = grid_points(over, over, {**metrics["pd"], "objective": 1.0}, marks, best)
    around = [
        [c, _percent(checked.less[c]), _percent(checked.more[c]), checked.shape[c], number(checked.slopes[c])]
        for c in checked.shape
    ]
    title = "Map: the same gains on all axes, around the result"
    return Page(
        title=f"Tuned gains for {origin.name}: {search.method}, {search.space}",
        origin=origin,
        verdict=f"Tuned gains score {checked.value:.4f} of pd's 1: {'; '.join(parts)}; {limits}.",
        notes=[*outcome, *_worse(tuned, metrics["pd"], found.judged_by)],
        more=tests,
        scenario=found.scenario,
        explorers=[
            explorer(
                title if points else "Walks",
                dict(reversed(list(walks.items()))),
                {walk: {**numbers, **scores.get(walk, {})} for walk, numbers in metrics.items()},
                opens_on="tuned",
                points=points,
                about=found.judged_by,
            )
        ],
        tables=[
            comparison.table(compared, "Walks in double precision", found.judged_by, found.law),
            comparison.gains_table(compared, found.law),
            Table(
                "Around the result: change of the objective, in per cent of pd's, with one gain 20 % less or more",
                ["gain", "20 % less", "20 % more", "shape", "slope per log"],
                [("", around)],
                1,
            ),
        ],
        pictures=pictures,
        facts={
            "precision": "float32 (search, map), float64 (named walks, verification)",
            "seed": search.seed,
            "env-steps": f"{found.env_steps:,} (best after {found.best_at:,})",
        },
    )


def _marks(walk: str, x: ArrayLike, y: ArrayLike) -> dict[str, tuple[float, float]]:
    """Return where gains stand on the map; where axes differ, the means of translations and of rotations."""
    both = [axis_values(gain) for gain in (x, y)]
    if all(np.ptp(values) == 0 for values in both):
        return {walk: (both[0][0].item(), both[1][0].item())}
    parts = {"translations": slice(0, 3), "rotations": slice(3, 6)}
    places = {
        f"{walk}, {name}": [np.exp(np.log(gain[axes]).mean()).item() for gain in both] for name, axes in parts.items()
    }
    return {name: (at[0], at[1]) for name, at in places.items() if np.isfinite(at).all()}


def _percent(value: float | None) -> str:
    return "breaks a limit" if value is None else f"{100 * value:+.2f}"


def _worse(metrics: comparison.Values, baseline: comparison.Values, about: mc.MetricTable) -> list[str]:
    worse, _ = comparison.differences(metrics, baseline, about)
    return [f"Worse than pd: {', '.join(worse)}."] if worse else []
