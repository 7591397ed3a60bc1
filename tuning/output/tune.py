"""What a search for gains leaves in a folder: gains, all points, verification, map, pictures and report."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb import plots
from mjx_climb.control import PD
from tuning.background import Callback, background, ignore
from tuning.evaluation import maps, margins, verification
from tuning.evaluation.verification import Verification
from tuning.output.comparisons import CONVERGENCE, OfSearch, Retuned, beside_retuned, of_search, one_walk
from tuning.output.folder import Contents, Folder
from tuning.problem.objectives import Goal
from tuning.report import pages, pictures
from tuning.report.comparison import Compared, differences, gains_of
from tuning.report.numbers import failed, remarks, to_json
from tuning.searches import retuned_pd
from tuning.searches.result import Tuned, Written
from tuning.searches.retuned_pd import Worth

Metrics = Mapping[str, Any]  # of one walk, as `mjx_climb.metrics` gives them
WALKS = "The walks over time: red crosses mark a torn gripper, shading a disturbance."
PATH = "The way of the search over the map; the red line is the limit of stability."
MARGINS = "Force variation on worse hardware: a curve ends where a gripper is torn off, or the walk diverges."


def tune(found: Tuned, folder: Folder, begun: OfSearch | None = None) -> Contents:
    """Simulate, test and draw the result, with the contents that `mjx-climb tune` writes."""
    found = folder.found(found)
    compared = compare(found, folder, begun)
    over, rows, checked = compared.over, compared.rows, compared.checked
    outcome, tests = compared.outcome(found), outcome_of(checked, found) + _turns(found, compared.walks["tuned"])
    summary = _summary(found, checked, rows, compared.worth)
    files: dict[str, Any] = {"summary.json": summary + "\n"}
    drawn: dict[str, Any] = {"margins": (MARGINS, lambda: pictures.plot_margins(compared.hardware, "tuned"))}
    if over is not None:
        files["map.nc"] = over
        drawn["path"] = PATH, lambda: pictures.plot_path(found, over)
    return Contents(
        Written(walks=compared.walks, compared=rows, data=over, outcome=outcome + tests, summary=summary),
        files,
        drawn,
        lambda origin: pages.tune_page(found, compared, outcome, tests, origin),
        "mjx-climb tune config.yaml --search search.yaml --out again",
    )


class Comparison(NamedTuple):
    """A result beside the scenario's own gains and pd, walked in double precision, and what its tests found."""

    walks: Mapping[str, mc.Trajectory]  # pd, config, tuned, retuned_pd
    rows: Compared  # tuned, retuned_pd, config, pd
    over: xr.Dataset | None  # the map around it
    hardware: margins.Found  # on worse hardware
    checked: Verification
    worth: Worth | None  # of a force sensor: the result against pd retuned

    def outcome(self, found: Tuned) -> list[str]:
        """Return in lines what the sensor is worth, and warnings."""
        metrics = {name: row[1] for name, row in self.rows.items()}
        lines = [] if self.worth is None else [self.worth.in_words]
        lines += [f"warning: {line}" for line in self.checked.warnings]
        if broken := verification.broken_limits(found.problem.objective, metrics["config"]):
            lines.append(f"the config's own gains break limits: {'; '.join(broken)}")
        return lines + remarks(metrics)


