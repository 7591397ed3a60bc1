"""What a sweep leaves in a folder: the grid, its maps, the walks that matter beside it, and the report."""

import contextlib
import dataclasses
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb import plots
from mjx_climb.execution import devices
from mjx_climb.files import scenario_files
from tuning.background import Stage, Work, background, ignore
from tuning.evaluation import stability_limit
from tuning.output.comparisons import GIVEN, OfGrid, beside_retuned, of_grid, one_walk
from tuning.output.folder import Contents, Folder, made_from, write_config
from tuning.report import pages
from tuning.report.comparison import Compared, differences, gains_of
from tuning.report.explorer import axes_of
from tuning.report.numbers import failed, remarks, to_json
from tuning.searches import retuned_pd
from tuning.searches.result import Written
from tuning.searches.retuned_pd import Worth
from tuning.searches.sweep import HISTORIES, Swept, best_cell, holding

HATCHED = ("detached_limb", "diverged")  # shown on every map
CAPTION = "All metrics over both gains; brighter is better."


def sweep(found: Swept, folder: Folder, begun: OfGrid | None = None) -> Contents:
    """Simulate the best, the scenario's own gains and pd, with the contents that `mjx-climb sweep` writes."""
    problem, (scenario, law) = found.problem, found.walker()
    walked = write_config(scenario, folder.path, law, problem.metrics)
    problem = dataclasses.replace(problem, scenario=scenario_files.copied(problem.scenario, folder.path))
    found = dataclasses.replace(found, problem=problem, data=made_from(found.data, walked))
    compared = compare(found, folder.stage, begun)
    data, best, (scenario, law) = compared.data, compared.best, found.walker()
    folder.add("sweep.nc", data)
    count, edges = data["diverged"].size, compared.at_edge
    with background() as begin:
        how = {**problem.walks, "law": law}
        walking = begin(lambda _: pages.with_histories(data, scenario, best, **how) if count > HISTORIES else data)
        folder.draw({"maps": (CAPTION, lambda: sheet(data, compared.rows))})
        with folder.stage("histories") if count > HISTORIES else contextlib.nullcontext():
            histories = walking(ignore)
    summary = _summary(compared, {"walks": count, "failed": compared.failed, "best_at_edge_of": edges})
    widen = [f"the best lies on the edge of the grid: widen {name}" for name in edges]
    worth = [] if compared.worth is None else [compared.worth.in_words]
    if best is None:
        outcome = [f"no walk of the grid held: all {count} detached or diverged"]
    else:
        at = ", ".join(f"{name} {best[name].item():.4g}" for name in found.axes)
        outcome = [f"best: {at} ({compared.failed} of {count} walks detached or diverged)", *widen]
    outcome += worth + remarks({name: metrics for name, (_, metrics) in compared.rows.items()})
    listed = {name: [float(f"{value:.6g}") for value in data[name].values] for name in found.axes}
    return Contents(
        Written(walks=compared.walks, compared=compared.rows, data=data, outcome=outcome, summary=summary),
        {"comparison.json": summary + "\n"},
        page=lambda origin: pages.sweep_page(
            dataclasses.replace(problem, scenario=scenario), compared, histories, marks(data, compared.rows),
            [*worth, *widen], origin,
        ),
        again=f'tuning.sweep(mjx_climb.load_scenario("config.yaml"), {listed}).write("again")',
    )  # fmt: skip


class Comparison(NamedTuple):
    """The best walk of a grid beside the scenario's own gains and pd, walked in double precision."""

    data: xr.Dataset  # the grid, with the limit of stability
    best: xr.Dataset | None  # its cell, None where all failed
    walks: Mapping[str, mc.Trajectory]  # best, pd retuned, gains file, config (or paper), pd: as far as there are such
    rows: Compared  # gains and metrics of these
    failed: int  # walks of the grid
    at_edge: list[str]  # gains whose end of the axis the best cell lies on
    worth: Worth | None  # of a force sensor: the best against pd retuned


