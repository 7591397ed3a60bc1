"""Searches: spaces, objectives, gradients, methods, and results that survive a kill."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
import tuning
from mjx_climb.control import law_of
from mjx_climb.files.dataset import OutputError
from mjx_climb.inputs.from_scenario import gains as gains_of
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.methods import Method, Request, Task, grid, method_of
from tuning.methods.rounds import follow, settled
from tuning.problem import evaluation, known, objectives, search, spaces
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Evaluation, Problem
from tuning.results import tuned
from tuning.searches import tune as searches
from tuning.searches.tune import problem_of, run, start_of, tune

SHORT = {"duration": 0.3, "disturbance.cargo.mass": 1.0, "disturbance.cargo.start": 0.05}


@pytest.fixture(scope="module")
def scenario():
    return mc.Scenario().with_overrides({"gravity": [0.0, 0.0, -1.635], **SHORT})


@pytest.mark.parametrize("searched", [tuning.tune, functools.partial(tuning.robust, ensemble=Ensemble(members=2))])
def test_the_space_is_resolved_once(scenario, monkeypatch, searched):
    resolved, resolve = [], spaces.space
    monkeypatch.setattr(spaces, "space", lambda *asked: resolved.append(resolve(*asked)) or resolved[-1])

    def walked(problem, *_, **__):
        raise LookupError(problem.space)

    monkeypatch.setattr(searches, "run", walked)
    monkeypatch.setattr(evaluation, "baseline", lambda *_: dict.fromkeys(mc.METRICS.names, 1.0))
    monkeypatch.setattr(evaluation, "pd_of", lambda *_, **__: dict.fromkeys(mc.METRICS.names, np.ones(2)))
    monkeypatch.setattr(objectives, "objective", lambda *_: None)
    with pytest.raises(LookupError) as stopped:
        searched(scenario)
    assert len(resolved) == 1 and stopped.value.args[0] is resolved[0]


@pytest.mark.parametrize("layout", search.LAYOUTS)
@pytest.mark.parametrize("inertia", [False, True])
def test_a_space_goes_to_gains_and_back(scenario, layout, inertia):
    space = spaces.space(scenario, search.Search.make({"space": layout, "inertia": inertia}))
    theta = space.draw(np.random.default_rng(0), 5)
    for point in theta:
        gains = jax.tree.map(np.asarray, space.to_gains(jnp.asarray(point)))
        assert gains.stiffness.shape == (6,)
        np.testing.assert_allclose(space.from_gains(gains), point, rtol=1e-5)
    assert space.size == (2 + inertia) * {"isotropic": 1, "split": 2, "diagonal": 6}[layout]
    assert space.ties.sum() == space.size


def test_own_gains_are_the_first_start_a_shared_one_at_the_geometric_mean_of_its_axes(scenario):
    space = spaces.space(scenario, search.Search())
    gains = space.to_gains(jnp.asarray(start_of(Problem(scenario, space))))
    np.testing.assert_allclose(gains.stiffness, np.broadcast_to(gains_of(scenario).stiffness, 6), rtol=1e-5)
    point = space.from_gains(mc.Gains(1.0, np.array([100.0, 400.0] * 3), 4e3))
    np.testing.assert_allclose(space.to_gains(jnp.asarray(point)).damping, 200.0, rtol=1e-5)


def test_pins_bounds_and_joint_gains(scenario):
    wanted = {"pins": {"damping.rotation": 7.0, "stiffness.x": 123.0}, "space": "diagonal", "joint_gains": True}
    wanted["bounds"] = {"stiffness": [10.0, 20.0], "stiffness.rz": [30.0, 40.0]}
    space = spaces.space(scenario, search.Search.make(wanted))
    assert "stiffness.x" not in space.names and "damping.rx" not in space.names and "kp" in space.names
    gains = space.to_gains(jnp.asarray(space.lower))
    np.testing.assert_allclose(gains.damping[3:], 7.0, rtol=1e-5)
    np.testing.assert_allclose(gains.stiffness, [123.0, 10.0, 10.0, 10.0, 10.0, 30.0], rtol=1e-5)
    assert space.on_bound(space.lower) == list(space.names)


def test_an_integral_gain_is_searched_where_there_is_one_or_it_is_asked_for(scenario):
    names = lambda changes, **wanted: spaces.space(scenario.with_overrides(changes), search.Search.make(wanted)).names  # noqa: E731
    assert "ki" not in names({}, joint_gains=True) and "ki" not in names({"control.ki": 20.0}, joint_gains=False)
    assert "ki" in names({"control.ki": 20.0}, joint_gains=True)
    space = spaces.space(scenario, search.Search.make({"also": ["ki"], "joint_gains": True}))
    assert float(space.to_gains(jnp.asarray(space.upper)).ki) == pytest.approx(10 * 0.5 * scenario.control.kp, rel=1e-5)
    start = space.from_gains({"ki": 7.0, "kp": 40.0})
    assert float(space.to_gains(jnp.asarray(start)).ki) == pytest.approx(7.0 if 7.0 > 2.5 else 2.5, rel=1e-5)


def test_joint_gains_that_shake_at_the_time_step_are_no_result(scenario):
    """One walk may seem well with them; nobody could walk with what was found."""
    settings = search.Search.make({"joint_gains": True})
    space = spaces.space(scenario, settings)
    problem = Problem(scenario, space)
    gains = [mc.Gains(1.0, 1e2, 3e3, kp=50.0, kd=kd) for kd in (0.9, 0.3, 0.8, 0.2)]
    arrays = {
        "theta": np.array([space.from_gains(each) for each in gains]), "value": np.array([0.1, 0.4, 0.2, 0.3]),
        "penalty": np.zeros(4), "feasible": np.ones(4, bool), "env_steps": np.arange(4),
        "phase": np.full(4, "population"),
    }  # fmt: skip
    found = tuned.from_rounds(problem, settings, arrays, interrupted=False)
    assert float(found.gains.kd) == pytest.approx(0.2) and found.feasible
    assert found.data["feasible"].values.tolist() == [False, True, False, True]
    assert tuned.best_of({name: found.data[name].values for name in ("value", "penalty", "feasible")}) == 3
    none = {**arrays, "theta": np.repeat(arrays["theta"][:1], 4, axis=0)}
    assert not tuned.from_rounds(problem, settings, none, interrupted=False).feasible


def test_joint_gains_that_shake_with_the_gait_beside_them_are_no_result(scenario):
    """A kd that the scenario's own gait can take, and strides of twice the length cannot."""
    settings = search.Search.make({"joint_gains": True, "also": ["gait.cycle"]})
    space = spaces.space(scenario, settings)
    gains = {"damping": 1e2, "stiffness": 3e3, "kp": 50.0, "kd": 0.59}
    arrays = {
        "theta": np.array([space.from_gains(gains | {"gait.cycle": cycle}) for cycle in (8.0, 4.0)]),
        "value": np.array([0.1, 0.2]), "penalty": np.zeros(2), "feasible": np.ones(2, bool), "env_steps": np.arange(2),
        "phase": np.full(2, "population"),
    }  # fmt: skip
    found = tuned.from_rounds(Problem(scenario, space), settings, arrays, interrupted=False)
    assert found.gains["gait.cycle"] == pytest.approx(4.0) and found.data["feasible"].values.tolist() == [False, True]


