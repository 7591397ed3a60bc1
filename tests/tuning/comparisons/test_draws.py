"""Draws of walks: each member walks with its own parameters, each row of gains with its law, and is labelled."""

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import LoadTransfer
from tests.shell import ROOT
from tuning.comparisons import degraded, judge
from tuning.comparisons.judge import held, through, without_sensors
from tuning.gains.gains_file import Whole
from tuning.problem.ensemble import Cargo, Drawn, Ensemble, Posterior, Pushes
from tuning.problem.evaluation import Problem

CASE = mc.load_scenario(ROOT / "configs" / "case_1_2.yaml", ["duration=0.3"])
POSTERIOR = Posterior(
    keys=("contact.damping",), log=(False,), mean=(200.0,), covariance=((1.0,),), lower=(0.0,), upper=(300.0,)
)
DRAW = Ensemble(members=3, pushes=Pushes(), cargo=Cargo(mass=(0.5, 1.0)), gravity=None)


@pytest.fixture
def asked(monkeypatch):
    """Walks whose metrics tell kp, kd, the first damping, the duty, the mass on board, and whose law walked."""
    calls = []

    def rollout(scenario, gains, parameters, *, law, metrics, **how):
        calls.append((scenario, law, how))
        count = len(np.ravel(parameters.mass_scale))
        mass = np.broadcast_to(np.ravel(parameters.at("disturbance.cargo.mass")), count)
        duty = np.ravel(gains.get("gait.duty", 0.0))[0]
        damping = np.ravel(gains.get("damping", 0.0))[0]
        told = {"travel": np.ravel(gains["kp"])[0], "min_tsm": np.ravel(gains["kd"])[0], "peak_foot_force": mass,
                "peak_joint_torque": damping, "cost_of_transport": duty}  # fmt: skip
        found = {name: np.zeros((count, 1)) for name in metrics.names}
        none = dict.fromkeys(("detached_limb", "stands_at"), np.full((count, 1), -1.0))
        found |= none | {"sensor_lost_limb": np.full((count, 1), -1)}
        columns = {name: np.reshape(value, (-1, 1)) for name, value in told.items()}
        return found | {name: np.broadcast_to(value, (count, 1)) for name, value in columns.items()}

    monkeypatch.setattr(mc, "rollout_metrics", rollout)
    return calls


def test_members_walk_with_their_own_parameters_and_gains_with_their_law(asked):
    gains = {
        "mine": mc.Gains(1.0, 300.0, 3000.0), "own": Whole(LoadTransfer(), {"leak": 1.0}),
        "gait": {"damping": 70.0, "gait.duty": 0.8, "kp": 33.0},
    }  # fmt: skip
    work = through(Problem(CASE), gains, DRAW, {"retuned_pd": {"kp": 17.0, "kd": 1.0}})
    found = work.walk(np.array([2, 0]))
    kp, kd = CASE.control.kp, CASE.control.kd
    np.testing.assert_allclose(found["travel"], [[kp, kp, 33.0, 17.0, kp]] * 2)
    np.testing.assert_allclose(found["min_tsm"], [[kd, kd, kd, 1.0, kd]] * 2)
    np.testing.assert_allclose(found["peak_joint_torque"][0], [300.0, 0.0, 70.0, 0.0, 0.0])
    np.testing.assert_allclose(found["cost_of_transport"][0], [0.0, 0.0, 0.8, 0.0, 0.0])
    mass = np.ravel(work.problem.parameters.at("disturbance.cargo.mass"))
    np.testing.assert_allclose(found["peak_foot_force"], np.tile(mass[[2, 0], None], (1, 5)))
    # what is kept of it is known by all of its gains, and by laws other than that of all
    known = work.identity()["gains"]
    assert {name: "law" in each for name, each in known.items()} == {"mine": False, "own": True, "gait": False}
    assert set(np.ravel(known["mine"]["damping"])) == {300.0} and known["gait"]["gait.duty"] == 0.8
    walked = [(scenario.control.controller, type(law).__name__) for scenario, law, _ in asked]
    assert walked[1] == (CASE.control.controller, "LoadTransfer") and walked[3:] == [("pd", "NoneType")] * 2
    assert all(how["smooth"] and how["unsteady"] and how["dtype"] == np.float32 for *_, how in asked)


@pytest.mark.parametrize(
    "ranges",
    [
        {"draw": {"contact.damping": Drawn(range=(20.0, 150.0))}},
        {"grip_stiffness": (0.5, 50.0), "draw": {}},
        {"posterior": POSTERIOR},
    ],
)
def test_a_range_that_the_time_step_cannot_follow_is_refused_before_the_first_walk(asked, ranges):
    with pytest.raises(mc.ConfigError, match=r"^ensemble: time_step: expected one short enough for .* would do"):
        through(Problem(CASE), {"mine": mc.Gains(1.0, 300.0, 3000.0)}, DRAW.model_copy(update=ranges))


