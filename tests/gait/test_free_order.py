"""The free order of limbs: one at a time, that which gains most."""

import dataclasses

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.gait.footholds import Farthest
from mjx_climb.gait.free_order import first_largest
from mjx_climb.ground.ground import Ground
from mjx_climb.inputs.from_scenario import own_parameters
from tests.gait.test_planner import NO_PUSH, SOFT, holds

# a limb swings for 0.2 s, and all stand for 0.1 s
WALK = {
    "duration": 1.0, "gait.cycle": 1.2, "gait.duty": 0.834, "gait.stride": 0.01, "gait.step_height": 0.005,
    "gait.order": "free", "disturbance.pushes": [NO_PUSH], **SOFT,
}  # fmt: skip


def test_of_equal_ones_the_first_is_next():
    np.testing.assert_array_equal(first_largest(np.array([1.0, 3.0, 3.0, 0.0])), [False, True, False, False])


@pytest.mark.slow
def test_the_limb_that_can_go_farthest_is_next(case):
    """Of three limbs with a hold ahead they swing in the order of the ways; the fourth stays."""
    scenario = case("case_2", "pd", WALK)
    feet = mc.rollout(case("case_2", "pd", WALK | {"duration": 0.1, "gait.order": "periodic"})).foot_position[0]
    ways = np.array([0.01, 0.0, 0.02, 0.015])
    points = feet[ways > 0] + np.outer(ways[ways > 0], [1.0, 0, 0])
    points[:, 2] = 0
    # on holds below its feet it stands
    ground = Ground(holds=holds(np.concatenate([points, feet * [1, 1, 0]])))
    parameters = dataclasses.replace(own_parameters(scenario), ground=ground, footholds=Farthest())
    walk = mc.rollout(scenario, parameters=parameters)
    assert walk.support.sum(1).min() >= 3 and not walk.detached.any()
    lifted = [int((~walk.support[:, limb]).argmax()) for limb in range(4)]
    assert lifted[2] < lifted[3] < lifted[0]
    np.testing.assert_allclose(walk.grip_point[-1][ways > 0], points, rtol=0, atol=1e-3)
