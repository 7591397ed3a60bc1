"""The search of joint targets: plans that know more are no worse; what a plan may depend on; refused settings."""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
import tuning
from mjx_climb.control import PD
from mjx_climb.disturbances.on_base import Push
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.gains.gains_file import Whole
from tuning.problem import ensemble as ensembles
from tuning.problem.ceiling import Ceiling
from tuning.problem.ensemble import Cargo, Ensemble
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Objective, Term
from tuning.problem.plans import RATE, SWING, OverTime, Scored
from tuning.results.ceiling import Bounded, mean_and_interval
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
    for spacing in (1e-9, 0.0004, 0.0005, 0.0015, 0.05001):
        with pytest.raises(ConfigError, match=rf"knots: expected whole time steps of 0.001 s, got {spacing:g}$"):
            search._knots(mc.Scenario(), spacing)
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
    reasons = {"joint_limit_margin": "joint limits", "peak_utilization": "limit of the grips"}
    reasons |= dict.fromkeys(("base_deviation", SWING.name, RATE.name), "2 times pd's")
    assert {limit.metric: limit.reason for limit in goal.limits} == reasons | {"peak_joint_torque": "set by the user"}
    assert {limit.margin for limit in goal.limits} == {0.02}
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

    @property
    def gravity(self):
        return np.zeros((len(self.price), 3))

    @property
    def components(self):
        return {f"disturbance.pushes.{n}": each for n, each in enumerate(self.disturbances)}


class Springs:
    """Walks whose merit is the squared distance of their targets from each member's aim, and a price of the start."""

    def __init__(self, aim, steps):
        self.aim, self.steps, self.seen, self.bases = aim, steps, [], []

    def evaluate(self, freedom, x, parameters, *, sharp):
        off = freedom.targets(x) - self.aim[:, None, None, None]
        merit = (off**2).mean((2, 3, 4)) + parameters.price.reshape(off.shape[:2])
        self.seen.append((freedom.knots.every, sharp, bool(parameters.disturbances)))
        self.bases.append(freedom.base)
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


# -------------------------------------------------------------------------------------------------- the whole contest


def contest_of(onsets, delays, aim=(0.1, 0.3), duration=0.1):
    """A contest of `Springs` whose members are pushed from a time on, s, each."""
    scenario = mc.load_scenario("case_2").with_overrides({"duration": duration})
    robot, members = load_robot(scenario.robot), len(onsets)
    asked = Ceiling.make({"knots": (0.02,), "iterations": 6, "delays": delays, "weights": {"force_variation": 1.0}})
    force = np.where(np.isfinite(onsets), 1.0, 0.0)[:, None] * np.ones(3)
    begins = np.where(np.isfinite(onsets), onsets, 0.0)
    push = Push(force=force, moment=np.zeros((members, 3)), start=begins, stop=begins + 1.0)
    parameters = Priced(np.zeros(members), (push,))
    walks: Any = Springs(np.array(aim), scenario.steps)
    draws = search.Draws(members, 0, parameters, {})
    contest = search.Contest(scenario, robot, asked, walks, draws, 0.05, lambda *_: None)
    targets = np.zeros((members, scenario.steps, *robot.joint_lower.shape))
    middle = np.clip(0.0, robot.joint_lower, robot.joint_upper)
    apart = 0.01 * np.arange(members)[:, None, None, None]
    return contest, [search.Start("pd", targets + middle + apart, parameters)]


FREE = 2, 0  # limb and joint whose limits are far


def test_a_causal_plan_is_shared_until_the_disturbance_is_felt_and_the_clairvoyant_never():
    contest, starts = contest_of(np.array([0.02, 0.05]), (0.005, 0.0101))
    ended, hidden = search._plans(contest, starts)
    assert not hidden and all(flag for *_, flag in contest.walks.seen)
    names = [each.plan.name for each in ended]
    assert names == ["blind, first", "blind", "causal 10.1 ms", "causal 5 ms", "clairvoyant"]
    # a plan for all members begins in the middle of those that each would have
    middle = np.broadcast_to(starts[0].targets.mean(0), starts[0].targets.shape)
    np.testing.assert_allclose(contest.walks.bases[0][0], middle, atol=1e-15)
    of = {each.plan.name: each.plan.targets[:, :, *FREE] for each in ended}
    for name, since in (("causal 10.1 ms", 31), ("causal 5 ms", 25)):
        np.testing.assert_array_equal(of[name][0, :since], of[name][1, :since])
        assert (of[name][0, since + 1 :] != of[name][1, since + 1 :]).all()
    np.testing.assert_array_equal(of["blind"][0], of["blind"][1])
    assert (of["clairvoyant"][0] != of["clairvoyant"][1]).all()
    merits = [each.scored.merit.mean() for each in ended[1:]]
    assert merits == sorted(merits, reverse=True)


