"""What is said beside the numbers of walks, and before them."""

import pytest

import mjx_climb as mc
from tuning.report import remarks


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
    lines = remarks.swings(mc.load_scenario("case_1_1", changes))
    assert len(lines) == said
    assert all("contact.capture_distance" in line for line in lines)
