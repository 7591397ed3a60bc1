"""Pushes and cargo in their windows of time."""

import dataclasses

import jax
import numpy as np
import pytest

import mjx_climb as mc


@pytest.mark.slow
def test_forces_of_a_batch_need_no_moments_of_a_batch(case):
    """Forces with a batch axis beside moments without one, and the reverse: each walk is the one that it is alone."""
    push = {"force": [1.0, 0.0, 0.0], "start": 0.01, "stop": 0.05}
    scenario = case("case_1_2", "pd", (("duration", 0.1), ("gait.cycle", 0.5), ("disturbance.pushes", [push])))
    with jax.enable_x64(True):
        own = jax.tree.map(np.asarray, mc.parameters(scenario))
    force = np.arange(24.0).reshape(8, 1, 3) / 10
    moment = np.full((8, 1, 3), 0.1)
    for changes in ({"push_force": force}, {"push_moment": moment}):
        together = mc.rollout_metrics(scenario, numbers=dataclasses.replace(own, **changes), dtype=np.float64)
        both = {"push_force": np.broadcast_to(own.push_force, force.shape),
                "push_moment": np.broadcast_to(own.push_moment, force.shape), **changes}  # fmt: skip
        whole = mc.rollout_metrics(scenario, numbers=dataclasses.replace(own, **both), dtype=np.float64)
        np.testing.assert_allclose(together["peak_foot_force"], whole["peak_foot_force"], rtol=1e-12)
        assert together["peak_foot_force"].shape == (8,)
