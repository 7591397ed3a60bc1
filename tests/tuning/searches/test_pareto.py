"""The Pareto front: what is on it, and a search that goes on after an interrupt with the same result."""

from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import PlannedTransfer
from mjx_climb.files import dataset
from mjx_climb.scenario.shipped import config_path
from tuning.gains.gains_file import by_name
from tuning.gains.own_section import load_law
from tuning.pages.pareto import front_table, plot_front
from tuning.problem import spaces
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Pareto, Search
from tuning.results.front import gains_of, knee, without_sensor
from tuning.searches import pareto, retuned_pd

LAW = Path(__file__).parents[3] / "docs" / "guides" / "filtered_law.py"


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(retuned_pd, "FINE", (3, 2))
    for name, number in {"CANDIDATES": 6, "STAGES": 2, "ITERATIONS": 2}.items():
        monkeypatch.setattr(pareto, name, number)


def test_nondominated():
    x, y = np.array([3.0, 1.0, 2.0, 2.0, 4.0, 1.0]), np.array([1.0, 5.0, 3.0, 4.0, 1.0, 6.0])
    assert pareto.nondominated(x, y).tolist() == [1, 2, 0]
    assert pareto.nondominated(x, np.full(6, np.inf)).size == 0


def test_the_table_of_a_front_has_as_many_points_as_were_asked_for():
    values = {
        "stiffness": np.geomspace(1e2, 1e4, 40),
        "travel": np.arange(40.0),
        "force_variation": np.arange(40.0)[::-1],
    }
    data = {name: ("front", value, {"units": "1"}) for name, value in values.items()}
    data |= {f"without_{name}": ("without", np.zeros(0)) for name in ("travel", "force_variation", "kp", "kd")}
    data |= {f"reference_{name}": ("reference", [1.0, 3e86]) for name in ("travel", "force_variation")}
    data["reference_detached_limb"] = "reference", [-1, -1]
    data["reference_diverged"] = "reference", [0, 1]
    attributes = {"against": "travel", "better": "force_variation", "searched": "stiffness"}
    front = xr.Dataset(data, {"reference": ["config", "pd"]}, attributes)
    made = front_table(front, 17, 6, None)
    (_, on), (_, below) = made.sections
    assert [row[1] for row in on] == ["0", "8", "17", "23", "31", "39"] and [row[0] for row in on].index("knee") == 2
    assert made.caption == "The front: 6 of its 40 points, all of them in front.nc"
    assert [row[:3] for row in below] == [["config", "1", "1"], ["pd", "failed", "failed"]]


def test_knee_is_furthest_from_the_line_between_the_ends():
    assert knee(np.array([0.0, 1.0, 5.0, 10.0]), np.array([10.0, 2.0, 1.0, 0.0])) == 1
    assert knee(np.array([1.0]), np.array([1.0])) == 0


def test_the_rival_without_a_sensor_is_pds_best_that_costs_no_more():
    """Of a metric that is better the larger it is, too."""
    for against, sign in (("base_deviation", 1.0), ("min_tsm", -1.0)):
        x, y = sign * np.array([1.0, 2.0, 3.0]), np.array([5.0, 2.0, 1.0])
        data = {against: ("front", sign * np.array([0.5, 2.0, 2.5])), "force_variation": ("front", [9.0, 3.0, 1.0])}
        data |= {
            f"without_{against}": ("without", x),
            "without_force_variation": ("without", y),
            "n": ("without", [*"abc"]),
        }
        front = xr.Dataset(data, attrs={"against": against, "better": "force_variation"})
        found = [without_sensor(front, place) for place in range(3)]
        assert found[0] is None and [str(each["n"].values) for each in found[1:]] == ["b", "b"]


