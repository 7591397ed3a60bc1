"""`mjx-climb robot`: one plain robot, and what exporters write beside it or in other ways."""

import re

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.robot_import.bodies import robot_in
from tests.robot.test_proposal import dog, told
from tests.robot.test_robot_file import robot_of
from tuning.proposal.limbs import Found
from tuning.proposal.propose import propose

AXES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
LIMITS_OF = '<limit lower="{}" upper="{}" effort="2" velocity="5"/>'


def weighed(mass, moment, middle=0.0):
    inertia = "".join(f'{axes}="{moment if axes[1] == axes[2] else 0}" ' for axes in AXES)
    return f'<inertial><origin xyz="{middle} 0 0"/><mass value="{mass}"/><inertia {inertia}/></inertial>'


def plain_urdf(of_trunk="", of_feet='type="fixed">', foot="foot", at=0.12, shape=""):
    """Return a URDF of four limbs of three joints, 0.24 m long, with a foot `at` m from the knee."""
    parts = [f'<link name="trunk">{weighed(1.2, 5e-3)}</link>', of_trunk]
    for name, (x, y) in {"LF": (1, 1), "LH": (-1, 1), "RH": (-1, -1), "RF": (1, -1)}.items():
        for joint, parent, child, place, axis, limits in (
            ("yaw", "trunk", f"{name}_coxa", f"{0.08 * x} {0.06 * y} 0", "0 0 1", (-1, 1)),
            ("lift", f"{name}_coxa", f"{name}_femur", "0.04 0 0", "0 1 0", (-1.5, 1.5)),
            ("knee", f"{name}_femur", f"{name}_tibia", "0.08 0 0", "0 1 0", (-0.5, 2.5)),
        ):
            turn = np.arctan2(0.06 * y, 0.08 * x) if joint == "yaw" else 0
            looks, middle = (shape, 0.05) if joint == "knee" else ("", 0.0)
            parts.append(
                f'<link name="{child}">{weighed(0.1, 1e-4, middle)}{looks}</link>\n'
                f'<joint name="{name}_{joint}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
                f'<origin xyz="{place}" rpy="0 0 {turn}"/><axis xyz="{axis}"/>{LIMITS_OF.format(*limits)}</joint>'
            )
        ends = f'<parent link="{name}_tibia"/><child link="{name}_{foot}"/><origin xyz="{at} 0 0"/>'
        parts.append(f'<link name="{name}_{foot}"/><joint name="{name}_ankle" {of_feet}{ends}</joint>')
    return "<robot name='plain'>" + "\n".join(parts) + "</robot>"


@pytest.fixture(scope="module")
def plain_stance(tmp_path_factory):
    """The section of a scenario for a plain robot, without its file's name."""
    file = tmp_path_factory.mktemp("plain") / "plain.urdf"
    file.write_text(plain_urdf())
    section = propose(file).sections["robot"]
    return {key: value for key, value in section.items() if key != "file"}


LOOK = '<visual><geometry><box size="1 1 1"/></geometry>{}</visual>'


@pytest.mark.parametrize(
    "beside",
    [
        LOOK.format('<material name="silver"/><material/>'),
        LOOK.format('<material name="silver"><color rgba="1 0"/></material>'),
    ],
)
def test_looks_that_mujoco_refuses_are_left_out(saved, beside):
    """A second material, one without all its colours: a robot's looks are not needed."""
    text = plain_urdf().replace("</inertial></link>", f"</inertial>\n{beside}</link>", 1)
    text = text.replace("</robot>", "<transmission/><gazebo reference='x'><link name='trunk'/></gazebo></robot>")
    limbs = Found(saved(text, "seen.urdf")).limbs
    assert limbs == Found(saved(plain_urdf(), "plain.urdf")).limbs


@pytest.mark.parametrize(("kind", "root"), [("floating", "base_link"), ("planar", "odom")])
def test_a_base_that_floats_as_the_file_says(saved, plain_stance, kind, root):
    """Below a link of any name without a mass, at any place: the robot is that of a file that begins at its trunk."""
    joint = f'<joint name="free" type="{kind}"><parent\nlink="{root}"/><child link="trunk"/></joint>'
    text = plain_urdf(of_trunk=f'<link name="{root}">{LOOK.format("")}</link>{joint}')
    assert propose(file := saved(text, "free.urdf")).sections["robot"] == plain_stance | {"file": str(file)}
    broken = text.replace('<child link="RF_tibia"/>', '<child link="nobody"/>')
    line = broken[: broken.index("nobody")].count("\n") + 1
    with pytest.raises(mc.RobotError, match=f"free.urdf:{line}: "):
        propose(saved(broken, "free.urdf"))


