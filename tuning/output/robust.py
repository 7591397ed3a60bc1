"""What a search over an ensemble leaves in a folder: gains, all that was judged, a fresh draw, pictures and report."""

import dataclasses
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import xarray as xr
from matplotlib.figure import Figure

from mjx_climb import MetricTable
from mjx_climb.files import dataset
from mjx_climb.quantities.parameters import gains as gains_of
from mjx_climb.rollouts.given import AnyGains
from tuning.gains.gains_file import by_name
from tuning.output.folder import complete
from tuning.output.found import draw, write_gains
from tuning.output.stages import Stage, silent
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.report import ensemble_pictures, page, search_pictures
from tuning.report import robust as pages
from tuning.report.comparison import differences
from tuning.report.numbers import to_json
from tuning.searches import finished_parts, retuned_pd, robust
from tuning.searches.result import Result
from tuning.searches.retuned_pd import Worth
from tuning.searches.robust import RobustObjective

JUDGES = 128  # walks of each set of gains in the fresh draw
FILES = (
    "report.html, gains.yaml, search.nc, judged.nc, summary.json, convergence.png, judged.png, "
    "config.yaml, search.yaml, ensemble.yaml"
)
CAPTIONS = {"convergence": "How the search converged.", "judged": "Share of the fresh walks below a value."}


class Judged(NamedTuple):
    """Gains beside the scenario's own and pd, on walks that the search never saw."""

    walks: xr.Dataset  # see `tuning.searches.robust.judge`
    summed: xr.Dataset  # mean and worst, see `tuning.searches.robust.summary`
    outcome: list[str]  # in lines
    summary: str  # all of it, JSON
    files: str = FILES  # that are written


@dataclasses.dataclass(frozen=True)
class Robust(Result):
    """The result of a search over an ensemble, and what was searched."""

    problem: Problem = dataclasses.field(kw_only=True)
    ensemble: Ensemble = dataclasses.field(kw_only=True)
    judges: int = dataclasses.field(default=JUDGES, kw_only=True)  # walks of each set of gains in the fresh draw

    def write(
        self,
        folder: str | os.PathLike[str],
        *,
        origin: page.Origin | None = None,
        figures: Collection[str] = ("png",),
        stage: Stage = silent,
    ) -> Judged:
        """Judge the result on a fresh draw, and write what `mjx-climb tune --ensemble` writes.

        The arguments are those of `tuning.output.swept.Swept.write`.

        Returns:
            The walks of the draw, their means and worst, and the verdict.

        Raises:
            OutputError: a file cannot be written.
        """
        folder = Path(folder)
        found = self.write_found(folder, "from Python" if origin is None else origin.name)
        again = "mjx-climb tune config.yaml --search search.yaml --ensemble ensemble.yaml --out again"
        origin = complete(origin, "tuning.robust(...)", again, folder)
        judged = judge(found, stage, out=folder)
        dataset.save(judged.walks, folder / "judged.nc")
        dataset.write_text_atomically(folder / "summary.json", judged.summary + "\n")
        wanted: dict[str, Callable[[], Figure]] = {
            "convergence": lambda: search_pictures.plot_convergence(found),
            "judged": lambda: ensemble_pictures.plot_judged(judged.walks),
        }
        drawn = draw(wanted, folder, {"png", *figures}, stage)
        with stage("report", compiles=False):
            pictures = {CAPTIONS[name]: file for name, file in drawn.items()}
            page.write(pages.page(found, judged.summed, judged.outcome, origin=origin, pictures=pictures), folder)
        finished_parts.clear(folder)
        return judged

    def write_found(self, folder: Path, name: str) -> Self:
        """Write what `tuning.output.found.write_gains` does and the ensemble, and return what it returns."""
        search, ensemble = self.search, self.ensemble
        dataset.write_text_atomically(folder / "ensemble.yaml", ensemble.to_yaml())
        comment = f"{search.method}, {search.space}, {ensemble.members} members, objective {self.value:.4f} (pd: 1)"
        comment = f"mjx-climb tune {name} --ensemble: {comment}"
        return write_gains(self, folder, comment, self.problem)


