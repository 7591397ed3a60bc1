"""Which limits a walk breaks, and which hold it where it is."""

import pytest

from tuning.evaluation.verification import binding_limits, broken_limits
from tuning.problem.objectives import Limit, Objective

PULL = Limit("peak_pull_force", 40.0, 40.0, 0.02, "holding limit of the grippers")
MARGIN = Limit("joint_limit_margin", 0.0, 0.1, 0.02, "joint limits", larger_is_better=True)
TARGET = Objective((), (PULL, MARGIN))
HELD = {"diverged": False, "detached_limb": None, "detached_at": None}


@pytest.mark.parametrize(
    "pull, margin, broken, binding",
    [
        (39.18, 0.4, [], ["peak pull force 39.18, limit 40 (holding limit of the grippers)"]),
        (30.0, 0.002, [], ["joint limit margin 0.002, limit 0 (joint limits)"]),
        (30.0, 0.4, [], []),
        (41.0, -0.01, ["peak pull force 41, limit 40", "joint limit margin -0.01, limit 0"], []),
        (None, 0.4, [], []),
    ],
)
def test_limits_are_named(pull, margin, broken, binding):
    metrics = {**HELD, "peak_pull_force": pull, "joint_limit_margin": margin}
    assert binding_limits(TARGET, metrics) == binding
    found = broken_limits(TARGET, metrics)
    assert len(found) == len(broken) and all(map(str.startswith, found, broken))


def test_a_torn_gripper_and_a_walk_that_diverged_are_named():
    torn = {"diverged": False, "detached_limb": "LF", "detached_at": 1.5, "peak_pull_force": 1, "joint_limit_margin": 1}
    assert broken_limits(TARGET, torn) == ["limb LF let go at 1.500 s"]
    assert broken_limits(TARGET, torn | {"diverged": True}) == ["the walk diverged"]
