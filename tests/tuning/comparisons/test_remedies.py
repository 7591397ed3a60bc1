"""What would keep grippers from letting go, in one line."""

import pytest

import mjx_climb as mc
from tuning.comparisons.remedies import remedies


@pytest.mark.slow
def test_grips_without_a_limit_are_said_to_have_none():
    """A hold with limits may let go of them."""
    scenario = mc.load_scenario("case_1_2", ["duration=0.3", "contact.holding_limit=null"])
    assert remedies(scenario, 0.1).endswith("; contact.holding_limit is null")
