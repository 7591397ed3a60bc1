"""Every declared value and every rule between keys from both sides, and copies of scenarios."""

import math
import pickle
import sys

import numpy as np
import pytest
from pydantic import BaseModel

import mjx_climb as mc
from mjx_climb.scenario import declared
from mjx_climb.scenario.messages import ConfigError, keys, printable, show
from mjx_climb.scenario.model import validated
from mjx_climb.scenario.registers import LoopGains, Registers, RegisterScale, gains_of, registers_of
from mjx_climb.scenario.yaml_text import assign, pairs, parse
from mjx_climb.value_field import BELOW_ONE, in_words, one_in_words

LEAST, MOST, INF = math.ulp(0.0), sys.float_info.max, math.inf
PLAIN = mc.Scenario()


def made(data):
    return validated(mc.Scenario, data, "walk")


# ------------------------------------------------------------------------------------------ bounds, in words and held


@pytest.mark.parametrize(
    ("bounds", "several", "one"),
    [
        ((-MOST, MOST), "finite numbers", "a finite number"),
        ((0.0, MOST), "finite numbers of 0 or more", "a finite number, 0 or above"),
        ((LEAST, MOST), "finite numbers above 0", "a finite number above 0"),
        ((2.5, MOST), "finite numbers of 2.5 or more", "a finite number, 2.5 or above"),
        ((0.0, INF), "finite numbers of 0 or more, or infinite ones", "a finite number, 0 or above"),
        ((LEAST, INF), "finite numbers above 0, or infinite ones", "a finite number above 0"),
        ((LEAST, BELOW_ONE), "numbers above 0 and below 1", "a number above 0 and below 1"),
        ((LEAST, 1.0), "numbers above 0, 1 at most", "a number above 0, 1 at most"),
        ((0.0, BELOW_ONE), "numbers from 0 to below 1", "a number from 0 to below 1"),
        ((-1.5, 1e4), "numbers from -1.5 to 10000", "a number from -1.5 to 10000"),
    ],
)
def test_bounds_are_said_in_words(bounds, several, one):
    assert (in_words(bounds), one_in_words(bounds)) == (several, one)
    assert one_in_words(bounds, whole=True) == one.replace("number", "whole number")


def test_large_whole_bounds_are_written_out():
    assert one_in_words((0.0, 2.0**24 - 1), whole=True) == "a whole number from 0 to 16777215"
    assert one_in_words((0.0, 2.0**24 - 1)) == "a number from 0 to 1.67772e+07"


SECTIONS = {
    "contact": declared.Gripper, "control": declared.JointLoop, "control.recovery": declared.Recovery,
    "gait": declared.PeriodicGait, "gait.waiting": declared.Waiting, "disturbance.cargo": declared.Cargo,
    "hardware": declared.Bus, "hardware.force_sensor": declared.ForceSensors,
    "hardware.base_estimate": declared.BaseEstimate, "hardware.servo": declared.Servos,
}  # fmt: skip
# keys with rules of their own beside their bounds
OWN_RULES = {"control.safe_kp", "control.recovery.margin", "hardware.force_sensor.dead", "gait.swing_path"}


def values():
    for place, component in SECTIONS.items():
        for name, field in component.__dataclass_fields__.items():
            if "value" in field.metadata and f"{place}.{name}" not in OWN_RULES:
                yield f"{place}.{name}", field.metadata["value"]


class Alone:
    """One section, so that no rule between sections is in the way."""

    def __init__(self, key):
        self.place, _, self.name = key.rpartition(".")
        self.model = type(PLAIN.value(self.place))

    def take(self, value):
        return getattr(self.model.model_validate({self.name: value}), self.name)


