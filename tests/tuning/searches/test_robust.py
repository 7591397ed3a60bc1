"""Ensembles: what is drawn, how mean and worst count, and that a draw that was not seen judges."""

import dataclasses

import jax
import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
import tuning
from mjx_climb.control.recovering import Recovering
from mjx_climb.hardware import servo
from mjx_climb.hardware.stages import hardware_of, stages_of
from mjx_climb.scenario.load import load_hardware, with_hardware
from mjx_climb.scenario.shipped import config_path
from mjx_climb.walk.metrics import SENSORS
from tuning.comparisons import compare, judge
from tuning.methods import Request
from tuning.problem import ensemble as ensembles
from tuning.problem import search, spaces
from tuning.problem.ensemble import Ensemble, Worst, draw, worst_mean
from tuning.problem.evaluation import Problem, pd_of
from tuning.problem.objectives import Limit, Objective, Term, objective
from tuning.results import tuned
from tuning.searches import tune
from tuning.searches.shards import Rows
from tuning.searches.tune import MOST, finalists

FAST = ["duration=0.3"]
SHORT_PUSHES = {"start": (0.05, 0.1), "length": (0.05, 0.1)}


@pytest.fixture(scope="module")
def scenario():
    return mc.load_scenario(config_path("case_2.yaml"), FAST)


@pytest.fixture(scope="module")
def ensemble():
    return Ensemble.make({"members": 4, "pushes": SHORT_PUSHES, "cargo": {"start": (0.0, 0.1)}})


@pytest.fixture(scope="module")
def pd(scenario, ensemble):
    return {name: value.reshape(-1) for name, value in pd_of(scenario, draw(scenario, ensemble)).items()}


def test_yaml_round_trip(tmp_path, ensemble):
    (tmp_path / "e.yaml").write_text(ensemble.to_yaml())
    assert Ensemble.load(tmp_path / "e.yaml") == ensemble
    assert Ensemble.load(config_path("ensemble.yaml")) == Ensemble()  # the shipped one is the default


def test_a_seed_gives_one_draw_and_another_seed_another(scenario):
    first, again, other = (draw(scenario, Ensemble(members=5, seed=s)) for s in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (first, again)), strict=True))
    assert not np.array_equal(first.disturbances[0].mass, other.disturbances[0].mass)


def check_filled(values, low, high, share):
    """Values are within a range, and as near to both of its ends as a share of its width."""
    reach = share * (high - low)
    assert low - 1e-9 <= values.min() < low + reach and high - reach < values.max() <= high + 1e-9


def test_draws_fill_their_ranges(scenario):
    drawn = draw(mc.load_scenario(config_path("case_1_1.yaml")), Ensemble(members=200))
    pushes = drawn.disturbances[1:]
    assert drawn.gravity.shape == (200, 1, 3) and [push.force.shape for push in pushes] == [(200, 1, 3)] * 2
    pushed = np.stack([push.force for push in pushes], axis=-2)
    start, stop = (np.stack([getattr(push, name) for push in pushes], axis=-1) for name in ("start", "stop"))
    size = np.linalg.norm(drawn.gravity, axis=-1) / 9.81
    slope = np.degrees(np.arccos(-drawn.gravity[..., 2] / (9.81 * size)))
    force = np.linalg.norm(pushed, axis=-1)
    for values, *span in (
        (drawn.disturbances[0].mass, 0.0, 1.5), (size, 0.9, 1.1), (slope, 0.0, 10.0), (force, 1.0, 5.0),
        (drawn.contact.stiffness / 1e4, 0.5, 2.0), (drawn.mass_scale, 0.9, 1.1), (start, 0.5, 7.0),
        (stop - start, 0.2, 1.0),
    ):  # fmt: skip
        check_filled(values, *span, 0.02)
    directions = (pushed / force[..., None]).reshape(-1, 3)
    assert np.abs(directions.mean(0)).max() < 0.1 and np.abs((directions**2).mean(0) - 1 / 3).max() < 0.1


