"""A robot that chooses its footholds stands on holds from the start, with their normals and limits."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.gait.first_holds import check_first_holds, first_holds
from mjx_climb.gait.footholds.held import no_holds
from mjx_climb.ground import holds_of
from mjx_climb.physics.inverse_kinematics import limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tests.gait import footholds_reference as by_loops
from tests.gait.test_planner_decisions import BASE, FEET, GRAVITY, ROBOT, ground_of, reaches

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


def test_each_foot_takes_the_nearest_hold_that_is_its_own_and_that_it_reaches():
    """By loops, from bases that are turned and moved; where there is none it stays, on the ground that it had."""
    held, lacking = [], 0
    begin = jax.jit(lambda holds, place, rest: first_holds(ROBOT, limb_geometry(ROBOT), holds, place, rest))
    for seed in range(8):
        random = np.random.default_rng(seed)
        angle, base = random.normal(0, 0.3), BASE + random.normal([1.0, -2.0, 0.5], 0.02)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        feet = base + (FEET - BASE) @ turn.T
        # one foot has none beside it; some lie far off, one between two feet, and one on a foot is padding
        beside = feet[np.arange(4) != seed % 4] + random.normal(0, 0.05, (3, 3)) * [1, 1, 0.3]
        far = random.uniform(-0.3, 0.3, (3, 3)) + base
        points = np.concatenate([beside, far, feet[:2].mean(0)[None] + 0.001, feet[seed % 4][None]])
        holds = ground_of(points, random)
        own = no_holds(holds, jnp.asarray(feet))
        place = tuple(map(jnp.asarray, (base, turn, feet, GRAVITY)))
        found, on = begin(holds, place, own)
        may, away = reaches(points, base, turn), np.linalg.norm(points - feet[:, None], axis=2)
        may = may & (away <= away.min(0)) & (np.arange(len(points)) < len(points) - 1)
        for limb in range(4):
            if not may[limb].any():
                lacking += 1
                np.testing.assert_array_equal(found[limb], feet[limb])
                np.testing.assert_array_equal(on.bound[limb], np.inf)
                continue
            best = np.where(may[limb], away[limb], np.inf).argmin()
            held.append(best)
            np.testing.assert_array_equal(found[limb], points[best])
            np.testing.assert_array_equal(on.bound[limb], holds.limit_bound[best])
            axes = by_loops.frame(np.asarray(holds.normal[best]), GRAVITY)
            np.testing.assert_allclose(on.rows[limb], holds.limit_matrix[best] @ axes.T, atol=1e-12)
    assert lacking > 2 and len({*held}) > 4


@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_the_check_of_a_stance_looks_where_its_feet_stand(heading):
    """Four holds 1 cm beside the feet, of which one is taken away or moved; the base is turned by the heading."""
    robot = load_robot("hubrobo_v3_2")
    turn = np.array([[np.cos(heading), -np.sin(heading), 0], [np.sin(heading), np.cos(heading), 0], [0, 0, 1]])
    own = quaternion_to_matrix(robot.stance_orientation)
    feet = (robot.stance_position + limb_frames(robot, own, robot.stance_joints).foot) @ turn.T
    points = feet + np.array([0.006, 0.008, 0.0])

    def checked(points):
        keys = {
            "gait.footholds": "nearest",
            "gait.heading": heading,
            "ground.holds": {"points": [{"at": at} for at in points.tolist()]},
        }
        check_first_holds(mc.load_scenario("case_1_1", keys), "mine.yaml")

    checked(points)
    for limb, shift in enumerate(([0.4, 0, 0], [0, 0.4, 0], [-0.4, 0, 0], [0, 0, 0.4])):
        away = points + np.outer(np.arange(4) == limb, shift)
        nearest = np.linalg.norm(away - feet[limb], axis=1).min()
        with pytest.raises(
            ConfigError, match=f"none for {robot.limbs[limb]}, the nearest {nearest:.2g} m away".replace("[", r"\[")
        ):
            checked(away)


@pytest.mark.parametrize("height", [1.0, 2.0])
def test_a_base_that_the_gait_raises_reaches_less(height):
    """Holds straight below the feet, which a raised base has to stretch for."""
    robot = load_robot("hubrobo_v3_2")
    own = quaternion_to_matrix(robot.stance_orientation)
    feet = robot.stance_position + limb_frames(robot, own, robot.stance_joints).foot
    holds = {"points": [{"at": at} for at in feet.tolist()]}
    keys = {"gait.footholds": "nearest", "gait.height": height, "ground.holds": holds}
    refused = (
        contextlib.nullcontext() if height == 1.0 else pytest.raises(ConfigError, match="none for LF, the nearest")
    )
    with refused:
        check_first_holds(mc.load_scenario("case_1_1", keys))


@pytest.mark.parametrize(("scale", "said"), [(1.0, False), (10.0, False), (1000.0, True)])
def test_a_cloud_in_millimetres_is_called_so(tmp_path, scale, said):
    """A wall of 2 m by 1 m; in dm it is as large as a hall."""
    x, y = np.meshgrid(np.linspace(0.3, 2.3, 41), np.linspace(-0.5, 0.5, 21))
    np.savetxt(
        tmp_path / "scan.csv",
        scale * np.c_[x.ravel(), y.ravel(), 0 * x.ravel()],
        "%g",
        ",",
        header="x,y,z",
        comments="",
    )
    keys = WALL | {"ground.holds": {"cloud": {"file": str(tmp_path / "scan.csv")}}}
    with pytest.raises(ConfigError, match=r"got none for \w\w, the nearest [\d.e+]+ m away") as refused:
        check_first_holds(mc.load_scenario("case_1_1", keys), "mine.yaml")
    assert ("m away, among points over 2e+03 m, as of a file in mm" in str(refused.value)) == said


def test_a_stance_without_a_hold_within_reach_is_refused():
    """Holds on one side alone; and far away. A walk of planned footholds needs none."""
    rock = ROCK["rock"]
    for away, where in (({"corner": [-0.4, 0.05], "size": [1.0, 0.2]}, "R[HF]"), ({"corner": [5.0, 5.0]}, "L[HF]")):
        scenario = mc.load_scenario("case_1_1", WALL | {"ground.holds": ROCK | {"rock": rock | away}})
        with pytest.raises(ConfigError, match=f"ground.holds: expected a hold within reach .* got none for {where}"):
            mc.Simulation(scenario)
        mc.Simulation(scenario.with_overrides({"gait.footholds": "planned"}))