def test_a_disturbance_at_one_time_is_hidden_from_the_blind_plan():
    contest, starts = contest_of(np.array([0.03, 0.03]), (0.005,))
    ended, hidden = search._plans(contest, starts)
    assert hidden
    disturbed = [flag for *_, flag in contest.walks.seen]
    # two searches and their ends: the walks that score an end have the disturbances
    assert disturbed == ([False] * 6 + [True]) * 2 + [True] * (len(disturbed) - 14)
    blind, causal = (next(each.plan.targets for each in ended if each.plan.name == n) for n in ("blind", "causal 5 ms"))
    np.testing.assert_array_equal(blind[:, :35], causal[:, :35])


@pytest.mark.parametrize(
    ("onsets", "names"),
    [([np.inf, np.inf], ["blind", "clairvoyant"]), ([0.02, np.inf], ["blind", "causal 5 ms", "clairvoyant"])],
)
def test_there_are_causal_plans_where_a_disturbance_is_felt(onsets, names):
    contest, starts = contest_of(np.array(onsets), (0.005,))
    ended, hidden = search._plans(contest, starts)
    assert not hidden and [each.plan.name for each in ended[1:]] == names


def test_random_starts_are_shaken_by_a_hundredth_of_a_radian_at_the_knots():
    contest, (about,) = contest_of(np.array([0.02, 0.05]), ())
    asked = contest.asked.changed({"random": 40, "seed": 3})
    starts = search._random(contest.scenario, asked, about)
    assert [each.name for each in starts[:2]] == ["random 1", "random 2"] and len(starts) == 40
    shaken = np.stack([each.targets - about.targets for each in starts])
    np.testing.assert_allclose(shaken[:, 0], shaken[:, 1], atol=1e-15)
    assert shaken[:, 0, ::20].std() == pytest.approx(0.01, rel=0.05)
    np.testing.assert_allclose(shaken[:, :, 10], (shaken[:, :, 0] + shaken[:, :, 20]) / 2, atol=1e-12)
    again = search._random(contest.scenario, asked, about)
    np.testing.assert_array_equal(again[5].targets, starts[5].targets)


def test_a_plan_of_a_front_may_be_the_best_for_its_neighbours_weights():
    goal = Objective((), ())
    terms = [Term("force_variation", 1.0, 10.0, 10.0), Term("min_tsm", 1.0, 2.0, 2.0, True)]
    metrics = np.array([[[10.0, 5.0], [2.0, 1.0]], [[6.0, 4.0], [2.5, 1.0]], [[9.0, 9.0], [4.0, 4.0]]])
    penalty = np.zeros((3, 2))
    shares = np.array([0.0, 0.5, 1.0])
    ratios = [np.asarray(goal.ratios(metrics[:, n], term)[0]) for n, term in enumerate(terms)]
    found = search._along(goal, terms, shares, metrics, penalty)
    for point, share in enumerate(shares):
        for member in range(2):
            merits = [(1 - share) * ratios[0][n, member] + share * ratios[1][n, member] for n in range(3)]
            np.testing.assert_array_equal(found[point, :, member], metrics[int(np.argmin(merits)), :, member])
    np.testing.assert_array_equal(found[0, :, 0], [6.0, 2.5])
    penalty[1, 0] = 9.0
    assert search._along(goal, terms, shares, metrics, penalty)[0, 0, 0] == 9.0
    penalty[1:, 0] = np.nan
    assert (search._along(goal, terms, shares, metrics, penalty)[:, 0, 0] == 10.0).all()


