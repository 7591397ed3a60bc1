"""The gait among the gains: the walk is that of a scenario with these values; what no gait could have is refused."""

import jax
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.hardware.stages import IDEAL

SHORT = mc.load_scenario("case_1_2", {"duration": 0.6, "gait.cycle": 1.0, "gait.stride": 0.02})
GAIT = {"gait.duty": 0.8, "gait.cycle": 0.76, "gait.step_height": 0.02}
WALKED = SHORT.with_overrides(GAIT | {"gait.stride": 0.02 * 0.76})
PAPER = {"inertia": 1.0, "damping": 5e3, "stiffness": 5e4}


@pytest.mark.slow
def test_the_walk_is_that_of_the_scenario_with_these_values():
    """Bit by bit, at the same speed of travel, whatever law has the other gains; the walk says which gait it had."""
    walk, same = mc.rollout(SHORT, {"kp": 40.0, **GAIT}), mc.rollout(WALKED, {"kp": 40.0})
    assert walk.scenario == WALKED
    np.testing.assert_array_equal(walk.foot_force, same.foot_force)
    assert not np.array_equal(walk.foot_force, mc.rollout(SHORT, {"kp": 40.0}).foot_force)
    again = mc.rollout(walk.scenario, walk.gains, walk.parameters)
    np.testing.assert_array_equal(walk.base_position, again.base_position)


@pytest.mark.nightly
def test_a_batch_of_gaits_is_walked_side_by_side():
    """A cycle between two time steps counts as the nearer one; a stride that is given is kept."""
    pd = SHORT.with_overrides(["control.controller=pd"])
    cycle, height = np.array([0.76, 0.7603, 1.0]), np.array([0.02, 0.02, 0.03])
    found = mc.rollout_metrics(pd, {**PAPER, "gait.cycle": cycle, "gait.step_height": height})
    kept = mc.rollout_metrics(pd, {**PAPER, "gait.cycle": cycle, "gait.stride": 0.02, "gait.step_height": height})
    for name in ("travel", "peak_foot_force", "force_variation"):
        assert found[name][0] == found[name][1] != found[name][2]
        assert kept[name][0] != found[name][0]
        np.testing.assert_allclose(kept[name][2], found[name][2], rtol=1e-4)  # another program
    scenarios = [pd.with_overrides({"gait.cycle": 0.76, "gait.stride": 0.0152, "gait.step_height": 0.02}), pd]
    for row, scenario in zip((0, 2), scenarios, strict=True):
        for name, value in mc.rollout_metrics(scenario).items():
            np.testing.assert_allclose(found[name][row], value, rtol=1e-4, atol=1e-5, err_msg=name)


def test_times_have_no_derivative():
    with pytest.raises(ValueError, match=r"^directions\.gait\.duty: expected none, as it is counted in whole time"):
        mc.rollout_jvp(SHORT, {"gait.duty": 0.8}, {"gait.duty": np.ones(1)})


LENGTHS = {"gait.step_height": 0.02, "gait.height": 0.95, "gait.sway": 0.05, "gait.landing_speed": 0.02}


@pytest.mark.nightly
def test_heights_sway_and_landing_speed_have_derivatives():
    """Of the sway also where there is none, from above."""
    every = ("cost_of_transport", "base_deviation", "force_variation")
    simulation = mc.Simulation(SHORT, metrics=tuple(mc.METRICS[name] for name in every))
    along = {"damping": np.zeros((len(LENGTHS), 6)), **dict(zip(LENGTHS, np.eye(len(LENGTHS)), strict=True))}
    for key, sway in [*((name, 0.05) for name in LENGTHS), ("gait.sway", 0.0)]:
        values = {"damping": 5e3, **LENGTHS, "gait.sway": sway}
        slopes = {
            name: slope[[*LENGTHS].index(key)]
            for name, slope in simulation.jvp(values, along, dtype=np.float64)[1].items()
        }
        h, rtol, other = (1e-6, 1e-4, 2) if key == "gait.step_height" else (1e-5, 1e-3, 1)
        weights = {h: 1.0, -h: -1.0} if values[key] else {2 * h: -1.0, h: 4.0, 0.0: -3.0}
        ends = {e: simulation.metrics(values | {key: values[key] + e}, dtype=np.float64) for e in weights}
        for name in ("cost_of_transport", every[other]):
            expected = sum(weight * ends[e][name] for e, weight in weights.items()) / (2 * h)
            np.testing.assert_allclose(slopes[name], expected, rtol=rtol, err_msg=f"{key} {name}")


def test_what_a_walk_is_not_compiled_for_is_refused_where_it_is_traced():
    simulation = mc.Simulation(SHORT)
    assert simulation.structure.stages == IDEAL
    with pytest.raises(ValueError, match=r"^gains\.gait\.sway: expected a value that is known where the walk is"):
        jax.jit(lambda sway: simulation.simulate({"gait.sway": sway})["travel"])(0.1)
    assert jax.eval_shape(lambda: simulation.reset({"gait.height": 0.9})).setup.hardware.stages.height


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        ({"gait.duty": 0.6}, r"gains\.gait\.duty: expected a number from 0\.75 to below 1, so that one swing"),
        ({"gait.duty": [0.8, 1.0]}, r"gains\.gait\.duty: expected a number above 0 and below 1, got 1"),
        ({"gait.duty": 0.9999}, r"gains\.gait\.duty: expected a swing, .* of two time steps"),
        ({"gait.cycle": 1e-5}, r"gains\.gait\.cycle: expected a finite number above 0, got 0"),
        ({"gait.step_height": -0.1}, r"gains\.gait\.step_height: expected finite numbers of 0 or more, got -0\.1"),
        ({"gait.cycle": np.nan}, r"gains\.gait\.cycle: expected finite numbers of 0 or more, got nan"),
        ({"gait.step_height": 0.0}, r"gains\.gait\.step_height: expected a number above 0, 100 at most, got 0"),
        ({"gait.height": [1.0, 2.5]}, r"gains\.gait\.height: expected at most 1\.\d+, with which all feet are within"),
        ({"gait.height": 1.7, "gait.sway": 0.9}, r"gains\.gait\.sway: expected at most 0\.\d+, with which all feet"),
        ({"gait.heading": 0.1}, r"gains\.gait\.heading: expected one of inertia, damping, stiffness, kp, kd, ki, safe"),
    ],
)  # fmt: skip
def test_what_no_gait_could_have_is_refused_in_one_line(gains, message):
    with pytest.raises(ValueError, match=rf"^{message}") as refused:
        mc.rollout_metrics(SHORT, gains)
    assert "\n" not in str(refused.value)


def test_swings_worked_out_for_one_stride_keep_it_and_a_robot_that_walks_its_gait():
    low = SHORT.with_overrides(["gait.swing=low_reaction"])
    with pytest.raises(
        ValueError, match=r"^gains\.gait\.duty: expected none, as gait\.swing: low_reaction is computed"
    ):
        mc.rollout_metrics(low, {"gait.duty": 0.8})
    simulation = mc.Simulation(SHORT)
    with pytest.raises(ValueError, match=r"^gains\.gait\.duty: expected none, a robot that walks keeps its gait"):
        simulation.with_gains(simulation.reset(), {"gait.duty": 0.8})
