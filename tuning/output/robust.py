"""What a search over an ensemble leaves in a folder: gains, all points, a fresh draw, pictures and report."""

import dataclasses
from typing import Any, NamedTuple

import xarray as xr

from mjx_climb.quantities.parameters import gains as gains_of
from tuning.background import Stage
from tuning.gains.gains_file import by_name
from tuning.output.folder import Folder
from tuning.output.tune import CONVERGENCE
from tuning.report import ensemble_pictures, pages, search_pictures
from tuning.report.comparison import differences
from tuning.report.numbers import to_json
from tuning.searches import judge, retuned_pd, robust
from tuning.searches.result import Robust, Written
from tuning.searches.retuned_pd import Worth
from tuning.searches.robust import RobustObjective
from tuning.searches.shards import Rows

SHARES = "Share of the fresh walks below a value."


def write(found: Robust, folder: Folder, begun: None = None) -> Written:
    """Evaluate the result on a fresh draw, and write what `mjx-climb tune --ensemble` writes."""
    found = folder.found(found)
    compared = compare(found, folder)
    folder.data(compared.walks, "judged.nc")
    summed, outcome = compared.summed, compared.outcome
    summary = to_json(_plain(summed, found, compared.worth))
    folder.text("summary.json", summary + "\n")
    folder.draw(
        {
            "convergence": (CONVERGENCE, lambda: search_pictures.plot_convergence(found)),
            "judged": (SHARES, lambda: ensemble_pictures.plot_judged(compared.walks)),
        }
    )
    with folder.report() as write_page:
        again = "mjx-climb tune config.yaml --search search.yaml --ensemble ensemble.yaml --out again"
        origin = folder.origin("tuning.robust(...)", again)
        write_page(pages.robust_page(found, summed, outcome, origin=origin, pictures=folder.pictures))
    return Written(data=compared.walks, summed=summed, outcome=outcome, summary=summary)


class Comparison(NamedTuple):
    """Gains beside the scenario's own and pd, on walks that the search never saw."""

    walks: xr.Dataset  # see `tuning.searches.judge.Judged`
    summed: xr.Dataset  # mean and worst, see `tuning.searches.judge.summary`
    worth: Worth | None  # of a force sensor: the result against pd retuned
    outcome: list[str]  # in lines


def compare(found: Robust, folder: Folder) -> Comparison:
    """Simulate a result, the scenario's own gains, pd and pd retuned through a fresh draw.

    The folder keeps the rounds in which pd is retuned.
    """
    problem, ensemble, goal, stage = found.problem, found.ensemble, found.problem.objective, folder.stage
    assert isinstance(goal, RobustObjective)
    with stage("retuned pd", unit="rounds") as told:
        retuned = retuned_pd.search(
            problem, found.search, out=folder.path, progress=lambda now: told(now.rounds, now.rounds_in_all)
        )
    walked, pd, step = problem, {}, None
    if retuned is not None:  # as short a time step as it needs, for all that are compared
        pd = {retuned_pd.NAME: retuned.gains}
        shortest = retuned_pd.time_step_for(found.scenario, retuned_pd.joint_of(retuned))
        step = None if shortest == found.scenario.time_step else shortest
        shorter = found.scenario.with_overrides({"time_step": shortest})
        walked = dataclasses.replace(problem, scenario=shorter)
    rivals = {"robust": found.gains, "config": problem.law or gains_of(found.scenario)}
    fresh = judge.fresh(ensemble.model_copy(update={"members": found.judges}))
    walks = _walked("fresh draw", judge.through(walked, rivals, fresh, pd), stage)
    seen = _walked("its own draw", judge.through(problem, {"robust": found.gains}, ensemble), stage)
    broken = robust.broken(walks, goal)
    summed = judge.summary(walks).assign(objective=robust.scores(walks, goal), broken=broken)
    outcome = [f"{found.judges} walks each that the search never saw; {judge.failed_in_words(summed)}"]
    worth = None
    if retuned is not None:
        means = judge.plain(summed, pages.shown(problem.metrics))
        ours, theirs = (means[name]["mean"] for name in ("robust", retuned_pd.NAME))
        others = differences(ours, theirs, problem.metrics, but=("force_variation",))
        values, without = (
            {"objective": float(summed["objective"].sel(gains=name)), "force_variation": mean["force_variation"]}
            for name, mean in (("robust", ours), (retuned_pd.NAME, theirs))
        )
        worth = retuned_pd.worth(values, without, retuned_pd.rival_of(found, retuned, step), others=others)
        outcome.append(worth.in_words)
    if binding := robust.binding(seen, goal, "robust"):
        outcome.append(f"held by its limits: {'; '.join(binding)}")
    shares = broken.sel(gains="robust")
    for limit, share in zip(shares["limit"].values.tolist(), shares.values.tolist(), strict=True):
        if share:
            outcome.append(f"warning: {share:.1%} of the fresh walks break {limit}")
    if not found.feasible:
        outcome.append("warning: no gains kept every limit in every member of the search")
    return Comparison(walks, summed, worth, outcome)


def _walked(name: str, draw: judge.Draw, stage: Stage) -> xr.Dataset:
    with stage(name, unit="members") as told:
        return draw.dataset(Rows(draw).walk(told))


def _plain(summed: xr.Dataset, found: Robust, worth: Worth | None) -> dict[str, Any]:
    limits = summed["limit"].values.tolist()
    result: dict[str, Any] = judge.plain(summed, pages.shown(found.problem.metrics))
    for name, own in result.items():
        broken = summed["broken"].sel(gains=name).values.tolist()
        own["objective"] = float(summed["objective"].sel(gains=name))
        own["broken_limits"] = dict(zip(limits, broken, strict=True))
    result["search"] = {
        "objective": found.value, "feasible": found.feasible, "env_steps": found.env_steps,
        "gains": by_name(found.gains),
    }  # fmt: skip
    return result if worth is None else result | worth.summary