def test_the_blind_plan_walks_through_fresh_members_with_what_its_start_changed():
    contest, _ = contest_of(np.array([0.02, 0.05]), ())

    class Judging:
        def judge(self, targets, parameters):
            self.seen = targets, parameters
            return Scored(None, None, None, {"travel": np.arange(3.0)})

    walks, steps = Judging(), contest.scenario.steps
    contest = contest._replace(walks=walks, draws=contest.draws._replace(fresh=3))
    pds, fresh = (
        {"kp": np.array([50.0, 50.0]), "mass": np.array([1.0, 2.0])},
        {"kp": np.full(3, 50.0), "mass": np.arange(3.0)},
    )

    def contestant(travel):
        return search.Contestant(None, None, None, pds, {}, fresh, {"travel": travel})

    plan = search.Start(
        "blind",
        np.arange(2.0)[:, None, None, None] * np.ones((2, steps, 4, 3)),
        {"kp": np.array([60.0, 60.0]), "mass": np.array([1.0, 2.0])},
    )
    ended = [search.Ended(plan._replace(name=name), None, []) for name in ("blind, first", "blind", "clairvoyant")]
    found = search._tested(contest, {"pd": contestant(1.0), "mine": contestant(2.0)}, ended)
    assert list(found) == ["blind", "mine", "pd"] and found["mine"] == {"travel": 2.0}
    targets, parameters = walks.seen
    assert targets.shape == (3, steps, 4, 3) and (targets == 0).all()
    np.testing.assert_array_equal(parameters["kp"], [60.0] * 3)
    np.testing.assert_array_equal(parameters["mass"], [0.0, 1.0, 2.0])


def test_contestants_are_laws_of_the_scenario_files_or_pd_retuned(tmp_path):
    scenario = mc.load_scenario("case_1_2")
    own, law, gains = search._walker(scenario, "mine", {"stiffness": 1e3})
    assert own is scenario and law is None and gains == {"stiffness": 1e3}
    retuned, law, gains = search._walker(scenario, "retuned_pd", {"kp": 20.0})
    assert retuned.control.controller == "pd" and law is None and gains == {"kp": 20.0}
    whole = Whole(PD(), {"kp": 30.0})
    assert search._walker(scenario, "retuned_pd", whole) == (scenario, whole.law, whole.gains)


def test_pd_is_retuned_for_the_same_objective_on_the_members_of_the_search(monkeypatch):
    """In the precision of the plans, its joint gains alone; fresh members have no part in it."""
    scenario, asked = mc.load_scenario("case_1_2"), Ceiling(precision="float64")
    how = {"metrics": mc.METRICS, "engine": "limb", "dtype": np.float64}
    draws = search.draws_of(scenario, Ensemble(members=3, pushes=None), 2, how)
    goal, seen = Objective((), ()), {}
    monkeypatch.setattr(search, "tune", lambda *given, **named: seen.update(given=given, **named))
    monkeypatch.setattr(search.retuned_pd, "joint_of", lambda found: {"kp": 20.0, "kd": 0.1})
    assert search._retuned(scenario, asked, goal, draws) == {"kp": 20.0, "kd": 0.1}
    (own,) = seen["given"]
    assert own.control.controller == "pd" and seen["objective"] is goal
    masses = np.asarray(draws.parameters.mass_scale)
    np.testing.assert_array_equal(seen["parameters"].mass_scale, masses[:3, None])
    assert masses.shape == (5,) and seen["metrics"] is mc.METRICS and seen["engine"] == "limb"
    assert (seen["space"], seen["joint_gains"], seen["precision"]) == ("isotropic", True, "float64")


def test_histories_of_long_walks_keep_the_peaks_of_their_stretches():
    forces = np.stack([np.arange(1700.0), np.arange(1700.0)[::-1]])
    offsets = np.arange(1700.0)[None, :, None] * np.ones((2, 1, 3))
    first, peaks, kept = search._thinned(forces, offsets)
    np.testing.assert_array_equal(first, np.arange(0, 1700, 3))
    np.testing.assert_array_equal(peaks[0], np.minimum(first + 2, 1699))
    np.testing.assert_array_equal(peaks[1], 1699 - first)
    np.testing.assert_array_equal(kept[1, :, 2], first)
    assert len(search._thinned(forces[:, :1600], offsets)[0]) == 800
    assert len(search._thinned(forces[:, :800], offsets)[0]) == 800


