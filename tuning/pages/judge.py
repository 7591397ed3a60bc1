"""Gains on walks of an ensemble that no search has seen: table, picture, page."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb.viz import plots
from mjx_climb.viz.plots import key
from tuning.comparisons import judge as judging
from tuning.comparisons import paired, verdicts
from tuning.comparisons.of_draw import DrawComparison
from tuning.comparisons.of_draw import compare as compare
from tuning.comparisons.of_ensemble import shown
from tuning.numbers import change, number, unit
from tuning.pages.contents import Contents, Picture, contents_of
from tuning.pages.page import Findings, Page, Table
from tuning.pages.pictures import COLORS, scaled
from tuning.problem import ensemble
from tuning.results.judged import Judged

SHARES = "Share of the walks below a value."


def contents(found: Judged, compared: DrawComparison, name: str) -> Contents:
    """Return every walk, means and worst, the picture, the page."""
    ensemble, metrics, summed = found.ensemble, found.problem.metrics, compared.summed
    assert ensemble is not None
    failed = f"{ensemble.members} walks each; {judging.failed_in_words(summed)}"
    said = Findings.of(compared.verdict, judging.lost_in_words(found.data), failed, compared.sensor)
    gains: dict[str, Any] = judging.plain(summed, shown(metrics))
    for own in gains.values():
        own["failed"] = round(own["failed"] * found.data.sizes["member"])
    tables, facts = [judged_table(summed, metrics)], {"seed": ensemble.seed}
    page = Page("Gains on the walks of {}", said, found.scenario, tables=tables, facts=facts)
    summary = {"gains": gains, "differences": paired.differences(compared.table), "verdict": said.verdict}
    picture = Picture(SHARES, lambda: plot_judged(found.data))
    return contents_of(found, name, page, summary, {"judged": picture}, data=found.data, summed=summed)


def judged_table(summed: xr.Dataset, metrics: mc.MetricTable = mc.METRICS) -> Table:
    """Return mean and worst of the main metrics, the first gains' with their change against the config's."""
    names = summed["gains"].values.tolist()
    columns = ["metric", "unit", "of the members", names[0], "vs config %", *names[1:]]
    statistics = {"mean": "mean", "worst": f"worst {summed.attrs['worst_share']:.0%}"}

    def row(values: xr.DataArray, *words: str) -> list[str]:
        numbers = {name: float(values.sel(gains=name)) for name in names}
        first, *others = map(number, numbers.values())
        return [*words, first, change(numbers[names[0]], numbers["config"]), *others]

    sections = []
    if "objective" in summed:
        sections.append(("", [row(summed["objective"], "objective", "", "mean and worst")]))
    for name in shown(metrics):
        about = metrics.in_words(name), unit(name, metrics)
        rows = [row(summed[name].sel(statistic=key), *about, label) for key, label in statistics.items()]
        sections.append(("", rows))
    return Table(f"On the walks of a fresh draw{verdicts.explained(names)}", columns, sections, 3)


@plots.style()
def plot_judged(judged: xr.Dataset, metrics: Sequence[str] = ("force_variation", "peak_utilization")) -> Figure:
    """Draw which share of the unseen walks stays below a value, a curve for each set of gains.

    A dot marks the mean, a diamond the mean of the worst 5 %. A gripper lets go beyond the vertical line.
    """
    figure = Figure(figsize=(plots.COLUMN, 0.35 + 1.75 * len(metrics)), layout="constrained")
    others = itertools.cycle((plots.BLUE, plots.GREEN, plots.PURPLE))
    colors = {
        name: COLORS.get(name, other) for name, other in zip(judged["gains"].values.tolist(), others, strict=False)
    }
    for panel, metric in zip(figure.subplots(len(metrics), 1, squeeze=False)[:, 0], metrics, strict=True):
        factor, label = scaled(judged[metric])
        for name, color in colors.items():
            every = judged[metric].sel(gains=name).values.astype(float)  # of all seeds, where there are such
            values = np.sort(every[np.isfinite(every)]) * factor
            share = 100 * (np.arange(values.size) + 1) / every.size
            panel.step(values, share, where="post", color=color, linewidth=1.2)
            for mark, at in (("o", values.mean()), ("D", ensemble.worst_mean(values, judging.WORST_SHARE))):
                panel.plot(at, np.interp(at, values, share), mark, color=color, ms=4)
        panel.set(xlabel=label, ylabel="share of walks [%]", ylim=(0, 103))
        if metric == "peak_utilization" and panel.get_xlim()[1] > 1:
            panel.axvline(1.0, color=plots.RED, linewidth=0.8)
    handles = [key(name, color=color) for name, color in colors.items()]
    for label, mark in (("mean", "o"), ("worst 5 %", "D")):
        handles.append(key(label, color="0.3", marker=mark, ms=4, ls=""))
    plots.legend(figure, handles)
    return figure
