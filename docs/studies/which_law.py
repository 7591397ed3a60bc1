"""Table of all metrics of laws beside pd, and beside the best law that reads no forces, on unseen walks.

    python docs/studies/what_a_sensor_is_worth.py results/laws --varied --laws pd PlannedTransfer LoadTransfer ...
    python docs/studies/which_law.py results/laws docs/studies/which_law.csv

Intervals are those of the program's own comparisons (`tuning/comparisons/paired.py`): of a law that is searched once
more, for all rows of a cell at once.
"""

import csv
import sys
from pathlib import Path

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from tuning.comparisons import judge, paired
from tuning.problem.objectives import Objective, Term

WEIGHTS = ("force_variation", "peak_foot_force", "cost_of_transport", "peak_joint_torque")
PD, HALVED, CONFIG = "pd, searched", "pd on half the friction", "as configured"
BLIND = {"pd": PD, "PlannedTransfer": "load transfer by plan"}  # laws that read no forces
LAWS = BLIND | {
    "LoadTransfer": "load transfer", "VirtualModelAdmittance": "Eq. 3, virtual model",
    "EndEffectorAdmittance": "Eq. 2, feet", "InternalForce": "internal force", "ClimbSDK": "Climb-SDK", HALVED: HALVED,
}  # fmt: skip
METRICS = {
    "objective": "objective", "force_variation": "V N", "peak_foot_force": "F N", "peak_pull_force": "P N",
    "cost_of_transport": "COT", "peak_joint_torque": "peak torque N m", "failed": "share lost",
}  # fmt: skip
OF = {"mean": "mean", "worst": "worst 5 %"}


def walks_of(folder, cell):
    """Return the unseen walks of a cell by law, seed and member, those of the config's pd last."""
    found = {words: np.load(file) for name, words in LAWS.items() if (file := folder / f"{cell}_{name}.npz").exists()}
    config = np.load(folder / f"{cell}_{CONFIG}.npz")
    data = {}
    for name in config.files:
        each = [own[name].T for own in found.values()]
        values = np.stack([*each, np.broadcast_to(config[name][:, :1].T, each[0].shape)])
        data[name] = (
            paired.DIMS,
            values,
            dataset.metric_attributes(mc.METRICS[name]) if name in mc.METRICS.names else {},
        )
    seeds, members = values.shape[1:]
    return xr.Dataset(data, {"gains": [*found, judge.PD], "seed": np.arange(seeds), "member": np.arange(members)})


def rows_of(walks):
    """Yield the rows of a cell: the law, the metric, the statistic, its value, and differences from both rivals."""
    goal = Objective(tuple(Term(name, 1.0, 1.0, 1.0) for name in WEIGHTS), ())
    metrics = [name for name in METRICS if name not in ("objective", "failed")]
    shared = [name for name in walks["gains"].values if name == HALVED]
    beside = paired.compared(walks, metrics, PD, goal, shared=shared)
    blind = [name for name in BLIND.values() if name in walks["gains"]]
    objective = beside["value"].sel(metric="objective", statistic="mean")
    best = min(blind, key=lambda name: float(objective.sel(gains=name)))
    tables = {"pd": beside, "the best without forces": beside}
    if best != PD:
        tables["the best without forces"] = paired.compared(walks.drop_sel(gains=shared), metrics, best, goal)
    for law in walks["gains"].values.tolist():
        for metric, (statistic, of) in ((metric, own) for metric in METRICS for own in OF.items()):
            place = {"metric": metric, "statistic": statistic, "gains": law}
            if metric == "failed" and statistic == "worst":
                continue
            row = {"law": law.replace(judge.PD, "pd as configured") if law == judge.PD else law}
            row |= {"metric": METRICS[metric], "of 512 walks": of, "value": f"{float(beside['value'].sel(place)):.4g}"}
            for rival, table in tables.items():
                there = law in table["gains"].values and law != table.attrs["baseline"] and metric != "failed"
                own = table.sel(place) if there else None
                for end in ("low", "high"):
                    base = float(own["value"] - own["difference"]) if there else np.nan
                    size = 100 * float(own[end]) / abs(base) if there else np.nan
                    row[f"95 % {end}: difference from {rival} %"] = f"{size:+.1f}" if np.isfinite(size) else ""
            yield row | {"best without forces": best}


def main(folder, file):
    """Write the table of all cells of a folder."""

    def rows(cell):
        servos, case = next((each, cell[len(each) + 1 :]) for each in ("ideal", "dynamixel_x", "mx_64") if each in cell)
        place = {"servos": servos, "case": case.replace("_", ".")}
        return [place | row for row in rows_of(walks_of(folder, cell))]

    write_cells(folder, file, rows)


def write_cells(folder, file, rows):
    """Write a table of the `rows` of all cells of a folder, by the name of each."""
    suffix = f"_{CONFIG}.npz"
    found = [row for each in sorted(folder.glob(f"*{suffix}")) for row in rows(each.name.removesuffix(suffix))]
    with file.open("w", newline="") as out:
        writer = csv.DictWriter(out, list(found[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(found)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
