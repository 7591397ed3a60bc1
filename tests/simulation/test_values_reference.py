"""Values of components and parameters against plain readings of their rules: checks, shapes, steps, and every key."""

import dataclasses
import itertools
import math
import os
import threading

import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.component import (
    Component,
    checked_value,
    in_full,
    in_precision,
    option,
    parameter,
    real_numbers,
    with_values,
)
from mjx_climb.control import PD, Law
from mjx_climb.inputs.from_scenario import own_parameters, parameters, paths, waiting_of
from mjx_climb.inputs.resolve import checked
from mjx_climb.parameter_types import path_of_gain, stance_steps, whole_steps, with_whole_steps
from mjx_climb.reading import leaving, read_found
from mjx_climb.value_field import ValueField, value_field

SCENARIO = mc.Scenario()


class Part(Component):
    """A component within another."""

    depth = None
    size: float = parameter("m", bounds=(0.0, 2.0), default=1.0)


class Whole(Component):
    """Values of all shapes, an option, and a component."""

    one: float = parameter("N", bounds=(-1.0, 5.0), default=2.0)
    three: float = parameter("m", shape=(3,), bounds=(0.0, math.inf), default=1.0)
    any_length: float = parameter("m", shape=(None, 2), bounds=(-10.0, 10.0), default=np.zeros((0, 2)))
    much: bool = option(True, "whether much")
    part: Part = dataclasses.field(default=Part(), metadata={"tree": True})


# ---------------------------------------------------------------------------------------------------- single values


def refused(value, shape, low, high, zero, limits):
    """Whether a value is refused, by its numbers one by one."""
    array = np.asarray(value)
    own = array.shape[max(0, array.ndim - len(shape)) :] if shape and array.ndim else shape
    fits = len(own) == len(shape) and all(w is None or w == g for w, g in zip(shape, own, strict=True))
    if not fits and not (len(shape) == 1 and own == (1,)):
        return True
    for number in array.ravel().tolist():
        if limits is not None:
            slack = np.finfo(array.dtype if array.dtype.kind == "f" else np.float64).eps
            least, most = (
                end
                if end in (math.ulp(0.0), math.inf, np.finfo(float).max, math.nextafter(1, 0))
                or end == -np.finfo(float).max
                else end + way * slack * abs(end)
                for end, way in zip(limits, (-1, 1), strict=True)
            )
            if not least <= number <= most:
                return True
            continue
        if math.isnan(number) or (math.isinf(number) and high != math.inf):
            return True
        if not low < 0 and (number < 0 or (number == 0 and not zero and low != 0)):
            return True
    return False


@pytest.mark.parametrize("seed", range(4))
def test_a_value_is_checked_number_by_number(seed):
    draw, both = np.random.default_rng(seed), set()
    for _ in range(120):
        shape = [(), (3,), (6,), (None,), (2, 3), (None, 3)][draw.integers(6)]
        kind = [np.float64, np.float32, np.int64][draw.integers(3)]
        own = tuple(n or int(draw.integers(0, 4)) for n in shape)
        size = [(), own, (4, *own), (1,), (4, 1), (*own, 2), own[:-1]][draw.integers(7)]
        value = np.asarray(draw.choice([1.0, 2.0, 0.5, 3.0], size), kind)
        if value.size and draw.random() < 0.6:
            value = value.copy()
            bad = (
                [0.0, -1.0, 5.0, 2.5]
                if kind is np.int64
                else [0.0, -1.0, math.inf, math.nan, 2.0000000001, 5.0, -math.inf]
            )
            value.reshape(-1)[draw.integers(value.size)] = draw.choice(bad)
        low, high, zero = [(math.nan, math.nan), (0.0, 1.0), (1.0, math.inf), (-3.0, 4.0), (-1.0, math.inf)][
            draw.integers(5)
        ] + (bool(draw.random() < 0.3),)
        limits = [None, None, (0.0, 2.0), (0.5, math.inf), (-1.0, 3.0), (math.ulp(0.0), 1e9)][draw.integers(6)]
        wrong = refused(value, shape, low, high, zero, limits)
        both.add(wrong)
        if wrong:
            with pytest.raises(ValueError, match=r"^a.b: expected ") as error:
                checked_value("a.b", value, shape, low, high, zero, limits)
            assert "\n" not in str(error.value)
        else:
            found = checked_value("a.b", value, shape, low, high, zero, limits)
            np.testing.assert_array_equal(found, value)
            assert found.dtype == (float if value.ndim == 0 else kind)
    assert both == {True, False}


