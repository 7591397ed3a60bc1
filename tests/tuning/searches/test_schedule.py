"""The gain schedule: each operating point is its own, and between them the gains go from one to the other."""

import csv
import dataclasses
import io
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import xarray as xr
import yaml

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.files.dataset import OutputError
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.scenario.shipped import config_path
from tuning.comparisons.worth import of_schedule
from tuning.gains.gains_file import by_name
from tuning.gains.own_section import load_law
from tuning.pages import schedule as pages
from tuning.pages.schedule import plot_schedule
from tuning.problem import spaces
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Schedule, Search
from tuning.results.scheduled import lookup
from tuning.searches import schedule

LAW = Path(__file__).parents[3] / "docs" / "guides" / "filtered_law.py"


@pytest.fixture(scope="module")
def scenario():
    return mc.load_scenario(config_path("case_1_2.yaml"), ["duration=0.3", "disturbance.cargo.start=0.1"])


@pytest.fixture(scope="module", autouse=True)
def few():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "CANDIDATES", 3)
        patch.setattr(schedule, "ITERATIONS", (1, 1))
        yield


def made(scenario, **how):
    return schedule.schedule(scenario, gravity=(1e-2, 1.0), cargo=(0.0, 1.0), no_worse_than_pd=False, **how).data


@pytest.fixture(scope="module")
def table(scenario, few):
    return made(scenario)


def test_each_operating_point_has_its_gravity_and_its_cargo(scenario, monkeypatch):
    """The cargo runs fastest, in what is walked as in the tables."""
    pd = dict.fromkeys(mc.METRICS.names, np.ones(6)) | {"diverged": np.zeros(6)}
    monkeypatch.setattr(schedule, "pd_of", lambda *_, **__: pd)
    asked = Schedule(gravity=(0.1, 1.0), cargo=(0.0, 0.5, 2.0))
    points = schedule.operating_points(scenario, Search(precision="float64"), asked)
    assert points.problem.dtype is np.float64
    np.testing.assert_allclose(points.problem.parameters.gravity[:, 2], [-0.981] * 3 + [-9.81] * 3)
    assert points.problem.parameters.disturbances[0].mass.tolist() == [0.0, 0.5, 2.0] * 2


@pytest.mark.parametrize(("limits", "expected"), [({}, [1e-3, 6e-3]), ({"base_deviation": 5e-4}, [5e-4, 5e-4])])
def test_a_base_may_deviate_a_millimetre_where_pd_hardly_sags(scenario, monkeypatch, limits, expected):
    """Three times pd's own, but without cargo or weight that is nothing; a limit that a user names stays."""
    pd = dict.fromkeys(mc.METRICS.names, np.ones(2)) | {"diverged": np.zeros(2)}
    monkeypatch.setattr(schedule, "pd_of", lambda *_, **__: pd | {"base_deviation": np.array([1e-5, 2e-3])})
    asked = Schedule(gravity=(1.0,), cargo=(0.0, 2.0))
    goals = schedule.operating_points(scenario, Search(limits=limits), asked).goals
    found = [limit.value for goal in goals for limit in goal.limits if limit.metric == "base_deviation"]
    assert found == expected


def test_pd_of_each_point_is_the_best_of_a_grid_that_keeps_the_limits(monkeypatch):
    """Where none keeps them it is that of the least value and penalty, at the last point, and is worth nothing."""
    kp, kd = np.array([20.0, 30.0, 40.0])[:, None], np.ones((3, 1))
    values, deviation = [[0.5], [0.9], [0.7]], [[2.0, 2.0], [1.0, 2.5], [1.0, 1.01]]
    walks = {"force_variation": np.broadcast_to(values, (3, 2)), "base_deviation": np.array(deviation)}
    walks |= {"diverged": np.zeros((3, 2), bool)}
    grid = {"kp": kp[:, 0], "kd": kd[:, 0]}, walks | {"detached_limb": np.full((3, 2), -1)}
    monkeypatch.setattr(schedule.retuned_pd, "walked_on_grid", lambda *_, **__: grid)
    goal = Objective((Term("force_variation", 1.0, 1.0, 1.0),), (Limit("base_deviation", 1.0, 1.0, 0.02, ""),))
    joint, worth = schedule.pd_of_each(Problem(mc.Scenario(), objective=goal))
    assert joint["kp"].tolist() == [40.0, 40.0] and joint["kd"].tolist() == [1.0, 1.0]
    np.testing.assert_allclose(worth, [0.7, np.nan])


