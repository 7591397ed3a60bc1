"""Tangents of a batch, whatever the shares and the batch axes."""

import dataclasses
import re

import jax
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.quantities.parameters import own_parameters

ROBOTS, MEMBERS, DIRECTIONS = 3, 2, 2


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_1_2", "virtual_model", (("duration", 0.2), ("disturbance.cargo.start", 0.05)))


@pytest.mark.parametrize(
    ("of_gains", "of_directions", "said"),
    [
        ({}, {"kp": 1.0}, "directions.kp: expected None, as gains.kp is, got rates"),
        ({"kd": 0.2}, {}, "directions.kd: expected rates of change, as gains.kd is given, got None"),
        ({"kp": 50.0, "kd": 0.2}, {"kp": 1.0}, "directions.kd: expected rates of change"),
    ],
)
def test_directions_have_the_gains_that_the_gains_have(scenario, of_gains, of_directions, said):
    gains = mc.Gains(np.ones((ROBOTS, 6)), np.full((ROBOTS, 6), 1e2), np.full((ROBOTS, 6), 3e3), **of_gains)
    rates = {name: np.full((DIRECTIONS, 1), value) for name, value in of_directions.items()}
    six = np.ones((DIRECTIONS, 1, 6))
    with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
        mc.rollout_jvp(scenario, gains, mc.Gains(six, six, six, **rates))


@pytest.mark.slow
def test_tangents_of_a_batch_agree_with_central_differences(scenario):
    """Every robot under every member's parameters, along directions of its own."""
    rng = np.random.default_rng(0)
    six, own = (ROBOTS, 6), mc.Gains(1.0, 100.0, 3e3, 50.0, 0.2)
    damping, stiffness = 100 * rng.uniform(1, 2, six), 3e3 * rng.uniform(1, 2, six)
    gains = mc.Gains(np.ones(six), damping, stiffness, np.full(ROBOTS, 50.0), np.full(ROBOTS, 0.2))
    rates = jax.tree.map(lambda g, size: size * rng.normal(size=(DIRECTIONS, *g.shape)), gains, own)
    rates = dataclasses.replace(rates, inertia=np.zeros((DIRECTIONS, 6)), kd=np.zeros(DIRECTIONS))
    parameters = dataclasses.replace(own_parameters(scenario), cargo_mass=rng.uniform(0, 1, (MEMBERS, 1)))
    walk = {"dtype": np.float64, "smooth": True}
    metrics, tangents = mc.rollout_jvp(scenario, gains, rates, parameters, **walk)
    same = mc.rollout_metrics(scenario, gains, parameters, **walk)

    def moved(step):
        there = jax.tree.map(lambda g, r: g + step * r.reshape(DIRECTIONS, 1, -1, *g.shape[1:]), gains, rates)
        return mc.rollout_metrics(scenario, there, parameters, **walk)

    above, below = moved(1e-5), moved(-1e-5)
    assert set(metrics) - set(tangents) == {"detached_limb", "missed_grips", "diverged"}
    for name, value in metrics.items():
        np.testing.assert_allclose(value, same[name], rtol=1e-9, err_msg=name)
    del tangents["detached_at"]  # nothing is torn off
    for name, tangent in tangents.items():
        assert tangent.shape == (DIRECTIONS, MEMBERS, ROBOTS)
        differences = (above[name] - below[name]) / 2e-5
        np.testing.assert_allclose(tangent, differences, rtol=1e-4, atol=1e-4 * np.abs(differences).max(), err_msg=name)
    assert np.ptp(tangents["peak_foot_force"]) > 0


@pytest.mark.nightly
@pytest.mark.slow
def test_one_robot_has_the_tangents_that_it_has_in_a_batch(case):
    """A batch of one keeps its axis, along one direction or several."""
    scenario = case("case_1_2", "virtual_model", (("duration", 0.02),))
    gains = mc.Gains(np.ones((1, 6)), np.full((1, 6), 1e2), np.full((1, 6), 3e3))
    rates = mc.Gains(np.zeros((DIRECTIONS, 1, 6)), np.full((DIRECTIONS, 1, 6), 10.0), np.zeros((DIRECTIONS, 1, 6)))
    two = jax.tree.map(lambda value: np.repeat(value, 2, axis=0), gains)
    _, alone = mc.rollout_jvp(scenario, gains, rates, dtype=np.float64)
    _, beside = mc.rollout_jvp(scenario, two, rates, dtype=np.float64)
    for name, tangent in alone.items():
        assert tangent.shape == (DIRECTIONS, 1)
        np.testing.assert_allclose(tangent, beside[name][:, :1], rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.slow
def test_gains_that_a_law_does_not_have_move_nothing(case):
    scenario, six = case("case_1_2", "pd", (("duration", 0.02),)), np.ones((1, 6))
    _, tangents = mc.rollout_jvp(scenario, mc.Gains(six, six, six), mc.Gains(six, six, six), dtype=np.float64)
    assert all((tangents[name] == 0).all() for name in ("peak_foot_force", "force_variation", "travel"))