@pytest.mark.parametrize(("given", "words"), [
    (True, "True"), (np.array([True]), "bool"), (1j, "1j"), ("1", "'1'"),
    (np.ma.masked_array([1.0], [True]), "a masked array"),
    (np.array(["a", "b"]), "<U1"), (None, "None"), (np.datetime64("2020-01-01"), "np.datetime64('2020-01-01')"),
])  # fmt: skip
def test_what_is_no_number_is_refused_with_what_it_is(given, words):
    with pytest.raises(ValueError) as error:
        real_numbers("a", given)
    assert str(error.value) == f"a: expected real numbers, got {words}"


def test_numbers_of_python_are_in_double_precision_and_arrays_in_their_own():
    for given in (3, 3.0, np.float32(3), np.int8(3)):
        assert real_numbers("a", given).dtype == float and real_numbers("a", given) == 3.0
    assert real_numbers("a", [1, 2]).dtype == int and real_numbers("a", np.ones(2, np.float32)).dtype == np.float32
    assert isinstance(real_numbers("a", jnp.ones(2)), jnp.ndarray)
    single = lambda value: np.asarray(value, np.float32)  # noqa: E731
    assert in_precision("a", np.array(2.0), single).dtype == np.float32
    assert np.isinf(in_precision("a", np.array(math.inf), single))
    with pytest.raises(ValueError, match=r"a: expected numbers that float32 holds, got 1e.40"):
        in_precision("a", np.array([1.0, 1e40]), single)


def test_values_of_a_component_get_their_full_shape():
    whole = with_values(Whole(), {"one": 3, "three": 0.5, "any_length": np.ones((4, 2))}, name="it")
    assert whole.one == 3.0 and whole.three.tolist() == [0.5] * 3 and whole.any_length.shape == (4, 2)
    assert whole.part.size == 1.0 and isinstance(whole.part.size, np.ndarray) and whole.much
    batch = with_values(Whole(), {"one": np.ones(5), "three": np.ones((5, 1))})
    assert batch.one.shape == (5,) and batch.three.shape == (5, 3)
    for values, said in (
        ({"one": 5.1}, "it.one: expected numbers from -1 to 5, got 5.1"),
        ({"one": [1.0, -1.1]}, "it.one: expected numbers from -1 to 5, got -1.1"),
        ({"three": [1.0, 2.0]}, r"it.three: expected a scalar or a last axis of three, got shape \(2,\)"),
        ({"any_length": np.ones(3)}, r"it.any_length: expected a scalar or last axes \(None, 2\), got shape \(3,\)"),
        ({"three": math.nan}, "it.three: expected finite numbers of 0 or more, or infinite ones, got nan"),
    ):
        with pytest.raises(ValueError, match=f"^{said}"):
            with_values(Whole(), values, name="it")
    with pytest.raises(ValueError, match=r"^it.part.size: expected numbers from 0 to 2, got 3"):
        with_values(Whole(part=Part(size=3.0)), {}, name="it")
    full = in_full(Whole(three=2.0))
    assert full.three.tolist() == [2.0] * 3 and in_full(full) is full
    assert (Whole.VALUES.keys(), dict(Whole.AXES)) == (
        {"one", "three", "any_length"},
        {"one": 0, "three": 1, "any_length": 2},
    )


