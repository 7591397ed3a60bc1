"""What a search for gains leaves in a folder: gains, all that was judged, verification, map, pictures and report."""

import dataclasses
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb import plots
from mjx_climb.control import PD
from mjx_climb.files import dataset
from tuning.judged import maps, margins, verification
from tuning.judged.verification import Verification
from tuning.output.ahead import ahead, to_nobody
from tuning.output.beside_search import Beside, beside
from tuning.output.folder import complete
from tuning.output.found import draw, write_gains
from tuning.output.stages import Stage, Told, silent
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Goal
from tuning.report import page, search_pictures
from tuning.report import tune as pages
from tuning.report.comparison import Compared, differences, gains_of
from tuning.report.margin_pictures import plot_margins
from tuning.report.numbers import to_json
from tuning.report.remarks import failed, remarks
from tuning.searches import finished_parts, retuned_pd
from tuning.searches.result import Result
from tuning.searches.retuned_pd import Worth

FILES = (
    "report.html, gains.yaml, search.nc, map.nc, summary.json, convergence.png, path.png, walks.png, margins.png, "
    "config.yaml, search.yaml"
)
CAPTIONS = {
    "convergence": "How the search converged.",
    "walks": "The walks over time: red crosses mark a torn gripper, shading a disturbance.",
    "path": "The way of the search over the map; the red line is the limit of stability.",
    "margins": "Force variation on worse hardware: a curve ends where a gripper is torn off, or the walk diverges.",
}


class Judged(NamedTuple):
    """A result beside the scenario's own gains and pd, walked in double precision, and what its tests found."""

    walks: Mapping[str, mc.Trajectory]  # pd, config, tuned, retuned_pd
    compared: Compared  # tuned, retuned_pd, config, pd
    over: xr.Dataset | None  # the map around it
    hardware: margins.Found  # on worse hardware
    checked: Verification
    outcome: list[str]  # in lines: what the sensor is worth, warnings, and then `tests`
    tests: list[str]  # what the tests found that warns of nothing
    summary: str  # all of it, JSON
    files: str = FILES  # that are written


@dataclasses.dataclass(frozen=True)
class Tuned(Result):
    """The result of a search for gains, and what was searched."""

    problem: Problem = dataclasses.field(kw_only=True)
    beside: Beside | None = dataclasses.field(default=None, kw_only=True, repr=False, compare=False)  # if begun already

    def write(
        self,
        folder: str | os.PathLike[str],
        *,
        origin: page.Origin | None = None,
        figures: Collection[str] = ("png",),
        stage: Stage = silent,
    ) -> Judged:
        """Walk, test and draw the result, and write what `mjx-climb tune` writes: gains, map, pictures, report.

        pd is retuned for the same goal beside it; the arguments are those of `tuning.output.swept.Swept.write`.

        Returns:
            The walks, their metrics side by side and the outcome of the tests.

        Raises:
            OutputError: a file cannot be written.
        """
        folder = Path(folder)
        found = self.write_found(folder, "from Python" if origin is None else origin.name)
        again = "mjx-climb tune config.yaml --search search.yaml --out again"
        origin = complete(origin, "tune(...)", again, folder)
        drawn, formats = {}, {"png", *figures}

        def meanwhile(walks: Mapping[str, mc.Trajectory]) -> None:
            drawn.update(draw(_of_the_walks(found, walks), folder, formats, stage))

        judged = judge(found, stage, meanwhile, out=folder)
        dataset.write_text_atomically(folder / "summary.json", judged.summary + "\n")
        if judged.over is not None:
            dataset.save(judged.over, folder / "map.nc")
        drawn.update(draw(_of_the_tests(found, judged), folder, formats, stage))
        with stage("report", compiles=False):
            shown = {name: judged.walks[name] for name in judged.compared}
            written = pages.page(
                found, judged.checked, judged.over, shown, judged.compared,
                outcome=_sentences(judged.outcome[: -len(judged.tests)]),
                tests=_sentences(judged.tests),
                origin=origin,
                pictures={CAPTIONS[name]: file for name, file in drawn.items()},
            )  # fmt: skip
            page.write(written, folder)
        finished_parts.clear(folder)
        return judged

    def write_found(self, folder: Path, name: str) -> Self:
        """Write what `tuning.output.found.write_gains` does, and return what it returns."""
        comment = f"{self.search.method}, {self.search.space}, objective {self.value:.4f} (pd: 1)"
        return write_gains(self, folder, f"mjx-climb tune {name}: {comment}", self.problem)


