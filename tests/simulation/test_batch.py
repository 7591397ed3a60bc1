"""Batches: each robot walks as if it were alone, whatever its neighbours do, and its tangents are differences."""

import dataclasses
import re

import jax
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters

COUNT = 64
LOST, BLOWN_UP = 10, 40  # environments made to detach and to diverge


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_2", "virtual_model", (("duration", 2.0),))


@pytest.fixture(scope="module")
def batch(scenario):
    """Gains, and parameters of which four differ from one environment to the next."""
    rng = np.random.default_rng(0)
    scale = lambda *shape: 10.0 ** rng.uniform(-1, 1, shape)  # noqa: E731
    gains = mc.Gains(scale(COUNT, 6), 1e3 * scale(COUNT, 6), 1e4 * scale(COUNT, 6))
    parameters = own_parameters(scenario).replace(
        {
            "gravity": np.array([0, 0, -1.0]) * scale(COUNT, 1),
            "contact.stiffness": 1e4 * rng.uniform(0.5, 1.5, COUNT),
            "contact.holding_limit": np.full(COUNT, 100.0),
            "disturbance.cargo.mass": rng.uniform(0, 1, COUNT),
        }
    )
    return gains, parameters


@pytest.fixture(scope="module")
def together(scenario, batch):
    return mc.rollout_metrics(scenario, *batch, dtype=np.float64)


@pytest.mark.nightly
def test_a_batch_of_64_gives_each_what_it_has_alone(scenario, batch, together):
    """Walked one at a time, every environment has the metrics that it had among 64 others."""
    alone = mc.rollout_metrics(scenario, *batch, dtype=np.float64, batch_size=1)
    assert not together["diverged"].any()
    assert len(np.unique(together["peak_foot_force"])) == COUNT
    for name, values in together.items():
        np.testing.assert_allclose(alone[name], values, rtol=1e-12, err_msg=name)


@pytest.mark.slow
def test_bad_neighbours_change_nothing(scenario, batch, together):
    """One environment tears off and one diverges: both say so, and the other 62 stay the same to the last bit."""
    gains, parameters = batch
    limit, stiffness = parameters.contact.holding_limit.copy(), parameters.contact.stiffness.copy()
    limit[LOST], stiffness[BLOWN_UP] = 1e-3, 1e9
    worse = parameters.replace({"contact.holding_limit": limit, "contact.stiffness": stiffness})
    result = mc.rollout_metrics(scenario, gains, worse, dtype=np.float64, unsteady=True)
    others = np.delete(np.arange(COUNT), [LOST, BLOWN_UP])
    for name, values in together.items():
        np.testing.assert_array_equal(result[name][others], values[others], err_msg=name)
    assert np.flatnonzero(result["diverged"]).tolist() == [BLOWN_UP]
    for bad in (LOST, BLOWN_UP):
        assert result["detached_limb"][bad] >= 0 and 0 <= result["detached_at"][bad] < 2.0
    assert np.isnan(result.pop("stands_at")[BLOWN_UP])  # it waits for no grip
    for name, values in result.items():
        assert np.isfinite(values[BLOWN_UP]), name


@pytest.mark.nightly
def test_parts_of_a_batch_have_its_shape(scenario, batch, together):
    """Batch axes of any number come back, and a last part that is not full changes nothing."""
    rows = np.arange(70) % COUNT
    fold = lambda a: a[rows].reshape(2, 35, *a.shape[1:]) if a.shape[:1] == (COUNT,) else a  # noqa: E731
    how, seen = {"dtype": np.float64, "batch_size": COUNT}, []
    progress = lambda *done_of_all: seen.append(done_of_all)  # noqa: E731
    result = mc.rollout_metrics(scenario, *jax.tree.map(fold, batch), progress=progress, **how)
    assert seen == [(64, 70), (70, 70)]
    for name, values in result.items():
        assert values.shape == (2, 35)
        np.testing.assert_allclose(values.ravel(), together[name][rows], rtol=1e-11, err_msg=name)  # other shares


STOOD = ("disturbance.pushes.0.force", "disturbance.pushes.0.moment", "ground.foothold_height")


@pytest.mark.slow
@pytest.mark.parametrize("varies", [*(pytest.param(path, marks=pytest.mark.nightly) for path in STOOD[:2]), STOOD[2]])
def test_what_varies_may_stand_beside_what_does_not(case, varies):
    """Forces with a batch axis beside moments without one, and so on: each walk is the one that it is alone."""
    push = {"force": [1.0, 0.3, 0.0], "moment": [0.1, 0.1, 0.1], "start": 0.01, "stop": 0.05}
    rough = {"disturbance.pushes": [push], "ground.footholds": {"LF": [0.0, 0.004], "RH": [0.006]}}
    scenario = case("case_1_2", "pd", {"duration": 0.1, "gait.cycle": 0.5, **rough})
    own = own_parameters(scenario)
    some = {varies: np.multiply.outer(np.arange(8.0), own.at(varies))}
    whole = {path: np.broadcast_to(own.at(path), (8, *np.shape(own.at(path)))) for path in STOOD} | some
    found, expected = (
        mc.rollout_metrics(scenario, None, own.replace(changes), dtype=np.float64)["peak_foot_force"]
        for changes in (some, whole)
    )
    assert len(np.unique(found)) == 8
    np.testing.assert_allclose(found, expected, rtol=1e-12)


