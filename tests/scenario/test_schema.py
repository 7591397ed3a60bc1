"""The schema for editors: it takes what the loader takes, and refuses what the loader refuses."""

import ast
import contextlib
import importlib.util
import inspect
import io
import json
import re
from pathlib import Path

import jsonschema
import pytest
import yaml

import mjx_climb as mc
from tuning.command_line import main

CONFIGS = Path(__file__).parents[2] / "configs"
PAGES = [CONFIGS.parent / "docs" / "guides" / f"{name}.md" for name in ("scenario", "robot", "hardware_keys")]
BLOCKS = [block for page in PAGES for block in re.findall(r"```yaml\n(.*?)```", page.read_text(), re.DOTALL)]
CASES = ["case_1_1", "case_1_2", "case_2"]
LIMB = {"joints": ["a", "b", "c"], "foot": "d", "foothold": [0.1, 0.1]}
ROBOT = {"file": "robot.urdf", "height": 0.1, "limbs": dict.fromkeys(("LF", "LH", "RH", "RF"), LIMB)}


@pytest.fixture(scope="module")
def schema():
    with contextlib.redirect_stdout(io.StringIO()) as out, pytest.raises(SystemExit) as ended:
        main(["doctor", "--schema"])
    assert ended.value.code == 0
    tree = json.loads(out.getvalue())
    jsonschema.Draft202012Validator.check_schema(tree)
    return jsonschema.Draft202012Validator(tree)


@pytest.mark.parametrize("text", [*BLOCKS, *((CONFIGS / f"{case}.yaml").read_text() for case in CASES)])
def test_shipped_configs_and_every_example_of_the_how_to_are_valid(schema, text):
    schema.validate(yaml.safe_load(mc.Scenario.from_yaml(text).to_yaml()))


def test_the_page_of_the_keys_has_each_with_its_meaning():
    spec = importlib.util.spec_from_file_location("keys", CONFIGS.parent / "docs" / "hooks" / "keys.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = module.on_page_markdown((CONFIGS.parent / "docs" / "reference" / "scenario.md").read_text())
    rows = dict(re.findall(r"^\| `([\w.]+)` \| .* \| (.*) \|$", text, re.MULTILINE))
    models = mc.Scenario.model_json_schema()["$defs"].values()
    known = {name for model in models for name in model.get("properties", ())}
    assert known <= {key.rpartition(".")[2] for key in rows} and "hardware.servo.register_scale.p" in rows
    assert all(rows.values()) and module.MARK not in text


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"robot": ROBOT},
        {"ground": {"footholds": {"LF": [0.0, 0.1]}}},
        {"ground": {"map": {"file": "map.csv", "resolution": 0.01}}},
        {"control": {"damping": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]}},
        {"gait": {"sequence": [["LF", "RH"], ["LH", "RF"]], "duty": 0.5}},
        {"robot": ROBOT | {"limbs": {"arm": LIMB, "leg": LIMB}}, "gait": {"phases": {"arm": 0.0, "leg": 0.5}}},
    ],
)
def test_what_loads_is_valid(schema, data):
    mc.Scenario.from_yaml(json.dumps(data))
    schema.validate(data)


@pytest.mark.parametrize(
    "data",
    [
        {"gravty": [0, 0, -9.81]},
        {"gait": {"duty": 1.5}},
        {"gait": {"sequence": ["LF"]}},
        {"robot": ROBOT | {"limbs": {}}},
        {"robot": {"file": "robot.urdf"}},
        {"control": {"damping": [1.0, 2.0]}},
        {"control": {"controller": "pid"}},
        {"time_step": -1},
    ],
)
def test_what_does_not_load_is_invalid(schema, data):
    with pytest.raises(mc.ConfigError, match=r"^walk: "):
        mc.Scenario.from_yaml(json.dumps(data), "walk")
    assert not schema.is_valid(data)


def test_every_key_is_described(schema):
    """Each key of each section has a sentence that an editor can show."""
    for name, section in [*schema.schema["$defs"].items(), ("Scenario", schema.schema)]:
        for key, value in section.get("properties", {}).items():
            assert value.get("description"), f"{name}.{key}"


def test_type_checkers_know_the_keywords_of_a_scenario():
    nodes = ast.walk(ast.parse(inspect.getsource(mc.Scenario)))
    (init,) = [node for node in nodes if isinstance(node, ast.FunctionDef) and node.name == "__init__"]
    assert [argument.arg for argument in init.args.kwonlyargs] == [*mc.Scenario.model_fields]
