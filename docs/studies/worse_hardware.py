r"""Table of laws on worse hardware: beside their own walks as drawn, and beside both laws that read no forces.

    python docs/studies/what_a_sensor_is_worth.py results/laws --varied --hardware dynamixel_x \
        --laws pd PlannedTransfer LoadTransfer --worse force_sensor.delay=0.03 friction=x2 force_sensor.dead.LF=3.0
    python docs/studies/worse_hardware.py results/laws docs/studies/worse_hardware.csv

Changes have a ~ where their interval holds 0: of a law that is searched once more, for all rows of a case at once.
"""

import csv
import sys
from pathlib import Path

import numpy as np
import xarray as xr
from which_law import BLIND, LAWS, METRICS, PD

import mjx_climb as mc
from mjx_climb.files import dataset
from tuning.comparisons import judge, paired
from tuning.comparisons.degraded import AS_DRAWN
from tuning.problem.objectives import Objective

METRICS = {name: words for name, words in METRICS.items() if name not in ("objective", "failed")}
NOTHING = Objective((), ())


def walks_of(folder, cell):
    """Return the walks of a cell over settings, laws, seeds and members."""
    found = {words: np.load(file) for name, words in LAWS.items()
             if (file := folder / f"{cell}_{name}_worse.npz").exists()}  # fmt: skip
    first = next(iter(found.values()))
    data = {}
    for name in (name for name in first.files if name != "settings"):
        attrs = dataset.metric_attributes(mc.METRICS[name]) if name in mc.METRICS.names else {}
        values = np.stack([np.swapaxes(own[name], -1, -2) for own in found.values()], 1)
        data[name] = (("setting", *paired.DIMS), values, attrs)
    _, _, seeds, members = data["diverged"][1].shape
    places = {"setting": [AS_DRAWN, *first["settings"].tolist()], "gains": list(found)}
    return xr.Dataset(data, places | {"seed": np.arange(seeds), "member": np.arange(members)})


def in_cells(table, metric, gains):
    """Return the changes of a metric's mean in per cent of the baseline's, as text."""
    cells = []
    for name in gains:
        own = table.sel(metric=metric, statistic="mean", gains=name)
        base = abs(float(own["value"] - own["difference"]))
        change = 100 * float(own["difference"]) / base if base else np.nan
        text = f"{'' if bool(own['real']) else '~'}{change:+.0f}" if np.isfinite(change) else ""
        cells.append("0" if abs(change) < 0.5 else text)
    return cells


def rows_of(walks):
    """Yield the rows of a case: of values, the metric, the law, as drawn, and in each setting."""
    settings, laws, metrics = walks["setting"].values.tolist(), walks["gains"].values.tolist(), list(METRICS)
    changes = {}
    for law in laws:
        own = walks.sel(gains=law, drop=True).rename(setting="gains").transpose(*paired.DIMS)
        changes[law] = paired.compared(own, metrics, AS_DRAWN, NOTHING, shared=settings[1:])
    for metric, law in ((metric, law) for metric in metrics for law in laws):
        drawn = float(changes[law]["value"].sel(metric=metric, statistic="mean", gains=AS_DRAWN))
        row = ["change from its own walks as drawn, %", METRICS[metric], law, f"{drawn:.3g}"]
        yield row + in_cells(changes[law], metric, settings[1:])
    for rival in (name for name in BLIND.values() if name in laws):
        of = f"difference from {'pd' if rival == PD else rival} in the same setting, %"
        each = [paired.compared(walks.sel(setting=name, drop=True), metrics, rival, NOTHING) for name in settings]
        for metric, law in ((metric, law) for metric in metrics for law in laws if law != rival):
            cells = [in_cells(table, metric, [law])[0] for table in each]
            yield [of, METRICS[metric], law, *cells]
    lost = judge.failed(walks).mean("seed").sum("member")
    for law in laws:
        yield [f"walks of {walks.sizes['member']}", "lost", law, *(f"{n:g}" for n in lost.sel(gains=law).values)]


def main(folder, file):
    """Write the table of all cases of a folder."""
    cells = sorted({each.name.partition("_pd_worse")[0] for each in folder.glob("*_pd_worse.npz")})
    with file.open("w", newline="") as out:
        table = csv.writer(out, lineterminator="\n")
        for place, cell in enumerate(cells):
            walks = walks_of(folder, cell)
            if place == 0:
                table.writerow(["case", "values", "metric", "law", *walks["setting"].values.tolist()])
            case = cell.removeprefix("dynamixel_x_").replace("_", ".")
            table.writerows([case, *row] for row in rows_of(walks))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