# --- tangents

ROBOTS, MEMBERS, DIRECTIONS = 3, 2, 2


@pytest.fixture(scope="module")
def short(case):
    return case("case_1_2", "virtual_model", (("duration", 0.2), ("disturbance.cargo.start", 0.05)))


@pytest.mark.parametrize(
    ("of_gains", "of_directions", "said"),
    [
        ({}, {"kp": 1.0}, "directions.kp: expected None, as gains.kp is, got rates"),
        ({"kd": 0.2}, {}, "directions.kd: expected rates of change, as gains.kd is given, got None"),
        ({"kp": 50.0, "kd": 0.2}, {"kp": 1.0}, "directions.kd: expected rates of change"),
    ],
)
def test_directions_have_the_gains_that_the_gains_have(short, of_gains, of_directions, said):
    gains = mc.Gains(np.ones((ROBOTS, 6)), np.full((ROBOTS, 6), 1e2), np.full((ROBOTS, 6), 3e3), **of_gains)
    rates = {name: np.full((DIRECTIONS, 1), value) for name, value in of_directions.items()}
    six = np.ones((DIRECTIONS, 1, 6))
    with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
        mc.rollout_jvp(short, gains, mc.Gains(six, six, six, **rates))


def test_batches_that_do_not_broadcast_are_named():
    scenario = mc.load_scenario("case_1_2")
    parameters = own_parameters(scenario).replace({"disturbance.cargo.mass": np.full((8, 1), 0.1)})
    expected = "batch axes of gains and parameters: expected some that broadcast, got damping (4, 1), "
    expected += "disturbances.0.mass (8, 1)"
    with pytest.raises(ValueError, match=f"^{re.escape(expected)}$"):
        mc.rollout_metrics(
            scenario, {"damping": np.full((4, 1, 6), 500.0), "stiffness": 1e4, "inertia": 1.0}, parameters
        )


@pytest.mark.nightly
def test_tangents_of_a_batch_agree_with_central_differences(short):
    """Every robot under every member's parameters, along directions of its own."""
    rng = np.random.default_rng(0)
    six, own = (ROBOTS, 6), mc.Gains(1.0, 100.0, 3e3, 50.0, 0.2)
    damping, stiffness = 100 * rng.uniform(1, 2, six), 3e3 * rng.uniform(1, 2, six)
    gains = mc.Gains(np.ones(six), damping, stiffness, np.full(ROBOTS, 50.0), np.full(ROBOTS, 0.2))
    rates = jax.tree.map(lambda g, size: size * rng.normal(size=(DIRECTIONS, *g.shape)), gains, own)
    rates = dataclasses.replace(rates, inertia=np.zeros((DIRECTIONS, 1, 6)), kd=np.zeros((DIRECTIONS, 1)))
    parameters = own_parameters(short).replace({"disturbance.cargo.mass": rng.uniform(0, 1, (MEMBERS, 1))})
    walk = {"dtype": np.float64, "smooth": True}
    metrics, tangents = mc.rollout_jvp(short, gains, rates, parameters, **walk)
    same = mc.rollout_metrics(short, gains, parameters, **walk)

    def moved(step):
        there = jax.tree.map(lambda g, r: g + step * r.reshape(DIRECTIONS, 1, -1, *g.shape[1:]), gains, rates)
        return mc.rollout_metrics(short, there, parameters, **walk)

    above, below = moved(1e-5), moved(-1e-5)
    assert set(metrics) - set(tangents) == {"detached_limb", "missed_grips", "diverged"}
    for name, value in metrics.items():
        np.testing.assert_allclose(value, same[name], rtol=1e-9, err_msg=name)
    del tangents["detached_at"], tangents["stands_at"]  # nothing is torn off, nothing waits for a grip
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


@pytest.mark.nightly
def test_gains_that_a_law_does_not_have_move_nothing(case):
    scenario, six = case("case_1_2", "pd", (("duration", 0.02),)), np.ones((1, 6))
    _, tangents = mc.rollout_jvp(scenario, mc.Gains(six, six, six), mc.Gains(six, six, six), dtype=np.float64)
    assert all((tangents[name] == 0).all() for name in ("peak_foot_force", "force_variation", "travel"))
