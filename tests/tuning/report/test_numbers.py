"""What is said beside the numbers of walks, and before them."""

import pytest

import mjx_climb as mc
from tuning.report import numbers

JUMPY, MEASURED = {"gait.swing": "low_reaction"}, {"control.reading": "measured_pose"}
UNSTUCK, OF_STEP = "contact.capture_distance", "0.0005 s, without a hardware.control_period"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, None),
        (JUMPY, UNSTUCK),
        (JUMPY | {"contact.capture_distance": 0.005}, None),
        (JUMPY | {"gravity": [0.0, 0.0, 0.0]}, None),
        (MEASURED | {"time_step": 5e-4}, OF_STEP),
        (MEASURED | {"time_step": 5e-4, "hardware.control_period": 1e-3}, None),
        (MEASURED, None),
        ({"time_step": 5e-4}, None),
    ],
)
def test_what_speaks_against_a_scenario_is_said_before_the_walk(changes, said):
    """A low-reaction swing under weight where grippers hold at any distance, and gains of another control period.

    Case 1.1, the paper's gains: COT 1.31 at 1 ms, 5.03 at 0.5 ms, 1.31 there with a period of 1 ms.
    """
    lines = numbers.ahead_of(mc.load_scenario("case_1_1", changes))
    assert len(lines) == (said is not None) and all(said in line for line in lines)
