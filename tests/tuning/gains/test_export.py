"""Export: what is written reads back, and what would diverge in ros2_control's admittance_controller is refused."""

import re

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import mjx_climb as mc
from tuning.command_line import main
from tuning.gains import gains_file, gains_tables, ros2_control

SIX = [1.0, 2.0, 0.5, 0.1, 0.3, 0.02]
GAINS = mc.Gains(np.array(SIX), np.array([90.0, 120, 33, 2, 5, 1.5]), np.array([3e3, 2e3, 1e3, 7.5, 30, 11]))
PAPER = mc.Gains(1.0, 1e4, 4e5)

positive = st.floats(1e-2, 1e4)  # wider, and the slow pole rounds to one
axes = st.lists(positive, min_size=6, max_size=6).map(np.array)
any_gains = st.builds(mc.Gains, axes, axes, axes, st.none() | positive, st.none() | positive)


def controller_step(gains, rate, x, v, force):
    """One period of the controller as its source has it, six axes side by side, the joints where they were sent."""
    mass, damping, stiffness = ros2_control.six(gains)
    acceleration = (1 / mass) * (force - damping * v - stiffness * x)
    v = v + acceleration * (1 / rate)
    return x + v * (1 / rate), v


def step_matrix(gains, rate):
    """The step of the controller as a matrix of each axis, (6, 2, 2), by stepping unit states."""
    columns = [controller_step(gains, rate, np.full(6, a), np.full(6, b), 0.0) for a, b in ((1.0, 0.0), (0.0, 1.0))]
    return np.moveaxis(np.array(columns), (0, 1, 2), (2, 1, 0))


@pytest.fixture
def export(tmp_path, capsys):
    """Run the export of some gains: (exit code, stdout, stderr)."""

    def run(gains, *arguments):
        path = gains_file.save(gains, tmp_path / "gains.yaml")
        with pytest.raises(SystemExit) as ended:
            main(["export", str(path), *map(str, arguments)])
        return ended.value.code, *capsys.readouterr()

    return run


@settings(max_examples=200, deadline=None)
@given(any_gains, st.floats(10.0, 1e4))
def test_poles_are_those_of_the_controllers_step(gains, rate):
    """The closed form gives the eigenvalues of the update rule, sum and product to rounding."""
    matrix, poles = step_matrix(gains, rate), ros2_control.poles(gains, rate)
    scale = np.abs(matrix).max((1, 2)) + 1
    np.testing.assert_allclose(poles.sum(1), np.trace(matrix, axis1=1, axis2=2), atol=1e-12 * scale.max(), rtol=1e-9)
    product = 1 - ros2_control.six(gains)[1] / ros2_control.six(gains)[0] / rate
    np.testing.assert_allclose(poles.prod(1), product, rtol=1e-9, atol=1e-9 * scale.max())


@settings(max_examples=200, deadline=None)
@given(any_gains, st.floats(10.0, 1e4))
def test_limits_are_where_the_poles_leave_the_circle(gains, rate):
    """Just inside the limits of rate and inertia all poles lie in the unit circle, just outside one does not."""

    def largest(gains, rate):
        return np.abs(ros2_control.poles(gains, rate)).max(1)

    lowest = ros2_control.lowest_rate(gains)
    inertia, damping, stiffness = ros2_control.six(gains)
    least = ros2_control.smallest_inertia(gains, rate)
    for axis in range(6):
        one = mc.Gains(inertia[axis], damping[axis], stiffness[axis])
        assert largest(one, lowest[axis] * 1.001)[0] < 1 < largest(one, lowest[axis] * 0.999)[0]
        assert (
            ros2_control.stable(one, lowest[axis] * 1.001)[0] and not ros2_control.stable(one, lowest[axis] * 0.999)[0]
        )
        for factor, holds in ((1.001, True), (0.999, False)):
            heavier = mc.Gains(least[axis] * factor, damping[axis], stiffness[axis])
            assert (largest(heavier, rate)[0] < 1) == holds
            assert ros2_control.stable(heavier, rate)[0] == holds


@pytest.mark.parametrize(("factor", "grows"), [(1.01, False), (0.99, True)])
def test_a_push_dies_out_or_grows_as_the_poles_say(factor, grows):
    """A second of the controller's own steps after a push: calm above the limit of the rate, growing below."""
    for axis, limit in enumerate(ros2_control.lowest_rate(GAINS)):
        alone = np.eye(6)[axis]
        x, v = controller_step(GAINS, limit * factor, 0 * alone, 0 * alone, alone)
        size = []
        for _ in range(400):
            x, v = controller_step(GAINS, limit * factor, x, v, 0 * alone)
            size.append(np.abs(x[axis]))
        assert (max(size[-50:]) > max(size[:50])) == grows


