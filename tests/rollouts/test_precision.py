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
    "law",
    [
        "virtual_model",
        *(pytest.param(law, marks=pytest.mark.slow) for law in ("pd", "measured_pose", "end_effector")),
    ],
)
def test_single_precision_is_good_enough(case, gains, numbers, walk, law):
    """Over 8 s of each case the peak foot force in float32 is that in float64 within 0.5 %."""
    scenarios = [case(name, law) for name in CASES]
    errors = relative_errors(scenarios, single_precision(scenarios, gains, numbers), walk)
    print({name: [f"{e:.1e}" for e in error] for name, error in errors.items()})
    assert errors["peak_foot_force"].max() < 0.005
    for name in ("force_variation", "peak_joint_torque", "cost_of_transport", "travel"):
        assert errors[name].max() < 0.005, (name, errors[name])