def test_bounds_are_those_of_the_robot(scenario):
    """HubRobo's as declared, in proportion for a robot from a file; joint gains about the scenario's own."""
    law = law_of(scenario)
    bounds = spaces.default_bounds(scenario, law)
    assert bounds == {**law.search_bounds(scenario.time_step), "kp": (10.0, 200.0), "kd": (0.02, 2.0)}
    softer = spaces.default_bounds(scenario.with_overrides({"control.kp": 25.0, "control.kd": 0.0}), law)
    assert (softer["kp"], softer["kd"]) == ((5.0, 100.0), pytest.approx((0.01, 1.0)))
    lemur = mc.load_scenario("lemur_like_cliff")
    heavier = float(load_robot(lemur.robot).total_mass / load_robot(scenario.robot).total_mass)
    assert heavier > 10
    found = spaces.default_bounds(lemur, law_of(lemur))
    assert found["stiffness.rotation"] == pytest.approx([heavier * end for end in bounds["stiffness.rotation"]])
    measured = lemur.with_overrides({"control.reading": "measured_pose"})  # its bounds come of inertia and time step
    own = law_of(measured)
    assert spaces.default_bounds(measured, own)["damping"] == own.search_bounds(measured.time_step)["damping"]


def test_settings_survive_yaml():
    settings = search.Search.make({"space": "split", "limits": {"base_deviation": 0.01}, "pins": {"damping": 3.0}})
    assert search.Search.parse(settings.to_yaml()) == settings


