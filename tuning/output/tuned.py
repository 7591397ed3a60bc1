"""What a search for gains leaves in a folder: gains, all that was judged, verification, map, pictures and report."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb import plots
from mjx_climb.control import PD
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.files import dataset
from tuning.gains import gains_file
from tuning.judged import maps, margins, verification
from tuning.judged.verification import Verification
from tuning.output.folder import complete, made_from, write_config
from tuning.output.stages import Stage, silent
from tuning.problem.objectives import Goal, Judge
from tuning.report import page, search_pictures
from tuning.report import tune as pages
from tuning.report.comparison import Compared, gains_of
from tuning.report.margin_pictures import plot_margins
from tuning.report.numbers import to_json
from tuning.searches import finished_parts, retuned_pd
from tuning.searches.result import Result
from tuning.searches.retuned_pd import Worth
from tuning.searches.tune import problem_of

FILES = (
    "report.html, gains.yaml, search.nc, map.nc, summary.json, convergence, path, walks, margins (.png, .svg, .pdf), "
    "config.yaml, search.yaml"
)


class Judged(NamedTuple):
    """A result beside the scenario's own gains and pd, walked in double precision, and what its tests found."""

    walks: Mapping[str, mc.Trajectory]  # pd, config, tuned, retuned_pd
    compared: Compared  # tuned, retuned_pd, config, pd
    checked: Verification
    outcome: list[str]  # of the tests, in lines
    summary: str  # all of it, JSON


def write_settings(folder: Path, scenario: mc.Scenario, search_yaml: str) -> mc.Scenario:
    """Write what repeats a search, and return the scenario with the files that it names copied to the folder."""
    scenario = write_config(scenario, folder)
    dataset.write_text_atomically(folder / "search.yaml", search_yaml)
    return scenario


def write_found(found: Result, folder: Path, comment: str, law: mc.Law | None = None) -> None:
    """Write the gains (gains.yaml) and all that was judged (search.nc), without walking anything."""
    gains_file.save(found.gains, folder / "gains.yaml", comment, law)
    found.save(folder / "search.nc")


def write(
    found: Result,
    folder: Path,
    *,
    law: mc.Law | None = None,
    origin: page.Origin | None = None,
    function: Judge | None = None,
    engine: str = DEFAULT_ENGINE,
    stage: Stage = silent,
) -> Judged:
    """Walk, test and draw a result, and write all of it with the report; pd is retuned for the same goal beside it.

    Arguments:
        found: the result.
        folder: where to.
        law: the one whose gains were searched, as it was before, where it is not the scenario's.
        origin: what the report says of where it comes from.
        function: the objective of the user's own, where the search had one.
        engine: the dynamics.
        stage: told what goes on, see `tuning.output.stages`.

    Raises:
        OutputError: a file cannot be written.
    """
    scenario = write_settings(folder, found.scenario, found.search.to_yaml())
    again = "mjx-climb tune config.yaml --search search.yaml --out again"
    origin = complete(origin, "tune(...)", again, scenario, folder)
    found = dataclasses.replace(found, scenario=scenario, history=made_from(found.history, scenario))
    comment = f"{found.search.method}, {found.search.space}, objective {found.value:.4f} (pd: 1)"
    write_found(found, folder, f"mjx-climb tune {origin.name}: {comment}", law)
    target = problem_of(
        found.scenario, found.search, function, engine=engine, law=found.law, metrics=found.judged_by
    ).objective
    kept = (folder / finished_parts.FOLDER).is_dir()  # as the rounds of the search itself
    with stage("retuned pd", unit="rounds") as told:
        retuned = retuned_pd.search(
            found, objective=function or target, engine=engine, out=folder if kept else None,
            progress=lambda now: told(now.rounds, now.rounds_in_all),
        )  # fmt: skip
    scenarios = {"pd": retuned_pd.under_pd(scenario), "config": scenario, "tuned": verification.tuned(found)}
    if retuned is not None:
        scenarios[retuned_pd.NAME] = verification.tuned(retuned)
    laws, walks = {"config": law, "tuned": found.law}, {}
    for name, walked in scenarios.items():
        with stage(name):
            walks[name] = mc.rollout(walked, law=laws.get(name), engine=engine)
    metrics = {name: mc.metrics(trajectory, found.judged_by) for name, trajectory in walks.items()}
    with stage("map") as told:
        over = verification.map_of(found, progress=told, engine=engine)
    with stage("margins") as told:
        hardware = margins.find(
            scenario, found.gains, law=found.law, others=_rivals(law, retuned), engine=engine, progress=told
        )
    with stage("verification"):
        checked = verification.verify(
            found, metrics=metrics["tuned"], walks=over, hardware=hardware, function=function, engine=engine
        )
    order = [name for name in ("tuned", retuned_pd.NAME, "config", "pd") if name in walks]
    compared = {name: (_with_joint_gains(walks[name]), metrics[name]) for name in order}
    worth = None
    if retuned is not None:
        compared[retuned_pd.NAME] = (_joint(retuned), metrics[retuned_pd.NAME])
        worth = retuned_pd.worth(_scored(target, metrics["tuned"]), _scored(target, metrics[retuned_pd.NAME]), retuned)
    summary = _summary(found, checked, compared, worth)
    dataset.write_text_atomically(folder / "summary.json", summary + "\n")
    captions = {
        "convergence": "How the search converged.",
        "walks": "The walks over time: red crosses mark a torn gripper, shading a disturbance.",
        "path": "The way of the search over the map; the red line is the limit of stability.",
        "margins": "Force variation on worse hardware: a curve ends where a gripper is torn off, or the walk diverges.",
    }
    with stage("drawing", compiles=False):
        figures = {
            "convergence": search_pictures.plot_convergence(found),
            "walks": plots.plot_comparison(walks),
            "margins": plot_margins(hardware, "tuned"),
        }
        if over is not None:
            dataset.save(over, folder / "map.nc")
            figures["path"] = search_pictures.plot_path(found, over)
        for name, figure in figures.items():
            plots.save_figure(figure, folder / name)
    outcome = outcome_of(checked, found)
    if worth is not None:
        outcome.insert(0, worth.in_words)
    if broken := verification.broken_limits(target, metrics["config"]):
        outcome.append(f"the config's own gains break limits: {'; '.join(broken)}")
    with stage("report", compiles=False):
        written = pages.page(
            found, checked, over, {name: walks[name] for name in compared}, compared,
            outcome=[line[0].upper() + line[1:] for line in outcome],
            origin=origin,
            pictures={captions[name]: folder / f"{name}.svg" for name in figures},
        )  # fmt: skip
        page.write(written, folder)
    retuned_pd.forget(folder)
    return Judged(walks, compared, checked, outcome, summary)


