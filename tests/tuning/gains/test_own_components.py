"""Contact, drive and disturbances of a config and of the shell: `own.contact`, `--contact` and the like."""

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
"""
SHORT = ["duration=0.3", "control.controller=pd"]
ROWS = {"normals": [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], "limits": [15.0, 8.0]}
ALL = {
    "contact": {"name": "PolyhedralGripper", "values": ROWS, "options": {"only_pulled": True}},
    "drive": {"name": "VelocityCommanded", "values": {"velocity_gain": 4.0}},
    "disturbances": [
        {"name": "LinkWrench", "values": {"limb": 1, "force": [1.0, 0.0, 0.0]}, "options": {"frame": "link"}},
        {"name": "LinkWrench"},
    ],
}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "grip.py"
    path.write_text(TEXT)
    return path


def walk(**how):
    return options.Walk(config="case_1_2", changes=(*SHORT, *how.pop("changes", ())), **how)


def test_a_config_reaches_contact_drive_and_disturbances_and_comes_back():
    scenario = mc.Scenario(contact={"stiffness": 7e3}).with_overrides({"own": ALL})
    found = own_parameters(scenario)
    np.testing.assert_array_equal(found.contact.normals, ROWS["normals"])
    assert found.contact.only_pulled and found.contact.stiffness == 7e3  # that of the contact section
    assert isinstance(found.drive, VelocityCommanded) and (found.drive.velocity_gain, found.drive.p) == (4.0, 10.0)
    *shipped, first, second = found.disturbances
    assert [type(each).__name__ for each in shipped] == ["Cargo"]
    assert (first.frame, second.frame) == ("link", "world") and first.limb == 1
    assert mc.Scenario.from_yaml(scenario.to_yaml()) == scenario and hash(scenario) is not None
    for other in (under_pd(scenario), mc.Scenario.from_yaml(scenario.to_yaml())):
        assert other.own.components == scenario.own.components
    assert mc.parameters(scenario, np.float32).contact.limits.dtype == np.float32


@pytest.mark.slow
def test_the_walk_of_a_config_is_that_of_a_simulation_in_python():
    scenario = walk().load().scenario
    named = mc.rollout(scenario.with_overrides({"own": {"drive": ALL["drive"]}}))
    given = mc.Simulation(scenario, drive=VelocityCommanded(velocity_gain=4.0)).rollout()
    np.testing.assert_array_equal(named.base_position, given.base_position)
    assert type(named.parameters.drive) is type(given.parameters.drive) is VelocityCommanded


def test_options_take_the_place_of_a_configs_and_set_comes_last(file):
    loaded = walk(
        contact=f"{file}:weak",
        drive="VelocityCommanded",
        disturbances=("LinkWrench", "LinkWrench"),
        changes=["own.contact.values.damping=11", "own.disturbances.1.values.limb=2"],
    ).load()
    found = own_parameters(loaded.scenario)
    assert type(found.contact).__name__ == "Weak" and (found.contact.holding_limit, found.contact.damping) == (0.5, 11)
    assert [float(each.limb) for each in found.disturbances[-2:]] == [0, 2] and type(found.drive) is VelocityCommanded


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ({"contact": {"name": "Nobody"}}, "own.contact.file: expected a file of Python, got none"),
        ({"contact": {"name": "PolyhedralGripper"}}, "own.contact: values.normals: expected a value, got none"),
        ({"drive": {"name": "VelocityCommanded", "values": {"q": 1.0}}}, "own.drive: values.q: expected one of p, d"),
        (
            {"drive": {"name": "VelocityCommanded", "values": {"p": [1.0, 2.0]}}},
            "values.p: expected that of one robot",
        ),
        (
            {"drive": {"name": "VelocityCommanded", "values": {"p": -1.0}}},
            "values.p: expected numbers from 0.1 to 1000",
        ),
        (
            {"drive": {"name": "VelocityCommanded", "values": {"p": "x"}}},
            "own.drive.values.p: expected a ",
        ),
        ({"disturbances": [{"name": "LinkWrench", "options": {"frame": 1.0}}]}, "own.disturbances.0: options.frame: "),
        ({"disturbances": [{"name": "LinkWrench", "options": {"at": 1.0}}]}, "options.at: expected one of frame"),
    ],
)
def test_what_a_component_cannot_take_is_refused_in_one_line(own, said):
    with pytest.raises(ConfigError, match=re.escape(said)) as refused:
        own_parameters(mc.Scenario().with_overrides({"own": own}))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("option", "text", "said"),
    [
        ("--contact", "Nobody", "FILE.py:NAME, or one of PolyhedralGripper, UncertainGripper, got 'Nobody'"),
        ("--drive", "{file}:Nobody", "expected a drive named Nobody, got none"),
        ("--drive", "{file}:weak", "own.drive: expected a drive that inherits from mjx_climb.Actuator, got Weak("),
        ("--disturbance", "gone.py:Wind", "gone.py: expected a readable file, got no such file or directory"),
    ],
)
def test_a_bad_name_at_the_shell_is_one_line(file, call, tmp_path, option, text, said):
    code, _, err = call("run", "case_1_2", option, text.format(file=file), "--out", tmp_path / "out")
    [line] = err.splitlines()
    assert code == 2 and said in line and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_run_with_a_contact_of_ones_own_is_repeated_from_its_folder(file, call, tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.comparisons.remedies.remedies", lambda *_: "")  # which walks many times
    typed = [word for change in SHORT for word in ("--set", change)]
    touch = ["--disturbance", "LinkWrench", "--set", "own.disturbances.0.values.force=[0, 0, 9]"]
    code, _, err = call("run", "case_1_2", *typed, *touch, "--contact", f"{file}:weak", "--out", tmp_path / "out")
    assert code == 1, err  # half a newton holds nothing
    assert "contact: grip.py:weak" in err and "disturbances.0: LinkWrench" in err
    told = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())["own"]["contact"]
    assert (told["file"], told["name"]) == ("inputs/contact/grip.py", "weak") and len(told["digest"]) == 64
    first = json.loads((tmp_path / "out" / "metrics.json").read_text())
    (tmp_path / "out").rename(tmp_path / "moved")
    file.unlink()
    call("run", tmp_path / "moved" / "config.yaml", "--out", tmp_path / "again")
    assert json.loads((tmp_path / "again" / "metrics.json").read_text()) == first
    assert first["detached_limb"] is not None
    copy = tmp_path / "moved" / "inputs" / "contact" / "grip.py"
    copy.write_text(copy.read_text() + "# new\n")
    code, _, err = call("run", tmp_path / "moved" / "config.yaml", "--out", tmp_path / "third")
    assert code == 2 and "own.contact.digest: expected " in err


def test_a_search_under_another_contact_is_another(file, tmp_path):
    def identity(contact):
        return parts.identity_of(walk(contact=contact).load())

    first = identity(f"{file}:weak")
    parts.Parts(tmp_path, first)
    parts.Parts(tmp_path, identity(f"{file}:weak"))
    for other, differs in ((f"{file}:pole", r"scenario\.own\.contact\.name"), (None, "scenario")):
        with pytest.raises(OutputError, match=f"another that differs in {differs}"):
            parts.Parts(tmp_path, identity(other))
    file.write_text(TEXT.replace("0.5", "0.6"))
    with pytest.raises(OutputError, match=r"scenario\.own\.contact"):
        parts.Parts(tmp_path, identity(f"{file}:weak"))


def test_config_yaml_keeps_the_digest_where_a_config_gave_none(file, tmp_path):
    own = {"contact": {"file": str(file), "name": "pole"}}
    written = write_config(mc.Scenario().with_overrides({"own": own}), tmp_path / "out")
    assert written.own.contact.digest == scenario_files.digest(file)


def test_a_copy_of_a_file_is_the_same_class_and_old_files_are_forgotten(file, tmp_path):
    copy = tmp_path / "copy.py"
    copy.write_text(file.read_text())
    made = [
        own_parameters(mc.Scenario().with_overrides({"own": {"contact": {"file": str(each), "name": "pole"}}})).contact
        for each in (file, copy)
    ]
    assert type(made[0]) is type(made[1])
    for n in range(70):
        copy.write_text(f"found = {n}")
        assert own_objects.load(f"{copy}:found", "law")[0] == n
    assert len(own_objects.RUN) == 64 and own_objects.RUN[-1][0].found == 69


def test_a_plan_of_a_log_refuses_other_drives(call, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text(yaml.safe_dump({"own": {"drive": ALL["drive"]}}))
    code, _, err = call("excite", config)
    [line] = err.splitlines()
    assert code == 2 and "own.drive: expected none with excite, got VelocityCommanded" in line


@pytest.mark.nightly
def test_a_polyhedron_that_holds_is_as_stable_as_the_gripper_in_it():
    """The linearised loop knows no limits: contacts are those of the same springs and dampers."""
    scenario = mc.load_scenario("case_1_2", ["control.controller=pd"])
    own = scenario.with_overrides({"own": {"contact": ALL["contact"]}})
    gripper, polyhedron = (spectral_radius(one, {"kp": 50.0, "kd": 0.2}) for one in (scenario, own))
    np.testing.assert_allclose(polyhedron, gripper, rtol=1e-9)
