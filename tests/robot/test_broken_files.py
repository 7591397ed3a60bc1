"""Two hundred broken robot files: each is refused in one line that says where and which element, exit code 2."""

import re

import pytest

import mjx_climb as mc
from tests.robot import climbers
from tests.robot.test_robot_file import urdf
from tuning.proposal.propose import propose

MJCF = climbers.mjcf(4, 3).replace("><", ">\n<")
URDF = urdf(1)[0].replace("><", ">\n<")


QUICK = ("L1_2", "RH_knee")

# what to change, from the line on in which the element stands
OF_JOINTS = {
    "an axis of no length": (r'axis="[^"]*"', 'axis="0 0 0"'),
    "an axis of two numbers": (r'axis="[^"]*"', 'axis="0 1"'),
    "a word for a number": (r'range="[^"]*"', 'range="low high"'),
    "limits the wrong way round": (r'range="[^"]*"', 'range="60 -60"'),
    "no such kind": (r'type="[^"]*"', 'type="cube"'),
    "an unknown key": (r'type="[^"]*"', 'kind="hinge"'),
    "a negative armature": (r'type="', 'armature="-1" type="'),
    "an element left open": (r"/>", ">"),
    "a weight below nothing": (r'mass="[^"]*"', 'mass="-0.2"'),
    "a weight in words": (r'mass="[^"]*"', 'mass="light"'),
    "half a weight": (r'mass="[^"]*"', ""),
    "moments below nothing": (r'diaginertia="[^"]*"', 'diaginertia="-1e-4 1e-4 1e-4"'),
    "no number": (r'mass="[^"]*"', 'mass="nan"'),
}
OF_LINKS = {
    "no parent": (r'parent link="[^"]*"', 'parent link="nobody"'),
    "no child": (r'child link="[^"]*"', 'child link="nobody"'),
    "an axis of no length": (r'axis xyz="[^"]*"', 'axis xyz="0 0 0"'),
    "a word in a place": (r'origin xyz="[^"]*"', 'origin xyz="here"'),
    "limits the wrong way round": (r'lower="[^"]*" upper="[^"]*"', 'lower="1" upper="-1"'),
    "limits in words": (r'lower="[^"]*"', 'lower="low"'),
    "no such kind": (r'type="[^"]*"', 'type="bendy"'),
    "an element left open": (r"/>", ">"),
}
BROKEN = {
    f"{name}, {what}": (suffix, text, name, *change)
    for suffix, text, names, changes in (
        ("xml", MJCF, [f"L{limb}_{joint}" for limb in range(4) for joint in range(3)], OF_JOINTS),
        ("urdf", URDF, [f"{limb}_{joint}" for limb in ("LF", "RH") for joint in ("yaw", "lift", "knee")], OF_LINKS),
    )
    for name in names
    for what, change in changes.items()
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if row[2] in QUICK else pytest.mark.slow) for name, row in BROKEN.items()],
)
def test_a_broken_file_is_refused_in_one_line(saved, ended, name):
    """The line is that of the element or the one after, or names it."""
    suffix, text, element, old, new = BROKEN[name]
    before, rest = re.split(rf'(?=<joint name="{element}")', text, maxsplit=1)
    changed, count = re.subn(old, new, rest, count=1)
    file = saved(before + changed, f"robot.{suffix}")
    code, out, line = ended(file)
    assert count and code == 2 and line.count("\n") == 1 and not out, (out, line)
    place = re.search(rf"{re.escape(str(file))}:(\d+)", line)
    assert place, line
    assert element in line or 0 <= int(place[1]) - 1 - before.count("\n") <= 8, line