HARDWARE = {
    "force_delay": (0.002, 0.015), "control_rate": (100.0, 500.0), "force_noise": (0.05, 0.3), "friction": (0.5, 2.0),
    "armature": (0.5, 2.0), "force_filter": (10.0, 50.0), "force_bias": (-0.2, 0.2), "capture_distance": (0.001, 0.01),
}  # fmt: skip
SCALED = ("coulomb_friction", "load_friction", "viscous_friction", "armature")


def test_hardware_is_drawn_last_and_every_walk_has_its_own_noise():
    scenario = with_hardware(mc.load_scenario(config_path("case_2.yaml")), load_hardware("dynamixel_x"))
    scenario = scenario.with_overrides({"hardware.servo": {"load_friction": 0.1, "viscous_friction": 0.02}})
    own = jax.tree.map(np.asarray, mc.parameters(scenario))
    before = draw(scenario, Ensemble(members=50))
    drawn = draw(scenario, Ensemble.make({"members": 50, "hardware": HARDWARE}))
    for path in (
        "disturbance.pushes.0.force", "disturbance.pushes.1.force", "disturbance.cargo.mass", "gravity", "mass_scale",
        "contact.stiffness", "hardware.servo.backlash",
    ):  # fmt: skip
        np.testing.assert_array_equal(before.at(path), drawn.at(path))
    assert len(np.unique(drawn.bus.seed)) == 50 and before.bus.seed.ndim == 0
    rate = 1 / drawn.bus.control_period
    np.testing.assert_allclose(drawn.bus.control_period * 1000, np.round(drawn.bus.control_period * 1000), atol=1e-9)
    for values, low, high in (
        (drawn.force_sensor.delay, 0.002, 0.015), (rate, 100.0, 500.0), (drawn.force_sensor.noise, 0.05, 0.3),
        *((getattr(drawn.drive, name) / getattr(own.drive, name), 0.5, 2.0) for name in SCALED),
        (drawn.force_sensor.filter, 10.0, 50.0), (drawn.force_sensor.bias, -0.2, 0.2),
        (drawn.contact.capture_distance, 0.001, 0.01),
    ):  # fmt: skip
        assert values.shape == (50, 1)
        check_filled(values, low, high, 0.1)
    assert np.median(rate) == pytest.approx(np.sqrt(100.0 * 500.0), rel=0.15)


def test_all_friction_of_a_servo_is_scaled_alike():
    """That of an MX-64 is nearly all Stribeck's and the load's; what it can bear is linear in its coefficients."""
    scenario = with_hardware(mc.load_scenario(config_path("case_2.yaml")), load_hardware("mx_64"))
    own = mc.parameters(scenario)
    drawn = draw(scenario, Ensemble.make({"members": 1, "hardware": {"friction": (2.0, 2.0)}}))
    half = compare.on_better_hardware(scenario, own)["half the friction"]
    motor, load, rate = jax.numpy.asarray(np.random.default_rng(0).normal(0, 2, (3, 50)))
    stages = stages_of(own, scenario.time_step)
    bounds = [
        servo.friction_bound(motor, load, rate, hardware_of(parameters, stages, scenario.time_step))
        for parameters in (own, drawn, half)
    ]
    np.testing.assert_allclose(np.ravel(bounds[1]), 2 * bounds[0], rtol=1e-5)
    np.testing.assert_allclose(bounds[2], bounds[0] / 2, rtol=1e-5)
    viscous = [float(np.ravel(each.drive.viscous_friction)[0]) for each in (own, drawn, half)]
    np.testing.assert_allclose(viscous, 0.025337 * np.array([1, 2, 0.5]), rtol=1e-5)


def test_joint_gains_are_searched_where_there_is_hardware(scenario):
    late = scenario.with_overrides({"hardware.force_sensor.delay": 0.005})
    names = [spaces.space(s, search.Search()).names for s in (scenario, late)]
    assert names == [("damping", "stiffness"), ("damping", "stiffness", "kp", "kd")]
    assert spaces.space(late, search.Search.make({"joint_gains": False})).size == 2
    drawn = Ensemble.make({"hardware": {"force_delay": (0.0, 0.01)}})
    assert tune.over_ensemble(search.Search(), {}, drawn).joint_gains
    assert not tune.over_ensemble(None, {"joint_gains": False}, drawn).joint_gains
    assert tune.over_ensemble(search.Search(), {}, Ensemble()).joint_gains is None


