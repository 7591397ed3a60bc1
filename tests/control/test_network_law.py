"""A law whose gains are the weights of a network, of `docs/guides/learned_law.md`: searched, written, read, refused."""

import importlib.util
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from tuning.gains import gains_file, own_section
from tuning.gains.gains_tables import axes_of, labelled
from tuning.methods import method_of
from tuning.pages.comparison import gains_table
from tuning.problem import spaces
from tuning.problem.evaluation import REVERSE_ABOVE
from tuning.problem.search import Search
from tuning.searches import tune as searches
from tuning.searches.sweep import sweep
from tuning.searches.tune import tune

SCRIPT = Path(__file__).parents[2] / "docs" / "guides" / "network_law.py"
QUICK = {"duration": 0.3, "gait.cycle": 0.4, "gait.stride": 0.01, "gait.step_height": 0.01}


def from_script():
    spec = importlib.util.spec_from_file_location("network_law", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Network


Network = from_script()
SHAPES = {"inner": (16, 12), "inner_bias": (16,), "output": (12, 16), "output_bias": (12,)}


class Mixed(mc.Law):
    """An array of positive numbers beside axes, and a number that may be negative."""

    share: object = mc.gain("1", shape=(2, 3), bounds=(0.1, 10.0), default=1.0)
    damping: object = mc.gain("N s/m", length=3, bounds=(1.0, 1e3), default=10.0)
    slope: object = mc.gain("1", length=1, bounds=(-1.0, 1.0), default=0.0)

    def init(self, start):
        return ()

    def step(self, state, measured, reference):
        return state, mc.control.shifted(reference, jnp.zeros(6))


@pytest.fixture(scope="module")
def random():
    rng = np.random.default_rng(1)
    return {name: rng.normal(0, 0.3, shape) for name, shape in SHAPES.items()}


def test_the_script_is_short_and_the_page_shows_it():
    text = SCRIPT.read_text()
    assert len(text.splitlines()) <= 40
    assert text in (SCRIPT.parent / "learned_law.md").read_text()


@pytest.mark.slow
def test_arrays_are_searched_bounded_frozen_and_pinned_as_a_whole(random):
    scenario = mc.load_scenario("case_1_1")
    space = spaces.space(scenario, Search(), Network())
    assert (space.size, space.gains, len(space.ties)) == (412, list(SHAPES), 412)
    assert (space.names[0], space.names[-1]) == ("inner.0.0", "output_bias.11")
    found = spaces.to_gains64(space, space.from_gains(random)[None])
    for name, values in random.items():
        np.testing.assert_allclose(found[name][0], values, rtol=1e-15, atol=1e-16)
    wanted = Search(bounds={"output": (-0.5, 1.0)}, frozen=("inner",), pins={"inner_bias": -0.25, "output.0.1": 0.75})
    space = spaces.space(scenario, wanted, Network(**random))
    assert space.gains == ["output", "output_bias"] and space.size == 12 * 16 - 1 + 12
    low, high = (spaces.to_gains64(space, ends) for ends in (space.lower, space.upper))
    np.testing.assert_array_equal(low["inner"], random["inner"])
    np.testing.assert_array_equal(high["inner_bias"], np.full(16, -0.25))
    assert low["output"][0, 1] == high["output"][0, 1] == 0.75
    assert (low["output"][3, 3], high["output"][3, 3]) == (-0.5, 1.0) and low["output_bias"][0] == -1.0


def test_positive_arrays_move_by_logarithms_and_axes_share_gains_as_ever():
    space = spaces.space(mc.load_scenario("case_1_1"), Search(space="diagonal"), Mixed())
    assert space.names[5:] == ("share.1.2", "damping.x", "damping.y", "damping.z", "slope")
    assert [*space.parts] == ["share", "damping.x", "damping.y", "damping.z", "slope"]
    np.testing.assert_allclose(space.lower, [*6 * [np.log(0.1)], 0, 0, 0, -3.5])
    np.testing.assert_allclose(space.strides, [*6 * [6**-0.5], 1, 1, 1, 1])
    assert space.ties.sum(1).tolist() == [*6 * [1], 3, 1]
    larger = spaces.to_gains64(space, space.scaled(space.from_gains({"slope": 0.5, "share": 2.0}), 1.2, "share"))
    np.testing.assert_allclose((larger["share"].min(), larger["slope"]), (2.4, 0.5))
    assert space.on_bound(space.lower) == [*space.parts]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"bounds": {"damping": (-1.0, 1.0)}}, "bounds.damping: expected a low end above 0, got -1"),
        ({"pins": {"share": -1.0}}, "pins.share: expected a number above 0, got -1"),
        ({"frozen": ("shares",)}, "frozen.shares: expected one of damping, share, slope"),
    ],
)
def test_settings_of_arrays_that_cannot_be_are_refused_in_one_line(settings, said):
    with pytest.raises(mc.ConfigError) as refused:
        spaces.space(mc.load_scenario("case_1_1"), Search(**settings), Mixed())
    assert str(refused.value) == said


