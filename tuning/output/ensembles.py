"""What many walks, or many sets of gains, leave in a folder: searches over an ensemble, fresh draws, fronts, schedules.

Each function is named as the kind of its result and gives the contents of the folder.
"""

import dataclasses
from typing import Any, NamedTuple

import xarray as xr

import mjx_climb as mc
from mjx_climb.quantities.parameters import gains as gains_of
from tuning.gains.gains_file import by_name
from tuning.output.comparisons import CONVERGENCE
from tuning.output.folder import Contents, Folder
from tuning.problem.evaluation import under_pd
from tuning.problem.objectives import Objective
from tuning.report import page, pages, pictures
from tuning.report.comparison import differences
from tuning.report.numbers import to_json
from tuning.searches import judge as judging
from tuning.searches import retuned_pd
from tuning.searches import schedule as schedules
from tuning.searches.judge import Judged
from tuning.searches.pareto import Front
from tuning.searches.result import Robust, Written
from tuning.searches.retuned_pd import Worth
from tuning.searches.schedule import Scheduled
from tuning.searches.shards import Rows

SHARES = "Share of the walks below a value."
FRONT = "The front, and all that was walked on the way."
SCHEDULE = "Gains by gravity and cargo."


def judge(found: Judged, folder: Folder, _: None = None) -> Contents:
    """Every walk, means and worst, the picture, the page."""
    ensemble = found.ensemble
    assert ensemble is not None
    found, metrics = folder.found(found), found.problem.metrics
    summed = judging.summary(found.data)
    sentence = f"{ensemble.members} walks each; {judging.failed_in_words(summed)}"
    summary = to_json(judging.plain(summed, pages.shown(metrics)))
    return Contents(
        Written(data=found.data, summed=summed, outcome=[sentence], summary=summary),
        {"summary.json": summary + "\n"},
        {"judged": (SHARES, lambda: pictures.plot_judged(found.data))},
        lambda origin: page.Page(
            title=f"Gains on the walks of {origin.name}", origin=origin, verdict=f"{sentence}.",
            scenario=found.scenario, tables=[pages.judged_table(summed, metrics)], facts={"seed": ensemble.seed},
        ),
    )  # fmt: skip


def schedule(found: Scheduled, folder: Folder, _: None = None) -> Contents:
    """The table, all metrics, and a picture; no report."""
    data = folder.found(found).data
    return Contents(
        Written(data=data, outcome=[schedules.worth(data)]),
        {"schedule.csv": schedules.to_csv(data), "schedule.yaml": schedules.to_yaml(data)},
        {"schedule": (SCHEDULE, lambda: pictures.plot_schedule(data))},
    )


def pareto(found: Front, folder: Folder, _: None = None) -> Contents:
    """The front with its gains, a picture, the knee, and the report with the walks along the front."""
    found = folder.found(found)
    problem, data, asked, scenario = found.problem, found.data, found.asked, found.scenario
    summary = _summary_of(found)
    how: dict[str, Any] = {"law": problem.law, "engine": problem.engine}
    on_front = {name: data[name].values for name in data.attrs["gains"].split()}
    with folder.stage("walks along the front"):
        walks = {"pd": mc.rollout(under_pd(scenario), engine=problem.engine), "config": mc.rollout(scenario, **how)}
        histories = mc.rollout_histories(scenario, on_front, metrics=problem.metrics, **how)
    again = "mjx-climb pareto config.yaml --search search.yaml "
    again += f"--better {asked.better} --against {asked.against} --points {asked.points} --out again"
    return Contents(
        Written(walks=walks, data=data, outcome=[found.worth], summary=summary),
        {"summary.json": summary + "\n"},
        {"front": (FRONT, lambda: pictures.plot_front(data))},
        lambda origin: pages.pareto_page(found, histories, walks, origin),
        again,
    )


def _summary_of(found: Front) -> str:
    """Return the front, its knee, the metrics of the config's gains and of pd, and pd's front over kp and kd."""
    data, metrics = found.data, (found.asked.against, found.asked.better)

    def rows(names: tuple[str, ...], along: str, prefix: str = "") -> list[dict[str, Any]]:
        return [{n: data[f"{prefix}{n}"].values[i] for n in names} for i in range(data.sizes[along])]

    config, pd = ({n: data[f"reference_{n}"].sel(reference=name).item() for n in metrics} for name in ("config", "pd"))
    return to_json(
        {
            "front": rows((*metrics, *data.attrs["gains"].split()), "front"), "knee": found.knee,
            "config": config, "pd": pd, "pd_over_kp_and_kd": rows(("kp", "kd", *metrics), "without", "without_"),
            "force_sensor": {"in_words": found.worth},
        }
    )  # fmt: skip