def test_sections_that_are_null_leave_the_scenario(scenario):
    drawn = draw(scenario, Ensemble(members=3, pushes=None, cargo=None, gravity=None))
    own = mc.parameters(scenario)
    assert drawn.paths == own.paths
    for path, value in own.values.items():
        if path.startswith(("disturbance.", "gravity")):
            np.testing.assert_allclose(drawn.at(path), value, rtol=1e-6)


@pytest.mark.nightly
def test_mass_scale_is_a_robot_of_other_mass(scenario):
    """With all forces, masses and inertias twice as large the motion is the same."""
    numbers = jax.tree.map(np.asarray, mc.parameters(scenario.with_overrides({"gravity": [0, 0, -1.635]})))
    names = ("contact.stiffness", "contact.damping", "control.kp", "control.kd")
    forces = [path for path in numbers.paths if path.startswith("disturbance.pushes.") and path.endswith(".force")]
    twice = {path: 2 * numbers.at(path) for path in (*names, *forces)}
    assert forces
    heavy = numbers.replace({"mass_scale": np.asarray(2.0), **twice})
    gains = mc.Gains(np.ones(6), np.full(6, 1e3), np.full(6, 1e4))
    doubled = mc.Gains(2 * gains.inertia, 2 * gains.damping, 2 * gains.stiffness)
    light, big = (mc.rollout_metrics(scenario, g, n, dtype=np.float64) for g, n in ((gains, numbers), (doubled, heavy)))
    factors = {"peak_foot_force": 2, "force_variation": 2, "base_deviation": 1, "cost_of_transport": 1, "travel": 1}
    for name, factor in factors.items():
        assert big[name] == pytest.approx(factor * light[name], rel=1e-6), name
    alone = mc.metrics(mc.rollout(scenario, doubled, heavy))
    assert alone["cost_of_transport"] == pytest.approx(float(big["cost_of_transport"]), rel=1e-6)


def test_worst_mean():
    values = np.arange(20.0)[::-1]
    assert worst_mean(values, 0.05) == 19.0
    assert worst_mean(values, 0.2) == 17.5
    assert worst_mean(values, 0.22) == 17.0  # five of them: no smaller share than asked for
    assert worst_mean(values, 0.1, larger_is_better=True) == 0.5
    assert worst_mean(values, 1.0) == values.mean()


@pytest.mark.slow
def test_pd_scores_one(scenario, ensemble, pd):
    settings = search.Search.make({"weights": search.ROBUST_WEIGHTS})
    goal = objective(settings, pd, worst=ensemble.worst)
    score = goal.score({name: value[:, None] for name, value in pd.items()})
    assert float(score.value[0]) == pytest.approx(1.0, rel=1e-5)
    assert float(score.descent[0] - score.penalty[0]) == pytest.approx(1.0, rel=1e-5)
    # halved in one of four members: the mean falls, the worst fifth (one member) does not
    better = {name: value.copy() for name, value in pd.items()}
    least = int(np.argmin(pd["force_variation"]))
    better["force_variation"][least] *= 0.5
    one = dataclasses.replace(goal, terms=tuple(t for t in goal.terms if t.metric == "force_variation"))
    value, variation = one.score({name: v[:, None] for name, v in better.items()}).value[0], pd["force_variation"]
    assert float(value) == pytest.approx(1 - 0.5 * 0.5 * variation[least] / variation.sum(), rel=1e-5)


