"""What a kept program is known by: all that it depends on, and nothing that only this process knows."""

from pathlib import Path

import pytest

import mjx_climb as mc
from mjx_climb.robot.constants import load_robot
from mjx_climb.rollouts.identity import of_robot

ROBOT = mc.load_scenario("hexapod_ceiling").robot


@pytest.fixture
def own(tmp_path):
    """Give the hexapod from a file that lies elsewhere, and says something else."""

    def make(name, old="armature", new="armature"):
        text = Path(ROBOT.file).read_text()
        assert old in text
        place = tmp_path / name / "hexapod.xml"
        place.parent.mkdir()
        place.write_text(text.replace(old, new))
        return ROBOT.model_copy(update={"file": str(place)})

    return make


def test_a_robot_is_known_by_what_its_file_says(own):
    """And not by where it lies, or by an object of one process: another would compile its programs again."""
    one, same = own("one"), own("same")
    assert load_robot(one).model is not load_robot(same).model
    assert of_robot(one) == of_robot(same)


@pytest.mark.parametrize(
    ("old", "new"),
    [('mass="0.06"', 'mass="0.07"'), ('range="-70 100"', 'range="-70 90"'), ('armature="0.004"', 'armature="0.005"')],
)
def test_another_robot_is_another(own, old, new):
    assert of_robot(own("one")) != of_robot(own("other", old, new))