def test_contestants_stand_from_the_clairvoyant_plan_to_pd():
    contest, (about,) = contest_of(np.array([0.02, 0.05]), ())
    scenario, table = contest.scenario, mc.MetricTable((*mc.METRICS, SWING, RATE))
    how = {"metrics": table, "engine": "limb", "dtype": np.float32}
    contest = contest._replace(draws=contest.draws._replace(how=how, fresh=3))
    goal = Objective((Term("force_variation", 1.0, 10.0, 10.0),), ())

    def metrics(variation, count=2):
        return {name: np.full(count, 1.0) for name in table.with_companions.names} | {
            "force_variation": np.full(count, variation),
            "diverged": np.zeros(count, bool),
        }

    def plan(name, variation):
        scored = Scored(np.ones(2), np.ones(2), np.ones(2, bool), metrics(variation))
        return search.Ended(about._replace(name=name), scored, [{"contestant": name, "merit": variation}])

    def contestant(variation, gains):
        return search.Contestant(scenario, PD(), gains, about.parameters, metrics(variation), about.parameters, {})

    found = {"pd": contestant(10.0, {}), "mine": contestant(8.0, {"gait.duty": 0.8})}
    ended = [plan("blind, first", 5.0), plan("blind", 4.0), plan("causal 5 ms", 3.0), plan("clairvoyant", 2.0)]
    tested = {"blind": metrics(6.0, 3), "mine": metrics(4.0, 3), "pd": metrics(8.0, 3)}
    front = search.Front(np.array([0.0, 1.0]), np.zeros((2, 2, 2)), [plan("front, 0 % min_tsm", 1.0)])
    made = search._bounded(contest, goal, found, ended, front, True, tested, None)
    assert made.contestants == ["clairvoyant", "causal 5 ms", "blind", "mine", "pd"]
    assert made.plans == made.contestants[:3]
    np.testing.assert_allclose([made.values(name)[0] for name in made.contestants], [0.2, 0.3, 0.4, 0.8, 1.0])
    assert list(made.tested) == ["blind", "mine", "pd"]
    np.testing.assert_allclose([made.tested[name][0] for name in made.tested], [0.75, 0.5, 1.0])
    assert made.data["descent_contestant"].values.tolist() == [
        "blind, first", "blind", "causal 5 ms", "clairvoyant", "front, 0 % min_tsm"
    ]  # fmt: skip
    assert (made.data.attrs["hidden"], made.data.attrs["own_gait"], made.data.attrs["reads_forces"]) == (1, "mine", "")
    assert made.sensor.mean == pytest.approx(0.2) and made.share("mine") == pytest.approx(-2.0)
    assert made.share("causal 5 ms") == pytest.approx(0.5)
    assert list(made.first) == ["clairvoyant", "causal 5 ms", "blind", "pd", "mine"]
    assert made.first["blind"].targets is not None and made.first["pd"].targets is None
    assert SWING.name not in made.problem.metrics.names and "travel" in made.problem.metrics.names


def bounded(values, descents):
    """A result of one member by the values of its contestants and the merits of its descents, (name, knots, merit)."""
    data = {"value": (("contestant", "member"), [[value] for value in values.values()])}
    names, knots, merits = zip(*descents, strict=True)
    data |= {"descent_contestant": ("descent", list(names)), "descent_knots": ("descent", list(knots)),
             "descent_merit": ("descent", list(merits))}  # fmt: skip
    return Bounded(xr.Dataset(data, {"contestant": list(values)}), Problem(mc.Scenario()), asked=BRIEF)


def test_how_sure_a_bound_is_by_its_descents():
    first = [("blind, first", 0.05, merit) for merit in (4.0, 5.0, 4.4)]
    first += [("blind, first", 0.025, merit) for merit in (3.5, 3.6)]
    descents = [*first, ("blind", 0.05, 2.0), ("blind", 0.025, 2.8)]
    found = bounded({"clairvoyant": 2.0, "blind": 2.0, "pd": 3.0}, descents)
    assert found.spread == pytest.approx(0.1) and found.left == pytest.approx(0.2)
    assert np.isnan(found.share("pd"))  # of nothing
    lost = bounded({"blind": 1.0}, [("blind, first", 0.05, 4.0), ("blind, first", 0.05, np.inf)])
    assert np.isnan(lost.spread)


