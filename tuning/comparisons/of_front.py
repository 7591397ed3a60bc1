"""The walks along a Pareto front, beside the law's own gains and pd, and the worth of a force sensor at its knee."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

import mjx_climb as mc
from tuning.background import Stage, silent
from tuning.comparisons.worth import of_front
from tuning.problem.evaluation import under_pd
from tuning.results.front import Front


@dataclasses.dataclass(frozen=True)
class FrontComparison:
    """The rivals of a front."""

    walks: Mapping[str, mc.Trajectory]  # pd and config, in double precision
    histories: Mapping[str, np.ndarray]  # metrics and time histories of the points on the front
    worth: str  # of a force sensor, in words


def compare(found: Front, stage: Stage = silent, *_: object) -> FrontComparison:
    """Simulate the points on a front, the law's own gains and pd."""
    problem, data, scenario = found.problem, found.data, found.scenario
    how: dict[str, Any] = {"law": problem.law, "engine": problem.engine}
    with stage("walks along the front"):
        walks = {"pd": mc.rollout(under_pd(scenario), engine=problem.engine), "config": mc.rollout(scenario, **how)}
        on_front = {name: data[name].values for name in data.attrs["gains"].split()}
        histories = mc.rollout_histories(scenario, on_front, metrics=problem.metrics, unsteady=True, **how)
    return FrontComparison(walks, histories, of_front(found))