def _with_joint_gains(walk: mc.Trajectory) -> dict[str, Any] | None:
    """Return the gains of a walk, those of the joint loop last; None where its controller has none."""
    gains, control = gains_of(walk), walk.scenario.control
    return None if gains is None else gains | {name: getattr(control, name) for name in ("kp", "kd")}


def _rivals(law: mc.Law | None, retuned: Result | None) -> dict[str, margins.Walker]:
    """Return who walks beside a result and pd on worse hardware: the config's own gains, and pd retuned."""
    rivals = {"config": margins.Walker(law, {})}
    return rivals if retuned is None else rivals | {"retuned pd": margins.Walker(PD(), _joint(retuned))}


def _joint(retuned: Result) -> dict[str, float]:
    """Return kp and kd alone: pd has no other gains."""
    gains = gains_file.by_name(retuned.gains)
    return {name: float(gains[name]) for name in ("kp", "kd")}


def _scored(target: Goal, metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return what gains are compared by."""
    variation = metrics["force_variation"]
    score = float(maps.score_of(target, metrics).value)
    return {"objective": score, "force_variation": np.nan if variation is None else float(variation)}


def _summary(found: Result, checked: Verification, compared: Compared, worth: Worth | None) -> str:
    summary: dict[str, Any] = {
        name: {"gains": gains, "metrics": metrics} for name, (gains, metrics) in compared.items()
    }
    summary["search"] = {
        **found.search.model_dump(mode="json"), "objective": found.value, "feasible": found.feasible,
        "env_steps": found.env_steps, "env_steps_at_best": found.best_at,
    }  # fmt: skip
    if worth is not None:
        summary["force_sensor"] = worth._asdict()
    summary["verification"] = {**dataclasses.asdict(checked), "passed": checked.passed}
    return to_json(summary)


def outcome_of(checked: Verification, found: Result) -> list[str]:
    """Return the outcome of the tests in a few lines."""
    limits = "keeps every limit" if checked.passed else "breaks limits: " + "; ".join(checked.broken_limits)
    lines = [f"verification: alone in float64 objective {checked.value:.4f} (pd: 1); {limits}"]
    if checked.binding_limits:
        lines.append(f"held by its limits: {'; '.join(checked.binding_limits)}")
    kinds = {kind: [n for n, k in checked.shape.items() if k == kind] for kind in ("plateau", "slope", "cliff")}
    lines.append("within 20 %: " + "; ".join(f"{kind} in {', '.join(n)}" for kind, n in kinds.items() if n))
    steepest = max(checked.slopes, key=lambda name: abs(checked.slopes[name]))
    lines.append(f"steepest slope: {checked.slopes[steepest]:+.3g} per unit of log {steepest}")
    if checked.grid_value is not None:
        lines.append(f"best cell of an isotropic grid: {checked.grid_value:.4f}, the search: {found.value:.4f}")
    for name, margin in checked.margins.items():
        holds, better = (margins.in_words(name, margin.worst, reached) for reached in (margin.holds, margin.better))
        lines.append(f"margin, {margins.QUANTITIES[name].title}: holds up to {holds}, better than pd up to {better}")
    lines.append(f"closed loop about the stance: largest eigenvalue {checked.spectral_radius:.6f} (below 1: stable)")
    return lines + [f"warning: {line}" for line in checked.warnings]