@pytest.mark.parametrize(("key", "field"), [pytest.param(key, field, id=key) for key, field in values()])
def test_a_value_is_taken_up_to_its_bounds_and_refused_beyond(key, field):
    alone, (low, high) = Alone(key), field.bounds
    shape = tuple(length or 2 for length in field.shape)
    kind = int if field.whole else float

    def of(number):
        return np.full(shape, number).tolist() if shape else number

    def beyond(number, way):
        return number + way if field.whole else math.nextafter(number, way * INF)

    def taken(number):
        found = alone.take(of(number))
        return np.asarray(found, float).tolist() == np.asarray(of(number), float).tolist()

    def refused(number):
        with pytest.raises(ValueError) as error:
            alone.model.model_validate({alone.name: of(number)})
        text = str(error.value)
        if field.shape == (3,):
            assert "a list of three finite numbers" in text
        else:
            assert one_in_words(field.bounds, field.whole) in text
            assert ("or null" in text) == (high == INF)
        return True

    inside = [end for end in (low, high) if abs(end) < MOST]
    tries = [kind(end) for end in inside if not (alone.name == "duty" and end == LEAST)]
    for number in tries:
        if key not in ("hardware.servo.pwm_limit", "hardware.servo.no_load_speed", "disturbance.cargo.stop"):
            try:
                assert taken(number)
            except ValueError as error:  # a rule between keys, not of this one's bounds
                assert "expected a number beside" in str(error) or "a time after" in str(error)
    assert all(refused(beyond(kind(end), -1 if end == low else 1)) for end in inside)
    assert refused(math.nan) and refused(True) and refused("1")
    if high != INF:
        assert refused(None)
    elif not shape and key not in ("disturbance.cargo.stop",):
        assert alone.take(None) is None


# --------------------------------------------------------------------------------------------- rules between keys

SCALE = {"p": 0.001, "i": None, "d": 0.002, "largest": 800}
VOLTAGE = {"drive": "voltage", "torque_limit": 2.0, "no_load_speed": 5.0}
HOLDS = {"wall": {"pitch": 0.2}}


def servo(**keys):
    return {"hardware": {"servo": keys}}


