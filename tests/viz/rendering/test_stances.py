"""Pictures of robots in their rest stance: grey levels of a grid of blocks against those of pictures that were seen."""

import os
from pathlib import Path

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.viz import rendering
from mjx_climb.viz.rendering import backend
from tests.robot import climbers
from tests.robot.test_proposal import dog
from tuning.proposal.propose import propose

APPROVED = Path(__file__).parent / "approved_stances.txt"
BLOCK = 25  # pixels
NEAR = 4  # grey levels of 256: machines shade otherwise
TRUNK = '<geom type="box" size="0.05 0.05 0.02" rgba="1 0.6 0.2 1"/>'


def springs(file):
    """Return a robot of four joints a limb, of which one is on a spring, and one foot beside its link."""
    file.write_text(climbers.mjcf(4, 4, on_base=TRUNK))
    sections = climbers.config(file, 4, 4)
    sections["robot"]["springs"] = {f"L{n}_3": {"stiffness": 4.0, "rest": -0.6} for n in range(4)}
    sections["robot"]["limbs"]["limb2"]["at"] = [0.03, 0.0, 0.01]
    return sections["robot"]


def held(file):
    """Return a robot one of whose limbs is held."""
    file.write_text(dog())
    return propose(file).sections["robot"]


@pytest.mark.slow
@pytest.mark.parametrize("made", [springs, held])
def test_a_stance_is_drawn_as_it_was_seen(made, tmp_path):
    try:
        backend.find()
    except rendering.RenderingError as error:
        pytest.skip(str(error))
    section = made(tmp_path / "robot.xml")
    robot = mc.Scenario.model_validate({"robot": section, "gait": {"sequence": list(section["limbs"])}}).robot
    picture = rendering.stance(robot)
    blocks = picture.mean(-1).reshape(600 // BLOCK, BLOCK, 800 // BLOCK, BLOCK).mean((1, 3))
    texts = dict(part.split("\n", 1) for part in APPROVED.read_text().split("--- ")[1:]) if APPROVED.exists() else {}
    if os.environ.get("APPROVE"):
        texts[made.__name__] = "\n".join(" ".join(f"{value:.0f}" for value in row) for row in blocks) + "\n"
        APPROVED.write_text("".join(f"--- {name}\n{text}" for name, text in sorted(texts.items())))
    known = np.array([row.split() for row in texts[made.__name__].splitlines()], float)
    np.testing.assert_allclose(blocks, known, atol=NEAR)
