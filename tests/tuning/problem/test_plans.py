"""Walks under joint targets: the same as under the law that gave them, with exact derivatives, and the least forces."""

import math
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import mjx_climb as mc
from mjx_climb.control import PD, law_of
from mjx_climb.execution.devices import share_size
from mjx_climb.walk.metrics import peak
from tuning.methods.many_variables import Evaluated, descend
from tuning.problem import plans
from tuning.problem.evaluation import under_pd
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.plans import RATE, SWING, Freedom, Knots, commanded, row, rows, walks_of

TABLE = mc.MetricTable((*mc.METRICS, SWING, RATE))
SHORT = {"duration": 0.1, "disturbance.cargo.mass": 1.0, "disturbance.cargo.start": 0.02}
GOAL = Objective(
    (Term("force_variation", 1.0, 2.0, 2.0), Term("peak_foot_force", 2.0, 3.0, 2.8)),
    (Limit("base_deviation", 1e-4, 1e-4, 0.02, "of the test"),),
)


def own_row(scenario, law):
    return rows(scenario, law, None, mc.parameters(scenario), 1)


@pytest.mark.parametrize(
    "hardware",
    [
        {},
        {"control_period": 0.004, "command_delay": 0.003},
        {"control_period": 0.005, "command_delay": 0.0035, "interpolation": "hold"},
        {"control_period": 0.004, "command_delay": 0.002, "interpolation": "linear"},
    ],
)
def test_what_the_joints_got_is_sent_so_that_they_get_it_again(hardware):
    """A bus of NumPy holds and delays a signal; the plan that is worked out from its end comes out of it likewise."""
    scenario = mc.Scenario().with_overrides({"duration": 0.06, **{f"hardware.{k}": v for k, v in hardware.items()}})
    sent = np.cumsum(np.random.default_rng(0).normal(size=(60, 4, 3)), axis=0)

    def through_the_bus(signal):
        period, late = round(hardware.get("control_period", 0.001) / 1e-3), hardware.get("command_delay", 0.0) / 1e-3
        begins = np.arange(60) // period * period
        held = signal[begins]
        if hardware.get("interpolation") == "linear":
            share = ((np.arange(60) - begins + 1) / period)[:, None, None]
            held = signal[np.maximum(begins - period, 0)] * (1 - share) + held * share
        times = np.maximum(np.arange(60) - late, 0.0)
        return np.stack([np.interp(times, np.arange(60), one) for one in held.reshape(60, -1).T], -1).reshape(60, 4, 3)

    got = through_the_bus(sent)
    again = through_the_bus(commanded(got, row(own_row(scenario, PD()), 0), scenario))
    end = -6 if hardware.get("interpolation") == "linear" else None  # a line whose end is behind the record
    np.testing.assert_allclose(again[8:end], got[8:end], atol=1e-9)


@pytest.mark.slow
def test_a_plan_walks_as_the_law_did_that_it_was_taken_from():
    """Alone, as in a batch of two whose cargo differs."""
    hardware = {"hardware.control_period": 0.005, "hardware.command_delay": 0.004}
    scenario = mc.load_scenario("case_1_2").with_overrides({**SHORT, **hardware})
    law, own = law_of(scenario), mc.parameters(scenario)
    parameters = rows(scenario, law, None, own.replace({"disturbance.cargo.mass": np.array([1.0, 0.5])}), 2)
    how = {"metrics": TABLE, "engine": "limb", "dtype": np.float64}
    walked = plans.over_time(scenario, law, None, parameters, **how)
    assert abs(walked.foot_force[1] - walked.foot_force[0]).max() > 0.1
    plan = commanded(walked.joint_targets[0], row(parameters, 0), scenario)
    again = mc.Simulation(scenario, PD(), smooth=True).rollout({}, row(parameters, 0), targets=plan)
    np.testing.assert_allclose(walked.joint_targets[0], again.joint_targets, atol=1e-12)
    np.testing.assert_allclose(walked.foot_force[0], np.linalg.norm(again.foot_force, axis=-1).max(-1), atol=1e-9)
    np.testing.assert_allclose(walked.base_offset[0], again.base_position - again.base_reference, atol=1e-9)


