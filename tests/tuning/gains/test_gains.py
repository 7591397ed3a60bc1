"""Gains on disk: what is written reads back; what is wrong, or would diverge in a robot's controller, is refused."""

import contextlib
import csv
import dataclasses
import itertools
import json
import math
import re

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

import mjx_climb as mc
from mjx_climb.control import LoadTransfer
from mjx_climb.control.internal_force import InternalForce
from mjx_climb.control.virtual_mass import Motion, advance, at_rest
from mjx_climb.inputs import gait_values
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.scenario.load import load_hardware
from mjx_climb.scenario.shipped import config_path
from tuning.comparisons import deployment, margins, stability_limit
from tuning.gains import admittance_control, gains_file, gains_tables, interfaces, own_section, ros2_control

SIX = [1.0, 2.0, 0.5, 0.1, 0.3, 0.02]
AXES = ("x", "y", "z", "rx", "ry", "rz")
GAINS = mc.Gains(np.array(SIX), np.array([90.0, 120, 33, 2, 5, 1.5]), np.array([3e3, 2e3, 1e3, 7.5, 30, 11]))
PAPER = mc.Gains(1.0, 1e4, 4e5)
STAGE = re.compile(r"(disturbances (about|of) .*|walks on worse hardware): [\d.]+ s")  # how long it took

positive = st.floats(1e-2, 1e4)  # wider, and the slow pole rounds to one
axes = st.lists(positive, min_size=6, max_size=6).map(np.array)
any_gains = st.builds(mc.Gains, axes, axes, axes, st.none() | positive, st.none() | positive)


@pytest.fixture
def export(tmp_path, call):
    """Run the export of some gains, perhaps with a config beside them: (exit code, stdout, stderr without stages)."""

    def run(gains, *arguments, config=None):
        path = gains_file.save(gains, tmp_path / "gains.yaml")
        if config is not None:
            (tmp_path / "config.yaml").write_text(config.to_yaml())
        code, out, err = call("export", path, *arguments)
        return code, out, "".join(line for line in err.splitlines(keepends=True) if not STAGE.match(line))

    return run


@settings(max_examples=200, deadline=None)
@given(any_gains, st.floats(10.0, 1e4))
def test_poles_are_those_of_the_controllers_step(gains, rate):
    """The closed form gives the eigenvalues of one period as its source has it, sum and product to rounding."""
    (mass, damping, stiffness), poles, columns = ros2_control.six(gains), ros2_control.poles(gains, rate), []
    for x, v in ((1.0, 0.0), (0.0, 1.0)):  # unit states of six axes side by side, the joints where they were sent
        v = v + (1 / mass) * (0.0 - damping * v - stiffness * x) * (1 / rate)
        columns.append((x + v * (1 / rate), v))
    matrix = np.moveaxis(np.array(columns), (0, 1, 2), (2, 1, 0))  # (6, 2, 2)
    scale = np.abs(matrix).max((1, 2)) + 1
    np.testing.assert_allclose(poles.sum(1), np.trace(matrix, axis1=1, axis2=2), atol=1e-12 * scale.max(), rtol=1e-9)
    product = 1 - damping / mass / rate
    np.testing.assert_allclose(poles.prod(1), product, rtol=1e-9, atol=1e-9 * scale.max())


@settings(max_examples=200, deadline=None)
@given(any_gains, st.floats(10.0, 1e4))
def test_limits_are_where_the_poles_leave_the_circle(gains, rate):
    """Just inside the limits of rate and inertia all poles lie in the unit circle, just outside one does not."""
    lowest, least = ros2_control.lowest_rate(gains), ros2_control.smallest_inertia(gains, rate)
    inertia, damping, stiffness = ros2_control.six(gains)
    for axis in range(6):
        for factor, holds in ((1.001, True), (0.999, False)):
            one = mc.Gains(inertia[axis], damping[axis], stiffness[axis])
            heavier = mc.Gains(least[axis] * factor, damping[axis], stiffness[axis])
            for judged, at in ((one, lowest[axis] * factor), (heavier, rate)):
                assert (np.abs(ros2_control.poles(judged, at)).max(1)[0] < 1) == holds
                assert ros2_control.stable(judged, at)[0] == holds


