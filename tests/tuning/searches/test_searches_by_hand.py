"""Searches of landscapes that are formulas, against the same rules written a second time, with loops."""

import dataclasses
import itertools
import math
from typing import ClassVar

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance
from mjx_climb.execution import devices
from tuning.comparisons import judge
from tuning.methods import Request
from tuning.methods.rounds import Progress, settled
from tuning.problem import spaces
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Pareto, Search
from tuning.searches import pareto, sweep, tune
from tuning.searches.shards import Kept, Shard

CASE = mc.load_scenario("case_1_2", {"control.ki": 3.0})


class Landscape(Problem):
    """Values, penalties and metrics that depend on the point by sines: rough, some points diverge, few keep limits."""

    asked: ClassVar[list] = []

    def evaluate(self, theta, directions=None):
        self.asked.append((theta, directions, self.objective))
        waves = np.sin(np.outer(theta @ np.arange(1.0, 1 + theta.shape[1]), [1.0, 7.0, 3.0, 11.0, 5.0]))
        value = 1 + 0.3 * waves[:, 0]
        descent = np.where(waves[:, 1] > 0.9, np.nan, value + 0.1)
        penalty = np.maximum(waves[:, 2], 0.0)
        slopes = np.cos(theta) @ (np.zeros((0, theta.shape[1])) if directions is None else directions).T
        metrics = dict.fromkeys(mc.METRICS.with_companions.names, np.zeros(len(theta)))
        metrics |= {"base_deviation": 0.02 + 0.01 * waves[:, 3], "min_tsm": 0.1 + 0.05 * waves[:, 3],
                    "force_variation": 5 + 2 * waves[:, 4], "peak_foot_force": 10 + waves[:, 0]}  # fmt: skip
        return Evaluation(value, descent, penalty, penalty == 0, slopes, slopes, metrics)


def landscape(settings, **more):
    Landscape.asked.clear()
    return Landscape(CASE, spaces.space(CASE, settings), **more)


def test_rounds_record_every_point_and_report_how_far_a_search_has_come():
    """Of a search by gradients: what has been spent, the best that keeps its limits, the slope at the best point."""
    settings, heard = Search(space="split", iterations=4, seed=2, joint_gains=False), []
    problem = landscape(settings, members=3)
    found = tune.run(problem, settings, progress=heard.append)
    requests, data = [*Landscape.asked], found.data
    assert len(heard) == len(requests) and heard[-1].rounds_in_all == len(requests)
    spent, best, begin = 0, math.inf, 0
    for number, (theta, directions, _) in enumerate(requests):
        again = problem.evaluate(theta, directions)
        tangents = 0 if directions is None else len(directions)
        spent += len(theta) * 3 * CASE.steps * (1 + tangents)
        best = min([best, *again.value[again.feasible]])
        told = heard[number]
        place = int(np.argmin(again.merit))
        norm = np.linalg.norm(again.gradient[place]) if tangents else math.nan
        assert told == Progress(
            number + 1, len(requests), told.phase, pytest.approx(best) if best < math.inf else told.best,
            pytest.approx(norm, nan_ok=True), int(np.isfinite(again.descent).sum()), len(theta), spent, True,
        )  # fmt: skip
        rows = slice(begin, begin + len(theta))
        for name in ("value", "descent", "penalty", "feasible"):
            np.testing.assert_array_equal(data[name][rows], getattr(again, name))
        np.testing.assert_array_equal(data["theta"][rows], theta)
        np.testing.assert_array_equal(data["row"][rows], np.arange(len(theta)))
        np.testing.assert_array_equal(data["round"][rows], number)
        np.testing.assert_array_equal(data["env_steps"][rows], spent)
        assert set(data["phase"].values[rows]) == {told.phase}
        norms = np.linalg.norm(again.gradient, axis=1) if tangents else np.full(len(theta), np.nan)
        np.testing.assert_allclose(data["gradient_norm"][rows], norms)
        np.testing.assert_array_equal(data["force_variation"][rows], again.metrics["force_variation"])
        begin += len(theta)
    assert begin == data.sizes["point"] and "smooth_peak_foot_force" not in data and math.isnan(heard[0].gradient_norm)