RULES = [
    (servo(torque_limit=2.0, no_load_speed=5.0), None),
    (servo(torque_limit=2.0), None),
    (servo(no_load_speed=5.0), "hardware.servo.torque_limit: expected a number beside no_load_speed, got null"),
    (servo(drive="voltage", no_load_speed=5.0), "servo.torque_limit: expected a number beside no_load_speed, got null"),
    (servo(**VOLTAGE), None),
    (servo(drive="voltage", torque_limit=2.0), "hardware.servo.no_load_speed: expected a number with drive: voltage"),
    (servo(drive="voltage"), "hardware.servo.torque_limit: expected a number with drive: voltage, got null"),
    (servo(supply_voltage=11.0, rated_voltage=12.0, torque_limit=1.0), None),
    (servo(supply_voltage=11.0, torque_limit=1.0), "servo.rated_voltage: expected a number beside supply_voltage"),
    (servo(supply_voltage=11.0, rated_voltage=12.0), "servo.torque_limit: expected a number beside supply_voltage"),
    (servo(rated_voltage=12.0), None),
    (servo(profile_acceleration=3.0), "servo.profile_velocity: expected a number beside profile_acceleration"),
    (servo(profile_acceleration=3.0, profile_velocity=2.0), None),
    (servo(profile_velocity=2.0), None),
    (servo(**VOLTAGE, supply_voltage=11.0, rated_voltage=12.0, supply_resistance=0.1), None),
    (servo(**VOLTAGE, supply_resistance=0.1), "supply_resistance: expected 0 but with drive: voltage and a"),
    (servo(torque_limit=1.0, supply_voltage=11.0, rated_voltage=12.0, supply_resistance=0.1),
     "supply_resistance: expected 0 but with drive: voltage and a supply_voltage, got 0.1"),
    (servo(**VOLTAGE, pwm_limit=0.9), None),
    (servo(pwm_limit=0.9), "pwm_limit: expected 1 with drive: torque, which has no share of the voltage, got 0.9"),
    (servo(registers={"p": 400}, torque_limit=2.0), "hardware.servo.register_scale: expected the scale of this servo"),
    (servo(registers={"p": 400}, register_scale=SCALE), "servo.torque_limit: expected a number beside registers"),
    (servo(registers={"p": 0}, register_scale=SCALE, torque_limit=2.0), "registers.p: expected a register of 1"),
    (servo(registers={"p": 800, "d": 800}, register_scale=SCALE, torque_limit=2.0), None),
    (servo(registers={"p": 801}, register_scale=SCALE, torque_limit=2.0),
     "registers.p: expected a whole number from 0 to 800, as register_scale.largest says, got 801"),
    (servo(registers={"p": 800, "d": 801}, register_scale=SCALE, torque_limit=2.0), "registers.d: expected a whole"),
    (servo(registers={"p": 4, "i": 1}, register_scale=SCALE, torque_limit=2.0),
     "register_scale.i: expected a number beside registers.i, got null"),
    ({"ground": {"holds": HOLDS}}, None),
    ({"ground": {"holds": {}}}, "ground.holds: expected one of points, cloud, map, handrails, truss, pipe, wall, rock"),
    ({"ground": {"holds": HOLDS | {"rock": {}}}}, "ground.holds.rock: expected one of points, cloud, map, handrails, "),
    ({"ground": {"holds": HOLDS, "footholds": {"LF": [0.0]}}}, "ground.holds: expected footholds or holds, not both"),
    ({"ground": {"holds": {"points": [{"at": [0, 0, 0], "normal": [0, 0, 0]}]}}}, "normal: expected a direction, not"),
    ({"ground": {"holds": {"points": [{"at": [1, 0, 0], "normal": [0, 0, 0]}]}}},
     "ground.holds.points.0.normal: expected a direction, not zero, got [0.0, 0.0, 0.0]"),
    ({"ground": {"holds": {"wall": {"size": [0.0, 1.0]}}}}, "wall.size: expected a list of two numbers above 0, 100"),
    ({"ground": {"holds": {"wall": {"size": [100.0, 1.0]}, "seed": 2**24 - 1}}}, None),
    ({"ground": {"holds": {"wall": {"size": [1.0, 100.1]}}}}, "wall.size: expected a list of two numbers above 0, 100"),
    ({"ground": {"holds": HOLDS | {"seed": 2**24}}}, "holds.seed: expected a whole number from 0 to below 2^24, got"),
    ({"ground": {"holds": {"wall": {"filled": 0.0}}}}, "wall.filled: expected a number above 0, 1 at most, got 0.0"),
    ({"ground": {"holds": {"rock": {}, "limit": 0.0, "count": 20_000}}}, None),
    ({"ground": {"holds": HOLDS | {"count": 20_001}}}, "holds.count: expected a whole number from 1 to 20000, got 20"),
    ({"ground": {"holds": HOLDS | {"polyhedron": {"matrix": [[0, 0, -1]], "bound": [1, 2]}}}},
     "ground.holds.polyhedron.bound: expected 1 numbers, one for each row of matrix"),
    ({"ground": {"holds": HOLDS | {"polyhedron": {"matrix": [[0, 0, -1]], "bound": [1]}}}}, None),
    ({"gait": {"swing": "low_reaction", "swing_file": {"file": "a.txt"}}}, "gait.swing_file: expected none with"),
    ({"gait": {"swing": "low_reaction", "height": 0.9}}, "gait.height: expected 1 with swing: low_reaction"),
    ({"gait": {"swing": "low_reaction", "landing_speed": 0.01}}, "gait.landing_speed: expected 0 with swing: low_r"),
    ({"gait": {"swing": "low_reaction"}}, None),
    ({"gait": {"height": 0.9, "sway": 0.01, "landing_speed": 0.01}}, None),
    ({"gait": {"phases": {"LF": 0.0, "LH": 0.25, "RH": 0.5, "RF": 0.75}, "duty": 0.75}}, None),
    ({"gait": {"phases": {"LF": 0.0, "LH": 0.25, "RH": 0.5, "RF": 0.76}, "duty": 0.75}},
     "gait.phases.RF: expected a swing that ends within the cycle, phase 0.75 or less, got 0.76"),
    ({"gait": {"phases": {"LF": 0.0, "LH": 0.1, "RH": 0.2, "RF": 0.24}, "duty": 0.75}},
     "gait.phases.RF: expected a limb on the ground at every moment, got 0.24"),
    ({"gait": {"phases": {"LF": 0.0, "LH": 0.1, "RH": 0.2, "RF": 0.25}, "duty": 0.75}}, None),
    ({"gait": {"duty": 0.75}}, None),
    ({"gait": {"duty": 0.7499}}, "gait.duty: expected a number from 0.75 to below 1, so that one swing ends as the ne"),
    ({"gait": {"sequence": [["LF", "RH"], ["LH", "RF"]], "duty": 0.5}}, None),
    ({"control": {"controller": "base_admittance", "reading": "measured_pose"}}, None),
    ({"control": {"controller": "pd", "reading": "measured_pose", "deadband": 1.0}}, None),
    *(({"control": {"controller": "base_admittance", "reading": "measured_pose", key: value}},
       f"control.{key}: expected none with measured_pose, which has no virtual mass, got {json}")
      for key, value, json in (
          ("deadband", 1.0, "1.0"), ("max_offset", 0.1, "0.1"), ("max_velocity", [1, 2], "[1.0, 2.0]"),
                               ("integration", "semi_implicit", '"semi_implicit"'))),
    ({"control": {"controller": "end_effector_admittance", "reading": "measured_pose"}}, "control.reading: expected"),
    ({"disturbance": {"cargo": {"start": 1.0, "stop": 1.001}}}, None),
    ({"disturbance": {"cargo": {"start": 1.0, "stop": 1.0}}}, "cargo.stop: expected a time after start = 1 s, or null"),
    ({"duration": 0.001, "gait": {"cycle": 0.008}}, None),
    ({"duration": 0.30000000001}, None),
    ({"duration": 0.300001}, "duration: expected a whole number of time steps of 0.001 s, got 0.300001"),
    ({"duration": 0.0004}, "duration: expected a whole number of time steps of 0.001 s, got 0.0004"),
    ({"duration": 1e4}, None),
    ({"duration": 10_000.001}, "duration: expected at most 10000000 time steps of 0.001 s, got 10000.001"),
    ({"hardware": {"control_period": 0.0}}, None),
    ({"hardware": {"control_period": 0.0025}}, "control_period: expected a whole number of time steps of 0.001 s, "
     "or 0, got 0.0025"),
    (servo(rate=250.0), None),
    (servo(rate=0.0), "hardware.servo.rate: expected a finite number above 0, or null, got 0"),
    (servo(rate=300.0), "hardware.servo.rate: expected a rate whose period is a whole number of time steps of 0.001 s"),
    (servo(rate=3000.0), "hardware.servo.rate: expected a rate whose period is a whole number of time steps of 0.001"),
    ({"hardware": {"command_delay": 0.5}}, None),
    ({"hardware": {"force_sensor": {"delay": 0.5011}}}, "hardware.force_sensor.delay: expected at most 500 time steps"),
    ({"gait": {"cycle": 0.008, "duty": 0.75}}, None),
    ({"gait": {"cycle": 0.007, "duty": 0.75}}, "gait.duty: expected a swing, (1 - duty) cycle, of two time steps of"),
]  # fmt: skip


