"""A pipe that is given as a file of some kind is refused: nobody may ever write to it."""

import os
import threading

import pytest

import mjx_climb as mc
from mjx_climb.ground import holds_of
from mjx_climb.ground.height_map import grid_of
from mjx_climb.ground.readers import table_of
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.robot_import.description import described
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