class Valleys(Problem):
    """Points whose value is 1 at shares of the space that gravity and cargo say, and more about them.

    The share of the first coordinate has the limit of each row, in place of a metric's.
    """

    walked: ClassVar[list] = []

    def evaluate(self, theta, directions=None):
        own, span = self.parameters, self.space.upper - self.space.lower
        gravity, mass = np.abs(own.gravity[:, 2]), own.disturbances[0].mass
        shares = (theta - self.space.lower) / span
        away = shares - (0.2 + 0.03 * gravity + 0.2 * mass)[:, None]
        value, over = 1 + (away**2).sum(1), shares[:, 0] - np.asarray(self.objective.limits[0].value)
        slopes = np.zeros((len(theta), 0)) if directions is None else 2 * away / span @ directions.T
        found = Evaluation(value, value, np.maximum(over, 0), over <= 0, slopes, slopes, {"mass": mass})
        self.walked.append((theta, gravity / schedule.G, mass, value, over))
        return found


def valleys(scenario, highest=(2.0, 2.0, 2.0, -1.0)):
    """Return two levels of gravity with two cargos each; at the last point no gains keep the limit."""
    asked, search = Schedule(gravity=(0.1, 1.0), cargo=(0.0, 1.0)), Search(space="isotropic")
    level, load = np.array([0.1, 0.1, 1.0, 1.0]), np.array([0.0, 1.0, 0.0, 1.0])
    rows = {"gravity": schedule.G * level[:, None] * [0, 0, -1.0], "disturbance.cargo.mass": load}
    goals = [
        Objective((Term("force_variation", 1.0, 1.0, 1.0),), (Limit("base_deviation", most, 1.0, 0.02, ""),))
        for most in highest
    ]
    problem = Valleys(scenario, spaces.space(scenario, search), parameters=own_parameters(scenario).replace(rows))
    return schedule.OperatingPoints(dataclasses.replace(problem, objective=goals[0]), search, asked, goals)


def who_walks(scenario, gains=None, parameters=None, law=None, **_):
    """Return metrics that tell the law, the cargo and the first gain."""
    mass, given = parameters.disturbances[0].mass, by_name(gains) if gains is not None else {}
    of_law = {"pd": 100.0, "base_admittance": 200.0}[scenario.control.controller] if law is None else 300.0
    first = next(iter(given.values()), np.zeros(1))
    first = first[..., 0] if first.ndim > 1 and first.shape[-1] == 6 else first
    found = dict.fromkeys(mc.METRICS.names, np.zeros(np.broadcast_shapes(np.shape(first), mass.shape)))
    return found | {"travel": of_law + mass + found["travel"], "cost_of_transport": first + 0 * found["travel"]}


@pytest.fixture(scope="module")
def searched(scenario, few):
    """Return the operating points, the schedule and the rounds of a search in the valleys."""
    points = valleys(scenario)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "ITERATIONS", (3, 2))
        patch.setattr(mc, "rollout_metrics", who_walks)
        patch.setattr(Valleys, "walked", [])
        return points, schedule.run(points).data, Valleys.walked