@pytest.mark.parametrize(
    ("kind", "limits", "middle"),
    [
        ("revolute", (0, 0), 0.0),
        ("revolute", (0, 0.006), 0.003),
        ("prismatic", (-1e-4, 1e-4), 0.0),
    ],
)
def test_a_joint_of_hardly_any_range_is_held(saved, plain_stance, kind, limits, middle):
    """As a foot's force sensor is written: at its middle, with a word, and the foot at the limb's end."""
    text = plain_urdf(of_feet=f'type="{kind}">{LIMITS_OF.format(*limits)}')
    proposal = propose(saved(text, "sensors.urdf"))
    section = proposal.sections["robot"]
    assert section["limbs"] == plain_stance["limbs"] and section["height"] == plain_stance["height"]
    assert section["locked"] == {f"{limb}_ankle": middle for limb in section["limbs"]}
    assert "changed joint 'LF_ankle' its limits are" in told(proposal) and f"held at {middle:g}" in told(proposal)
    assert robot_of(proposal.sections | {"time_step": 1e-4}).joints == 3


def test_limits_that_nobody_gave(saved):
    """Continuous joints have none, whatever stands there; nor does a file whose joints all go from 0 to 0."""
    feet = f'type="continuous">{LIMITS_OF.format(0, 0)}'
    limbs = Found(saved(plain_urdf(of_feet=feet), "wheels.urdf")).limbs
    assert [chain.joints for chain in limbs.values()] == [tuple(range(4 * n, 4 * n + 4)) for n in range(4)]
    text = re.sub('lower="[^"]*" upper="[^"]*"', 'lower="0" upper="0"', plain_urdf())
    assert "changed limits of 12 joints the file has none" in told(propose(saved(text, "blank.urdf")))
    turns = plain_urdf().replace("revolute", "continuous")
    assert not robot_in(str(saved(turns, "turns.urdf"))).jnt_limited.any()


GONE_MESH = '<visual><geometry><mesh filename="package://any/tibia.stl"/></geometry></visual>'


@pytest.mark.parametrize(
    ("foot", "at", "end"),
    [("screw", 0.02, ("tibia", 0.1)), ("imu", 0.02, ("tibia", 0.1)), ("strut", 0.12, ("strut", 0.0))],
)
def test_a_link_that_is_not_called_a_foot_is_a_guess(saved, foot, at, end):
    """One near the knee is passed over, one about where weights have the end is taken: either way it is said."""
    robot = Found(saved(plain_urdf(foot=foot, at=at, shape=GONE_MESH), "robot.urdf"))
    assert (robot.limbs["LF"].foot, robot.limbs["LF"].at) == (f"LF_{end[0]}", (end[1], 0.0, 0.0))
    assert f"changed ends of last links not in the file ('LF_{end[0]}'" in told(robot)


@pytest.mark.parametrize("foot", ["pad", "LegTip", "paw", "suction_cup", "endeffector"])
def test_a_foot_by_other_names(saved, foot):
    robot = Found(saved(plain_urdf(foot=foot, shape=GONE_MESH), "robot.urdf"))
    assert robot.limbs["LF"].foot == f"LF_{foot}" and "guessed" not in told(robot)


def finger(limb, parent):
    ends = f'<parent link="{limb}_{parent}"/><child link="{limb}_claw"/><origin xyz="0.1 0 0"/><axis xyz="0 1 0"/>'
    joint = f'<joint name="{limb}_finger" type="revolute">{ends}{LIMITS_OF.format(-1, 1)}</joint>'
    return f'<link name="{limb}_claw">{weighed(0.01, 1e-6)}</link>{joint}'


@pytest.mark.parametrize("limbs", [("LF",), ("LF", "LH", "RH", "RF")])
@pytest.mark.parametrize("parent", ["tibia", "foot"])
def test_a_finger_beyond_a_foot_is_no_joint_of_the_limb(saved, plain_stance, limbs, parent):
    """One is not told from a further link of the limb by itself; nor does one limb's make it another than the rest."""
    fingers = "".join(finger(limb, parent) for limb in limbs)
    proposal = propose(saved(plain_urdf().replace("</robot>", f"{fingers}</robot>"), "hand.urdf"))
    assert proposal.sections["robot"]["limbs"] == plain_stance["limbs"]
    assert proposal.sections["robot"]["locked"] == {f"{limb}_finger": 0.0 for limb in limbs}


@pytest.mark.parametrize(("kind", "one", "other"), [("joint", "LF_yaw", "LH_yaw"), ("link", "LF_coxa", "LH_coxa")])
def test_two_of_one_name_are_refused_with_both_lines(saved, kind, one, other):
    text = plain_urdf()
    lines = [text[: text.index(f'<{kind} name="{name}"')].count("\n") + 1 for name in (one, other)]
    expected = f"twice.urdf:{lines[1]}: expected one {kind} '{one}', got another in line {lines[0]}"
    with pytest.raises(mc.RobotError, match=expected):
        propose(saved(text.replace(other, one), "twice.urdf"))


