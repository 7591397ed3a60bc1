"""Scores, limits and draws against the same written a second time, with loops in NumPy."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.walk.metrics import PREFIX
from tuning.methods.rounds import settled
from tuning.problem import ensemble, plans
from tuning.problem.ensemble import Ensemble, Gravity, Posterior, Pushes, Worst
from tuning.problem.evaluation import report_of
from tuning.problem.objectives import Limit, Objective, Term, lost, objective
from tuning.problem.search import Search


def penalty_of(over):
    return 100 * max(over, 0.0) ** 2 / (1 + max(over, 0.0) / 0.1)


def score_by_loops(goal, metrics):
    """Return value, descent, penalty and feasibility of one point, of whose members metrics (members,) are."""
    members, worst = len(metrics["diverged"]), goal.worst or Worst(share=1.0, weight=1.0)
    count = math.ceil(worst.share * members)

    def ratios(term, smooth):
        name = PREFIX + term.metric if smooth and PREFIX + term.metric in metrics else term.metric
        smooth = name.startswith(PREFIX)
        ordered = np.sort(metrics[name])
        ends = ordered[:count] if term.larger_is_better else ordered[-count:]
        means, bases = [ordered.mean()], [term.smooth_baseline if smooth else term.baseline]
        if goal.worst:
            means, bases = [*means, ends.mean()], [*bases, term.smooth_worst if smooth else term.worst]
        found = np.array(means) / bases
        return 2 - found if term.larger_is_better else found

    shares = [1 - worst.weight, worst.weight] if goal.worst else [1.0]
    weights = [term.weight for term in goal.terms]
    value, smooth = (
        np.average([ratios(term, soft) @ shares for term in goal.terms], weights=weights) for soft in (False, True)
    )
    penalty, feasible = 0.0, np.isfinite(value)
    if goal.margin is not None:
        for ratio in np.ravel([ratios(term, False) for term in goal.terms]):
            penalty, feasible = penalty + penalty_of(ratio - 1 + goal.margin), feasible and ratio <= 1
    for limit in goal.limits:
        slack = (metrics[limit.metric] - limit.value) / limit.scale * (-1 if limit.larger_is_better else 1)
        over = np.sort([penalty_of(each + limit.margin) for each in slack])
        penalty, feasible = penalty + over[-count:].mean(), feasible and (slack <= 0).all()
    if metrics["diverged"].any():
        return np.nan, np.nan, np.nan, False
    return value, smooth + penalty, penalty, feasible


def drawn(points, worst, margin=None):
    """Return an objective and metrics (members, points): limits just kept, just broken and far broken."""
    random, members = np.random.default_rng(0), 5 if worst else 1
    terms = (
        Term("force_variation", 3.0, 2.0, 1.8, worst=2.6, smooth_worst=2.3),
        Term("travel", 1.0, 0.9, 0.8, larger_is_better=True, worst=0.8, smooth_worst=0.7),
    )
    limits = (
        Limit("base_deviation", 1.1, 0.5, 0.02, ""),
        Limit("joint_limit_margin", 0.9, 2.0, 0.02, "", larger_is_better=True),
    )
    names = ("force_variation", PREFIX + "force_variation", "travel", "base_deviation", "joint_limit_margin")
    spread = random.uniform(0.001, 0.2, points)
    metrics = {name: random.normal(1, spread, (members, points)) for name in names}
    metrics["diverged"] = random.uniform(size=(members, points)) < 0.03
    return Objective(terms, limits, worst=worst, margin=margin), metrics


@pytest.mark.parametrize("worst", [None, Worst(share=0.4, weight=0.3)])
@pytest.mark.parametrize("margin", [None, 0.05])
def test_scores_of_points_are_those_of_loops(worst, margin):
    """Terms of both directions with and without a smooth companion."""
    goal, metrics = drawn(points := 60, worst, margin)
    found = goal.score(metrics if worst else {name: values[0] for name, values in metrics.items()})
    wanted = [score_by_loops(goal, {name: each[:, n] for name, each in metrics.items()}) for n in range(points)]
    np.testing.assert_allclose(np.array(found).T.astype(float), np.array(wanted, float), rtol=1e-9)
    assert 2 < np.sum(found.feasible) < points - 10 and np.isnan(found.value).any()


def test_many_points_of_an_ensemble_are_scored_each_as_alone():
    goal, metrics = drawn(points := 4000, Worst(share=0.4, weight=0.3))
    found = report_of(goal, metrics)
    for n in range(0, points, 57):
        own = {name: each[:, n] for name, each in metrics.items()}
        scored = [found[name][n] for name in ("value", "descent", "penalty", "feasible")]
        np.testing.assert_allclose(scored, np.array(score_by_loops(goal, own), float), rtol=1e-9)
        np.testing.assert_allclose(found["metrics"]["travel"][n], own["travel"].mean())
    assert found["value"].shape == found["metrics"]["diverged"].shape == (points,)


def test_a_walk_is_lost_that_uses_more_than_the_limit_of_a_grip_or_diverges():
    metrics = {"peak_utilization": np.array([0.93, 1.0, 1.01, 0.2]), "diverged": np.array([0.0, 0.0, 0.0, 1.0])}
    np.testing.assert_array_equal(lost(metrics), [0.0, 0.0, 1.0, 1.0])


ASKED = {  # settings, and the limits by hand: value, scale, margin
    "alone": ({"weights": {"force_variation": 1.0}, "no_worse_than_pd": False, "limits": {"base_deviation": 0.3}}, [
        ("joint_limit_margin", 0.0, 0.1, 0.02), ("peak_utilization", 1.0, 1.0, 0.02),
        ("base_deviation", 0.3, 0.3, 0.02)]),
    "no worse": ({"weights": {"force_variation": 1.0, "travel": 2.0}, "no_worse_than_pd": True, "deviation_factor": 3.0,
                  "limits": {"travel": 0.5}}, [
        ("joint_limit_margin", 0.0, 0.1, 0.02), ("peak_utilization", 1.0, 1.0, 0.02),
        ("base_deviation", 0.12, 0.12, 0.02), ("travel", 0.5, 0.5, 0.02), ("force_variation", 2.0, 2.0, 0.005)]),
    # a metric with a scale of its own: a limit beyond it has that of the limit
    "wide": ({"weights": {"force_variation": 1.0}, "no_worse_than_pd": False, "deviation_factor": 2.0,
              "limits": {"joint_limit_margin": -0.4, "peak_utilization": 0.0}}, [
        ("base_deviation", 0.08, 0.08, 0.02), ("joint_limit_margin", -0.4, 0.4, 0.02),
        ("peak_utilization", 0.0, 1.0, 0.02)]),
}  # fmt: skip


@pytest.mark.parametrize("name", ASKED)
def test_limits_are_those_of_the_scenario_the_settings_and_pd(name):
    settings, wanted = ASKED[name]
    pd = {"force_variation": 2.0, "travel": 0.6, "base_deviation": 0.04, "diverged": False, "peak_utilization": 0.1}
    found = objective(Search.make(settings), pd)
    assert [limit.metric for limit in found.limits] == [name for name, *_ in wanted]
    np.testing.assert_allclose([limit[1:4] for limit in found.limits], [each for _, *each in wanted], rtol=1e-12)
    assert [limit.larger_is_better for limit in found.limits] == [
        limit[0] in ("joint_limit_margin", "travel") for limit in wanted
    ]
    assert [term.baseline for term in found.terms] == [pd[name] for name in settings["weights"]]
    # over an ensemble the widest deviation of pd's members, and a margin of its own
    many = {key: np.array([value, value / 2]) for key, value in pd.items()}
    over = objective(Search.make(settings), many, worst=Worst(share=0.5, weight=0.5))
    assert over.margin == (0.005 if settings.get("no_worse_than_pd") else None)
    assert over.terms[0].baseline == 1.5 and over.terms[0].worst == 2.0
    assert {limit.metric: limit.value for limit in over.limits}["base_deviation"] == {n: v for n, v, *_ in wanted}[
        "base_deviation"
    ]


def test_an_objective_of_another_length_than_the_members_is_refused():
    pd = {"force_variation": np.array([2.0, 3.0, 4.0]), "base_deviation": np.ones(3), "travel": np.ones(3)}
    assert objective(Search(), pd, lambda metrics: metrics["force_variation"] / 2).reference == 1.5
    for own in (lambda metrics: metrics["force_variation"][:2], lambda metrics: metrics["force_variation"].mean()):
        with pytest.raises(
            mc.ConfigError, match=r"objective: expected an array made of metrics, shape \(3,\) as theirs"
        ):
            objective(Search(), pd, own)


def test_a_search_is_settled_relative_to_its_best():
    """A thousandth of what it has, in any unit, not of 1; just what it asks for is enough."""
    for scale, better, done in ((1e-4, 0.9, False), (1e-4, 0.9995, True), (1e4, 0.9995, True), (-1.0, 1.0005, True)):
        assert settled(scale * np.array([1.0, 1.0, better, 1.0]), 2) == done
    assert not settled(np.array([1.0, 1.0]), 2) and settled(np.array([1.0, 1.0, 1.0]), 2)


# --- draws


def test_gravity_of_members_is_tilted_by_the_slope_to_any_side():
    """All by 10 degrees, one in each eighth of the circle; a scale counts on the size."""
    scenario = mc.Scenario().with_overrides({"gravity": [0.0, 0.0, -2.0]})
    found = ensemble.draw(scenario, Ensemble(members=8, gravity=Gravity(scale=(0.5, 0.5), slope=(10.0, 10.0)))).gravity
    np.testing.assert_allclose(found[:, 0, 2], -np.cos(np.radians(10)), rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(found[:, 0], axis=1), 1.0, rtol=1e-9)
    side = np.sort(np.arctan2(found[:, 0, 1], found[:, 0, 0]))
    assert (np.bincount(((side + np.pi) / (np.pi / 4)).astype(int), minlength=8) == 1).all()
    # gravity along the slope is turned about a level axis as a rigid body
    tilted = mc.Scenario().with_overrides({"gravity": [1.0, 0.0, -2.0]})
    steep = ensemble.draw(tilted, Ensemble(members=40, gravity=Gravity(scale=(1.0, 1.0), slope=(10.0, 10.0)))).gravity
    np.testing.assert_allclose(np.linalg.norm(steep[:, 0], axis=1), np.sqrt(5), rtol=1e-9)
    across = np.cross([1.0, 0.0, -2.0], steep[:, 0])
    assert (np.linalg.norm(across, axis=1) <= 5 * np.sin(np.radians(10)) + 1e-9).all()


def test_pushes_come_from_all_sides_and_last_as_long_as_they_are_drawn():
    """Of a sphere each coordinate is even between -1 and 1."""
    pushes = Pushes(count=2, force=(3.0, 3.0), start=(1.0, 2.0), length=(0.2, 0.4))
    found = ensemble.draw(mc.Scenario(), Ensemble(members=500, pushes=pushes))
    drawn = found.disturbances[1:]
    assert len(drawn) == 2
    direction = np.concatenate([push.force.reshape(-1, 3) for push in drawn]) / 3
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, rtol=1e-9)
    for along in direction.T:
        np.testing.assert_allclose(np.quantile(along, [0.25, 0.5, 0.75]), [-0.5, 0.0, 0.5], atol=0.08)
    start, stop = (np.stack([getattr(push, name) for push in drawn]) for name in ("start", "stop"))
    length = stop - start
    assert 0.2 <= length.min() < 0.21 and 0.39 < length.max() <= 0.4
    assert 1.0 <= start.min() < 1.01 and 1.99 < start.max() <= 2.0


def test_a_posterior_is_drawn_in_its_coordinates_and_cut_at_its_bounds():
    keys = ("contact.stiffness", "contact.damping", "gravity.tilt_x")
    covariance = ((0.04, 0.0, 0.0), (0.0, 9.0, 0.0), (0.0, 0.0, 1e-4))
    posterior = Posterior(
        keys=keys, log=(True, False, False), mean=(np.log(1e4), 20.0, 0.1), covariance=covariance,
        lower=(1.0, 18.0, -1.0), upper=(1.5e4, 1e4, 1.0),
    )  # fmt: skip
    own = mc.Scenario().with_overrides({"gravity": [0.0, 0.0, -2.0]})
    how = Ensemble(members=800, gravity=None, grip_stiffness=(1.0, 1.0), posterior=posterior)
    found = ensemble.draw(own, how)
    logs = np.log(found.contact.stiffness)
    assert logs.mean() == pytest.approx(np.log(1e4), abs=0.03) and logs.std() == pytest.approx(0.2, rel=0.1)
    assert found.contact.stiffness.max() == 1.5e4 and found.contact.damping.min() == 18.0
    assert np.median(found.contact.damping) == pytest.approx(20, abs=0.5)
    # about x, by 0.1 rad: from -z towards y
    gravity = np.asarray(found.gravity)[:, 0].mean(0)
    np.testing.assert_allclose(gravity, [0.0, 2 * np.sin(0.1), -2 * np.cos(0.1)], atol=3e-3)


# --- plans


def test_offsets_of_a_walk_are_the_lines_between_knots_within_both_limits():
    """Of two sets, of which the second counts from a step on: step by step the targets that `Freedom` has."""
    random, steps, every = np.random.default_rng(0), 12, 4
    knots = plans.Knots(steps, every)
    base, limit = random.normal(0, 0.1, (1, 1, steps, 4, 3)), np.full((4, 3), 0.3)
    freedom = plans.Freedom(base, knots, True, np.array([5]), -limit, limit)
    x = random.normal(0, 0.3, freedom.none.shape)
    wanted = freedom.targets(x)[0, 0]
    assert (wanted == limit).any() and (wanted == -limit).any() and (abs(wanted) < limit).any()
    sets = x.reshape(-1, knots.count, 4, 3)
    steering = plans.Steering(base[0, 0], np.array([0, 5], np.int32)[: len(sets)], -limit, limit)
    seen = []

    def step(carry, targets):
        jax.debug.callback(lambda each: seen.append(np.array(each)), targets, ordered=True)
        return carry, ()

    plans._between_knots(jnp.asarray(sets), steering, step, jnp.zeros(()), jnp.asarray(base[0, 0]), length=steps)
    jax.effects_barrier()
    np.testing.assert_allclose(seen, wanted, atol=1e-12)


def test_a_cargo_comes_before_the_drawn_pushes_and_disturbances_of_other_kinds_behind_them():
    scenario = mc.Scenario().with_overrides({
        "disturbance.cargo": {"mass": 1.0, "start": 0.0},
        "disturbance.pushes": [{"force": [9.0, 0.0, 0.0], "start": 0.1, "stop": 0.2}],
        "disturbance.others": [{"kind": "link_wrench", "force": [1.0, 0.0, 0.0], "start": 0.3}],
    })  # fmt: skip
    found = ensemble.draw(scenario, Ensemble(members=3, pushes=Pushes(count=2), cargo=None)).disturbances
    assert [type(each).__name__ for each in found] == ["Cargo", "Push", "Push", "LinkWrench"]
    assert all(each.force.shape == (3, 1, 3) and (abs(each.force) < 9.0).all() for each in found[1:3])