@pytest.mark.parametrize("method", ["grid", "cmaes", "optuna"])
def test_methods_that_cannot_search_so_many_numbers_refuse(method):
    search = Search(method=method)
    problem = searches.without_goal(mc.load_scenario("case_1_1"), search, law=Network())
    with pytest.raises(
        mc.ConfigError, match=rf"^method: expected at most \d+ numbers to search by {method}, got 412: pin"
    ):
        method_of(method).check(problem.space, search)


def test_a_sweep_of_an_array_is_refused():
    with pytest.raises(
        ValueError, match=r"^axes\.inner: expected a gain of one number or of axes, got an array of sha"
    ):
        sweep(mc.load_scenario("case_1_1"), {"inner": [1.0], "output_bias": [1.0]}, law=Network())


def test_a_gains_file_and_a_config_keep_every_bit(random, tmp_path):
    file = gains_file.save(random, tmp_path / "gains.yaml", law=Network())
    for name, values in gains_file.load(file, Network()).items():
        np.testing.assert_array_equal(values, random[name])
    law = own_section.load_law(f"{SCRIPT}:Network")
    section = own_section.section(type(law)(**random))
    scenario = mc.load_scenario("case_1_1").with_own(**section)
    (tmp_path / "config.yaml").write_text(scenario.to_yaml())
    taken = own_section.taken(mc.load_scenario(tmp_path / "config.yaml"))[1]
    for name, values in random.items():
        np.testing.assert_array_equal(getattr(taken, name), values)


def test_rows_of_unequal_lengths_are_refused_in_one_line(tmp_path):
    (tmp_path / "gains.yaml").write_text("law: network_law.py:Network\n" + "".join(f"{n}: [[1], 2]\n" for n in SHAPES))
    with pytest.raises(
        mc.ConfigError, match=r"gains\.yaml: inner: expected a number, or lists of numbers of equal len"
    ):
        gains_file.load(tmp_path / "gains.yaml", Network())


def test_tables_show_an_array_by_shape_and_norm_and_netcdf_has_it_whole(random):
    rows = [row for _, section in gains_table({"tuned": (random, {})}, Network()).sections for row in section]
    assert [row[0] for row in rows] == list(SHAPES)
    assert rows[0][2] == f"16 x 12, norm {np.linalg.norm(random['inner']):.4g}"
    variables = labelled({name: values[None] for name, values in random.items()}, ("front",), Network())
    assert variables["inner"][0] == ("front", "inner_0", "inner_1") and axes_of(variables) == {}
    np.testing.assert_array_equal(variables["inner"][1][0], random["inner"])


@pytest.fixture(scope="module")
def problem(case):
    """Return a search of the network in double precision, over a walk in which each limb lets go and grips."""
    scenario = case("case_1_1", "virtual_model", tuple(QUICK.items()))
    return searches.problem_of(scenario, Search(precision="float64"), law=Network())


@pytest.mark.nightly
def test_reverse_derivatives_by_arrays_are_central_differences(problem, random):
    """Along random directions in all of the weights, of the objective with smooth extremes and with true ones."""
    space, rng = problem.space, np.random.default_rng(2)
    assert space.size > REVERSE_ABOVE
    theta = space.from_gains(random)
    found = problem.evaluate(theta[None], np.eye(space.size))
    along, step = rng.normal(0, 1, (3, space.size)), 1e-5
    sides = [problem.evaluate(theta + sign * step * along) for sign in (1, -1)]
    for gradient, values in (
        (found.gradient, [s.descent for s in sides]),
        (found.sharp, [s.value + s.penalty for s in sides]),
    ):
        difference = (values[0] - values[1]) / (2 * step)
        assert np.abs(difference).min() > 0
        np.testing.assert_allclose(gradient[0] @ along.T, difference, rtol=1e-4, atol=1e-5 * np.abs(difference).max())


@pytest.mark.nightly
def test_a_few_steps_of_the_gradient_lower_the_objective(problem):
    found = tune(problem.scenario, law=Network(), precision="float64", starts=1, iterations=4)
    descent = found.data["descent"].values
    assert np.isfinite(descent).all() and descent.min() < descent[0]
    for name, shape in SHAPES.items():
        assert found.gains[name].shape == shape
    assert found.env_steps == 4 * problem.scenario.steps * (1 + REVERSE_ABOVE)


@pytest.mark.nightly
def test_a_minute_of_gradients_beats_the_start():
    """Of two cores, once the walk is compiled. The start walks as pd does, on the limits of `no_worse_than_pd`."""
    began = []

    def stop(now):
        began.append(time.monotonic())
        if began[-1] - began[0] > 60:
            raise KeyboardInterrupt

    scenario = mc.load_scenario("case_1_1").with_overrides({"duration": 2.0})
    how = {"starts": 1, "iterations": 40, "no_worse_than_pd": False}
    found = tune(scenario, law=Network(), progress=stop, **how)
    assert found.feasible and found.value < float(found.data["value"][0]) - 0.01
    assert jax.tree.map(np.shape, dict(found.gains)) == SHAPES
