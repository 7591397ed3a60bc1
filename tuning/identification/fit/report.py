"""The page of a fit: tables of parameters and residuals, and pictures of the residuals."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mjx_climb.viz import plots
from tuning.identification.fit.inference import suspicious
from tuning.identification.fit.result import Estimate, Identified
from tuning.identification.model.variables import begin
from tuning.identification.model.windows import KINDS
from tuning.identification.readers.log import signals_of
from tuning.numbers import number
from tuning.pages import page

RESIDUALS = "Residuals over the noise of their signal, over time, joint by joint; grey: held out, predicted only."
CORRELATION = "Autocorrelation of the residuals of each signal; outside the band by chance once in twenty."
PREDICTION = (
    "The signal that is predicted worst, two seconds of it: log, model with the values before and after, and below "
    "what each misses in units of the noise; grey: twice the noise."
)
SHOWN = 2.0  # s
# before is a broad band, so that after does not hide it
_MODELS: dict[str, dict[str, Any]] = {
    "before": {"color": plots.ORANGE, "linewidth": 2.4, "alpha": 0.7}, "after": {"color": plots.BLUE, "linewidth": 0.9},
}  # fmt: skip
_COLOURS = (plots.BLUE, plots.ORANGE, plots.GREEN, plots.PURPLE, plots.SKY)
COLUMNS = ("parameter", "unit", "before", "after", "95 % interval", "remark")


def table(found: Identified) -> page.Table:
    """Return the fitted values: before, after, interval, and bound or prior where one was reached."""
    beside = {key: each for key, each in found.beside.items() if each.seen}
    sections = [("", _rows(found.estimates)), ("beside these", _rows(beside))]
    return page.Table("Parameters", COLUMNS, [(name, rows) for name, rows in sections if rows])


def _rows(estimates: Mapping[str, Estimate]) -> list[list[str]]:
    return [
        [key, e.unit, number(e.before), number(e.value),
         f"{number(e.low)} to {number(e.high)}",
         e.remark or ("" if e.seen else "not told")]
        for key, e in estimates.items()
    ]  # fmt: skip


def residual_table(found: Identified) -> page.Table:
    """Return of each signal, joint by joint, the noise, the residuals over it, fitted and held out, and doubts."""
    windows, fitted = found.model.windows, found.problem.fitted
    scaled, meanings = found.fitted.scaled, signals_of(found.model.structure.robot)
    ahead, wrong = found.held_out.get("signals", {}), {test.signal: test for test in suspicious(found.tests)}
    rows: dict[str, list[list[str]]] = {}
    for n, name in enumerate(windows.names):
        place, _, what = name.rpartition(".") if windows.kind[n] < 3 else (name.partition(".")[0], "", name)
        own = scaled[fitted & (found.problem.rows.signal == n)]
        test = wrong.get(name)
        rows.setdefault(place, []).append([
            what, meanings[name].unit, number(float(found.fitted.noise[n])), f"{np.sqrt((own**2).mean()):.3f}",
            f"{ahead[name]:.3f}" if name in ahead else "",
            "" if test is None else f"{test.correlation[np.argmax(np.abs(test.correlation))]:+.2f}",
        ])  # fmt: skip
    columns = ("signal", "unit", "noise", "residual over noise", "held out", "correlation")
    return page.Table("Residuals by joint", columns, list(rows.items()))


def findings(found: Identified) -> page.Findings:
    """The findings of a fit; all its warnings bear on the verdict."""
    return page.Findings(found.sentence, [f"warning: {line}" for line in found.warnings], found.combined)


def page_of(found: Identified) -> page.Page:
    """Return the page of a result."""
    return page.Page(
        title=f"Identified from {Path(found.log.source).name}", findings=findings(found),
        scenario=found.scenario, tables=[table(found), residual_table(found)],
        facts={
            "search": found.fitted.ended, "iterations": found.fitted.iterations,
            "windows": len(found.model.windows.begin),
        },
    )  # fmt: skip


def _times(found: Identified) -> np.ndarray:
    rows, windows = found.problem.rows, found.model.windows
    return np.asarray(windows.begin[rows.window] + (rows.step + rows.share) * windows.time_step)


@plots.style()
def plot_residuals(found: Identified) -> Figure:
    """Return residuals over time, a panel for each joint, foot, and the base; kinds of signals by colour."""
    rows, windows, time = found.problem.rows, found.model.windows, _times(found)
    scaled, robot = found.fitted.scaled, found.model.structure.robot
    kind, held = windows.kind[rows.signal], windows.held_out[rows.window]
    lane = np.where(kind < 3, windows.joint[rows.signal], np.where(kind == 3, robot.joints, robot.joints + 1))
    limb = np.where(kind > 3, 0, windows.limb[rows.signal])
    names = [*robot.joint_names, "foot", "base"]
    lanes, limbs = np.unique(lane), np.unique(limb)
    figure = Figure(figsize=(max(1.9 * len(limbs), 3.5), 1.1 * len(lanes) + 0.6), layout="constrained")
    panels = figure.subplots(len(lanes), len(limbs), sharex=True, sharey=True, squeeze=False)
    for (row, column), panel in np.ndenumerate(panels):
        of_panel = (lane == lanes[row]) & (limb == limbs[column])
        for each, color in zip(np.unique(kind), _COLOURS, strict=False):
            own = of_panel & (kind == each)
            panel.plot(time[own & ~held], scaled[own & ~held], ".", ms=1.5, color=color)
            panel.plot(time[own & held], scaled[own & held], ".", ms=1.5, color="0.75")
        panel.set_ylim(-6, 6)
        if row == 0:
            panel.set_title(robot.limbs[limbs[column]])
        if column == 0:
            panel.set_ylabel(f"{names[lanes[row]]}, 1")
        if row == len(lanes) - 1:
            panel.set_xlabel("time, s")
    handles = [
        plots.key(KINDS[each].replace("_", " "), color=color)
        for each, color in zip(np.unique(kind), _COLOURS, strict=False)
    ]
    plots.legend_below(figure, handles, len(handles))
    return figure


@plots.style()
def plot_correlation(found: Identified) -> Figure:
    """Return the autocorrelation of each signal's residuals, those that are wrong by name."""
    figure = Figure(figsize=(7.0, 2.4), layout="constrained")
    axis, wrong = figure.subplots(), {test.signal for test in suspicious(found.tests)[:5]}
    for test in found.tests:
        lags = test.period * np.arange(1, len(test.correlation) + 1)
        if test.signal in wrong:
            axis.plot(lags, test.correlation, label=test.signal)
        else:
            axis.plot(lags, test.correlation, color="0.75", linewidth=0.6)
    counts = [int((found.problem.rows.signal == n).sum()) for n in range(len(found.model.windows.names))]
    band = 2 / np.sqrt(max(min(counts), 1))
    axis.axhspan(-band, band, color="0.93", zorder=0)
    axis.set_xlabel("lag, s")
    axis.set_ylabel("autocorrelation, 1")
    if wrong:
        axis.legend()
    return figure