def test_before_a_point_keeps_the_limits_there_is_no_best():
    class Never(Landscape):
        def evaluate(self, theta, directions=None):
            return super().evaluate(theta, directions)._replace(feasible=np.zeros(len(theta), bool))

    heard, settings = [], Search(starts=1, iterations=2, joint_gains=False)
    tune.run(Never(CASE, spaces.space(CASE, settings)), settings, progress=heard.append)
    assert all(math.isnan(each.best) for each in heard)


@pytest.mark.parametrize("seed", range(6))
def test_the_points_that_are_checked_are_the_start_and_the_best_others(seed):
    """Each once and none beside a better one, those that diverged last; repeated where they do not fill the rounds."""
    rng = np.random.default_rng(seed)
    theta = rng.integers(0, 4, (12, 2)).astype(float)
    value, penalty = theta @ [1.0, 0.3] + 0.01 * rng.integers(0, 3, 12), np.zeros(12)
    value[rng.integers(0, 12, 2)] = np.nan
    start, size = theta[3], int(rng.integers(1, 15))
    ranked, others = sorted(range(12), key=lambda n: (math.inf if np.isnan(value[n]) else value[n], n)), []
    width = np.array([10.0, 1.5 / tune.NEAR])
    space = spaces.Space(("a", "b"), np.zeros(2), width, np.zeros(2), {}, np.zeros(0))
    for n in ranked:
        apart = [math.dist(theta[n] / width, each / width) / math.sqrt(2) for each in others]
        if (theta[n] != start).any() and all(each > tune.NEAR for each in apart):
            others.append(theta[n])
    rounds = next(count for count in itertools.count(1) if count * size >= tune.FINALISTS)
    wanted = list(itertools.islice(itertools.cycle([start, *others[: rounds * size - 1]]), rounds * size))
    first = Request(np.zeros((size, 2)), np.eye(2), "first")
    found = tune.finalists(space, first, {"theta": theta, "value": value, "penalty": penalty}, start)
    assert np.concatenate([each.theta for each in found]).tolist() == np.array(wanted).tolist()
    for each in found:
        assert each.directions is first.directions and each.phase != "first" and len(each.theta) == size


def test_seeds_search_one_after_the_other_in_folders_of_their_own(monkeypatch, tmp_path):
    """Numbered from the settings' own; rounds are counted over all of them, phases named by the seed."""
    asked, heard = [], []

    def run(problem, search, *, out, progress):
        asked.append((search.seed, out, problem.ensemble and problem.ensemble.seed))
        progress(Progress(7, 10, "some", 1.0, 0.0, 1, 1, 5, True))
        progress(Progress(8, 10, "some", 1.0, 0.0, 1, 1, 5, True))
        return dataclasses.make_dataclass("Found", ["interrupted"])(search.seed == stops)

    monkeypatch.setattr(tune, "run", run)
    monkeypatch.setattr(tune, "of_seeds", list)
    monkeypatch.setattr(
        tune, "redrawn", lambda problem, search, ensemble: dataclasses.replace(problem, ensemble=ensemble)
    )
    problem = Problem(CASE, ensemble=Ensemble(seed=40))
    for stops, count in ((None, 3), (5, 2)):  # noqa: B007
        asked.clear()
        heard.clear()
        found = tune.from_seeds(problem, Search(seed=4), 3, out=tmp_path, progress=heard.append)
        assert len(found) == count == len(asked)
        folders = [tmp_path, tmp_path / "parts" / "seed-5", tmp_path / "parts" / "seed-6"]
        assert asked == [(4 + n, folders[n], 40 + n) for n in range(count)]
        assert [each.rounds for each in heard] == [*range(1, 2 * count + 1)]
        assert {each.rounds_in_all for each in heard} == {30}
        assert [each.phase for each in heard] == [f"seed {4 + n // 2}, some" for n in range(2 * count)]
    asked.clear()
    heard.clear()
    plain = dataclasses.replace(problem, ensemble=None)
    one = tune.from_seeds(plain, Search(seed=4), 1, out=None, progress=heard.append)
    assert not isinstance(one, list) and [each.phase for each in heard] == ["some"] * 2
    tune.from_seeds(plain, Search(seed=4), 2, out=None, progress=None)
    assert asked == [(4, None, None), (4, None, None), (5, None, None)]


