"""Folders of made-up results, whole: files, page and pictures against texts that were read and computed by hand."""

import dataclasses
import json
import re

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from tests.tuning.pages.made_up import CASE, PROBLEM, drawn_again, same, table_of, walks_of
from tuning.comparisons import judge as judging
from tuning.comparisons import margins as margins_of
from tuning.comparisons.degraded import AS_DRAWN, Degradation
from tuning.comparisons.degraded import METRICS as OF_HARDWARE
from tuning.comparisons.linear_margins import Stable
from tuning.comparisons.of_draw import DrawComparison, verdict
from tuning.comparisons.of_ensemble import RobustComparison, shown
from tuning.comparisons.worth import Worth
from tuning.pages import degraded, judge, margins, page, pushes, redrawn, robust
from tuning.pages.contents import Contents, Written
from tuning.problem.ensemble import Ensemble
from tuning.problem.search import Search
from tuning.results.judged import Degraded, Judged
from tuning.results.tuned import AGREEMENT, CHECKED, Robust


def test_the_folder_of_evaluate(tmp_path):
    names = ["mine", "config", "pd"]
    walks = walks_of(names)
    found = Judged(walks, PROBLEM, ensemble=Ensemble(members=5, seed=3))
    table = table_of(names, shown(mc.METRICS), "pd")
    summed = judging.summary(walks)
    compared = DrawComparison(summed, table, "a sensor is worth nothing", verdict(summed))
    drawn_again("evaluate", same("evaluate", judge.contents(found, compared, "case.yaml")), tmp_path)
    (one,) = (figure for _, figure in redrawn.figures(tmp_path, ["travel"]))
    assert [panel.get_xlabel() for panel in one.axes] == ["travel [mm]"]


def test_lost_walks_are_whole_numbers_and_shares_those_of_all_walks():
    """29 of 100, whose share is a little less as a number; a walk that diverges is below no value."""
    walks = walks_of(["mine", "config", "pd"], members=100)
    table, lost = table_of(["mine", "config", "pd"], shown(mc.METRICS), "pd"), [0.29, 0.57, 0.0]
    summed = judging.summary(walks).assign(failed=("gains", lost))
    made = judge.contents(Judged(walks, PROBLEM, ensemble=Ensemble()), DrawComparison(summed, table, "", ""), "case")
    told = json.loads(made.written.summary)["gains"]
    assert {name: own["failed"] for name, own in told.items()} == {"mine": 29, "config": 57, "pd": 0}
    walks["force_variation"][0, :20] = np.nan
    mine, *_, pd = judge.plot_judged(walks, ["force_variation"]).axes[0].get_lines()[::3]
    assert (mine.get_ydata()[[0, -1]], pd.get_ydata()[-1]) == (pytest.approx([1, 80]), 100)


@pytest.mark.parametrize("told", [True, False])
def test_the_folder_of_a_search_over_an_ensemble(told):
    names = ["robust", "retuned_pd", "config", "pd"]
    walks, count = walks_of(names), 6
    points = {
        "value": [0.9, 0.8, np.nan, 0.7, 0.75, 2.0], "penalty": [0.0, 0.1, np.inf, 0.0, 0.0, 0.0],
        "feasible": [True, False, False, True, True, True], "env_steps": np.arange(1, 7) * 1000,
        "gradient_norm": [np.nan, 3.0, np.nan, 2.0, 1.0, np.nan] if told else [np.nan] * 6,
        "phase": ["population"] * 4 + [CHECKED if told else "population"] * 2,
    }  # fmt: skip
    data = xr.Dataset({name: ("point", np.array(each)) for name, each in points.items()}, {"point": np.arange(count)})
    data["theta"] = (("point", "coordinate"), np.zeros((count, 2)))
    data = data.assign_coords(coordinate=["stiffness", "damping"]).assign_attrs(interrupted=0)
    data = data.assign_attrs({AGREEMENT: "2 seeds agree"} if told else {})
    gains = mc.Gains(np.asarray(1.0), np.asarray(50.0), np.asarray(2e3))
    found = Robust(data, PROBLEM, Search(seed=4), Ensemble(members=5), gains, judges=5)
    if not told:
        found = dataclasses.replace(found, data=data.assign(feasible=("point", np.zeros(count, bool))))
    summed = judging.summary(walks)
    shares = [[0.25, 0.0, 0.5, 1.0]] if told else [[0.0] * 4]
    broken = xr.DataArray(shares, {"limit": ["a limit"], "gains": names}, ("limit", "gains"))
    summed = summed.assign(objective=("gains", [0.6, 0.7, 0.9, 1.0]), broken=broken)
    worth = Worth({"objective": -0.1}, "the force sensor pays") if told else None
    binding = ["base deviation at most 0.01 (as asked)"] if told else []
    joint, plain = {"kp": 17.0, "kd": 1.0} if told else {}, judging.plain(summed, shown(mc.METRICS))
    compared = RobustComparison(walks, summed, worth, "the verdict", joint, binding, plain)
    same(f"robust_{told}", robust.contents(found, compared, "case.yaml"))