def test_mean_and_worst_count_by_their_weights():
    """Walks with 1 and 3 N where pd has 2 N in the mean and 4 N in the worse half; farther is better."""
    terms = (
        Term("force_variation", 3.0, 2.0, 2.0, worst=4.0),
        Term("travel", 1.0, 2.0, 2.0, larger_is_better=True, worst=1.0),
    )
    goal = Objective(terms, (), worst=Worst(share=0.5, weight=0.25))
    metrics = {"force_variation": [[1.0], [3.0]], "travel": [[1.5], [3.5]], "diverged": [[False], [False]]}
    value = goal.score({name: np.array(values) for name, values in metrics.items()}).value[0]
    assert value == pytest.approx((3 * (0.75 + 0.25 * 3 / 4) + (0.75 * (2 - 2.5 / 2) + 0.25 * (2 - 1.5))) / 4)


def test_walks_that_lose_a_gripper_count_by_their_number_and_break_no_limit():
    """Of four walks pd loses three, these gains two; the limit binds in those that hold alone."""
    terms = (Term("lost", 1.0, 0.75, 0.75, worst=1.0),)
    limits = (Limit("base_deviation", 0.01, 0.01, 0.02, ""),)
    goal = Objective(terms, limits, worst=Worst(share=0.25, weight=0.5))
    metrics = {"peak_utilization": [[0.93], [1.03], [0.2], [6.0]], "base_deviation": [[0.0], [1.0], [0.0], [1.0]]}
    rows = {name: np.array(values) for name, values in metrics.items()} | {"diverged": np.zeros((4, 1), bool)}
    score = goal.score(rows)
    assert float(score.value[0]) == pytest.approx(0.5 * 0.5 / 0.75 + 0.5)
    assert score.feasible.tolist() == [True] and float(score.penalty[0]) == 0.0
    rows["base_deviation"][2] = 0.02
    assert goal.score(rows).feasible.tolist() == [False]


@pytest.mark.nightly
def test_a_search_over_large_pushes_finds_thresholds_with_which_more_walks_hold():
    """Under pd's stiff gains, on walks of the search and on others; at their upper bounds thresholds interrupt none."""
    scenario = mc.load_scenario(config_path("case_2.yaml"), {"duration": 2.5})
    scenario = with_hardware(scenario, load_hardware("dynamixel_x"))
    pushes = Ensemble.load(config_path("ensemble_large_pushes.yaml")).pushes.model_copy(update={"start": (0.2, 0.7)})
    large = Ensemble.load(config_path("ensemble_large_pushes.yaml"), members=16, pushes=pushes)
    found = tuning.robust(
        scenario, large, method="cmaes", law=Recovering(), joint_gains=False, starts=12, iterations=4,
        weights={"lost": 1.0},
    )  # fmt: skip
    problem = found.problem
    points = np.stack([found.theta, problem.space.upper] * 6)  # as many as walked: the same compiled program
    for parameters in (problem.parameters, draw(scenario, judge.fresh(large))):
        value = dataclasses.replace(problem, parameters=parameters).evaluate(points).value[:2]
        assert value[0] < 0.8 * value[1], value


@pytest.mark.slow
def test_one_limit_broken_in_one_member_is_infeasible(scenario, ensemble, pd):
    goal = objective(search.Search.make({"no_worse_than_pd": False}), pd, worst=ensemble.worst)
    rows = {name: np.stack([value, value], axis=1) for name, value in pd.items()}
    rows["peak_utilization"][2, 1] = 16 / 15
    score = goal.score(rows)
    assert score.feasible.tolist() == [True, False]
    assert float(score.penalty[1]) > float(score.penalty[0])


def test_the_best_on_walks_that_no_search_has_seen_is_the_result():
    arrays = {"value": [0.1, 0.2, 0.9, 0.3, 0.6], "penalty": [0.0] * 5, "feasible": [True] * 5}
    assert tuned.best_of(arrays) == 0
    phases = ["population", "population", tuned.CHECKED, tuned.CHECKED, tuned.CHECKED]
    assert tuned.best_of(arrays | {"phase": phases}) == 3
    assert tuned.best_of(arrays | {"phase": phases, "feasible": [True, True, True, False, True]}) == 4


