"""Short walks with all hardware at once: batches, derivatives, engines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import PD, JointGains
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.scenario.load import load_hardware, with_hardware
from tests import derivatives

PUSH = {"start": 0.01, "stop": 0.1, "force": [3.0, 1.0, 1.0], "moment": [0.0, 0.5, 0.0]}
EVERYTHING = {
    # a swing of 0.1 s: it lifts, lands and grips
    "duration": 0.15, "gait.cycle": 0.4, "gait.stride": 0.005, "gait.step_height": 0.002,
    "contact.capture_distance": 0.01, "disturbance.pushes": [PUSH],
    "control": {
        "damping": 150.0, "stiffness": 3000.0, "deadband": 0.05, "max_offset": 0.05, "integration": "semi_implicit",
    },
    "hardware": {
        "control_period": 0.005, "command_delay": 0.0024, "interpolation": "linear",
        "force_sensor": {"delay": 0.0034, "noise": 0.1, "bias": 0.05, "resolution": 0.01, "filter": 60.0},
        "base_estimate": {"delay": 0.0013, "position_noise": 1e-4, "velocity_noise": 1e-3},
        "servo": {
            "torque_limit": 1.0, "no_load_speed": 4.8, "armature": 0.002, "coulomb_friction": 0.02,
            "viscous_friction": 0.01, "load_friction": 0.05, "backlash": 0.001, "delay": 0.0007,
        },
    },
}  # fmt: skip
VARIED = (
    "hardware.command_delay", "hardware.force_sensor.delay", "hardware.force_sensor.noise",
    "hardware.force_sensor.bias", "hardware.force_sensor.filter", "hardware.servo.torque_limit",
    "hardware.servo.no_load_speed", "hardware.servo.armature", "hardware.servo.coulomb_friction",
    "hardware.servo.viscous_friction", "hardware.servo.load_friction", "hardware.servo.backlash",
    "hardware.servo.delay", "contact.capture_distance",
)  # fmt: skip


@pytest.fixture(scope="module")
def scenario():
    return mc.load_scenario("case_1_2", EVERYTHING)


def parameters_of(scenario, robots, seed=3):
    """Parameters of robots whose hardware differs in everything."""
    own = own_parameters(scenario)
    rng = np.random.default_rng(seed)
    changes = {path: own.at(path) * rng.uniform(0.5, 1.0, robots) for path in VARIED}
    changes["hardware.control_period"] = rng.choice([0.002, 0.005, 0.007], robots)
    return own.replace({**changes, "hardware.seed": np.arange(robots) * 1.0})


class Showing(PD):
    """The baseline, which says it shifts the base by what it is told of two joints: a walk keeps that."""

    def step(self, state, measured, reference):
        seen = jnp.stack([measured.joint_angles, measured.joint_rates, measured.joint_torque])
        return state, super().step(state, measured, reference)[1]._replace(base_displacement=seen[:, 1, :2].ravel())


@pytest.mark.nightly
@pytest.mark.parametrize("delay", [pytest.param(0.0, marks=pytest.mark.nightly), 0.0024])
def test_a_law_is_told_of_the_joints_by_the_bus(delay):
    """Angles and rates of this step and the motors' torque of the one before, late as the targets, once a period."""
    scenario = mc.load_scenario("case_1_2", EVERYTHING | {"duration": 0.05})
    scenario = scenario.with_overrides({"hardware.command_delay": delay, "control.controller": "pd"})
    walk = mc.rollout(scenario, law=Showing(), dtype=np.float64)
    own = np.stack([walk.joint_angles, walk.joint_rates, walk.joint_torque], axis=1)[:, :, 1, :2].reshape(-1, 6)
    own[:, 4:] = np.vstack([np.zeros((1, 2)), own[:-1, 4:]])
    rest = np.array([*own[0, :2], 0, 0, 0, 0])  # it has always rested
    before, share = int(delay * 1000), delay * 1000 % 1
    padded = np.vstack([rest] * (before + 1) + [own])
    told = [(1 - share) * padded[n + 1] + share * padded[n] for n in range(len(own))]
    told = np.array(told)[np.arange(len(own)) // 5 * 5]
    np.testing.assert_allclose(walk.base_displacement, told, rtol=1e-9, atol=1e-12)
    assert np.ptp(told, axis=0).min() > 1e-5
    reports = [mc.Simulation(scenario, law).reset().carry.memory.reports for law in (Showing(), PD())]
    assert len(jax.tree.leaves(reports[0])) == 1 + 4 * (4 if delay else 0) and reports[1] is None


class Softening(PD):
    """The baseline with joint gains that fall, each limb's otherwise."""

    def init(self, start):
        return jnp.ones(len(start.reference.foot_position))

    def step(self, share, measured, reference):
        factors = JointGains(share, share * share, share)
        less = jnp.linspace(0.9, 0.99, len(share), dtype=share.dtype)
        return share * less, super().step((), measured, reference)[1]._replace(joint_gains=factors)


@pytest.mark.slow
@pytest.mark.parametrize(
    "hardware",
    [
        pytest.param({"control.ki": 30.0}, marks=pytest.mark.nightly, id="ideal"),
        pytest.param(
            {"hardware.control_period": 0.005, "hardware.command_delay": 0.0024, "control.ki": 30.0}, id="bus"
        ),
    ],
)
def test_joint_gains_that_a_law_commands_come_by_the_bus(hardware):
    scenario = mc.load_scenario("case_1_2", {"duration": 0.05, "gait.cycle": 0.4} | hardware)
    walk = mc.rollout(scenario, law=Softening(), dtype=np.float64)
    share = np.linspace(0.9, 0.99, 4) ** np.arange(50)[:, None]
    if len(hardware) > 1:
        held = np.vstack([np.ones((3, 4)), (np.linspace(0.9, 0.99, 4) ** np.arange(10)[:, None]).repeat(5, axis=0)])
        share, square = (0.6 * late[1:-2] + 0.4 * late[:-3] for late in (held, held**2))
    else:
        square = share**2
    kp, kd = scenario.control.kp * share[:, :, None], scenario.control.kd * square[:, :, None]
    error = walk.joint_targets - walk.joint_angles
    torque = kp * error - kd * walk.joint_rates + 30.0 * share[:, :, None] * 0.001 * error.cumsum(0)
    np.testing.assert_allclose(walk.joint_torque, torque, rtol=1e-9, atol=1e-12)
    assert np.abs(torque).max() > 1e-3


@pytest.mark.nightly
def test_each_robot_of_a_batch_walks_as_it_does_alone(scenario):
    """To rounding: its noise is the same, whatever its neighbours."""
    parameters = parameters_of(scenario, 8)
    together = mc.rollout_metrics(scenario, parameters=parameters, dtype=np.float64)
    alone = mc.rollout_metrics(scenario, parameters=parameters, dtype=np.float64, batch_size=1)
    for name, values in together.items():
        np.testing.assert_allclose(alone[name], values, rtol=1e-9, atol=1e-12, err_msg=name)
    assert len(np.unique(together["peak_foot_force"])) == 8


@pytest.mark.nightly
def test_a_walk_does_not_depend_on_the_longest_delay_of_its_batch():
    short = mc.load_scenario("case_1_2", {"duration": 0.05, "control.damping": 150.0, "control.stiffness": 3e3})

    def varied(force, command):
        changed = mc.parameters(short).replace(
            {"hardware.force_sensor.delay": force * 1e-3, "hardware.command_delay": command * 1e-3}
        )
        return mc.rollout_metrics(short, parameters=changed, dtype=np.float64)["force_variation"]

    force, command = np.array([6.5, 6.9, 0.0, 0.0, 9.0]), np.array([0.0, 0.0, 6.5, 6.9, 9.0])
    together = varied(force, command)
    np.testing.assert_allclose(varied(force[:4], command[:4]), together[:4], rtol=1e-9)
    assert len(np.unique(together.round(6))) == 5


def test_an_ideal_profile_is_no_hardware():
    plain = mc.load_scenario("case_1_2", {"duration": 0.1})
    assert with_hardware(plain, load_hardware("ideal")) == plain


@pytest.mark.nightly
def test_neutral_parameters_change_nothing(scenario):
    """A stage that is there for a neighbour leaves a robot with neutral parameters as it is, to rounding."""
    plain = mc.load_scenario("case_1_2", {"duration": 0.15, "disturbance.pushes": [PUSH]})
    own = own_parameters(plain)
    there = parameters_of(scenario, 2)
    names = [path for path, value in own.values.items() if np.ndim(value) == 0 and np.ndim(there.at(path)) == 1]
    mixed = own.replace({path: np.stack([own.at(path), there.at(path)[1]]) for path in names})
    ideal, found = (mc.rollout_metrics(plain, parameters=of, dtype=np.float64) for of in (own, mixed))
    for name in ("force_variation", "peak_foot_force", "travel", "base_deviation", "peak_joint_torque"):
        np.testing.assert_allclose(found[name][0], ideal[name], rtol=1e-9, err_msg=name)
        assert found[name][1] != ideal[name]


@pytest.mark.nightly
@pytest.mark.slow
def test_engines_agree_on_hardware(scenario):
    parameters = parameters_of(scenario, 2)
    how = {"parameters": parameters, "dtype": np.float64}
    limb, mjx = (mc.rollout_metrics(scenario, engine=engine, **how) for engine in ("limb", "mjx"))
    for name, values in limb.items():
        np.testing.assert_allclose(mjx[name], values, rtol=1e-8, atol=1e-12, err_msg=name)


DIFFERENTIATED = (
    "hardware.force_sensor.delay", "hardware.servo.delay", "hardware.force_sensor.filter",
    "hardware.force_sensor.noise", "hardware.force_sensor.bias", "hardware.servo.armature",
    "hardware.servo.coulomb_friction", "hardware.servo.viscous_friction", "hardware.servo.load_friction",
    "hardware.servo.backlash",
)  # fmt: skip


@pytest.fixture(scope="module")
def tangents(scenario):
    gentle = scenario.with_overrides({"contact.capture_distance": None, "hardware.force_sensor.resolution": 0.0})
    return derivatives.by_each(gentle, DIFFERENTIATED, "peak_joint_torque")


@pytest.mark.nightly
@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_derivative_of_a_walk_by_its_hardware(tangents, name):
    exact, differences = tangents[name]
    assert abs(exact) > 0
    np.testing.assert_allclose(exact, differences, rtol=1e-4)