def test_the_interval_of_a_mean_is_students():
    from scipy import stats

    values = np.array([1.0, 2.0, 4.0, 4.0])
    found = mean_and_interval(values)
    expected = stats.t.interval(0.95, 3, values.mean(), stats.sem(values))
    np.testing.assert_allclose(found, [values.mean(), *expected])
    assert np.isnan(mean_and_interval(values[:1])[1:]).all()


class Known:
    """A simulation whose metrics are 10 under pd, 8 with retuned joint gains and 6 else, a tenth more a member."""

    asked: list[Any]

    def __init__(self, scenario, law, metrics, engine, *, smooth):
        self.asked.append((scenario, type(law).__name__, engine, smooth))
        self.pd, self.names = type(law) is PD, metrics.with_companions.names

    def metrics(self, gains, parameters, *, dtype, unsteady):
        assert dtype is np.float64 and unsteady
        rows = 1 + 0.1 * np.arange(len(parameters.gravity))
        found = {name: (10.0 if self.pd and not gains else 8.0 if self.pd else 6.0) * rows for name in self.names}
        return found | {"diverged": np.zeros(len(rows), bool)}


class Numbered(NamedTuple):
    """Numbers of walks."""

    terms: np.ndarray


@dataclasses.dataclass
class Aimed:
    """Walks whose merit is the mean square of targets less 0.01, and whose metrics are 3, of fresh ones 4."""

    asked: tuple[Any, ...]
    goal: Objective
    rows: int
    names: tuple[str, ...]
    numbers: Numbered
    prepared: list[Any] = dataclasses.field(default_factory=list)
    steps_of: list[float] = dataclasses.field(default_factory=list)
    judged: list[Any] = dataclasses.field(default_factory=list)
    weights: list[Any] = dataclasses.field(default_factory=list)

    def prepare(self, freedom, parameters):
        since = None if freedom.since is None else freedom.since.tolist()
        self.prepared.append((len(freedom.base), freedom.knots.every, since, len(parameters.gravity)))

    def evaluate(self, freedom, x, parameters, *, sharp):
        assert len(parameters.gravity) == len(freedom.base) * 2
        self.steps_of.append(float(abs(x).max()))
        self.weights.append(tuple(self.numbers.terms[:, 0].tolist()))
        off = freedom.targets(x) - 0.01
        merit = (off**2).mean((2, 3, 4)).ravel()
        metrics = {name: np.full(len(merit), 3.0) for name in self.names} | {"diverged": np.zeros(len(merit), bool)}
        return Scored(merit, merit, merit < 9, metrics), freedom.slopes(x, 2 * off / off.shape[2])

    def judge(self, targets, parameters):
        self.judged.append((targets.shape[0], len(parameters.gravity)))
        metrics = {name: np.full(len(targets), 4.0) for name in self.names} | {"diverged": np.zeros(len(targets), bool)}
        return Scored(None, None, None, metrics)