@pytest.mark.parametrize("starts", [1, 5])
def test_the_program_of_gradients_is_prepared_by_few_walks(monkeypatch, starts):
    """In shares of as many robots as those of the search, whose arguments have the same shapes."""
    asked = []

    class AskedError(Exception):
        """What is asked for is known: nothing needs to be compiled."""

    def run(function, structure, robots, *, batch_size, **_):
        asked.append(
            (function, structure, batch_size, robots.shape[0], [*map(np.ndim, jax.tree.leaves(robots.arguments))])
        )
        raise AskedError

    monkeypatch.setattr(plans.execution, "run", run)
    monkeypatch.setattr(plans.devices, "usable_cores", lambda: 2)
    scenario = under_pd(mc.load_scenario("case_1_2")).with_overrides(SHORT)
    parameters = rows(scenario, PD(), None, mc.parameters(scenario), starts * 16)
    walks = walks_of(scenario, GOAL, parameters, metrics=TABLE)
    freedom = Freedom(np.zeros((starts, 16, 100, 4, 3)), Knots(100, 50), True, None, -np.ones((4, 3)), np.ones((4, 3)))
    for begin in (walks.prepare, lambda *given: walks.evaluate(given[0], freedom.none, given[1], sharp=0.0)):
        with pytest.raises(AskedError):
            begin(freedom, parameters)
    (*prepared, some, shapes), (*needed, every, of_all) = asked
    assert prepared == needed and some <= 32 and every == starts * 16 and shapes == of_all
    shares = [share_size(robots, prepared[2], in_regions=True) for robots in (some, every)]
    assert shares == [8 if starts == 1 else 16] * 2


@pytest.mark.nightly
def test_derivatives_by_a_knot_are_central_differences():
    """In double precision, through the law's bus and servos, along single knots and along all at once."""
    hardware = {"hardware.control_period": 0.005, "hardware.command_delay": 0.004, "hardware.servo.armature": 0.01}
    scenario = under_pd(mc.load_scenario("case_1_2")).with_overrides({**SHORT, **hardware})
    parameters = own_row(scenario, PD())
    walks = walks_of(scenario, GOAL, parameters, metrics=TABLE, dtype=np.float64)
    walk = mc.Simulation(scenario, PD(), smooth=True).rollout({}, row(parameters, 0))
    base = commanded(np.asarray(walk.joint_targets), row(parameters, 0), scenario)[None, None]
    freedom = Freedom(base, Knots(100, 25), True, None, -np.full((4, 3), np.pi), np.full((4, 3), np.pi))
    rng = np.random.default_rng(0)
    x = 1e-3 * rng.normal(size=freedom.none.shape)

    def at(x):
        return walks.evaluate(freedom, x, parameters, sharp=1.0)

    slopes = at(x)[1][0]
    shape = (freedom.knots.count, 4, 3)
    directions = np.zeros((4, x.size))
    for number, place in enumerate([(0, 0, 1), (2, 1, 2), (3, 3, 0)]):
        directions[number, np.ravel_multi_index(place, shape)] = 1.0
    directions[3] = rng.normal(size=x.size)
    for along in directions:
        off = 1e-7 * along[None]
        difference = (at(x + off)[0].merit - at(x - off)[0].merit)[0] / 2e-7
        np.testing.assert_allclose(slopes @ along, difference, rtol=1e-5, atol=1e-7 * abs(slopes).max())


@pytest.mark.slow
@pytest.mark.parametrize(("common", "since"), [(True, [30.5, 60.0]), (True, None), (False, [0.0, 0.0])])
def test_slopes_by_knots_are_those_by_steps(common, since):
    """In double precision, two members from two starts, with offsets for all or own ones or both; a joint's limit."""
    scenario = under_pd(mc.load_scenario("case_1_2")).with_overrides(SHORT)
    parameters = rows(scenario, PD(), None, mc.parameters(scenario), 2)
    parameters = jax.tree.map(lambda value: np.concatenate([value, value]), parameters)
    parameters = parameters.replace({"disturbance.cargo.mass": np.array([1.0, 0.5, 1.0, 0.5])})
    walks = walks_of(scenario, GOAL, parameters, metrics=TABLE, dtype=np.float64)
    walk = mc.Simulation(scenario, PD(), smooth=True).rollout({}, row(parameters, 0))
    rng = np.random.default_rng(0)
    base = np.asarray(walk.joint_targets) + 1e-3 * rng.normal(size=(2, 2, 1, 4, 3))
    upper = np.full((4, 3), np.pi)
    upper[1, 2] = base[..., 1, 2].max()
    freedom = Freedom(base, Knots(100, 25), common, since and np.array(since), -upper - 9, upper)
    x = 1e-3 * rng.normal(size=freedom.none.shape)
    assert 0 < (freedom.targets(x) == upper)[..., 1, 2].mean() < 0.9
    (found, by_steps), (there, by_knots) = (
        how(freedom, x, parameters, 0.3) for how in (walks._reverse, walks._by_knots)
    )
    np.testing.assert_allclose(by_knots, by_steps, rtol=1e-8, atol=1e-9 * abs(by_steps).max())
    assert np.isfinite(by_steps).all() and (by_steps != 0).mean() > 0.7
    np.testing.assert_allclose(there.merit, found.merit, rtol=1e-12)


