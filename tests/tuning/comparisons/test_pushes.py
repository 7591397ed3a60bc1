"""Pushes that walks bear: found where known robots fail, with intervals that hold."""

import itertools
import json

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import PD
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.comparisons import pushes
from tuning.comparisons.pushes import verdict
from tuning.pages.pushes import pushes_table, summary

LIMITS = np.array([5.0, 20.0, 100.0])  # N, of walks that are up, down or other


def drawn(thresholds, resolution=1.02):
    """Return what a search finds whose draws (draw,) N fail above thresholds."""
    grid = np.append(0, np.geomspace(60 / 64, 60, 200))
    place = np.searchsorted(grid, thresholds, side="right") - 1
    low, high = grid[place], np.append(grid, np.inf)[place + 1]
    dims = ("walker", "length", "direction", "draw")
    data = {"survived": (dims, low[None, None, None]), "lost": (dims, high[None, None, None])}
    named = {"walker": ["mine"], "length": [0.5], "direction": ["up"]}
    return xr.Dataset(data, named, {"smallest": 60 / 64, "largest": 60.0})


def test_an_interval_holds_the_true_force_as_often_as_it_says():
    """Of thresholds spread by a third 95 % of the intervals hold, to what 400 draws leave: 92.5 % at least."""
    random, quantile = np.random.default_rng(0), {"half": 0.0, "95 %": -1.6449}
    for (name, share), count in itertools.product(pushes.SHARES.items(), (24, 80)):
        true = 10 * np.exp(quantile[name] / 3)
        each = [pushes.borne(drawn(10 * np.exp(random.normal(0, 1 / 3, count))), share) for _ in range(400)]
        assert np.mean([found.low <= true <= found.high for found in each]) > 0.925
        assert np.median([found.value for found in each]) == pytest.approx(true, rel=0.12)
        assert all(found.low <= found.value <= found.high for found in each)


def test_a_limit_that_binds_is_named():
    strong, weak = drawn(np.full(80, 100.0)), drawn(np.zeros(80))
    alone = "mine: 95 % of the walks survive a push of 0.5 s in its weakest direction, up, of"
    assert verdict(strong) == f"{alone} more than 60 N, the largest tried"
    assert verdict(weak) == f"{alone} less than 0.938 N, the smallest tried"
    assert pushes_table(strong).sections[0][1][0][2:4] == ["> 60", "> 30"]
    (row, _) = json.loads(summary(strong))["pushes"]
    assert row["outside"] == "more than the largest" and row["force"] == [None, 60.0, None]
    even = drawn(np.full(80, 12.0))
    (row, _) = json.loads(summary(even))["pushes"]
    np.testing.assert_allclose(row["impulse"], 6.0, rtol=0.03)
    assert row["outside"] == ""


def side_by_side(**forces):
    """Walkers whose draws, 80 or a tenth, all fail between a force up (and 1.5 times it down) and 1.02 times that."""
    each = [np.broadcast_to(np.array([[1.0], [1.5]]) * force, (2, 80)) for force in forces.values()]
    survived = np.array(each)[:, None]
    survived = np.where(survived < 60 / 64, 0.0, np.minimum(survived, 60.0))
    lost = np.where(survived == 60, np.inf, np.where(survived > 0, 1.0404 * survived, 60 / 64))
    dims = ("walker", "length", "direction", "draw")
    named = {"walker": [*forces], "length": [1.0], "direction": ["up", "down"]}
    return xr.Dataset({"survived": (dims, survived), "lost": (dims, lost)}, named, {"smallest": 60 / 64, "largest": 60})


@pytest.mark.parametrize(
    ("forces", "said"),
    [
        # 1.02 times the force, the middle of what is survived and lost
        ({"mine": 20.0, "config": 10.0, "pd": 5.0},
         "20.4 N, 100.0 % more than the best rival that walked, the config's gains: 10.2 N, in its own, up"),
        ({"mine": 10.0, "config": 5.0, "pd": 20.0},
         "10.2 N, 50.0 % less than the best rival that walked, pd as the config has it: 20.4 N, in its own, up"),
        ({"mine": 10.0, "pd": 10.2},
         "10.2 N, 1.9 % less than the best rival that walked, pd as the config has it: 10.4 N, in its own, up; "
         "80 walks in each direction do not tell them apart"),
        ({"mine": 10.0, "pd": 10.0},
         "10.2 N, the same as the best rival that walked, pd as the config has it: 10.2 N, in its own, up; "
         "80 walks in each direction do not tell them apart"),
        ({"mine": 100.0, "pd": 10.0},
         "more than 60 N, the largest tried, beside the best rival that walked, pd as the config has it: 10.2 N, "
         "in its own, up"),
        ({"mine": 10.0, "config": 0.1, "pd": 100.0},
         "10.2 N, beside the best rival that walked, pd as the config has it: more than 60 N, the largest tried, "
         "in its own, up"),
        ({"mine": 0.1, "pd": 0.1},
         "less than 0.938 N, the smallest tried, beside the best rival that walked, pd as the config has it: less than "
         "0.938 N, the smallest tried, in its own, up; 80 walks in each direction do not tell them apart"),
    ],
)  # fmt: skip
def test_the_verdict_on_pushes_names_the_best_rival_with_its_force(forces, said):
    own = "mine: 95 % of the walks survive a push of 1 s in its weakest direction, up, of"
    assert verdict(side_by_side(**forces)) == f"{own} {said}"