def expected_rows(gains):
    """Every number with its axis and unit, those of the six axes first."""
    units = {"inertia": ("kg", "kg m^2"), "damping": ("N s/m", "N m s/rad"), "stiffness": ("N/m", "N m/rad")}
    rows = [
        (name, axis, value, units[name][i // 3])
        for name in units
        for i, (axis, value) in enumerate(
            zip(("x", "y", "z", "rx", "ry", "rz"), np.broadcast_to(getattr(gains, name), 6), strict=True)
        )
    ]
    joint = {"kp": (gains.kp, "N m/rad"), "kd": (gains.kd, "N m s/rad")}
    return rows + [(name, "joints", value, unit) for name, (value, unit) in joint.items() if value is not None]


@pytest.mark.parametrize(
    ("form", "write"),
    [
        ("json", gains_tables.write_json),
        ("csv", gains_tables.write_csv),
        ("ros2_control", lambda gains: ros2_control.write(gains, 1000)),
    ],
)
def test_each_form_is_written(export, form, write):
    code, text, err = export(GAINS, "--format", form)
    assert (code, text, len(err.splitlines())) == (0, write(GAINS), 1) and "these gains were not walked" in err


@settings(max_examples=50, deadline=None)
@given(any_gains)
def test_any_gains_survive_every_format_with_their_units(gains):
    """Joint gains too, but for the controller, which has none."""
    tree = json.loads(gains_tables.write_json(gains))
    assert tree.pop("law")["name"] == "VirtualModelAdmittance"
    rows = [(name, axis, v, of["units"][axis]) for name, of in tree.items() for axis, v in of["values"].items()]
    head, *lines = csv.reader(line for line in gains_tables.write_csv(gains).splitlines() if line[0] != "#")
    assert head == ["gain", "axis", "value", "unit"]
    assert rows == [(name, axis, float(v), unit) for name, axis, v, unit in lines] == expected_rows(gains)
    back = ros2_control.read(ros2_control.write(gains, 1000))
    for name in mc.Gains.AXES:
        np.testing.assert_allclose(getattr(back, name), getattr(gains, name), rtol=1e-13)


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
    inertia = float(re.search(r"virtual inertia of ([\d.e+-]+)", err)[1])
    holds = ros2_control.stable(gains, 1000)
    assert not holds.all()
    heavier = mc.Gains(np.where(holds, gains.inertia, inertia), gains.damping, gains.stiffness)
    for cured, at in ((gains, rate), (heavier, "1000")):
        assert export(cured, "--update-rate", at)[0] == 0
        assert (np.abs(ros2_control.poles(cured, float(at))) < 1).all()


def test_the_papers_pole_is_the_known_one():
    """M = 1, D = 1e4, K = 4e5 at 1 ms: semi-implicit Euler has a pole of magnitude 9.36."""
    assert np.abs(ros2_control.poles(PAPER, 1000)).max() == pytest.approx(9.36, abs=0.005)


@pytest.mark.parametrize(
    ("gains", "arguments", "expected"),
    [
        (mc.Gains(1e7, 1.0, 1.0), (), "inertia: expected 0.0001 to 1e+06"),
        (mc.Gains(1.0, 1.0, 1e9), (), "stiffness: expected 0 to 1e+08"),
        (GAINS, ("--format", "admittance_control"), "inertia: expected one value for the axes of a force"),
        (PAPER, ("--format", "admittance_control"), "a virtual inertia of 5.35 would do"),
    ],
)
def test_bad_input_ends_with_2_and_one_line(export, gains, arguments, expected):
    code, out, err = export(gains, *arguments)
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert expected in err


def in_two_digits(least):
    """The least number of two digits that is no less."""
    found = (digits * 10.0**power for power in range(-9, 9) for digits in range(10, 100))
    return next(each for each in found if each >= least * (1 - 1e-12))


@pytest.mark.parametrize(
    ("inertia", "damping", "stiffness", "rate", "faster", "heavier", "axes"),
    [
        # of x alone, of three axes with an inertia of their own each, of all
        ([1.0, 9, 9, 9, 9, 9], 3e3, 10.0, 1000, True, True, " (x)"),
        ([9.0, 9, 9, 1, 1, 0.5], 3e3, 1e4, 1000, True, True, " (rx, ry, rz)"),
        ([1.0] * 6, 1e4, 4e5, 1000, True, True, ""),
        # of two axes with a damping of their own, and at half of the fastest rate
        ([1.0] * 6, [3e3, 4e3, 1, 1, 1, 1], 10.0, 1000, True, True, " (x, y)"),
        ([1e-2] * 6, 1e4, 1.0, 1000, True, True, ""),
        # beyond the fastest rate, beyond the largest inertia, beyond both
        ([1e-3] * 6, 1e4, 1.0, 1000, False, True, ""),
        ([9e5] * 6, 3e8, 1.0, 100, True, False, ""),
        ([1e-4] * 6, 1e9, 1.0, 100, False, False, ""),
    ],
)
def test_gains_that_grow_are_refused_with_what_would_do(inertia, damping, stiffness, rate, faster, heavier, axes):
    """Five per cent inside the limit, up to two digits; of rates a quarter of D / M + sqrt(D^2 / M^2 + 4 K / M)."""
    mass, damping = np.array(inertia), np.broadcast_to(damping, 6)
    gains = mc.Gains(mass, damping, stiffness)
    with pytest.raises(mc.ConfigError) as refused:
        ros2_control.check(gains, rate, "mine")
    limit = max(damping / mass + np.sqrt((damping / mass) ** 2 + 4 * stiffness / mass)) / 4
    grows = (stiffness / rate + 2 * damping) / (rate * mass) >= 4
    lightest = max((stiffness / rate + 2 * damping[grows]) / (4 * rate))
    cures = [f"--update-rate {in_two_digits(1.05 * limit):.0f}"] if faster else []
    cures += [f"a virtual inertia of {in_two_digits(1.05 * lightest):g}{axes}"] if heavier else []
    assert (1.05 * limit < 1e6) == faster and (1.05 * lightest < 1e6) == heavier
    assert axes == ("" if all(grows) else f" ({', '.join(np.array(AXES)[grows])})")
    poles = np.abs(ros2_control.poles(gains, rate)).max(1)
    worst = f"a discrete pole of magnitude {poles.max():.4g} ({AXES[int(poles.argmax())]})"
    cure = " or ".join(cures) or "no update rate or virtual inertia within bounds"
    expected = (
        f"mine: expected gains that are stable in admittance_controller at {rate:g} Hz, got {worst}: {cure} would do"
    )
    assert str(refused.value) == expected


def test_the_edges_of_what_controllers_take_are_taken():
    for value, name, fits in (
        (1e-4, "inertia", True), (0.99e-4, "inertia", False), (1e6, "inertia", True), (1.01e6, "inertia", False),
        (1e8, "stiffness", True), (1.01e8, "stiffness", False),
    ):  # fmt: skip
        gains = {"inertia": np.full(6, 1e3), "damping": 1e-3, "stiffness": np.full(6, 1e-3)}
        gains[name] = np.array([*gains[name][:4], value, gains[name][5]])
        refused = pytest.raises(
            mc.ConfigError, match=rf"^mine: {name}: expected .*, got {re.escape(f'{value:g}')} \(ry\)$"
        )
        with contextlib.nullcontext() if fits else refused:
            ros2_control.check(mc.Gains(**gains), 1000, "mine")
    soft = mc.Gains(np.repeat([9.0, 3.0], 3), 1.0, 1.0)
    for period, fits in ((0.02, True), (0.0201, False)):
        refused = pytest.raises(mc.ConfigError, match=r"^mine: expected a period of at most 0\.02 s, .*, got 0\.0201$")
        with contextlib.nullcontext() if fits else refused:
            admittance_control.check(soft, period, "mine")


def test_the_library_divides_a_period_into_as_few_substeps_of_two_milliseconds_as_there_fit():
    """Of whole milliseconds, also where they were added up, and of whole rates: rounding makes no further substep."""
    summed = itertools.accumulate([1e-3] * 20)
    for period in [*(1e-3 * n for n in range(1, 21)), *summed, *(1 / rate for rate in range(50, 1001))]:
        count = -(-round(period * 1e9) // 2_000_000)
        assert admittance_control.substep_of(period) == pytest.approx(period / count, rel=1e-6)


def test_the_library_is_told_the_inertia_that_would_do_for_all_axes():
    light = mc.Gains(np.repeat([1.0, 0.1], 3), np.repeat([9e3, 50.0], 3), np.repeat([4e5, 300.0], 3))
    least = max((k * 1e-3 + 2 * d) / 4e3 for d, k in ((9e3, 4e5), (50.0, 300.0)))
    with pytest.raises(mc.ConfigError, match=f"substeps of 0.001 s .* inertia of {1.05 * least:.3g} would do$"):
        admittance_control.check(light, 1e-3, "mine")


def test_the_head_of_a_controllers_parameters_says_rate_pole_and_joint_loop():
    gains = mc.Gains(np.full(6, 2.0), np.array([900.0, 700, 700, 700, 700, 700]), 5e3, kp=41.0, kd=0.3, ki=12.0)
    text = ros2_control.write(gains, 400, registers="registers of mine")
    lowest = (450 + math.sqrt(450**2 + 4 * 2500)) / 4
    pole = np.abs(ros2_control.poles(gains, 400)).max()
    assert f"stable at update rates of {math.ceil(lowest)} Hz and above; the largest discrete pole at 400 Hz is" in text
    assert f"# {pole:.6g}. How late" in text and "filter_coefficient 1 filters nothing. It reads" in text
    assert "# The joint loop is the hardware's: kp 41, kd 0.3, ki 12\n# In registers of mine\n" in text
    assert "joint loop" not in ros2_control.write(dataclasses.replace(gains, kp=None, kd=None, ki=None), 400)


def test_gains_are_labelled_by_their_axes():
    """Three or six of a law's, dimensions of its own of an array; the long name is that of the field, or its name."""

    class Own(mc.Law):
        """A law with gains of every shape."""

        damping: object = mc.gain("N s/m", length=3, bounds=(1.0, 1e3), default=10.0)
        deep_net: object = mc.gain("1", shape=(3, 2), bounds=(-1.0, 1.0), default=0.0)
        seven: object = mc.gain("m", shape=(7,), bounds=(-1.0, 1.0), default=0.0, long_name="lucky number")

        def init(self, start):
            return ()

        def step(self, state, measured, reference):
            return state, reference

    shapes = {"damping": (3,), "stiffness": (6,), "deep_net": (3, 2), "seven": (7,), "kp": (), "gait.duty": ()}
    values = {name: np.zeros((2, *shape)) for name, shape in shapes.items()}
    found = gains_tables.labelled(values, ("point",), Own())
    assert {name: dimensions for name, (dimensions, *_) in found.items()} == {
        "damping": ("point", "three"), "stiffness": ("point", "six"), "deep_net": ("point", "deep_net_0", "deep_net_1"),
        "seven": ("point", "seven_0"), "kp": ("point",), "gait.duty": ("point",),
    }  # fmt: skip
    told = {name: (about["units"], about["long_name"]) for name, (*_, about) in found.items()}
    assert told["deep_net"] == ("1", "deep net") and told["seven"] == ("m", "lucky number")
    assert told["damping"][0] == "N s/m" and told["stiffness"][0] == "N/m, N m/rad" and told["kp"][0] == "N m/rad"
    assert gains_tables.axes_of(found) == {"three": ["x", "y", "z"], "six": ["x", "y", "z", "rx", "ry", "rz"]}
    assert gains_tables.axes_of({"kp": found["kp"], "damping": found["damping"]}) == {"three": ["x", "y", "z"]}


def test_rotations_that_a_law_does_not_have_are_like_its_translations():
    kept = {mc.control.EndEffectorAdmittance: [0, 1, 2, 0, 1, 2], mc.control.VirtualModelAdmittance: [*range(6)]}
    for law, axes in kept.items():
        found = interfaces.of_law(dataclasses.replace(GAINS, kp=7.0), law)
        for name in mc.Gains.AXES:
            np.testing.assert_array_equal(getattr(found, name), getattr(GAINS, name)[axes])
        assert found.kp == 7.0


def test_a_value_of_the_gait_that_is_zero_stands_in_a_table_too():
    gait = {"gait.settling": 0.0, "gait.duty": 0.8}
    rows = list(csv.reader(gains_tables.write_csv(GAINS, gait=gait).splitlines()))[-2:]
    assert rows == [["gait.settling", "gait", "0.0", "1"], ["gait.duty", "gait", "0.8", "1"]]


SPLIT = mc.Gains(*(np.repeat(pair, 3) for pair in ([1.0, 0.5], [150.0, 20.0], [3e3, 300.0])))


@pytest.fixture
def judged(monkeypatch):
    """Stability and margins that a test sets, in place of minutes of walking; what they were asked for is kept."""
    found = {"radius": 0.99, "standing": 0.99, "holds": 0.05, "better": 0.05, "asked": []}

    def find(scenario, gains, *, law, engine, progress):
        found["asked"].append(scenario)
        own = own_parameters(scenario)
        reached = {"force_delay": (found["holds"], found["better"]), "joint_gains": (0.1, 0.1)}
        each = {
            name: margins.Margin(each.own(own, scenario.time_step), *reached.get(name, (0.05, 0.05)), 0.05, each.title)
            for name, each in margins.QUANTITIES.items()
        }
        return margins.Found(each, found["holds"] >= 0.005, found["better"] >= 0.005, None)

    def radius(scenario, *_, **__):
        return np.array([found["standing" if scenario.gait.duty > 0.99 else "radius"]])

    monkeypatch.setattr(margins, "find", find)
    monkeypatch.setattr(stability_limit, "spectral_radius", radius)
    return found


def test_gains_for_the_cpp_library_read_back_and_move_as_here(export, judged):
    """Deadband, bounds and period of the config go with them; the walk that is judged has the library's steps."""
    code, text, err = export(SPLIT, "--config", "case_1_2", "--format", "admittance_control", "--update-rate", 200)
    assert (code, err) == (0, "")
    gains, period, motion = admittance_control.read(text)
    assert period == 0.005 and motion == Motion(semi_implicit=True)
    for name in mc.Gains.AXES:
        np.testing.assert_array_equal(getattr(gains, name), getattr(SPLIT, name))
    (scenario,) = judged["asked"]
    assert (scenario.control.integration, scenario.hardware.control_period) == ("semi_implicit", 0.005)
    bounded = Motion(True, (0.5, 0.02), (0.03, 0.1), (0.1, math.inf))
    assert admittance_control.read(admittance_control.write(SPLIT, 0.01, bounded))[1:] == (0.01, bounded)


@pytest.mark.parametrize("factor", [1.01, 0.99])
def test_the_librarys_limit_is_that_of_its_substeps(factor):
    """Gains just inside the limit die out in the law's own semi-implicit steps, just outside they grow."""
    period, damping, stiffness = 0.007, 300.0, 4e4
    gains = mc.Gains(1.0, damping, stiffness)
    limit = ros2_control.smallest_inertia(gains, 1 / admittance_control.substep_of(period))[0]
    gains = mc.Gains(np.full(6, limit * factor), np.full(6, damping), np.full(6, stiffness))
    motion, sizes = Motion(semi_implicit=True), []
    mass = at_rest(gains, period, np.zeros(6), motion)
    for step in range(300):
        mass = advance(mass, np.full(6, 10.0 * (step == 0)), motion)
        sizes.append(float(np.abs(mass.displacement).max()))
    assert (max(sizes[-20:]) > max(sizes[:20])) == (factor < 1)
    refused = pytest.raises(mc.ConfigError, match="virtual inertia")
    with contextlib.nullcontext() if factor > 1 else refused:
        admittance_control.check(gains, period, "gains")


def parameters_in(text):
    return yaml.safe_load(text)["admittance_controller"]["ros__parameters"]


def test_filter_and_rate_are_those_that_were_walked(export, judged):
    """A config beside the gains is the one; a filter of 30 Hz halves a step after ln 2 / (2 pi 30) s."""
    changes = {"hardware.control_period": 0.002, "hardware.force_sensor": {"filter": 30.0, "filtered_by": "law"}}
    code, text, err = export(SPLIT, config=mc.load_scenario("case_1_2", changes))
    parameters = parameters_in(text)
    assert (code, err, parameters["update_rate"]) == (0, "", 500)
    coefficient = parameters["ft_sensor"]["filter_coefficient"]
    assert (1 - coefficient) ** (math.log(2) / (2 * math.pi * 30) * 500) == pytest.approx(0.5)
    assert "filter_coefficient: 30 Hz" in text


VOLTAGE = {"drive": "voltage", "torque_limit": 8.0, "no_load_speed": 7.0, "armature": 0.01}
SCALE = {"p": 5e-3, "i": 0.02, "d": 4e-5}  # the share of the voltage for a unit


def test_gains_of_the_joint_loop_are_written_as_registers(export, judged):
    """They stand for the gains to half a unit of a register; a register that cannot hold its gain says so."""
    gains = dataclasses.replace(SPLIT, kp=41.0, kd=0.3, ki=12.0)
    config = mc.load_scenario("case_1_2", {"hardware.servo": VOLTAGE | {"register_scale": SCALE}})
    code, text, err = export(gains, config=config)
    assert code == 0, err
    (line,) = [line for line in text.splitlines() if "registers" in line]
    found = map(int, re.search(r"P Gain (\d+), I Gain (\d+), D Gain (\d+)$", line).groups())
    assert line.split("In ")[1] in err
    for register, unit, gain in zip(found, SCALE.values(), (41.0, 12.0, 0.3), strict=True):
        assert abs(register * unit * 8.0 - gain) <= unit * 8.0 / 2
    _, text, _ = export(dataclasses.replace(gains, kd=30.0), config=config)
    assert f"D Gain 16383 (kd {16383 * 4e-5 * 8:.3g} in place of 30)" in text
    assert "registers" not in "".join(export(gains, config=mc.load_scenario("case_1_2"))[1:])
    # half of a unit is said where it is more than two per cent of the gain: of 12.5 units, not of 62.5
    for kp, said in ((0.5, " (kp 0.48 in place of 0.5)"), (2.5, "")):
        text = gains_file.registers_in_words(config, dataclasses.replace(SPLIT, kp=kp, kd=0.032, ki=1.6))
        assert text == f"registers of the servo: Position P Gain {int(kp / 0.04)}, I Gain 10, D Gain 100{said}"


@pytest.mark.parametrize(
    ("hardware", "joint", "expected"),
    [
        ("mx_64", {"kp": 42.0, "kd": 0.0}, "P Gain 880, I Gain 0, D Gain 0"),
        (
            "xl_330",
            {"kp": 0.767, "kd": 0.01},
            "P Gain 400, I Gain 0, D Gain not known (kd 0.01: the scale of D is not known)",
        ),
        ("xl_320", {"kp": 0.387, "kd": 0.0}, "P Gain 32, I Gain 0, D Gain 0"),
        ("xl_320", {"kp": 5.0, "kd": 0.0}, "P Gain 254, I Gain 0, D Gain 0 (kp 3.07 in place of 5)"),
    ],
)
def test_registers_of_shipped_servos_are_those_of_the_published_fits(export, judged, hardware, joint, expected):
    code, text, err = export(dataclasses.replace(SPLIT, **joint), "--config", "case_1_2", "--hardware", hardware)
    assert code == 0 and f"registers of the servo: Position {expected}" in text and expected in err


def test_no_register_is_written_for_a_servo_whose_scale_is_not_known(export, judged):
    """Neither as a comment nor as a note: both say which key is missing."""
    config = mc.load_scenario("case_1_2", {"hardware.servo": VOLTAGE})
    code, text, err = export(dataclasses.replace(SPLIT, kp=41.0, kd=0.3), config=config)
    assert code == 0 and "Gain" not in text + err
    assert all(
        "no registers for kp 41, ki 0, kd 0.3: hardware.servo.register_scale does" in said for said in (text, err)
    )


def test_what_the_sensors_filter_is_not_filtered_once_more(export, judged):
    config = mc.load_scenario("case_1_2", {"hardware.force_sensor.filter": 30.0})
    _, text, err = export(SPLIT, config=config)
    assert parameters_in(text)["ft_sensor"]["filter_coefficient"] == 1 and judged["asked"] == [config]
    assert "filtered_by=law" in err and len(err.splitlines()) == 1
    err = export(SPLIT, "--format", "admittance_control")[2]
    assert "filters nothing: give it forces behind a low pass of 30 Hz" in err and len(err.splitlines()) == 1


def received(walk, gains, share, period):
    """Offsets (T, 6) of a controller that takes a sample of a walk's wrench every `period` steps and filters these."""
    inertia, damping, stiffness = ros2_control.six(gains)
    zero, h = np.zeros((6, 6)), period * walk.scenario.time_step
    # offset, rate and the force that is held over a period
    system = np.block([[zero, np.eye(6), zero], [-np.diag(stiffness / inertia), -np.diag(damping / inertia),
                                                 np.diag(1 / inertia)], [zero, zero, zero]])  # fmt: skip
    transition, state, wrench, offsets = expm(system * h), np.zeros(12), np.zeros(6), []
    for step, sample in enumerate(walk.base_wrench):
        if step % period == 0:
            wrench = share * sample + (1 - share) * wrench
            state = (transition @ np.concatenate([state, -wrench]))[:12]
        offsets.append(state[:6])
    return np.array(offsets)


@pytest.mark.nightly
def test_the_walk_has_the_filter_of_the_controller_that_gets_it():
    """At 200 Hz, of 40 Hz, with the coefficient that is written; filtered by the sensors it is another walk."""
    sensor = {"duration": 0.4, "gait.cycle": 1.0, "hardware.control_period": 0.005, "hardware.force_sensor.filter": 40}
    gains, off = mc.Gains(1.0, 150.0, 3e3), {}
    written = parameters_in(ros2_control.write(gains, 200, cutoff=40.0))
    for who in ("law", "sensor"):
        walk = mc.rollout(mc.load_scenario("case_1_2", sensor | {"hardware.force_sensor.filtered_by": who}), gains)
        expected = received(walk, gains, written["ft_sensor"]["filter_coefficient"], 5)
        error = walk.base_displacement - expected
        off[who] = np.sqrt((error**2).mean(0) / (expected**2).mean(0))
    np.testing.assert_allclose(off["law"], 0, atol=1e-9)
    assert (off["sensor"] > 0.01).all() and off["sensor"].max() > 0.05


@pytest.mark.parametrize(
    ("changes", "code", "expected"),
    [
        ({"radius": 1.001}, 2, "a disturbance about a stance of the gait that grows by 1.001"),
        # it stands there before it walks, although its gait, with duty 0.75, always has a foot in the air
        ({"standing": 2.0}, 2, "a disturbance of a robot that stands on all feet that grows by 2.0"),
        ({"holds": 0.004}, 2, "a walk that loses a gripper or diverges"),
        ({"holds": 0.009, "better": 0.006}, 0, "warning: force delay: gains hold up to 9 ms only"),
    ],
)
def test_margins_refuse_and_warn(export, judged, changes, code, expected):
    judged |= changes
    got, out, err = export(SPLIT, "--config", "case_1_2", "--hardware", "dynamixel_x")
    assert (got, bool(out), len(err.splitlines())) == (code, code == 0, 1)
    assert expected in err


@pytest.mark.parametrize(("key", "value"), [("control.controller", "pd"), ("control.reading", "measured_pose")])
def test_gains_of_another_law_are_refused(export, judged, key, value):
    code, out, err = export(SPLIT, config=mc.load_scenario("case_1_2", {key: value}))
    assert (code, out, len(err.splitlines())) == (2, "", 1) and key in err


@pytest.mark.parametrize("case", ["case_1_1", "case_1_2", "case_2"])
def test_the_shipped_gains_are_stable_in_the_robots_controllers(case):
    period = load_hardware("dynamixel_x").control_period
    gains = gains_file.load(config_path(f"gains/dynamixel_x_{case}.yaml"))
    ros2_control.check(gains, 1 / period, case)
    admittance_control.check(gains, period, case)


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
        ("inertia: 1\ndamping: 1\nstiffness: 1\nkx: 3", "kx: expected only the keys"),
        ("inertia: 1\ndamping: 1\nstiffness: 1\nkd: null", ": kd: expected"),
        ("inertia: [", "valid YAML"),
    ],
)
def test_bad_gains_file(text, expected, tmp_path):
    (tmp_path / "gains.yaml").write_text(text)
    with pytest.raises(mc.ConfigError) as refused:
        gains_file.load(tmp_path / "gains.yaml")
    message = str(refused.value)
    assert expected in message and message.startswith(str(tmp_path / "gains.yaml")) and "\n" not in message


GAIT = {"gait.duty": 0.8, "gait.cycle": 3.2, "gait.step_height": 0.02}


@pytest.mark.parametrize("law", [mc.control.PD(), mc.control.MeasuredPoseAdmittance(1.0, 1.0, 1.0)])
def test_a_file_holds_law_joint_gains_and_gait(law, tmp_path):
    """Whatever law the scenario has: it walks under that of the file, as fast, on its own gait."""
    scenario = mc.load_scenario("case_1_2")
    gains = {
        "inertia": 1.0,
        "damping": [1.0, 2, 3, 4, 5, 6],
        "stiffness": 3e3,
        "kp": 40.0,
        "kd": 0.4,
        "safe_kp": 60.0,
        **GAIT,
    }
    path = gains_file.save(gains_file.completed(scenario, gains), tmp_path / "g.yaml", law=law)
    whole = gains_file.whole(path, scenario)
    assert type(whole.law) is type(law)
    kept = {name: value for name, value in gains.items() if name not in mc.Gains.AXES or law.GAINS}
    assert set(whole.gains) == {*kept, *gait_values.GAIT}
    for name, value in kept.items():
        np.testing.assert_array_equal(whole.gains[name], value)
    place, own = gains_file.walker(path, scenario)
    walked, _ = gains_file.replaced(place, own, gains_file.load(path))
    assert own is None and isinstance(mc.control.law_of(walked), type(law))
    assert (walked.gait.duty, walked.gait.cycle, walked.control.kd) == (0.8, 3.2, 0.4)
    assert walked.control.safe_kp == 60
    assert gains_file.applied(scenario, {"kp": 15.0}).control.safe_kp == scenario.control.kp  # not what was searched
    assert walked.gait.stride / 3.2 == pytest.approx(scenario.gait.stride / scenario.gait.cycle)
    assert gains_file.apart(scenario, whole.gains)[0].gait == walked.gait
    assert gains_file.whole(path, walked).law is None  # the scenario's


def test_a_file_holds_the_limits_of_its_law_and_a_config_too(tmp_path):
    """Beside --law as well; what a config.yaml does not say is the law's own."""
    scenario, law = mc.load_scenario("case_1_2"), LoadTransfer(max_offset=0.01, torque_limit=1.5)
    path = gains_file.save(law, tmp_path / "g.yaml", law=law)
    assert "limits: {max_offset: 0.01, max_rate: 0.1, torque_limit: 1.5}" in path.read_text()
    read = gains_file.whole(path, scenario).law
    found = [read, gains_file.walker(path, scenario)[1], gains_file.limited(path, LoadTransfer())]
    named = own_section.section(law)
    assert named["law"]["limits"] == {"max_offset": 0.01, "torque_limit": 1.5}
    found.append(own_section.taken(scenario.with_overrides({"own": named}))[1])
    for own in found:
        assert (own.max_offset, own.max_rate, own.torque_limit) == (0.01, 0.1, 1.5)
    assert gains_file.whole(path, scenario, read).law is read
    other = InternalForce()
    assert gains_file.limited(path, other) is other  # which `load` refuses
    assert "limits" not in own_section.section(LoadTransfer())["law"]
    assert "limits" not in gains_file.text(mc.Gains(1.0, 1.0, 1.0), law=mc.control.MeasuredPoseAdmittance())
    with pytest.raises(mc.ConfigError, match=r"^scenario: own\.law: limits\.reach: expected one of max_offset"):
        own_section.taken(scenario.with_overrides({"own": {"law": {"name": "LoadTransfer", "limits": {"reach": 1.0}}}}))


def test_a_file_that_names_a_shipped_law_with_its_module_still_reads(tmp_path):
    (tmp_path / "g.yaml").write_text(
        "law: admittance.py:VirtualModelAdmittance\ninertia: 1\ndamping: 2\nstiffness: 3\n"
    )
    law = mc.control.VirtualModelAdmittance(1.0, 1.0, 1.0)
    assert gains_file.load(tmp_path / "g.yaml").damping == gains_file.load(tmp_path / "g.yaml", law)["damping"][0] == 2


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("law: PD\ndamping: 1", "damping: expected only the keys kp, kd, ki, safe_kp, got another"),
        ("law: mine.py:Mine\nkp: 1", "law: expected gains of the config's law, got those of mine.py:Mine"),
        (
            "law: base_admittance\ndamping: 1",
            "law: expected no such key in gains of the config's own controller, got base",
        ),
        ("law: PD\nlimits: {max_offset: 1}", "limits.max_offset: expected none, as the law has no limits of its own"),
        ("law: PD\ngait: 3", "gait: expected a mapping with keys stride, step_height, cycle, duty, settling, height, "),
        ("law: PD\ngait: {speed: 3}", "gait.speed: expected only the keys stride, "),
        ("law: PD\ngait: {duty: high}", "gait.duty: expected a number, got 'high'"),
        ("law: PD\ngait: {duty: 0.6}", "gait.duty: expected a number from 0.75 to below 1, so that one swing"),
    ],
)
def test_what_a_whole_file_cannot_say_is_refused(text, expected, tmp_path):
    (tmp_path / "g.yaml").write_text(text)
    with pytest.raises(mc.ConfigError) as refused:
        gains_file.whole(tmp_path / "g.yaml", mc.Scenario())
    assert expected in str(refused.value) and "g.yaml: " in str(refused.value) and "\n" not in str(refused.value)


