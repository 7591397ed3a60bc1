"""Whole walks against the oracle: every history, the next state and every metric, in float64."""

import dataclasses

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.disturbances.link_wrench import LinkWrench
from mjx_climb.hardware.velocity_commanded import VelocityCommanded
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.walks import histories
from tests import oracle
from tests.conftest import six_gains
from tests.robot import climbers
from tests.walk import reference_walks

SHORT = {
    "duration": 0.3, "gravity": [0.5, -0.3, -1.5], "contact.stiffness": 6e3,
    "gait": {
        "cycle": 0.2, "stride": 0.012, "step_height": 0.006, "heading": 0.6,
        "phases": {"LH": 0.05, "LF": 0.05 + 1 / 3, "RH": 0.05 + 1 / 3, "RF": 0.05 + 2 / 3},
    },
    "control": {"kp": 40.0, "kd": 0.25, "damping": [90, 150, 200, 4, 3, 5], "stiffness": [2e3, 3e3, 4e3, 40, 60, 50]},
    "disturbance": {
        "cargo": {"mass": 0.8, "start": 0.05, "stop": 0.22},
        "pushes": [
            {"force": [2.0, -1.0, 1.5], "moment": [0.1, -0.2, 0.15], "start": 0.1, "stop": 0.2},
            {"force": [-1.0, 0.5, 0.5], "start": 0.15, "stop": 0.25},
        ],
    },
}  # fmt: skip
PD = {"control.controller": "pd"}
WALKS = {  # changes, and what is to happen
    "pd": (PD, lambda walk: np.ptp(walk.cargo_mass) and np.ptp(walk.push) and 2 in walk.support.sum(1)),
    "torn off along the ground": (
        PD | {"contact.holding_limit": 2.5}, lambda walk: (walk.foot_force[walk.torn_off][:, 2] > -2.5).any()
    ),
    "torn off at once": (
        PD | {"contact.holding_limit": 1e-3, "gravity": [0.1, 0.0, 2.0]}, lambda walk: walk.torn_off.sum(1).max() > 1
    ),
    "grips that close": (
        PD | {"contact.closing_time": 0.01, "contact.closing_force": 0.5, "contact.capture_distance": 2e-3,
              "ground.footholds": {"LF": [0.0, 0.001], "LH": [0.0, -0.001]}},
        lambda walk: np.ptp(walk.grip_point[walk.support][:, 2]) > 1e-4,
    ),
    "hardware on uneven ground": (
        {
            "contact.capture_distance": 1e-3,
            "ground.footholds": {"LF": [0.004, 0.0, 0.002], "LH": [0.0, 0.003], "RH": [-0.002], "RF": [0.001, -0.002]},
            "hardware": {
                "control_period": 0.005, "command_delay": 0.0017, "interpolation": "linear", "seed": 7,
                "force_sensor": {"delay": 0.0034, "noise": 0.05, "bias": 0.3, "resolution": 0.01, "filter": 60.0},
                "servo": {
                    "torque_limit": 0.3, "no_load_speed": 4.0, "armature": 0.002, "coulomb_friction": 0.02,
                    "viscous_friction": 0.01, "load_friction": 0.1, "backlash": 0.001, "delay": 0.0007,
                },
            },
        },
        lambda walk: walk.missed.any() and (np.abs(walk.joint_torque) == 0.3).any(),
    ),
    "servos on a voltage": (
        PD | {
            "control.ki": 60.0, "control.kp": 60.0,
            "hardware.servo": {
                "drive": "voltage", "torque_limit": 0.5, "no_load_speed": 6.0, "pwm_limit": 0.8, "rate": 500.0,
                "rated_voltage": 12.0, "supply_voltage": 10.5, "profile_velocity": 1.5, "profile_acceleration": 60.0,
                "supply_resistance": 9.0,
                "current_limit": 0.45, "armature": 0.002, "coulomb_friction": 0.005, "viscous_friction": 0.01,
                "presliding": 8e-4,
                "load_friction": 0.1, "external_load_friction": 0.05, "stribeck_friction": 0.01,
                "stribeck_load_friction": 0.07, "stribeck_external_load_friction": 0.03, "stribeck_velocity": 0.5,
                "stribeck_exponent": 0.8, "quadratic_load_friction": 0.3, "quadratic_external_load_friction": 0.2,
                "delay": 0.0013, "backlash": 0.001,
            },
        },
        lambda walk: (np.abs(walk.joint_torque) > 0.3).any(),
    ),
    "servos of limited current": (
        PD | {
            "control.ki": 400.0, "hardware.servo": {
                "current_limit": 0.25, "torque_limit": 0.6, "no_load_speed": 5.0, "rated_voltage": 12.0,
                "supply_voltage": 13.0, "profile_velocity": 0.8, "stribeck_friction": 0.02,
                "stribeck_load_friction": 0.1,
            },
        },
        lambda walk: (np.abs(walk.joint_torque) == 0.25).any(),
    ),
    "measured pose": (
        {
            # h D / M is not 1: the measured rate counts
            "control.reading": "measured_pose", "control.damping": 300.0, "control.stiffness": 2e4,
            "gait.base_reference": "actual", "gait.settling": 0.3,
            "hardware.base_estimate": {"delay": 0.0025, "position_noise": 1e-4, "velocity_noise": 1e-3},
            "hardware.force_sensor": {"filter": 60.0, "filtered_by": "law", "dead": {"LF": 0.02}},
            "hardware.control_period": 0.002, "hardware.command_delay": 0.0017, "control.safe_kp": 60.0,
        },
        lambda walk: np.ptp(walk.base_displacement) and list(walk.lost_sensors) == ["LF"],
    ),
    "a base that sways, low over feet that land fast": (
        {
            "gait.sway": 0.4, "gait.height": 0.92, "gait.landing_speed": 0.05, "gait.heading": 0.7,
            "gait.settling": 0.1, "gait.phases": {"LF": 0.03, "LH": 0.2, "RH": 0.52, "RF": 0.75},
            "gait.base_reference": "actual", "gait.duty": 0.77,
        },
        lambda walk: np.ptp(walk.base_reference[:, 1]) > 1e-3,
    ),
    "end effector": (
        {
            "control.controller": "end_effector_admittance", "gravity": [0.0, 0.0, 0.0],
            "hardware.force_sensor.dead": {"LH": 0.0, "RF": 0.05},
        },
        lambda walk: np.isinf(walk.tsm).any(),
    ),
    "forces by joints' efforts": (
        {
            "hardware.force_sensor": {"source": "joint_effort", "axes": "z", "drift": 2.0, "delay": 0.0015},
            "hardware.servo.coulomb_friction": 0.01, "hardware.servo.armature": 0.001,
        },
        lambda walk: np.ptp(walk.base_displacement),
    ),
    "motors that follow rates, limbs that are touched": (
        {},
        lambda walk: np.ptp(walk.push[:, :3]) > 4.0 and (np.abs(walk.joint_torque) == 1.2).any(),
    ),
    "a robot of its own": (
        {
            "time_step": 0.0005, "duration": 0.15, "contact.stiffness": 2e3, "contact.rotational_stiffness": 5.0,
            "contact.rotational_damping": 0.01, "gait.cycle": 0.1, "gait.duty": 0.8,
            "gait.phases": {f"limb{n}": 0.02 + n / 4 for n in range(4)},
            "hardware.servo": {"coulomb_friction": 0.01, "viscous_friction": 0.02, "armature": 0.001},
        },
        lambda walk: np.ptp(walk.foot_moment) and (np.abs(walk.joint_torque) == 0.7).any(),
    ),
}  # fmt: skip
FORCE, MOMENT, AT = np.array([3.0, -2.0, 1.0]), np.array([0.2, 0.1, -0.3]), np.array([0.03, -0.01, 0.02])
OF_THE_JOINTS = 'damping="0.03" armature="0.002" frictionloss="0.015" actuatorfrcrange="-0.7 0.7"'


