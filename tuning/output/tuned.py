"""What a search for gains leaves in a folder: gains, all that was judged, verification, map, pictures and report."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import xarray as xr

import mjx_climb as mc
from mjx_climb import plots
from mjx_climb.files import dataset
from tuning.gains import gains_file
from tuning.judged import verification
from tuning.judged.verification import Verification
from tuning.output.folder import complete, made_from, write_config
from tuning.output.stages import Stage, silent
from tuning.problem.evaluation import Problem
from tuning.report import page, search_pictures
from tuning.report import tune as pages
from tuning.report.comparison import Compared, gains_of
from tuning.report.numbers import to_json
from tuning.searches import finished_parts
from tuning.searches.result import Result

FILES = (
    "report.html, gains.yaml, search.nc, map.nc, summary.json, convergence, path, walks (.png, .svg, .pdf), "
    "config.yaml, search.yaml"
)
CAPTIONS = {
    "convergence": "How the search converged.",
    "walks": "The walks over time: red crosses mark a torn gripper, shading a disturbance.",
    "path": "The way of the search over the map; the red line is the limit of stability.",
}


class Judged(NamedTuple):
    """A result beside the scenario's own gains and pd, walked in double precision, and what its tests found."""

    walks: Mapping[str, mc.Trajectory]  # pd, config, tuned
    compared: Compared  # tuned, config, pd
    over: xr.Dataset | None  # the map around it
    checked: Verification
    outcome: list[str]  # of the tests, in lines
    summary: str  # all of it, JSON
    files: str = FILES  # that are written


@dataclasses.dataclass(frozen=True)
class Tuned(Result):
    """The result of a search for gains, and what was searched."""

    problem: Problem = dataclasses.field(kw_only=True)

    def write(
        self, folder: str | os.PathLike[str], *, origin: page.Origin | None = None, stage: Stage = silent
    ) -> Judged:
        """Walk, test and draw the result, and write what `mjx-climb tune` writes: gains, map, pictures, report.

        Arguments:
            folder: where to; it is made. Rounds that `tune(out=folder)` kept there are removed.
            origin: what the report says of where it comes from.
            stage: told what goes on, see `tuning.output.stages`; nothing is printed.

        Returns:
            The walks, their metrics side by side and the outcome of the tests.

        Raises:
            OutputError: a file cannot be written.
        """
        folder = Path(folder)
        found = self.write_found(folder, "from Python" if origin is None else origin.name)
        again = "mjx-climb tune config.yaml --search search.yaml --out again"
        origin = complete(origin, "tune(...)", again, found.scenario, folder)
        judged = judge(found, stage)
        dataset.write_text_atomically(folder / "summary.json", judged.summary + "\n")
        if judged.over is not None:
            dataset.save(judged.over, folder / "map.nc")
        with stage("drawing", compiles=False):
            pictures = _draw(found, judged, folder)
        with stage("report", compiles=False):
            shown = {name: judged.walks[name] for name in judged.compared}
            written = pages.page(
                found, judged.checked, judged.over, shown, judged.compared,
                outcome=[line[0].upper() + line[1:] for line in judged.outcome],
                origin=origin,
                pictures=pictures,
            )  # fmt: skip
            page.write(written, folder)
        finished_parts.clear(folder)
        return judged

    def write_found(self, folder: Path, name: str) -> Self:
        """Write scenario, settings, gains and all that was judged, without walking anything.

        Returns:
            The result, of the scenario with the files that it names copied to the folder.
        """
        scenario = write_config(self.scenario, folder)
        found = dataclasses.replace(self, scenario=scenario, history=made_from(self.history, scenario))
        dataset.write_text_atomically(folder / "search.yaml", self.search.to_yaml())
        comment = f"{self.search.method}, {self.search.space}, objective {self.value:.4f} (pd: 1)"
        gains_file.save(self.gains, folder / "gains.yaml", f"mjx-climb tune {name}: {comment}", self.problem.law)
        found.save(folder / "search.nc")
        return found


def judge(found: Tuned, stage: Stage = silent) -> Judged:
    """Walk a result, what it is compared with and the map around it, and test it."""
    scenario, problem = found.scenario, found.problem
    pd = scenario.with_overrides({"control.controller": "pd", "control.reading": "virtual_model"})
    walkers = {"pd": (pd, None), "config": (scenario, problem.law), "tuned": (verification.tuned(found), found.law)}
    walks = {}
    for name, (walked, law) in walkers.items():
        with stage(name):
            walks[name] = mc.rollout(walked, law=law, engine=problem.engine)
    metrics = {name: mc.metrics(trajectory, found.judged_by) for name, trajectory in walks.items()}
    with stage("map") as told:
        over = verification.map_of(found, problem, progress=told)
    with stage("verification"):
        checked = verification.verify(found, problem, metrics=metrics["tuned"], walks=over)
    compared = {name: (_with_joint_gains(walks[name]), metrics[name]) for name in ("tuned", "config", "pd")}
    outcome = outcome_of(checked, found)
    if broken := verification.broken_limits(problem.objective, metrics["config"]):
        outcome.append(f"the config's own gains break limits: {'; '.join(broken)}")
    return Judged(walks, compared, over, checked, outcome, _summary(found, checked, compared))


def _draw(found: Result, judged: Judged, folder: Path) -> dict[str, Path]:
    """Draw the pictures of a result and return the files of the page by their captions."""
    figures = {
        "convergence": search_pictures.plot_convergence(found),
        "walks": plots.plot_comparison(judged.walks),
    }
    if judged.over is not None:
        figures["path"] = search_pictures.plot_path(found, judged.over)
    for name, figure in figures.items():
        plots.save_figure(figure, folder / name)
    return {CAPTIONS[name]: folder / f"{name}.svg" for name in figures}


def _with_joint_gains(walk: mc.Trajectory) -> dict[str, Any] | None:
    """Return the gains of a walk, those of the joint loop last; None where its controller has none."""
    gains, control = gains_of(walk), walk.scenario.control
    return None if gains is None else gains | {name: getattr(control, name) for name in ("kp", "kd")}


def _summary(found: Result, checked: Verification, compared: Compared) -> str:
    summary: dict[str, Any] = {
        name: {"gains": gains, "metrics": metrics} for name, (gains, metrics) in compared.items()
    }
    summary["search"] = {
        **found.search.model_dump(mode="json"), "objective": found.value, "feasible": found.feasible,
        "env_steps": found.env_steps, "env_steps_at_best": found.best_at,
    }  # fmt: skip
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
    lines.append(f"closed loop about the stance: largest eigenvalue {checked.spectral_radius:.6f} (below 1: stable)")
    return lines + [f"warning: {line}" for line in checked.warnings]