def test_the_gait_of_exported_gains_is_walked_and_told(export, judged):
    """A controller does not have it, a table does; pd has no gains that an admittance controller takes."""
    gains = vars(SPLIT) | GAIT
    gains = {name: value for name, value in gains.items() if value is not None}
    _, text, err = export(gains, "--config", "case_1_2")
    (scenario,) = judged["asked"]
    assert (scenario.gait.duty, scenario.gait.cycle) == (0.8, 3.2)
    assert "no parameter of the controller: duty 0.8, cycle 3.2, step_height 0.02" in err and len(err.splitlines()) == 1
    assert parameters_in(text) == parameters_in(export(SPLIT, config=None)[1])
    rows = list(csv.reader(export(gains, "--format", "csv")[1].splitlines()))
    err = export(gains)[2].splitlines()
    assert len(err) == 2 and "no parameter of the controller: duty 0.8" in err[1]  # also where nothing walked
    assert ["gait.cycle", "gait", "3.2", "s"] in rows
    assert json.loads(export(gains, "--format", "json")[1])["gait.duty"] == {
        "units": {"gait": "1"},
        "values": {"gait": 0.8},
    }


def test_pd_is_not_exported_and_options_do_not_contradict_a_file(call, tmp_path):
    path = gains_file.save(GAINS, tmp_path / "g.yaml", law=mc.control.PD())
    code, out, err = call("export", path, "--config", "case_1_2")
    assert (code, out, len(err.splitlines())) == (2, "", 1) and "law: expected an admittance law" in err
    for typed in (("--controller", "base_admittance"), ("--set", "control.controller=base_admittance")):
        code, _, err = call("run", "case_1_2", "--gains", path, *typed)
        assert code == 2 and f"expected none with {path}, whose gains are of PD, got base_admittance" in err