def robust(found: Robust, folder: Folder, _: None = None) -> Contents:
    """Gains, all points, a fresh draw that tests them, pictures and report."""
    found = folder.found(found)
    walks, summed, worth, outcome = compare(found, folder)
    summary = to_json(_plain(summed, found, worth))
    return Contents(
        Written(data=walks, summed=summed, outcome=outcome, summary=summary),
        {"judged.nc": walks, "summary.json": summary + "\n"},
        {
            "convergence": (CONVERGENCE, lambda: pictures.plot_convergence(found)),
            "judged": (SHARES, lambda: pictures.plot_judged(walks)),
        },
        lambda origin: pages.robust_page(found, summed, outcome, origin),
        "mjx-climb tune config.yaml --search search.yaml --ensemble ensemble.yaml --out again",
    )


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
    problem, ensemble, goal = found.problem, found.ensemble, found.problem.objective
    assert isinstance(goal, Objective)
    with folder.stage("retuned pd", unit="rounds") as told:
        retuned = retuned_pd.search(
            problem, found.search, out=folder.path, progress=lambda now: told(now.rounds, now.rounds_in_all)
        )
    walked, pd, step = problem, {}, None
    if retuned is not None:  # as short a time step as it needs, for all that are compared
        pd = {retuned_pd.NAME: retuned.gains}
        shortest = retuned_pd.time_step_for(found.scenario, retuned_pd.joint_of(retuned))
        step = None if shortest == found.scenario.time_step else shortest
        walked = dataclasses.replace(problem, scenario=found.scenario.with_overrides({"time_step": shortest}))
    rivals = {"robust": found.gains, "config": problem.law or gains_of(found.scenario)}
    fresh = judging.fresh(ensemble.model_copy(update={"members": found.judges}))
    walks = _walked("fresh draw", judging.through(walked, rivals, fresh, pd), folder)
    seen = _walked("its own draw", judging.through(problem, {"robust": found.gains}, ensemble), folder)
    broken = judging.broken(walks, goal)
    summed = judging.summary(walks).assign(objective=judging.scores(walks, goal), broken=broken)
    outcome = [f"{found.judges} walks each that the search never saw; {judging.failed_in_words(summed)}"]
    worth = None
    if retuned is not None:
        worth = _worth(summed, found, retuned_pd.rival_of(found, retuned, step))
        outcome.append(worth.in_words)
    if binding := judging.binding(seen, goal, "robust"):
        outcome.append(f"held by its limits: {'; '.join(binding)}")
    for limit, share in broken.sel(gains="robust").to_series().items():
        if share:
            outcome.append(f"warning: {share:.1%} of the fresh walks break {limit}")
    if not found.feasible:
        outcome.append("warning: no gains kept every limit in every member of the search")
    return Comparison(walks, summed, worth, outcome)


def _walked(name: str, draw: judging.Draw, folder: Folder) -> xr.Dataset:
    with folder.stage(name, unit="members") as told:
        return draw.dataset(Rows(draw).walk(told))


def _worth(summed: xr.Dataset, found: Robust, rival: retuned_pd.Rival) -> Worth:
    metrics = found.problem.metrics
    means = judging.plain(summed, pages.shown(metrics))
    ours, theirs = (means[name]["mean"] for name in ("robust", retuned_pd.NAME))
    others = differences(ours, theirs, metrics, but=("force_variation",))
    values, without = (
        {"objective": float(summed["objective"].sel(gains=name)), "force_variation": mean["force_variation"]}
        for name, mean in (("robust", ours), (retuned_pd.NAME, theirs))
    )
    return retuned_pd.worth(values, without, rival, others=others)


def _plain(summed: xr.Dataset, found: Robust, worth: Worth | None) -> dict[str, Any]:
    result: dict[str, Any] = judging.plain(summed, pages.shown(found.problem.metrics))
    for name, own in result.items():
        own["objective"] = float(summed["objective"].sel(gains=name))
        own["broken_limits"] = summed["broken"].sel(gains=name).to_series().to_dict()
    result["search"] = {
        "objective": found.value, "feasible": found.feasible, "env_steps": found.env_steps,
        "gains": by_name(found.gains),
    }  # fmt: skip
    return result if worth is None else result | worth.summary
