"""A gait that is too fast is slowed down until it holds, and what holds at none says why."""

import re

import pytest

import mjx_climb as mc
from mjx_climb.rollouts.remedies import slow_enough

HASTY = mc.load_scenario("case_1_2").with_overrides({"gait.cycle": 0.4, "disturbance.cargo.mass": 0.0})


@pytest.mark.slow
def test_the_fastest_cycle_that_holds():
    """It holds, and the one that is twice as fast does not."""
    scenario, holds, how = slow_enough(HASTY.with_overrides({"contact.holding_limit": 5.0}))
    assert holds and scenario.gait.cycle > 0.4 and scenario.duration == 2 * scenario.gait.cycle
    assert f"at a cycle of {scenario.gait.cycle:g} s, which it does not at {scenario.gait.cycle / 2:g} s" in how
    assert not mc.rollout(scenario).detached.any()
    assert mc.rollout(scenario.with_overrides({"gait.cycle": scenario.gait.cycle / 2})).detached.any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"gravity": [0, 0, 1.62], "contact.holding_limit": 0.5}, r"limb [LR][FH] lets go; .*holding_limit is 0.5 N"),
        ({"gravity": [0, 0, -9.81], "control.kp": 0.2, "control.kd": 0.02}, "strays .* control.kp and torque limits"),
    ],
)
def test_what_holds_at_no_cycle_says_why(change, why):
    scenario, holds, how = slow_enough(HASTY.with_overrides(change))
    assert not holds and scenario.gait.cycle == 0.4
    assert how.startswith("does not walk at any cycle from 0.4 to 1.6 s: ")
    assert re.search(why, how), how
