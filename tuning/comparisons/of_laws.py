"""Which differences between laws are real, and what that says of the force sensor and of better hardware."""

import dataclasses

import xarray as xr

from tuning.background import Stage, silent
from tuning.comparisons import paired
from tuning.comparisons.compare import reads_forces
from tuning.comparisons.of_ensemble import shown
from tuning.problem.objectives import Objective
from tuning.results.judged import Comparison
from tuning.searches import retuned_pd

SHOWN = ("force_variation", "peak_foot_force", "peak_pull_force", "cost_of_transport", "peak_joint_torque")


@dataclasses.dataclass(frozen=True)
class LawsComparison:
    """Laws beside pd retuned, by their walks."""

    table: xr.Dataset  # see `tuning.comparisons.paired.compared`
    verdict: paired.Verdict
    reading: list[str]  # laws that read forces


def compare(found: Comparison, stage: Stage = silent) -> LawsComparison:
    """Compute which differences are real; nothing walks."""
    problem = found.problem
    assert isinstance(problem.objective, Objective)
    reading = [name for name in found.laws if reads_forces(found.tuned[name].problem)]
    with stage("intervals", compiles=False):
        of_laws, goal = shown(problem.metrics, SHOWN), problem.objective
        table = paired.compared(found.data, of_laws, retuned_pd.NAME, goal, shared=found.hardware)
    joint = retuned_pd.joint_of(found.tuned[retuned_pd.NAME])
    verdict = paired.verdict(table, found.laws, reading, found.hardware, found.outside, found.unsettled, joint)
    return LawsComparison(table, verdict, reading)
