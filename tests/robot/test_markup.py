"""A robot's file as text: its elements by another parser, comments, includes, and the lines of names and numbers."""

import math
import re
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.robot_import.bodies import beginning
from mjx_climb.robot_import.description import described, impossible, one_limit
from mjx_climb.robot_import.markup import (
    check_numbers,
    elements,
    fixed_by_limits,
    is_urdf,
    line_of,
    lines_of,
    needed,
    text_of,
    urdf_limits,
)


def written(draw, depth=0):
    """Text of a random element: attributes with brackets in them, some elements without an end tag."""
    tag = str(draw.choice(["link", "joint", "a", "b-c"]))
    attributes, quotes = "", ("'{}'", '"{}"')
    for key, value in (("name", "x>y"), ("of", "1 2"), ("ü", "é")):
        if draw.random() < 0.5:
            attributes += f" {key}" + str(draw.choice(["=", " = "])) + str(draw.choice(quotes)).format(value)
    space = str(draw.choice(["", "\n", " text ", "<!-- a <b> -->"]))
    if draw.random() < 0.4 or depth > 3:
        return f"<{tag}{attributes}" + str(draw.choice(["", " ", "\n"])) + "/>" + space
    inside = space + "".join(written(draw, depth + 1) for _ in range(draw.integers(0, 4)))
    return f"<{tag}{attributes}>{inside}</{tag}" + str(draw.choice(["", " "])) + ">" + space


@pytest.mark.parametrize("seed", range(20))
def test_elements_are_those_of_another_parser(seed):
    text = f"<root>{written(np.random.default_rng(seed))}</root>"
    found, root = elements(text), ET.fromstring(text)
    parents = {child: parent for parent in root.iter() for child in parent}
    every = list(root.iter())
    assert [(each.tag, each.attributes) for each in found] == [(each.tag, dict(each.attrib)) for each in every]
    assert [each.parent for each in found] == [every.index(parents[e]) if e in parents else -1 for e in every]
    data = text.encode()
    for each, other in zip(found, every, strict=True):
        own = ET.fromstring(data[each.begin : each.end].decode())
        assert [part.tag for part in own.iter()] == [part.tag for part in other.iter()]
        assert each.line == data[: each.begin].count(b"\n") + 1
    assert elements(text + "<open>") == []


def test_comments_go_and_their_lines_stay(tmp_path):
    file = tmp_path / "robot.urdf"
    file.write_text(
        "<?xml version='1.0'?>\n<!-- <mujoco>\n a\n b -->\n<robot name='r'><!-- c --><link name='l'/></robot>\n"
    )
    assert text_of(str(file)) == "<?xml version='1.0'?>\n\n\n\n<robot name='r'><link name='l'/></robot>\n"
    assert is_urdf(str(file)) and text_of(str(tmp_path / "none")) == "" and not is_urdf(str(tmp_path / "none"))
    assert line_of(str(file), "l") == f"{file}:5" and line_of(str(file), "nobody") == str(file)
    for head, urdf in (
        ("<!DOCTYPE x>\n< robot>", True),
        ("<mujoco model='robot'>", False),
        ("<robot:x>", False),
        ("", False),
    ):
        file.write_text(head)
        assert is_urdf(str(file)) == urdf, head


JOINTS = """<robot name="r"><transmission><joint name="t"/></transmission><link name="base"><visual>
<geometry/><material name="m"/></visual><sensor/></link>
<joint name="a" type="continuous"><parent link="base"/><limit lower="-1" upper = '1' effort="2"/><safety/></joint>
<joint name="b" type="{kind}"><parent
link="odom"/><child link="base"/><limit lower="0.5" upper="0.5" effort="x"/></joint>
<joint name="c" type="revolute"><limit lower="-2" upper="2"/></joint></robot>"""


