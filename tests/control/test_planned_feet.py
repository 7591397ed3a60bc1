"""Offsets of the feet by stance and by time, of `docs/studies/planned_feet.py`, against NumPy's interpolation."""

import importlib.util
from pathlib import Path

import numpy as np

import mjx_climb as mc
from mjx_climb.control.law import Start

SCRIPT = Path(__file__).parents[2] / "docs" / "studies" / "planned_feet.py"
PERIOD = 0.005


def from_script():
    spec = importlib.util.spec_from_file_location("planned_feet", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


study = from_script()
FEET = np.array([[0.2, 0.1, 0.0], [-0.2, 0.1, 0.0], [-0.2, -0.1, 0.0], [0.2, -0.1, 0.0]])


def reference(until, since):
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    return mc.Reference(np.array([0.0, 0.0, 0.1]), upright, FEET, np.array(until), np.array(since))


def test_a_standing_foot_follows_its_table_over_its_stance():
    table = np.random.default_rng(0).normal(size=(4, len(study.NODES), 3))
    law = study.PlannedFeet(offsets=table)
    since, until = np.array([0.0, 0.3, 2.0, 4.0]), np.array([3.0, 2.0, 0.9, 1e-3])
    now = reference(until, since)
    _, command = law.step(law.init(Start(PERIOD, now)), None, now)
    share = since / (since + until)
    expected = [[np.interp(at, study.NODES, foot[:, axis]) for axis in range(3)]
                for at, foot in zip(share, table, strict=True)]  # fmt: skip
    np.testing.assert_allclose(command.foot_position, FEET + 1e-3 * np.array(expected), atol=1e-7)
    np.testing.assert_array_equal(command.base_displacement, 0)


def test_a_swinging_foot_comes_down_where_its_table_begins():
    table = np.random.default_rng(1).normal(size=(4, len(study.NODES), 3))
    law = study.PlannedFeet(offsets=table)
    now = reference([0.0, 1.0, 1.0, 1.0], [0.0, 1.0, 1.0, 1.0])
    state = law.init(Start(PERIOD, now))
    for _ in range(100):
        state, command = law.step(state, None, now)
    np.testing.assert_allclose(command.foot_position[0], FEET[0] + 1e-3 * table[0, 0], atol=1e-6)


def test_a_plan_in_time_is_followed_from_knot_to_knot():
    table = np.random.default_rng(2).normal(size=(4, len(study.KNOTS), 3))
    law = study.TimedFeet(timed=table)
    now = reference([1.0] * 4, [1.0] * 4)
    state = law.init(Start(0.11, now))
    for step in range(4):
        state, command = law.step(state, None, now)
        expected = [[np.interp(0.11 * step, study.KNOTS, foot[:, axis]) for axis in range(3)] for foot in table]
        np.testing.assert_allclose(command.foot_position, FEET + 1e-3 * np.array(expected), atol=1e-6)
