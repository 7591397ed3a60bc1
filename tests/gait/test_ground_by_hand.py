"""Footholds, heights below them, and the base's way over its feet, against loops over limbs, steps and phases."""

import math

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import mjx_climb as mc
from mjx_climb.gait.base_path import planned_feet, raised, sway_of, swayed
from mjx_climb.gait.footholds.footholds import level, pull_of_grip
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot_import.load import load_robot
from mjx_climb.terrain import foothold_heights, footholds
from tests.physics.test_kinematics_by_hand import forward

ROBOT = load_robot("hubrobo_v3_2")
CASE = mc.load_scenario("case_1_2")
STANCE = np.array([quaternion_to_matrix(ROBOT.stance_orientation) @ forward(ROBOT, n, ROBOT.stance_joints[n])[0]
                   for n in range(4)])  # fmt: skip


def rest_to_rest(share):
    share = min(max(share, 0.0), 1.0)
    return 3 * share**2 - 2 * share**3


@pytest.mark.parametrize(("duration", "heading"), [(4.0, 0.0), (4.1, 0.7), (8.0, -2.0), (0.4, 0.3)])
def test_footholds_are_a_stride_apart_along_the_heading(duration, heading):
    """As many as there are cycles that begin, and the first."""
    scenario = CASE.with_overrides(
        {"gait.cycle": 2.0, "gait.stride": 0.03, "duration": duration, "gait.heading": heading}
    )
    found = footholds(scenario, ROBOT)
    count = math.ceil(duration / 2.0 - 1e-9) + 1
    assert found.shape == (4, count, 2)
    for limb in range(4):
        x, y = (ROBOT.stance_position + STANCE[limb])[:2]
        for n in range(count):
            ahead = x + 0.03 * n
            wanted = [
                math.cos(heading) * ahead - math.sin(heading) * y,
                math.sin(heading) * ahead + math.cos(heading) * y,
            ]
            np.testing.assert_allclose(found[limb, n], wanted, atol=1e-12)


def test_heights_below_footholds_are_linear_between_the_samples_of_a_map(tmp_path):
    """By SciPy, on a map whose axes have other lengths, with a scale; one that ends before the walk is refused."""
    heights = np.random.default_rng(0).normal(size=(60, 90))
    np.save(tmp_path / "map.npy", heights)
    about = {"file": str(tmp_path / "map.npy"), "resolution": 0.01, "origin": [-0.35, -0.3], "scale": 2e-3}
    scenario = CASE.with_overrides({"ground.map": about, "gait.heading": 0.2, "gait.stride": 0.02})
    places = footholds(scenario, ROBOT)
    rows, columns = -0.3 + 0.01 * np.arange(60), -0.35 + 0.01 * np.arange(90)
    expected = RegularGridInterpolator((rows, columns), 2e-3 * heights)(places[..., ::-1])
    np.testing.assert_allclose(foothold_heights(scenario, ROBOT), expected, atol=1e-9)
    for origin in ([-0.05, -0.3], [-0.35, 0.0], [-0.9, -0.3], [-0.35, -0.75]):
        with pytest.raises(mc.ConfigError, match=r"expected a map that covers foothold \d+ of \w+ at x"):
            foothold_heights(CASE.with_overrides({"ground.map": about | {"origin": origin}}), ROBOT)


def test_heights_of_a_list_go_on_with_their_last_one():
    scenario = CASE.with_overrides({"ground.footholds": {"LF": [0.0, 0.01, 0.02], "RH": [0.005]}})
    found = dict(zip(ROBOT.limbs, foothold_heights(scenario, ROBOT).tolist(), strict=True))
    assert found == {"LF": [0, 0.01, 0.02], "RH": [0.005] * 3, "LH": [0.0] * 3, "RF": [0.0] * 3}
    assert foothold_heights(CASE, ROBOT).shape == (4, 0)


ORDERS = {"one by one": [0.0, 0.25, 0.5, 0.75], "pairs": [0.0, 0.5, 0.0, 0.5], "uneven": [0.1, 0.3, 0.7, 0.9]}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("duty", [0.55, 0.8, 0.92])
def test_the_base_sways_through_the_middles_of_the_feet_that_stand(order, duty):
    """At rest in the middle of each swing, cubic in between; feet that swing then do not count."""
    lift_off, share = np.array(ORDERS[order]), 0.4
    sway = sway_of(STANCE, lift_off, duty, share)
    times = sorted({*lift_off.tolist()})
    points = []
    for time in times:
        middle = time + (1 - duty) / 2
        stands = [n for n in range(4) if (middle - lift_off[n] + 1e-6) % 1.0 >= 1 - duty]
        points.append(share * np.append(np.mean(STANCE[stands, :2], axis=0), 0.0))
    for phase in np.linspace(-1, 2, 61):
        since = [(phase - time - (1 - duty) / 2) % 1.0 for time in times]
        last = int(np.argmin(since))
        following = (last + 1) % len(times)
        span = (times[following] - times[last]) % 1.0 or 1.0
        wanted = points[last] + (points[following] - points[last]) * rest_to_rest(since[last] / span)
        np.testing.assert_allclose(swayed(sway, phase), wanted, atol=1e-9)


def test_planned_feet_swing_ahead_of_a_base_that_goes_on_sways_and_is_raised():
    changes = {
        "gait.stride": 0.04,
        "gait.step_height": 0.03,
        "gait.sway": 0.3,
        "gait.height": 1.1,
        "gait.settling": 0.2,
    }
    gait = CASE.with_overrides(changes).gait
    phases = np.linspace(0, 0.999, 23)
    feet, swing = planned_feet(ROBOT, gait, phases)
    lift_off = [gait.lift_off[limb] for limb in ROBOT.limbs]
    sway = sway_of(STANCE, lift_off, gait.duty, 0.3)
    above = np.array([0, 0, 0.1 * ROBOT.stance_position[2]])
    np.testing.assert_allclose(raised(ROBOT, gait), above)
    for row, phase in enumerate(phases):
        for limb in range(4):
            share = (phase - lift_off[limb]) / (1 - gait.duty)
            assert swing[row, limb] == pytest.approx(share)
            moved = min(max(share / 0.8, 0.0), 1.0)
            height = 0.03 * rest_to_rest(1 - abs(2 * moved - 1))
            ahead = 0.04 * (rest_to_rest(moved) - rest_to_rest(phase))
            wanted = STANCE[limb] + [ahead, 0, height] - above - swayed(sway, phase)
            np.testing.assert_allclose(feet[row, limb], wanted, atol=1e-9)


def test_a_grip_on_a_hold_bears_what_the_weaker_one_bears():
    """None of both names a limit: no pull that margins may count on."""
    for hold in (0.0, 0.5, 3.0, math.inf):
        for grip in (0.0, 0.25, 0.9, 5.0):
            named = [each for each in (hold, grip if grip > 0 else math.inf) if each < math.inf]
            found = pull_of_grip(np.array([hold, hold]), np.asarray(grip))
            np.testing.assert_array_equal(found, [min(named, default=0.0)] * 2)
    np.testing.assert_array_equal(level(np.array([[1.0, -2.0, 3.0]])), [[1.0, -2.0, 0.0]])