def test_every_point_keeps_the_best_of_its_walks_and_goes_on_from_there(searched):
    """Random points, the config's own first; descents from the best so far, between which neighbours are tried."""
    points, found, walked = searched
    drawn, last, own = walked[0], walked[-1], schedule.tune.start_of(points.problem)
    assert [len(theta) for theta, *_ in walked] == [12, 4, 4, 4, 16, 4, 4, 16]

    def ranks(value, over):
        return np.where(over <= 0, value, 1e3 + value + np.maximum(over, 0))

    np.testing.assert_allclose(drawn[0].reshape(4, 3, -1)[:, 0], own[None].repeat(4, 0))
    assert np.ptp(drawn[0].reshape(4, 3, -1), axis=0).max() == 0 and np.ptp(drawn[0][:3], axis=0).min() > 0
    best, least = own[None].repeat(4, 0), np.full(4, np.inf)
    for number, (theta, gravity, mass, value, over) in enumerate(walked):
        if number in (1, 4, 5, 7):
            np.testing.assert_allclose(theta, best if len(theta) == 4 else np.tile(best, (4, 1)), err_msg=str(number))
        place = 2 * (gravity > 0.5) + mass.astype(int)
        assert (np.diff(place) >= 0).all()
        for at, one, rank in zip(place, theta, ranks(value, over), strict=True):
            if rank < least[at]:
                best[at], least[at] = one, rank
    assert (least[:3] < ranks(*drawn[3:]).reshape(4, 3).min(1)[:3]).all()
    value = np.append(least[:3], np.nan).reshape(2, 2)
    np.testing.assert_allclose(found["value"], value)
    np.testing.assert_array_equal(found["feasible"], np.isfinite(value))
    transfer = np.where(last[4] <= 0, last[3], np.nan).reshape(2, 2, 2, 2)
    np.testing.assert_allclose(found["transfer"], transfer)
    assert len(np.unique(transfer[0, 0])) > 2 and np.isnan(transfer[1, 1]).all()
    gains = by_name(spaces.to_gains64(points.problem.space, best))
    for name, values in gains.items():
        np.testing.assert_allclose(found[name], values.reshape(2, 2, *values.shape[1:]))
    assert found.attrs["env_steps"] == points.problem.env_steps(12 + 32) + 5 * points.problem.env_steps(4, 2)


def test_each_walk_of_a_schedule_has_the_gains_and_the_cargo_of_its_point(scenario, searched):
    _, found, _ = searched
    laws = {"tuned": 200.0, "config": 200.0, "retuned_pd": 100.0, "planned_unsearched": 300.0, "pd": 100.0}
    for walk, law in laws.items():
        np.testing.assert_array_equal(found["travel"].sel(walk=walk), law + np.array([[0.0, 1.0]] * 2))
    first = found.attrs["gains"].split()[0]
    own = {"tuned": found[first].values[..., 0], "config": 0.0, "retuned_pd": found["retuned_kp"].values}
    own["planned_unsearched"] = found["retuned_kp"].values
    for walk, gain in (own | {"pd": scenario.control.kp}).items():
        np.testing.assert_allclose(found["cost_of_transport"].sel(walk=walk), np.broadcast_to(gain, (2, 2)))


@pytest.mark.nightly
@pytest.mark.slow
def test_metrics_are_those_of_the_operating_point(scenario, table):
    point = table.isel(gravity=1, cargo=1)
    there = scenario.with_overrides({"gravity": [0, 0, -9.81], "disturbance.cargo.mass": 1.0})
    gains = mc.Gains(*(point[name].values for name in ("inertia", "damping", "stiffness")))
    pd = there.with_overrides({"control.controller": "pd"})
    for walk, *alone in (("tuned", there, gains), ("config", there), ("pd", pd)):
        metrics = mc.metrics(mc.rollout(*alone))
        for name in ("force_variation", "peak_foot_force", "base_deviation"):
            assert point[name].sel(walk=walk).item() == pytest.approx(metrics[name], rel=1e-6), (walk, name)


@pytest.mark.slow
@pytest.mark.nightly
def test_a_schedule_of_a_law_of_ones_own(scenario, few):
    law = load_law(f"{LAW}:Filtered")
    table = made(scenario, law=law)
    assert table["cutoff"].dims == ("gravity", "cargo", "six") and table["share"].dims == ("gravity", "cargo")
    there = scenario.with_overrides({"gravity": [0, 0, -9.81], "disturbance.cargo.mass": 1.0})
    alone = mc.metrics(mc.rollout(there, lookup(table, 1.0, 1.0), law=law))
    tuned = table["force_variation"].sel(walk="tuned", gravity=1.0, cargo=1.0).item()
    assert tuned == pytest.approx(alone["force_variation"], rel=1e-6)
    [head, *_] = pages.to_csv(table).splitlines()
    assert "cutoff_rz" in head and ",share," in head
    assert plot_schedule(table).axes