def test_what_was_drawn_stands_beside_the_walks(asked):
    work = through(Problem(CASE), {"mine": mc.Gains(1.0, 300.0, 3000.0)}, DRAW)
    arrays = work.walk(np.arange(3))
    arrays["diverged"][1, 0], arrays["peak_utilization"][2, 1] = 1.0, 1.5
    limb, at = arrays["sensor_lost_limb"], arrays["sensor_lost_at"]
    limb[:2, 0], at[:2, 0] = 1, [0.25, 0.15]
    data = work.dataset(arrays)
    assert data["gains"].values.tolist() == ["mine", "pd"] and data.sizes["member"] == 3
    parameters = work.problem.parameters
    np.testing.assert_allclose(data["disturbance.cargo.mass"], np.ravel(parameters.at("disturbance.cargo.mass")))
    assert data["disturbance.cargo.mass"].attrs["units"] == "kg"
    pushes = [each.force for each in parameters.disturbances if hasattr(each, "force")]
    largest = np.max([np.linalg.norm(np.reshape(each, (-1, 3)), axis=1) for each in pushes], axis=0)
    np.testing.assert_allclose(data["largest_push"], largest)
    assert (largest > 0).any() and data["largest_push"].attrs["units"] == "N"
    assert not [name for name in data.data_vars if str(name).startswith("disturbance.pushes.")]
    np.testing.assert_allclose(data["gravity"], np.linalg.norm(CASE.gravity))
    np.testing.assert_allclose(
        data["peak_foot_force"].sel(gains="pd"), np.ravel(parameters.at("disturbance.cargo.mass"))
    )
    np.testing.assert_array_equal(data[judge.LOST], [[False, True, False], [False, False, True]])
    assert data.attrs[judge.LOST_SENSORS] == "mine ran without the force sensor of LH from 0.15 s in 2 of 3 walks"
    assert data.attrs[judge.READING] == "mine" and work.name(2) == "member 2"


def test_a_result_keeps_the_ensemble_that_was_asked_for(asked):
    """It walks through another draw: that of a seed of its own."""
    work = judge.draw_of(Problem(CASE), {"mine": mc.Gains(1.0, 300.0, 3000.0)}, DRAW, 2)
    found = work.result(work.walk(np.arange(2)))
    assert found.ensemble == DRAW.model_copy(update={"members": 2}) and found.problem is work.problem
    assert found.data["gains"].values.tolist() == ["mine", "config", "pd"] and found.data.sizes["member"] == 2
    assert found.problem.ensemble.seed != DRAW.seed and found.problem.members == 2
    assert Ensemble.parse(found.data.attrs["ensemble"], "ensemble") == found.problem.ensemble


def test_a_law_of_ones_own_walks_as_the_configs_gains():
    law = LoadTransfer()
    work = judge.draw_of(Problem(CASE, law=law), {"mine": {"leak": 1.0}}, DRAW, 2)
    assert work.gains["config"] is law and [*work.gains] == ["mine", "config"] and not work.pd


def test_members_of_a_long_walk_walk_in_parts_of_four_million_time_steps():
    long = CASE.with_overrides({"duration": 8.0})
    work = through(Problem(long), {}, DRAW.model_copy(update={"members": 3000}))
    assert (work.rows, work.size, long.steps) == (3000, 500, 8000)


def test_sensors_that_were_lost_are_named_by_limb():
    assert without_sensors({"LF": 0.5, "RH": 1.25}) == "ran without the force sensor of LF from 0.50 s, RH from 1.25 s"
    assert without_sensors({}) == ""


def test_each_setting_has_the_walks_of_its_members(asked):
    case = CASE.with_overrides({"hardware.force_sensor.noise": 0.1})
    own = Ensemble(members=2, pushes=None, cargo=Cargo(mass=(0.5, 1.0)), gravity=None)
    work = degraded.draw_of(Problem(case), {"mine": mc.Gains(1.0, 300.0, 3000.0)}, own, ("noise=x2", "noise=x3"), 2)
    arrays = work.walk(np.arange(6))
    arrays["travel"] = np.arange(6.0)[:, None] * np.ones(arrays["travel"].shape[1])
    data = work.result(arrays).data
    assert data["setting"].values.tolist() == [degraded.AS_DRAWN, "noise=x2", "noise=x3"]
    np.testing.assert_array_equal(data["travel"].sel(gains="mine"), [[0, 1], [2, 3], [4, 5]])
    assert data["member"].values.tolist() == [0, 1]


def test_gains_that_diverge_in_more_than_half_of_their_walks_are_left_out(asked):
    work = through(Problem(CASE), {"mine": mc.Gains(1.0, 300.0, 3000.0)}, DRAW.model_copy(update={"members": 4}))
    arrays = work.walk(np.arange(4))
    for lost, names, members in (([0, 1], ["mine", "pd"], [2, 3]), ([0, 1, 2], ["pd"], [0, 1, 2, 3])):
        arrays["diverged"] = np.zeros((4, 2))
        arrays["diverged"][lost, 0] = 1.0
        kept = held(work.dataset(arrays))
        assert kept["gains"].values.tolist() == names and kept["member"].values.tolist() == members