def test_each_walker_is_judged_by_its_own_weakest_direction():
    found = side_by_side(mine=10.0, pd=20.0)
    found["survived"][1], found["lost"][1] = found["survived"][1, :, ::-1].values, found["lost"][1, :, ::-1].values
    assert verdict(found).endswith("pd as the config has it: 20.4 N, in its own, down")


def test_each_draw_is_pushed_alike_and_its_force_is_bracketed(monkeypatch, case):
    """Walks that bear a known force in each direction: what is tried lies between what is survived and what is lost."""
    kept = []

    def walked(scenario, gains, parameters, **_):
        (push,) = parameters.disturbances[1:]
        size = np.linalg.norm(push.force, axis=-1)
        limit = np.where(push.force[..., 2] > 0, 5.0, np.where(push.force[..., 2] < 0, 20.0, 100.0))
        kept.append((push, parameters.at("hardware.seed")))
        return {"peak_utilization": size / limit, "diverged": np.zeros_like(size)}

    monkeypatch.setattr(mc, "rollout_metrics", walked)
    scenario, told = case("case_2", "pd", {"gait.heading": np.pi / 2}), []
    mine = pushes.Walker(PD(), {})
    found = pushes.find(scenario, {"a": mine, "b": mine}, draws=9, progress=lambda *now: told.append(now))
    assert found.sizes == {"walker": 2, "length": 2, "direction": 6, "draw": 9} and told[-1] == (2 * 7 * 108,) * 2
    for way, limit in {"up": 5.0, "down": 20.0}.items():
        own = found.sel(direction=way)
        assert (own["survived"] <= limit).all() and (own["lost"] > limit).all()
        assert (own["lost"] / own["survived"] < 1.15).all()
    ahead = found.sel(direction="ahead")
    assert (ahead["survived"] == 60.0).all() and np.isinf(ahead["lost"]).all()
    push, seed = kept[0]
    np.testing.assert_allclose(push.stop - push.start, np.tile([[[0.2]], [[1.0]]], (6, 9)))
    assert push.start.min() >= pushes.EARLIEST and push.stop.max() <= scenario.duration - pushes.AFTER
    np.testing.assert_array_equal(push.start[0], push.start[1])
    assert len(np.unique(push.start)) == 6 * 9
    np.testing.assert_array_equal(push.start, kept[7][0].start)
    assert len(np.unique(seed)) == 6 * 9
    # ahead is along the heading, left is beside it
    np.testing.assert_allclose(push.force[0, 2, 0] / np.linalg.norm(push.force[0, 2, 0]), [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(push.force[0, 4, 0] / np.linalg.norm(push.force[0, 4, 0]), [-1, 0, 0], atol=1e-9)


def test_a_walk_that_is_too_short_is_refused(case):
    with pytest.raises(ConfigError, match=r"duration: expected more than 1.75 s for pushes of 1 s, got 1"):
        pushes.find(case("case_2", "pd", {"duration": 1.0}), {"pd": pushes.Walker(PD(), {})})


@pytest.mark.slow
def test_a_robot_that_stands_bears_what_its_grips_hold(case):
    """Four grips of 15 N bear 60 N up at rest by symmetry; a push that begins at once counts up to twice.

    Without weight the force on the grips is in proportion to the push: grips of 30 N bear twice as much.
    """
    phases = {"LH": 0.5, "LF": 0.6, "RH": 0.7, "RF": 0.8}
    keys = {"duration": 1.0, "gait.cycle": 40.0, "gait.duty": 0.95, "gait.stride": 1e-3, "gait.phases": phases}
    scenario, force = case("case_2", "pd", keys), []
    robot = load_robot(scenario.robot)
    feet = np.asarray(limb_frames(robot, None, robot.stance_joints).foot)
    np.testing.assert_allclose(feet.mean(0)[:2], 0, atol=1e-3)
    for limit in (15.0, 30.0):
        stronger = scenario.with_overrides({"contact.holding_limit": limit})
        how = {"lengths": (0.2,), "largest": 8 * limit, "draws": 8, "rounds": 6}
        found = pushes.find(stronger, {"pd": pushes.Walker(PD(), {})}, **how)
        up, down = (pushes.borne(found.sel(direction=way), 0.5).value for way in ("up", "down"))
        assert 2 * limit < up < 1.05 * 4 * limit and up < down
        force.append(up)
    assert force[1] == pytest.approx(2 * force[0], rel=0.07)
