"""Table of gains that were searched over drawn walks beside those of the case's own walk, on unseen draws.

    python docs/studies/what_a_sensor_is_worth.py results/gait --own-gait --hardware ideal
    python docs/studies/what_a_sensor_is_worth.py results/nominal --own-gait --hardware ideal --nominal
    python docs/studies/robust_gains.py results/gait results/nominal docs/studies/robust_gains.csv

Intervals are of a law that is searched once more, for all rows of a case and metric at once.
"""

import sys
from pathlib import Path

import numpy as np
import which_law
import xarray as xr

from tuning.comparisons import judge, paired
from tuning.problem.objectives import Objective, Term

METRICS = which_law.METRICS | {"base_deviation": "dev m"}
ROBUST, NOMINAL = "robust", "nominal"


def walks_of(robust, nominal, cell):
    """Return the walks of both searches as gains of their own, those of the config's pd last."""
    both = [which_law.walks_of(folder, cell).drop_sel(gains=which_law.HALVED, errors="ignore")
            for folder in (robust, nominal)]  # fmt: skip
    each = [
        walks.drop_sel(gains=judge.PD).assign_coords(gains=[f"{law}, {of}" for law in laws(walks)])
        for of, walks in zip((ROBUST, NOMINAL), both, strict=True)
    ]
    return xr.concat([*each, both[0].sel(gains=[judge.PD])], "gains", combine_attrs="override").transpose(*paired.DIMS)


def laws(walks):
    """Return the names of the laws that were searched."""
    return [name for name in walks["gains"].values.tolist() if name != judge.PD]


def rows_of(walks):
    """Yield the rows of a case: law, its gains, metric, mean and worst 5 %, lost walks, and robust less nominal, %."""
    goal = Objective(tuple(Term(name, 1.0, 1.0, 1.0) for name in which_law.WEIGHTS), ())
    metrics = [name for name in METRICS if name not in ("objective", "failed")]
    lost = judge.failed(walks).mean("seed").sum("member")
    for gains in walks["gains"].values.tolist():
        law, _, of = gains.rpartition(", ")
        rival = f"{law}, {NOMINAL}" if of == ROBUST else f"{which_law.PD}, {NOMINAL}"
        beside = paired.compared(walks, metrics, rival, goal)
        for metric in ("objective", *metrics):
            mean, worst = (beside.sel(metric=metric, statistic=each, gains=gains) for each in paired.STATISTICS)
            row = {"law": law or gains, "gains": of if law else "as configured", "metric": METRICS[metric]}
            row |= {"mean": f"{float(mean['value']):.4g}", "worst 5 %": f"{float(worst['value']):.4g}"}
            row |= {"lost": f"{float(lost.sel(gains=gains)):g}"}
            base = abs(float(mean["value"] - mean["difference"]))
            for end in ("difference", "low", "high"):
                size = 100 * float(mean[end]) / base if of == ROBUST else np.nan
                row[f"{end} from nominal %"] = f"{size:+.1f}" if np.isfinite(size) else ""
            yield row


def main(robust, nominal, file):
    """Write the table of all cases."""

    def rows(cell):
        case = {"case": cell.removeprefix("ideal_").replace("_", ".")}
        return [case | row for row in rows_of(walks_of(robust, nominal, cell))]

    which_law.write_cells(nominal, file, rows)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
