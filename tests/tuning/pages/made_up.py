"""Made-up walks and differences, with numbers that a reader can compute again, and their approved folders."""

from pathlib import Path

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from tests import approved
from tuning.comparisons import judge as judging
from tuning.pages import page, redrawn
from tuning.problem.ensemble import Ensemble, Worst
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Search
from tuning.problem.spaces import space

HERE = Path(__file__).parent / "approved"
ORIGIN = page.Origin("case", "mjx-climb ask", "mjx-climb again", "")
CASE = mc.load_scenario("case_1_2", {"duration": 0.3})
LIMITS = (Limit("base_deviation", 0.01, 0.01, 0.02, "as asked"),)
GOAL = Objective((Term("force_variation", 1.0, 100.0, 100.0),), LIMITS, worst=Worst())
PROBLEM = Problem(CASE, objective=GOAL, ensemble=Ensemble(members=5), space=space(CASE, Search()))


def same(name, contents):
    """Assert that a folder is the one that was approved, and return it."""
    approved.check(HERE / f"{name}.txt", approved.of_contents(contents, ORIGIN))
    return contents


def walks_of(names, members=5, level=1.0):
    """Walks of gains through a draw, with numbers that a reader can compute again: gains by members, in order."""
    rows = np.arange(1, len(names) + 1)[:, None] + 0.1 * np.arange(members)
    data = {}
    for place, metric in enumerate(mc.METRICS):
        data[metric.name] = (("gains", "member"), level * rows + place, dataset.metric_attributes(metric))
    data["peak_utilization"] = (("gains", "member"), 0.3 * rows, data["peak_utilization"][2])
    data["missed_grips"] = (("gains", "member"), (rows > 2.3).astype(int), data["missed_grips"][2])
    for name in ("diverged", "detached_limb", "detached_at"):
        data[name] = (("gains", "member"), np.full(rows.shape, 0 if name == "diverged" else -1), data[name][2])
    data["stands_at"] = (("gains", "member"), np.full(rows.shape, np.nan), data["stands_at"][2])
    lost = {judging.LOST_SENSORS: "mine ran without the force sensor of LF from 0.25 s in 1 of 5 walks"}
    return xr.Dataset(data, {"gains": names, "member": np.arange(members)}, lost)


def table_of(names, metrics, baseline, members=5):
    """Differences from a baseline: of the metric m and gains g the value 10 m + g, the ends one below and above."""
    metrics = ["objective", *metrics, "failed"]
    shape = (len(metrics), 2, len(names))
    value = 10.0 * np.arange(1, len(metrics) + 1)[:, None, None] + 3.0 * np.arange(len(names))
    value = value + np.array([0.0, 5.0])[:, None]
    value[-1, 0] = 0.2 * np.arange(len(names))
    value[[0, -1], 1] = np.nan
    difference = value - value[..., [names.index(baseline)]]
    fields = {"value": value, "difference": difference, "low": difference - 4, "high": difference + 4}
    fields["low"][1, 1] = fields["high"][1, 1] = np.nan
    fields |= {"walks_needed": np.full(shape, np.inf), "seeds_needed": np.full(shape, np.inf)}
    dims = ("metric", "statistic", "gains")
    made = xr.Dataset(
        {name: (dims, each) for name, each in fields.items()},
        {"metric": metrics, "statistic": ["mean", "worst"], "gains": names},
    )
    made["real"] = (made["low"] > 0) | (made["high"] < 0)
    made["larger_is_better"] = ("metric", np.array([name == "travel" for name in metrics]))
    about = {"baseline": baseline, "members": members, "members_compared": members - 1, "seeds": 3, "resamples": 40}
    return made.assign_attrs(about, lacks="", level=0.95, worst_share=0.05)


def drawn_again(name, contents, folder):
    """Assert that the pictures that a folder's files give are those that were approved."""
    for file, each in contents.files.items():
        if isinstance(each, xr.Dataset):
            dataset.save(each, folder / file)
        elif isinstance(each, str):
            (folder / file).write_text(each)
    text = (HERE / f"{name}.txt").read_text()
    drawn = [(stem, "\n".join(approved.of_figure(figure))) for stem, figure in redrawn.figures(folder)]
    assert drawn
    for stem, lines in drawn:
        assert lines in text.partition(f"--- {stem}\n")[2], stem