class Shares(Problem):
    """Metrics that are shares of the space; the margin is the larger the more the force varies."""

    def evaluate(self, theta, directions=None):
        if directions is not None and self.asked is not None:
            self.asked.append((theta, self.objective.limits[-1].value))
        shares = (theta - self.space.lower) / (self.space.upper - self.space.lower)
        found = {"base_deviation": shares[:, 0] + 0.1, "force_variation": 1.1 - shares[:, 0]}
        found |= {"peak_foot_force": shares[:, 1], "min_tsm": 0.1 + 1.0 - shares[:, 0]}
        ones = np.ones(len(theta))
        slopes = np.zeros((len(theta), 0 if directions is None else len(directions)))
        return Evaluation(ones, ones, 0 * ones, ones > 0, slopes, slopes, found)

    # what was asked for with gradients, and the rows' limits
    asked: ClassVar[list | None] = None


class Given(Exception):
    pass


@pytest.fixture
def given(few, monkeypatch):
    """Have a search of a front end with what it would make a dataset of."""

    def dataset(problem, asked, walked, widest):
        raise Given(walked, widest)

    monkeypatch.setattr(pareto, "front_dataset", dataset)


def test_rows_begin_at_the_best_point_within_their_limit(given, monkeypatch):
    """Of a metric that is better the larger it is, too."""
    monkeypatch.setattr(Shares, "asked", [])
    goal = Objective((Term("force_variation", 1.0, 1.0, 1.0),), ())
    problem = Shares(mc.Scenario(), spaces.space(mc.Scenario(), Search()), goal)
    with pytest.raises(Given) as found:
        pareto.run(problem, Search(), Pareto(against="min_tsm", points=3))
    walked, _ = found.value.args
    theta, limits = Shares.asked[0]
    first = walked.values["min_tsm"][:6], walked.values["force_variation"][:6]
    for row, limit in zip(theta, limits, strict=True):
        inside = np.where(first[0] >= limit, first[1], np.inf)
        np.testing.assert_array_equal(row, walked.theta[inside.argmin()])
    assert len(np.unique(theta, axis=0)) > 1


def test_points_of_a_front_keep_every_limit_but_that_of_what_is_traded(given):
    """The feet's force has a limit, the base's deviation those of the rows."""
    limits = tuple(Limit(name, 0.5, 0.5, 0.02, "") for name in ("base_deviation", "peak_foot_force"))
    goal = Objective((Term("force_variation", 1.0, 1.0, 1.0),), limits)
    problem = Shares(mc.Scenario(), spaces.space(mc.Scenario(), Search()), goal)
    with pytest.raises(Given) as found:
        pareto.run(problem, Search(), Pareto(points=2))
    walked, widest = found.value.args
    assert widest == pytest.approx(0.5)  # the limit itself, where the least variation is below it
    theta, held = walked.theta, walked.held
    deviation, force = ((theta - problem.space.lower) / (problem.space.upper - problem.space.lower)).T
    assert held.tolist() == (force <= 0.5).tolist() and 0 < held.sum() < held.size and deviation[held].max() > 0.5


# shares of the space of points that were walked: deviation and variation in the search, exactly, and what ended a walk
POINTS = [
    ((0.1, 0.9), (0.1, 0.9), ""),
    ((0.2, 0.7), (0.2, 0.95), ""),  # not on the front with its exact walk
    ((0.3, 0.5), (0.31, 0.5), ""),
    ((0.35, 0.6), (0.0, 0.0), ""),  # another is better in both
    ((0.5, 0.3), (0.5, 0.3), "tears off"),
    ((0.55, 0.2), (0.55, 0.2), "diverges"),
    ((0.6, 0.15), (0.6, 0.15), ""),
    ((0.8, 0.1), (0.8, 0.1), ""),  # beyond the widest limit
    ((0.05, 0.05), (0.05, 0.05), "breaks a limit"),
]


