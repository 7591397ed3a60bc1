"""What `identify` leaves in its folder: values, sections that other commands read, a posterior ensemble, a page."""

import dataclasses
import functools
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.files.scenario_files import portable_yaml
from mjx_climb.parameter_types import KEYS
from mjx_climb.viz import plots
from tuning.background import Stage, silent
from tuning.identification.fit import robot_files
from tuning.identification.fit.identify import Estimate, Identified
from tuning.identification.fit.inference import suspicious
from tuning.identification.fit.least_squares import scaled_residuals
from tuning.identification.model.variables import begin
from tuning.identification.model.windows import KINDS, UNITS
from tuning.numbers import number
from tuning.pages import page
from tuning.pages.contents import Files, Picture, Written
from tuning.problem.ensemble import TILTS, Ensemble, Posterior
from tuning.results.config_file import write_config
from tuning.writing.folder import fill
from tuning.writing.record import Settings, check_own, whole

FILE = "result.json"
CALL = "tuning.identify(...)"
RESIDUALS = "Residuals over the noise of their signal, over time; grey: held out, predicted only."
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
COLUMNS = ("parameter", "unit", "before", "after", "95 % interval", "remark")


def write(
    found: Identified,
    folder: Path,
    *,
    origin: page.Origin | None = None,
    figures: Collection[str] = ("png",),
    stage: Stage = silent,
    settings: Settings | None = None,
) -> Written:
    """Write what `mjx-climb identify --out` does; arguments and errors as of `tuning.write`."""
    check_own(folder, FILE)
    where, report = origin or page.Origin("the scenario", CALL, CALL), functools.partial(page_of, found)
    with whole(folder, settings) as place:
        return Written(fill(place, _files(found, place, where.asked), report, where, figures, stage))


def _files(found: Identified, place: Path, asked: str) -> Files:
    scenario = write_config(found.scenario, place)
    identified = identified_scenario(found, scenario, place)
    texts = {
        "identified.yaml": portable_yaml(identified, place),
        "hardware.yaml": _yaml({"hardware": identified.hardware.model_dump(mode="json")}),
        **({"posterior.yaml": ensemble_of(found).to_yaml()} if found.known else {}),
        FILE: json.dumps(_result(found, asked), indent=2) + "\n",
    }
    return texts | {
        "residuals": Picture(RESIDUALS, lambda: plot_residuals(found)),
        "autocorrelation": Picture(CORRELATION, lambda: plot_correlation(found)),
        "prediction": Picture(PREDICTION, lambda: plot_prediction(found)),
    }


def identified_scenario(found: Identified, scenario: mc.Scenario, folder: Path) -> mc.Scenario:
    """Return the scenario with what was identified; a robot that was is written into the folder."""
    scenario = scenario.with_overrides(found.overrides())
    if any(key.startswith("robot.") for key in found.estimates):
        section = robot_files.write(found.scenario.robot, found.robot(), folder / "robot.xml")
        scenario = scenario.with_overrides({"robot": section})
    return scenario


def ensemble_of(found: Identified) -> Ensemble:
    """Return the ensemble whose members are drawn from the posterior; all else is the scenario's own."""
    of_scenario = set(KEYS.values()) | set(TILTS)
    told = {key: each for key, each in {**found.beside, **found.estimates}.items() if each.low is not None}
    chosen = [n for n, v in enumerate(found.model.variables) if v.key in of_scenario and v.key in told]
    variables = [found.model.variables[n] for n in chosen]
    lower = [max(v.lower, 0.0) if v.unit == "s" else v.lower for v in variables]
    return Ensemble(
        pushes=None, cargo=None, gravity=None, grip_stiffness=(1.0, 1.0), robot_mass=(1.0, 1.0),
        posterior=Posterior(
            keys=tuple(v.key for v in variables), log=tuple(v.log for v in variables),
            mean=tuple(found.fitted.x[chosen].tolist()),
            covariance=tuple(map(tuple, found.posterior.covariance[np.ix_(chosen, chosen)].tolist())),
            lower=tuple(lower), upper=tuple(v.upper for v in variables),
            held=tuple(key for key in found.estimates if key not in of_scenario and not key.startswith("log.")),
        ),
    )  # fmt: skip


def _yaml(data: Any) -> str:
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=110)


def _result(found: Identified, command: str) -> dict[str, Any]:
    made = dataset.provenance(found.scenario)
    made.pop("scenario")
    told = {
        name: {k: dataclasses.asdict(e) for k, e in getattr(found, name).items()} for name in ("estimates", "beside")
    }
    noise = dict(zip(found.model.windows.names, found.fitted.noise.tolist(), strict=True))
    own = {"noise": noise, "clock": found.fitted.clock, "mass": found.model.structure.mass}
    more = {"combined": list(found.combined), **own}
    made_of = {"log": found.log.source, "log_sha256": found.log.digest, "command": command, "provenance": made}
    return found.as_json() | told | more | made_of


# ----------------------------------------------------------------------------------------------- tables, page, pictures


