"""Gains that a search over an ensemble found, on walks that it never saw, beside pd, pd retuned and the scenario's."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import gains as scenario_gains
from mjx_climb.inputs.resolve import AnyGains
from tuning.background import Stage, silent
from tuning.comparisons import judge as judging
from tuning.comparisons import verdicts
from tuning.comparisons.side_by_side import VARIATION, planned, retuned, rivals
from tuning.comparisons.worth import Worth, best_without, between, over_walks
from tuning.gains.gains_file import Whole
from tuning.problem.objectives import Objective
from tuning.results.tuned import Robust, Tuned
from tuning.searches import retuned_pd
from tuning.searches.shards import Rows

SHOWN = ("force_variation", "peak_foot_force", "peak_pull_force", "peak_joint_torque", "cost_of_transport",
         "travel", "base_deviation", "joint_limit_margin")  # fmt: skip


def shown(metrics: mc.MetricTable, main: Sequence[str] = SHOWN) -> list[str]:
    """Return the names of the metrics that a table has: the main ones, and those of the user's own."""
    return [*main, *(name for name in metrics.names if name not in mc.METRICS.names)]


@dataclasses.dataclass(frozen=True)
class RobustComparison:
    """A result beside the scenario's own gains, pd and pd retuned on walks that the search never saw."""

    walks: xr.Dataset
    # mean and worst of these (see `tuning.comparisons.judge.summary`), with `objective`, and as `broken` the share of
    # walks that break each limit
    summed: xr.Dataset
    worth: Worth | None  # of a force sensor: the result against pd retuned
    verdict: str  # the result against the best of the others
    joint: Mapping[str, float]  # gains of pd retuned
    binding: list[str]  # limits that hold the gains where they are, in words
    plain: Mapping[str, Any]  # the main metrics of `summed` by gains, see `tuning.comparisons.judge.plain`


def compare(found: Robust, stage: Stage = silent, out: Path | None = None, *_: object) -> RobustComparison:
    """Simulate a result and its rivals; `out` keeps the rounds of the search that retunes pd."""
    problem, ensemble = found.problem, found.ensemble
    how = problem, found.search, found.seeds, out
    rival, plan = rivals(retuned(*how), planned(*how), stage)
    walked, pd, step = problem, {}, None
    if rival is not None:  # as short a time step as it needs, for all that are compared
        pd = {retuned_pd.NAME: rival.gains}
        shortest = retuned_pd.shared_step(found.scenario, [each for each in (rival, plan) if each is not None])
        step = None if shortest == found.scenario.time_step else shortest
        walked = dataclasses.replace(problem, scenario=found.scenario.with_overrides({"time_step": shortest}))
    gains: dict[str, AnyGains | Whole] = {
        "robust": found.gains,
        "config": problem.law or scenario_gains(found.scenario),
    }
    by_plan = retuned_pd.by_plan(problem)
    if plan is not None:
        gains[retuned_pd.PLANNED] = Whole(plan.law, plan.gains)
    elif rival is not None and by_plan is not None:
        gains[retuned_pd.UNSEARCHED] = Whole(by_plan, retuned_pd.joint_of(rival))
    fresh = judging.fresh(ensemble.model_copy(update={"members": found.judges}))
    draws = {
        "fresh draw": judging.through(walked, gains, fresh, pd),
        # a search from another seed has a draw of its own
        "its own draw": dataclasses.replace(
            judging.through(problem, {"robust": found.gains}, ensemble), problem=problem
        ),
    }
    drawn = {}
    for name, draw in draws.items():
        with stage(name, unit="members") as told:
            drawn[name] = draw.dataset(Rows(draw).walk(told))
    walks, seen = drawn.values()
    return conclusions(found, walks, seen, (rival, plan), step)


def conclusions(
    found: Robust, walks: xr.Dataset, seen: xr.Dataset, others: tuple[Tuned | None, Tuned | None], step: float | None
) -> RobustComparison:
    """Return the result beside its rivals, from their walks.

    Arguments:
        found: the result.
        walks: of the gains, pd retuned and pd, through a draw that no search saw.
        seen: of the gains through the draw of their search.
        others: pd retuned, and load transfer by plan.
        step: the time step of all walks, s, where it is not the scenario's.
    """
    problem, goal, (rival, plan) = found.problem, found.problem.objective, others
    assert isinstance(goal, Objective)
    joint = {} if rival is None else retuned_pd.joint_of(rival)
    scores = judging.scores(walks, goal)
    value = {name: float(scores.sel(gains=name)) for name in scores["gains"].values.tolist()}
    best = None if rival is None else best_without(found, (rival, plan), value, step)
    kept = [name for name in value if name != retuned_pd.UNSEARCHED or (best is not None and name == best.name)]
    walks, scores = walks.sel(gains=kept), scores.sel(gains=kept)
    broken = judging.broken(walks, goal)
    summed = judging.summary(walks).assign(objective=scores, broken=broken)
    plain = judging.plain(summed, shown(problem.metrics))
    worth, over = None, None
    if best is not None:
        both = {name: plain[name]["mean"] for name in ("robust", best.name)}
        values = [{"objective": value[name], VARIATION: mean[VARIATION]} for name, mean in both.items()]
        over = over_walks(walks, "robust", goal, best.name)
        worth = between(both.values(), values, best.rival, problem, over=over, pd=best.pd, ends=best.ends)
    most = broken.max("limit") if broken.size else xr.zeros_like(scores)
    reached = {
        name: verdicts.Walked(float(scores.sel(gains=name)), bool(most.sel(gains=name) <= most.sel(gains="robust")))
        for name in walks["gains"].values.tolist()
    }
    ours, what = verdicts.named("robust gains", found.gains, problem), f"objective over {found.judges} unseen walks"
    said = verdicts.against_best(ours, reached, what, joint=joint, breaks="breaks a limit in more walks")
    if best is not None and over is not None and not (over.low > 0 or over.high < 0):
        said += f"; {over.walks} walks do not tell them from {best.name}"
    return RobustComparison(walks, summed, worth, said, joint, judging.binding(seen, goal, "robust"), plain)
