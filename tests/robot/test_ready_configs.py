"""The robots that come with configs: each stands, and walks its habitat with all grippers holding."""

import numpy as np
import pytest
from PIL import Image

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.load import load_hardware, with_hardware
from mjx_climb.scenario.shipped import config_path
from tuning.command_line import main

READY = {  # limbs, joints of each
    "hubrobo_v3_2_cliff": (4, 3),
    "hubrobo_v2_2_ceiling": (4, 3),
    "limbero_like_cliff": (4, 4),
    "hexapod_ceiling": (6, 3),
    "lemur_like_cliff": (4, 7),
    "station_arms_handrail": (3, 7),
    "climb_rock": (4, 3),
}


@pytest.mark.parametrize("name", READY)
def test_a_ready_config_stands(name):
    scenario = mc.load_scenario(config_path(f"{name}.yaml"))
    robot = load_robot(scenario.robot)
    assert (len(robot.limbs), robot.joints) == READY[name]
    check_time_step(scenario)


@pytest.mark.nightly
@pytest.mark.parametrize("name", [pytest.param("lemur_like_cliff", marks=pytest.mark.nightly), "station_arms_handrail"])
def test_a_ready_config_begins_to_walk(name):
    """XLA has ended the process while it compiled one of them."""
    scenario = mc.load_scenario(config_path(f"{name}.yaml")).with_overrides({"duration": 0.02})
    assert not mc.metrics(mc.rollout(scenario))["diverged"]


@pytest.mark.slow
@pytest.mark.nightly  # of four joints: tests/robot/test_climbers.py
@pytest.mark.filterwarnings("ignore:the CPU's regions cannot do")  # seven joints: too many operations
@pytest.mark.parametrize("hardware", ["ideal", "dynamixel_x"])
def test_where_grips_transmit_moments_tangents_are_differences(hardware):
    """XLA has ended the process at such steps."""
    scenario = mc.load_scenario(config_path("station_arms_handrail.yaml")).with_overrides({"duration": 0.2})
    scenario = with_hardware(scenario, load_hardware(hardware))
    stiffness, step = np.full((1, 6), 3e3), 10.0
    _, tangents = mc.rollout_jvp(scenario, {"stiffness": stiffness}, {"stiffness": np.ones((1, 1, 6))}, dtype=float)
    moved = {"stiffness": stiffness + np.array([[step], [-step]])}
    both = mc.rollout_metrics(scenario, moved, dtype=float)
    for name in ("cost_of_transport", "peak_foot_force", "travel"):
        more, less = both[name]
        assert tangents[name][0, 0] == pytest.approx((more - less) / (2 * step), rel=1e-3), name


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", READY)
def test_a_ready_config_walks(name):
    """Its whole walk: all grippers hold, it gets where the gait leads, and no joint passes a limit."""
    scenario = mc.load_scenario(config_path(f"{name}.yaml"))
    walk = mc.rollout(scenario)
    measured = mc.metrics(walk)
    assert not measured["diverged"] and not walk.detached.any()
    way = scenario.gait.stride * scenario.duration / scenario.gait.cycle
    assert measured["travel"] == pytest.approx(way, rel=0.2)
    assert measured["joint_limit_margin"] > 0


@pytest.mark.slow
@pytest.mark.nightly
def test_six_limbs_are_drawn_stored_and_compared_at_the_shell(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["run", "hexapod_ceiling", "--set", "duration=0.2", "--compare", "pd", "--out", str(tmp_path)])
    assert not ended.value.code, capsys.readouterr().err
    scenario = mc.load_scenario("hexapod_ceiling")
    stored = dataset.load(tmp_path / "trajectory.nc")
    assert stored["limb"].values.tolist() == list(load_robot(scenario.robot).limbs)
    assert stored["support"].shape == (200, 6)
    for name in ("walk", "feet", "comparison"):
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert len(picture.getcolors(picture.width * picture.height) or []) > 100
