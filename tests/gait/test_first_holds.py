"""A robot that chooses its footholds stands on holds from the start, with their normals and limits."""

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.ground import holds_of
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError

ROCK = {"rock": {"density": 400.0, "roughness": 0.01, "corner": [-0.4, -0.25], "size": [1.0, 0.5]}, "limit": 15.0}
WALL = {"gait.footholds": "nearest", "ground.holds": ROCK, "time_step": 0.0005, "duration": 0.1}


@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_feet_stand_on_the_holds_next_to_the_rest_stance(heading):
    """By brute force; the joints have the feet there, and memory has the holds' planes and limits."""
    scenario = mc.load_scenario("case_1_1", WALL | {"gait.heading": heading})
    state = mc.Simulation(scenario).reset(dtype=np.float64)
    robot, holds, swings = load_robot(scenario.robot), holds_of(scenario.ground), state.carry.gait
    base, own = state.robot.base_position, quaternion_to_matrix(robot.stance_orientation)
    turn = np.array([[np.cos(heading), -np.sin(heading), 0], [np.sin(heading), np.cos(heading), 0], [0, 0, 1]])
    rest = (robot.stance_position + limb_frames(robot, own, robot.stance_joints).foot) @ turn.T
    nearest = np.linalg.norm(holds.position[:, None] - rest, axis=2).argmin(0)
    assert len(set(nearest)) == 4
    frames = limb_frames(robot, quaternion_to_matrix(state.robot.base_orientation), state.carry.state.joint_angles)
    np.testing.assert_allclose(base + frames.foot, holds.position[nearest], atol=1e-9)
    np.testing.assert_allclose(swings.goal, holds.position[nearest], atol=1e-12)
    for normals in (swings.held.normal, swings.left):
        np.testing.assert_allclose(normals, holds.normal[nearest], atol=1e-12)
    np.testing.assert_allclose(swings.held.rows[:, 0], -holds.normal[nearest], atol=1e-9)
    np.testing.assert_allclose(swings.held.bound, 15.0)


def test_a_stance_without_a_hold_within_reach_is_refused():
    """Holds on one side alone; and far away. A walk of planned footholds needs none."""
    rock = ROCK["rock"]
    for away, where in (({"corner": [-0.4, 0.05], "size": [1.0, 0.2]}, "R[HF]"), ({"corner": [5.0, 5.0]}, "L[HF]")):
        scenario = mc.load_scenario("case_1_1", WALL | {"ground.holds": ROCK | {"rock": rock | away}})
        with pytest.raises(ConfigError, match=f"ground.holds: expected a hold within reach .* got none for {where}"):
            mc.Simulation(scenario)
        mc.Simulation(scenario.with_overrides({"gait.footholds": "planned"}))