def box(size, width=1.0):
    lower, units = np.zeros(size), np.zeros(size)
    return spaces.Space(tuple(map(str, range(size))), lower, lower + width, units, {}, np.zeros(0))


def test_start_and_best_points_that_lie_apart_are_checked():
    theta = np.array([[0.0], [1.0], [2.0], [2.0], [2.01], [3.0], [0.0]])
    evaluated = {"theta": theta, "value": np.array([0.5, 0.4, 0.2, 0.2, 0.3, np.nan, 0.1]), "penalty": np.zeros(7)}
    first = Request(np.zeros((3, 1)), np.ones((1, 1)), "random points")
    asked = finalists(box(1), first, evaluated, np.zeros(1))
    assert [each.theta[:, 0].tolist() for each in asked] == [[0, 2, 1], [3, 0, 2], [1, 3, 0]]
    assert all(each.phase == tuned.CHECKED and each.directions is first.directions for each in asked)
    assert finalists(box(1, 0.4), first, evaluated, np.zeros(1))[0].theta[:, 0].tolist() == [0, 2, 2.01]


def test_of_large_rounds_a_few_points_are_checked():
    theta = np.arange(100.0)[:, None]
    (asked,) = finalists(
        box(1), Request(theta, None, ""), {"theta": theta, "value": theta[:, 0], "penalty": 0}, theta[0]
    )
    assert asked.theta[:, 0].tolist() == np.resize(np.arange(MOST), 100).tolist()


def test_a_search_that_ends_with_one_point_a_round_checks_others_than_its_start():
    """Descents end so: the start alone would be checked, and be the result whatever was found."""
    evaluated = {"theta": np.array([[0.0], [1.0]]), "value": np.array([1.0, 0.5]), "penalty": np.zeros(2)}
    asked = finalists(box(1), Request(np.zeros((1, 1)), np.eye(1), "winner alone"), evaluated, np.zeros(1))
    assert [each.theta.item() for each in asked] == [0, 1] * 4


def test_each_use_and_each_search_has_walks_of_its_own(ensemble):
    uses = [ensembles.of_search(ensemble, number) for number in range(8)]
    uses += [ensembles.fresh(ensemble, use) for use in ensembles.Use]
    assert len({own.seed for own in uses}) == 8 + 3 and uses[0] == ensemble


@pytest.mark.nightly
def test_search_and_judgement(scenario):
    """Forces are late in every walk: the joint loop is searched and judged with the admittance."""
    late = {"force_delay": (0.002, 0.005)}
    ensemble = Ensemble.make({"members": 4, "pushes": SHORT_PUSHES, "cargo": {"start": (0.0, 0.1)}, "hardware": late})
    found = tuning.robust(scenario, ensemble, method="cmaes", starts=4, iterations=2)
    assert found.data["phase"].values.tolist() == ["first points"] * 4 + ["population"] * 4 + [tuned.CHECKED] * 8
    assert found.env_steps == 16 * ensemble.members * scenario.steps
    assert found.gains.kp is not None
    paper, calm = mc.Gains(1.0, 5e3, 2e4), {"kp": 30.0, "kd": 0.5}
    rivals = {"robust": found.gains, "config": paper}
    fresh = judge.fresh(Ensemble(**vars(ensemble) | {"members": 6}))
    walked = judge.through(Problem(scenario), rivals, fresh, {"retuned_pd": calm})
    judged = walked.dataset(Rows(walked).walk())
    assert judged["force_variation"].dims == ("gains", "member")
    assert judged["gains"].values.tolist() == ["robust", "config", "retuned_pd", "pd"]
    unseen = draw(scenario, fresh)
    drawn = {path for path, value in unseen.values.items() if np.ndim(value) > len(unseen.paths[path].shape)}
    alone = unseen.replace({path: unseen.at(path)[3, 0] for path in drawn})
    pd = scenario.with_overrides({"control.controller": "pd"})
    for name, metrics in (
        ("robust", mc.rollout_metrics(scenario, found.gains, alone)),
        ("config", mc.rollout_metrics(scenario, paper, alone)),
        ("retuned_pd", mc.rollout_metrics(pd, calm, alone)),
    ):
        there = judged["force_variation"].sel(gains=name, member=3).item()
        assert there == pytest.approx(metrics["force_variation"].item(), rel=1e-3), name
    summed = judge.summary(judged)
    assert summed["force_variation"].dims == ("statistic", "gains")
    variation = judged["force_variation"].sel(gains="pd").values
    assert summed["force_variation"].sel(gains="pd", statistic="worst").item() == pytest.approx(variation.max())
    assert summed["failed"].values.tolist() == [0.0, 0.0, 0.0, 0.0]


