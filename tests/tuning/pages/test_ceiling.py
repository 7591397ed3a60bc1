"""What is said of a ceiling, and what its folder holds, of made-up walks."""

import dataclasses
import html
import json

import numpy as np
import pytest
import scipy.stats
import xarray as xr

import mjx_climb as mc
import tuning
from tuning.pages import ceiling as pages
from tuning.problem.ceiling import Ceiling
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.results.ceiling import Bounded, mean_and_interval

SCENARIO = mc.Scenario().with_overrides({"duration": 0.3})
MEANS = {"clairvoyant": 0.6, "causal 5 ms": 0.65, "blind": 0.8, "mine": 0.7, "retuned_pd": 0.85, "pd": 1.0}


def bounded(means=MEANS, members=6, spread=0.01, left=0.005, broken=(), unseen=None, front=False):
    """A result whose contestants have these mean objectives; the members differ alike, but for a part of each."""
    rng, names = np.random.default_rng(0), list(means)
    shared = rng.normal(0, 0.1, members)
    values = np.array([mean + shared + rng.normal(0, spread, members) for mean in means.values()])
    values += (np.array([*means.values()]) - values.mean(1))[:, None]
    data = {
        "value": (("contestant", "member"), values),
        "feasible": (("contestant", "member"), np.array([[name not in broken] * members for name in names])),
    }
    for metric in mc.METRICS:
        data[metric.name] = (("contestant", "member"), np.abs(values) * 3, {"units": metric.unit})
    if unseen is not None:
        data["unseen_value"] = (("tested", "fresh"), np.array([[mean - 0.1, mean + 0.1] for mean in unseen.values()]))
        for metric in mc.METRICS:
            data[f"unseen_{metric.name}"] = (("tested", "fresh"), np.ones((len(unseen), 2)), {"units": metric.unit})
    records = [("blind, first", "pd", 0.2, 1.0, 0.85), ("blind, first", "mine", 0.2, 0.9, 0.84),
               ("blind, first", "mine", 0.1, 0.84, 0.8), ("blind", "blind", 0.2, 0.8, 0.8),
               ("blind", "blind", 0.1, 0.8, 0.8 * (1 - left))]  # fmt: skip
    for place, name in enumerate(("contestant", "start", "knots", "before", "merit")):
        data[f"descent_{name}"] = ("descent", np.array([record[place] for record in records]))
    data["descent_slope"] = ("descent", np.full(len(records), 0.1))
    data["foot_force_history"] = (("contestant", "instant"), np.ones((len(names), 5)))
    data["base_offset_history"] = (("contestant", "instant", "axis"), np.ones((len(names), 5, 3)))
    data["joint_targets"] = (("plan", "member", "time", "limb", "joint"), np.zeros((3, members, 9, 4, 3)))
    if front:
        data["front_share"] = ("point", np.array([0.0, 0.5, 1.0]))
        data["front"] = (
            ("point", "axis_of_front", "member"),
            np.arange(6.0)[:, None].repeat(members, 1).reshape(3, 2, -1),
        )
    coordinates = {"contestant": names, "plan": names[:3], "instant": np.arange(5) * 0.01}
    coordinates |= {} if unseen is None else {"tested": list(unseen)}
    attrs = {"limits": "base deviation at most 0.01", "hidden": 0, "own_gait": "", "scenario": SCENARIO.to_yaml()}
    ensemble = None if members < 2 else Ensemble(members=members)
    asked = Ceiling(knots=(0.2, 0.1), **({"against": "cost_of_transport"} if front else {}))
    return Bounded(xr.Dataset(data, coordinates, attrs), Problem(SCENARIO), ensemble=ensemble, asked=asked)


def test_a_sensor_is_worth_at_most_what_knowing_all_betters_the_blind_plan_by():
    found = bounded()
    assert found.sensor.mean == pytest.approx(0.2) and found.sensor.low < 0.2 < found.sensor.high
    assert found.share("mine") == pytest.approx(0.5) and found.share("pd") == pytest.approx(-1)
    assert found.spread == pytest.approx(0.85 / 0.84 - 1) and found.left == pytest.approx(0.005)
    said = pages.sentence(found)
    assert "at most 20.0 % of pd's objective" in said and "over 6 walks" in said
    assert "mine reaches 0.700, 50% of the way" in said


def test_the_two_best_of_many_starts_tell_how_far_the_search_is_known():
    """At the coarsest knots alone, whatever their order; of one start there is nothing to tell."""
    records = [("blind, first", 0.2, 0.9), ("blind, first", 0.2, 0.8), ("blind, first", 0.2, 0.84), ("blind", 0.2, 0.7),
               ("blind, first", 0.1, 0.6), ("blind, first", 0.1, 0.61)]  # fmt: skip
    names = ("contestant", "knots", "merit")
    data = {f"descent_{name}": ("descent", np.array([each[k] for each in records])) for k, name in enumerate(names)}
    found = dataclasses.replace(bounded(), data=xr.Dataset(data))
    assert found.spread == pytest.approx(0.84 / 0.8 - 1)
    assert np.isnan(dataclasses.replace(found, data=found.data.isel(descent=[0, 3, 4, 5])).spread)


@pytest.mark.parametrize("count", [2, 5, 30])
def test_a_mean_has_students_interval(count):
    values = np.random.default_rng(count).normal(0.2, 0.1, count)
    low, high = scipy.stats.t.interval(0.95, count - 1, values.mean(), scipy.stats.sem(values))
    assert mean_and_interval(values) == pytest.approx((values.mean(), low, high))
    mean, *none = mean_and_interval(values[:1])
    assert mean == values[0] and np.isnan(none).all()