@pytest.mark.parametrize(("data", "said"), RULES, ids=[str(n) for n in range(len(RULES))])
def test_rules_between_keys_hold_from_both_sides(data, said):
    if said is None:
        made(data)
        return
    with pytest.raises(ConfigError) as refused:
        made(data)
    assert said in str(refused.value) and "(and" not in str(refused.value)


def test_gains_of_registers_take_the_place_of_those_of_the_config():
    """By the formula: stall torque times scale times register; the last of both that is set holds."""
    scenario = made(servo(registers={"p": 400, "d": 30}, register_scale=SCALE, torque_limit=2.0))
    assert (scenario.control.kp, scenario.control.ki, scenario.control.kd) == pytest.approx((0.8, 0.0, 0.12))
    for key in ("control.kp", "control.ki", "control.kd"):
        assert scenario.with_overrides({key: 3.0}).hardware.servo.registers is None, key
    kept = scenario.with_overrides({"gait.stride": 0.02})
    assert kept.hardware.servo.registers.p == 400 and kept.control.kp == pytest.approx(0.8)
    scale = RegisterScale(p=0.01, i=0.5, d=0.002)
    gains = LoopGains(3.0, 4.0, 0.5)
    held = registers_of(gains, scale, 2.5)
    assert held == pytest.approx((3.0 / 0.025, 4.0 / 1.25, 0.5 / 0.005))
    assert gains_of(held, scale, 2.5) == pytest.approx(gains)
    unknown = RegisterScale(p=0.01)
    assert registers_of(gains, unknown, 2.5) == Registers(pytest.approx(120.0), None, None)
    assert gains_of(Registers(120.0, None, 7.0), unknown, 2.5) == pytest.approx((3.0, 0.0, 0.0))