@pytest.mark.parametrize("widest, on", [(0.6, [0, 2, 6]), (0.01, [0, 2, 6, 7])])
def test_a_front_is_what_no_other_beats_in_its_exact_walk(few, monkeypatch, widest, on):
    """Within the widest limit where there is any; beside it config and pd, and the front without a force sensor.

    Load transfer by plan walks on the joint gains of pd's front: as pd does with the first, better with the second.
    """
    scenario, asked = mc.Scenario(), Pareto()
    limits = tuple(Limit(name, 0.55, 1.0, 0.02, "") for name in ("peak_foot_force", "base_deviation"))
    goal = Objective((Term("force_variation", 1.0, 1.0, 1.0),), limits)
    problem = Shares(scenario, spaces.space(scenario, Search(space="isotropic")), goal)
    span = problem.space.upper - problem.space.lower
    shares, exact, ends = zip(*POINTS, strict=True)
    theta, held = problem.space.lower + span * np.array(shares), np.array([end != "breaks a limit" for end in ends])
    x, y = np.where(held, np.array(shares).T, np.inf)
    walked = pareto.Walked(
        theta, dict(zip(("base_deviation", "force_variation"), np.array(shares).T, strict=True)), held, x, y
    )

    def walk(of, gains=None, parameters=None, **how):
        assert how["dtype"] is np.float64
        own, ended = {} if gains is None else by_name(gains), np.array("")
        if "kp" in own:
            stiffer, damped = (np.log(own[name] / getattr(scenario.control, name)) for name in ("kp", "kd"))
            rows = np.stack([0.5 - 0.1 * stiffer, 0.4 + 0.1 * stiffer + 0.01 * np.abs(damped)], -1)
            if isinstance(how.get("law"), PlannedTransfer):
                assert of.control.controller == "pd" and len(rows) == 2
                rows[:, 1] -= 0.1 * (stiffer < -0.01)
        elif own:
            points = np.log(np.stack([own[name][:, 0] for name in problem.space.names], -1))
            number = np.abs((points - problem.space.lower)[:, None] / span - shares).sum(2).argmin(1)
            rows, ended = np.array(exact)[number], np.array(ends)[number]
        else:
            rows = np.array([0.7, 0.7]) + (of.control.controller == "pd")
        found = dict.fromkeys(mc.METRICS.names, np.full(rows.shape[:-1], -1.0))
        found |= {
            "base_deviation": rows[..., 0],
            "force_variation": rows[..., 1],
            "peak_foot_force": 0.1 + rows[..., 1],
        }
        ended = np.broadcast_to(ended, rows.shape[:-1])
        return found | {"diverged": ended == "diverges", "detached_limb": np.where(ended == "tears off", 2, -1)}

    monkeypatch.setattr(mc, "rollout_metrics", walk)
    data = pareto.front_dataset(problem, asked, walked, widest)
    for name, values in zip(("base_deviation", "force_variation"), np.array(exact)[on].T, strict=True):
        np.testing.assert_array_equal(data[name], values)
    for place, name in enumerate(problem.space.names):
        np.testing.assert_allclose(np.log(data[name][:, 0]), theta[on, place])
    np.testing.assert_array_equal(data["reference_base_deviation"].sel(reference=["config", "pd"]), [0.7, 1.7])
    np.testing.assert_array_equal(data["held"], held)
    np.testing.assert_array_equal(data["theta"], theta)
    np.testing.assert_array_equal(data["walked_force_variation"], np.array(shares)[:, 1])
    # of the kp of pd's grid, 10, 45, 50 and 200, the first deviates too far and with the last the feet press too hard
    kp = np.array([scenario.control.kp, np.sqrt(10 * 200)])
    np.testing.assert_allclose(data["without_kp"], kp)
    np.testing.assert_allclose(data["without_kd"], scenario.control.kd)
    np.testing.assert_allclose(data["without_base_deviation"], 0.5 - 0.1 * np.log(kp / kp[0]))
    np.testing.assert_allclose(data["without_force_variation"], 0.4 + 0.1 * np.log(kp / kp[0]) - [0.0, 0.1])
    assert data["without_law"].values.tolist() == ["retuned_pd", "planned_unsearched"]
    last = data.sizes["front"] - 1
    _, (_, below) = front_table(data, last, 6, without_sensor(data, last)).sections
    assert below[-1][0].startswith("planned_unsearched, kp 44.7")


