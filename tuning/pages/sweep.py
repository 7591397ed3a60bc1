"""A sweep: its maps, page with the walks beside it."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from mjx_climb import trajectory
from mjx_climb.viz import plots
from mjx_climb.viz.plots.styling import render_ahead
from tuning.background import Stage, silent
from tuning.comparisons import of_sweep, verdicts
from tuning.comparisons.of_sweep import SweepComparison, own_name, variation_of
from tuning.comparisons.side_by_side import Compared, Values
from tuning.numbers import number, remarks, to_json
from tuning.pages import comparison
from tuning.pages.contents import Contents, Files, Picture, Written, at_own_step, plain_of, worse_than_pd
from tuning.pages.explorer import explorer, grid_points
from tuning.pages.page import Findings, Page
from tuning.results.swept import Swept, axes_of, best_cell
from tuning.searches.sweep import own_values

FIRST_MAP = "Force variation over both gains; brighter is better."
LACKS = "pd retuned, the walks in double precision and the limit of stability"  # of the first page
MAPS = "All metrics over both gains; brighter is better."
_HATCHED = ("detached_limb", "diverged")  # shown on every map


class Drawn(NamedTuple):
    """A sheet of maps, and what is marked on it."""

    figure: Figure
    marked: tuple[Mapping[str, tuple[float, float]], Values]


def compare(
    found: Swept, stage: Stage = silent, _: object = None, begun: of_sweep.Begun | None = None
) -> SweepComparison:
    """Return `of_sweep.compare`; the sheet of maps is drawn while pd is retuned."""

    def draw(data: xr.Dataset, rows: Compared) -> Drawn:
        with stage("maps", compiles=False):
            figure = sheet(data, rows)
            render_ahead(figure, "png")
        return Drawn(figure, _marked(data, rows))

    return of_sweep.compare(found, stage, begun=begun, draw=draw)


def contents(found: Swept, compared: SweepComparison, name: str) -> Contents:
    """Return the grid, the sheet of maps, the walks beside it, and the page."""
    data, best = compared.data, compared.best
    count, edges = data["diverged"].size, compared.at_edge
    walks = {"config" if name == "paper" else name: own for name, own in plain_of(compared.rows).items()}
    sensor = {} if compared.worth is None else compared.worth.summary
    counts = {"walks": count, "failed": compared.failed, "best_at_edge_of": edges}
    summary = {"best": None} | walks | sensor | {"grid": counts}
    metrics = {name: own for name, (_, own) in compared.rows.items()}
    lines = [f"warning: the best lies on the edge of the grid: widen {name}" for name in edges]
    if best is not None:
        missed = metrics["best"].get("missed_grips")
        lines += [precision_of(best), f"{compared.failed} of {count} walks lost a gripper or diverged"]
        lines += [f"warning: {missed} grips of the best missed the ground"] if missed else []
        lines += worse_than_pd(metrics["best"], metrics["pd"], found.problem.metrics)
    lines += [*at_own_step(compared.level, "the best", "force variation"), *remarks(metrics), *compared.remedies]
    said = Findings.of(compared.verdict, lines, "" if compared.worth is None else compared.worth.in_words)
    listed = {name: [float(f"{value:.6g}") for value in data[name].values] for name in found.axes}
    call = f'tuning.sweep(mjx_climb.load_scenario("config.yaml"), {listed})'
    page, maps = page_of(found, compared, said), Picture(MAPS, lambda: sheet(data, compared.rows, compared.drawn))
    written = Written(walks=compared.walks, compared=compared.rows, data=data, outcome=said.lines)
    return _contents(found, written, summary, page, maps, f'tuning.write({call}, "again")')


def _contents(
    found: Swept, written: Written, summary: dict[str, Any], page: Page, maps: Picture, again: str = ""
) -> Contents:
    """Return the contents of the folder of a grid, whose config has the gains that replace the scenario's."""
    problem, text, data = found.walked, to_json(summary), written.data
    assert data is not None
    files: Files = {
        found.FILE: data.assign_attrs(scenario=problem.scenario.to_yaml()),
        "maps": maps,
        "comparison.json": text + "\n",
    }
    return Contents(dataclasses.replace(written, summary=text), problem, files, page.at, again)


