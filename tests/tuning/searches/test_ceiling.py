"""The search of joint targets: plans that know more are no worse; what a plan may depend on; refused settings."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

import mjx_climb as mc
import tuning
from mjx_climb.disturbances.on_base import Push
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.problem import ensemble as ensembles
from tuning.problem.ceiling import Ceiling
from tuning.problem.ensemble import Cargo, Ensemble
from tuning.problem.plans import RATE, SWING, Scored
from tuning.searches import ceiling as search

SHORT = {"duration": 0.1, "disturbance.cargo.start": 0.02}
LAWS = {"mine": {"kp": 60.0, "kd": 0.3}, "retuned_pd": {"kp": 55.0, "kd": 0.25}}
BRIEF = Ceiling(knots=(0.05, 0.025), iterations=8, delays=(0.005, 0.02), random=1, test_members=3)


def test_plans_walk_through_the_members_of_the_draw_and_then_through_fresh_ones():
    """Values that no member shares have a row for each; without an ensemble there is the scenario's own walk."""
    scenario = mc.load_scenario("case_1_2").with_overrides(SHORT)
    own = Ensemble(members=3, pushes=None, cargo=Cargo(mass=(0.5, 1.0), start=(0.03, 0.05)), gravity=None)
    draws = search.draws_of(scenario, own, 2, {})
    assert (draws.members, draws.fresh) == (3, 2)
    both = [ensembles.draw(scenario, each) for each in (own, ensembles.fresh(own.model_copy(update={"members": 2})))]
    for path in ("disturbance.cargo.mass", "contact.stiffness", "mass_scale"):
        rows = np.concatenate([np.asarray(each.at(path))[:, 0] for each in both])
        assert len(np.unique(rows)) == 5
        np.testing.assert_array_equal(draws.parameters.at(path), rows, err_msg=path)
    assert np.shape(draws.parameters.gravity) == (5, 3) and np.ptp(draws.parameters.gravity, axis=0).max() == 0
    alone = search.draws_of(scenario, None, 2, {})
    assert (alone.members, alone.fresh) == (1, 0) and np.shape(alone.parameters.at("contact.stiffness")) == (1,)


@pytest.mark.nightly
@pytest.mark.slow
def test_who_knows_more_is_no_worse_and_no_law_is_better():
    scenario = mc.load_scenario("case_1_2").with_overrides(SHORT)
    draw = Ensemble(members=2, pushes=None, cargo=Cargo(mass=(0.5, 1.0), start=(0.03, 0.05)), gravity=None)
    told = []
    found = tuning.ceiling(scenario, LAWS, BRIEF, ensemble=draw, progress=lambda *how: told.append(how))
    assert found.contestants == ["clairvoyant", "causal 5 ms", "causal 20 ms", "blind", "retuned_pd", "mine", "pd"]
    assert told[-1] == ("clairvoyant", 16, 16)
    value = {name: found.values(name) for name in found.contestants}
    ranked = [value[name].mean() for name in found.contestants[:4]]
    assert ranked == sorted(ranked) and ranked[0] < 0.99 * value["pd"].mean()
    for name in ("mine", "retuned_pd", "pd"):
        assert found.data["feasible"].sel(contestant=name).all()
        assert (value["clairvoyant"] <= value[name] * (1 + 1e-5)).all()
    assert value["pd"].mean() == pytest.approx(1.0, rel=1e-5)
    assert found.data["feasible"].sel(contestant="clairvoyant").all()

    of_first = found.data.isel(member=0)  # each step of it is kept
    forces, offsets = of_first["foot_force_history"].max("instant"), abs(of_first["base_offset_history"])
    np.testing.assert_allclose(forces, of_first["peak_foot_force"], rtol=1e-4)
    lengths = np.sqrt((offsets**2).sum("axis")).max("instant")
    np.testing.assert_allclose(lengths, of_first["base_deviation"], rtol=1e-3)
    for name in ("clairvoyant", "mine"):
        walk = found.first[name].trajectory()
        peak = np.linalg.norm(walk.foot_force, axis=-1).max()
        assert peak == pytest.approx(float(of_first["peak_foot_force"].sel(contestant=name)), rel=1e-3)

    assert list(found.tested) == ["blind", "retuned_pd", "mine", "pd"]
    assert found.tested["pd"].shape == (3,) and found.tested["pd"].mean() == pytest.approx(1.0, rel=1e-5)
    assert found.tested["blind"].mean() < 0.99  # of walks that no search has seen
    cargo = found.data["unseen_peak_foot_force"].sel(tested="blind").values
    assert len(np.unique(cargo)) == 3

    plans = found.data["joint_targets"]
    blind, late = plans.sel(plan="blind").values, plans.sel(plan="causal 20 ms").values
    np.testing.assert_array_equal(blind[0], blind[1])
    onset = search._onset(mc.parameters(scenario), 0.1)  # the scenario's own: not what was drawn
    assert onset == pytest.approx(0.02)
    np.testing.assert_array_equal(late[0, :50], late[1, :50])  # cargo from 30 ms on, felt 20 ms later
    assert found.data["descent_merit"].values[-1] <= found.data["descent_before"].values[-1]


