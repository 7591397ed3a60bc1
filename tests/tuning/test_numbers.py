"""Numbers as tables and files have them, and what is said of walks and scenarios by their numbers."""

import json

import numpy as np
import pytest

import mjx_climb as mc
from tuning import numbers

HELD = {"diverged": False, "detached_limb": None, "detached_at": None, "stands_at": None}


@pytest.mark.parametrize(("value", "text"), [
    (None, "-"), (True, "yes"), (np.False_, "no"), ("LF", "LF"), (12.34567, "12.35"), (3, "3"),
])  # fmt: skip
def test_a_metric_in_a_table(value, text):
    assert numbers.number(value) == text


@pytest.mark.parametrize(("value", "axes"), [
    (None, [np.nan] * 6), (2.0, [2.0] * 6), ([1, 2, 3], [1, 2, 3, np.nan, np.nan, np.nan]),
    ([1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 5, 6]),
])  # fmt: skip
def test_a_gain_of_one_or_three_numbers_stands_on_six_axes(value, axes):
    np.testing.assert_array_equal(numbers.axis_values(value), axes)


@pytest.mark.parametrize(("gains", "text"), [
    (None, "-"), ({}, "-"), ({"k": 2.5}, "2.5"), ({"k": [3.0] * 6}, "3"), ({"k": [[1.0, 1.0]]}, "1"),
    ({"k": [1.0, 1.0, 2.0]}, "three values"), ({"k": np.arange(6)}, "six values"),
    ({"k": [[3.0, 4.0]]}, "1 x 2, norm 5"),
])  # fmt: skip
def test_a_gain_in_a_table(gains, text):
    assert numbers.gain(gains, "k") == text


@pytest.mark.parametrize(("value", "base", "text"), [
    (3.0, 2.0, "+50.0"), (1.0, 2.0, "-50.0"), (3.98, 2.0, "+99.0"), (4.0, 2.0, "+100"), (2.0, 0.0, ""),
    ("LF", 2.0, ""),
    (2.0, None, ""), (True, 2.0, ""),
])  # fmt: skip
def test_a_change_is_in_per_cent(value, base, text):
    assert numbers.change(value, base) == text


def test_json_has_no_number_that_is_not_finite():
    value = {"a": np.array([1.0, np.nan]), "b": (np.inf, np.float32(0.5)), "c": [True, None, "x"], "d": np.int64(3)}
    assert json.loads(numbers.to_json(value)) == {"a": [1.0, None], "b": [None, 0.5], "c": [True, None, "x"], "d": 3}


@pytest.mark.parametrize(("changes", "shown"), [
    ({}, True), ({"base_deviation": 11.0}, True),  # it did not fail
    ({"detached_limb": "LF", "detached_at": 1.0}, True),
    ({"detached_limb": "LF", "detached_at": 1.0, "base_deviation": 10.0}, True),
    ({"detached_limb": "LF", "detached_at": 1.0, "base_deviation": 10.1}, False),
    ({"detached_limb": "LF", "detached_at": 1.0, "base_deviation": np.nan}, False),
    ({"diverged": True}, False),
])  # fmt: skip
def test_numbers_of_a_walk_that_flew_off_are_not_shown(changes, shown):
    metrics = {**HELD, "base_deviation": 0.1, "peak_pull_force": 7.0, **changes}
    expected = metrics if shown else metrics | dict.fromkeys(("base_deviation", "peak_pull_force"), "failed")
    assert numbers.presentable(metrics) == expected


def test_a_margin_longer_than_ten_metres_is_no_length():
    assert not numbers.weightless({"a": {"min_tsm": 10.0}, "b": {"min_tsm": None}})
    assert len(numbers.weightless({"a": {"min_tsm": 1.0}, "b": {"min_tsm": 10.1}})) == 1


@pytest.mark.parametrize(("changes", "said"), [
    ({}, ""),
    ({"gait.swing": "low_reaction"}, ""),
    ({"gait.swing": "low_reaction", "gravity": [0.0, 0.09, 0.0]}, ""),
    ({"gait.swing": "low_reaction", "gravity": [0.0, -0.08, -0.08]}, "gait.swing"),
    ({"gait.swing": "low_reaction", "gravity": [0, 0, -1.6], "contact.capture_distance": 0.005}, ""),
    ({"gait.swing": "cubic", "gravity": [0.0, 0.0, -1.6]}, ""),
    ({"control.reading": "measured_pose"}, ""),
    ({"control.reading": "measured_pose", "time_step": 5e-4}, "control.reading"),
    ({"control.reading": "measured_pose", "time_step": 5e-4, "hardware.control_period": 0.001}, ""),
    ({"time_step": 5e-4}, ""),
])  # fmt: skip
def test_objections_to_a_scenario_before_any_walk(changes, said):
    scenario = mc.load_scenario("case_1_2", {"gravity": [0.0, 0.0, 0.0], **changes})
    assert [line.partition(":")[0] for line in numbers.ahead_of(scenario)] == [said] * bool(said)