def compare(found: Tuned, folder: Folder, begun: OfSearch | None = None) -> Comparison:
    """Simulate a result, what it is compared with and the map around it, and test it; draw the walks meanwhile."""
    scenario, problem, stage = found.scenario, found.problem, folder.stage
    ours, engine = (verification.tuned(found), found.law), problem.engine
    with background() as begin:
        tested = begin(lambda _: verification.tests(found, problem))  # the longest to compile
        others = begun or of_search(problem, found.search, begin, out=folder.path)
        mapped = others.over or begin(lambda told: verification.map_of(found, problem, progress=told))
        walking = {**others.walks, "tuned": begin(one_walk(*ours, engine))}
        with stage("retuned pd", unit="rounds") as told:
            retuned = others.retuned(told)
        rivals, beside = {"config": margins.Walker(problem.law, {})}, None
        if retuned is not None:
            joint = retuned_pd.joint_of(retuned)
            beside = beside_retuned(scenario, joint, ours, engine, begin)
            walking[retuned_pd.NAME] = beside.walk
            if beside.step is None:
                rivals["retuned pd"] = margins.Walker(PD(), joint)

        def find_margins(told: Callback) -> margins.Found:
            walked = {name: asked(ignore) for name, asked in others.on_hardware.items()}  # begun before this
            how: dict[str, Any] = {"law": found.law, "engine": engine}
            return margins.find(scenario, found.gains, others=rivals, walked=walked, progress=told, **how)

        margin, walks = begin(find_margins), {}
        for name, walk in walking.items():
            with stage(name) as told:
                walks[name] = walk(told)
        metrics = {name: mc.metrics(trajectory, problem.metrics) for name, trajectory in walks.items()}
        folder.draw(
            {
                "convergence": (CONVERGENCE, lambda: pictures.plot_convergence(found)),
                "walks": (WALKS, lambda: plots.plot_comparison(walks)),
            }
        )
        with stage("map") as told:
            over = mapped(told)
        with stage("margins") as told:
            hardware = margin(told)
        with stage("verification"):
            checked = verification.verify(
                found, problem, metrics=metrics["tuned"], walks=over, hardware=hardware, tested=tested(ignore)
            )
        worth = None if retuned is None or beside is None else _worth(found, retuned, metrics, beside)
    order = [name for name in ("tuned", retuned_pd.NAME, "config", "pd") if name in walks]
    gains = {name: _with_joint_gains(walks[name]) for name in order} | (
        {} if worth is None else {retuned_pd.NAME: joint}
    )
    return Comparison(walks, {name: (gains[name], metrics[name]) for name in order}, over, hardware, checked, worth)


def _worth(found: Tuned, retuned: Tuned, metrics: Mapping[str, Metrics], beside: Retuned) -> Worth:
    problem, theirs = found.problem, metrics[retuned_pd.NAME]
    ours = metrics["tuned"] if beside.level is None else mc.metrics(beside.level(ignore), problem.metrics)
    values, without = (_scored(problem.objective, each) for each in (ours, theirs))
    others = differences(ours, theirs, problem.metrics, but=("force_variation",))
    return retuned_pd.worth(values, without, retuned_pd.rival_of(found, retuned, beside.step), others=others)


def _turns(found: Tuned, walk: mc.Trajectory) -> list[str]:
    """Return what isotropic gains mean for rotations: nothing much, where the law shifts the base."""
    if found.search.space != "isotropic" or not np.any(walk.base_displacement):
        return []
    moved = np.linalg.norm(walk.base_displacement.reshape(-1, 2, 3), axis=-1)
    shift, turn = 1e3 * np.nanmax(moved, axis=0)
    return [
        "one number for N/m and N m/rad alike makes rotations far stiffer at the feet than translations: the law "
        f"shifts the base by up to {shift:.2g} mm and turns it by {turn:.2g} mrad; --space split tunes both"
    ]


def _with_joint_gains(walk: mc.Trajectory) -> dict[str, Any] | None:
    """Return the gains of a walk, those of the joint loop last; None where its controller has none."""
    gains, control = gains_of(walk), walk.scenario.control
    return None if gains is None else gains | {name: getattr(control, name) for name in ("kp", "kd")}


def _scored(target: Goal, metrics: Metrics) -> dict[str, float]:
    """Return what gains are compared by."""
    variation = metrics["force_variation"]
    if variation is None or failed(metrics):
        return {"objective": np.nan, "force_variation": np.nan}
    return {"objective": float(maps.score_of(target, metrics).value), "force_variation": float(variation)}


def _summary(found: Tuned, checked: Verification, compared: Compared, worth: Worth | None) -> str:
    goal = found.problem.objective
    summary: dict[str, Any] = {
        name: {"gains": gains, "metrics": metrics, "broken_limits": verification.broken_limits(goal, metrics)}
        for name, (gains, metrics) in compared.items()
    }
    summary["search"] = {
        **found.search.model_dump(mode="json"), "objective": found.value, "feasible": found.feasible,
        "env_steps": found.env_steps, "env_steps_at_best": found.best_at,
    }  # fmt: skip
    summary |= {} if worth is None else worth.summary
    summary["verification"] = {**dataclasses.asdict(checked), "passed": checked.passed}
    return to_json(summary)


def outcome_of(checked: Verification, found: Tuned) -> list[str]:
    """Return the outcome of the tests in a few lines, without their warnings."""
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
    lines.append(f"closed loop in its worst stance: largest eigenvalue {checked.spectral_radius:.6f} (below 1: stable)")
    return lines
