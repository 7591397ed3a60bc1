"""Rigid parts of a file: bodies whose joints are held, or that have none, belong to the body that they are fixed to."""

import mujoco
import pytest

from mjx_climb.robot_import.bodies import rigid_parts

FILE = """<mujoco><worldbody><body name="base"><freejoint/><geom size="1"/>
  <body name="a"><geom size="1"/><body name="b"><geom size="1"/><body name="c"><joint name="held"/><geom size="1"/>
    <body name="d"><joint name="turns"/><geom size="1"/><body name="e"><geom size="1"/></body></body></body></body>
  </body></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("held", "parts"), [((), [0, 1, 1, 1, 4, 5, 5]), (("held",), [0, 1, 1, 1, 1, 5, 5]),
                                             (("held", "turns"), [0, 1, 1, 1, 1, 1, 1])])  # fmt: skip
def test_a_chain_of_fixed_bodies_is_one_part(held, parts):
    model = mujoco.MjModel.from_xml_string(FILE)
    assert rigid_parts(model, {model.joint(name).id for name in held}).tolist() == parts