@pytest.mark.slow
def test_pd_scores_one_and_keeps_its_own_limits(scenario):
    baseline = evaluation.baseline(scenario)
    target = objectives.objective(search.Search(), baseline)
    walked = {name: jnp.asarray(value) for name, value in baseline.items()}
    score = target.score(walked | {"diverged": jnp.asarray(False)})
    assert float(score.value) == pytest.approx(1, rel=1e-5)
    assert float(score.descent - score.penalty) == pytest.approx(1, rel=1e-5)
    assert bool(score.feasible)
    (deviation,) = (limit.value for limit in target.limits if limit.metric == "base_deviation")
    assert deviation == pytest.approx(3 * baseline["base_deviation"])  # the limit where the settings name none
    for name in ("peak_foot_force", "peak_joint_torque", "base_deviation"):
        assert 0.6 * baseline[name] < baseline[f"smooth_{name}"] <= baseline[name]


def test_a_limit_is_penalised_before_it_breaks_and_judged_where_it_breaks():
    limit = objectives.Limit("base_deviation", 0.01, 0.01, 0.02, "")
    target = objectives.Objective((objectives.Term("force_variation", 1.0, 1.0, 1.0),), (limit,))
    deviation = jnp.array([0.0097, 0.0099, 0.0101, jnp.nan])
    walked = {"base_deviation": deviation, "force_variation": jnp.ones(4), "diverged": jnp.isnan(deviation)}
    score = target.score(walked)
    assert score.feasible.tolist() == [True, True, False, False]
    assert float(score.penalty[0]) == 0 and 0 < float(score.penalty[1]) < float(score.penalty[2])


@pytest.mark.nightly
@pytest.mark.parametrize("layout", ["isotropic", "split", "diagonal"])
def test_gradients_agree_with_central_differences(scenario, layout):
    """Each slope of the smooth objective, in float64, against differences of the same program's values."""
    weights = dict.fromkeys(("force_variation", "peak_foot_force", "peak_joint_torque", "min_tsm"), 1.0)
    wanted = {"space": layout, "inertia": True, "precision": "float64", "limits": {"base_deviation": 5e-4}}
    problem = problem_of(scenario, search.Search.make({**wanted, "weights": weights}))
    n, point = problem.space.size, problem.space.from_gains(mc.Gains(1.0, 300.0, 4e3))
    slopes = problem.evaluate(point[None], np.eye(n)).gradient[0]
    step = 1e-4
    moved = problem.evaluate(np.concatenate([point + step * np.eye(n), point - step * np.eye(n)])).descent
    differences = (moved[:n] - moved[n:]) / (2 * step)
    np.testing.assert_allclose(slopes, differences, rtol=1e-3, atol=1e-6 * np.abs(slopes).max())


@pytest.mark.nightly
def test_an_ensemble_scores_the_mean_of_its_members(scenario):
    problem = dataclasses.replace(problem_of(scenario, search.Search()), dtype=np.float64)
    theta = problem.space.draw(np.random.default_rng(1), 3)
    with jax.enable_x64(True):
        numbers = mc.parameters(scenario)
    masses = np.array([0.5, 1.5])[:, None]

    def values(mass, members):
        parameters = numbers.replace({"disturbance.cargo.mass": mass})
        return dataclasses.replace(problem, parameters=parameters, members=members).evaluate(theta).value

    np.testing.assert_allclose(values(masses, 2), sum(values(mass[0], 1) for mass in masses) / 2, rtol=1e-9)