@pytest.mark.nightly
@pytest.mark.slow
def test_a_disturbance_that_is_the_same_in_all_walks_is_hidden_from_the_blind_plan():
    scenario = mc.load_scenario("case_1_2").with_overrides(SHORT)
    found = tuning.ceiling(scenario, LAWS, BRIEF, delays=(0.02,), against="cost_of_transport", points=3)
    assert found.data.attrs["hidden"] and found.data.sizes["member"] == 1
    plans = found.data["joint_targets"].isel(member=0)
    blind, late = plans.sel(plan="blind").values, plans.sel(plan="causal 20 ms").values
    np.testing.assert_array_equal(blind[:40], late[:40])
    assert np.abs(blind - late).max() > 0
    variation, transport = found.data["front"].isel(member=0).values.T
    assert (np.diff(variation) >= 0).all() and (np.diff(transport) <= 0).all() and variation[0] < variation[-1]
    best = found.data.sel(contestant="clairvoyant").isel(member=0)
    assert variation[0] <= best["force_variation"] and transport[-1] <= best["cost_of_transport"]
    without = tuning.ceiling(scenario.with_overrides({"disturbance.cargo.mass": 0.0}), {}, BRIEF, iterations=2)
    assert without.values("retuned_pd") < 1
    assert not without.data.attrs["hidden"] and "causal 5 ms" not in without.contestants
    assert (without.values("clairvoyant") <= without.values("blind")).all()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"knots": (0.2, 0.15)}, "knots: expected each spacing to divide the one before it, got 0.2, 0.15"),
        ({"weights": {"force_variation": 0.0}}, "weights: expected one above 0"),
        ({"against": "force_variation"}, "against: expected another metric than force_variation"),
        ({"iterations": 1}, "iterations: expected 2 or more, got 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, said):
    with pytest.raises(ConfigError, match=said):
        Ceiling.make(changes)


def test_knots_are_whole_time_steps():
    with pytest.raises(ConfigError, match=r"knots: expected whole time steps of 0.001 s, got 0.0005"):
        search._knots(mc.Scenario(), 0.0005)
    assert search._knots(mc.Scenario(), 0.05).every == 50


def test_the_first_disturbance_of_a_walk_is_what_tells():
    def onset(**changes):
        scenario = mc.load_scenario("case_2").with_overrides(changes)
        members = jax.tree.map(lambda value: np.asarray(value)[None], mc.parameters(scenario))
        return search._onset(members, scenario.duration).item()

    assert onset() == 1.0 and onset(duration=0.5) == np.inf
    assert onset(**{"disturbance.cargo.mass": 1.0, "disturbance.cargo.start": 0.4}) == pytest.approx(0.4)
    pushes = [
        {"force": [0.0, 0.0, 0.0], "start": 0.1, "stop": 0.2},
        {"force": [1.0, 0.0, 0.0], "start": 0.7, "stop": 0.9},
    ]
    assert onset(**{"disturbance.pushes": pushes}) == pytest.approx(0.7)
    touch = {"kind": "link_wrench", "force": [1.0, 0.0, 0.0], "start": 0.3}
    assert onset(**{"disturbance.others": [touch]}) == pytest.approx(0.3)


def ended(name, merit, targets):
    """Return an end of plans whose members have merits and targets (member,), and parameters of the same numbers."""
    each = np.asarray(targets, float)
    scored = Scored(np.array(merit), np.array(merit), np.array(merit) < 9, {"travel": each})
    return search.Ended(search.Start(name, each[:, None, None, None], {"kp": each}), scored, [])


def test_a_plan_that_knows_more_takes_that_of_one_that_knows_less_where_that_is_better():
    """Each member by itself, or all of them by their mean; targets, parameters and scores go together."""
    own, less = ended("causal", [1.0, 5.0, 3.0], [1, 2, 3]), ended("blind", [2.0, 1.0, 3.0], [10, 20, 30])
    for alone, wanted in ((True, [1, 20, 3]), (False, [10, 20, 30])):
        found = search._no_worse(own, less, alone=alone)
        assert found.plan.name == "causal"
        for values in (found.plan.targets.ravel(), found.plan.parameters["kp"], found.scored.metrics["travel"]):
            np.testing.assert_array_equal(values, wanted)
    assert search._no_worse(less, own, alone=False).plan.targets.ravel().tolist() == [10, 20, 30]


def test_limits_of_plans_are_pd_s_and_as_wide_as_the_contestants_need():
    """Travel may be a hundredth less or more than any contestant's that walked to its end; a user's own limit stays."""
    table = mc.MetricTable((*mc.METRICS, SWING, RATE))
    asked = Ceiling.make({"deviation_factor": 2.0, "limits": {"peak_joint_torque": 3.0}})
    pd = {name: np.array([1.0, 3.0]) for name in table.names} | {"diverged": np.zeros(2)}
    goal = search._objective(asked, pd, table)
    value = {limit.metric: limit.value for limit in goal.limits}
    assert value["base_deviation"] == 6.0 and value[SWING.name] == value[RATE.name] == 6.0
    assert value["peak_joint_torque"] == 3.0 and {term.baseline for term in goal.terms} == {2.0}
    walked = [pd | {"base_deviation": np.array([7.0, 4.0]), "travel": np.array([0.2, 0.4])},
              pd | {"base_deviation": np.array([1.0, 99.0]), "travel": np.array([0.3, 9.0]),
                    "peak_joint_torque": np.array([5.0, 99.0]), "diverged": np.array([0.0, 1.0])}]  # fmt: skip
    for stride, way in ((0.1, 0.4), (2.0, 2.0)):
        limits = search._widened(goal, asked, walked, stride).limits
        value = {limit.metric: limit.value for limit in limits if limit.metric != "travel"}
        assert value["base_deviation"] == 7.0 and value[SWING.name] == 6.0 and value["peak_joint_torque"] == 3.0
        travel = {limit.larger_is_better: (limit.value, limit.scale) for limit in limits if limit.metric == "travel"}
        assert travel == {True: pytest.approx((0.2 - 0.01 * way, way)), False: pytest.approx((0.4 + 0.01 * way, way))}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Priced:
    """Parameters of `Springs`."""

    price: Any  # (member,)
    disturbances: tuple[Push, ...]


class Springs:
    """Walks whose merit is the squared distance of their targets from each member's aim, and a price of the start."""

    def __init__(self, aim, steps):
        self.aim, self.steps, self.seen = aim, steps, []

    def evaluate(self, freedom, x, parameters, *, sharp):
        off = freedom.targets(x) - self.aim[:, None, None, None]
        merit = (off**2).mean((2, 3, 4)) + parameters.price.reshape(off.shape[:2])
        self.seen.append((freedom.knots.every, sharp, bool(parameters.disturbances)))
        return Scored(merit.ravel(), merit.ravel(), merit.ravel() < 9, {}), freedom.slopes(x, 2 * off / self.steps)


@pytest.mark.parametrize("common", [True, False])
def test_a_search_of_plans_goes_on_from_the_best_start_with_finer_knots(common):
    """One start for all members, or the best one of each; a plan that is shared ends in the middle of the aims."""
    scenario = mc.load_scenario("case_2").with_overrides({"duration": 0.1})
    asked, robot = Ceiling.make({"knots": (0.05, 0.025), "iterations": 30}), load_robot(scenario.robot)
    walks: Any = Springs(np.array([0.1, 0.3]), scenario.steps)
    draws, said = search.Draws(2, 0, None, {}), []
    contest = search.Contest(scenario, robot, asked, walks, draws, 0.05, lambda *progress: said.append(progress))
    shape = (2, scenario.steps, *robot.joint_lower.shape)
    begun = np.zeros(shape) + np.clip(0.0, robot.joint_lower, robot.joint_upper)

    push = Push(force=np.ones((2, 3)), moment=np.zeros((2, 3)), start=np.zeros(2), stop=np.ones(2))

    def start(name, price):
        return search.Start(name, begun, Priced(np.array(price), (push,)))

    starts = [start("one", [1.0, 0.0]), start("other", [0.0, 0.5])]
    found = search._search(contest, "plan", starts, common=common, since=None if common else np.zeros(2))
    assert found.plan.targets.shape == shape
    free = (robot.joint_lower < 0.0) & (robot.joint_upper > 0.4)
    ends = found.plan.targets[:, :, free].mean((1, 2))
    np.testing.assert_allclose(ends, [0.2, 0.2] if common else [0.1, 0.3], atol=0.02)
    np.testing.assert_array_equal(found.plan.parameters.price, [0.0, 0.5] if common else [0.0, 0.0])
    assert {record["knots"] for record in found.records} == {0.05, 0.025}
    assert said[-1] == ("plan", 60, 60) and {every for every, *_ in walks.seen} == {50, 25}
    assert walks.seen[-1][1] == 0.0 and walks.seen[0][2]
