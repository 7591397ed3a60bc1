"""Scenarios: what loads, what the overrides do, and what a wrong file is told."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_climb.scenario import shipped
from mjx_climb.scenario.load import load_hardware, load_scenario, with_hardware
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Cargo, Push, Scenario

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture
def write(tmp_path):
    def write(content: str | bytes) -> Path:
        path = tmp_path / "walk.yaml"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


def message(call, *arguments) -> str:
    with pytest.raises(ConfigError) as raised:
        call(*arguments)
    text = str(raised.value)
    assert len(text.splitlines()) == 1 and text.encode()
    return text


PUSHES = (
    Push(force=(-5, 0, 0), start=1.0, stop=1.5),
    Push(force=(0, 5, 0), start=4.5, stop=5.0),
    Push(force=(0, -10, 0), start=7.0, stop=7.5),
)


@pytest.mark.parametrize(
    ("name", "gravity", "damping", "stiffness", "cargo", "pushes"),
    [
        ("case_1_1", -9.81, 1e4, 4e5, 1.0, ()),
        ("case_1_2", -9.81 / 6, 5e3, 5e4, 1.0, ()),
        ("case_2", -9.81e-6, 5e3, 2e4, 0.0, PUSHES),
    ],
)
def test_configs_hold_the_papers_cases(name, gravity, damping, stiffness, cargo, pushes):
    scenario = load_scenario(CONFIGS / f"{name}.yaml")
    assert scenario.gravity == pytest.approx((0, 0, gravity)) and scenario.steps == 8000
    control, disturbance = scenario.control, scenario.disturbance
    assert (control.inertia, control.damping, control.stiffness) == (1, damping, stiffness)
    assert disturbance.cargo == Cargo(mass=cargo, start=2.0, stop=None) and disturbance.pushes == pushes


def test_defaults_are_valid_and_left_out_keys_take_them(write):
    assert Scenario.model_validate(Scenario().model_dump()) == Scenario()
    assert load_scenario(write("gait: {cycle: 2.0}")) == Scenario().with_overrides({"gait.cycle": 2.0})


@pytest.mark.parametrize("text", ["2e3", "2E+3", "2000", "+2000.", "2.0e3", "002000"])
def test_every_spelling_of_a_number_is_one(write, text):
    assert load_scenario(write(f"control: {{damping: {text}}}")).control.damping == 2000.0
    assert Scenario().with_overrides([f"control.damping={text}"]).control.damping == 2000.0


def test_to_yaml_gives_back_an_equal_scenario(write):
    changes = {
        "robot": "1e3",  # looks like a number
        "gait.heading": np.float32(0.1), "control.stiffness": np.geomspace(1e-7, 1e17, 6),
        "contact.holding_limit": None, "disturbance.pushes.1.moment": (0, 1 / 3, 0),
    }  # fmt: skip
    scenario = load_scenario(CONFIGS / "case_2.yaml").with_overrides(changes)
    again = load_scenario(write(scenario.to_yaml()))
    assert again == scenario and hash(again) == hash(scenario)


def test_overrides_reach_every_kind_of_key():
    keys = ["disturbance.pushes.0.start = 0.5", "contact.holding_limit=null", "control.inertia=[1,1,1,2,2,2]"]
    case = load_scenario(CONFIGS / "case_2.yaml", ["duration=4", *keys])
    assert [push.start for push in case.disturbance.pushes] == [0.5, 4.5, 7.0]
    assert (case.duration, case.contact.holding_limit, case.control.inertia) == (4, None, (1, 1, 1, 2, 2, 2))


def test_a_mapping_changes_only_the_keys_that_it_names():
    changed = Scenario().with_overrides({"gait.stride": 0.07}).with_overrides({"gait": {"cycle": 2.0}})
    assert (changed.gait.stride, changed.gait.cycle) == (0.07, 2.0)
    assert changed == Scenario().with_overrides(["gait={stride: 0.07, cycle: 2.0}"])


def test_the_last_override_wins_and_only_the_end_is_validated():
    overrides = ["control.reading=measured_pose", "control.controller=end_effector_admittance"]
    assert Scenario().with_overrides([*overrides, "control.reading=virtual_model"]).control.reading == "virtual_model"


def test_whole_numbers_of_steps_tolerate_floats():
    assert Scenario().with_overrides({"duration": 0.3, "time_step": 0.1, "gait.cycle": 1.4}).steps == 3


BAD_FILES = [
    ("", "expected a mapping with keys robot, gravity"),
    ("- 1", "expected a mapping with keys robot, gravity"),
    ("gait:", "gait: expected a mapping with keys stride, step_height"),
    ("gait: {dutty: 0.8}", "gait.dutty: expected a known key, got an unknown one (did you mean duty?)"),
    ("holding_limits: 3", "did you mean contact.holding_limit?"),
    ("stifness: 3", "did you mean contact.stiffness or control.stiffness?"),
    ("torque_limit: 3", "did you mean hardware.servo.torque_limit?"),
    ("robot: ''", "robot: expected the name of a robot"),
    ("robot: '  '", "robot: expected the name of a robot"),
    ("gravity: [0, 0]", "gravity: expected a list of three numbers from -10000 to 10000, got [0, 0]"),
    ("gravity: [0, 0, .nan]", "gravity: expected a list of three numbers from -10000 to 10000"),
    ("gravity: -9.81", "gravity: expected a list of three numbers from -10000 to 10000, got -9.81"),
    ("duration: true", "duration: expected a finite number above 0, got true"),
    ("duration: '8'", 'duration: expected a finite number above 0, got "8"'),
    ("duration: .inf", "duration: expected a finite number above 0"),
    (f"duration: {'9' * 5000}", "duration: expected a finite number above 0"),
    ("duration: 8.0005", "duration: expected a whole number of time steps of 0.001 s, got 8.0005"),
    ("duration: 1.0e-12", "duration: expected a whole number of time steps"),
    ("duration: 1e300\ntime_step: 1e-300", "duration: expected at most 10000000 time steps"),
    ("gait: {cycle: 3.9995}", "gait.cycle: expected a whole number of time steps of 0.001 s, got 3.9995"),
    ("hardware: {command_delay: -1e-3}", "hardware.command_delay: expected a finite number, 0 or above, got -0.001"),
    ("hardware: {control_period: 0.0015}", "hardware.control_period: expected a whole number of time steps of 0.001 s"),
    ("hardware: {servo: {frction: 1}}", "hardware.servo.frction: expected a known key"),
    ("hardware: {servo: {no_load_speed: 5}}", "hardware.servo.torque_limit: expected a number beside no_load_speed"),
    ("hardware: {command_delay: 0.501}", "hardware.command_delay: expected at most 500 time steps of 0.001 s, got"),
    ("hardware: {force_sensor: {delay: 1e9}}", "hardware.force_sensor.delay: expected at most 500 time steps"),
    ("hardware: {base_estimate: {delay: 1}}", "hardware.base_estimate.delay: expected at most 500 time steps"),
    ("hardware: {servo: {delay: 1}}", "hardware.servo.delay: expected at most 500 time steps"),
    ("gait: {duty: 1.0}", "gait.duty: expected a number above 0 and below 1, got 1.0"),
    ("ground: {footholds: {LF: []}}", "ground.footholds.LF: expected a list of one finite number or more"),
    ("ground: {footholds: {LF: [0, high]}}", "ground.footholds.LF: expected a list"),
    ("ground: {footholds: {XX: [0]}}", "ground.footholds.XX: expected one of the limbs LF, LH, RH, RF"),
    ("ground: {map: {file: a.csv}}", "ground.map.resolution: expected a value"),
    ("ground: {map: {file: a.csv, resolution: 0}}", "ground.map.resolution: expected a finite number above 0"),
    ("ground: {map: {file: a.csv, resolution: 1}, footholds: {LF: [1]}}", "expected footholds or map, not both"),
    ("gait: {duty: 0.9999}", "gait.duty: expected a swing"),
    ("gait: {duty: 0.99975}", "gait.duty: expected a swing, (1 - duty) cycle, of two time steps of 0.001 s or more"),
    ("gait: {duty: 0.74}", "gait.duty: expected a number from 0.75 to below 1, so that"),
    ("gait: {sequence: [[LH, RF], [LF, RH]], duty: 0.4}", "gait.duty: expected a number from 0.5 to below 1, so that"),
    ("gait: {sequence: [[LH, RF], [LF]], duty: 0.5}", "gait.sequence: expected the four limbs"),
    ("gait: {phases: {LF: 0, LH: 0.5}}", "gait.phases: expected a phase for each of the four limbs"),
    ("gait: {phases: {LF: 0, LH: 0, RH: 0, RF: 0}}", "gait.phases.LF: expected a limb on the ground at every moment"),
    ("gait: {phases: {LF: 0, LH: 0.3, RH: 0.5, RF: 0.9}}", "gait.phases.RF: expected a swing that ends within the"),
    ("gait: {sequence: [LH, LF, RH, LH]}", "gait.sequence: expected the four limbs"),
    ("gait: {sequence: [LH, LF, RH]}", "gait.sequence: expected the four limbs"),
    ("gait: {heading: 90}", "gait.heading: expected a number from -6.28319 to 6.28319"),
    ("gait: {swing: calm}", "gait.swing: expected 'cubic' or 'low_reaction', got \"calm\""),
    ("gait: {base_reference: sagged}", "gait.base_reference: expected 'nominal' or 'actual', got \"sagged\""),
    ("hardware: {force_sensor: {dead: {LX: 1.0}}}", "hardware.force_sensor.dead.LX: expected one of the limbs LF, LH,"),
    ("hardware: {force_sensor: {dead: {LF: -1.0}}}", "hardware.force_sensor.dead.LF: expected a finite number, 0 or"),
    ("gait: {sway: 0.2, swing: low_reaction}", "gait.sway: expected 0 with swing: low_reaction, which is computed"),
    ("gait: {height: 0}", "gait.height: expected a number above 0"),
    ("control: {stiffness: [1, null, 1, 1, 1, 1]}", "control.stiffness: expected a finite number above 0, or a list"),
    ("gravity: [0, null, -9.8]", "gravity: expected a list of three numbers"),
    ("gait: {sequence: [LF, null, RH, RF]}", "gait.sequence: expected a list of two limbs or more"),
    ("gait: {way_points: [[0.1, null]]}", "gait.way_points: expected a list of lists of two finite numbers"),
    ("disturbance: {pushes: [null]}", "disturbance.pushes.0: expected a mapping with keys force, moment, start, stop"),
    ("ground: {footholds: {LF: [0, null]}}", "ground.footholds.LF: expected a list of one finite number or more"),
    ("contact: {holding_limit: -1}", "contact.holding_limit: expected a finite number, 0 or above, or null, got -1"),
    ("control: {controller: lqr}", "control.controller: expected 'pd', 'base_admittance' or 'end_effector_admittance'"),
    ("control: {damping: 0}", "control.damping: expected a finite number above 0, or a list of six, got 0"),
    ("control: {damping: [1, 2, 3, 4, 5]}", "control.damping: expected a finite number above 0, or a list of six"),
    ("control: {stiffness: [1, 1, 1, 1, 1, -1]}", "control.stiffness: expected"),
    ("control: {controller: end_effector_admittance, reading: measured_pose}",
     "control.reading: expected virtual_model with end_effector_admittance (measured_pose reads "
     'base_admittance only), got "measured_pose"'),
    ("disturbance: {cargo: {start: 2, stop: 2}}", "disturbance.cargo.stop: expected a time after start = 2 s, or null"),
    ("disturbance: {cargo: null}", "disturbance.cargo: expected a mapping with keys mass, start, stop, got null"),
    ("disturbance: {pushes: 5}", "disturbance.pushes: expected a list, got 5"),
    ("disturbance: {pushes: [5]}", "disturbance.pushes.0: expected a mapping with keys force, moment, start, stop"),
    ("disturbance: {pushes: [{start: 1}]}", "disturbance.pushes.0.force: expected a value, got none"),
    ("disturbance: {pushes: [{force: [0, 0, 1], start: 2, stop: 1}]}",
     "disturbance.pushes.0.stop: expected a time after start = 2 s, or null, got 1.0"),
    ("disturbance: {pushes: [{force: [0, 0, 1], start: 2, strt: 1}]}", "disturbance.pushes.0.strt: expected a known"),
    ("duration: -1\ntime_step: 0\nrobot: 3", "robot: expected the name of a robot, got 3 (and 2 more)"),
    ("duration: 8\ngait: {cycle: 4\nduty", "expected valid YAML, got line 3:"),
    ("duration: 8\nduration: 9", "expected valid YAML, got line 2: key 'duration' comes twice"),
    ("gait: {}\ngait: {}\nx: [", "expected valid YAML, got line 2: key 'gait' comes twice"),  # the rest is not read
    ("1: 2", "expected valid YAML, got line 1: a key is not a word"),
    ("? [a, b]\n: 2", "expected valid YAML, got line 1: a key is not a word"),
    ("gait: &a {cycle: 2}\ncontact: *a", "expected valid YAML, got line 1: tags, anchors and aliases are not used"),
    ("duration: *a", "expected valid YAML, got line 1: tags, anchors and aliases are not used"),
    ("duration: !!int ''", "expected valid YAML, got line 1: tags, anchors and aliases are not used"),
    ("duration: !!python/name:os.system", "expected valid YAML, got line 1: tags, anchors and aliases are not used"),
    ("duration: 1\n---\nduration: 2", "expected valid YAML, got line 2"),
    ("gait: " + "[" * 100_000, "expected valid YAML, got line 1: nested deeper than 20"),
    ("robot: " + "a" * 1_000_000, "expected at most 1000000 bytes"),
    ("robot: \x00", "expected valid YAML, got"),
    (b"robot: \xff", "expected UTF-8 text, got byte 0xff at offset 7"),
    ("robot: 8\n".encode("utf-16"), "expected UTF-8 text"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "fragment"), BAD_FILES, ids=[str(content)[:40] for content, _ in BAD_FILES])
def test_a_bad_file_is_told_what_is_wrong(write, content, fragment):
    path = write(content)
    text = message(load_scenario, path)
    assert text.startswith(f"{path}: ")
    assert fragment in text


def test_a_file_may_be_as_long_as_is_said_and_begin_with_a_mark_of_its_encoding(write):
    text = "robot: hubrobo_v3_2  #"
    assert load_scenario(write(text + "a" * (1_000_000 - len(text)))) == Scenario()
    assert "at most 1000000 bytes, got more" in message(load_scenario, write(text + "a" * (1_000_001 - len(text))))
    assert load_scenario(write(b"\xef\xbb\xbfduration: 4.0")).duration == 4.0


def test_a_profile_of_hardware_is_one_section_in_a_file_or_a_bare_name(write, tmp_path, monkeypatch):
    profile = load_hardware(write("hardware: {command_delay: 0.01}"))
    assert profile == Scenario().with_overrides({"hardware.command_delay": 0.01}).hardware
    for text, got in (("duration: 4", '{"duration": 4}'), ("hardware: {}\nduration: 4", '{"hardware": {}, "dur'),
                      ("[1]", "[1]"), ("", "null")):  # fmt: skip
        assert f"walk.yaml: expected the one section hardware, got {got}" in message(load_hardware, write(text))
    wrong = message(load_hardware, write("hardware: {comand_delay: 1}"))
    assert "walk.yaml: hardware.comand_delay: expected a known key, got an unknown one (did you mean com" in wrong
    name = shipped.profiles()[0]
    assert load_hardware(name) == load_hardware(CONFIGS / "hardware" / f"{name}.yaml")
    assert "expected a readable file, got no such file" in message(load_hardware, f"below/{name}")
    assert "expected a readable file, got no such file" in message(load_hardware, f"{name}.yml")
    assert message(load_hardware, "zzz").startswith(f"zzz: expected a file, or a profile of hardware ({name}, ")
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text("hardware: {command_delay: 0.02}")
    assert load_hardware(name).command_delay == 0.02
    (tmp_path / "case_2").write_text("duration: 4.0")
    assert load_scenario("case_2").duration == 4.0 and load_scenario("case_1_1").duration == 8.0
    assert message(load_scenario, "case_9").startswith("case_9: expected a file, or a config that comes with the prog")
    every = {file.stem for file in CONFIGS.glob("*.yaml")}
    assert {*shipped.names()} | {*shipped.ensembles()} == every and not {*shipped.names()} & {*shipped.ensembles()}
    assert all(each.startswith("ensemble") for each in shipped.ensembles()) and len(shipped.ensembles()) > 0
    slower = with_hardware(Scenario(), profile)
    assert slower.hardware == profile and slower.gait == Scenario().gait
    late = profile.model_copy(update={"control_period": 0.0015})
    assert message(with_hardware, Scenario(), late, "mine").startswith("mine: hardware.control_period: expected a who")


def test_paths_that_are_no_readable_file(tmp_path):
    assert "got no such file or directory" in message(load_scenario, tmp_path / "absent.yaml")
    assert "got is a directory" in message(load_scenario, tmp_path)
    assert "expected a readable file" in message(load_scenario, "a\0b")


BAD_OVERRIDES = [
    (["control.damping"], 'expected an override of the form dotted.key=value, got "control.damping"'),
    (["=3"], "expected an override of the form"),
    (["contact.holding_limit="], "expected an override of the form"),
    (["gait..cycle=3"], "expected an override of the form"),
    ([3], "expected an override of the form"),
    ({3: 3}, "expected an override of the form"),
    (["gait.cycle=[1"], "gait.cycle: expected valid YAML, got expected ',' or ']', but got '<stream end>'"),
    (["gait.cycle.x=1"], 'gait.cycle: expected no further keys below this one, got "x"'),
    (["gait.cicle=1"], "gait.cicle: expected a known key, got an unknown one (did you mean cycle?)"),
    (["gate.cycle=1"], "gate: expected a known key, got an unknown one (did you mean gait?)"),
    (["disturbance.pushes.0.start=1"], 'disturbance.pushes: expected an index below 0, got "0"'),
    (["gravity.-1=1"], 'gravity: expected an index below 3, got "-1"'),
    (["gravity.x\n\x1b\u2028=1"], "gravity: expected an index below 3"),
    (["control.kp=true"], "control.kp: expected a finite number above 0, got true"),
    (["gate={}"], "gate: expected a mapping with at least one key"),
    ({"control.damping": np.ones(5)}, "control.damping: expected a finite number above 0, or a list of six"),
    ({"robot": object}, "robot: expected the name of a robot"),
]


@pytest.mark.parametrize(("overrides", "fragment"), BAD_OVERRIDES, ids=[str(bad)[:40] for bad, _ in BAD_OVERRIDES])
def test_a_bad_override_is_told_what_is_wrong(overrides, fragment):
    assert fragment in message(load_scenario, CONFIGS / "case_1_1.yaml", overrides)


def test_a_value_that_holds_itself_is_an_error():
    endless: list = []
    endless.append(endless)
    message(Scenario().with_overrides, {"gravity": endless})


KEYS = st.sampled_from(["robot", "gravity", "gait.sequence", "control.inertia", "contact", "disturbance.pushes.0"])


def scenario_or_one_line(call, *arguments):
    try:
        assert isinstance(call(*arguments), Scenario)
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1


@given(st.text() | st.tuples(KEYS, st.text()).map("=".join) | st.tuples(st.text(), st.just("1")).map("=".join))
def test_no_override_string_raises_anything_but_config_error(text):
    scenario_or_one_line(Scenario().with_overrides, [text])


@given(st.binary() | st.text(alphabet="[]{}:,-?&*!|>'\"%@`#~ \n\tae01.").map(str.encode))
def test_no_file_raises_anything_but_config_error(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "odd.yaml"
    path.write_bytes(content)
    scenario_or_one_line(load_scenario, path)


def test_an_error_of_a_config_says_its_parts():
    with pytest.raises(ConfigError) as refused:
        Scenario.from_yaml("contact: {stiffness: -1}", "mine.yaml")
    error = refused.value
    assert (error.source, error.key, error.got) == ("mine.yaml", "contact.stiffness", "-1")
    assert str(error) == f"mine.yaml: contact.stiffness: expected {error.expected}, got -1"
    moved = pickle.loads(pickle.dumps(error.moved(source="other.yaml")))
    assert str(moved) == str(error).replace("mine", "other") and moved.expected == error.expected


def test_gains_of_the_joint_loop_leave_a_drive_without_registers_as_it_is():
    scenario = Scenario().with_overrides({"hardware.servo.kind": "velocity"})
    changed = scenario.with_overrides({"control.kp": 40.0})
    assert changed.control.kp == 40.0 and changed.hardware == scenario.hardware


def test_a_component_of_another_kind_has_none_of_the_papers_values():
    """Readers that ask for one get its absence, not the gripper's 15 N or the servos' defaults."""
    scenario = Scenario().with_overrides({"contact.kind": "polyhedron", "hardware.servo.kind": "velocity"})
    assert scenario.value("contact.holding_limit", "none") == "none"
    assert scenario.value("hardware.servo.armature", "none") == "none"
    with pytest.raises(AttributeError):
        _ = scenario.contact.holding_limit
    named = scenario.with_overrides({"contact.stiffness": 5e3})
    assert named.value("contact.stiffness") == named.contact.stiffness == 5e3