@pytest.mark.parametrize(("kind", "world"), [("floating", True), ("planar", True), ("revolute", False)])
def test_a_urdf_keeps_its_lines_and_what_the_dynamics_need(kind, world, tmp_path):
    text = needed(JOINTS.format(kind=kind))
    assert text.count("\n") == JOINTS.count("\n")
    for gone in ("transmission", "material", "sensor", "safety"):
        assert gone not in text
    root = ET.fromstring(text)
    limits = {
        each.get("name"): each.find("limit").attrib for each in root.iter("joint") if each.find("limit") is not None
    }
    assert limits["a"] == {"effort": "2"} and limits["c"] == {"lower": "-2", "upper": "2"}
    (parent,) = (each.find("parent").get("link") for each in root.iter("joint") if each.get("name") == "b")
    types = {each.get("name"): each.get("type") for each in root.iter("joint")}
    assert parent == ("world" if world else "odom") and types["b"] == ("revolute" if not world else "floating")
    assert [each.get("name") for each in root.iter("link")].count("world") == world
    file = tmp_path / "r.urdf"
    file.write_text(JOINTS.format(kind=kind))
    assert urdf_limits(str(file), "lower") == {"b": 0.5, "c": -2.0} and urdf_limits(str(file), "effort") == {"a": 2.0}
    assert fixed_by_limits(str(file)) == {"b": 0.5}
    file.write_text(JOINTS.format(kind=kind).replace('lower="-2" upper="2"', 'lower="1" upper="1"'))
    assert fixed_by_limits(str(file)) == {}  # all of them: nobody gave a limit
    file.write_text(JOINTS.format(kind=kind).replace("robot", "mujoco"))
    assert urdf_limits(str(file), "lower") == {}
    assert needed("no xml <") == "no xml <" and needed('<robot><link name="world"/></robot>').count("world") == 1


def test_lines_of_files_that_are_included_stand_in_their_places(tmp_path):
    (tmp_path / "parts").mkdir()
    main, leg, foot = tmp_path / "robot.xml", tmp_path / "parts" / "leg.xml", tmp_path / "parts" / "foot.xml"
    main.write_text(
        '<mujoco>\n<worldbody>a<include file="parts/leg.xml"/>b\n</worldbody>\n'
        '<include file="parts/leg.xml" >\n</include></mujoco>'
    )
    leg.write_text(
        '<?xml?>\n<mujocoinclude>\n<body name="leg"/><include file="foot.xml"></include>\n'
        '<include file="leg.xml"/></mujocoinclude>'
    )
    foot.write_text('<site name="foot"/>')
    found = lines_of(main)
    text = "".join(text for _, text in found)
    assert text.count('<body name="leg"/>') == 1 and text.count('<site name="foot"/>') == 1
    assert "?xml" not in text and "mujocoinclude" not in text and text.startswith("<mujoco>")
    places = dict((text, place) for place, text in found)
    assert places['<body name="leg"/>'] == f"{leg}:3" and places['<site name="foot"/>'] == f"{foot}:1"
    assert places["b"] == f"{main}:2" and lines_of(tmp_path / "none.xml") == []
    assert line_of(str(main), "foot") == f"{foot}:1" and line_of(str(main), "leg") == f"{leg}:3"
    # a circle, each twice: it ends, and what is wrong is told in its line
    main.write_text('<mujoco>\n<include file="parts/leg.xml"/>\n<include file="./parts/leg.xml"/></mujoco>')
    leg.write_text('<mujocoinclude>\n<include file="../robot.xml"/><body name="leg" pos="1e9 0 0"/></mujocoinclude>')
    assert [place for place, text in lines_of(main) if "leg" in text] == [f"{leg}:2", f"{leg}:2"]
    with pytest.raises(mc.RobotError, match=rf"^{leg}:2: body 'leg': body pos: expected numbers of up to 10000"):
        described(str(main))
    main.write_text("<mujoco>\n<a joint='hip'/>\n<b name='hip'/>\n<joint armature='1'\nname = 'hip'/></mujoco>")
    assert line_of(str(main), "hip") == f"{main}:5"  # the element itself
    main.write_text("<mujoco>\n<a joint='hip'/>\n<b name='hip'/></mujoco>")
    assert line_of(str(main), "hip") == f"{main}:3"
    main.write_text("<mujoco>\n<a joint='hip'/></mujoco>")
    assert line_of(str(main), "hip") == f"{main}:2"