def judge(found: Robust, stage: Stage = silent, *, out: Path | None = None) -> Judged:
    """Walk a result, the scenario's own gains, pd and pd retuned through a fresh draw.

    `out` keeps the rounds in which pd is retuned until the result has been written.
    """
    problem, ensemble, law = found.problem, found.ensemble, found.problem.law
    goal = problem.objective
    assert isinstance(goal, RobustObjective)
    with stage("retuned pd", unit="rounds") as told:
        retuned = retuned_pd.search(
            problem, found.search, out=out, progress=lambda now: told(now.rounds, now.rounds_in_all)
        )
    scenario, pd = found.scenario, {}
    if retuned is not None:  # as short a time step as it needs, for all that are compared
        pd = {retuned_pd.NAME: retuned.gains}
        step = retuned_pd.time_step_for(scenario, retuned_pd.joint_of(retuned))
        scenario = scenario.with_overrides({"time_step": step})
    rivals: Mapping[str, AnyGains] = {"robust": found.gains, "config": law or gains_of(found.scenario)}
    how: dict[str, Any] = {"law": law, "engine": problem.engine, "metrics": problem.metrics}
    with stage("fresh draw") as told:
        walks = robust.judge(scenario, rivals, ensemble, members=found.judges, pd=pd, progress=told, **how)
    with stage("its own draw") as told:
        seen = robust.walked(found.scenario, {"robust": found.gains}, ensemble, progress=told, **how)
    broken = robust.broken(walks, goal)
    summed = robust.summary(walks).assign(objective=robust.scores(walks, goal), broken=broken)
    outcome, worth = _limits_in_words(broken, robust.binding(seen, goal, "robust")), None
    if retuned is not None:
        ours, theirs = _scored(summed, "robust"), _scored(summed, retuned_pd.NAME)
        means, against = (_means(summed, name, found.problem.metrics) for name in ("robust", retuned_pd.NAME))
        worth = retuned_pd.worth(
            ours, theirs, retuned.gains,
            feasible=retuned.feasible,
            spread=max(map(retuned_pd.spread_of, (found, retuned))),
            lacks=retuned_pd.lacks(retuned),
            step=None if step == found.scenario.time_step else step,
            others=differences(means, against, found.problem.metrics, but=("force_variation",)),
        )  # fmt: skip
        outcome.insert(0, worth.in_words)
    if not found.feasible:
        outcome.append("warning: no gains kept every limit in every member of the search")
    lost = zip(summed["gains"].values.tolist(), summed["failed"].values, strict=True)
    failed = ", ".join(f"{name} {share:.0%}" for name, share in lost)
    verdict = f"{found.judges} walks each that the search never saw; would lose a gripper, or diverge: {failed}"
    return Judged(walks, summed, [verdict, *outcome], to_json(_plain(summed, found, worth)))


def _limits_in_words(broken: xr.DataArray, binding: list[str]) -> list[str]:
    """Return which limits hold the result where it is, and a warning for each that it breaks in the fresh draw."""
    lines = [f"held by its limits: {'; '.join(binding)}"] if binding else []
    shares = broken.sel(gains="robust")
    for limit, share in zip(shares["limit"].values.tolist(), shares.values.tolist(), strict=True):
        if share:
            lines.append(f"warning: {share:.1%} of the fresh walks break {limit}")
    return lines


def _scored(summed: xr.Dataset, name: str) -> dict[str, float]:
    """Return what gains are compared by."""
    own = summed.sel(gains=name)
    return {
        "objective": float(own["objective"]),
        "force_variation": float(own["force_variation"].sel(statistic="mean")),
    }


def _means(summed: xr.Dataset, name: str, metrics: MetricTable) -> dict[str, float]:
    own = summed.sel(gains=name, statistic="mean")
    return {metric: float(own[metric]) for metric in pages.shown(metrics)}


def _plain(summed: xr.Dataset, found: Robust, worth: Worth | None) -> dict[str, Any]:
    names, shown = summed["gains"].values.tolist(), pages.shown(found.problem.metrics)
    limits = summed["limit"].values.tolist()
    result = {
        name: {
            "failed": float(summed["failed"].sel(gains=name)),
            "objective": float(summed["objective"].sel(gains=name)),
            "broken_limits": dict(zip(limits, summed["broken"].sel(gains=name).values.tolist(), strict=True)),
            **{s: {m: float(summed[m].sel(gains=name, statistic=s)) for m in shown} for s in ("mean", "worst")},
        }
        for name in names
    }
    search = {
        "objective": found.value,
        "feasible": found.feasible,
        "env_steps": found.env_steps,
        "gains": by_name(found.gains),
    }
    return {**result, "search": search} | (
        {} if worth is None else {"force_sensor": worth.changes | {"in_words": worth.in_words}}
    )