def test_a_draw_says_in_how_many_walks_a_law_did_without_a_sensor(scenario):
    ensemble = Ensemble.make({"members": 3, "pushes": SHORT_PUSHES, "cargo": {"start": (0.0, 0.1)}})
    draw = judge.through(Problem(scenario), {"mine": mc.Gains(1.0, 5e3, 2e4)}, ensemble)
    names = [*draw.problem.metrics.names, *SENSORS.names]
    arrays = {name: np.zeros((3, 2)) for name in names}
    arrays["sensor_lost_limb"] = np.array([[-1, -1], [3, -1], [3, -1]])
    arrays["sensor_lost_at"] = np.array([[np.nan, np.nan], [0.5, np.nan], [0.24, np.nan]])
    found = draw.dataset(arrays)
    assert judge.lost_in_words(found) == [
        "warning: mine ran without the force sensor of RF from 0.24 s in 2 of 3 walks"
    ]
    arrays["sensor_lost_limb"][:] = -1
    assert judge.lost_in_words(draw.dataset(arrays)) == []


def judgement(**metrics):
    """Walks of two members with "mine" and "pd", by metric as [[mine], [pd]]."""
    rows = {"diverged": [[False] * 2] * 2, "joint_limit_margin": [[1.0] * 2] * 2}
    rows |= {"peak_utilization": [[1 / 15] * 2] * 2, "base_deviation": [[1e-3] * 2] * 2} | metrics
    data = {name: (("gains", "member"), np.array(values)) for name, values in rows.items()}
    return xr.Dataset(data, {"gains": ["mine", "pd"]})


def test_limits_are_judged_on_the_unseen_draw(scenario):
    base = judgement(force_variation=[[1.0, 2.0], [2.0, 4.0]], base_deviation=[[4e-3, 6e-3], [1e-3, 1e-3]])
    pd = {name: base[name].sel(gains="pd").values for name in base.data_vars}
    settings = search.Search.make({"weights": {"force_variation": 1.0}, "limits": {"base_deviation": 5e-3}})
    goal = objective(settings, pd, worst=Worst())
    shares = judge.broken(base, goal)
    asked = "base deviation at most 0.005 (set by the user)"
    assert shares.sel(limit=asked).values.tolist() == [0.5, 0.0]
    assert shares.drop_sel(limit=asked).max() == 0
    assert judge.scores(base, goal).values.tolist() == pytest.approx([0.5, 1.0])
    assert judge.binding(base, goal, "mine") == []
    near = judgement(force_variation=[[1.0, 2.0], [2.0, 4.0]], base_deviation=[[4e-3, 4.95e-3], [1e-3, 1e-3]])
    assert judge.binding(near, goal, "mine") == [asked]
    level = judgement(force_variation=[[1.0, 3.99], [2.0, 4.0]])
    assert judge.binding(level, goal, "mine") == ["mean of the worst 20% of force variation no worse than pd's"]
    lost = judgement(diverged=[[True, False], [False, False]], force_variation=[[1.0, 2.0], [2.0, 4.0]])
    assert judge.broken(lost, goal).sel(gains="mine").values.tolist() == [0.5] * len(goal.limits)