def compare(found: Swept, stage: Stage, begun: OfGrid | None = None) -> Comparison:
    """Simulate what the grid is compared with, and work out its limit of stability."""
    problem, best = found.problem, best_cell(found.data)
    axes = {name: found.data[name].values for name in found.axes}
    others = begun or of_grid(problem.scenario, problem.law, found.gains, axes, problem.engine, lambda work: work)
    # side by side: most of the time goes to the compiler, which has a program of its own for each
    with stage("walks alone and stability limit"), ThreadPoolExecutor(devices.usable_cores()) as pool:

        def begin(work: Work[Any]) -> Work[Any]:
            future = pool.submit(work, ignore)
            return lambda _: future.result()

        limits = begin(others.limits)
        asked = dict(others.walks)
        if best is not None:
            walker = found.walker({name: best[name].item() for name in found.axes})
            asked["best"] = one_walk(*walker, problem.engine)
        walking = {name: begin(walk) for name, walk in reversed(asked.items())}
        rival, limit = limits(ignore)
        if best is not None and (rival is None or (rival.lacks and best["force_variation"] < rival.value)):
            rival = retuned_pd.least(problem.scenario, engine=problem.engine)  # a verdict takes all of pd's bounds
        if rival is not None:
            ours = None if best is None else walker
            walking[retuned_pd.NAME], step, level = beside_retuned(
                problem.scenario, rival.joint, ours, problem.engine, begin
            )
        walked = {name: each(ignore) for name, each in walking.items()}
        radius = stability_limit.on_map(limit, found.data)
    config = next(name for name in others.walks if name not in ("pd", GIVEN))
    walks = {name: walked[name] for name in ("best", retuned_pd.NAME, GIVEN, config, "pd") if name in walked}
    rows = {name: (gains_of(walk), mc.metrics(walk, problem.metrics)) for name, walk in walks.items()}
    worth = None
    if rival is not None:
        rows[retuned_pd.NAME] = dict(rival.joint), (theirs := rows[retuned_pd.NAME][1])
        if best is not None:
            metrics = rows["best"][1] if level is None else mc.metrics(level(ignore), problem.metrics)
            worth = _worth(found, metrics, theirs, rival._replace(step=step))
    data = found.data.assign(spectral_radius=radius)
    failures = int(((data["detached_limb"] >= 0) | data["diverged"].astype(bool)).sum())
    edges = [] if best is None else [n for n in found.axes if best[n].item() in data[n].values[[0, -1]]]
    return Comparison(data, best, walks, rows, failures, edges, worth)


def _worth(found: Swept, ours: Mapping[str, Any], theirs: Mapping[str, Any], rival: retuned_pd.Rival) -> Worth:
    name = "force_variation"  # what the best cell has least of
    values, without = ({name: np.nan if failed(metrics) else metrics[name]} for metrics in (ours, theirs))
    spread = max(retuned_pd.spread(holding(found.data, name).values), rival.spread)
    others = differences(ours, theirs, found.problem.metrics, but=(name,))
    return retuned_pd.worth(values, without, rival._replace(spread=spread), place=" on this grid", others=others)


def _summary(compared: Comparison, counts: Mapping[str, Any]) -> str:
    walks = {
        "config" if name == "paper" else name: {"gains": gains, "metrics": metrics}
        for name, (gains, metrics) in compared.rows.items()
    }
    sensor = {} if compared.worth is None else compared.worth.summary
    return to_json({"best": None} | walks | sensor | {"grid": counts})


def sheet(data: xr.Dataset, compared: Compared) -> Figure:
    """Draw the maps of all metrics that have values, with the gains and with pd's values to compare with."""
    metrics = [str(n) for n, v in data.items() if "larger_is_better" in v.attrs and n not in HATCHED]
    known = [name for name in metrics if np.isfinite(data[name]).any()]
    baselines = {name: value for name, value in compared["pd"][1].items() if value is not None}
    return plots.plot_maps(data, known, marks(data, compared), baselines=baselines, columns=3)


def marks(data: xr.Dataset, compared: Compared) -> dict[str, tuple[float, float]]:
    """Return the two gains of the walks that have one of each."""
    found = {}
    for name, (gains, _) in compared.items():
        if gains is not None and all(key in gains and np.unique(gains[key]).size == 1 for key in axes_of(data)):
            x, y = (float(np.ravel(gains[key])[0]) for key in axes_of(data))
            found[name] = x, y
    return found