def test_a_search_starts_at_the_gains_of_law_joint_loop_and_gait():
    law = VirtualModelAdmittance(np.arange(1.0, 7), np.full(6, 300.0), np.full(6, 4e3))
    settings = Search.make({"space": "diagonal", "inertia": True, "joint_gains": True, "also": ["ki", "gait.duty"],
                            "method": "cmaes", "bounds": {"inertia": (0.1, 100.0), "damping": (1.0, 1e4)}})  # fmt: skip
    space = spaces.space(CASE, settings, law)
    problem = Problem(CASE, space, law=law)
    start = dict(zip(space.names, np.exp(tune.start_of(problem)), strict=True))
    for n, axis in enumerate(("x", "y", "z", "rx", "ry", "rz")):
        assert start[f"inertia.{axis}"] == pytest.approx(n + 1) and start[f"damping.{axis}"] == pytest.approx(300)
    own = {"kp": CASE.control.kp, "kd": CASE.control.kd, "ki": 3.0, "gait.duty": CASE.gait.duty}
    assert {name: start[name] for name in own} == pytest.approx(own)


def test_the_last_evaluations_of_a_search_have_bettered_nothing():
    """A thousandth of the best before is little, whatever its sign; nothing before is not settled."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        merits = rng.normal(size=rng.integers(1, 9)) * 10.0 ** rng.integers(-3, 3)
        merits = np.where(rng.uniform(size=merits.size) < 0.2, np.nan, merits)
        if rng.uniform() < 0.5:
            merits = 1 - 1e-3 * rng.uniform(0, 2, merits.size)
        patience = int(rng.integers(1, 6))
        before, after = merits[:-patience], merits[-patience:]
        before, after = (each[np.isfinite(each)] for each in (before, after))
        gain = before.min() - min([before.min(), *after]) if before.size else math.inf
        assert settled(merits, patience) == (before.size > 0 and gain <= 1e-3 * abs(before.min()))


# --- fronts


@pytest.mark.parametrize("seed", range(20))
def test_the_front_is_what_no_other_point_beats(seed):
    """Of points on a lattice, many of which are equal in one or both costs; infinite costs are none."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 5, (2, 14)).astype(float)
    y[rng.uniform(size=14) < 0.2] = np.inf
    front = pareto.nondominated(x, y)

    def beaten(n):
        better = (x <= x[n]) & (y <= y[n]) & ((x < x[n]) | (y < y[n]))
        return better.any() or np.isinf(y[n])

    assert {(x[n], y[n]) for n in front} == {(x[n], y[n]) for n in range(14) if not beaten(n)}
    assert (np.diff(x[front]) > 0).all() and (np.diff(y[front]) < 0).all()


class Given(Exception):
    pass