@pytest.mark.slow
def test_an_interrupted_search_goes_on_with_the_same_result(scenario, ensemble, tmp_path, stop):
    how, heard = {"method": "cmaes", "starts": 4, "iterations": 2}, []
    assert tuning.robust(scenario, ensemble, out=tmp_path, progress=stop(1), **how).interrupted
    resumed = tuning.robust(scenario, ensemble, out=tmp_path, progress=heard.append, **how)
    assert [now.walked for now in heard] == [False, True, True, True]
    assert [now.rounds_in_all for now in heard] == [3, 3, 4, 4]  # how many rounds a check takes is known when it begins
    xr.testing.assert_equal(resumed.data, tuning.robust(scenario, ensemble, **how).data)


@pytest.mark.nightly
@pytest.mark.slow
def test_gradients_of_the_robust_objective(scenario, ensemble):
    """Forward derivatives through all members and the worst of them agree with central differences."""
    settings = search.Search.make({"weights": {"force_variation": 1.0, "peak_pull_force": 1.0}, "precision": "float64"})
    problem = tune.problem_of(scenario, settings, ensemble=ensemble)
    theta = np.log([[1e3, 2e4]])
    step = 1e-4
    around = np.concatenate([theta, *(theta + sign * step * np.eye(2) for sign in (1, -1))])
    found = problem.evaluate(np.tile(theta, (5, 1)), np.eye(2))
    values = problem.evaluate(around).descent
    np.testing.assert_allclose(found.gradient[0], (values[1:3] - values[3:5]) / (2 * step), rtol=1e-3, atol=1e-7)


def test_gains_that_diverge_in_most_walks_of_a_search_are_left_out_and_else_the_walks():
    """In more than half, of one search; the members in which any of the others diverges are none of all."""
    diverged = np.zeros((3, 2, 4), bool)
    diverged[0, 1, :3] = diverged[1, 0, :2] = diverged[2, 1, 1] = True
    walks = xr.Dataset({"diverged": (("gains", "seed", "member"), diverged)}, {"gains": [*"abc"], "member": range(4)})
    kept = judge.held(walks)
    assert kept["gains"].values.tolist() == ["b", "c"] and kept["member"].values.tolist() == [2, 3]


def test_walks_that_fail_are_counted():
    names = [n for n in mc.METRICS.names if n not in ("detached_limb", "diverged", "stands_at")]
    values = np.array([[1.0, 2.0, 16.0], [4.0, 5.0, np.nan]])
    data = {n: (("gains", "member"), values, {"larger_is_better": int(mc.METRICS[n].larger_is_better)}) for n in names}
    data["diverged"] = (("gains", "member"), np.array([[False] * 3, [False, False, True]]))
    data["peak_utilization"] = (("gains", "member"), values / 15)
    judged = xr.Dataset(data, {"gains": ["robust", "pd"]})
    summed = judge.summary(judged)
    assert summed["failed"].values.tolist() == pytest.approx([1 / 3, 1 / 3])
    assert summed["peak_pull_force"].sel(statistic="mean").values.tolist() == [1.5, 4.5]  # without the diverged one
    assert summed["peak_pull_force"].sel(statistic="worst").values.tolist() == [2.0, 5.0]
    assert summed["travel"].sel(statistic="worst").values.tolist() == [1.0, 4.0]  # the least of it
    assert summed.attrs["members_compared"] == 2


@pytest.mark.nightly
def test_robust_gains_beat_the_papers_on_a_draw_that_was_not_seen():
    scenario = mc.load_scenario(config_path("case_1_2.yaml"))
    ensemble = Ensemble.load(config_path("ensemble.yaml"))
    found = tuning.robust(scenario, ensemble, method="gradient", starts=3, iterations=10)
    paper = mc.Gains(1.0, 5e3, 5e4)
    summed = judge.summary(judge.evaluate(scenario, {"robust": found.gains, "paper": paper}, ensemble).data)
    for metric, mean, worst in (("force_variation", 0.55, 0.55), ("peak_pull_force", 0.85, 0.95)):
        ratio = (summed[metric].sel(gains="robust") / summed[metric].sel(gains="paper")).values
        assert ratio[0] < mean and ratio[1] < worst, (metric, ratio)
    assert summed["failed"].sel(gains="robust") == 0