@pytest.mark.slow
@pytest.mark.nightly
def test_a_front_of_a_law_of_ones_own(few):
    """Its gains, of six axes and of one, are those of the walks on the front."""
    law = load_law(f"{LAW}:Filtered")
    scenario = mc.load_scenario(config_path("case_1_2.yaml"), ["duration=0.3", "disturbance.cargo.start=0.05"])
    front = pareto.pareto(scenario, points=2, law=law).data
    assert front.attrs["searched"].split() == ["stiffness", "damping", "cutoff", "share"]
    assert front["cutoff"].dims == ("front", "six") and front["share"].dims == ("front",)
    assert front["cutoff"].attrs["units"] == "Hz"
    gains = gains_of(front, 0)
    alone = mc.metrics(mc.rollout(scenario, gains, law=law))
    assert alone["force_variation"] == pytest.approx(front["force_variation"].values[0], rel=1e-6)
    own = mc.metrics(mc.rollout(scenario, law=law))["force_variation"]
    assert front["reference_force_variation"].sel(reference="config").item() == pytest.approx(own, rel=1e-6)
    assert len(front_table(front, 0, 3, None).columns) == 7


@pytest.mark.nightly
def test_front_and_resume(few, tmp_path, stop):
    scenario = mc.load_scenario(config_path("case_1_2.yaml"), ["duration=0.3", "disturbance.cargo.start=0.1"])
    whole = pareto.pareto(scenario, points=3).data
    x, y = whole["base_deviation"].values, whole["force_variation"].values
    assert (np.diff(x) > 0).all() and (np.diff(y) < 0).all()
    for i in range(whole.sizes["front"]):  # nothing that was walked beats the front, up to the walks' precision
        beaten = (whole["walked_base_deviation"] < 0.99 * x[i]) & (whole["walked_force_variation"] < 0.99 * y[i])
        assert not (beaten & whole["held"].astype(bool)).any()
    alone = mc.metrics(mc.rollout(scenario, gains_of(whole, 0)))
    assert alone["force_variation"] == pytest.approx(y[0], rel=1e-6)

    pd = scenario.with_overrides({"control.controller": "pd"})
    without = [whole[f"without_{name}"].values for name in ("base_deviation", "force_variation", "kp", "kd")]
    assert (np.diff(without[0]) > 0).all() and (np.diff(without[1]) < 0).all()
    for deviation, variation, kp, kd in zip(*without, strict=True):
        walk = mc.metrics(mc.rollout(pd.with_overrides({"control.kp": kp, "control.kd": kd})))
        assert (deviation, variation) == pytest.approx((walk["base_deviation"], walk["force_variation"]), rel=1e-6)
    reference = whole["reference_force_variation"].sel(reference="pd").item()  # it was among them
    assert without[1][-1] <= reference * (1 + 1e-9)
    for i in range(whole.sizes["front"]):
        rival, within = without_sensor(whole, i), without[0] <= x[i]
        assert (rival is None) == (not within.any())
        if rival is not None:
            assert rival["without_force_variation"].item() == without[1][within].min()

    with pytest.raises(KeyboardInterrupt):
        pareto.pareto(scenario, points=3, out=tmp_path, progress=stop(3))
    resumed = pareto.pareto(scenario, points=3, out=tmp_path).data
    for name in ("theta", "walked_force_variation", "force_variation", "stiffness"):
        np.testing.assert_array_equal(resumed[name], whole[name])
    dataset.save(whole, tmp_path / "front.nc")
    assert plot_front(dataset.load(tmp_path / "front.nc")).axes
