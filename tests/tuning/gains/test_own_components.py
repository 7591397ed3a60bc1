"""Contact, drive, disturbances and footholds of other kinds, in a config and at the shell."""

import json
import re

import numpy as np
import pytest
import yaml

import mjx_climb as mc
from mjx_climb.files.writing import OutputError
from mjx_climb.hardware.velocity_commanded import VelocityCommanded
from mjx_climb.inputs import own_objects
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.scenario.messages import ConfigError
from tuning import scenario_files
from tuning.command_line import options
from tuning.comparisons.stability_limit import spectral_radius
from tuning.methods import parts
from tuning.problem.evaluation import under_pd
from tuning.results.config_file import write_config

TEXT = """
import mjx_climb as mc
from mjx_climb.physics.contact.gripper import Gripper
from mjx_climb.physics.contact.polyhedron import PolyhedralGripper, magnet


class Weak(Gripper):
    pass


weak = Weak(holding_limit=0.5)
pole = PolyhedralGripper(**magnet(pull=15.0, friction=0.6))


class Contactless(mc.Contact):
    def init(self, grip_point, rotation):
        return ()


class Driveless(mc.Actuator):
    pass


class Calm(mc.Disturbance):
    pass


class Picky(mc.Disturbance):
    reason = "a wind needs a speed\\nand a direction",

    def __post_init__(self):
        raise ValueError(*self.reason)

    def act(self, time, body):
        return body.untouched()


class Speechless(Picky):
    reason = ()
"""
SHORT = ["duration=0.3", "control.controller=pd"]
ROWS = {"normals": [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], "limits": [15.0, 8.0]}
POLYHEDRON = {"kind": "polyhedron", "stiffness": 7e3, "only_pulled": True, **ROWS}
VELOCITY = {"kind": "velocity", "velocity_gain": 4.0}
ALL = {
    "contact": POLYHEDRON,
    "hardware": {"servo": VELOCITY},
    "disturbance": {
        "others": [
            {"kind": "link_wrench", "limb": 1, "force": [1.0, 0.0, 0.0], "frame": "link"},
            {"kind": "link_wrench"},
        ]
    },
}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "grip.py"
    path.write_text(TEXT)
    return path


def walk(**how):
    return options.Walk(config="case_1_2", changes=(*SHORT, *how.pop("changes", ())), **how)


def test_a_config_reaches_contact_drive_and_disturbances_and_comes_back():
    scenario = mc.Scenario(**ALL)
    found = own_parameters(scenario)
    np.testing.assert_array_equal(found.contact.normals, ROWS["normals"])
    assert found.contact.only_pulled and found.contact.stiffness == 7e3
    assert isinstance(found.drive, VelocityCommanded) and (found.drive.velocity_gain, found.drive.p) == (4.0, 10.0)
    _, first, second = found.disturbances
    assert (first.frame, second.frame) == ("link", "world") and first.limb == 1
    assert mc.Scenario.from_yaml(scenario.to_yaml()) == scenario and hash(scenario) is not None
    for other in (under_pd(scenario), mc.Scenario.from_yaml(scenario.to_yaml())):
        assert other.kinds == scenario.kinds and len(other.kinds) == 4
    assert mc.parameters(scenario, np.float32).contact.limits.dtype == np.float32


@pytest.mark.slow
def test_the_walk_of_a_config_is_that_of_a_simulation_in_python():
    scenario = walk().load().scenario
    named = mc.rollout(scenario.with_overrides({"hardware.servo": VELOCITY}))
    given = mc.Simulation(scenario, drive=VelocityCommanded(velocity_gain=4.0)).rollout()
    np.testing.assert_array_equal(named.base_position, given.base_position)
    assert type(named.parameters.drive) is type(given.parameters.drive) is VelocityCommanded


