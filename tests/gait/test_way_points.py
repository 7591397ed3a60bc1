"""A base that walks to points, one after the other, on footholds that are chosen."""

import dataclasses

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.ground.ground import Ground
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tests.gait.test_planner import NO_PUSH, SOFT, holds

STRIDE = 0.02
WALK = {
    "duration": 4.0, "gait.cycle": 0.8, "gait.duty": 0.85, "gait.stride": STRIDE, "gait.step_height": 0.005,
    "gait.footholds": "nearest", "disturbance.pushes": [NO_PUSH], **SOFT,
}  # fmt: skip


def walked(case, points, **changes):
    """Return the walk of a robot over holds 1 cm apart, on its way to points beside its start."""
    scenario = case("case_2", "pd", WALK | {f"gait.{name}": value for name, value in changes.items()})
    robot = load_robot(scenario.robot)
    feet = robot.stance_position + np.asarray(limb_frames(robot, np.eye(3), robot.stance_joints).foot)
    beside = robot.stance_position[:2] + np.array(points)
    scenario = scenario.with_overrides({"gait.way_points": [[float(x), float(y)] for x, y in beside]})
    spread = np.arange(-0.12, 0.121, 0.01)
    offsets = np.stack([*np.meshgrid(spread, spread), np.zeros((len(spread), len(spread)))], -1).reshape(-1, 3)
    places = (feet[:, None] * [1, 1, 0] + offsets).reshape(-1, 3)
    parameters = dataclasses.replace(own_parameters(scenario), ground=Ground(holds=holds(places)))
    return mc.rollout(scenario, parameters=parameters), beside


@pytest.mark.slow
@pytest.mark.parametrize("order", ["periodic", pytest.param("free", marks=pytest.mark.nightly)])
def test_the_base_comes_by_each_way_point_in_turn_and_stays_at_the_last(case, order):
    walk, points = walked(case, [(0.04, 0.0), (0.04, 0.03)], order=order)
    away = np.linalg.norm(walk.base_position[:, None, :2] - points, axis=2)
    assert walk.support.sum(1).min() >= 3 and not walk.detached.any()
    assert (away.min(0) < 0.6 * STRIDE).all() and away[:, 0].argmin() < away[:, 1].argmin()
    late = walk.time > walk.time[-1] - 0.4
    assert walk.support[late].all() and (away[late, 1] < 0.6 * STRIDE).all()


def test_planned_footholds_have_a_way_of_their_own():
    scenario = mc.load_scenario("case_2").with_overrides({"gait.way_points": [[0.1, 0.0]], "duration": 0.1})
    with pytest.raises(
        ConfigError, match=r"^gait.way_points: expected none with planned footholds, got \[\[0.1, 0.0\]\]$"
    ):
        mc.rollout(scenario)
