"""Gains that a search found: page with the map around them and their tests, pictures of the search."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

import mjx_climb as mc
from mjx_climb.viz import plots
from mjx_climb.viz.plots import key
from tuning.comparisons import maps
from tuning.comparisons.of_search import TuneComparison
from tuning.comparisons.of_search import compare as compare
from tuning.comparisons.side_by_side import Values
from tuning.comparisons.verification import Verification
from tuning.gains.gains_file import by_name
from tuning.numbers import axis_values, number, remarks
from tuning.pages import comparison
from tuning.pages.contents import Contents, Picture, at_own_step, contents_of, plain_of, worse_than_pd
from tuning.pages.explorer import explorer, grid_points
from tuning.pages.margins import plot_margins
from tuning.pages.page import Findings, Page, Table
from tuning.problem.spaces import kind_of
from tuning.results.swept import axes_of
from tuning.results.tuned import AGREEMENT, CHECKED, Tuned

CONVERGENCE = "How the search converged."
WALKS = "The tuned gains beside pd over time: red crosses mark a torn gripper, shading a disturbance."
PATH = "The way of the search over the map; the red line is the limit of stability."
MARGINS = "Force variation on worse hardware: a curve ends where a gripper is torn off, or the walk diverges."
CROWD = 100  # points of a round; more would hide the map


def contents(found: Tuned, compared: TuneComparison, name: str) -> Contents:
    """Return gains, all points, the map, the walks, pictures and page."""
    over, rows, checked, broken = compared.over, compared.rows, compared.checked, compared.broken
    metrics = {name: own for name, (_, own) in rows.items()}
    lines = [f"warning: the tuned gains break limits: {'; '.join(broken['tuned'])}"] if broken["tuned"] else []
    lines += [found.data.attrs[AGREEMENT]] if AGREEMENT in found.data.attrs else []
    lines += at_own_step(compared.level, "the tuned gains", "objective")
    lines += [f"warning: {line}" for line in checked.warnings]
    if broken["config"]:
        lines.append(f"the config's own gains break limits: {'; '.join(broken['config'])}")
    lines += remarks(metrics) + worse_than_pd(metrics["tuned"], metrics["pd"], found.problem.metrics)
    lines += _outcome_of(checked, found) + _turns(found, compared.walks["tuned"])
    said = Findings.of(compared.verdict, lines, "" if compared.worth is None else compared.worth.in_words)
    plain: dict[str, Any] = {name: own | {"broken_limits": broken[name]} for name, own in plain_of(rows).items()}
    plain["search"] = {
        **found.search.model_dump(mode="json"), "objective": found.value, "feasible": found.feasible,
        "env_steps": found.env_steps, "env_steps_at_best": found.best_at,
    }  # fmt: skip
    plain |= {} if compared.worth is None else compared.worth.summary
    plain["verification"] = {**dataclasses.asdict(checked), "passed": checked.passed}
    walks = {walk: compared.walks[walk] for walk in ("pd", "tuned")}
    files: dict[str, Any] = {
        "convergence": Picture(CONVERGENCE, lambda: plot_convergence(found)),
        "walks": Picture(WALKS, lambda: plots.plot_comparison(walks)),
        "margins": Picture(MARGINS, lambda: plot_margins(compared.hardware, "tuned")),
    }
    own = {} if over is None else {"map.nc": over, "path": Picture(PATH, lambda: plot_path(found, over))}
    again, page = "mjx-climb tune config.yaml --search search.yaml --out again", page_of(found, compared, said)
    told: dict[str, Any] = {"walks": compared.walks, "compared": rows, "data": over}
    return contents_of(found, name, page, plain, files | own, again=again, shown=0, **told)


def _turns(found: Tuned, walk: mc.Trajectory) -> list[str]:
    """Warn that isotropic gains stiffen rotations, where the law shifts the base."""
    if found.search.space != "isotropic" or not np.any(walk.base_displacement):
        return []
    moved = np.linalg.norm(walk.base_displacement.reshape(-1, 2, 3), axis=-1)
    shift, turn = 1e3 * np.nanmax(moved, axis=0)
    return [
        "one number for N/m and N m/rad alike makes rotations far stiffer at the feet than translations: the law "
        f"shifts the base by up to {shift:.2g} mm and turns it by {turn:.2g} mrad; --space split tunes both"
    ]


def _outcome_of(checked: Verification, found: Tuned) -> list[str]:
    """Return the outcome of the tests in a few lines, without their warnings."""
    limits = "keeps every limit" if checked.passed else "breaks limits: " + "; ".join(checked.broken_limits)
    lines = [f"verification: alone in float64 objective {checked.value:.4f} (pd: {found.of_pd:.4g}); {limits}"]
    if checked.binding_limits:
        lines.append(f"held by its limits: {'; '.join(checked.binding_limits)}")
    kinds = {kind: [n for n, k in checked.shape.items() if k == kind] for kind in ("plateau", "slope", "cliff")}
    lines.append("within 20 %: " + "; ".join(f"{kind} in {', '.join(n)}" for kind, n in kinds.items() if n))
    if checked.slopes:
        steepest = max(checked.slopes, key=lambda name: abs(checked.slopes[name]))
        lines.append(f"steepest slope: {checked.slopes[steepest]:+.3g} per unit of log {steepest}")
    if checked.grid_value is not None:
        lines.append(f"best cell of an isotropic grid: {checked.grid_value:.4f}, the search: {found.value:.4f}")
    lines += [f"margin, {margin.sentence}" for margin in checked.margins.values()]
    lines.append(f"closed loop in its worst stance: largest eigenvalue {checked.spectral_radius:.6f} (below 1: stable)")
    return lines


def page_of(found: Tuned, compared: TuneComparison, said: Findings) -> Page:
    """Return the page of a search."""
    search, about, checked, rows = found.search, found.problem.metrics, compared.checked, compared.rows
    metrics = {walk: numbers for walk, (_, numbers) in rows.items()}
    points = None if compared.over is None else _points_of_map(found, compared.over, metrics["pd"])
    title = "Map: the same gains on all axes, around the result" if points else "Walks"
    walks = {name: compared.walks[name] for name in reversed(list(rows))}
    objective = {"tuned": {"objective": checked.value}, "pd": {"objective": found.of_pd}}
    values = {walk: {**numbers, **objective.get(walk, {})} for walk, numbers in metrics.items()}
    side_by_side = comparison.table(rows, "Walks in double precision", about, found.law)
    caption = "Around the result: change of the objective, in per cent of pd's, with one gain 20 % less or more"
    around = []
    for name, shape in checked.shape.items():
        cells = (
            "breaks a limit" if value is None else f"{100 * value / (abs(found.of_pd) or 1.0):+.2f}"
            for value in (checked.less[name], checked.more[name])
        )
        around.append([name, *cells, shape, number(checked.slopes.get(name))])
    near = Table(caption, ["gain", "20 % less", "20 % more", "shape", "slope per log"], [("", around)], 1)
    return Page(
        f"Tuned gains for {{}}: {found.method}, {search.space}", said, found.scenario,
        explorers={
            title: explorer(walks, values, shown=("pd", "tuned"), opens_on="tuned", points=points, about=about)
        },
        tables=[side_by_side, comparison.gains_table(rows, found.law), near],
        facts={"precision": "float32 (search, map), float64 (named walks, verification)", "seed": search.seed,
               "env-steps": f"{found.env_steps:,} (best after {found.best_at:,})"},
    )  # fmt: skip


def _points_of_map(found: Tuned, over: xr.Dataset, baseline: Values) -> dict[str, Any]:
    """Return the cells of the map around a result, which begins at its best one.

    Gains that differ from axis to axis stand at the geometric means of translations and of rotations.
    """
    x, y = axes_of(over)
    walks = {"tuned": by_name(found.gains)} | ({"config": vars(found.scenario.control)} if found.law is None else {})
    marks: dict[str, tuple[float, float]] = {}
    for walk, gains in walks.items():
        both = np.stack([axis_values(gains[x]), axis_values(gains[y])])
        if np.ptp(both, axis=1).max() == 0:
            marks[walk] = (both[0, 0].item(), both[1, 0].item())
            continue
        for part, place in (("translations", both[:, :3]), ("rotations", both[:, 3:])):
            at = np.exp(np.log(place).mean(1))
            if np.isfinite(at).all():
                marks[f"{walk}, {part}"] = (at[0].item(), at[1].item())
    best = maps.best_cell(over)
    first = over.isel({x: 0, y: 0}) if best is None else best
    return grid_points(over, over, {**baseline, "objective": found.of_pd}, marks, first)


@plots.style()
def plot_convergence(found: Tuned) -> Figure:
    """Draw the objective over the env-steps spent: every feasible point, the best so far, and gradient norms.

    Of a search over an ensemble, the points that were checked on other walks, and the result among them.
    """
    history = found.data
    spent = history["env_steps"].values / 1e6
    value = np.where(history["feasible"], history["value"], np.nan)
    norm, checked = history["gradient_norm"].values, history["phase"].values == CHECKED
    with_gradient = np.isfinite(norm).any()
    figure = Figure(figsize=(plots.COLUMN, 3.2 if with_gradient else 2.2), layout="constrained")
    axes = figure.subplots(1 + with_gradient, 1, sharex=True, squeeze=False)[:, 0]
    axes[0].plot(spent[~checked], value[~checked], ".", color="0.65", markersize=2.5, label="keeps every limit")
    if checked.any():
        axes[0].plot(
            spent[checked], value[checked], "_", color=plots.PURPLE, markersize=4, label="on the check's walks"
        )
        axes[0].plot(spent[found.best], value[found.best], "*", color="0.1", markersize=5, label="result")
    if np.isfinite(value).any():
        axes[0].plot(spent[~checked], np.fmin.accumulate(value[~checked]), color=plots.BLUE, label="best so far")
        low = np.nanmin(value)
        size = abs(found.of_pd) or 1.0
        top = max(found.of_pd + 0.1 * size, low + 0.5 * size)
        axes[0].set_ylim(low - 0.03 * size, min(np.nanmax(value), top) + 0.03 * size)
    axes[0].axhline(found.of_pd, color=plots.RED, linewidth=0.8, label="pd")
    axes[0].set_ylabel("objective")
    plots.legend(figure, axes[0].get_legend_handles_labels()[0])
    if with_gradient:
        axes[1].semilogy(spent, norm, ".", color=plots.BLUE, markersize=2.5)
        axes[1].set_ylabel("norm of\nthe gradient")
    axes[-1].set_xlabel("env-steps spent [million]")
    return figure


_PARTS = {  # which of six axes are drawn as one; their names in a space, colour, and the mark of the result
    "translations": (slice(0, 3), ("translation", "x", "y", "z"), "0.1", "*"),
    "rotations": (slice(3, 6), ("rotation", "rx", "ry", "rz"), plots.PURPLE, "P"),
}


@plots.style()
def plot_path(found: Tuned, walks: xr.Dataset) -> Figure:
    """Draw the way of every start over a map with an `objective` (`tuning.comparisons.maps`), and its stability limit.

    The map and its limit are of gains that are the same on all axes. Where a search told axes apart, translations and
    rotations go their own ways, the geometric means of theirs, and the result has a mark for each axis.
    """
    axes, tuned, control = axes_of(walks), by_name(found.gains), found.scenario.control
    coordinates, theta = found.data["coordinate"].values.astype(str), found.data["theta"].values
    apart = any(name != kind_of(name) for name in coordinates)
    means = {"tuned": [_mean(tuned[gain]) for gain in axes]}
    if not found.law:
        means["config"] = [_mean(getattr(control, gain)) for gain in axes]
    title = "map and limit: the same gains on all axes" if apart else None
    marks = {} if apart else {name: (x, y) for name, (x, y) in means.items()}
    figure = plots.plot_map(walks, "objective", marks, baseline=found.of_pd, title=title)
    descending = np.isin(found.data["phase"].values.astype(str), ["descent", "axes tied", "axes free"])
    starts, leading, others = found.data["row"].values, best_of_crowds(found.data), ~descending & ~crowded(found.data)
    panel = figure.axes[0]
    handles: list[Artist] = []
    for legend in figure.legends:
        handles += [handle for handle in legend.legend_handles if handle is not None]
        legend.remove()
    for part, (six, names, color, marker) in (_PARTS if apart else {"": _PARTS["translations"]}).items():
        result, ways = [axis_values(tuned[gain])[six] for gain in axes], []
        for gain, values in zip(axes, result, strict=True):
            searched = theta[:, np.isin(coordinates, [gain, *(f"{gain}.{name}" for name in names)])]
            ways.append(np.exp(searched.mean(1)) if searched.size else np.full(len(theta), _mean(values)))
        line: dict[str, Any] = {"color": color, "linewidth": 0.7}
        dots: dict[str, Any] = {"color": color, "marker": ".", "markersize": 2, "linestyle": "none"}
        for points in [*(descending & (starts == row) for row in np.unique(starts[descending])), leading]:
            panel.plot(ways[0][points], ways[1][points], "-", **line, zorder=3)
        panel.plot(ways[0][others], ways[1][others], **dots, zorder=3)
        for text, drawn in (("descents", descending.any()), ("best of each round", leading.size)):
            handles += [key(f"{text}, {part}" if part else text, **line)] if drawn else []
        last = _mark(panel, result, marker, color, f"tuned, {part}") if apart else key("other points", **dots)
        handles.append(last)
    if apart and "config" in means:
        handles.append(_mark(panel, means["config"], "o", "0.1", "config"))
    plots.legend_below(figure, handles, 3)
    return figure


def crowded(history: xr.Dataset) -> np.ndarray:
    """Return which points (N,) were judged beside so many that they would hide the map."""
    return np.asarray(np.bincount(history["round"].values)[history["round"].values] > CROWD)


def best_of_crowds(history: xr.Dataset) -> np.ndarray:
    """Return the indices of the points with the least value plus penalty of each crowded round, one after the other."""
    merit, rounds = (history["value"] + history["penalty"]).values, history["round"].values
    places = np.flatnonzero(crowded(history) & np.isfinite(merit))
    order = places[np.lexsort((merit[places], rounds[places]))]
    return np.asarray(order[np.unique(rounds[order], return_index=True)[1]])


def _mark(panel: Axes, points: Sequence[ArrayLike], marker: str, color: str, label: str) -> Artist:
    """Mark points (x, y) and return the handle of the legend."""
    look: dict[str, Any] = {"ls": "none", "mfc": "white", "mec": color, "mew": 0.9, "ms": 9 if marker == "*" else 6}
    return panel.plot(*points, marker=marker, **look, zorder=4, label=label, gid=label)[0]


def _mean(gain: ArrayLike) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(gain))))