@pytest.mark.parametrize(
    ("against", "sign", "limit", "points"),
    [("base_deviation", 1, None, 4), ("base_deviation", 1, 0.028, 3), ("base_deviation", 1, 0.0115, 3),
     ("min_tsm", -1, None, 5), ("min_tsm", -1, 0.08, 2)],
)  # fmt: skip
def test_rows_of_a_front_have_limits_of_their_own_and_start_from_the_best_within(
    against, sign, limit, points, monkeypatch
):
    """From the least that was walked to where the other is best, or as far as the settings allow."""

    def dataset(problem, asked, walked, widest):
        raise Given(walked, widest)

    monkeypatch.setattr(pareto, "front_dataset", dataset)
    limits = [Limit("peak_foot_force", 10.7, 1.0, 0.02, "")]
    if limit is not None:
        limits.append(Limit(against, limit, 1.0, 0.02, "", larger_is_better=sign < 0))
    goal = Objective((Term("force_variation", 1.0, 1.0, 1.0),), tuple(limits))
    settings = Search(space="isotropic", joint_gains=False, seed=5)
    problem = landscape(settings, objective=goal)
    with pytest.raises(Given) as found:
        pareto.run(problem, settings, Pareto(against=against, points=points))
    walked, widest = found.value.args
    (first, directions, _), *rest = Landscape.asked
    assert directions is None and len(first) == pareto.CANDIDATES == 64
    drawn = problem.space.draw_tied(np.random.default_rng(5), 63)
    np.testing.assert_allclose(first, [tune.start_of(problem), *drawn])

    def costs(theta):
        """Of each point: the cost that is limited, and that which is bettered; infinite where a limit is broken."""
        one = Landscape.evaluate(problem, theta)
        fine = np.isfinite(one.descent) & (one.metrics["peak_foot_force"] <= 10.7)
        both = zip(sign * one.metrics[against], one.metrics["force_variation"], fine, strict=True)
        return [(a, b) if ok else (math.inf, math.inf) for a, b, ok in both]

    known = costs(first)
    allowed = [
        each for each in known if each[0] <= (math.inf if limit is None else sign * limit) and each[0] < math.inf
    ]
    low, high = min(x for x, _ in allowed), min(allowed, key=lambda each: each[1])[0]
    high = max(high, sign * limit) if limit is not None else high
    high = high if low < high else low + 0.1 * abs(low)
    share = [n / (points - 1) for n in range(points)]
    wanted = [low * (high / low) ** s if low > 0 else low + (high - low) * s for s in share]
    assert widest == pytest.approx(wanted[-1])
    every, own = [*first], rest[0][2].limits[-1]
    np.testing.assert_allclose(np.array(own.value) * sign, wanted)
    np.testing.assert_allclose(own.scale, np.abs(wanted))
    assert own.metric == against and own.larger_is_better == (sign < 0)
    # a penalty begins so near that limits side by side stay apart
    assert own.margin == 0.002
    assert [each.metric for each in rest[0][2].limits] == ["peak_foot_force", against]
    for stage in range(pareto.STAGES):
        requests = rest[stage * pareto.ITERATIONS : (stage + 1) * pareto.ITERATIONS]
        known = costs(np.array(every))
        for row, end in enumerate(own.value):
            within = [n for n, each in enumerate(known) if each[0] <= sign * end and each[0] < math.inf]
            best = (
                min(within, key=lambda n: known[n][1]) if within else min(range(len(known)), key=lambda n: known[n][0])
            )
            np.testing.assert_array_equal(requests[0][0][row], every[best])
        every += [point for request in requests for point in request[0]]
    assert len(rest) == pareto.STAGES * pareto.ITERATIONS
    np.testing.assert_array_equal(walked.theta, every)
    np.testing.assert_allclose(np.column_stack([walked.x, walked.y]), costs(np.array(every)))


# --- grids


def test_the_cells_of_a_sweep_are_numbered_along_its_axes():
    """The second axis runs fastest."""
    axes = {"stiffness": [1e3, 2e3], "damping": [10.0, 20.0, 30.0]}
    grid = sweep.grid_of(Problem(CASE), axes, batch_size=4)
    assert grid.shape == (2, 3) and grid.rows == 6 and grid.size == 4
    for row, (k, d) in enumerate(itertools.product(*axes.values())):
        assert grid.name(row) == f"stiffness {k:.4g} damping {d:.4g}"