@pytest.mark.parametrize(("attribute", "said"), [
    ('pos="1 1e4 0"', None), ('pos="1 1.01e4 0"', "body 'b': body pos: expected numbers of up to 10000, got 1.01e4"),
    ('quat="1e9 0 0 0"', None), ('quat="1.1e9 0 0 0"', "body quat: expected numbers of up to 1e+09, got 1.1e9"),
    ('range="0 1e300"', None), ('range="0 nan"', "body 'b': body range: expected numbers of up to inf, got nan"),
    ('other="1e300"', None), ('pos="a b"', None), ('euler="inf 0 0"', "expected numbers of up to 1e+09, got inf"),
])  # fmt: skip
def test_numbers_that_no_robot_has_are_refused_where_they_stand(attribute, said, tmp_path):
    file = tmp_path / "robot.xml"
    file.write_text(f"<mujoco>\n<worldbody><body\n name='b' {attribute}/></worldbody></mujoco>")
    if said is None:
        check_numbers(str(file))
        return
    with pytest.raises(mc.RobotError, match=f"^{re.escape(str(file))}:2: .*{re.escape(said)}$"):
        check_numbers(str(file))
    for inside in ("<inertial mass='1e10'/>", "<body name='inner'/><inertial mass='1e10'/>"):
        file.write_text(f"<mujoco>\n<body name='far'><body name='outer'>{inside}</body></body></mujoco>")
        with pytest.raises(
            mc.RobotError, match=r"robot.xml:2: body 'outer': inertial mass: expected numbers of up to 1"
        ):
            check_numbers(str(file))


# ------------------------------------------------------------------------------------------------------- description


@pytest.mark.parametrize(("lower", "upper", "limit"), [
    (-2.0, 3.0, 2.0), (-3.0, 2.0, 2.0), (1.0, 3.0, 3.0), (-3.0, -1.0, 3.0), (0.0, 2.0, 2.0), (-2.0, 0.0, 2.0),
])  # fmt: skip
def test_a_torque_limit_is_the_smaller_of_two_ways_or_that_of_the_one_way(lower, upper, limit):
    assert one_limit(lower, upper) == limit