# ------------------------------------------------------------------------------------------------ copies of scenarios


@pytest.mark.parametrize("seed", range(6))
def test_steps_and_the_nearest_planning_period_that_divides_them(seed):
    draw = np.random.default_rng(seed)
    for _ in range(20):
        steps, wanted = int(draw.integers(1, 200)), float(draw.choice([0.0004, 0.003, 0.0125, 0.02, 0.3]))
        keys = {"duration": steps * 0.001, "gait.planning_period": wanted}
        scenario = PLAIN.with_overrides(keys)
        assert scenario.steps == steps
        divisors = [n for n in range(1, steps + 1) if steps % n == 0]
        aim = min(max(1.0, wanted / 0.001), steps)
        assert scenario.planning_steps == min(divisors, key=lambda n: (abs(n - aim), n))


LIMB = {"joints": ["a", "b"], "foot": "c"}
AROUND = {"back": [-0.1, 0.01], "left": [0.0, 0.1], "front": [0.1, 0.0], "right": [0.05, -0.1]}
ROBOT = {"file": "own.xml", "height": 0.1, "limbs": {name: LIMB | {"foothold": at} for name, at in AROUND.items()}}


def test_limbs_of_a_file_come_counter_clockwise_from_straight_ahead():
    walks = {"robot": ROBOT, "gait": {"sequence": list(AROUND)}}
    assert made(walks).limbs == ("front", "left", "back", "right")
    assert PLAIN.limbs == ("LF", "LH", "RH", "RF")
    stand = made({"robot": {"file": "own.xml", "limbs": {"b": {"joints": ["x"]}, "a": {"joints": ["y"]}}}})
    assert stand.limbs == ("b", "a") and stand.robot.on_stand and not made(walks).robot.on_stand


@pytest.mark.parametrize(("change", "said"), [
    ({"limbs": {"a": LIMB | {"foothold": [1, 1]}}}, "robot.limbs: expected 2 to 8 limbs, got 1"),
    ({"limbs": {f"l{n}": LIMB | {"foothold": [1, 1]} for n in range(9)}}, "robot.limbs: expected 2 to 8 limbs, got 9"),
    ({"limbs": ROBOT["limbs"] | {"back": {"joints": ["a", "b"], "foothold": [0, 0]}}}, "back.foot: expected a value"),
    ({"limbs": ROBOT["limbs"] | {"back": LIMB}}, "limbs.back.foothold: expected a value, as the robot has a height"),
    ({"limbs": ROBOT["limbs"] | {"back": LIMB | {"joints": ["a"], "foothold": [0, 1]}}}, "expected two joints or more"),
    ({"limbs": ROBOT["limbs"] | {"back": LIMB | {"joints": [*"abcdefgh"], "foothold": [0, 1]}}},
     "back.joints: expected a list of one to seven joint names, from the base outwards"),
    ({"limbs": ROBOT["limbs"] | {"back": LIMB | {"joints": ["a", " "], "foothold": [0, 1]}}}, "back.joints"),
    ({"height": None, "limbs": {f"l{n}": {"joints": ["a"]} for n in range(9)}}, "limbs: expected 1 to 8 limbs, got 9"),
])  # fmt: skip
def test_limbs_of_a_file_are_complete(change, said):
    with pytest.raises(ConfigError, match=said):
        made({"robot": ROBOT | change, "gait": {"sequence": list(AROUND)}})
    seven = LIMB | {"joints": [*"abcdefg"], "foothold": [0, 1]}
    made({"robot": ROBOT | {"limbs": ROBOT["limbs"] | {"back": seven}}, "gait": {"sequence": list(AROUND)}})