@pytest.mark.parametrize("baseline", ["retuned_pd", "pd"])
def test_the_folder_of_worse_hardware(baseline):
    names = ["mine", *dict.fromkeys([baseline, "pd"])]
    settings = [AS_DRAWN, "delay=x2", "noise=x3"][: 3 if baseline == "pd" else 2]
    one = walks_of(names)
    each = [one.assign(force_variation=one["force_variation"] * (1 + place)) for place in range(len(settings))]
    walks = xr.concat(each, xr.Variable("setting", settings))
    found = Degraded(walks.assign_attrs(one.attrs), PROBLEM, ensemble=Ensemble(members=5, seed=2))
    losses = {name: table_of(settings, OF_HARDWARE, AS_DRAWN) for name in names}
    losses["pd"] = losses["pd"].assign(value=losses["pd"]["value"] * 0)  # nothing that per cent could be of
    lead = {each: table_of(names, OF_HARDWARE, baseline) for each in settings}
    same(f"worse_{baseline}", degraded.contents(found, Degradation(losses, lead, baseline), "case.yaml"))


def test_the_worst_setting_is_that_which_is_known_to_take_most():
    """What seems worse without being real is not named."""
    settings = [AS_DRAWN, "a", "b"]
    found = Degraded(xr.Dataset(coords={"member": range(5)}), PROBLEM)
    losses = table_of(settings, OF_HARDWARE, AS_DRAWN)
    lead = {each: table_of(["mine", "pd"], OF_HARDWARE, "pd") for each in settings}
    said = {}
    for name, real in {"both": [0, 1, 1], "first": [0, 1, 0], "none": [0, 0, 0]}.items():
        own = losses.copy(deep=True)
        own["real"].loc[{"metric": "force_variation", "statistic": "mean"}] = np.array(real, bool)
        said[name] = degraded.in_words(found, Degradation({"mine": own}, lead, "pd"))
    begin = ("mine: mean force variation as drawn 20 N, 13.0 % less than the best rival that walked, pd as the config "
             "has it: 23 N, which loses more walks; cannot be told apart: as drawn, a, b; ")  # fmt: skip
    end = "; mine loses most walks: b, 2 of 5"
    assert said == {
        "both": f"{begin}the force variation of mine rises most with b, from 20 to 26 N{end}",
        "first": f"{begin}the force variation of mine rises most with a, from 20 to 23 N{end}",
        "none": f"{begin}no rise of the force variation of mine can be told{end}",
    }
    lead["a"], lead["b"] = (lead["a"].copy(deep=True) for _ in range(2))
    for place, better in {"a": True, "b": False}.items():
        at = {"metric": "force_variation", "statistic": "mean", "gains": "mine"}
        lead[place]["real"].loc[at] = True
        lead[place]["difference"].loc[at] *= 1 if better else -1
    said = degraded.in_words(found, Degradation({"mine": own}, lead, "pd"))
    assert "; mine is ahead: a; mine is behind: b; cannot be told apart: as drawn; " in said
    own["difference"] = -own["difference"]
    own["real"][:] = True
    own["value"].loc[{"metric": "failed"}] = 0.0
    said = degraded.in_words(found, Degradation({"mine": own}, lead, "pd"))
    assert said.endswith(
        "; no rise of the force variation of mine can be told; mine loses no walk in any setting, of 5 in each"
    )


@pytest.mark.parametrize("wide", [True, False])
def test_the_files_of_margins(wide):
    """Of gains whose walks fail at known values: one quantity in s, one as a factor, one at a path."""
    asked = {"force_delay": ("force delay", "s", 0.004), "joint_gains": ("share of the joint gains", "x", 1.0),
             "contact.spread": ("contact.spread", "N", 0.25)}  # fmt: skip
    names, points = ["given", "pd", "config", "other"], 6
    value = np.array(
        [[0.0, 2e-3, 4e-3, 8e-3, 16e-3, 30e-3], [1, 0.8, 0.5, 0.3, 0.2, 0.05], [0.25, 0.3, 0.4, 0.5, 0.6, 0.7]]
    )
    force = np.arange(1, 5)[:, None, None] * (10.0 ** np.linspace(0, 1 if wide else 0.2, points)) * np.ones((1, 3, 1))
    detached, diverged = np.full(force.shape, np.nan), np.zeros(force.shape, bool)
    detached[0, 0, 4:], diverged[2, 0, 3:], diverged[1, 1, 5], force[2, 0, 3] = 1.0, True, True, np.nan
    detached[0, 2, 0] = 0.5
    dims = ("gains", "quantity", "point")
    walks = xr.Dataset(
        {"force_variation": (dims, force), "detached_at": (dims, detached), "diverged": (dims, diverged)},
        {"gains": names, "quantity": [*asked]},
    )
    walks["value"] = (("quantity", "point"), value)
    each = {
        name: margins_of.Margin(own, *how, float(value[row, -1]), title, unit)
        for row, ((name, (title, unit, own)), how) in enumerate(
            zip(asked.items(), [(8e-3, 4e-3), (0.05, None), (None, None)], strict=True)
        )
    }
    found = margins_of.Found(each, True, False, walks)
    stable = {
        "force_delay": Stable(7e-3, 16e-3),
        "joint_gains": Stable(0.05, 0.05),
        "contact.spread": Stable(None, 1.0),
    }
    written = Written(tables=[margins.margins_table(found, stable)])
    files = margins.files(found, stable, ["a warning"], "soft gains")
    same(f"margins_{wide}", Contents(written, PROBLEM, files, _page(written.tables).at))