def test_bodies_that_cannot_exist_are_found_by_their_principal_moments():
    spec, draw = mujoco.MjSpec(), np.random.default_rng(0)
    body, seen = spec.worldbody.add_body(name="b"), set()
    body.explicitinertial, body.mass = True, 1.0
    for _ in range(60):
        moments = draw.uniform(0.1, 2.0, 3) * draw.choice([1.0, 1e-13])
        axes = np.linalg.qr(draw.normal(size=(3, 3)))[0]
        full = axes @ np.diag(moments) @ axes.T
        body.fullinertia = full[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        low, middle, high = sorted(moments)
        expected = high > 1e-14 and low + middle < (1 - 1e-6) * high
        seen.add(expected)
        assert impossible(body) == expected
    assert seen == {True, False}
    for share in (1 - 3e-6, 1 - 0.3e-6):  # of what a body can have, to rounding
        body.fullinertia = [0.5, 0.5 * share, 0.5 + 0.5, 0, 0, 0]
        assert impossible(body) == (share < 1 - 2e-6)
    body.explicitinertial = False
    assert not impossible(body)


def test_parts_without_names_are_called_after_those_that_have_them(tmp_path):
    file = tmp_path / "robot.xml"
    file.write_text("""<mujoco><worldbody><body name="trunk"><freejoint/><geom size="1"/>
      <body><joint axis="0 0 1"/><geom size="1"/><body><joint type="slide"/><geom size="1"/></body></body>
      <body name="trunk_2_"><joint name="trunk_2"/><geom size="1"/></body>
      <body><joint type="ball" range="0 0.4" damping="0.1" stiffness="3" armature="0.02" pos="0.1 0 0.2"/>
      <geom size="1"/></body></body></worldbody>
      <actuator><motor joint="trunk_3" gear="2 0 3" ctrlrange="-1 1"/></actuator></mujoco>""")
    with pytest.raises(mc.RobotError, match=r"robot.xml:6: .*actuators of joints in the file, got one of 'trunk_3'"):
        described(str(file))
    file.write_text(
        file.read_text().replace('<joint type="ball"', '<joint name="hip" type="ball"').replace('"trunk_3"', '"hip"')
    )
    spec = described(str(file))
    assert [body.name for body in spec.bodies] == ["world", "trunk", "trunk_1", "trunk_1_1", "trunk_2_", "trunk_3"]
    joints = {joint.name: joint for joint in spec.joints}
    assert {*joints} == {"trunk_free", "trunk_1", "trunk_1_1", "trunk_2", "hip_x", "hip_y", "hip_z"}
    for letter, axis in zip("xyz", np.eye(3), strict=True):
        hinge = joints[f"hip_{letter}"]
        np.testing.assert_array_equal(hinge.axis, axis)
        assert hinge.type == mujoco.mjtJoint.mjJNT_HINGE and np.ravel(hinge.damping)[0] == pytest.approx(0.1)
        np.testing.assert_allclose(hinge.range, [-0.4, 0.4])
        np.testing.assert_allclose([np.ravel(hinge.stiffness)[0], hinge.armature, *hinge.pos], [3, 0.02, 0.1, 0, 0.2])
    drives = {each.target: each for each in spec.actuators}
    assert {*drives} == {"hip_x", "hip_z"} and drives["hip_z"].gear[0] == 3 and drives["hip_x"].gear[0] == 2
    np.testing.assert_allclose(drives["hip_x"].ctrlrange, [-1, 1])


WRONG = {
    'range="0.5 -0.5"': "expected limits in ascending order, got 0.5 to -0.5",
    'armature="-1"': "armature of zero or more",
    'damping="-0.1"': "damping of zero or more, got -0.1", 'frictionloss="-2"': "frictionloss of zero or more, got -2",
    'stiffness="-3"': "stiffness of zero or more, got -3",
    'range="0 inf"': "expected finite limits, or none, got 0 to inf",
}  # fmt: skip


@pytest.mark.parametrize("attribute", WRONG)
def test_numbers_that_no_joint_can_have_are_refused(attribute, tmp_path):
    file = tmp_path / "robot.xml"
    text = (
        '<mujoco><compiler angle="radian"/><worldbody>\n<body name="b">\n<joint name="hip" {}/><geom size="1"/></body>'
    )
    text += "</worldbody></mujoco>"
    file.write_text(text.format(attribute))
    with pytest.raises(mc.RobotError, match=f"robot.xml:3: joint 'hip': .*{WRONG[attribute]}"):
        described(str(file))
    off = attribute + ' limited="false"'
    file.write_text(text.format(off))
    if attribute == 'range="0.5 -0.5"':
        assert described(str(file)).joint("hip").name == "hip"
    else:
        with pytest.raises(mc.RobotError):
            described(str(file))


@pytest.mark.parametrize(("inertial", "fine"), [
    ('mass="1" diaginertia="1 1 1"', True), ('mass="-1" diaginertia="1 1 1"', False),
    ('mass="1" diaginertia="1 1 -1"', False),
    ('mass="1" fullinertia="1 1 1 0 0 0"', True), ('mass="1" fullinertia="1 1 1 0 nan 0"', False),
    ('mass="0" diaginertia="0 0 0"', True),
])  # fmt: skip
def test_bodies_have_masses_and_moments_of_zero_or_more(inertial, fine, tmp_path):
    file = tmp_path / "robot.xml"
    file.write_text(
        f'<mujoco><worldbody>\n<body name="b"><inertial pos="0 0 0" {inertial}/></body></worldbody></mujoco>'
    )
    if fine:
        assert not math.isnan(described(str(file)).body("b").mass)
    else:
        with pytest.raises(mc.RobotError, match=r"robot.xml:2: "):
            described(str(file))


@pytest.mark.parametrize(("names", "head"), [
    ([["a", "b"], ["a", "b", "c"]], ["a", "b"]), ([["a"], ["b"]], []), ([["a", "b", "c"], ["a", "x", "c"]], ["a"]),
    ([["a", "b"]], ["a", "b"]),
])  # fmt: skip
def test_names_begin_with_the_words_that_all_of_them_have(names, head):
    assert beginning(names) == head