LATE = peak("late_force", "N", "largest foot force late", lambda sample, _: jax.numpy.where(
    sample.time > 0.25, jax.numpy.sqrt((sample.foot_force**2).sum(-1) + 1e-18), 0.0))  # fmt: skip


@pytest.mark.nightly
@pytest.mark.slow
def test_a_static_load_on_four_feet_is_shared_as_a_convex_program_shares_it():
    """The least of the largest foot force under a force and a moment on a standing robot; to 1 %."""
    push = {"force": [1.0, 0.5, -2.0], "moment": [0.1, -0.15, 0.05], "start": 0.0, "stop": 1.0}
    standing = {"gait.duty": 0.9, "gait.phases": {"LH": 0.2, "LF": 0.4, "RH": 0.6, "RF": 0.8}}
    scenario = under_pd(mc.load_scenario("case_1_2")).with_overrides(
        {"duration": 0.4, "disturbance.cargo.mass": 0.0, "disturbance.pushes": [push], **standing}
    )
    parameters, table = own_row(scenario, PD()), mc.MetricTable((*TABLE, LATE))
    walk = mc.Simulation(scenario, PD(), table, smooth=True).rollout({}, row(parameters, 0))
    assert walk.support.all()

    feet, weight = walk.foot_position[-1], np.array(scenario.gravity) * 2.2539
    force = np.array(push["force"])
    moment = np.cross(walk.center_of_mass[-1], weight) + np.cross(walk.base_position[-1], force) + push["moment"]

    def unbalanced(x):
        forces = x[1:].reshape(4, 3)
        return np.concatenate([forces.sum(0) + weight + force, np.cross(feet, forces).sum(0) + moment])

    program = optimize.minimize(
        lambda x: x[0], np.concatenate([[5.0], np.tile(-(weight + force) / 4, 4)]), method="SLSQP",
        constraints=[{"type": "eq", "fun": unbalanced},
                     {"type": "ineq", "fun": lambda x: x[0] ** 2 - (x[1:].reshape(4, 3) ** 2).sum(1)}],
        options={"maxiter": 500, "ftol": 1e-12},
    )  # fmt: skip
    assert program.success
    least = program.x[0]

    goal = Objective((Term("late_force", 1.0, least, least),), ())
    walks = walks_of(scenario, goal, parameters, metrics=table)
    base = commanded(np.asarray(walk.joint_targets), row(parameters, 0), scenario)[None, None]
    known, ends = None, []
    for every in (50, 25):
        freedom = Freedom(base, Knots(400, every), True, None, -np.full((4, 3), np.pi), np.full((4, 3), np.pi))

        def evaluate(x, sharp, freedom=freedom):
            found, slopes = walks.evaluate(freedom, x, parameters, sharp=sharp)
            return Evaluated(found.merit, slopes)

        found = descend(evaluate, freedom.none, 120, step=1e-3, known=known)
        base, known = freedom.targets(found.x), found.merit
        ends.append(found.merit[0])
    assert ends[1] <= ends[0]
    assert 0.99 < ends[1] < 1.01


@pytest.mark.parametrize(("cores", "walks", "share"), [(2, 48, 16), (2, 16, 8), (16, 48, 4), (16, 16, 4), (16, 3, 2)])
def test_a_call_of_many_walks_holds_four_at_least(monkeypatch, cores, walks, share):
    monkeypatch.setattr(plans.devices, "usable_cores", lambda: cores)
    assert plans._at_once(walks, kernel=False) == share


# ------------------------------------------------------------------------------------------------- without walking


