"""The walks along a Pareto front, beside the law's own gains and pd, and the worth of a force sensor at its knee."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

import mjx_climb as mc
from tuning.background import Stage, silent
from tuning.comparisons import verdicts
from tuning.comparisons.side_by_side import Values
from tuning.comparisons.worth import law_without, of_front
from tuning.problem.evaluation import under_pd
from tuning.results.front import Front


@dataclasses.dataclass(frozen=True)
class FrontComparison:
    """The rivals of a front."""

    walks: Mapping[str, mc.Trajectory]  # pd and config, in double precision
    metrics: Mapping[str, Values]  # of these
    histories: Mapping[str, np.ndarray]  # metrics and time histories of the points on the front
    worth: str  # of a force sensor, in words
    verdict: str  # both metrics of the knee, beside those of its rivals


def compare(found: Front, stage: Stage = silent, *_: object) -> FrontComparison:
    """Simulate the points on a front, the law's own gains and pd."""
    problem, data, scenario = found.problem, found.data, found.scenario
    how: dict[str, Any] = {"law": problem.law, "engine": problem.engine}
    with stage("walks along the front"):
        walks = {"pd": mc.rollout(under_pd(scenario), engine=problem.engine), "config": mc.rollout(scenario, **how)}
        on_front = {name: data[name].values for name in data.attrs["gains"].split()}
        histories = mc.rollout_histories(scenario, on_front, metrics=problem.metrics, unsteady=True, **how)
    metrics = {name: mc.metrics(walk, problem.metrics) for name, walk in walks.items()}
    return FrontComparison(walks, metrics, histories, of_front(found), verdict(found, metrics))


def verdict(found: Front, walked: Mapping[str, Values]) -> str:
    """Return both metrics of the knee in a sentence, beside those of pd retuned, and of the walks of config and pd."""
    about, data, rival, texts = found.problem.metrics, found.data, found.rival, []
    for name in (found.asked.better, found.asked.against):
        walks: dict[str, Values] = {"knee": {name: data[name].values[found.knee].item()}}  # nothing fails on a front
        walks |= {} if rival is None else {law_without(rival): {name: rival[f"without_{name}"].item()}}
        texts.append(f"{about.in_words(name)} {verdicts.against(name, 'knee', walks | dict(walked), about)}")
    return f"the front of {data.sizes['front']} points bends at {'; '.join(texts)}"
