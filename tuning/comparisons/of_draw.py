"""Gains on the walks of a draw: means, worst, and their differences from the best pd that walked beside them."""

from typing import NamedTuple

import xarray as xr

from tuning.background import Stage, silent
from tuning.comparisons import judge as judging
from tuning.comparisons import paired, verdicts
from tuning.comparisons.of_ensemble import shown
from tuning.comparisons.side_by_side import VARIATION
from tuning.problem.objectives import Objective
from tuning.problem.readings import best_of_both
from tuning.results.judged import Judged
from tuning.searches.retuned_pd import NAME


class DrawComparison(NamedTuple):
    """Gains on the same unseen walks."""

    summed: xr.Dataset  # see `tuning.comparisons.judge.summary`
    table: xr.Dataset  # differences from pd, retuned where it walked, see `tuning.comparisons.paired.compared`
    sensor: str  # worth of a force sensor in words; empty where no gains read forces
    verdict: str  # the first gains against the best of the others


def compare(found: Judged, stage: Stage = silent, *_: object) -> DrawComparison:
    """Compute means, worst and differences; nothing walks."""
    walks = found.data
    baseline = NAME if NAME in walks["gains"].values else judging.PD
    with stage("intervals", compiles=False):
        table = paired.compared(walks, shown(found.problem.metrics), baseline, Objective((), ()))
        sensor = sensor_in_words(walks, shown(found.problem.metrics))
    summed = judging.summary(walks)
    return DrawComparison(summed, table, sensor, verdict(summed))


def verdict(summed: xr.Dataset) -> str:
    """Return how the first gains do beside the best of the others that lose no more walks."""
    walked = verdicts.by_lost_walks(summed[VARIATION].sel(statistic="mean"), summed["failed"])
    return verdicts.against_best(next(iter(walked)), walked, "mean force variation", "N", breaks="loses more walks")


def sensor_in_words(walks: xr.Dataset, metrics: list[str]) -> str:
    """The worth of a force sensor in words: of the gains that read forces the best, beside the best of the others."""
    reading = walks.attrs.get(judging.READING, "").split(", ")
    means, names = walks[VARIATION].mean("member"), walks["gains"].values.tolist()
    ours, without = best_of_both(names, reading, lambda name: float(means.sel(gains=name)))
    if ours is None:
        return ""
    if without is None or {*names} - {*reading} <= {NAME, judging.PD}:
        return "what a force sensor is worth is not told: of the gains that read no forces pd's alone walked"
    beside = walks.sel(gains=list(dict.fromkeys([ours, without, judging.PD])))
    table = paired.compared(beside, metrics, without, Objective((), ()))
    whole = float(means.sel(gains=NAME if NAME in names else judging.PD))
    return paired.sensor_in_words(table, ours, whole, metric=VARIATION)