def test_a_declaration_says_what_it_is():
    field = Whole.VALUES["three"]
    assert (field.lengths, field.size, Whole.VALUES["any_length"].lengths) == ((3,), 3, (1, 2))
    assert ValueField("N", (), (0, 1), long_name="pull").description == "pull, N"
    assert ValueField("N", (), (0, 1), long_name="pull", note="null: none").description == "pull, N; null: none"
    noted = parameter("N", bounds=(0.0, 1.0), long_name="pull; null: any", in_steps=True).metadata["value"]
    assert (noted.long_name, noted.note, noted.in_steps, noted.limits, noted.whole) == (
        "pull",
        "null: any",
        True,
        (0, 1),
        False,
    )
    for bounds, turned in (((1.0, 1.0), None), ((0.0, 1.0), (2.0, 1.0))):
        with pytest.raises(ValueError, match="bounds of a value: expected low < high"):
            value_field(ValueField("1", (), bounds, turned), 1.0)
    made = value_field(ValueField("1", (2,), (0.0, 1.0)), [0.5, 0.5])
    assert made.default_factory().tolist() == [0.5, 0.5] and made.default is dataclasses.MISSING


# --------------------------------------------------------------------------------------------------------- in steps


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_times_are_whole_steps_and_of_two_the_larger(array):
    draw = np.random.default_rng(0)
    for step in (0.001, 0.004, 1 / 3):
        counts = draw.integers(0, 40_000, 200)
        for off, expected in ((0.0, 0), (0.45, 0), (0.5, 1), (0.51, 1), (-0.5, 0), (-0.55, -1), (0.5 - 1e-9, 1)):
            found = np.asarray(whole_steps(array((counts + off) * step), step))
            np.testing.assert_array_equal(found[counts > 0], (counts + expected)[counts > 0])
    # the rounding of single precision, of a time and of its division, counts for nothing
    halves = np.arange(1, 40_000, 17)
    single = array(((halves + 0.5) * 0.001).astype(np.float32))
    np.testing.assert_array_equal(np.asarray(whole_steps(single, 0.001)), halves + 1)
    duty, cycle = draw.uniform(0.3, 0.99, 300), draw.integers(4, 5000, 300)
    np.testing.assert_array_equal(
        np.asarray(stance_steps(array(duty), array(cycle))), np.ceil(duty * cycle - 1e-7 * duty * cycle)
    )
    np.testing.assert_array_equal(
        np.asarray(stance_steps(array([0.75, 0.75 + 1e-8]), array([4000, 4000]))), [3000, 3000]
    )
    assert float(stance_steps(array(0.5), array(10**7))) == 5_000_000 and path_of_gain("kp") == "control.kp"
    assert path_of_gain("gait.duty") == "gait.duty"


def test_a_gait_and_windows_are_counted_in_steps():
    scenario = SCENARIO.with_overrides({"disturbance.pushes": [{"force": [1, 0, 0], "start": 0.1, "stop": 0.2}]})
    own = own_parameters(scenario).replace({
        "gait.cycle": np.array([1.0004, 1.0006]), "gait.duty": np.array([0.7504, 0.8]),
        "hardware.control_period": np.array(0.0024),
        "disturbance.pushes.0.start": np.array(0.10051), "disturbance.pushes.0.stop": np.array(math.inf),
    })  # fmt: skip
    found = with_whole_steps(own, 0.001)
    np.testing.assert_allclose(found.at("gait.cycle"), [1.0, 1.001])
    np.testing.assert_allclose(found.at("gait.duty"), [751 / 1000, 801 / 1001])
    np.testing.assert_allclose(found.at("hardware.control_period"), 0.002)
    np.testing.assert_allclose(found.at("disturbance.pushes.0.start"), 0.101)
    assert np.isinf(found.at("disturbance.pushes.0.stop"))
    changed = {path for path, value in own.values.items() if not np.array_equal(value, found.values[path])}
    assert changed == {"gait.cycle", "gait.duty", "hardware.control_period", "disturbance.pushes.0.start"}


# --------------------------------------------------------------------------------------------------------- every key