class Bowl(Problem):
    """A problem whose landscape is a bowl in the log gains, with a dead corner."""

    BOTTOM = 0.6  # as a share of the space

    def evaluate(self, theta, directions=None):
        ratio = (theta - self.space.lower) / (self.space.upper - self.space.lower)
        steep, off = np.arange(1, 1 + theta.shape[1]), ratio - self.BOTTOM
        value = np.where((ratio < 0.1).any(1), np.nan, 0.5 + (off**2 * steep).sum(1))
        slope = 2 * off * steep / (self.space.upper - self.space.lower)
        slopes = slope @ (np.zeros((0, theta.shape[1])) if directions is None else directions).T
        slopes[np.isnan(value)] = np.nan
        zero = np.zeros(len(theta))
        metrics = dict.fromkeys(mc.METRICS.names, zero)
        return Evaluation(value, value, zero, np.isfinite(value), slopes, slopes, metrics)


def searched(scenario, start=start_of, **settings):
    """Return every request of a method in a bowl and what it was told, and how many rounds it said it would take."""
    search_settings = search.Search.make(settings)
    bowl, found = Bowl(scenario, spaces.space(scenario, search_settings)), []
    own = start(bowl)
    task, method = Task(bowl, search_settings, own, known.others(bowl, own)), method_of(search_settings.method)
    method.check(bowl.space, search_settings)

    def evaluate(request):
        found.append((request, bowl.evaluate(request.theta, request.directions)))
        return found[-1][1]

    follow(method.run(task), evaluate)
    return found, method.rounds(task)


@pytest.mark.parametrize(
    ("method", "layout"),
    [pair for pair in itertools.product(search.METHODS, ("isotropic", "diagonal")) if pair != ("grid", "diagonal")],
)
def test_methods_find_the_bottom_of_a_bowl(scenario, method, layout):
    if method == "optuna":
        pytest.importorskip("optuna")
    found, rounds = searched(scenario, space=layout, method=method)
    assert min(np.nanmin(answer.value) for _, answer in found) < 0.5 + {"optuna": 0.8}.get(method, 0.06)
    assert len(found) <= rounds


@pytest.mark.parametrize("method", search.METHODS)
@pytest.mark.parametrize("pins", [{}, {"damping": 150.0}])
def test_every_method_evaluates_the_configs_own_gains_and_searches_one_gain_too(scenario, method, pins):
    """So no result is worse than the config; as `tune --help` says."""
    if method == "optuna":
        pytest.importorskip("optuna")
    found, rounds = searched(scenario, method=method, pins=pins)
    space = spaces.space(scenario, search.Search(pins=pins))
    own = start_of(Problem(scenario, space))
    # the stiffest gains that the bounds let, which are the nearest to pd; the shipped law has no defaults
    for point in (own, space.upper):
        nearest = [np.abs(request.theta - point).max(1).min() for request, _ in found]
        assert min(nearest[:2]) < 1e-9 and space.size == 2 - len(pins)
    assert min(np.nanmin(answer.value) for _, answer in found) < 0.5 + 0.06
    assert len(found) <= rounds


def test_a_population_of_one_is_refused(scenario):
    with pytest.raises(mc.ConfigError, match=r"^starts: expected a population of 2 or more for cmaes, got 1$"):
        searched(scenario, method="cmaes", starts=1)


class Slope(Bowl):
    """A plane that falls steeply along the first axis and hardly along the second."""

    def evaluate(self, theta, directions=None):
        slopes = np.array([-1.0, -1e-4])
        zero, value = np.zeros(len(theta)), theta @ slopes
        gradient = np.tile(slopes @ directions.T, (len(theta), 1))
        return Evaluation(value, value, zero, np.ones(len(theta), bool), gradient, gradient, {})