@pytest.mark.parametrize("form", ["ros2_control", "json", "csv"])
def test_what_is_written_reads_back(export, form):
    code, text, err = export(GAINS, "--format", form)
    read = {"ros2_control": ros2_control.read, "json": gains_tables.read_json, "csv": gains_tables.read_csv}[form]
    assert (code, err) == (0, "")
    for name in mc.Gains.AXES:
        np.testing.assert_allclose(getattr(read(text), name), getattr(GAINS, name), rtol=1e-14)


@settings(max_examples=50, deadline=None)
@given(any_gains)
def test_any_gains_survive_every_format(gains):
    for back in (
        ros2_control.read(ros2_control.write(gains, 1000)),
        gains_tables.read_json(gains_tables.write_json(gains)),
        gains_tables.read_csv(gains_tables.write_csv(gains)),
    ):
        for name in mc.Gains.AXES:
            np.testing.assert_allclose(getattr(back, name), getattr(gains, name), rtol=1e-13)
    assert (back.kp, back.kd) == (gains.kp, gains.kd)  # a table has the joint gains too


def test_the_parameters_are_what_the_controller_declares(export):
    """Its names, six doubles each, written so that neither rcl nor PyYAML takes them for whole numbers or words."""
    _, text, _ = export(mc.Gains(1, 50, 1e3), "--update-rate", 500, "--name", "base_admittance")
    parameters = yaml.safe_load(text)["base_admittance"]["ros__parameters"]
    assert parameters["update_rate"] == 500
    assert parameters["ft_sensor"] == {"filter_coefficient": 1.0}
    admittance = parameters["admittance"]
    assert set(admittance) == {"selected_axes", "mass", "damping_ratio", "stiffness", "joint_damping"}
    for name in ("mass", "damping_ratio", "stiffness"):
        assert [type(value) for value in admittance[name]] == [float] * 6
    assert admittance["damping_ratio"] == pytest.approx([50 / (2 * np.sqrt(1e3))] * 6)


@pytest.mark.parametrize("gains", [PAPER, mc.Gains(1e-3, 1.0, 1e7), mc.Gains(np.array(SIX), 900.0, 2e5)])
def test_what_would_diverge_is_refused_and_each_cure_cures(export, gains, tmp_path):
    """Exit code 2, one line; the update rate it names is taken, and so is the virtual inertia."""
    code, out, err = export(gains, "--out", tmp_path / "parameters.yaml")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert not (tmp_path / "parameters.yaml").exists()
    rate = re.search(r"--update-rate (\d+)", err)[1]
    assert export(gains, "--update-rate", rate)[0] == 0
    inertia = float(re.search(r"virtual inertia of ([\d.e+-]+)", err)[1])
    holds = ros2_control.stable(gains, 1000)
    assert not holds.all()
    heavier = mc.Gains(np.where(holds, gains.inertia, inertia), gains.damping, gains.stiffness)
    assert export(heavier)[0] == 0
    assert (np.abs(ros2_control.poles(heavier, 1000)) < 1).all()
    assert (np.abs(ros2_control.poles(gains, float(rate))) < 1).all()


def test_the_papers_pole_is_the_known_one():
    """M = 1, D = 1e4, K = 4e5 at 1 ms: semi-implicit Euler has a pole of magnitude 9.36."""
    assert np.abs(ros2_control.poles(PAPER, 1000)).max() == pytest.approx(9.36, abs=0.005)


@pytest.mark.parametrize(
    ("gains", "arguments", "expected"),
    [
        (mc.Gains(1e7, 1.0, 1.0), (), "inertia: expected 0.0001 to 1e+06"),
        (mc.Gains(1.0, 1.0, 1e9), (), "stiffness: expected 0 to 1e+08"),
        (GAINS, ("--format", "xml"), "'xml'"),
        (GAINS, ("--update-rate", "0"), "--update-rate"),
        (GAINS, ("--name", "a b"), "--name"),
    ],
)
def test_bad_input_ends_with_2_and_one_line(export, gains, arguments, expected):
    code, out, err = export(gains, *arguments)
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert expected in err
