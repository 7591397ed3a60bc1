"""What is said beside the numbers of walks, and before them."""

import pytest

import mjx_climb as mc
from tuning.report import numbers


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, 0),
        ({"gait.swing": "low_reaction"}, 1),
        ({"gait.swing": "low_reaction", "contact.capture_distance": 0.005}, 0),
        ({"gait.swing": "low_reaction", "gravity": [0.0, 0.0, 0.0]}, 0),
    ],
)
def test_low_reaction_is_warned_of_under_weight_where_grippers_hold_at_any_distance(changes, said):
    lines = numbers.ahead_of(mc.load_scenario("case_1_1", changes))
    assert len(lines) == said
    assert all("contact.capture_distance" in line for line in lines)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"control.reading": "measured_pose", "time_step": 5e-4}, 1),
        ({"control.reading": "measured_pose", "time_step": 5e-4, "hardware.control_period": 1e-3}, 0),
        ({"control.reading": "measured_pose"}, 0),
        ({"time_step": 5e-4}, 0),
    ],
)
def test_a_measured_pose_at_another_time_step_than_its_gains_is_warned_of(changes, said):
    """Case 1.1, the paper's gains: COT 1.31 at 1 ms, 5.03 at 0.5 ms, 1.31 there with a period of 1 ms."""
    lines = numbers.ahead_of(mc.load_scenario("case_1_1", changes))
    assert len(lines) == said
    assert all("0.0005 s, without a hardware.control_period" in line for line in lines)