def test_a_foot_that_swings_is_off_its_path_and_joints_have_speeds():
    rng = np.random.default_rng(0)
    foot, target, rates = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    sample = types.SimpleNamespace(
        foot_position=foot, foot_target=target, support=np.array([True, False, False, True]), joint_rates=rates
    )
    off = [0.0, *(math.dist(a, b) for a, b in zip(foot[1:3], target[1:3], strict=True)), 0.0]
    np.testing.assert_allclose(plans._swing_deviation(sample, None), off)
    np.testing.assert_array_equal(plans._joint_rates(sample, None), np.abs(rates))


def test_histories_are_the_largest_force_and_how_far_the_base_is_off(monkeypatch):
    rng, asked = np.random.default_rng(0), []
    force, base, reference, joints = (rng.normal(size=(6, *own)) for own in ((4, 3), (3,), (3,), (4, 3)))
    samples = types.SimpleNamespace(
        foot_force=force, base_position=base, base_reference=reference, joint_targets=joints
    )
    monkeypatch.setattr(plans, "samples_of", lambda *given: asked.append(given) or samples)
    found = plans._over_time("structure", "law", "parameters", "targets")
    assert asked == [("structure", "law", "parameters", "targets")]
    np.testing.assert_allclose(found["foot_force"], [max(map(np.linalg.norm, step)) for step in force])
    np.testing.assert_array_equal(found["base_offset"], base - reference)
    assert found["joint_targets"] is joints

    def run(function, shape, robots, *, over_time):
        assert function is plans._over_time and over_time and shape.smooth
        law, _, *under = robots.arguments
        assert [each.shape for each in under] == [(2, 3, 4, 3)] * len(robots.axes[2:]) and robots.shape == (2,)
        asked.append((type(law).__name__, [each.dtype for each in under], robots.axes[2:]))
        return dict.fromkeys(("joint_targets", "foot_force", "base_offset"), np.zeros(2))

    monkeypatch.setattr(plans.execution, "run", run)
    scenario, how = mc.load_scenario("case_1_2"), {"metrics": mc.METRICS, "engine": "limb", "dtype": np.float64}
    parameters = mc.parameters(scenario).replace({"mass_scale": np.array([1.0, 1.1])})
    plans.over_time(scenario, law_of(scenario), None, parameters, **how)
    plans.over_time(scenario, PD(), None, parameters, np.zeros((2, 3, 4, 3), np.float32), **how)
    assert asked[1:] == [("VirtualModelAdmittance", [], ()), ("PD", [np.dtype(float)], (3,))]
    stiff = mc.parameters(scenario).replace({"contact.stiffness": np.array([1e4, 1e9])})
    with pytest.raises(mc.ConfigError, match="time_step"):
        plans.over_time(scenario, PD(), None, stiff, **how)


@pytest.mark.parametrize(
    ("dtype", "every", "planning", "device", "path", "by_knots"),
    [
        (np.float32, 5, False, None, "kernel", True), (np.float64, 5, False, None, "kernel", False),
        (np.float32, 6, False, None, "kernel", False), (np.float32, 5, True, None, "kernel", False),
        (np.float32, 5, False, "cpu", "kernel", False), (np.float32, 5, False, None, "plain", False),
    ],
)  # fmt: skip
def test_a_kernel_derives_plans_that_it_can(dtype, every, planning, device, path, by_knots, monkeypatch):
    """In single precision, with whole steps between knots, of a gait without decisions, where a GPU is as quick."""
    asked = []
    monkeypatch.setattr(plans.paths, "device_for", lambda *given, kernel: asked.append((*given, kernel)) or device)
    monkeypatch.setattr(plans.paths, "path_for", lambda on, kernel: asked.append((on, kernel)) or path)
    shape = types.SimpleNamespace(planning=planning)
    walks = plans.Walks(plans.Asked(shape, (), ()), None, dtype)
    ends = np.zeros((4, 3))
    freedom = Freedom(np.zeros((3, 2, 20, 4, 3)), Knots(20, every), True, None, ends, ends)
    assert walks._derived(freedom) == (walks._by_knots if by_knots else walks._reverse)
    assert not by_knots or asked == [(6, plans.paths.AN_ADJOINT, True), (None, True)]


TERMS = (Term("travel", 2.0, 0.5, 0.4, True), Term("force_variation", 1.0, 10.0, 8.0))
LIMITS = (Limit("base_deviation", 0.02, 0.01, 0.1, ""), Limit("min_gia_margin", 3.0, 2.0, 0.05, "", True))
WALK = {
    "travel": 0.6, "travel_smooth": 0.55, "force_variation": 9.0, "force_variation_smooth": 8.5, "diverged": False,
    "base_deviation": 0.021, "base_deviation_smooth": 0.022, "min_gia_margin": 2.9, "min_gia_margin_smooth": 2.8,
    "detached_limb": -1,
}  # fmt: skip