def test_options_take_the_place_of_a_configs_and_set_comes_last(file):
    loaded = walk(
        contact=f"{file}:weak",
        drive="velocity",
        disturbances=("link_wrench", "link_wrench"),
        changes=["contact.damping=11", "disturbance.others.1.limb=2"],
    ).load()
    found = own_parameters(loaded.scenario)
    assert type(found.contact).__name__ == "Weak" and (found.contact.holding_limit, found.contact.damping) == (0.5, 11)
    assert [float(each.limb) for each in found.disturbances[1:]] == [0, 2] and type(found.drive) is VelocityCommanded


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"contact": {"kind": "Nobody"}},
            "contact.kind: expected one of gripper, polyhedron, uncertain, or FILE.py:NAM",
        ),
        (
            {"contact.kind": "uncertain", "contact.spred": 0.1},
            "contact.spred: expected a known key, got an unknown one (did you mean spread?)",
        ),
        (
            {"contact.kind": "uncertain", "contact.spread": True},
            "contact.spread: expected a number from 0 to 1, got true",
        ),
        (
            {"contact.kind": "uncertain", "contact.spread": "0.1"},
            'contact.spread: expected a number from 0 to 1, got "0.1"',
        ),
        (
            {"contact.kind": "uncertain", "contact.holding_limit": "x"},
            "contact.holding_limit: expected a finite number, 0 or",
        ),
        ({"hardware.servo": {"kind": "velocity", "q": 1.0}}, "hardware.servo.q: expected one of p, d, manager_period"),
        (
            {"hardware.servo": {"kind": "velocity", "p": [1.0, 2.0]}},
            "hardware.servo.p: expected a number from 0.1 to 1000, got [1.0, 2.0]",
        ),
        (
            {"hardware.servo": {"kind": "velocity", "p": -1.0}},
            "hardware.servo.p: expected a number from 0.1 to 1000, got ",
        ),
        (
            {"disturbance.others": [{"kind": "link_wrench", "frame": 1.0}]},
            "disturbance.others.0.frame: expected a word",
        ),
        (
            {"disturbance.others": [{"kind": "link_wrench", "att": 1.0}]},
            "disturbance.others.0.att: expected a known key",
        ),
        ({"gait.footholds": {"kind": "planned"}}, "gait.footholds.kind: expected one of best_margin, climblab"),
        ({"gait.footholds": {"kind": "best_margin", "q": 1}}, "gait.footholds.q: expected one of reach_a_stride_on"),
        (
            {"own": {"contact": {"name": "PolyhedralGripper"}}},
            "own.contact: expected the section contact, with kind and",
        ),
        (
            {"own": {"disturbances": [{"name": "LinkWrench"}]}},
            "own.disturbances: expected disturbance.others, with kind",
        ),
    ],
)
def test_what_a_component_cannot_take_is_refused_in_one_line(changes, said):
    with pytest.raises(ConfigError, match=re.escape(said)) as refused:
        own_parameters(mc.Scenario().with_overrides(changes))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("option", "text", "said"),
    [
        ("--contact", "Nobody", "FILE.py:NAME, or one of gripper, polyhedron, uncertain, got 'Nobody'"),
        ("--drive", "{file}:Nobody", "expected a drive named Nobody, got none"),
        ("--drive", "{file}:weak", "hardware.servo: expected a drive that inherits from mjx_climb.Actuator, got Weak("),
        ("--disturbance", "gone.py:Wind", "gone.py: expected a readable file, got no such file or directory"),
        (
            "--contact",
            "{file}:Contactless",
            "{file}: expected Contactless to have every method of mjx_climb.Contact, got none named step",
        ),
        (
            "--drive",
            "{file}:Driveless",
            "{file}: expected Driveless to have every method of mjx_climb.Actuator, got none named init, step",
        ),
        (
            "--disturbance",
            "{file}:Calm",
            "{file}: expected Calm to have every method of mjx_climb.Disturbance, got none named act",
        ),
        ("--disturbance", "{file}:Picky", "case_1_2.yaml: disturbance.others.0: a wind needs a speed"),
        ("--disturbance", "{file}:Speechless", "case_1_2.yaml: disturbance.others.0: ValueError"),
    ],
)
def test_a_bad_name_or_class_at_the_shell_is_one_line(file, call, tmp_path, option, text, said):
    code, _, err = call("run", "case_1_2", option, text.format(file=file), "--out", tmp_path / "out")
    [line] = err.splitlines()
    assert code == 2 and said.format(file=file) in line and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_run_with_a_contact_of_ones_own_is_repeated_from_its_folder(file, call, tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.comparisons.remedies.remedies", lambda *_: "")  # which walks many times
    typed = [word for change in SHORT for word in ("--set", change)]
    touch = ["--disturbance", "link_wrench", "--set", "disturbance.others.0.force=[0, 0, 9]"]
    code, _, err = call("run", "case_1_2", *typed, *touch, "--contact", f"{file}:weak", "--out", tmp_path / "out")
    assert code == 1, err  # half a newton holds nothing
    assert "contact: grip.py:weak" in err and "disturbance.others.0: link_wrench" in err
    told = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())["contact"]
    assert told["kind"] == "inputs/contact/grip.py:weak" and len(told["digest"]) == 64
    first = json.loads((tmp_path / "out" / "metrics.json").read_text())
    (tmp_path / "out").rename(tmp_path / "moved")
    file.unlink()
    call("run", tmp_path / "moved" / "config.yaml", "--out", tmp_path / "again")
    assert json.loads((tmp_path / "again" / "metrics.json").read_text()) == first
    assert first["detached_limb"] is not None
    copy = tmp_path / "moved" / "inputs" / "contact" / "grip.py"
    copy.write_text(copy.read_text() + "# new\n")
    code, _, err = call("run", tmp_path / "moved" / "config.yaml", "--out", tmp_path / "third")
    assert code == 2 and "contact.digest: expected " in err