def test_a_ceiling_walks_its_contestants_and_plans_of_all_and_returns_them(monkeypatch):
    made, followed, told = [], [], []
    monkeypatch.setattr(Known, "asked", [], raising=False)
    monkeypatch.setattr(mc, "Simulation", Known)

    def walks_of(scenario, goal, parameters, *, metrics, engine, dtype):
        names, terms = metrics.with_companions.names, Numbered(np.ones((len(goal.terms), 3)))
        made.append(Aimed((scenario, engine, dtype), goal, len(parameters.gravity), names, terms))
        return made[-1]

    monkeypatch.setattr(search, "walks_of", walks_of)
    monkeypatch.setattr(search, "tune", lambda *_, **__: "tuned")
    monkeypatch.setattr(
        search.retuned_pd, "joint_of", lambda found: {"kp": 20.0, "kd": 0.1} if found == "tuned" else None
    )

    def over_time(scenario, law, gains, parameters, targets=None, *, metrics, engine, dtype):
        rows = len(parameters.gravity)
        followed.append((type(law).__name__, gains, rows, targets is not None))
        level = 1.0 if targets is not None else {"pd": 10.0}.get(scenario.control.controller, 6.0) - 2.0 * bool(gains)
        still = np.zeros((rows, scenario.steps, 4, 3))
        return OverTime(still, np.full((rows, scenario.steps), level), np.full((rows, scenario.steps, 3), level))

    monkeypatch.setattr(search, "over_time", over_time)
    scenario = mc.load_scenario("case_1_2").with_overrides(SHORT | {"control.kp": 40.0})
    draw = Ensemble(members=2, pushes=None, cargo=Cargo(mass=(0.5, 1.0), start=(0.03, 0.05)), gravity=None)
    asked = {"knots": (0.05,), "iterations": 3, "delays": (0.005,), "random": 1, "test_members": 3, "points": 2,
             "against": "peak_joint_torque", "precision": "float64", "step": 0.08}  # fmt: skip
    found = search.ceiling(scenario, {"mine": Whole(None, {"kp": 60.0})}, ensemble=draw, engine="mjx",
                           progress=lambda *how: told.append(how), **asked)  # fmt: skip
    own = "VirtualModelAdmittance"
    assert {each[1:] for each in Known.asked} == {("PD", "mjx", True), (own, "mjx", True)}
    assert sorted(each[0].control.controller for each in Known.asked) == ["base_admittance", "pd", "pd"]
    laws = sorted(((name, gains, rows) for name, gains, rows, plans in followed if not plans), key=repr)
    assert laws == [("PD", {"kp": 20.0, "kd": 0.1}, 2), ("PD", {}, 2), (own, {"kp": 60.0}, 2)]
    assert [(name, gains, rows) for name, gains, rows, plans in followed if plans] == [("PD", None, 3)]
    walked, front = made
    assert (walked.asked, walked.rows) == ((scenario, "mjx", np.float64), 2 * (3 + 1)) and front.rows == 2
    assert sorted(walked.prepared, key=len) == [(4, 50, None, 8), (1, 50, [0.0, 0.0], 2)]
    step = 0.08 * 10.5 / 40.0  # of pd's mean torque, by the gain
    assert walked.steps_of[0] == 0.0 and walked.steps_of[1] == pytest.approx(step, rel=0.01)
    assert walked.judged == [(3, 3)]
    names = ["clairvoyant", "causal 5 ms", "blind", "mine", "retuned_pd", "pd"]
    assert found.contestants == names and list(found.tested) == ["blind", *names[3:]]
    np.testing.assert_allclose(found.data["travel"].sel(contestant="pd"), [10.0, 11.0])
    np.testing.assert_allclose(found.data["travel"].sel(contestant="mine"), [6.0, 6.6])
    np.testing.assert_allclose(found.data["unseen_travel"].sel(tested="retuned_pd"), [9.6, 10.4, 11.2])
    assert found.data["unseen_travel"].sel(tested="blind").values.tolist() == [4.0] * 3
    np.testing.assert_allclose(found.data["front_share"], [0.0, 1.0])
    assert [term.metric for term in front.goal.terms] == ["force_variation", "peak_joint_torque"]
    assert list(dict.fromkeys(front.weights)) == [(1.0, 0.0), (0.0, 1.0)]
    assert front.goal.limits == walked.goal.limits and len(found.data["front"]) == 2
    searches = list(dict.fromkeys(name for name, *_ in told))
    plans = ["blind, first", "blind", "causal 5 ms", "clairvoyant"]
    assert searches == [*plans, *(f"front, {share} peak_joint_torque" for share in ("0%", "100%"))]
    assert {(done, of) for _, done, of in told} == {(1, 3), (2, 3), (3, 3)}
    np.testing.assert_allclose(found.data["foot_force_history"][:, 0], [1.0, 1.0, 1.0, 4.0, 8.0, 10.0])
    assert found.data["base_offset_history"].shape == (6, 100, 3) and found.data["instant"][3] == pytest.approx(0.003)
    assert (found.ensemble, found.asked.points) == (draw, 2)
