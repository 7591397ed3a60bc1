"""What an executable on disk is found by: all that it depends on, and nothing that only this process knows."""

import dataclasses
from pathlib import Path

import pytest

import mjx_climb as mc

HEXAPOD = mc.load_scenario("hexapod_ceiling")


@pytest.fixture
def model_of(tmp_path):
    """Return the digest of the hexapod from a file that lies elsewhere, and says something else."""

    def digest(name, old="armature", new="armature", engine="limb"):
        text = Path(HEXAPOD.robot.file).read_text()
        assert old in text
        place = tmp_path / name / "hexapod.xml"
        place.parent.mkdir()
        place.write_text(text.replace(old, new))
        own = HEXAPOD.model_copy(update={"robot": HEXAPOD.robot.model_copy(update={"file": str(place)})})
        return mc.Simulation(own, engine=engine).structure.model

    return digest


@pytest.mark.parametrize("engine", mc.ENGINES)
def test_a_robot_is_known_by_what_its_file_says(model_of, engine):
    """And not by where it lies, or by an object of one process: another would compile its programs again."""
    assert model_of("one", engine=engine) == model_of("two", engine=engine)


@pytest.mark.parametrize(
    ("old", "new"),
    [('mass="0.06"', 'mass="0.07"'), ('range="-70 100"', 'range="-70 90"'), ('armature="0.004"', 'armature="0.005"')],
)
def test_another_robot_is_another(model_of, old, new):
    assert model_of("one") != model_of("other", old, new)


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