@pytest.mark.parametrize(("key", "field"), [pytest.param(key, field, id=key) for key, field in values()])
def test_what_the_words_of_a_value_allow_is_allowed(key, field):
    """Each that gives 0 or null a meaning takes it, and null has a meaning wherever it is taken."""
    alone, (low, high) = Alone(key), field.bounds
    assert low <= 0 or "0: " not in field.note, key
    assert (high == INF) == ("null: " in field.note), key
    default = getattr(alone.model.model_validate({"force": [1, 2, 3]} if "pushes" in key else {}), alone.name)
    if field.whole:
        assert type(default) is int, key
    elif "null: none" in field.note and key != "contact.holding_limit":
        assert default is None, key
    elif "0: none" in field.note:
        assert default == 0, key


OWN = {"file": "law.py", "name": "Law"}
FILES = {
    "robot": ROBOT, "gait": {"sequence": list(AROUND), "footholds": {"kind": "feet.py:Mine"}},
    "ground": {"holds": {"map": {"file": "map.csv", "resolution": 0.1, "mask": "mask.npy"}}},
    "own": {"law": OWN, "metrics": [OWN | {"name": "a"}, OWN | {"name": "b"}], "objective": OWN, "method": OWN},
    "contact": {"kind": "grip.py:Grip"}, "hardware": {"servo": {"kind": "drive.py:Drive"}},
    "disturbance": {"others": [{"kind": "link_wrench"}, {"kind": "wind.py:Wind"}]},
}  # fmt: skip


def test_all_files_of_a_scenario_are_found_and_may_lie_elsewhere(tmp_path):
    scenario, seen = made(FILES), {}
    moved = scenario.with_files(lambda key, file: seen.setdefault(key, file) and f"new/{file}")
    assert seen == {
        "robot.file": "own.xml", "ground.holds.map.file": "map.csv", "ground.holds.map.mask": "mask.npy",
        "own.law.file": "law.py", "own.objective.file": "law.py", "own.method.file": "law.py",
        "own.metrics.0.file": "law.py", "own.metrics.1.file": "law.py", "contact.kind": "grip.py",
        "hardware.servo.kind": "drive.py", "gait.footholds.kind": "feet.py", "disturbance.others.1.kind": "wind.py",
    }  # fmt: skip
    assert moved.robot.file == "new/own.xml" and moved.ground.holds.map.mask == "new/mask.npy"
    assert moved.contact.kind == "new/grip.py:Grip" and moved.own.metrics[1].file == "new/law.py"
    assert moved.disturbance.others[0].kind == "link_wrench" and moved.disturbance.others[1].kind == "new/wind.py:Wind"
    lies = scenario.beside(tmp_path)
    assert lies.robot.file == str(tmp_path / "own.xml") and lies.relative_to(tmp_path) == scenario
    assert lies.relative_to(tmp_path / "below").robot.file == str(tmp_path / "own.xml")
    swing = PLAIN.with_overrides(
        {"gait.swing_file.file": "swing.txt", "ground.map": {"file": "m.csv", "resolution": 1.0}}
    )
    found = []
    swing.with_files(lambda key, file: found.append((key, file)) or file)
    assert found == [("ground.map.file", "m.csv"), ("gait.swing_file.file", "swing.txt")]
    cloud = PLAIN.with_overrides({"ground.holds": {"cloud": {"file": "c.ply"}}})
    assert cloud.with_files(lambda key, file: key).ground.holds.cloud.file == "ground.holds.cloud.file"