LONG = (
    "measured pose", "forces by joints' efforts",
    "hardware on uneven ground", "servos on a voltage", "servos of limited current", "end effector",
    "a base that sways, low over feet that land fast", "a robot of its own",
    "motors that follow rates, limbs that are touched",
)  # fmt: skip


@pytest.fixture(
    scope="module", params=[pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in WALKS]
)
def walk(request, tmp_path_factory):
    own, happens = WALKS[request.param]
    changes, added = SHORT | own, {"mass_scale": np.asarray(1.1)}
    scenario = mc.Scenario()
    if "robot" in request.param:
        path = tmp_path_factory.mktemp("robot") / "climber.xml"
        path.write_text(climbers.mjcf(4, 3, attributes=OF_THE_JOINTS))
        scenario = mc.Scenario.model_validate(climbers.config(path, 4, 3))
        changes |= {f"gait.{name}": value for name, value in changes.pop("gait").items() if name != "phases"} | own
    if request.param == "measured pose":
        swing = np.random.default_rng(0).uniform(-0.3, 0.3, (4, 3, 6))
        added["gait"] = dataclasses.replace(own_parameters(scenario.with_overrides(changes)).gait, swing_path=swing)
    if "motors" in request.param:
        added |= {
            "drive": VelocityCommanded(p=12.0, d=0.15, manager_period=0.003, largest_rate=1.5, torque_limit=1.2),
            "disturbances": (
                *own_parameters(scenario.with_overrides(changes)).disturbances,
                LinkWrench(limb=1.0, link=2.0, force=FORCE, moment=MOMENT, at=AT, start=0.05, stop=0.15),
                LinkWrench(limb=3.0, link=1.0, force=-FORCE, moment=MOMENT, at=AT, start=0.1, frame="link"),
            ),
        }
    scenario = scenario.with_overrides(changes)
    made = mc.rollout(scenario, six_gains(scenario), dataclasses.replace(own_parameters(scenario), **added))
    assert happens(made)
    return made


def test_a_walk_worked_out_again(walk):
    oracle.assert_is(walk)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in reference_walks.WALKS if name.startswith(("gripper", "measured"))])
def test_a_reference_walk_worked_out_again(name, tmp_path):
    """A deadband and bounds of the virtual mass, and a height map, which no walk above has."""
    made = reference_walks.walked(name, tmp_path)
    oracle.assert_is(made)
    assert_metrics(made)


def test_lines_over_time(walk):
    """The least and the largest value of each pair of the 300 steps."""
    expected = {
        "foot_force_history": np.linalg.norm(walk.foot_force, axis=2).max(1),
        "base_deviation_history": np.linalg.norm(walk.base_position - walk.base_reference, axis=1),
        "joint_torque_history": np.abs(walk.joint_torque).max((1, 2)),
    }
    found = histories(walk)
    assert list(found) == list(expected)
    for name, line in expected.items():
        pairs = line.reshape(-1, 2)
        np.testing.assert_allclose(found[name], [pairs.min(1), pairs.max(1)], rtol=1e-12, err_msg=name)


def test_metrics_of_the_histories(walk):
    assert_metrics(walk)


def assert_metrics(walk):
    found, expected = mc.metrics(walk), oracle.judged(walk)
    assert list(found) == list(expected)
    for name, value in expected.items():
        assert found[name] == (pytest.approx(value, rel=1e-12) if isinstance(value, float) else value), name
