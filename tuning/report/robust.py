"""The page of a search over an ensemble."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import xarray as xr

import mjx_climb as mc
from tuning.gains.gains_file import by_name
from tuning.report import comparison
from tuning.report.numbers import change, number, unit
from tuning.report.page import Origin, Page, Table
from tuning.searches.result import Result

SHOWN = ("force_variation", "peak_foot_force", "peak_pull_force", "peak_joint_torque", "cost_of_transport",
         "base_deviation", "joint_limit_margin")  # fmt: skip


def page(
    found: Result, summed: xr.Dataset, outcome: Sequence[str], *, origin: Origin, pictures: Mapping[str, Path]
) -> Page:
    """Return the page of a search over an ensemble.

    Arguments:
        found: the result.
        summed: of walks that the search never saw, see `tuning.searches.robust.summary`.
        outcome: in lines: how it went on them, what a force sensor is worth, which limits bind or break.
        origin, pictures: as of `tuning.report.sweep.page`.
    """
    control = found.scenario.control
    rivals: comparison.Compared = {"robust": (by_name(found.gains), {})}
    if not found.law:
        rivals = {**rivals, "config": ({key: getattr(control, key) for key in mc.Gains.AXES}, {})}
    return Page(
        title=f"Robust gains for {origin.name}: {found.search.method}, {found.search.space}",
        origin=origin,
        verdict=f"{outcome[0]}.",
        notes=[f"{line[0].upper()}{line[1:]}." for line in outcome[1:]],
        scenario=found.scenario,
        explorers=[],
        tables=[judged_table(summed, found.judged_by), comparison.gains_table(rivals, found.law)],
        pictures=pictures,
        facts={"seed": found.search.seed, "env-steps": f"{found.env_steps:,} (best after {found.best_at:,})"},
    )


def shown(metrics: mc.MetricTable) -> list[str]:
    """Return the names of the metrics that the table has: the main ones, and those of the user's own."""
    return [*SHOWN, *(name for name in metrics.names if name not in mc.METRICS.names)]


def judged_table(summed: xr.Dataset, metrics: mc.MetricTable = mc.METRICS) -> Table:
    """Return mean and worst of the main metrics, the first gains' with their change against the config's."""
    names = summed["gains"].values.tolist()
    columns = ["metric", "unit", "of the members", names[0], "vs config %", *names[1:]]
    sections: list[tuple[str, list[list[str]]]] = []
    if "objective" in summed:
        values = {name: float(summed["objective"].sel(gains=name)) for name in names}
        scores = [number(value) for value in values.values()]
        scores.insert(1, change(values[names[0]], values["config"]))
        sections.append(("", [["objective", "", "mean and worst", *scores]]))
    for metric in shown(metrics):
        rows = []
        for statistic, label in (("mean", "mean"), ("worst", f"worst {summed.attrs['worst_share']:.0%}")):
            values = {n: float(summed[metric].sel(gains=n, statistic=statistic)) for n in names}
            cells = [number(v) for v in values.values()]
            cells.insert(1, change(values[names[0]], values["config"]))
            rows.append([metrics.in_words(metric), unit(metric, metrics), label, *cells])
        sections.append(("", rows))
    return Table("On the walks of a fresh draw", columns, sections, 3)
