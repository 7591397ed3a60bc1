"""Which differences between laws are real, and the worth of the force sensor and of better hardware."""

import dataclasses
from collections.abc import Mapping, Sequence

import xarray as xr

from tuning.background import Stage, silent
from tuning.comparisons import judge, paired
from tuning.comparisons.degraded import METRICS
from tuning.comparisons.of_ensemble import shown
from tuning.problem.objectives import Objective
from tuning.problem.readings import best_of_both, reads_forces
from tuning.results.judged import Comparison
from tuning.searches import retuned_pd


@dataclasses.dataclass(frozen=True)
class LawsComparison:
    """Laws beside pd retuned, by their walks."""

    table: xr.Dataset  # see `tuning.comparisons.paired.compared`
    verdict: paired.Verdict
    reading: list[str]  # laws that read forces


def compare(found: Comparison, stage: Stage = silent, *_: object) -> LawsComparison:
    """Compute which differences are real; nothing walks."""
    problem = found.problem
    assert isinstance(problem.objective, Objective)
    reading = [name for name in found.laws if reads_forces(found.tuned[name].problem)]
    of_laws, goal = shown(problem.metrics, METRICS), problem.objective
    with stage("intervals", compiles=False):
        table = paired.compared(found.data, of_laws, retuned_pd.NAME, goal, shared=found.hardware)
        joint = retuned_pd.joint_of(found.tuned[retuned_pd.NAME])
        sensor = _sensor(found, table, reading, joint)
    verdict = paired.verdict(table, found.laws, sensor, found.hardware, found.outside, found.unsettled, joint)
    return LawsComparison(table, verdict, reading)


def _sensor(found: Comparison, table: xr.Dataset, reading: Sequence[str], joint: Mapping[str, float]) -> str:
    """The worth of a force sensor, in words: of both kinds the law whose searches found the least counts."""
    laws = [name for name in (*found.laws, retuned_pd.NAME) if name not in found.outside]
    searched = found.data["search_value"].mean("seed").sel(gains=laws)
    ours, without = best_of_both(laws, reading, lambda name: float(searched.sel(gains=name)))
    if not reading:
        return "no law here reads forces"
    if ours is None or without is None or {*laws} - {*reading} == {retuned_pd.NAME}:
        return "what a force sensor is worth is not told: no law beside pd was searched that reads no forces"
    goal = found.problem.objective
    assert isinstance(goal, Objective)
    walks = found.data.sel(gains=[ours, without, judge.PD])
    beside = paired.compared(walks, shown(found.problem.metrics, METRICS), without, goal)
    pd = float(table["value"].sel(metric="objective", statistic="mean", gains=retuned_pd.NAME))
    by_effort = found.problem.scenario.hardware.force_sensor.source == "joint_effort"
    return paired.sensor_in_words(beside, ours, pd, joint, "reading joint efforts" if by_effort else "a force sensor")