def test_a_search_has_converged_when_it_finds_nothing_better_for_long_enough():
    """By evaluations, whatever their number in a round; one that is nowhere alive goes on."""
    merits = np.array([np.nan, 1.2, 1.0, 1.1, 0.9995, 1.3])
    assert not settled(merits, 6) and not settled(merits, 4) and settled(merits, 3) and not settled(merits[:4], 2)
    assert not settled(merits - [0, 0, 0, 0, 0.1, 0], 3) and not settled(np.full(9, np.nan), 3)


def test_a_search_of_patience_ends_where_it_has_converged(scenario):
    """Long before its rounds are spent; one that is cut short before says that it has not."""
    problem = Bowl(scenario, spaces.space(scenario, search.Search()))
    ends = {}
    for rounds in (3, 60):
        settings = search.Search(method="cmaes", starts=8, iterations=rounds)
        found = run(problem, settings, patience=80)
        ends[rounds] = found.converged, found.data.sizes["point"] // 8
    assert ends[3] == (False, 3) and ends[60][0] and 10 < ends[60][1] < 50
    assert run(problem, search.Search(method="cmaes", starts=8, iterations=1)).converged  # nobody asked


def test_a_refined_grid_reaches_as_far_as_the_next_points_of_the_last_one(scenario, monkeypatch):
    """About its best point alone: nothing between two points of a grid is left out by the next, finer one."""
    monkeypatch.setattr(grid, "CELLS", 1)
    walked = {"grid": [], "refined grid": []}
    for request, _ in searched(scenario, method="grid")[0]:
        walked[request.phase].append(request.theta)
    walked["grid"][0] = walked["grid"][0][1:]  # without the config's own gains
    levels = [np.concatenate(walked["grid"]), *walked["refined grid"]]
    assert len(levels) == 3
    for coarse, fine in itertools.pairwise(levels):
        steps = [np.diff(np.unique(axis.round(9))).min() for axis in coarse.T]
        np.testing.assert_allclose(np.ptp(fine, axis=0), 2 * np.array(steps), rtol=1e-6)


@pytest.mark.parametrize("method", ["grid", "cmaes", "gradient"])
def test_no_method_asks_for_gains_beyond_the_bounds(scenario, method, monkeypatch):
    monkeypatch.setattr(Bowl, "BOTTOM", 1.0)
    space = spaces.space(scenario, search.Search())
    for request, _ in searched(scenario, method=method)[0]:
        assert (request.theta >= space.lower - 1e-12).all() and (request.theta <= space.upper + 1e-12).all()


def test_a_dead_start_does_not_poison_the_others(scenario):
    found, _ = searched(scenario, start=lambda bowl: bowl.space.lower, starts=4)  # own gains in the dead corner
    assert [len(request.theta) for request, _ in found[1:]] == [4] * (len(found) - 1)
    assert all(np.isfinite(request.theta).all() for request, _ in found)
    alive = [answer.alive for _, answer in found]
    assert not alive[1][0] and alive[-1].all()


HOW = {"iterations": 3, "limits": {"base_deviation": 0.02}}


@pytest.fixture(scope="module")
def undisturbed(scenario):
    return tune(scenario, **HOW)


@pytest.mark.slow
def test_a_search_betters_pd_and_can_be_repeated_from_its_file(scenario, undisturbed, tmp_path):
    found = undisturbed
    assert found.value < 1
    assert found.env_steps == scenario.steps * (24 + 3 * 3 * 3)
    read = tuned.load(found.save(tmp_path / "search.nc"))
    for name in ("scenario", "search", "value", "env_steps"):
        assert getattr(read, name) == getattr(found, name)
    again = tune(read.scenario, read.search)
    np.testing.assert_array_equal(again.data["value"], read.data["value"])


@pytest.mark.slow
def test_an_objective_of_the_users_own(scenario):
    found = tune(scenario, objective=lambda m: m["peak_joint_torque"], **HOW | {"iterations": 2})
    assert found.value == pytest.approx(found.metrics["peak_joint_torque"])