def first(found: Swept, named: Mapping[str, Values]) -> Contents | None:
    """Return the contents of the folder until the grid is compared: a map, a table and a page; None where no walk held.

    `named` are the metrics of other walks of the grid's program, see `tuning.searches.sweep.Grid.named`.
    """
    data, best = found.data, best_cell(found.data)
    if best is None:
        return None
    scenario, about = found.walked.scenario, found.problem.metrics
    at = {axis: best[axis].item() for axis in found.axes}
    limbs = scenario.limbs
    own = trajectory.named({key: best[key].item() for key in about.names}, limbs)
    configs = own_values(found.walked, found.axes)
    gains = {"best": at, "pd": None}
    walks = {key: (gains.get(key, configs), metrics) for key, metrics in {"best": own, **named}.items()}
    rows = {own_name(found.problem) if key == "config" else key: walk for key, walk in walks.items()}
    listed = " and ".join(f"{axis} {value:.4g}" for axis, value in at.items())
    walked = {key: verdicts.Walked(variation_of(metrics)) for key, (_, metrics) in rows.items()}
    ours = f"not yet compared with pd retuned: best of {data['diverged'].size} walks, {listed}"
    outcome = f"{verdicts.against_best(ours, walked, 'force variation', 'N')} (single precision)"
    baseline = named["pd"]["force_variation"] if "pd" in named else None
    table = comparison.table(rows, "Walks of the grid, in single precision", about, found.walked.law)
    again = f"{LACKS} are missing here; the same command, as it stands below, goes on with them"
    page = Page("Sweep of {}, not yet compared", Findings(outcome, [again]), scenario, tables=[table])
    how: dict[str, Any] = {"marks": marks(data, rows), "baseline": baseline}
    maps = Picture(FIRST_MAP, lambda: plots.plot_map(data, "force_variation", **how))
    return _contents(found, Written(compared=rows, data=data, outcome=[outcome]), plain_of(walks), page, maps)


def page_of(found: Swept, compared: SweepComparison, said: Findings) -> Page:
    """Return the page of a sweep: its maps with gains marked on them, and time histories."""
    grid, best, rows, about = compared.data, compared.best, compared.rows, found.problem.metrics
    scenario, histories = found.walked.scenario, compared.histories
    axes, metrics = axes_of(grid), {walk: numbers for walk, (_, numbers) in rows.items()}
    count, kept, notes = grid["diverged"].size, histories["diverged"].size, [*said.notes]
    if kept < count:
        notes.append(f"the page holds the time histories of {kept} of the cells; a click shows the nearest of them")
    begin = best if best is not None else grid.isel(dict.fromkeys(axes, 0))
    points = grid_points(grid, histories, metrics["pd"], marks(grid, rows), begin)
    walks = {name: compared.walks[name] for name in reversed(list(compared.walks))}
    facts = {
        "precision": f"{grid.attrs['dtype']} (grid), float64 (named walks)", "engine": grid.attrs["engine"],
        "robots at a time": grid.attrs["batch_size"], "seed": "none: nothing is drawn at random",
    }  # fmt: skip
    how: dict[str, Any] = {"shown": ("pd",), "about": about, "scenario": scenario}
    return Page(
        f"Sweep of {{}}, {' by '.join(str(grid.sizes[name]) for name in axes)} gains", said._replace(notes=notes),
        scenario, facts=facts,
        explorers={"Maps and walks": explorer(walks, metrics, points=points, **how)},
        tables=[comparison.table(rows, precision_of(best), about, found.problem.law)],
    )  # fmt: skip


def precision_of(best: xr.Dataset | None) -> str:
    """Return the precision of the walks beside a grid and of its map, with the best cell's value there."""
    alone = "Walks alone, in double precision"
    if best is None:
        return alone
    return f"{alone}; the map is in single precision, where the best has {number(best['force_variation'].item())} N"


def sheet(data: xr.Dataset, compared: Compared, drawn: Drawn | None = None) -> Figure:
    """Draw the maps of all metrics that have values, with the gains and with pd's values to compare with.

    They are those that were `drawn` before, unless something else was marked there.
    """
    marked = _marked(data, compared)
    if drawn is not None and drawn.marked == marked:
        return drawn.figure
    metrics = [str(n) for n, v in data.items() if "larger_is_better" in v.attrs and n not in _HATCHED]
    known = [name for name in metrics if np.isfinite(data[name]).any()]
    return plots.plot_maps(data, known, marked[0], baselines=marked[1], columns=3)


def _marked(data: xr.Dataset, compared: Compared) -> tuple[dict[str, tuple[float, float]], Values]:
    """Return gains and values of pd that are marked on maps."""
    return marks(data, compared), {name: value for name, value in compared["pd"][1].items() if value is not None}


def marks(data: xr.Dataset, compared: Compared) -> dict[str, tuple[float, float]]:
    """Return the two gains of the walks that have one of each."""
    found = {}
    for name, (gains, _) in compared.items():
        if gains is not None and all(
            gains.get(key) is not None and np.unique(gains[key]).size == 1 for key in axes_of(data)
        ):
            x, y = (float(np.ravel(gains[key])[0]) for key in axes_of(data))
            found[name] = x, y
    return found
