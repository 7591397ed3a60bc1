"""Laws side by side: table of differences, picture, page."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.viz import plots
from mjx_climb.viz.plots import key
from tuning.comparisons import judge as judging
from tuning.comparisons import paired, verdicts
from tuning.comparisons.compare import HARDWARE, file_name
from tuning.comparisons.judge import PD
from tuning.comparisons.of_laws import LawsComparison
from tuning.comparisons.of_laws import compare as compare
from tuning.gains import gains_file
from tuning.gains.gains_file import by_name
from tuning.gains.gains_tables import labels
from tuning.numbers import gain, number, unit
from tuning.pages.contents import Contents, Picture, contents_of
from tuning.pages.page import Findings, Page, Table
from tuning.results.judged import Comparison
from tuning.results.tuned import Tuned

LAWS = "Differences from retuned pd, with 95 % intervals over walks and seeds; grey where the interval holds 0."
_NOT_METRICS = {"objective": "objective", "failed": "share lost"}


def contents(found: Comparison, compared: LawsComparison, name: str) -> Contents:
    """Return every walk with the differences, a table, the gains of each law, a picture, the page."""
    metrics, table, verdict = found.problem.metrics, compared.table, compared.verdict
    found = dataclasses.replace(found, data=paired.beside(found.data, table).assign_attrs(verdict=verdict.in_words))
    gains = {
        f"gains-{file_name(law)}.yaml": gains_file.text(
            gains_file.completed(own.scenario, own.gains),
            f"mjx-climb tune {name}: {law}",
            own.problem.law or law_of(own.scenario),
        )
        for law, own in found.tuned.items()
    }
    rows = rows_of(table)
    searched = {
        law: {"gains": by_name(own.gains), "points": own.data.sizes["point"], "env_steps": own.env_steps,
              "objective": own.value, "feasible": own.feasible, "reads_forces": law in compared.reading,
              "seeds": [of_search(each) for each in found.searched[law]]}
        for law, own in found.tuned.items()
    }  # fmt: skip
    summary = {"verdict": verdict.in_words, "best": verdict.best, "laws": searched, "table": rows.to_dict("records")}
    said = Findings.of(verdict.in_words, [*notes_of(found, table), *judging.lost_in_words(found.data)])
    csv = rows.to_csv(index=False, lineterminator="\n", na_rep="nan")
    files = gains | {"compared.csv": csv, "compared": Picture(LAWS, lambda: plot_laws(table))}
    page = page_of(found, laws_table(table, metrics), said)
    return contents_of(found, name, page, summary, files, data=found.data, summed=table)


def rows_of(table: xr.Dataset) -> Any:
    """Return a comparison of laws as rows: a metric, a statistic, a law, and its numbers."""
    numbers = table[["value", "difference", "low", "high", "real"]]
    rows = numbers.to_dataframe(dim_order=["metric", "statistic", "gains"]).reset_index()
    return rows[np.isfinite(rows["value"])][["metric", "statistic", "gains", *numbers]]


def laws_table(table: xr.Dataset, metrics: mc.MetricTable = mc.METRICS) -> Table:
    """Return mean and worst of each metric by law, each with its difference from retuned pd and the interval, in %.

    Better hardware and the scenario's own pd have a row of the objective and of the lost walks alone.
    """
    base, sections = table.attrs["baseline"], []
    versus = f"vs {base} %"
    columns = ["metric", "law", "mean", versus, f"worst {table.attrs['worst_share']:.0%}", versus]
    for name in table["metric"].values.tolist():
        own = table.sel(metric=name)
        words = _NOT_METRICS.get(name) or f"{metrics.in_words(name)} {unit(name, metrics)}".strip()
        rows: list[list[str]] = []
        for law in table["gains"].values.tolist():
            if name in metrics.names and law in (*HARDWARE, PD):
                continue
            cells = [
                cell
                for key in ("mean", "worst")
                for cell in _versus(own.sel(statistic=key, gains=law), own.sel(statistic=key, gains=base))
            ]
            rows.append(["" if rows else words, law, *cells])
        sections.append(("", rows))
    caption = f"On {table.attrs['members_compared']} walks that no search saw; ~: no real difference"
    return Table(caption + verdicts.explained([base]), columns, sections, 2)


def _versus(own: xr.Dataset, base: xr.Dataset) -> tuple[str, str]:
    """Return a value, and its difference with the interval in per cent, "~" behind it where it is not real."""
    value, of = float(own["value"]), abs(float(base["value"]))
    if not np.isfinite(value):
        return "", ""
    if str(own["gains"].values) == str(base["gains"].values):
        return number(value), ""
    if not of:  # a share of no walks has no per cent of its own
        of = 1.0
    change, low, high = (100 * float(own[name]) / of for name in ("difference", "low", "high"))
    interval = f"{low:.1f}, {high:.1f}" if np.isfinite([low, high]).all() else "no interval"  # of too few walks
    return number(value), f"{change:+.1f} [{interval}]{' ' if bool(own['real']) else '~'}"


def of_search(found: Tuned) -> dict[str, Any]:
    """Return one of the searches of a law as plain data."""
    return {
        "seed": found.search.seed, "objective": found.value, "feasible": found.feasible, "converged": found.converged,
        "points": found.data.sizes["point"], "gains": by_name(found.gains),
    }  # fmt: skip


def notes_of(found: Comparison, table: xr.Dataset) -> list[str]:
    """Return the basis of a comparison of laws, in lines."""
    seeds = int(table.attrs["seeds"])
    spent = ", ".join(
        f"{law} {' + '.join(str(own.data.sizes['point']) for own in each)}" for law, each in found.searched.items()
    )
    notes = [
        f"points of {found.problem.members} walks searched: {spent}",
        f"{table.attrs['members']} unseen walks of all that was found; {table.attrs['level']:.0%} intervals hold for "
        f"all rows of a column at once ({table.attrs['resamples']} resamples of the walks and of {seeds} seeds; lost "
        "walks: McNemar's exact test)",
    ]
    if seeds == 1:
        notes.append("each law was searched once: another search may end elsewhere, which no interval here counts")
    if found.unsettled:
        notes.append(f"warning: searches of {', '.join(found.unsettled)} ended before they had converged")
    if found.outside:
        notes.append(f"warning: a search of {', '.join(found.outside)} found no gains that keep every limit")
    if left := table.attrs["members"] - table.attrs["members_compared"]:
        notes.append(f"warning: {left} walks in which something diverged count among those lost alone")
    if found.hardware:
        notes.append("better hardware walks with what was tuned for the present one, so it may be worth more")
    return notes


def _searches_table(found: Comparison) -> Table:
    """Return the result of each search and whether it converged, by law and seed."""
    rows = [
        [law if place == 0 else "", str(own.search.seed), str(own.data.sizes["point"]), number(own.value),
         number(own.converged), number(own.feasible)]
        for law, each in found.searched.items()
        for place, own in enumerate(each)
    ]  # fmt: skip
    return Table("Searches", ["law", "seed", "points", "objective", "converged", "keeps all limits"], [("", rows)], 1)


def page_of(found: Comparison, table: Table, said: Findings) -> Page:
    """Return the page of a comparison of laws: verdict, table, and the gains of each."""
    sections = []
    for name, own in found.tuned.items():
        known = labels(own.problem.law)
        rows = [
            ["", gain_name, known[gain_name][0] if gain_name in known else "", gain(by_name(own.gains), gain_name)]
            for gain_name in own.problem.space.gains
        ]
        rows[0][0] = name
        sections.append(("", rows))
    steps = ", ".join(f"{name} {sum(own.env_steps for own in each):,}" for name, each in found.searched.items())
    assert found.search is not None
    return Page(
        f"Laws compared on {{}}: {', '.join(found.laws)} beside retuned pd", said, found.scenario,
        main=[rows[0][0] for _, rows in table.sections],
        tables=[table, _searches_table(found),
                Table("Gains found by the best search", ["law", "gain", "unit", "value"], sections, 3)],
        facts={"precision": "float32", "seed": found.search.seed, "env-steps": steps},
    )  # fmt: skip


@plots.style()
def plot_laws(table: xr.Dataset) -> Figure:
    """Draw differences from the baseline in per cent of it, with their intervals: a panel a metric, a row a law.

    Dots are means, diamonds means of the worst 5 %; grey where the interval holds 0, or where too few seeds or walks
    give none.
    """
    base = table.attrs["baseline"]
    names = [name for name in table["gains"].values.tolist() if name != base]
    others = table.sel(gains=names)  # one which is 0 with all gains shows nothing
    drawn = others["difference"].notnull() & ((others["value"] != 0) | (others["difference"] != 0))
    metrics = [name for name in table["metric"].values.tolist() if bool(drawn.sel(metric=name).any())]
    columns = max(1, min(3, len(metrics)))
    rows = max(1, -(-len(metrics) // columns))
    figure = Figure(figsize=(2 * plots.COLUMN, rows * (0.55 + 0.2 * len(names)) + 0.4), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for panel, metric in itertools.zip_longest(panels.flat, metrics):
        if metric is None:
            panel.set_visible(False)
            continue
        panel.axvline(0, color="0.6", linewidth=0.8)
        for statistic, marker, shift in (("mean", "o", -0.13), ("worst", "D", 0.13)):
            own = table.sel(metric=metric, statistic=statistic)
            per = 100 / (abs(float(own["value"].sel(gains=base))) or 1.0)  # of no lost walks: per cent of all
            for place, name in enumerate(names):
                middle, low, high = (per * float(own[key].sel(gains=name)) for key in ("difference", "low", "high"))
                better = (middle < 0) != bool(own["larger_is_better"])
                color = (plots.BLUE if better else plots.VERMILLION) if bool(own["real"].sel(gains=name)) else "0.7"
                panel.plot([low, high], [place + shift] * 2, color=color, linewidth=1.2)
                panel.plot(middle, place + shift, marker, color=color, ms=3.5)
        panel.set(title=metric.replace("_", " "), ylim=(len(names) - 0.5, -0.5))
        panel.set_yticks(range(len(names)), names)
    for panel in panels[-1]:
        panel.set_xlabel("difference from\nretuned pd [%]")
    marks = [key(text, color="0.3", marker=mark, ms=4, ls="") for text, mark in (("mean", "o"), ("worst 5 %", "D"))]
    lines = (("better", plots.BLUE), ("worse", plots.VERMILLION), ("not real", "0.7"))
    plots.legend_below(figure, [*marks, *(key(text, color=color) for text, color in lines)], 5)
    return figure