@pytest.mark.slow
def test_a_search_without_a_finite_gradient_says_so(scenario):
    """It would draw random points to its end."""
    with pytest.raises(ConfigError, match="cmaes or grid, as no point that walks has a finite gradient"):
        tune(scenario, objective=lambda m: m["travel"] + jnp.sqrt(0 * m["travel"]), **HOW | {"iterations": 1})


@pytest.mark.slow
def test_ctrl_c_ends_with_the_best_so_far(scenario, undisturbed, tmp_path, stop):
    cut = tune(scenario, out=tmp_path, progress=stop(3), **HOW)
    assert cut.interrupted and cut.data.sizes["point"] == 24 + 2 * 3
    xr.testing.assert_equal(tune(scenario, out=tmp_path, **HOW).data, undisturbed.data)


def judging(weight, metrics):
    return weight * metrics["peak_joint_torque"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "judge",
    [lambda weight: functools.partial(judging, weight), lambda weight: lambda metrics: judging(weight, metrics)],
    ids=["partial", "closure"],
)
def test_a_search_for_another_objective_is_not_taken_for_an_interrupted_one(scenario, tmp_path, stop, judge):
    settings = HOW | {"iterations": 1, "out": tmp_path}
    assert tune(scenario, objective=judge(1.0), progress=stop(1), **settings).interrupted
    with pytest.raises(OutputError, match="another that differs in objective"):
        tune(scenario, objective=judge(100.0), **settings)
    assert tune(scenario, objective=judge(1.0), progress=stop(1), **settings).interrupted


def random_search(spread, task):
    """A method in five lines: points round the best so far."""
    rng, best = np.random.default_rng(task.search.seed), task.start
    for _ in range(3):
        theta = task.problem.space.clip(best + spread * rng.standard_normal((24, best.size)))
        found = yield Request(theta, None, "round the best")
        best = theta[np.argmin(found.merit)]


class RandomSearch(Method):
    """The same, which knows its rounds."""

    def rounds(self, task):
        return 3

    def run(self, task):
        return random_search(1.0, task)


@pytest.mark.slow
def test_a_method_of_ones_own_searches_and_is_taken_up_again(scenario, tmp_path):
    def stop(now):
        assert now.rounds_in_all == 0 and now.phase == "round the best"
        raise KeyboardInterrupt

    how = {"limits": {"base_deviation": 0.02}, "seed": 3}
    method = functools.partial(random_search, 1.0)
    assert tune(scenario, method=method, out=tmp_path, progress=stop, **how).data.sizes["point"] == 24
    with pytest.raises(OutputError, match="another that differs in method"):
        tune(scenario, method=functools.partial(random_search, 2.0), out=tmp_path, **how)
    seen = []
    resumed = tune(scenario, method=method, out=tmp_path, progress=seen.append, **how)
    undisturbed = tune(scenario, method=RandomSearch(), **how)
    assert [now.walked for now in seen] == [False, True, True] and resumed.search.method == "own"
    assert seen[-1].best == pytest.approx(resumed.value)
    xr.testing.assert_equal(resumed.data, undisturbed.data)
    assert resumed.value == undisturbed.value < 1


_KILLED = f"""
import sys
import mjx_climb as mc
from tuning.searches.tune import tune
scenario = mc.load_scenario(sys.argv[1])
print("begun", flush=True)
tune(scenario, out=sys.argv[2], progress=lambda now: print(now.rounds, flush=True), **{HOW})
"""


@pytest.mark.nightly
def test_a_killed_search_goes_on_bit_by_bit(scenario, undisturbed, tmp_path, killed):
    config = tmp_path / "scenario.yaml"
    config.write_text(scenario.to_yaml())
    for delay in np.random.default_rng().uniform(0, 0.5, 2):
        killed(_KILLED, config, tmp_path / "out", lines=2, delay=delay)  # begun, and the first round
    resumed = tune(scenario, out=tmp_path / "out", **HOW)
    np.testing.assert_array_equal(resumed.data["value"], undisturbed.data["value"])
    np.testing.assert_array_equal(resumed.gains.stiffness, undisturbed.gains.stiffness)