@pytest.mark.parametrize(("old", "new", "said"), [
    ('(xyz|rpy)="([0-9.-]+) ([0-9.-]+) 0"', r'\1="\g<2>e3 \g<3>e3 0"', "lengths a limb is 240 m long: units"),
    ('mass value="([^"]*)"', r'mass value="\g<1>e3"', "masses 6.1e.04 kg in each cubic metre .*: units"),
    ('(lower|upper)="([^"]*)"', r'\1="\g<2>e1"', "limits of 12 joints up to 30 rad apart, as if they were degrees"),
])  # fmt: skip
def test_other_units_are_suspected(saved, old, new, said):
    notes = propose(saved(re.sub(old, new, plain_urdf()), "units.urdf")).notes
    warnings = [f"{note.what} {note.why}" for note in notes if note.kind == "warning"]
    assert any(re.search(said, each) for each in warnings), warnings


def test_an_inertia_of_something_larger_is_told_by_its_radius_of_gyration(saved):
    """1 kg m^2 of 0.1 kg: 3.16 m, in limbs of 0.24 m; those of the same file that fit its size go without a word."""
    text = plain_urdf()
    assert "radius of gyration" not in told(propose(saved(text, "robot.urdf")))
    knee = text.index('name="RF_tibia"')
    proposal = propose(saved(text[:knee] + text[knee:].replace('"0.0001"', '"1"', 3), "robot.urdf"))
    radius = "1 kg m^2 with 0.1 kg, a radius of gyration of 3.16 m"
    assert f"warning inertia of 'RF_tibia' {radius}; a limb is" in told(proposal)
    start = text.index('name="RF_')
    several = propose(saved(text[:start] + text[start:].replace('"0.0001"', '"1"', 6), "robots.urdf"))
    assert re.search(rf"{re.escape(radius)}, as of 1 others; a limb is", told(several))


def test_a_file_with_y_up(saved, plain_stance):
    """The advice is a link with z up, which makes it the robot that it is; it is no robot of two limbs."""
    text = re.sub(
        r'xyz="(\S+) (\S+) 0" rpy="0 0 (\S+)"/><axis xyz="0 0 1"',
        lambda m: f'xyz="{m[1]} 0 {-float(m[2])}" rpy="0 {m[3]} 0"/><axis xyz="0 1 0"',
        plain_urdf(),
    )
    turned = text.replace('axis xyz="0 1 0"/><limit lower="-1.5"', 'axis xyz="0 0 -1"/><limit lower="-1.5"')
    turned = turned.replace('axis xyz="0 1 0"/><limit lower="-0.5"', 'axis xyz="0 0 -1"/><limit lower="-0.5"')
    with pytest.raises(mc.RobotError, match=r"expected a base link whose z axis is up, got .trunk. .* about its y"):
        propose(saved(turned, "robot.urdf"))
    root = '<link name="up"/><joint name="up" type="fixed"><parent link="up"/><child link="trunk"/>'
    upright = turned.replace("</robot>", f'{root}<origin rpy="{np.pi / 2} 0 0"/></joint></robot>')
    section = propose(saved(upright, "robot.urdf"), base="up").sections["robot"]
    assert (section["limbs"], section["height"]) == (plain_stance["limbs"], plain_stance["height"])
    robot = Found(saved(upright, "robot.urdf"))
    assert robot.model.body(robot.base).name == "up"


def test_legs_that_hang_along_another_axis(saved):
    """As a dog's whose file has y up."""
    text = re.sub(r' (pos|axis)="(\S+) (\S+) (\S+)"',
                  lambda m: f' {m[1]}="{m[2]} {m[4]} {-float(m[3]):g}"', dog())  # fmt: skip
    text = re.sub(r"<keyframe>.*?</keyframe>", "", text, flags=re.DOTALL)
    with pytest.raises(mc.RobotError, match="z axis is up, got 'trunk' with limbs that hang along its -y"):
        propose(saved(text))


@pytest.mark.parametrize(
    ("angles", "said"),
    [
        ("0 0.9 -1.8 0 0.9 -1.8 0 1.4 -2.7 0 1.4 -2.7", "not level below it"),
        ("0 3.4 -0.84 0 3.4 -0.84 0 3.4 -0.84 0 3.4 -0.84", "not level below it"),
        ("0 0.9 -1.8 0 0.9 -1.8 0 1.0 -1.9 0 1.0 -1.9", ""),
    ],
)
def test_a_keyframe_is_a_stance_where_its_feet_are_level_below_the_base(saved, angles, said):
    """Others, as of a robot that lies folded, are passed over with a word; small differences are told."""
    text = dog().replace("0 0.9 -1.8 " * 4, angles + " ", 1)
    proposal = propose(saved(text))
    line = "ignored keyframe 'home' no stance: its feet are at heights" if said else "taken stance of keyframe 'home'"
    assert line in told(proposal)
    assert ("changed stance searched" in told(proposal)) == bool(said)
    assert said or "between their heights" in told(proposal)
