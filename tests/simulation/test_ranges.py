"""Parameters of a scenario, from Python in the ranges of its keys, and bad arguments of a batch in one line each."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.inputs.from_scenario import check_parameters, own_parameters
from mjx_climb.inputs.resolve import resolve_in


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_2", "virtual_model", {"duration": 0.01, "gait.cycle": 4.0})


@pytest.fixture(scope="module")
def numbers(scenario):
    return own_parameters(scenario)


WRONG = {
    "hardware.servo.torque_limit": (-1.0, "expected finite numbers above 0, or infinite ones, got -1"),
    "contact.holding_limit": (-1.0, "expected finite numbers of 0 or more, or infinite ones, got -1"),
    "gait.duty": (1.0, "expected numbers above 0 and below 1, got 1"),
    "gait.sway": (1.0, "expected numbers from 0 to below 1, got 1"),
    "hardware.servo.pwm_limit": (0.0, "expected numbers above 0, 1 at most, got 0"),
    "control.kp": ([50.0, -5.0], "expected finite numbers above 0, got -5"),
    "disturbance.cargo.mass": (-5.0, "expected finite numbers of 0 or more, got -5"),
    "hardware.force_sensor.delay": (-1.0, "expected finite numbers of 0 or more, got -1"),
    "gravity": ([0.0, np.nan, -9.81], "expected numbers from -10000 to 10000, got nan"),
    "gait.heading": (7.0, "expected numbers from -6.28319 to 6.28319, got 7"),
    "hardware.seed": (1.5, "expected whole numbers, got 1.5"),
    "mass_scale": (0.0, "expected finite numbers above 0, got 0"),
    "gait.cycle": (np.inf, "expected finite numbers above 0, got inf"),
}


@pytest.mark.parametrize("path", WRONG)
def test_parameters_outside_of_the_ranges_of_a_scenario_are_refused(scenario, numbers, path):
    """In either precision: 1 and 0 are no less so in single precision."""
    value, said = WRONG[path]
    for of in (np.asarray, jnp.asarray, np.float32):
        with pytest.raises(ValueError, match=f"^parameters.{path}: ") as error:
            mc.rollout_metrics(scenario, None, numbers.replace({path: of(value)}))
        assert str(error.value) == f"parameters.{path}: {said}"


def test_an_unknown_path_is_refused_with_those_near_it(numbers):
    for ask in (numbers.at, lambda path: numbers.replace({path: 1.0})):
        with pytest.raises(
            ValueError, match=r"^contact\.stifness: expected a path of the parameters, as contact\.stiff"
        ):
            ask("contact.stifness")


SHAPES = {  # of one robot of four limbs, by path: another one, and what is said
    "ground.foothold_height": ((3, 2), "shape (..., 4, N), got (3, 2)"),
    "gait.swing_path": ((4, 3, 7), "shape (..., 4, 3, K), K 0 to 6, got (4, 3, 7)"),
    "hardware.force_sensor.dead": ((3,), "shape (..., 4), got (3,)"),
    "disturbance.pushes.0.force": ((3, 2), "a scalar or a last axis of three, got shape (3, 2)"),
    "disturbance.pushes.0.moment": ((3, 2), "a scalar or a last axis of three, got shape (3, 2)"),
}


def test_each_parameter_of_another_shape_is_named(scenario, numbers):
    """By every method, before JAX sees it."""
    methods = (mc.rollout, mc.rollout_metrics, lambda s, *of: mc.simulator(s)(*of), mc.Simulation(scenario).reset)
    for path, (shape, said) in SHAPES.items():
        bad = numbers.replace({path: np.zeros(shape)})
        for method in methods:
            with pytest.raises(ValueError) as error:
                method(None, bad) if method is methods[-1] else method(scenario, None, bad)
            assert str(error.value) == f"parameters.{path}: expected {said}"


ACTIONS = [  # to robots (2,), or to one alone
    (mc.JointTargets(np.zeros((4, 2))), "JointTargets.angles: expected shape (4, 3){}, got (4, 2)"),
    (mc.JointTargets(np.zeros((3, 4, 3))), "JointTargets.angles: expected shape (4, 3){}, got (3, 4, 3)"),
    (mc.BaseShift(np.zeros(3)), "BaseShift.displacement: expected shape (6,){}, got (3,)"),
    (np.zeros(6), "action: expected JointTargets, BaseShift or None, got ndarray"),
]


@pytest.mark.parametrize("number", range(len(ACTIONS)))
def test_an_action_of_another_shape_is_named(scenario, number):
    action, said = ACTIONS[number]
    simulation = mc.Simulation(scenario)
    one, two = (jax.eval_shape(lambda batch=batch: simulation.reset(batch=batch)) for batch in ((), (2,)))
    for state, more in ((one, ""), (two, ", or with batch axes before it that broadcast to (2,)")):
        with pytest.raises(ValueError) as error:
            jax.eval_shape(lambda state: simulation.step(state, action), state)
        assert str(error.value) == said.format(more)


def test_what_the_scenario_allows_is_allowed(scenario, numbers):
    """The ends of ranges, batches, and what nobody knows yet."""
    ends = {"contact.holding_limit": np.array([0.0, np.inf]), "control.kd": 0.0, "gait.duty": np.nextafter(1, 0)}
    ends["hardware.seed"] = 2.0**24 - 1
    check_parameters(numbers.replace({path: np.asarray(value) for path, value in ends.items()}), 4)
    jax.eval_shape(lambda kp: check_parameters(numbers.replace({"control.kp": kp}), 4), -1.0)


def test_each_value_that_a_config_has_is_a_parameter_of_the_same_range(numbers):
    """By its path: what the scenario refuses the parameters refuse, one step beyond an end of the range."""
    scenario = mc.Scenario()
    for path, field in numbers.paths.items():
        if field.shape or "." not in path or path.startswith("disturbance.pushes"):
            continue
        for end, way in zip(field.bounds, (-1, 1), strict=True):
            beyond = end + way * max(1e-6 * abs(end), math.ulp(0.0)) if abs(end) < 1e300 else math.inf
            if not np.isfinite(beyond):
                continue
            with pytest.raises(ValueError, match=f"^parameters.{path}: "):
                check_parameters(numbers.replace({path: np.asarray(beyond)}), 4)
            with pytest.raises(mc.ConfigError, match=f"^scenario: {path}: "):
                scenario.with_overrides({path: beyond})


SIX = mc.Gains(*[np.ones((1, 6))] * 3)
ONE = mc.Gains(*[np.ones((1, 1, 6))] * 3)
TWO = [mc.METRICS["travel"], mc.METRICS["missed_grips"]]
NO_DTYPE, NO_BATCH = "dtype: expected float32 or float64, got ", "batch_size: expected 1 or more, got 0"
UNLIKE = "batch axes of gains and parameters: expected some that broadcast, got "
NOBODY = "gains and parameters: expected one robot or more, got batch axes (0,)"
LIMIT = "parameters.hardware.servo.torque_limit: expected finite numbers above 0, or infinite ones, got -1"
BAD = [  # a call of a scenario and of bad parameters, and what is said
    (lambda s, bad: mc.rollout(s, None, bad), LIMIT),
    (lambda s, bad: mc.rollout_histories(s, None, bad), LIMIT),
    (lambda s, bad: mc.rollout_jvp(s, {"damping": 1e2}, {"damping": 1.0}, bad), LIMIT),
    (lambda s, bad: mc.simulator(s)(None, bad), LIMIT),
    (lambda s, bad: mc.Simulation(s).reset(None, bad), LIMIT),
    (lambda s, _: mc.rollout_metrics(s, dtype=jnp.bfloat16), f"{NO_DTYPE}bfloat16"),
    (lambda s, _: mc.rollout_metrics(s, dtype=np.int32), f"{NO_DTYPE}int32"),
    (lambda s, _: mc.Simulation(s).reset(dtype=jnp.float16), f"{NO_DTYPE}float16"),
    (lambda s, _: mc.simulator(s)({"damping": jnp.full(6, 1e2, jnp.bfloat16)}), f"{NO_DTYPE}bfloat16"),
    (lambda s, _: resolve_in(s, law_of(s), None, None, np.int32), f"{NO_DTYPE}int32"),
    (lambda s, _: mc.rollout_metrics(s, batch_size=0), NO_BATCH),
    (lambda s, _: mc.rollout_jvp(s, SIX, ONE, batch_size=0), NO_BATCH),
    (lambda s, _: mc.rollout_histories(s, batch_size=0), NO_BATCH),
    (lambda s, _: mc.rollout_metrics(s, {"kp": np.ones(0)}), NOBODY),
    (lambda s, _: mc.Simulation(s).reset(batch=(0,)), NOBODY),
    (lambda s, _: mc.Simulation(s).reset(batch=(2.5,)), "batch: expected whole numbers of robots, got (2.5,)"),
    (lambda s, _: mc.Simulation(s).reset(batch="ab"), "batch: expected whole numbers of robots, got ('a', 'b')"),
    (
        lambda s, _: mc.Simulation(s).reset({"kp": np.full(2, 50.0)}, batch=(3,)),
        f"{UNLIKE}gains and parameters (2,), batch (3,)",
    ),
    (
        lambda s, _: mc.rollout_metrics(s, {"gait.sway": np.zeros(2), "gait.height": np.ones(3)}),
        f"{UNLIKE}gait.height (3,), gait.sway (2,)",
    ),
    (
        lambda s, _: mc.rollout_jvp(s, {"damping": 1e2}, {"damping": 1.0}),
        "directions.damping: expected shape (1, 6), or axes of 1 behind the first, got ()",
    ),
    (
        lambda s, _: mc.rollout_jvp(s, {"kp": np.full(2, 50.0)}, {"kp": np.ones((1, 3))}),
        "directions.kp: expected shape (1, 2), or axes of 1 behind the first, got (1, 3)",
    ),
    (
        lambda s, _: mc.rollout_jvp(s, {"damping": np.full((256, 1), 1e2)}, {"damping": np.ones((256, 1))}),
        "directions.damping: expected shape (256, 256, 6), or axes of 1 behind the first, got (256, 1)",
    ),
    (
        lambda s, _: mc.rollout_jvp(s, {"damping": np.full((8, 6), 1e2)}, {"stiffness": np.ones((8, 6))}),
        "directions.stiffness: expected shape (8, 8, 6), or axes of 1 behind the first, got (8, 6)",
    ),
    (lambda s, _: mc.rollout_metrics(s, {"damping": 1e2 + 1j}), "gains.damping: expected real numbers, got (100+1j)"),
    (lambda s, _: mc.rollout_metrics(s, {"kp": 1j}), "gains.kp: expected real numbers, got 1j"),
    (lambda s, _: mc.rollout_metrics(s, {"damping": "1e3"}), "gains.damping: expected real numbers, got '1e3'"),
    (lambda s, _: mc.rollout_metrics(s, {"damping": b"1e3"}), "gains.damping: expected real numbers, got b'1e3'"),
    (lambda s, _: mc.rollout_metrics(s, {"kp": True}), "gains.kp: expected real numbers, got True"),
    (lambda s, _: mc.rollout_metrics(s, {"kp": np.array([True])}), "gains.kp: expected real numbers, got bool"),
    (
        lambda s, _: mc.rollout_metrics(s, {"damping": np.full(6, "2024-01-01", "M8[D]")}),
        "gains.damping: expected real numbers, got datetime64[D]",
    ),
    (
        lambda s, _: mc.rollout_metrics(s, {"damping": np.ma.masked_less(np.arange(6.0), 2)}),
        "gains.damping: expected real numbers, got a masked array",
    ),
    (
        lambda s, n: mc.rollout_metrics(
            s, None, n.replace({"hardware.servo.torque_limit": np.asarray(1.0), "control.kp": np.ma.ones(2)})
        ),
        "parameters.control.kp: expected real numbers, got a masked array",
    ),
    (
        lambda s, _: mc.rollout_jvp(s, {"kp": 50.0}, {"kp": np.array(["1"])}),
        "directions.kp: expected real numbers, got <U1",
    ),
    (
        lambda s, _: mc.rollout_vjp(s, {"kp": 50.0}, {"speed": np.ones(1)}, metrics=TWO),
        "weights.speed: expected one of travel, the metrics that are real numbers",
    ),
    (
        lambda s, _: mc.rollout_vjp(s, {"kp": 50.0}, {"missed_grips": np.ones(1)}, metrics=TWO),
        "weights.missed_grips: expected one of travel, the metrics that are real numbers",
    ),
    (
        lambda s, _: mc.rollout_vjp(s, {"kp": 50.0}, {"travel": ["1"]}, metrics=TWO),
        "weights.travel: expected real numbers, got <U1",
    ),
    (
        lambda s, _: mc.rollout_metrics(s, {"damping": 1e39}),
        "gains.damping: expected numbers that float32 holds, got 1e+39",
    ),
    (lambda s, _: mc.rollout_metrics(s, {"ki": 1e39}), "gains.ki: expected numbers that float32 holds, got 1e+39"),
    (
        lambda s, n: mc.rollout_metrics(s, None, n.replace({"hardware.servo.torque_limit": np.asarray(1e39)})),
        "parameters.hardware.servo.torque_limit: expected numbers that float32 holds, got 1e+39",
    ),
]


@pytest.mark.parametrize("number", range(len(BAD)))
def test_bad_arguments_have_one_line_each(scenario, numbers, number):
    call, said = BAD[number]
    with pytest.raises(ValueError) as error:
        call(scenario, numbers.replace({"hardware.servo.torque_limit": np.asarray(-1.0)}))
    assert str(error.value) == said


@pytest.mark.parametrize("hardware", [(), ["hardware.force_sensor.delay=0.002"]])
def test_parameters_in_numpy_are_those_of_jax(hardware):
    """To the last bit, where no array of JAX is made: a GPU would have to start for it."""
    scenario = mc.load_scenario("case_1_2", hardware)
    with jax.transfer_guard("disallow"):
        mine = own_parameters(scenario)
    for name, value in mc.parameters(scenario).values.items():
        own = mine.at(name)
        assert isinstance(own, np.ndarray) and own.dtype == value.dtype == np.float64
        np.testing.assert_array_equal(own, value, err_msg=name)