LIMB = '<mujoco>\n<body name="x">\n<joint name="bad" axis="0 0 z"/>\n</body>\n</mujoco>'
PART = MJCF.replace("<worldbody>", '<worldbody>\n<include file="part.xml"/>')
TWICE = URDF.replace('<link name="LF_toe"/>', '<link name="LF_hip"/>')
AGAIN = TWICE[: TWICE.rindex('<link name="LF_hip"/>')].count("\n") + 1
NAN = re.sub('mass value="[^"]*"', 'mass value="nan"', urdf(0)[0], count=1)
GONE = MJCF.replace("</mujoco>", '<actuator>\n<motor joint="gone"/></actuator></mujoco>')
MESH = MJCF.replace("<worldbody>", '<asset>\n<mesh name="m" file="gone.stl"/></asset><worldbody>')
WEIGHS = MESH.replace("<freejoint/>", '<freejoint/><body><geom type="mesh" mesh="m"/></body>')
POSED = MJCF.replace("</mujoco>", f'<keyframe>\n<key name="home" qpos="inf {"0 " * 18}"/></keyframe></mujoco>')
TABLE = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
NOWHERE = MJCF.replace("-20 100", "80 81").replace("-150 10", "-1 0")
WRONG = {  # text of the robot's file, where it is and what is said, and text of part.xml
    "in an included file": (PART, r"part.xml:3: .*'axis'", LIMB),
    "limits in an included file": (
        PART, r"part.xml:3: joint 'bad': expected limits", LIMB.replace("0 0 z", '0 0 1" range="2 1'),
    ),
    "a weight in an included file": (
        PART, r"part.xml:4: .*negative", LIMB.replace('axis="0 0 z"/>', '/>\n<geom size="1" mass="-1"/>'),
    ),
    "another alphabet": (MJCF.replace("trunk", "tr\xfcnk").encode("latin-1"), r"t.xml:\d+: expected names in UTF-8"),
    "a weight that is no number": (NAN, r"t.urdf:1: link 'trunk': .*nan"),
    "limits without end": (MJCF.replace("-20 100", "-20 inf", 1), r"t.xml:\d+: joint 'L0_1': expected finite"),
    "a motor of no joint": (GONE, r"t.xml:\d+: .*'gone'"),
    "a name of two lines": (MJCF.replace('"L0_1"', '"L0\n1"'), r"t.xml:\d+: expected a name of one printable"),
    "a place without end": (MJCF.replace('pos="0.075', 'pos="1e308', 1), r"t.xml:\d+: body 'L0_0': .* got 1e308"),
    "a site nowhere": (MJCF.replace('pos="0.15', 'pos="nan', 1), r"t.xml:\d+: .*: expected numbers of .* got nan"),
    "a far link": (URDF.replace('xyz="0.', 'xyz="1e39', 1), r"t.urdf:\d+: link .* origin xyz: .*up to 10000, got 1e39"),
    "a stance of infinite angles": (POSED, r"t.xml:\d+: key 'home': key qpos: expected .* got inf"),
    "a number in an included file": (PART, r"part.xml:3: joint 'bad': .* got inf", LIMB.replace("0 0 z", "0 0 inf")),
    "a macro": ('<robot name="r">\n<xacro:leg/></robot>', r"t.urdf:2: .*written out, got <xacro:leg>"),
    "two of a name": (TWICE, rf"t.urdf:{AGAIN}: expected one link .LF_hip., got another in line 76"),
    "a mesh that weighs": (WEIGHS, r"t.xml:\d+: .*gone.stl"),
    "another kind": ("<sdf/>", r"t.sdf: expected a file whose name ends in .xml or .urdf"),
    "empty": ("", r"t.xml: expected an MJCF or URDF that MuJoCo loads"),
    "no robot": ("<mujoco/>", r"t.xml: expected a robot, got a file without bodies"),
    "a table": (TABLE, r"t.xml: expected 2 limbs or more"),
    "nowhere to stand": (NOWHERE, r"t.xml: expected a stance"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_told_where_it_stands(saved, tmp_path, name):
    text, expected, *part = WRONG[name]
    for included in part:
        saved(included, "part.xml")
    with pytest.raises(mc.RobotError) as refused:
        propose(saved(text, f"robot.{re.search(r'[.]([a-z]+)', expected)[1]}"))
    assert "\n" not in str(refused.value) and str(refused.value).startswith(str(tmp_path))
    assert re.search(expected, str(refused.value)), refused.value