def test_a_share_is_of_what_knowing_all_betters_and_of_laws_that_break_limits_the_least_is_the_best():
    worse = bounded({**MEANS, "clairvoyant": 0.9})
    assert all(np.isnan(worse.share(name)) for name in worse.contestants)
    assert bounded(broken=("mine", "retuned_pd", "pd")).best_law == "mine" and bounded().best_law == "mine"


def test_of_several_starts_at_one_spacing_the_best_tells_how_far_the_search_is_from_its_end():
    found = bounded()
    data = found.data.isel(descent=[1, 0, 3])  # the better start comes first
    found = dataclasses.replace(found, data=data, asked=Ceiling(knots=(0.2,)))
    assert found.left == pytest.approx(1 - 0.8 / 0.84)


@pytest.mark.parametrize(
    "how",
    [
        {"spread": 0.5},  # the interval holds 0
        {"left": 0.3},  # the search was far from its end
        {"means": {**MEANS, "clairvoyant": 0.8}},  # nothing
        {"members": 1, "left": 0.3},
    ],
    ids=lambda how: next(iter(how)),
)
def test_what_does_not_survive_is_not_claimed(how):
    said = pages.sentence(bounded(**how))
    assert "cannot be told from nothing" in said and "at most" not in said


@pytest.mark.parametrize(("own", "warned"), [("", False), ("mine", True), ("mine, retuned_pd", False)])
def test_a_gait_that_pd_lacks_is_said(own, warned):
    found = bounded()
    found.data.attrs["own_gait"] = own
    assert any("retuned_pd walks with the config's gait" in line for line in pages.notes(found)) == warned


def test_a_walk_that_was_lost_leaves_nothing_to_compare():
    assert (
        pages.sentence(bounded({**MEANS, "blind": np.nan})) == "A walk was lost, so that the plans cannot be compared"
    )


def test_a_law_that_breaks_a_limit_is_named_and_not_the_best():
    found = bounded(broken=("mine",))
    assert found.best_law == "retuned_pd"
    assert any("mine breaks a limit in 6 of 6 walks" in line for line in pages.notes(found))


def test_a_blind_plan_is_told_by_walks_that_it_was_not_searched_on():
    found = bounded(unseen={"blind": 0.9, "mine": 0.75, "pd": 1.0})
    assert any(
        "in 2 unseen walks, relative to pd in these: blind 0.900, mine 0.750" in line for line in pages.notes(found)
    )
    shown = pages.table(found)
    unseen = {row[0]: row[shown.columns.index("unseen")] for row in shown.sections[0][1]}
    assert unseen == {"clairvoyant": "-", "causal 5 ms": "-", "blind": "0.9000", "mine": "0.7500", "retuned_pd": "-",
                      "pd": "1.0000"}  # fmt: skip
    summary = pages.summary(found)
    assert summary["unseen"]["mine"]["objective"] == pytest.approx(0.75)
    assert list(summary["ceiling"]) == found.contestants
    assert summary["ceiling"]["blind"]["objective"] == pytest.approx(found.values("blind").mean())
    assert bounded().tested == {} and "unseen" not in pages.table(bounded()).columns


def test_a_front_is_a_table_and_part_of_the_summary():
    found = bounded(front=True)
    shown = pages.front_table(found)
    assert shown.columns[1:] == ["force variation N", "cost of transport"]
    assert shown.sections[0][1] == [["0", "0", "1"], ["50", "2", "3"], ["100", "4", "5"]]
    assert pages.summary(found)["front"] == {
        "metrics": ["force_variation", "cost_of_transport"], "points": [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]],
    }  # fmt: skip
    assert "front" not in pages.summary(bounded())


def test_one_walk_has_no_interval():
    found = bounded(members=1)
    assert np.isnan(found.sensor.low) and "one walk" in pages.sentence(found)


def test_the_first_screen_goes_from_the_best_plan_to_pd():
    page = pages.page_of(bounded())
    shown = [row[0] for _, rows in page.brief.sections for row in rows]
    assert shown == ["clairvoyant", "blind", "mine", "retuned_pd", "pd"]


@pytest.mark.slow
def test_its_folder_holds_the_sentence_the_table_and_the_plans(tmp_path):
    written = tuning.write(bounded(front=True), tmp_path)
    names = {file.name for file in tmp_path.iterdir()}
    assert names >= {
        "ceiling.nc",
        "ceiling.yaml",
        "report.html",
        "bounds.png",
        "first_walk.png",
        "front.png",
        "summary.json",
    }
    assert Ceiling.load(tmp_path / "ceiling.yaml").knots == (0.2, 0.1)
    assert json.loads(written.summary)["sensor"]["at_most"] == pytest.approx(0.2)
    text = html.unescape((tmp_path / "report.html").read_text("utf-8"))
    assert written.outcome[-1] in text and all(name in text for name in MEANS)
    with xr.open_dataset(tmp_path / "ceiling.nc", engine="h5netcdf") as data:
        assert data["joint_targets"].dims == ("plan", "member", "time", "limb", "joint")


def test_a_sensor_is_worth_the_best_law_that_reads_it_beside_the_best_that_does_not():
    found = bounded()
    assert pages.sensor_of_laws(found) == ""
    found.data.attrs["reads_forces"] = "mine"
    said = pages.sensor_of_laws(found)
    assert said.startswith("of the laws a force sensor is worth 15.0 % of pd's objective (95% interval ")
    assert said.endswith("mine 0.700, pd with its own kp and kd searched (retuned_pd) 0.850 without one")
    assert said in pages.notes(found)