def test_gains_of_the_config_and_pd_are_points_of_the_plane(monkeypatch):
    """Where all axes have the config's gains, and pd where both gains are swept under the paper's law."""
    asked = []

    def walks(scenario, gains, parameters, **how):
        asked.append({name: np.asarray(each) for name, each in gains.items()})
        count = max(len(each) for each in gains.values())
        found = {name: np.arange(count) + 0.5 for name in mc.METRICS.names}
        return found | {"detached_limb": np.full(count, -1), "diverged": np.zeros(count, bool)}

    monkeypatch.setattr(mc, "rollout_histories", walks)
    monkeypatch.setattr(sweep.jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(sweep.execution, "walking_with", lambda robots, whole: robots)
    scenario = CASE.with_overrides({"control.stiffness": 4e3, "control.damping": 300.0})
    both = {"stiffness": [1e3, 2e3], "damping": [10.0, 20.0, 30.0]}
    found = sweep.grid_of(Problem(scenario), both, batch_size=4).named()
    assert [found[name]["travel"] for name in ("config", "pd")] == [0.5, 1.5] and found["pd"]["detached_limb"] is None
    for name, own in (("stiffness", 4e3), ("damping", 300.0)):
        np.testing.assert_array_equal(asked[0][name][:2].ravel(), [own, 1e12])
    one = {"stiffness": [1e3, 2e3], "contact.stiffness": [1e4, 2e4]}
    assert [*sweep.grid_of(Problem(scenario), one, batch_size=4).named()] == ["config"]
    for changes in ({"control.stiffness": [1.0, 1, 1, 2, 2, 2]}, {"control.reading": "measured_pose"}):
        other = scenario.with_overrides(changes)
        wanted = {"pd"} if "control.stiffness" in changes else {"config"}
        assert {*sweep.grid_of(Problem(other), both, batch_size=4).named()} == wanted
    law = Problem(scenario, law=VirtualModelAdmittance())
    assert sweep.grid_of(law, both, batch_size=4).named() == {}
    assert sweep.grid_of(Problem(scenario), both, {"damping": 5.0}, 4).named() == {}
    monkeypatch.setattr(sweep.jax, "default_backend", lambda: "gpu")
    assert sweep.grid_of(Problem(scenario), both, batch_size=4).named() == {}


def test_gains_of_the_config_and_pd_walk_in_free_places_of_the_grid(monkeypatch):
    asked = []

    def walks(scenario, gains, parameters, **how):
        asked.append(np.ravel(gains["stiffness"]))
        return {name: np.arange(len(asked[-1])) + 0.5 for name in mc.METRICS.names} | {"detached_limb": np.full(8, -1)}

    monkeypatch.setattr(mc, "rollout_histories", walks)
    monkeypatch.setattr(sweep.jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(sweep.execution, "walking_with", lambda robots, whole: range(8))
    scenario = CASE.with_overrides({"control.stiffness": 4e3})
    grid = sweep.grid_of(Problem(scenario), {"stiffness": [1e3, 2e3], "damping": [10.0, 20.0, 30.0]})
    assert len(grid.walk(np.arange(6))["travel"]) == 6
    assert [own["travel"] for own in grid.named().values()] == [6.5, 7.5]
    (stiffness,) = asked
    np.testing.assert_array_equal(stiffness, [1e3] * 3 + [2e3] * 3 + [4e3, 1e12])


REFUSED = {
    "axes.nothing: expected a gain of the law": {"nothing": [1.0], "damping": [1.0]},
    "axes: expected two gains, got 1": {"damping": [1.0]},
    "axes: expected two gains, got 3": {"damping": [1.0], "stiffness": [1.0], "inertia": [1.0]},
    "damping: expected a list of finite numbers above 0": {"damping": [0.0, 1.0], "stiffness": [1.0]},
    "stiffness: expected a list of finite numbers above 0": {"damping": [1.0], "stiffness": [np.inf]},
    "inertia: expected a list of finite numbers above 0": {"damping": [1.0], "inertia": []},
    "kp: expected a list of finite numbers above 0": {"kp": [[1.0]], "damping": [1.0]},
    "axes.disturbance.cargo.mess: expected": {"disturbance.cargo.mess": [1.0], "damping": [1.0]},
    "axes: expected at most 1000000000 walks in all, got 1000100000":
        {"damping": np.ones(100_010), "stiffness": np.ones(10_000)},
    "batch_size: expected 1 or more, got 0": {"damping": [1.0], "stiffness": [1.0]},
}  # fmt: skip


@pytest.mark.parametrize("said", REFUSED)
def test_axes_of_no_sweep_are_refused(said):
    with pytest.raises((ValueError, mc.ConfigError)) as refused:
        sweep.grid_of(Problem(CASE), REFUSED[said], batch_size=0 if said.startswith("batch") else None)
    assert str(refused.value).startswith(said)
    pd = CASE.with_overrides({"control.controller": "pd"})
    with pytest.raises(ValueError, match=r"expected an admittance law, got pd"):
        sweep.grid_of(Problem(pd), {"damping": [1.0], "stiffness": [1.0]})


@pytest.mark.parametrize("starts", [[0.3, 0.1, 0.05], [0.05, 0.1, 0.3]])
def test_a_path_is_swept_up_to_values_that_a_config_can_have(starts):
    """Each end with the other values of the scenario: a cargo is not put down before it is taken up."""
    case = CASE.with_overrides({"disturbance.cargo.start": 0.1, "disturbance.cargo.stop": 0.2})
    axes = {"disturbance.cargo.start": starts, "contact.damping": [10.0, 20.0, 30.0]}
    with pytest.raises(mc.ConfigError, match=r"disturbance\.cargo\.stop: expected a time after start = 0\.3 s"):
        sweep.grid_of(Problem(case), axes)
    axes["disturbance.cargo.start"] = [0.1]
    assert sweep.grid_of(Problem(case), {**axes, "contact.damping": [10.0]}).rows == 1


@pytest.mark.parametrize(
    ("walks", "steps", "platform", "size"),
    [(5000, 8000, "cpu", 500), (100, 8000, "cpu", 100), (5000, 10**6, "cpu", 64), (5000, 10, "cpu", 1000),
     (10**6, 8000, "gpu", 250_000), (10**4, 10**7, "gpu", 1000), (3, 10, "gpu", 3)],
)  # fmt: skip
def test_parts_take_seconds_and_are_equal(walks, steps, platform, size):
    assert sweep.default_batch_size(walks, steps, platform) == size


def test_the_expected_duration_goes_by_steps_a_second(monkeypatch):
    monkeypatch.setattr(devices, "usable_cores", lambda: 4)
    assert sweep.expected_duration(100, 8800, "cpu") == pytest.approx(0.1)
    assert sweep.expected_duration(1000, 1000, "gpu") == pytest.approx(1e-3)


@pytest.mark.parametrize("law", [None, VirtualModelAdmittance(np.ones(6), np.full(6, 2e2), np.full(6, 3e4))])
@pytest.mark.parametrize("gains", [None, {"stiffness": 2e3}, {"kp": 30.0}])
def test_a_shard_of_a_sweep_is_read_as_it_was_asked_for(gains, law, tmp_path):
    """From the files beside it and its identity: some gains that are held, precision and size of a batch."""
    problem = Problem(CASE, dtype=np.float64, law=law)
    axes = {"damping": [10.0, 20.0], "contact.stiffness": [1e4, 2e4, 3e4]}
    grid = sweep.grid_of(problem, axes, gains, 4)
    grid.write_asked(tmp_path)
    kept = Kept(tmp_path, Shard(1, 2), grid.identity() | {"shard": [1, 2]}, {})
    again = sweep.read_asked(kept, CASE, law, mc.METRICS)
    assert again.identity() == grid.identity() and again.size == 4 and again.problem.dtype == np.float64
    assert (again.gains is None) == (gains is None)
    for work in (grid, again):
        held = {
            name: getattr(work.walked.law or work.walked.scenario.control, name) for name in ("stiffness", "damping")
        }
        held["kp"] = work.walked.scenario.control.kp
        own = {name: getattr(law or CASE.control, name) for name in ("stiffness", "damping")} | {"kp": CASE.control.kp}
        for name, value in (own | (gains or {})).items():
            np.testing.assert_array_equal(np.unique(held[name]), np.unique(value), err_msg=name)


@pytest.mark.parametrize("law", [None, VirtualModelAdmittance(np.ones(6), np.full(6, 2e2), np.full(6, 3e4))])
def test_a_shard_of_an_evaluation_is_read_as_it_was_asked_for(law, tmp_path):
    """Some gains stand for all, beside gains that are whole."""
    gains = {"some": {"stiffness": 2e3}, "joint": {"kp": 30.0}, "whole": mc.Gains(*np.ones((3, 6)))}
    draw = judge.draw_of(Problem(CASE, law=law), gains, Ensemble(members=2), 2)
    draw.write_asked(tmp_path)
    kept = Kept(tmp_path, Shard(1, 2), draw.identity() | {"shard": [1, 2]}, {})
    assert judge.read_asked(kept, CASE, law, mc.METRICS).identity() == draw.identity()
    table = mc.MetricTable((mc.METRICS["travel"], mc.METRICS["force_variation"]))
    draw = judge.draw_of(Problem(CASE, law=law, metrics=table, engine="mjx"), gains, Ensemble(members=2), 2)
    kept = kept._replace(identity=draw.identity() | {"shard": [1, 2]})
    again = judge.read_asked(kept, CASE, law, table)
    assert again.identity() == draw.identity() and (again.problem.metrics, again.problem.engine) == (table, "mjx")
    assert again.ensemble == draw.ensemble and again.problem.ensemble == draw.problem.ensemble


@pytest.mark.parametrize("widest", [0.021, 0.001])
def test_a_front_has_the_exact_walks_of_the_law_beside_config_pd_and_those_without_a_sensor(widest, monkeypatch):
    """Of the candidates within the widest limit, or all where none is; failed walks and those beaten are left out."""
    law = VirtualModelAdmittance(np.ones(6), np.full(6, 2e2), np.full(6, 3e4))
    settings, asked = Search(joint_gains=False), []
    problem = Problem(CASE, spaces.space(CASE, settings, law), Objective((), ()), law=law)
    theta = np.array([[1.0, 8.0], [2.0, 8.0], [3.0, 8.0], [4.0, 8.0], [5.0, 8.0]])
    x, y = np.array([0.01, 0.015, 0.02, 0.03, 0.04]), np.array([5.0, 4.0, 3.0, 2.0, np.inf])

    def walks(scenario, gains=None, parameters=None, **how):
        asked.append((scenario.control.controller, None if gains is None else len(gains.damping), how.get("law")))
        if gains is None:
            found = {"base_deviation": np.array(9.0), "force_variation": np.array(8.0)}
        else:
            first = np.log(gains.damping[:, 0])
            # the exact walk of the third point is worse than that of the second, and the first one's fails
            found = {"base_deviation": 0.01 * first, "force_variation": np.where(first > 2.5, 4.5, 5 - first)}
        count = np.shape(found["base_deviation"])
        found |= {name: np.zeros(count) for name in mc.METRICS.names if name not in found}
        fails = np.zeros(count) if gains is None else first < 1.5
        return found | {
            "diverged": np.asarray(fails, bool),
            "detached_limb": np.full(count, -1),
            "stands_at": np.full(count, np.nan),
        }

    def on_grid(scenario, counts, **how):
        joint = {"kp": np.array([10.0, 20, 30]), "kd": np.array([0.1, 0.2, 0.3])}
        found = {name: np.zeros(3) for name in mc.METRICS.names} | {"detached_limb": np.full(3, -1)}
        found |= {"diverged": np.zeros(3, bool), "stands_at": np.full(3, np.nan)}
        return joint, found | {
            "base_deviation": np.array([1.0, 2.0, 3.0]),
            "force_variation": np.array([3.0, 4.0, 1.0]),
        }

    monkeypatch.setattr(mc, "rollout_metrics", walks)
    monkeypatch.setattr(pareto.retuned_pd, "walked_on_grid", on_grid)
    monkeypatch.setattr(pareto.retuned_pd, "by_plan", lambda _: None)
    held = np.array([True, True, True, True, False])
    walked = pareto.Walked(theta, {"base_deviation": x, "force_variation": y}, held, np.where(held, x, np.inf), y)
    found = pareto.front_dataset(problem, Pareto(), walked, widest)
    own = "base_admittance"
    assert asked == [(own, 3 if widest > 0.01 else 4, law), (own, None, law), ("pd", None, None)]
    # the exact walks of the third and fourth are beaten, that of the first fails
    np.testing.assert_allclose(found["base_deviation"], [0.02])
    np.testing.assert_allclose(found["force_variation"], [3.0])
    np.testing.assert_allclose(found["reference_base_deviation"], [9.0, 9.0])
    assert found["without_kp"].values.tolist() == [10.0, 30.0] and found["without_force_variation"].values.tolist() == [
        3,
        1,
    ]
    assert set(found["without_law"].values) == {pareto.retuned_pd.NAME}
    np.testing.assert_array_equal(found["walked_force_variation"], y)
    np.testing.assert_array_equal(found["held"], held)
    np.testing.assert_array_equal(found["theta"], theta)
    assert (found.attrs["better"], found.attrs["against"]) == ("force_variation", "base_deviation")
    assert found.attrs["searched"] == "stiffness damping" and found["coordinate"].values.tolist() == [
        "damping",
        "stiffness",
    ]
