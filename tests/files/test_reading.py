"""A pipe that is given as a file is refused: nobody may ever write to it. An edited file is read again."""

import os
import threading

import pytest

import mjx_climb as mc
from mjx_climb.ground import holds_of
from mjx_climb.ground.height_map import grid_of
from mjx_climb.ground.readers import table_of
from mjx_climb.inputs.file_contents import digest
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.robot_import.description import described
from mjx_climb.robot_import.load import load_robot
from tuning.identification.readers.formats import record


def swing(file):
    return own_parameters(mc.Scenario.from_yaml(f"gait: {{swing_file: {{file: {file}}}}}"))


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("grid.csv", grid_of),
        ("grid.npy", grid_of),
        ("grid.png", grid_of),
        ("points.csv", table_of),
        ("swing.txt", swing),
        ("robot.xml", described),
        ("log.csv", record),
        ("log.mcap", record),
    ],
)
def test_a_pipe_is_refused_in_one_line(name, read, tmp_path):
    os.mkfifo(path := tmp_path / name)
    said = []

    def reading():
        try:
            read(str(path))
        except ValueError as error:
            said.append(str(error))

    reader = threading.Thread(target=reading, daemon=True)
    reader.start()
    reader.join(20)
    if reader.is_alive():
        # it waits for a writer
        os.close(os.open(path, os.O_WRONLY))
        pytest.fail("waits")
    (line,) = said
    assert line.startswith(f"{path}: ") and "expected" in line and "\n" not in line


def test_a_map_or_a_cloud_of_holds_that_is_edited_is_read_again(tmp_path):
    """In the same process, under the same name; one that is not is read once."""
    grid, points = tmp_path / "grid.csv", tmp_path / "points.csv"
    ground = mc.Scenario.from_yaml(f"ground: {{holds: {{cloud: {{file: {points}}}}}}}").ground
    for height in (0.0, 0.25):
        grid.write_text(f"0,0,{height}\n0,0,0\n")
        points.write_text(f"x,y,z\n0,0,{height}\n1,0,0\n")
        assert grid_of(str(grid)).max() == height
        assert holds_of(ground).position[:, 2].max() == height
        assert grid_of(str(grid)) is grid_of(str(grid)) and holds_of(ground) is holds_of(ground)


CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
FACES = "1 2 4|1 4 3|5 7 8|5 8 6|1 5 6|1 6 2|3 4 8|3 8 7|1 3 7|1 7 5|2 6 8|2 8 4".split("|")
WEIGHED = """<mujoco><compiler {compiler}/>{assets}<worldbody><body name="rod">
  <joint name="swing" axis="0 1 0"/><geom type="mesh" mesh="rod"/></body></worldbody></mujoco>"""
MESHES = {  # name in the robot's file, its compiler, and where MuJoCo finds the mesh
    "above": ("../rod.obj", "", "rod.obj"),
    "absolute": ("{folder}/far/rod.obj", "", "far/rod.obj"),
    "meshdir": ("rod.obj", 'meshdir="../meshes"', "meshes/rod.obj"),
    "path stripped": ("of/author/rod.obj", 'meshdir="../meshes" strippath="true"', "meshes/rod.obj"),
    "beside the include": ("rod.obj", "", "robot/parts/rod.obj"),
    "below the include": ("meshes/rod.obj", "", "robot/parts/meshes/rod.obj"),
}


@pytest.mark.parametrize("where", MESHES)
def test_a_robot_whose_mesh_is_edited_is_read_again(where, tmp_path):
    name, compiler, place = MESHES[where]
    assets, robot, mesh = f'<asset><mesh name="rod" file="{name}"/></asset>', tmp_path / "robot", tmp_path / place
    (robot / "parts").mkdir(parents=True)
    mesh.parent.mkdir(parents=True, exist_ok=True)
    if "include" in where:
        (robot / "parts" / "rod.xml").write_text(f"<mujocoinclude>{assets}</mujocoinclude>")
        assets = '<include file="parts/rod.xml"/>'
    text = WEIGHED.format(compiler=compiler, assets=assets).replace("{folder}", str(tmp_path))
    (robot / "rod.xml").write_text(text)
    config = {"robot": {"file": str(robot / "rod.xml"), "limbs": {"rod": {"joints": ["swing"]}}}}
    scenario, found = mc.Scenario().with_overrides(config), []
    for second, width in enumerate((0.1, 0.2)):
        corners = [" ".join(str(width * each) for each in corner) for corner in CORNERS]
        mesh.write_text("".join(f"{kind} {row}\n" for kind, rows in (("v", corners), ("f", FACES)) for row in rows))
        os.utime(mesh, (second, second))
        found.append((load_robot(scenario.robot).total_mass, digest(robot / "rod.xml")))
    assert found[0][0] < found[1][0] and found[0][1] != found[1][1]