@pytest.mark.parametrize("sharp", [0.0, 0.25, 1.0])
def test_what_a_search_descends_is_a_share_of_the_true_score_and_of_that_with_smooth_extremes(sharp, monkeypatch):
    asked, goal = [], Objective(TERMS, LIMITS)
    metrics = {name: jnp.asarray(value) for name, value in WALK.items()}
    monkeypatch.setattr(plans, "metrics_of", lambda *given: asked.append(given) or metrics)
    walks = walks_of(
        mc.load_scenario("case_1_2"), goal, mc.parameters(mc.load_scenario("case_1_2")), metrics=mc.METRICS
    )
    score = goal.score(metrics)
    found = plans.judged(walks.asked, "targets", walks.numbers._replace(sharp=sharp), "law", "parameters")
    assert [each[1:3] + each[4:] for each in asked] == [("law", "parameters", "targets")]
    assert float(found["_value"]) == pytest.approx(float(score.value)) and bool(found["_feasible"]) == bool(
        score.feasible
    )
    assert float(found["_merit"]) == pytest.approx(float(score.value + score.penalty))
    along, _ = plans._followed(walks.asked, walks.numbers._replace(sharp=sharp), "law", "parameters", "targets")
    wanted = (1 - sharp) * float(score.descent) + sharp * float(score.value + score.penalty)
    assert float(along) == pytest.approx(wanted) and found["travel"] is metrics["travel"]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("count", "calls"), [(3, 2), (9, 16), (40, 16)])
def test_plans_walk_in_whole_calls_and_get_their_scores_in_order(count, calls, dtype, monkeypatch):
    """Slopes by steps come back to the variables; a walk that diverged has no finite merit.

    In single precision a GPU's kernel may judge them, which keeps no histories.
    """
    monkeypatch.setattr(plans.devices, "usable_cores", lambda: 1)
    scenario, asked = mc.load_scenario("case_1_2"), []
    parameters = rows(scenario, PD(), None, mc.parameters(scenario), count)
    parameters = parameters.replace({"control.kp": np.arange(1.0, count + 1)})
    walks = walks_of(scenario, Objective(TERMS, LIMITS), parameters, metrics=mc.METRICS, dtype=dtype)

    def run(function, shape, robots, *, batch_size, over_time):
        assert {each.dtype for each in jax.tree.leaves(robots.arguments)} == {np.dtype(dtype)}
        targets, numbers, _, own = robots.arguments
        asked.append((function, batch_size, over_time, float(numbers.sharp), robots.axes[0]))
        merit = np.where(own.at("control.kp") == 2.0, np.nan, own.at("control.kp"))
        found = {"_value": merit / 2, "_merit": merit, "_feasible": merit > 1, "travel": targets[:, 0, 0, 0]}
        return found | ({"_slopes": np.ones(targets.shape)} if function is plans.scored else {})

    monkeypatch.setattr(plans.execution, "run", run)
    targets = np.arange(float(count))[:, None, None, None] * np.ones((1, 20, 4, 3))
    found = walks.judge(targets, parameters)
    np.testing.assert_array_equal(found.metrics["travel"], np.arange(float(count)))
    np.testing.assert_array_equal(found.merit, [1.0, np.inf, *np.arange(3.0, count + 1)])
    np.testing.assert_array_equal(found.value[2:], np.arange(3.0, count + 1) / 2)
    assert set(found.metrics) == {"travel"} and asked == [(plans.judged, calls, dtype is np.float64, 1.0, 3)]
    ends = np.full((4, 3), -1e3), np.full((4, 3), 1e3)
    freedom = Freedom(targets[None], Knots(20, 5), True, None, *ends)
    found, slopes = walks.evaluate(freedom, freedom.none, parameters, sharp=0.25)
    assert asked[1:] == [(plans.scored, calls, True, 0.25, 3)] and found.merit[1] == np.inf
    np.testing.assert_allclose(slopes, freedom.slopes(freedom.none, np.ones(freedom.base.shape)))
    walks.prepare(freedom, parameters)
    assert asked[2][:3] == (plans.scored, calls, True) and asked[2][3] == 0.0
