"""Proposals, whole: every section and note, against texts that were read and computed by hand."""

import os
from pathlib import Path

import pytest

from tests import approved
from tests.robot import climbers
from tests.robot.test_proposal import dog, driving, six_limbs
from tuning.proposal.propose import propose

MOTORS = "".join(f'<motor joint="L{n}_{k}"/>' for n in range(4) for k in range(3))
SPRING = 'stiffness="1.5" springref="20" damping="0.1" armature="0.002" frictionloss="0.03"'
ROBOTS = {
    "dog": (dog, {}),
    "six_limbs": (six_limbs, {"gravity": 1.62}),
    "passive_ankles": (lambda: driving(climbers.mjcf(4, 4), MOTORS), {}),
    "springs_of_its_own": (lambda: driving(climbers.mjcf(4, 4, attributes=SPRING), MOTORS), {}),
    "biped": (lambda: climbers.mjcf(2, 7), {}),
    "biped_that_turns_its_feet": (lambda: climbers.mjcf(2, 3, reach=0.6), {}),
    "sliding": (lambda: climbers.mjcf(4, 3, slides=(2,)), {"stand_on": ["L0", "L1", "L3"]}),
    "in_millimetres": (lambda: climbers.mjcf(4, 3, reach=12.0).replace('mass="0.15"', 'mass="1e-3"'), {}),
}


SLOW = {"six_limbs"}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in ROBOTS])
def test_a_proposal_is_the_one_that_was_read(name, saved):
    text, how = ROBOTS[name]
    file = saved(text(), "robot.urdf" if name == "six_limbs" else "robot.xml")
    found = propose(file, **how)
    assert found.sections["robot"].pop("file") == os.path.abspath(file)
    lines = [*approved.of_json(found.sections), *(" | ".join(note) for note in found.notes), ""]
    approved.check(Path(__file__).parent / "approved" / f"{name}.txt", "\n".join(lines))
