"""Single precision, which sweeps use, against double precision, which reproductions use."""

import jax
import numpy as np
import pytest

import mjx_climb as mc

CASES = ("case_1_1", "case_1_2", "case_2")


def single_precision(scenarios, gains, numbers):
    """Return the float32 metrics of scenarios that differ in numbers alone, walked as one batch."""
    stacked = [jax.tree.map(lambda *v: np.stack(v), *map(each, scenarios)) for each in (gains, numbers)]
    return mc.rollout_metrics(scenarios[0], *stacked)


def relative_errors(scenarios, single, walk):
    """Return the relative error of every metric of every case, (metric, case)."""
    double = [mc.metrics(walk(scenario)) for scenario in scenarios]
    names = [name for name, value in double[0].items() if isinstance(value, float) and name != "detached_at"]
    assert not single["diverged"].any()
    return {name: np.array([abs(single[name][i] / d[name] - 1) for i, d in enumerate(double)]) for name in names}


@pytest.mark.parametrize(
    ("law", "within"),
    [
        ("virtual_model", 4e-4),
        pytest.param("pd", 4e-4, marks=pytest.mark.slow),
        pytest.param("measured_pose", 3e-3, marks=pytest.mark.slow),
        pytest.param("end_effector", 3e-3, marks=pytest.mark.slow),
    ],
)
def test_single_precision_is_good_enough(case, gains, numbers, walk, law, within):
    """Over 8 s of each case metrics in float32 are those in float64."""
    scenarios = [case(name, law) for name in CASES]
    errors = relative_errors(scenarios, single_precision(scenarios, gains, numbers), walk)
    for name in ("peak_foot_force", "force_variation", "peak_joint_torque", "cost_of_transport", "travel"):
        assert errors[name].max() < within, (name, errors[name])
