"""Results can be repeated from their folder alone: a user's robot and height map go along."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.robot_import.description import bare
from mjx_climb.robot_import.load import load_robot
from mjx_climb.terrain import foothold_heights
from tests.robot.test_robot_file import keys, urdf
from tuning import scenario_files
from tuning.command_line import main

MESH = "v 0 0 0\nv 0.02 0 0\nv 0 0.02 0\nv 0 0 0.02\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def config(tmp_path):
    """Return a config with a URDF robot and a height map, each named relative to it."""
    folder = tmp_path / "mine"
    (folder / "maps").mkdir(parents=True)
    text, reach = urdf(0)
    (folder / "robot.urdf").write_text(text)
    (folder / "maps" / "rock.csv").write_text("0,0.002\n0.004,0\n")
    data = keys("robot.urdf", reach) | {
        "duration": 0.02, "time_step": 1e-4, "gait": {"cycle": 0.4, "stride": 0.01},
        "ground": {"map": {"file": "maps/rock.csv", "resolution": 2.0, "origin": [-1.0, -1.0]}},
    }  # fmt: skip
    path = folder / "walk.yaml"
    path.write_text(json.dumps(data))
    return path


def kept(scenario, folder):
    """Write what a command keeps of its scenario_files."""
    scenario = scenario_files.copied(scenario, folder)
    dataset.write_text_atomically(folder / "config.yaml", scenario_files.portable_yaml(scenario, folder))
    return scenario


def test_a_folder_with_copies_can_be_moved(config, tmp_path):
    scenario = mc.load_scenario(config)
    robot, heights = load_robot(scenario.robot), foothold_heights(scenario, load_robot(scenario.robot))
    made = kept(scenario, tmp_path / "out")
    assert kept(mc.load_scenario(tmp_path / "out" / "config.yaml"), tmp_path / "out") == made  # repeated in place
    xarray = xr.Dataset({"x": 1.0}, attrs={"scenario": made.to_yaml()})
    dataset.save(xarray, tmp_path / "out" / "made.nc")
    moved = (tmp_path / "out").rename(tmp_path / "moved")
    shutil.rmtree(config.parent)
    assert str(tmp_path) not in (moved / "config.yaml").read_text()
    again = mc.load_scenario(moved / "config.yaml")
    assert Path(again.robot.file) == moved / "inputs" / "robot" / "robot.urdf"
    assert Path(again.ground.map.file) == moved / "inputs" / "ground" / "rock.csv"
    np.testing.assert_array_equal(load_robot(again.robot).link_inertia, robot.link_inertia)
    np.testing.assert_array_equal(foothold_heights(again, robot), heights)
    assert again.with_files(lambda key, _: key) == scenario.with_files(lambda key, _: key)
    loaded = dataset.load(moved / "made.nc")  # a dataset names the files beside it
    assert str(tmp_path) not in loaded.attrs["scenario"]
    assert Path(dataset.scenario_of(loaded).robot.file) == moved / "inputs" / "robot" / "robot.urdf"


def test_an_mjcf_takes_includes_and_meshes_with_a_weight_along(tmp_path):
    """The copy loads without what is only to be looked at, a mesh on a body whose inertia is written down."""
    mine = tmp_path / "mine"
    inertia = "<inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/><geom type='mesh' mesh='looks'/>"
    for name, text in {
        "meshes/rock.obj": MESH,
        "meshes/looks.obj": MESH,
        "models/arm.xml": f"<mujoco><worldbody><body name='arm'>{inertia}</body></worldbody></mujoco>",
        "models/robot.xml": "<mujoco><compiler meshdir='../meshes'/><asset><mesh name='rock' file='rock.obj'/>"
        "<mesh name='looks' file='looks.obj'/></asset><include file='arm.xml'/><worldbody><body>"
        "<geom type='mesh' mesh='rock'/></body></worldbody></mujoco>",
    }.items():
        dataset.write_text_atomically(mine / name, text)
    _, reach = urdf(0)
    scenario = mc.Scenario.model_validate(keys(mine / "models" / "robot.xml", reach))
    copy = Path(scenario_files.copied(scenario, tmp_path / "out").robot.file)
    shutil.rmtree(mine)
    assert copy == tmp_path / "out" / "inputs" / "robot" / "models" / "robot.xml"
    assert [path.name for path in (tmp_path / "out").rglob("*.obj")] == ["rock.obj"]
    assert bare(str(copy)).compile().nmesh == 1


def test_a_scenario_without_files_keeps_nothing(tmp_path):
    scenario = mc.Scenario()
    assert scenario_files.copied(scenario, tmp_path / "out") == scenario
    assert not (tmp_path / "out").exists()
    assert scenario_files.portable_yaml(scenario, tmp_path) == scenario.to_yaml()
    assert scenario_files.identity(scenario) == yaml.safe_load(scenario.to_yaml())


def test_identity_is_of_the_contents_not_of_the_place(config, tmp_path):
    scenario = mc.load_scenario(config)
    before = scenario_files.identity(scenario)
    copy = scenario_files.copied(scenario, tmp_path / "out")
    assert scenario_files.identity(copy) == before
    Path(copy.ground.map.file).write_text("0,0.002\n0.004,0.001\n")
    assert scenario_files.identity(copy) != before


@pytest.mark.slow
def test_a_run_is_repeated_from_its_folder(config, tmp_path):
    def run(source, out):
        with pytest.raises(SystemExit) as ended:
            main(["run", str(source), "--controller", "pd", "--out", str(out)])
        assert ended.value.code == 0
        return json.loads((out / "metrics.json").read_text())

    first = run(config, tmp_path / "out")
    moved = (tmp_path / "out").rename(tmp_path / "moved")
    shutil.rmtree(config.parent)
    again = run(moved / "config.yaml", tmp_path / "again")
    assert again == first
    walk = dataset.load_trajectory(moved / "trajectory.nc")
    assert load_robot(walk.scenario.robot).limbs == walk.limbs


def test_every_file_that_a_scenario_names_goes_along():
    """Whatever section names it: paths are changed in all of them, and back."""
    own = {
        "law": {"file": "law.py", "name": "Law"},
        "metrics": [{"file": "one.py", "name": "one"}, {"file": "two.py", "name": "two"}],
        "objective": {"file": "objective.py", "name": "judge"},
    }
    kinds = {
        "contact.kind": "grip.py:Grip",
        "hardware.servo.kind": "drive.py:Drive",
        "disturbance.others": [{"kind": "link_wrench"}, {"kind": "wind.py:Wind"}],
        "gait.footholds": {"kind": "rule.py:Rule", "reach": 0.2},
    }
    ground = {"file": "map.csv", "resolution": 0.01, "origin": [0.0, 0.0]}
    scenario = mc.Scenario().with_overrides({"own": own, "ground.map": ground, **kinds})
    asked = {}
    scenario.with_files(lambda key, file: asked.setdefault(key, file))
    names = ["drive", "grip", "law", "objective", "one", "rule", "two", "wind"]
    assert sorted(asked.values()) == sorted([*(f"{name}.py" for name in names), "map.csv"])
    beside = scenario.beside("/there")
    assert beside.to_yaml().count("/there/") == 9 and beside.gait.footholds.reach == 0.2
    assert beside.relative_to("/there") == scenario