def table(found: Identified) -> page.Table:
    """Return what was fitted: before, after, interval, and bound or prior where one was reached."""
    beside = {key: each for key, each in found.beside.items() if each.seen}
    sections = [("", _rows(found.estimates)), ("beside these", _rows(beside))]
    return page.Table("Parameters", COLUMNS, [(name, rows) for name, rows in sections if rows])


def _rows(estimates: Mapping[str, Estimate]) -> list[list[str]]:
    return [
        [key, e.unit, number(e.before), number(e.value),
         "none" if e.low is None or e.high is None else f"{number(e.low)} to {number(e.high)}",
         e.remark or ("" if e.seen else "not told")]
        for key, e in estimates.items()
    ]  # fmt: skip


def noise_table(found: Identified) -> page.Table:
    """Return the noise of each signal, how what was held out is predicted, and what its residuals look like."""
    by_signal, rows = found.held_out.get("signals", {}), []
    wrong = {test.signal: test for test in suspicious(found.tests)}
    for n, name in enumerate(found.model.windows.names):
        kind = KINDS[found.model.windows.kind[n]]
        test = wrong.get(name)
        said = "" if test is None else f"{np.abs(test.correlation).max():.2f}"
        held = by_signal.get(name)
        rows.append([name, UNITS[KINDS.index(kind)], number(float(found.fitted.noise[n])),
                     "" if held is None else f"{held:.3f}", said])  # fmt: skip
    columns = ("signal", "unit", "noise", "error over noise, held out", "correlation")
    return page.Table("Signals", columns, [("", rows)])


def page_of(found: Identified, origin: page.Origin) -> page.Page:
    """Return the page of a result."""
    prose = {"What the log tells of combinations": list(found.combined)} if found.combined else {}
    return page.Page(
        title=f"Identified from {Path(found.log.source).name}", origin=origin, verdict=f"{found.sentence}.",
        scenario=found.scenario, notes=found.warnings, tables=[table(found), noise_table(found)], prose=prose,
        facts={"iterations": found.fitted.iterations, "windows": len(found.model.windows.begin)},
    )  # fmt: skip


def _times(found: Identified) -> np.ndarray:
    rows, windows = found.problem.rows, found.model.windows
    return np.asarray(windows.begin[rows.window] + (rows.step + rows.share) * windows.time_step)


@plots.style()
def plot_residuals(found: Identified) -> Figure:
    """Return residuals over time by kind of signal."""
    rows, windows, time = found.problem.rows, found.model.windows, _times(found)
    scaled = scaled_residuals(found.problem, found.fitted.normal)
    kinds = sorted(set(windows.kind))
    figure = Figure(figsize=(7.0, 1.6 * len(kinds) + 0.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(kinds), sharex=True))
    held = windows.held_out[rows.window]
    for axis, kind in zip(axes, kinds, strict=True):
        own = windows.kind[rows.signal] == kind
        for chosen, colour in ((own & ~held, plots.BLUE), (own & held, "0.75")):
            axis.plot(time[chosen], scaled[chosen], ",", color=colour)
        axis.set_ylabel(f"{KINDS[kind]}, 1")
        axis.set_ylim(-6, 6)
    axes[-1].set_xlabel("time, s")
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

    Two seconds are shown, and below what the model misses of the log, in units of the noise.
    """
    rows, windows, time = found.problem.rows, found.model.windows, _times(found)
    scaled = np.abs(scaled_residuals(found.problem, found.fitted.normal))
    means = [float(scaled[rows.signal == n].mean()) for n in range(len(windows.names))]
    worst = int(np.argmax(means))
    own = np.flatnonzero(rows.signal == worst)
    own = own[np.argsort(time[own], kind="stable")]
    first = begin(found.model.variables)[None]
    missed = {
        "before": found.problem.linearized(first, found.fitted.start[None])[0].residuals[own],
        "after": found.fitted.normal.residuals[own],
    }
    middle = time[own][int(np.argmax(np.abs(missed["after"])))]
    shown = np.abs(time[own] - np.clip(middle, time[own][0] + SHOWN / 2, time[own][-1] - SHOWN / 2)) <= SHOWN / 2
    own, missed = own[shown], {name: values[shown] for name, values in missed.items()}
    gap = np.flatnonzero(np.diff(time[own]) > 5 * np.median(np.diff(time[own]))) + 1  # lines break in holes

    def broken(values: np.ndarray) -> np.ndarray:
        return np.insert(values, gap, np.nan)

    name, kind = windows.names[worst], int(windows.kind[worst])
    noise = float(found.fitted.noise[worst])
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    above, below = figure.subplots(2, sharex=True, height_ratios=(2, 1))
    for label, look in _MODELS.items():
        above.plot(broken(time[own]), broken(rows.value[own] - missed[label]), label=f"model, {label}", **look)
        below.plot(broken(time[own]), broken(missed[label] / noise), **look)
    above.plot(time[own], rows.value[own], ".", color="black", markersize=2, label="log", zorder=3)
    below.axhspan(-2, 2, color="0.9", zorder=0)
    above.set_ylabel(f"{name} [{UNITS[kind]}]")
    below.set(xlabel="time [s]", ylabel="log - model [noise]")
    below.set_yscale("symlog", linthresh=10.0)
    figure.legend(*above.get_legend_handles_labels(), ncols=3, loc="outside upper center")
    return figure