@pytest.mark.parametrize("other", [{"gravity": (0.5,)}, {"cargo": (0.5,)}])
def test_rounds_of_other_operating_points_are_refused(scenario, tmp_path, monkeypatch, other):
    held = {name: np.full(1, float(name != "diverged")) for name in mc.METRICS.names}
    monkeypatch.setattr(schedule, "pd_of", lambda *_, **__: held)
    monkeypatch.setattr(schedule.Rounds, "evaluate", lambda *_: pytest.fail("begun"))
    points = {"gravity": (1.0,), "cargo": (0.0,)}
    for _ in range(2):
        with pytest.raises(pytest.fail.Exception, match="begun"):
            schedule.schedule(scenario, **points, out=tmp_path)
    with pytest.raises(
        OutputError, match="no unfinished computation but this one, got another that differs in operating_points "
    ):
        schedule.schedule(scenario, **(points | other), out=tmp_path)


@pytest.mark.nightly
def test_no_operating_point_would_rather_have_the_gains_of_another(table):
    others = np.nanmin(table["transfer"].values, axis=(2, 3))
    assert table["feasible"].values.all() and (table["value"].values <= others + 1e-6).all()


def test_one_for_all():
    """The gains that lose least where they lose most; those that break a constraint somewhere are out."""
    value = np.array([[0.5, 0.6]])
    transfer = np.array([[[[0.5, 0.7]], [[0.9, 0.6]]]])  # [gravity, cargo, gravity of, cargo of]: loses 0.3, 0.2
    dims = ("gravity", "cargo")
    data = {"value": (dims, value), "transfer": ((*dims, "gravity_of", "cargo_of"), transfer)}
    table = xr.Dataset(data, {"gravity": [1.0], "cargo": [0.0, 2.0]})
    assert pages.one_for_all(table) == (1.0, 2.0, pytest.approx(0.2))
    table["transfer"][0, 0, 0, 1] = np.nan
    assert pages.one_for_all(table) == (1.0, 0.0, pytest.approx(0.3))
    assert pages.one_for_all(table.assign(transfer=np.nan * table["transfer"]))[2] == np.inf


@pytest.mark.nightly
def test_values_are_relative_to_pd_there(table):
    """Pd's own joint gains are of the grid what is worth most there: never less than pd, whose kp and kd are on it."""
    terms = ("force_variation", "peak_foot_force", "cost_of_transport")
    for walk, value in (("tuned", "value"), ("retuned_pd", "retuned_value")):
        of_pd = np.mean([table[t].sel(walk=walk) / table[t].sel(walk="pd") for t in terms], axis=0)
        np.testing.assert_allclose(table[value].values, of_pd, rtol=2e-3)
    assert (of_pd <= 1 + 1e-6).all() and (of_pd < 0.99).any()
    assert table["retuned_value"].dtype == np.float32  # of the search, whatever JAX is set to
    kp = table["retuned_kp"].values
    assert len(np.unique(kp)) > 1 and (kp >= 10 - 1e-9).all() and (kp <= 200 + 1e-9).all()


@pytest.mark.parametrize(
    ("ours", "theirs", "expected"),
    [
        ([0.8, 0.9], [1.0, 0.6], "no verdict on the force sensor, since pd was searched on a grid alone: less "
         "objective at 1 of 2 operating points, 0.800 to 1.500 times"),
        ([0.9, np.nan], [0.6, 0.5], "does not pay: less objective at 0 of 1 operating points, 1.500 times"),
        ([np.nan], [0.5], "not to be compared with pd: the gains keep the limits at no operating point"),
        ([0.5], [np.nan], "not to be compared with pd, which keeps the limits at no operating point"),
    ],
)  # fmt: skip
def test_what_a_force_sensor_is_worth_over_the_points(ours, theirs, expected):
    assert expected in of_schedule(xr.Dataset({"value": ("gravity", ours), "retuned_value": ("gravity", theirs)}))