def test_a_search_under_another_contact_is_another(file, tmp_path):
    def identity(contact):
        return parts.identity_of(walk(contact=contact).load())

    first = identity(f"{file}:weak")
    parts.Parts(tmp_path, first)
    parts.Parts(tmp_path, identity(f"{file}:weak"))
    for other, differs in ((f"{file}:pole", r"scenario\.contact\.kind"), (None, "scenario")):
        with pytest.raises(OutputError, match=f"another that differs in {differs}"):
            parts.Parts(tmp_path, identity(other))
    file.write_text(TEXT.replace("0.5", "0.6"))
    with pytest.raises(OutputError, match=r"scenario\.contact"):
        parts.Parts(tmp_path, identity(f"{file}:weak"))


def test_config_yaml_keeps_the_digest_where_a_config_gave_none(file, tmp_path):
    written = write_config(mc.Scenario(contact={"kind": f"{file}:pole"}), tmp_path / "out")
    assert written.contact.digest == scenario_files.digest(file)


def test_a_copy_of_a_file_is_the_same_class_and_old_files_are_forgotten(file, tmp_path):
    copy = tmp_path / "copy.py"
    copy.write_text(file.read_text())
    made = [own_parameters(mc.Scenario(contact={"kind": f"{each}:pole"})).contact for each in (file, copy)]
    assert type(made[0]) is type(made[1])
    for n in range(70):
        copy.write_text(f"found = {n}")
        assert own_objects.load(f"{copy}:found", "law")[0] == n
    assert len(own_objects.RUN) == 64 and own_objects.RUN[-1][0].found == 69


def test_a_plan_of_a_log_refuses_other_drives(call, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text(yaml.safe_dump({"hardware": {"servo": VELOCITY}}))
    code, _, err = call("excite", config)
    [line] = err.splitlines()
    assert code == 2 and "hardware.servo.kind: expected none with excite, got velocity" in line


@pytest.mark.nightly
def test_a_polyhedron_that_holds_is_as_stable_as_the_gripper_in_it():
    """The linearised loop knows no limits: contacts are those of the same springs and dampers."""
    scenario = mc.load_scenario("case_1_2", ["control.controller=pd"])
    own = scenario.with_overrides({"contact": POLYHEDRON | {"stiffness": scenario.contact.stiffness}})
    gripper, polyhedron = (spectral_radius(one, {"kp": 50.0, "kd": 0.2}) for one in (scenario, own))
    np.testing.assert_allclose(polyhedron, gripper, rtol=1e-9)


def test_another_kind_starts_with_values_of_its_own_and_null_is_infinite():
    scenario = mc.Scenario(contact={"stiffness": 7e3, "holding_limit": 3.0})
    other = scenario.with_overrides({"contact.holding_limit": None, "contact.kind": "uncertain"})
    found = own_parameters(other).contact
    assert (found.stiffness, found.holding_limit) == (1e4, np.inf)
    assert mc.paths(other)["contact.spread"]["bounds"] == (0.0, 1.0)
    again = other.with_overrides({"contact.spread": 0.2, "contact.kind": "uncertain"})
    assert again.contact.holding_limit is None and own_parameters(again).contact.spread == 0.2
    assert again.value("contact.rotational_stiffness") is None  # a key that it was not given
    assert again.without_kinds() == mc.Scenario()


def test_an_option_keeps_the_values_of_the_section_that_the_class_has_too(file):
    found = own_parameters(walk(contact="uncertain", changes=["contact.spread=0.2"]).load().scenario).contact
    assert (found.holding_limit, found.spread) == (15.0, 0.2)
    kept = walk(contact=f"{file}:Weak", hardware="dynamixel_x").load().scenario
    assert kept.contact.holding_limit == 15.0 and kept.contact.name == "Weak"


@pytest.mark.parametrize("kind", ["uncertain", "gripper", "{file}:Weak"])
def test_a_kind_by_set_is_that_of_the_option(file, kind):
    kind, closes = kind.format(file=file), ["contact.closing_time=0.1", "contact.capture_distance=0.005"]
    by_set = walk(changes=[f"contact.kind={kind}", *closes]).load().scenario
    assert by_set == walk(contact=kind, changes=closes).load().scenario
    assert (by_set.contact.holding_limit, by_set.contact.closing_time) == (15.0, 0.1)
    drives = walk(hardware="dynamixel_x", changes=["hardware.servo.kind=velocity"]).load().scenario
    assert drives == walk(hardware="dynamixel_x", drive="velocity").load().scenario


def test_files_without_components_in_their_section_own_still_open():
    text = "own: {law: {name: LoadTransfer}, contact: null, drive: null, disturbances: [], footholds: null}"
    assert mc.Scenario.from_yaml(text).own.law.name == "LoadTransfer"