@plots.style()
def plot_prediction(found: Identified) -> Figure:
    """Return log and model, before and after the fit, where the signal with the largest error over its noise is worst.

    Two seconds are shown, and below the residuals in units of the noise.
    """
    rows, windows, time = found.problem.rows, found.model.windows, _times(found)
    scaled = np.abs(found.fitted.scaled)
    means = [float(scaled[rows.signal == n].mean()) for n in range(len(windows.names))]
    worst = int(np.argmax(means))
    own = np.flatnonzero(rows.signal == worst)
    own = own[np.argsort(time[own], kind="stable")]
    first = found.problem.evaluate(np.r_[begin(found.model.variables), found.fitted.start.ravel()])
    missed = {"after": found.fitted.residuals[own]}
    if first is not None:
        missed = {"before": first.residuals[own]} | missed
    middle = time[own][int(np.argmax(np.abs(missed["after"])))]
    shown = np.abs(time[own] - np.clip(middle, time[own][0] + SHOWN / 2, time[own][-1] - SHOWN / 2)) <= SHOWN / 2
    own, missed = own[shown], {name: values[shown] for name, values in missed.items()}
    gap = np.flatnonzero(np.diff(time[own]) > 5 * np.median(np.diff(time[own]))) + 1  # lines break in holes

    def broken(values: np.ndarray) -> np.ndarray:
        return np.insert(values, gap, np.nan)

    name, noise = windows.names[worst], float(found.fitted.noise[worst])
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    above, below = figure.subplots(2, sharex=True, height_ratios=(2, 1))
    for label in missed:
        look = _MODELS[label]
        above.plot(broken(time[own]), broken(rows.value[own] - missed[label]), label=f"model, {label}", **look)
        below.plot(broken(time[own]), broken(missed[label] / noise), **look)
    above.plot(time[own], rows.value[own], ".", color="black", markersize=2, label="log", zorder=3)
    below.axhspan(-2, 2, color="0.9", zorder=0)
    above.set_ylabel(f"{name} [{signals_of(found.model.structure.robot)[name].unit}]")
    below.set(xlabel="time [s]", ylabel="log - model [noise]")
    below.set_yscale("symlog", linthresh=10.0)
    figure.legend(*above.get_legend_handles_labels(), ncols=3, loc="outside upper center")
    return figure