def test_load_transfer_by_plan_is_a_rival_at_the_points_where_it_keeps_the_limits():
    table = xr.Dataset({"value": ("gravity", [0.8, 0.9]), "retuned_value": ("gravity", [1.0, 1.0])})
    said = of_schedule(table, np.array([0.5, np.nan]))
    assert "less objective at 1 of 2 operating points, 0.900 to 1.600 times the least of pd" in said
    assert said.endswith("and of load transfer by plan on these (planned_unsearched)")


def test_gains_between_operating_points_are_linear_in_log_gravity_and_cargo():
    """Logarithms are, of gains above 0 at all points; beyond the ends the gains stay."""
    stiffness, damping = np.array([[100.0, 400.0], [900.0, 2500.0]]), np.array([[0.0, 2.0], [4.0, 10.0]])
    each = {"stiffness": stiffness, "damping": damping, "inertia": 1 + damping}
    data = {name: (("gravity", "cargo", "six"), np.tile(values[..., None], 6)) for name, values in each.items()}
    table = xr.Dataset(data, {"gravity": [0.01, 1.0], "cargo": [0.0, 2.0]}, {"gains": " ".join(each)})
    for (gravity, cargo), (k, d) in {
        (0.01, 0.0): (100.0, 0.0), (1.0, 2.0): (2500.0, 10.0), (0.1, 0.0): (300.0, 2.0), (1.0, 1.0): (1500.0, 7.0),
        (0.1, 1.0): (np.sqrt(200 * 1500), 4.0), (5.0, 3.0): (2500.0, 10.0), (1e-3, -1.0): (100.0, 0.0),
    }.items():  # fmt: skip
        found = lookup(table, gravity, cargo)
        np.testing.assert_allclose(found.stiffness, k, rtol=1e-12)
        np.testing.assert_allclose(found.damping, d, atol=1e-12)


@pytest.mark.nightly
def test_lookup(table):
    for g, level in enumerate(table["gravity"].values):
        at = lookup(table, level, 1.0)
        np.testing.assert_allclose(at.stiffness, table["stiffness"].values[g, 1], rtol=1e-9)
    ends = table["damping"].values[:, 0]
    np.testing.assert_allclose(lookup(table, 0.1, 0.0).damping, np.sqrt(ends[0] * ends[1]), rtol=1e-9)
    np.testing.assert_allclose(lookup(table, 50.0, 0.0).damping, ends[1], rtol=1e-9)


@pytest.mark.nightly
def test_an_interrupted_schedule_goes_on_with_the_same_result(scenario, table, tmp_path, stop):
    with pytest.raises(KeyboardInterrupt):
        made(scenario, out=tmp_path, progress=stop(3))
    kept = sorted((tmp_path / "parts").glob("part-*"))
    assert len(kept) == 3
    before = [file.stat().st_mtime_ns for file in kept]
    resumed = made(scenario, out=tmp_path)
    assert [file.stat().st_mtime_ns for file in kept] == before  # not walked again
    xr.testing.assert_equal(resumed, table)


@pytest.mark.nightly
def test_tables(table, tmp_path):
    lines = list(csv.DictReader(io.StringIO(pages.to_csv(table))))
    there = [(float(row["gravity_G"]), float(row["cargo_kg"])) for row in lines]
    assert there == [(0.01, 0.0), (0.01, 1.0), (1.0, 0.0), (1.0, 1.0)]
    assert float(lines[3]["stiffness_rz"]) == pytest.approx(table["stiffness"].values[1, 1, 5], rel=1e-5)
    read = yaml.safe_load(pages.to_yaml(table))["operating_points"]
    assert read[0]["force_variation"].keys() == {"tuned", "config", "retuned_pd", "planned_unsearched", "pd"}
    dataset.save(table, tmp_path / "schedule.nc")
    assert plot_schedule(dataset.load(tmp_path / "schedule.nc")).axes
