"""Parameters from Python have the ranges of a scenario's keys, and bad arguments of a batch one line each."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.quantities.parameters import KEYS, check_ranges, own_parameters
from mjx_climb.rollouts.resolve import resolve_in


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_2", "virtual_model", {"duration": 0.01, "gait.cycle": 4.0})


@pytest.fixture(scope="module")
def numbers(scenario):
    return own_parameters(scenario)


WRONG = {
    "torque_limit": (-1.0, "expected a finite number above 0, or infinite, got -1"),
    "holding_limit": (-1.0, "expected a finite number, 0 or above, or infinite, got -1"),
    "duty": (2.0, "expected a number above 0 and below 1, got 2"),
    "kp": ([50.0, -5.0], "expected a finite number above 0, got -5"),
    "cargo_mass": (-5.0, "expected a finite number, 0 or above, got -5"),
    "force_delay": (-1.0, "expected a finite number, 0 or above, got -1"),
    "gravity": ([0.0, np.nan, -9.81], "expected a list of three numbers from -10000 to 10000, got nan"),
    "heading": (7.0, "expected an angle in rad between -2 pi and 2 pi, got 7"),
    "seed": (1.5, "expected a whole number from 0 to below 2^24, got 1.5"),
    "mass_scale": (0.0, "expected a finite number above 0, got 0"),
    "cycle": (np.inf, "expected a finite number above 0, got inf"),
}


@pytest.mark.parametrize("name", WRONG)
def test_parameters_outside_of_the_ranges_of_a_scenario_are_refused(scenario, numbers, name):
    value, said = WRONG[name]
    for of in (np.asarray, jnp.asarray):
        with pytest.raises(ValueError, match=f"^parameters.{name}: ") as error:
            mc.rollout_metrics(scenario, None, dataclasses.replace(numbers, **{name: of(value)}))
        assert str(error.value) == f"parameters.{name}: {said}"


def test_every_entry_checks(scenario, numbers):
    bad = dataclasses.replace(numbers, torque_limit=np.asarray(-1.0))
    for walk in (
        lambda: mc.rollout(scenario, None, bad),
        lambda: mc.rollout_histories(scenario, None, bad),
        lambda: mc.rollout_jvp(scenario, {"damping": 1e2}, {"damping": 1.0}, bad),
        lambda: mc.simulator(scenario)(None, bad),
        lambda: mc.Environment(scenario).reset(None, bad),
    ):
        with pytest.raises(ValueError, match=r"parameters\.torque_limit"):
            walk()


def test_pushes_without_their_times_are_refused(numbers):
    bad = copy.copy(numbers)
    object.__setattr__(bad, "push_start", np.zeros(1))  # jaxtyping knows it too, while tests run
    with pytest.raises(ValueError, match=r"^parameters\.push_start: .* 3 of push_force, .* 1 of push_start"):
        check_ranges(bad)


def test_what_the_scenario_allows_is_allowed(numbers):
    """The ends of ranges, batches, and what nobody knows yet."""
    ends = {"holding_limit": np.array([0.0, np.inf]), "kd": 0.0, "duty": np.nextafter(1, 0), "seed": 2.0**24 - 1}
    check_ranges(dataclasses.replace(numbers, **{name: np.asarray(value) for name, value in ends.items()}))
    assert set(KEYS) | {"mass_scale", "foothold_height", "swing_path"} == set(vars(numbers))
    jax.eval_shape(lambda kp: check_ranges(dataclasses.replace(numbers, kp=kp)), -1.0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"dtype": jnp.bfloat16}, "dtype: expected float32 or float64, got bfloat16"),
        ({"dtype": np.int32}, "dtype: expected float32 or float64, got int32"),
        ({"batch_size": 0}, "batch_size: expected 1 or more, got 0"),
        ({"gains": {"kp": np.ones(0)}}, "gains and parameters: expected one robot or more, got batch axes (0,)"),
        ({"gains": {"damping": 1e2 + 1j}}, "gains.damping: expected real numbers, got complex128"),
        ({"gains": {"kp": 1j}}, "gains.kp: expected real numbers, got complex128"),
    ],
)  # fmt: skip
def test_bad_arguments_have_one_line_each(scenario, arguments, said):
    with pytest.raises(ValueError) as error:
        mc.rollout_metrics(scenario, **arguments)
    assert str(error.value) == said


def test_so_they_have_elsewhere(scenario):
    with pytest.raises(ValueError, match=r"^dtype: "):
        mc.Environment(scenario, dtype=jnp.float16)
    six = mc.Gains(*[np.ones((1, 6))] * 3)
    for ask in (
        lambda: mc.rollout_jvp(scenario, six, six, batch_size=0),
        lambda: mc.rollout_histories(scenario, batch_size=0),
    ):
        with pytest.raises(ValueError, match=r"^batch_size: expected 1 or more, got 0$"):
            ask()
    with pytest.raises(ValueError, match="expected one robot or more"):
        mc.Environment(scenario).reset(batch=(0,))
    with pytest.raises(ValueError, match=r"^dtype: "):
        mc.simulator(scenario)({"damping": jnp.full(6, 1e2, jnp.bfloat16)})
    with pytest.raises(ValueError, match=r"^dtype: "):
        resolve_in(scenario, law_of(scenario), None, None, np.int32)
