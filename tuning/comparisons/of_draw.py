"""Gains on the walks of a draw: means, worst, and their differences from the best pd that walked beside them."""

from typing import NamedTuple

import xarray as xr

from tuning.background import Stage, silent
from tuning.comparisons import judge as judging
from tuning.comparisons import paired
from tuning.comparisons.of_ensemble import shown
from tuning.problem.objectives import Objective
from tuning.results.judged import Judged
from tuning.searches.retuned_pd import NAME


class DrawComparison(NamedTuple):
    """Gains on the same unseen walks."""

    summed: xr.Dataset  # see `tuning.comparisons.judge.summary`
    table: xr.Dataset  # differences from pd, retuned where it walked, see `tuning.comparisons.paired.compared`


def compare(found: Judged, stage: Stage = silent) -> DrawComparison:
    """Compute means, worst and differences; nothing walks."""
    walks = found.data
    baseline = NAME if NAME in walks["gains"].values else judging.PD
    with stage("intervals", compiles=False):
        table = paired.compared(walks, shown(found.problem.metrics), baseline, Objective((), ()))
    return DrawComparison(judging.summary(walks), table)