def test_a_law_of_each_foots_force_has_no_moment_in_the_cpp_librarys_file():
    laws = {
        mc.control.EndEffectorAdmittance: ["period", "force"],
        mc.control.VirtualModelAdmittance: ["period", "force", "moment"],
    }
    for law, kinds in laws.items():
        text = admittance_control.write(SPLIT, 0.01, law=law)
        assert list(yaml.safe_load(text)["admittance_control"]) == kinds


RUN = ("contact", "hardware.servo", "gait.footholds", "disturbance.others")  # files that a walk in a config runs


@pytest.mark.parametrize(
    ("place", "asked"),
    [*((name, False) for name in (*RUN, "law", "metrics", "objective", "method")), ("contact", True)],
)
def test_a_config_that_was_found_beside_the_gains_runs_nothing(export, tmp_path, monkeypatch, place, asked):
    """In somebody else's folder; one that is given runs the files of its contact, drive, footholds and disturbances."""
    monkeypatch.setattr(deployment, "check", lambda *_, **__: [])
    ran, file = tmp_path / "ran", tmp_path / "theirs.py"
    file.write_text(f"import pathlib\npathlib.Path({str(ran)!r}).touch()\n")
    named = {"kind": f"{file}:Theirs"} if place in RUN else {"file": str(file), "name": "Theirs"}
    key = place if place in RUN else f"own.{place}"
    value = [named] if place in ("metrics", "disturbance.others") else named
    config = mc.load_scenario("case_1_2").with_overrides({key: value})
    code, _, err = export(GAINS, *(["--config", tmp_path / "config.yaml"] if asked else []), config=config)
    assert ran.exists() is asked
    if place in RUN:
        assert code == 2 and err.count("\n") == 1
        assert asked or re.search(rf"{place}(\.0)?\.kind: expected none in a config that was found, not given", err)
