"""What an executable on disk is found by: all that it depends on, and nothing that only this process knows."""

import dataclasses
from pathlib import Path

import pytest

import mjx_climb as mc
from mjx_climb.execution.contents import identity
from mjx_climb.inputs.time_step import growth

HEXAPOD = mc.load_scenario("hexapod_ceiling")


@pytest.fixture
def model_of(tmp_path):
    """Return the robot that a walk of the hexapod is compiled for, from a file elsewhere with something replaced."""

    def robot(name, old="armature", new="armature", engine="limb"):
        text = Path(HEXAPOD.robot.file).read_text()
        assert old in text
        place = tmp_path / name / "hexapod.xml"
        place.parent.mkdir(exist_ok=True)
        place.write_text(text.replace(old, new))
        own = HEXAPOD.model_copy(update={"robot": HEXAPOD.robot.model_copy(update={"file": str(place)})})
        return mc.Simulation(own, engine=engine).structure.robot

    return robot


@pytest.mark.parametrize("engine", mc.ENGINES)
def test_a_robot_is_known_by_what_its_file_says(model_of, engine):
    """And not by where it lies, or by an object of one process: another would compile its programs again."""
    one, two = model_of("one", engine=engine), model_of("two", engine=engine)
    assert one == two and hash(one) == hash(two) and identity(one) == identity(two)


@pytest.mark.parametrize(
    ("old", "new"),
    [('mass="0.06"', 'mass="0.07"'), ('range="-70 100"', 'range="-70 90"'), ('armature="0.004"', 'armature="0.005"')],
)
@pytest.mark.parametrize("place", ["one", "other"])
def test_another_robot_is_another(model_of, old, new, place):
    """Also where a file is edited in place while the program runs."""
    one, other = model_of("one"), model_of(place, old, new)
    assert one != other and identity(one) != identity(other)


def test_an_edited_file_that_a_robots_file_includes_is_read_again(tmp_path):
    """In the same process, under the same name; so is what was computed of the old one: how fast it shakes."""
    text = Path(HEXAPOD.robot.file).read_text()
    begin, end = text.index("<default"), text.rindex("</default>") + len("</default>")
    (tmp_path / "hexapod.xml").write_text(text[:begin] + '<include file="defaults.xml"/>' + text[end:])
    own = HEXAPOD.model_copy(update={"robot": HEXAPOD.robot.model_copy(update={"file": str(tmp_path / "hexapod.xml")})})

    def growth_with(armature):
        defaults = text[begin:end].replace('armature="0.004"', f'armature="{armature}"')
        (tmp_path / "defaults.xml").write_text(f"<mujocoinclude>{defaults}</mujocoinclude>")
        return mc.Simulation(own).structure.robot.armature.max(), growth(own, 0.02)

    (before, slow), (after, fast) = growth_with(0.004), growth_with(0.04)
    assert (before, after) == pytest.approx((0.004, 0.04)) and slow != fast


def test_code_of_ones_own_is_known_by_its_content(case):
    scenario = case("case_1_2", "pd")
    law = mc.Simulation(scenario).law
    mine = dataclasses.replace(mc.METRICS["travel"], name="mine", finish=lambda running, _: running[1][0])
    other = dataclasses.replace(mine, finish=lambda running, _: running[1][1])

    class Own(type(law)):
        pass

    own = [mc.Simulation(scenario, Own())] + [mc.Simulation(scenario, metrics=(metric,)) for metric in (mine, other)]
    assert len({simulation.structure.own_code for simulation in own} - {""}) == 3
    for shipped in (mc.Simulation(scenario), mc.Simulation(scenario, law, smooth=True, engine="mjx")):
        assert shipped.structure.own_code == ""
