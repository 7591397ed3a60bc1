"""Short walks with all hardware at once: batches, derivatives, engines, the GPU kernel."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.compilation.gpu_kernel import over_robots
from mjx_climb.quantities.batches import varying
from mjx_climb.rollouts.rollout import given_in, metrics_of
from mjx_climb.scenario.profiles import load_hardware, with_hardware
from mjx_climb.walk.step import structure

PUSH = {"start": 0.01, "stop": 0.1, "force": [3.0, 1.0, 1.0], "moment": [0.0, 0.5, 0.0]}
EVERYTHING = {
    "duration": 0.15,
    "gait.cycle": 0.4,  # a swing of 0.1 s: it lifts, lands and grips
    "gait.stride": 0.005,
    "gait.step_height": 0.002,
    "contact.capture_distance": 0.01,
    "disturbance.pushes": [PUSH],
    "control": {
        "damping": 150.0,
        "stiffness": 3000.0,
        "deadband": 0.05,
        "max_offset": 0.05,
        "integration": "semi_implicit",
    },
    "hardware": {
        "control_period": 0.005,
        "command_delay": 0.0024,
        "interpolation": "linear",
        "force_sensor": {"delay": 0.0034, "noise": 0.1, "bias": 0.05, "resolution": 0.01, "filter": 60.0},
        "base_estimate": {"delay": 0.0013, "position_noise": 1e-4, "velocity_noise": 1e-3},
        "servo": {
            "torque_limit": 1.0,
            "no_load_speed": 4.8,
            "armature": 0.002,
            "coulomb_friction": 0.02,
            "viscous_friction": 0.01,
            "load_friction": 0.05,
            "backlash": 0.001,
            "delay": 0.0007,
        },
    },
}
VARIED = (
    "command_delay", "force_delay", "force_noise", "force_bias", "force_filter", "torque_limit", "no_load_speed",
    "armature", "coulomb_friction", "viscous_friction", "load_friction", "backlash", "servo_delay", "capture_distance",
)  # fmt: skip
WHOLE = {"xla_disable_hlo_passes": "fusion"}  # compiles sooner


@pytest.fixture(scope="module")
def scenario():
    return mc.load_scenario("case_1_2", EVERYTHING)


def numbers_of(scenario, robots, seed=3):
    """Parameters of robots whose hardware differs in everything."""
    with jax.enable_x64(True):
        own = jax.tree.map(np.asarray, mc.parameters(scenario))
    rng = np.random.default_rng(seed)
    changes = {name: getattr(own, name) * rng.uniform(0.5, 1.0, robots) for name in VARIED}
    changes["control_period"] = rng.choice([0.002, 0.005, 0.007], robots)
    changes["seed"] = np.arange(robots) * 1.0
    return dataclasses.replace(own, **changes)


@pytest.mark.slow
def test_each_robot_of_a_batch_walks_as_it_does_alone(scenario):
    """To rounding: its noise is the same, whatever its neighbours."""
    numbers = numbers_of(scenario, 8)
    together = mc.rollout_metrics(scenario, numbers=numbers, dtype=np.float64)
    alone = mc.rollout_metrics(scenario, numbers=numbers, dtype=np.float64, batch_size=1)
    for name, values in together.items():
        np.testing.assert_allclose(alone[name], values, rtol=1e-9, atol=1e-12, err_msg=name)
    assert len(np.unique(together["peak_foot_force"])) == 8


@pytest.mark.slow
def test_a_walk_does_not_depend_on_the_longest_delay_of_its_batch():
    short = mc.load_scenario("case_1_2", {"duration": 0.05, "control.damping": 150.0, "control.stiffness": 3e3})

    def varied(force, command):
        numbers = dataclasses.replace(mc.parameters(short), force_delay=force * 1e-3, command_delay=command * 1e-3)
        return mc.rollout_metrics(short, numbers=numbers, dtype=np.float64)["force_variation"]

    force, command = np.array([6.5, 6.9, 0.0, 0.0, 9.0]), np.array([0.0, 0.0, 6.5, 6.9, 9.0])
    together = varied(force, command)
    np.testing.assert_allclose(varied(force[:4], command[:4]), together[:4], rtol=1e-9)
    assert len(np.unique(together.round(6))) == 5


def test_an_ideal_profile_is_no_hardware():
    plain = mc.load_scenario("case_1_2", {"duration": 0.1})
    assert with_hardware(plain, load_hardware("ideal")) == plain


@pytest.mark.slow
def test_neutral_numbers_change_nothing(scenario):
    """A stage that is there for a neighbour leaves a robot with neutral numbers as it is, to rounding."""
    plain = mc.load_scenario("case_1_2", {"duration": 0.15, "disturbance.pushes": [PUSH]})
    with jax.enable_x64(True):
        own = jax.tree.map(np.asarray, mc.parameters(plain))
    there = numbers_of(scenario, 2)
    names = [
        f.name
        for f in dataclasses.fields(own)
        if np.ndim(getattr(there, f.name)) == 1 and np.ndim(getattr(own, f.name)) == 0
    ]
    mixed = {name: np.stack([getattr(own, name), getattr(there, name)[1]]) for name in names}
    mixed = dataclasses.replace(own, **mixed)
    ideal, found = (
        mc.rollout_metrics(plain, dtype=np.float64),
        mc.rollout_metrics(plain, numbers=mixed, dtype=np.float64),
    )
    for name in ("force_variation", "peak_foot_force", "travel", "base_deviation", "peak_joint_torque"):
        np.testing.assert_allclose(found[name][0], ideal[name], rtol=1e-9, err_msg=name)
        assert found[name][1] != ideal[name]


@pytest.mark.slow
def test_engines_agree_on_hardware(scenario):
    numbers = numbers_of(scenario, 2)
    limb, mjx = (mc.rollout_metrics(scenario, numbers=numbers, dtype=np.float64, engine=e) for e in ("limb", "mjx"))
    for name, values in limb.items():
        np.testing.assert_allclose(mjx[name], values, rtol=1e-8, atol=1e-12, err_msg=name)


SLOPES = (
    "force_delay", "servo_delay", "force_filter", "force_noise", "force_bias", "armature",
    "coulomb_friction", "viscous_friction", "load_friction", "backlash",
)  # fmt: skip


@pytest.fixture(scope="module")
def slopes(scenario):
    """Slopes of the peak joint torque by each number: forward, and by central differences; a robot for each."""
    gentle = scenario.with_overrides({"contact.capture_distance": None, "hardware.force_sensor.resolution": 0.0})
    simulate = mc.simulator(gentle, in_pieces=True)
    own, count = mc.parameters(gentle), len(SLOPES)
    gains = mc.Gains(jnp.ones((count, 6)), jnp.full((count, 6), 150.0), jnp.full((count, 6), 3000.0))

    def torque(varied):
        return simulate(gains, dataclasses.replace(own, **varied))["peak_joint_torque"]

    at = {name: jnp.full(count, float(getattr(own, name))) for name in SLOPES}
    along = {name: jnp.asarray(np.arange(count) == place, float) for place, name in enumerate(SLOPES)}
    _, forward = jax.jit(lambda: jax.jvp(torque, (at,), (along,)))()
    sides = []
    for sign in (1, -1):
        moved = {name: at[name] * (1 + sign * 1e-6 * along[name]) for name in SLOPES}
        numbers = jax.tree.map(np.asarray, dataclasses.replace(own, **moved))
        sides.append(mc.rollout_metrics(gentle, gains, numbers, dtype=np.float64)["peak_joint_torque"])
    widths = np.array([2e-6 * float(getattr(own, name)) for name in SLOPES])
    return dict(zip(SLOPES, zip(np.asarray(forward), (sides[0] - sides[1]) / widths, strict=True), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOPES)
def test_derivative_of_a_walk_by_its_hardware(slopes, name):
    exact, differences = slopes[name]
    assert abs(exact) > 0
    np.testing.assert_allclose(exact, differences, rtol=1e-4)


def kernel_walk(scenario, robots, dtype, steps):
    arguments = given_in(scenario, None, None, numbers_of(scenario, robots), dtype)[:2]
    arguments = (arguments[0], dataclasses.replace(arguments[1], kp=np.full(robots, 50.0, dtype)))
    shape = structure(scenario, "limb", arguments[1])._replace(steps=steps)
    return functools.partial(metrics_of, shape), arguments, [varying(tree) for tree in arguments]


@pytest.mark.slow
def test_the_gpu_kernel_walks_with_hardware_as_xla_does(scenario):
    walk, arguments, axes = kernel_walk(scenario, 3, np.float64, 40)
    found = jax.jit(over_robots(walk, axes, limbs=4, interpret=True), compiler_options=WHOLE)(*arguments)
    expected = jax.jit(walk, compiler_options=WHOLE)(*arguments)
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.slow
def test_the_gpu_kernel_is_written_with_hardware(scenario, without_nvrtc):
    with jax.enable_x64(False):
        walk, arguments, axes = kernel_walk(scenario, 3, np.float32, 8000)
        mapped = over_robots(walk, axes, limbs=4)
        lowered = jax.jit(mapped).trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()
    assert lowered.count("__gpu$xla.gpu.ptx") == 1
    assert "stablehlo.while" not in lowered