SERVO = {
    "torque_limit": 3.0,
    "no_load_speed": 6.0,
    "profile_velocity": 2.0,
    "rated_voltage": 12.0,
    "supply_voltage": 11.0,
}
GIVEN = {
    "hardware.servo": SERVO, "disturbance.cargo": {"mass": 0.3, "stop": 5.0}, "control.recovery": {"margin": 0.2},
    "disturbance.pushes": [
        {"force": [1, 2, 3], "start": 0.1}, {"force": [0, 0, 1], "moment": [4, 5, 6], "start": 1.0, "stop": 2.0},
    ],
    "gait.waiting.waits": True, "hardware.force_sensor.dead": {"RH": 2.5, "LF": 1.5},
}  # fmt: skip


def test_each_key_of_a_scenario_is_the_parameter_of_its_path():
    scenario = SCENARIO.with_overrides(GIVEN)
    own = own_parameters(scenario)
    computed = {
        "ground.foothold_height",
        "gait.swing_path",
        "hardware.force_sensor.dead",
        "mass_scale",
        "gravity",
        "control.safe_kp",
    }
    for path in own.paths.keys() - computed:
        key = path.replace("disturbance.pushes.0", "disturbance.pushes")
        if path.startswith("disturbance.pushes"):
            _, _, number, name = path.split(".")
            value = getattr(scenario.disturbance.pushes[int(number)], name)
        else:
            value = scenario.value(key)
        np.testing.assert_array_equal(own.at(path), math.inf if value is None else value, err_msg=path)
        assert own.at(path).dtype == float
    np.testing.assert_array_equal(own.at("hardware.force_sensor.dead"), [1.5, math.inf, 2.5, math.inf])
    assert own.at("mass_scale") == 1.0 and own.at("control.safe_kp") == scenario.control.kp
    assert own_parameters(SCENARIO.with_overrides({"control.safe_kp": 99.0})).at("control.safe_kp") == 99.0
    np.testing.assert_array_equal(own.at("gravity"), scenario.gravity)
    assert {"disturbance.pushes.0.force", "disturbance.pushes.1.moment", "disturbance.cargo.mass"} <= own.paths.keys()
    told = paths(scenario)
    limit = {"unit": "N", "bounds": (0.0, math.inf), "shape": (), "value": scenario.contact.holding_limit}
    meaning = "holding limit of a gripper, which lets go of a stronger pull"
    assert told["contact.holding_limit"] == {**limit, "meaning": meaning}
    assert told["hardware.servo.torque_limit"]["value"] == 3.0 and told["disturbance.cargo.mass"]["unit"] == "kg"
    assert told["gait.swing_path"]["shape"] == (4, 3, 0) and told["ground.foothold_height"]["shape"] == (4, 0)
    assert told["gravity"]["shape"] == (3,) and own.units["control.kp"][0] == "N m/rad" and {*told} == {*own.paths}
    assert all(np.asarray(v).dtype == np.float32 for v in parameters(scenario, jnp.float32).values.values())


def test_parts_that_a_scenario_does_not_ask_for_are_none():
    plain, asked = own_parameters(SCENARIO), own_parameters(SCENARIO.with_overrides(GIVEN))
    assert plain.recovery is plain.waiting is plain.footholds is None
    assert asked.recovery.margin == 0.2 and asked.waiting is not None
    assert own_parameters(SCENARIO.with_overrides({"control.recovery.shift": 0.1})).recovery.margin == 0.0
    holds = SCENARIO.with_overrides({"ground.holds": {"wall": {"pitch": 0.2}}})
    contact = plain.contact
    assert waiting_of(holds, contact) is not None and waiting_of(SCENARIO, contact) is None
    assert waiting_of(holds.with_overrides({"gait.waiting.waits": False}), contact) is None


