"""A gain schedule beside pd, pd retuned and the config's gains, over its operating points."""

from typing import NamedTuple

import numpy as np

from mjx_climb.walk.metrics import failed
from tuning.comparisons import maps, verdicts
from tuning.comparisons.worth import of_schedule
from tuning.results.scheduled import Scheduled
from tuning.searches.retuned_pd import UNSEARCHED


class ScheduleComparison(NamedTuple):
    """The worth of a schedule."""

    worth: str  # of a force sensor, in words
    verdict: str  # the gains of each point against the best of the others


def compare(found: Scheduled, *_: object) -> ScheduleComparison:
    """Score the walks of all operating points; nothing walks."""
    data, problem = found.data, found.problem
    values, feasible = {}, {}
    for name in data["walk"].values.tolist():
        own = data.sel(walk=name)
        score = maps.score_of(problem.objective, {key: own[key].values.ravel() for key in problem.metrics.names})
        values[name], feasible[name] = np.where(failed(own).values.ravel(), np.nan, score.value), score.feasible
    there = np.isfinite(values["tuned"])
    held = there if there.any() else ~there
    walked = {
        name: verdicts.Walked(float(own[held].mean()), bool(feasible[name][held].all())) for name, own in values.items()
    }
    points = f"{held.sum()} of {held.size} operating points" if not there.all() else f"{held.size} operating points"
    outside = int((~feasible["tuned"]).sum())
    ours = "gains tuned for each point" + (f", which break a limit at {outside}" if outside else "")
    by_plan = np.full(data["value"].shape, np.nan)
    if UNSEARCHED in values:
        by_plan = np.where(feasible[UNSEARCHED], values[UNSEARCHED], np.nan).reshape(by_plan.shape)
    return ScheduleComparison(
        of_schedule(data, by_plan),
        verdicts.against_best(ours, walked, f"mean objective at {points}", breaks="breaks a limit at a point"),
    )