def judge(
    found: Tuned,
    stage: Stage = silent,
    meanwhile: Callable[[Mapping[str, mc.Trajectory]], None] = to_nobody,
    *,
    out: Path | None = None,
) -> Judged:
    """Walk a result, what it is compared with and the map around it, and test it.

    `meanwhile` is given the walks while the tests go on; `out` is as of `beside`.
    """
    scenario, problem = found.scenario, found.problem
    how: dict[str, Any] = {"law": found.law, "engine": problem.engine}
    with ahead() as begin:
        tested = begin(lambda _: verification.tests(found, problem))  # the longest to compile
        retuned_alone, compared_with, over_all, on_hardware = found.beside or beside(
            problem, found.search, begin, out=out
        )
        mapped = over_all or begin(lambda told: verification.map_of(found, problem, progress=told))
        walking = {**compared_with, "tuned": begin(lambda _: mc.rollout(verification.tuned(found), **how))}
        with stage("retuned pd", unit="rounds") as told:
            retuned = retuned_alone(told)
        rivals, level, step = {"config": margins.Walker(problem.law, {})}, None, None
        if retuned is not None:
            joint = retuned_pd.joint_of(retuned)
            alone = retuned_pd.walker(scenario, joint)
            walking[retuned_pd.NAME] = begin(lambda _: mc.rollout(alone, engine=problem.engine))
            if alone.time_step == scenario.time_step:
                rivals["retuned pd"] = margins.Walker(PD(), joint)
            else:  # as short for both that are compared
                step = alone.time_step
                shorter = verification.tuned(found).with_overrides({"time_step": step})
                level = begin(lambda _: mc.rollout(shorter, **how))

        def find_margins(told: Told) -> margins.Found:
            walked = {name: asked(to_nobody) for name, asked in on_hardware.items()}  # begun before this
            return margins.find(scenario, found.gains, others=rivals, walked=walked, progress=told, **how)

        margin = begin(find_margins)
        walks = {}
        for name, walk in walking.items():
            with stage(name) as told:
                walks[name] = walk(told)
        metrics = {name: mc.metrics(trajectory, found.judged_by) for name, trajectory in walks.items()}
        ours = metrics["tuned"] if level is None else mc.metrics(level(to_nobody), found.judged_by)
        meanwhile(walks)
        with stage("map") as told:
            over = mapped(told)
        with stage("margins") as told:
            hardware = margin(told)
        with stage("verification"):
            checked = verification.verify(
                found, problem, metrics=metrics["tuned"], walks=over, hardware=hardware, tested=tested(to_nobody)
            )
    order = [name for name in ("tuned", retuned_pd.NAME, "config", "pd") if name in walks]
    compared = {name: (_with_joint_gains(walks[name]), metrics[name]) for name in order}
    outcome, worth = [f"warning: {line}" for line in checked.warnings], None
    if retuned is not None:
        compared[retuned_pd.NAME] = (joint, metrics[retuned_pd.NAME])
        theirs = metrics[retuned_pd.NAME]
        values, without = (_scored(problem.objective, walked) for walked in (ours, theirs))
        worth = retuned_pd.worth(
            values, without, joint,
            feasible=retuned.feasible,
            spread=max(map(retuned_pd.spread_of, (found, retuned))),
            lacks=retuned_pd.lacks(retuned),
            step=step,
            others=differences(ours, theirs, found.judged_by, but=("force_variation",)),
        )  # fmt: skip
        outcome.insert(0, worth.in_words)
    if broken := verification.broken_limits(problem.objective, metrics["config"]):
        outcome.append(f"the config's own gains break limits: {'; '.join(broken)}")
    outcome += remarks(metrics)
    tests = outcome_of(checked, found) + _turns(found, walks["tuned"])
    summary = _summary(found, checked, compared, worth)
    return Judged(walks, compared, over, hardware, checked, [*outcome, *tests], tests, summary)


def _sentences(lines: list[str]) -> list[str]:
    return [line[0].upper() + line[1:] for line in lines]


def _of_the_walks(found: Result, walks: Mapping[str, mc.Trajectory]) -> dict[str, Callable[[], Figure]]:
    """Return what draws the search and its walks."""
    return {
        "convergence": lambda: search_pictures.plot_convergence(found),
        "walks": lambda: plots.plot_comparison(walks),
    }


def _of_the_tests(found: Result, judged: Judged) -> dict[str, Callable[[], Figure]]:
    """Return what draws what the tests found."""
    over = judged.over
    drawn: dict[str, Callable[[], Figure]] = {"margins": lambda: plot_margins(judged.hardware, "tuned")}
    return drawn if over is None else drawn | {"path": lambda: search_pictures.plot_path(found, over)}


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


def _scored(target: Goal, metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return what gains are compared by."""
    variation = metrics["force_variation"]
    if variation is None or failed(metrics):
        return {"objective": np.nan, "force_variation": np.nan}
    return {"objective": float(maps.score_of(target, metrics).value), "force_variation": float(variation)}


def _summary(found: Tuned, checked: Verification, compared: Compared, worth: Worth | None) -> str:
    summary: dict[str, Any] = {
        name: {
            "gains": gains,
            "metrics": metrics,
            "broken_limits": verification.broken_limits(found.problem.objective, metrics),
        }
        for name, (gains, metrics) in compared.items()
    }
    summary["search"] = {
        **found.search.model_dump(mode="json"), "objective": found.value, "feasible": found.feasible,
        "env_steps": found.env_steps, "env_steps_at_best": found.best_at,
    }  # fmt: skip
    if worth is not None:
        summary["force_sensor"] = worth.changes | {"in_words": worth.in_words}
    summary["verification"] = {**dataclasses.asdict(checked), "passed": checked.passed}
    return to_json(summary)


def outcome_of(checked: Verification, found: Result) -> list[str]:
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