def test_replaced_values_leave_all_others_as_they_were():
    own = own_parameters(SCENARIO.with_overrides(GIVEN))
    for path, value in own.values.items():
        found = own.replace({path: value + 1.0})
        changed = {p for p, v in found.values.items() if not np.array_equal(v, own.values[p], equal_nan=True)}
        assert changed == ({path} if np.isfinite(value).any() and value.size else set()), path
        np.testing.assert_array_equal(found.at(path), value + 1.0)
    with pytest.raises(ValueError, match=r"^contact.stifness: expected a path of the parameters, as contact.stiffness"):
        own.at("contact.stifness")
    first = ", ".join(list(own.values)[:5])
    with pytest.raises(ValueError, match=f"^zzz: expected a path of the parameters, as {first}$"):
        own.replace({"zzz": 1.0})


def test_gains_of_registers_follow_the_torque_at_standstill():
    scale = {"p": 0.001, "i": 0.002, "d": 0.003}
    servo = {"registers": {"p": 400, "i": 10, "d": 30}, "register_scale": scale, "torque_limit": 2.0}
    own = own_parameters(SCENARIO.with_overrides({"hardware.servo": servo}))
    found = own.replace({"hardware.servo.torque_limit": np.array([1.0, 3.0])})
    for name in ("kp", "ki", "kd"):
        np.testing.assert_allclose(found.at(f"control.{name}"), own.at(f"control.{name}") * np.array([0.5, 1.5]))
    kept = own.replace({"hardware.servo.torque_limit": np.array(1.0), "control.kp": np.array(7.0)})
    assert kept.at("control.kp") == 7.0 and kept.at("control.kd") == own.at("control.kd") / 2
    alone = own.replace_alone({"hardware.servo.torque_limit": np.array(1.0)})
    assert alone.at("control.kp") == own.at("control.kp")
    plain = own_parameters(SCENARIO.with_overrides({"hardware.servo.torque_limit": 2.0}))
    assert plain.replace({"hardware.servo.torque_limit": np.array(1.0)}).at("control.kp") == plain.at("control.kp")


# ------------------------------------------------------------------------------------------------------------- files


def test_names_that_lead_out_of_a_folder_are_found(tmp_path):
    inside = tmp_path / "in"
    (inside / "below").mkdir(parents=True)
    (inside / "out").symlink_to(tmp_path)
    (inside / "link.txt").symlink_to(tmp_path / "file.txt")
    for good in ("a.txt", "below/b.txt", "new/c.txt", "./a", "below/../a", "link.txt", ".hidden", "..."):
        assert leaving(inside, [good]) is None, good
    for bad in ("../a", "/etc/passwd", "out/a", "below/..", "..", ".", "", "below/", "a\0b", "x\0/b", "below/../../a"):
        assert leaving(inside, ["a.txt", bad, "b.txt"]) == bad
    assert leaving(inside, itertools.chain()) is None
    (tmp_path / "text").write_text("grüße", encoding="utf-8")
    assert read_found(tmp_path / "text") == "grüße"
    os.mkfifo(tmp_path / "pipe")
    said = {}

    def read(name):
        try:
            said[name] = read_found(tmp_path / name)
        except OSError as error:
            said[name] = type(error)

    for name in ("pipe", "in", "none"):
        reader = threading.Thread(target=read, args=[name], daemon=True)
        reader.start()
        reader.join(10)
        if reader.is_alive():  # it waits for a writer
            os.close(os.open(tmp_path / name, os.O_WRONLY))
            pytest.fail("waits")
    assert said == {"pipe": OSError, "in": IsADirectoryError, "none": FileNotFoundError}


def test_a_law_is_an_instance_of_a_class_of_laws():
    law = PD()
    assert checked(law, Law) is law
    for given, kind, said in (
        (PD, Law, r"law: expected an instance of a class that inherits from mjx_climb.Law, got .*; PD\(\) makes one$"),
        (Part, Law, r"law: expected an instance of a class that inherits from mjx_climb.Law, got <class .*Part'>$"),
        (Part(), Law, r"law: expected an instance of a class that inherits from mjx_climb.Law, got Part\(.*\)$"),
    ):
        with pytest.raises(ValueError, match=f"^{said}"):
            checked(given, kind)
