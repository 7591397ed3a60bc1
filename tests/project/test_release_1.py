"""Files of release 1: they open and mean the same, or one line says what to change."""

import json

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.files import dataset as ds
from tuning.gains import gains_file

# as release 1.0 wrote them; shortened
CONFIG = """
robot: hubrobo_v3_2
gravity: [0.0, 0.0, -1.635]
duration: 4.0
gait: {sequence: [LH, LF, RH, RF], stride: 0.04, cycle: 2.0, footholds: planned, swing: cubic}
contact: {stiffness: 8000.0, damping: 10.0, holding_limit: 9.0, capture_distance: null}
control: {controller: base_admittance, kp: 40.0, damping: [5.0, 5.0, 5.0, 1.0, 1.0, 1.0]}
disturbance:
  cargo: {mass: 0.5, start: 2.0, stop: null}
  pushes:
  - {force: [1.0, 0.0, 0.0], moment: [0.0, 0.0, 0.0], start: 1.0, stop: 1.5}
hardware: {force_sensor: {delay: 0.004, noise: 0.1}, servo: {armature: 0.01, drive: torque}, seed: 3}
"""
OWN = """
own:
  law: null
  metrics: []
  objective: null
  method: null
  contact: null
  drive: null
  disturbances: []
  footholds: null
"""
NAMED = {"file": None, "name": "Mine", "digest": None, "values": {}, "options": {}}
GAINS = """
inertia: [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]
damping: 50.0
stiffness: 500.0
kp: 45.0
gait: {duty: 0.8}
"""


@pytest.fixture
def saved(tmp_path):
    """Write a file and return its path."""

    def write(text, name):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def test_a_config_means_the_same(saved):
    scenario = mc.load_scenario(saved(CONFIG + OWN, "old.yaml"))
    values = mc.parameters(scenario)
    for path, value in {
        "contact.stiffness": 8000.0, "contact.capture_distance": np.inf, "contact.closing_time": 0.0,
        "hardware.force_sensor.delay": 0.004, "disturbance.cargo.mass": 0.5, "gait.stride": 0.04,
    }.items():  # fmt: skip
        assert float(values.at(path)) == np.float32(value), path


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("contact", NAMED, "the section contact, with kind and values side by side"),
        ("drive", NAMED, "the section hardware.servo, with kind and values side by side"),
        ("disturbances", [NAMED], "disturbance.others, with kind and values side by side"),
        ("footholds", NAMED, "gait.footholds, with kind and values side by side"),
    ],
)
def test_a_component_of_ones_own_in_a_config_is_refused_with_its_new_place(saved, key, value, expected):
    path = saved(CONFIG + OWN.replace(f"{key}: null", f"{key}: {json.dumps(value)}").replace(
        f"{key}: []", f"{key}: {json.dumps(value)}"), "old.yaml")  # fmt: skip
    with pytest.raises(mc.ConfigError) as error:
        mc.load_scenario(path)
    assert str(error.value).startswith(f"{path}: own.{key}: expected {expected}, got ")
    assert "\n" not in str(error.value)


def test_gains_open(saved):
    gains = gains_file.load(saved(GAINS, "gains.yaml"))
    assert (float(gains["kp"]), float(gains["gait.duty"])) == (45.0, 0.8)
    np.testing.assert_array_equal(gains["inertia"], [1.0, 1.0, 1.0, 0.1, 0.1, 0.1])


@pytest.mark.slow
def test_a_walk_is_refused(tmp_path):
    """Its parameters have names of their own: the line says what to do."""
    walk = ds.to_dataset(mc.rollout(mc.Scenario().with_overrides({"duration": 0.3, "gait.cycle": 0.3})))
    walk.attrs["parameters"] = json.dumps({"contact_stiffness": 1e4, "force_delay": 0.0})
    path = ds.save(walk, tmp_path / "walk.nc")
    with pytest.raises(mc.ConfigError) as error:
        ds.load_trajectory(path)
    assert str(error.value) == f"{path}: expected a walk of release 2, got an older one: walk its config again"
