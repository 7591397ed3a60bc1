"""The gains file: what goes in comes out, and what is wrong is said in one line."""

import numpy as np
import pytest

import mjx_climb as mc
from tuning.gains import gains_file


@pytest.mark.parametrize(
    "gains", [mc.Gains(1.0, 5e3, 2e4), mc.Gains(np.arange(1.0, 7.0), np.float32(0.1), 1e22, kp=40.0, kd=0.0)]
)
def test_gains_file_returns_what_went_in(gains, tmp_path):
    read = gains_file.load(gains_file.save(gains, tmp_path / "new" / "gains.yaml", "found by\na test"))
    for name, value in vars(gains).items():
        assert (getattr(read, name) is None) == (value is None)
        np.testing.assert_array_equal(getattr(read, name), value)
    scenario = mc.load_scenario("case_1_2")
    control = gains_file.applied(scenario, read).control
    np.testing.assert_array_equal(control.damping, gains.damping)
    assert control.kp == (scenario.control.kp if gains.kp is None else gains.kp)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "a mapping with keys"),
        ("[1]", "a mapping with keys"),
        ("inertia: 1\ndamping: 1", "stiffness: expected a value, got none"),
        ("inertia: 1\ndamping: -1\nstiffness: 1", ": damping: expected a finite number above 0"),
        ("inertia: 1\ndamping: [1, 2]\nstiffness: 1", ": damping: expected"),
        ("inertia: 1\ndamping: {x: 1}\nstiffness: 1", ": damping"),
        ("inertia: 1\ndamping: 1\nstiffness: 1\nki: 3", "ki: expected only the keys"),
        ("inertia: 1\ndamping: 1\nstiffness: 1\nkd: null", ": kd: expected"),
        ("inertia: [", "valid YAML"),
    ],
)
def test_bad_gains_file(text, expected, tmp_path):
    (tmp_path / "gains.yaml").write_text(text)
    with pytest.raises(mc.ConfigError) as refused:
        gains_file.load(tmp_path / "gains.yaml")
    message = str(refused.value)
    assert expected in message
    assert message.startswith(str(tmp_path / "gains.yaml"))
    assert len(message.splitlines()) == 1