def test_kinds_are_those_that_are_not_the_papers():
    scenario = made(FILES)
    assert list(scenario.kinds) == [
        "contact", "hardware.servo", "gait.footholds", "disturbance.others.0", "disturbance.others.1"
    ]  # fmt: skip
    assert [(each.file, each.name) for each in scenario.kinds.values()] == [
        ("grip.py", "Grip"), ("drive.py", "Drive"), ("feet.py", "Mine"), (None, "link_wrench"), ("wind.py", "Wind"),
    ]  # fmt: skip
    bare = scenario.without_kinds()
    assert not bare.kinds and bare.robot == scenario.robot and not PLAIN.kinds
    assert (bare.contact, bare.hardware.servo, bare.gait.footholds) == (PLAIN.contact, PLAIN.hardware.servo, "planned")
    stiff = PLAIN.with_overrides(
        {"contact.stiffness": 3e3, "hardware.servo.armature": 0.1, "gait.footholds": "nearest"}
    )
    assert stiff.without_kinds() == stiff
    with pytest.raises(ConfigError, match=r"contact.kind: expected one of .*, or FILE.py:NAME, got \"lime\""):
        PLAIN.with_overrides({"contact.kind": "lime"})


def test_the_section_own_is_there_while_it_names_something():
    one = PLAIN.with_own(law=OWN)
    assert one.own.law.name == "Law" and one.own.metrics == () and "own:" in one.to_yaml()
    two = one.with_own(metrics=[OWN])
    assert two.own.law.name == "Law" and len(two.own.metrics) == 1
    assert two.with_own(law=None).own.law is None and two.with_own(law=None, metrics=[]) == PLAIN
    assert PLAIN.own is None and "own" not in PLAIN.to_yaml()
    for key, words in (("contact", "the section contact"), ("drive", "the section hardware.servo"),
                       ("disturbances", "disturbance.others"), ("footholds", "gait.footholds")):  # fmt: skip
        with pytest.raises(ConfigError, match=f"own.{key}: expected {words}, with kind and values side by side"):
            made({"own": {key: OWN}})
        assert made({"own": {key: None, "law": OWN}}).own == one.own


def test_another_kind_starts_with_values_of_its_own():
    velocity = PLAIN.with_overrides({"hardware.servo.armature": 0.2, "hardware.servo.kind": "velocity"})
    assert dict(velocity.hardware.servo.items()) == {
        "armature": 0.2
    }  # a value that is set beside the kind comes after it
    again = velocity.with_overrides({"hardware.servo.kind": "velocity"})
    assert dict(again.hardware.servo.items()) == {"armature": 0.2}
    assert PLAIN.with_overrides({"hardware.servo.kind": "servo"}) == PLAIN
    assert dict(velocity.with_overrides({"hardware.servo.kind": "a.py:velocity"}).hardware.servo.items()) == {
        "armature": 0.2
    }
    assert velocity.with_overrides({"hardware.servo.kind": "servo"}).hardware.servo == PLAIN.hardware.servo


# ------------------------------------------------------------------------------------------------- text and messages


def test_overrides_become_pairs_and_are_assigned_by_dotted_keys():
    assert pairs(["a.b = 1", "c={d: 2, e: {f: [3]}}"], "x") == [("a.b", 1), ("c.d", 2), ("c.e.f", [3])]
    assert pairs("a=1", "x") == [("a", 1)] and pairs({"a": {"b": None}}, "x") == [("a.b", None)]
    data = {"a": {"b": [1, {"c": 2}]}, "robot": "name", "word": "name", "none": None, "gait": {"footholds": "planned"}}
    for key, value in (("a.b.0", 5), ("a.b.1.c", np.float64(6)), ("none.x", (7, np.arange(2))), ("robot.file", "f"),
                       ("gait.footholds.kind", "k"), ("new.key", 1)):  # fmt: skip
        assign(data, key, value, "x")
    assert data == {
        "a": {"b": [5, {"c": 6.0}]}, "robot": {"file": "f"}, "word": "name", "none": {"x": [7, [0, 1]]},
        "gait": {"footholds": {"kind": "k"}}, "new": {"key": 1},
    }  # fmt: skip
    for key, said in (("word.x", "word: expected no further keys"), ("a.b.2", "a.b: expected an index below 2"),
                      ("a.b.-1", "a.b: expected an index below 2"), ("a..b", "dotted.key=value"),
                      ("", "dotted")):  # fmt: skip
        with pytest.raises(ConfigError, match=said):
            assign(data, key, 1, "x")