def test_pictures_are_those_of_the_files_that_are_there(tmp_path, monkeypatch):
    """The way of a search lies over its map; a law of one's own is not here; metrics are of maps and of draws alone."""
    grid = xr.Dataset({"diverged": (("a", "b"), np.zeros((2, 2), int))}, {"a": [1.0, 2.0], "b": [1.0, 2.0]})
    own = ("gains", "seed", "member"), np.ones((2, 2, 3))
    walks = xr.Dataset({"travel": own, "missed_grips": (own[0], own[1].astype(int)), "diverged": (own[0], own[1] > 2)})
    walks["mass"] = "member", np.ones(3)
    there = {"map.nc": grid, "search.nc": xr.Dataset(), "compared.nc": walks}
    monkeypatch.setattr(redrawn.dataset, "load_trajectory", lambda file: file.name)
    monkeypatch.setattr(redrawn.dataset, "load", lambda file: there[file.name])
    monkeypatch.setattr(redrawn.tuned, "load", lambda file: file.name)
    monkeypatch.setattr(redrawn.paired, "taken", lambda data: ("taken", data))
    for name in ("plot_walk", "plot_feet", "plot_convergence", "plot_path", "plot_laws", "plot_judged", "sheet"):
        module = redrawn.plots if name in ("plot_walk", "plot_feet") else redrawn
        monkeypatch.setattr(module, name, lambda *given, name=name: (name, *given))

    def drawn(*files, metrics=()):
        folder = tmp_path / "-".join(files)
        folder.mkdir(exist_ok=True)
        for file in files:
            (folder / file).touch()
        return dict(redrawn.figures(folder, metrics))

    assert drawn("trajectory.nc") == {
        "walk": ("plot_walk", "trajectory.nc"), "feet": ("plot_feet", "trajectory.nc")
    }  # fmt: skip
    way = {"convergence": ("plot_convergence", "search.nc")}
    assert drawn("search.nc") == way
    assert drawn("search.nc", "map.nc") == {
        "map": ("sheet", grid, {}), **way, "path": ("plot_path", "search.nc", grid)
    }  # fmt: skip
    assert drawn("compared.nc") == {"compared": ("plot_laws", ("taken", walks))}
    for metric in ("travel", "missed_grips"):
        assert drawn("compared.nc", "search.nc", metrics=[metric]) == {"judged": ("plot_judged", walks, [metric])}
    there["search.nc"].attrs["law"] = "Mine"
    assert drawn("search.nc") == {}
    for files, said in (
        (["search.nc"], "expected a result with maps or an ensemble to draw metrics of, got search.nc"),
        (["compared.nc"], "--metric: expected one of travel, missed_grips, got 'mass'"),
        ([], "expected a folder with a result ("),
    ):  # fmt: skip
        with pytest.raises(mc.ConfigError, match=re.escape(said)):
            drawn(*files, metrics=["mass"])


def _page(tables):
    return page.Page("", page.Findings(""), CASE, tables=tables)


def test_the_files_and_the_page_of_pushes():
    """Draws that bear forces one above the other; one direction bears more than any, another less."""
    low = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    ways = {"up": low, "down": np.zeros(6), "left": np.full(6, 60.0), "right": np.repeat([0.0, 8.0], 3)}
    shape = (2, 2, 4, 6)
    survived = np.broadcast_to(np.stack([*ways.values()]), shape).copy()
    survived[1] = np.where(survived[1] < 60, survived[1] / 2, survived[1])
    beyond = np.where(survived >= 60, np.inf, np.where(survived > 0, 2 * survived, 60 / 64))
    dims = ("walker", "length", "direction", "draw")
    coordinates = {"walker": ["mine", "pd"], "length": [0.2, 1.0], "direction": [*ways]}
    found = xr.Dataset({"survived": (dims, survived), "lost": (dims, beyond)}, coordinates,
                       {"smallest": 60 / 64, "largest": 60.0})  # fmt: skip
    written = Written(summary="", outcome=[pushes.verdict(found)])
    contents = Contents(written, PROBLEM, pushes.files(found), pushes.page_of(found, CASE).at)
    same("pushes", contents)