def test_twenty_levels_are_read_and_no_more():
    deep = "[" * 20 + "]" * 20
    assert str(parse(deep, "x")) == deep
    with pytest.raises(ConfigError, match="nested deeper than 20"):
        parse("[" + deep + "]", "x")
    assert parse("a: 00012345678901234\nb: 123456789012345678", "x") == {
        "a": 12345678901234,
        "b": 1.2345678901234568e17,
    }
    assert isinstance(parse("12345678901234567", "x"), int) and isinstance(parse("123456789012345678", "x"), float)


def test_a_message_has_its_parts_and_moves_elsewhere():
    error = ConfigError("file", "key", "this", "that", more=2)
    assert str(error) == "file: key: expected this, got that (and 2 more)"
    moved = error.moved(source="", key="other")
    assert str(moved) == "other: expected this, got that (and 2 more)" and moved.more == 2
    again = pickle.loads(pickle.dumps(error))
    assert vars(again) == vars(error) and again.args == error.args
    assert str(ConfigError("file", reason="why")) == "file: why" == str(ConfigError("file", reason="why").moved())
    assert str(ConfigError("", "key", "this")) == "key: expected this"
    assert printable("a\x1b\n\u2028é", keep="\n") == "a\\x1b\n\\u2028é"
    assert show("x" * 58) == '"' + "x" * 58 + '"' and show("x" * 59) == '"' + "x" * 56 + "..."
    assert show({1: {2}}) == '{"1": "{2}"}' and show({(1, 2): 3}) == "{(1, 2): 3}"


def test_keys_are_those_of_all_sections_and_a_misspelt_one_is_told_in_any():
    def leaves(model, place=""):
        for name in type(model).model_fields:
            value = getattr(model, name)
            if isinstance(value, BaseModel):
                yield from leaves(value, f"{place}{name}.")
            else:
                yield f"{place}{name}"

    assert list(keys(mc.Scenario)) == list(leaves(PLAIN))
    for data, said in (
        ({"robot": ROBOT | {"limbs": {"a": LIMB | {"jonts": 1}}}}, "robot.limbs.a.jonts: expected a known key, got an "
         "unknown one (did you mean joints?)"),
        ({"robot": ROBOT | {"limbs": {"a": 3}}}, "robot.limbs.a: expected a mapping with keys joints, foot, "
         "at, foothold, got 3"),
        ({"robot": ROBOT | {"limbs": 3}}, "robot.limbs: expected a mapping from names, got 3"),
        ({"ground": {"holds": {"points": [{"at": [0, 0, 0], "zzz": 1}]}}}, "ground.holds.points.0.zzz: expected one of "
         "at, normal, limit, got an unknown one"),
        ({"gravitation": 1}, "gravitation: expected a known key, got an unknown one (did you mean gravity?)"),
        ({"gravel": 1}, "gravel: expected a known key, got an unknown one (did you mean gravity?)"),
        ({"ground_": 1, "robot": 3}, "robot: expected the name of a robot, got 3 (and 1 more)"),
        ({"zzz": 1}, "zzz: expected one of robot, gravity, duration, time_step, gait, ground, contact, control, "
         "disturbance, hardware, own, got an unknown one"),
        ({"gait": {"armature": 1}}, "gait.armature: expected a known key, got an unknown one (did you mean "
         "hardware.servo.armature?)"),
        ({"contact": {"kind": "gripper", "stifness": 1}}, "contact.stifness: expected a known key, got an unknown one "
         "(did you mean stiffness?)"),
        ({"disturbance": {"pushes": [{"start": 1.0}]}}, "disturbance.pushes.0.force: expected a value, got none"),
        ({"hardware": {"servo": 3}}, "hardware.servo: expected a mapping with keys kind, "),
    ):  # fmt: skip
        with pytest.raises(ConfigError) as refused:
            made(data)
        assert str(refused.value).startswith(f"walk: {said}")
