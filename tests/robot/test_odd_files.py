"""What robots' files may hold that their authors meant otherwise than a quick reader takes it."""

import re

import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.checks.time_step import growth
from mjx_climb.robot.constants import load_model
from mjx_climb.robot.description import bare, compiled, described, driven_joints
from mjx_climb.robot.limbs import Found, rerooted
from mjx_climb.robot.proposal import propose
from tests.robot import climbers
from tests.robot.test_robot_file import robot_of, urdf

PLAIN = climbers.mjcf(4, 3).replace("><", ">\n<")
FEET = re.compile(r'<site name="foot\d" pos="0.15 0 0"/>')


def model_of(file):
    return compiled(str(file), bare(str(file)))


def limbs_in(file):
    """Return the limbs of a file by name, and what was noted."""
    robot = Found(file)
    return robot.limbs, " ".join(map(" ".join, robot.notes))


def driving(text, actuators):
    return text.replace("</worldbody>", f"</worldbody><actuator>{actuators}</actuator>")


@pytest.mark.parametrize(
    ("shape", "at"),
    [
        ('<frame pos="0.08 0 0"><geom type="capsule" size="0.01 0.07" euler="0 90 0"/></frame>', [0.15, 0, 0]),
        ('<geom type="box" size="0.07 0.01 0.01" pos="0.08 0 0"/>', [0.15, 0, 0]),
        ('<body pos="0.1 0 0"><geom type="box" size="0.02 0.03 0.01" pos="0.03 0 0"/></body>', [0.15, 0, 0]),
        ("", [0.15, 0.004, 0]),
    ],
)
def test_a_limb_ends_where_its_shape_does(saved, shape, at):
    """In a frame, turned by angles, in a part welded on: where MuJoCo has the shape; an end that is guessed is told."""
    limbs, told = limbs_in(saved(FEET.sub(shape, PLAIN)))
    for limb in limbs.values():
        np.testing.assert_allclose(limb.at, at, atol=1e-5)
    assert ("ends of last links not in the file" in told) == ("ends" in told) == (not shape)


def stl(points):
    """Return a mesh with these corners, (4, 3) m: a tetrahedron."""
    faces = [np.array([np.zeros(3), *(points[n] for n in face)], "<f4").tobytes() for face in
             ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0))]  # fmt: skip
    return b"\0" * 80 + np.uint32(4).tobytes() + b"".join(face + b"\0\0" for face in faces)


PRONGS = np.array([[0, 0, 0.01], [0, 0.01, 0], [0.15, 0, 0.02], [0.15, 0, -0.02]])


@pytest.mark.parametrize("kind", ["collision", "visual"])
@pytest.mark.parametrize("folder", ["meshes", "any_description/meshes", "urdf/gone"])
def test_a_limb_of_a_urdf_ends_where_its_mesh_does(saved, kind, folder):
    """Between the two prongs that reach farthest, scaled and turned; without the file a guess, as it says."""
    saved(stl(PRONGS * [1, 1, 0.1]), f"{folder}/shin.stl")
    mesh = '<mesh filename="package://any_description/meshes/shin.stl" scale="1 1 10"/>'
    shape = f'<{kind}><origin xyz="0 0 0.01" rpy="0 0 1.2"/><geometry>{mesh}</geometry></{kind}></link>'
    text = re.sub(r'<link name="\w+_toe"/>|<joint name="\w+_ankle".*?</joint>', "", urdf(1)[0])
    text = re.sub(r'(<link name="\w+_shank">.*?)</link>', rf"\1{shape}", text)
    limbs, told = limbs_in(saved(text, "urdf/robot.urdf"))
    there = folder != "urdf/gone"
    for limb in limbs.values():
        end = [0.15 * np.cos(1.2), 0.15 * np.sin(1.2), 0.01]
        assert (np.linalg.norm(np.subtract(limb.at, end)) < 1e-5) == there
    assert (f"{kind} mesh 'shin' of 'LF_shank'" in told) == there and ("guessed" in told) != there


def test_a_mesh_of_an_mjcf_and_one_that_is_none(saved):
    """A wheel's rim counts for its middle; a file that is no mesh is passed over, and said."""
    shape = '<geom type="mesh" mesh="shin" pos="0.01 0 0"/><geom type="cylinder" size="0.02 0.01" pos="0.1 0 0"/>'
    text = FEET.sub(shape, PLAIN).replace("<worldbody>", '<asset><mesh file="shin.stl"/></asset>\n<worldbody>')
    text = text.replace("<compiler", '<compiler meshdir="looks"')
    for mesh, at in ((stl(PRONGS), [0.16, 0, 0]), (b"solid nothing", [0.1, 0, 0])):
        saved(mesh, f"{len(mesh)}/looks/shin.stl")
        limbs, told = limbs_in(saved(text, f"{len(mesh)}/robot.xml"))
        np.testing.assert_allclose(limbs["L0"].at, at, atol=1e-5)
        assert ("ignored meshes of the last links" in told) == (at[0] == 0.1)


def test_joints_driven_in_any_way(saved):
    """By a motor, one in the parent's frame, a tendon: not the fourth limb's last. A ball joint's drive its hinges."""
    tendons = "".join(f'<fixed name="t{n}"><joint joint="L{n}_2" coef="2"/></fixed>' for n in range(3))
    motors = "".join(f'<motor joint="L{n}_0"/><motor jointinparent="L{n}_1"/>' for n in range(4))
    motors += "".join(f'<motor tendon="t{n}"/>' for n in range(3))
    text = driving(PLAIN, motors).replace("</worldbody>", f"</worldbody><tendon>{tendons}</tendon>")
    joints = {f"L{n}_{k}" for n in range(4) for k in range(3)}
    assert driven_joints(described(str(saved(text)))) == joints - {"L3_2"}
    ball = re.sub(r'<joint name="L0_1"[^>]*>', '<joint name="L0_1" type="ball"/>', PLAIN)
    text = driving(ball, '<motor joint="L0_1" gear="0 1 0"/><motor joint="L0_1" gear="0 0 2"/>')
    assert driven_joints(described(str(saved(text)))) == {"L0_1_y", "L0_1_z"}


LIMITS = {
    '<motor joint="{}" forcerange="-3 2"/>': 2,  # the smaller of two
    '<motor joint="{}" forcerange="0 2" gear="-4"/>': 8,  # one that pulls
    '<motor joint="{}" forcelimited="false" forcerange="-1 1"/>': None,
    '<motor joint="{}" ctrllimited="false" ctrlrange="-1 1"/>': None,
    '<motor joint="{0}" ctrlrange="-1 1" gear="2"/><motor jointinparent="{0}" forcerange="-3 3"/>': 5,  # in sum
    '<motor joint="{0}" forcerange="-3 3"/><velocity joint="{0}" kv="1"/>': None,
}


def test_torque_limits_of_actuators(saved):
    """Those in force, of all actuators of a joint together."""
    motors = "".join(motor.format(f"L{n // 3}_{n % 3}") for n, motor in enumerate(LIMITS))
    model = model_of(saved(driving(PLAIN, motors)))
    for n, limit in enumerate(LIMITS.values()):
        joint = model.joint(f"L{n // 3}_{n % 3}").id
        assert bool(model.jnt_actfrclimited[joint]) == (limit is not None)
        assert limit is None or model.jnt_actfrcrange[joint, 1] == limit


def test_small_and_bounded_weights_are_mujocos(saved):
    """Inertias of an insect, and least ones that the file asks for, are what MuJoCo makes of the file."""
    insect, bounded = ("", "1e-6", "4e-12 4e-12 5e-12"), ('boundmass="0.2" boundinertia="1e-3"', "0.15", "0 0 0")
    for compiler, mass, inertia in (insect, bounded):
        weighed = re.sub(r'mass="[^"]*" diaginertia="[^"]*"', f'mass="{mass}" diaginertia="{inertia}"', PLAIN)
        file = saved(weighed.replace("<compiler", f"<compiler {compiler}"))
        ours, theirs = model_of(file), mujoco.MjModel.from_xml_path(str(file))
        np.testing.assert_array_equal(ours.body_mass, theirs.body_mass)
        np.testing.assert_allclose(ours.body_inertia, theirs.body_inertia, rtol=1e-12)


def test_a_file_is_what_is_in_it_whatever_its_name(saved):
    """A URDF called .xml needs no meshes, and an MJCF called .urdf has the weights of its shapes."""
    assert model_of(saved(urdf(0)[0])).nmesh == 0
    shapes = re.sub(r'<inertial pos="0.075[^>]*>', '<geom type="capsule" size="0.01" fromto="0 0 0 0.1 0 0"/>', PLAIN)
    assert model_of(saved(shapes, "robot.urdf")).body("L0_2").mass[0] > 0.01


def test_a_hand_ends_a_limb(saved):
    """Of two fingers beyond three joints; beyond two it is a fork in a limb, whose longest branch counts."""
    finger = (
        '<body name="{0}{1}" pos="0.15 0 0"><joint name="{0}{1}"/><geom size="0.01" pos="0.03 0 0"/>'
        '<inertial pos="0.02 0 0" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/></body>'
    )
    ends = iter("abcd" * 2)
    hands = lambda _: "".join(map(finger.format, [next(ends)] * 2, (0, 1)))  # noqa: E731
    for joints, expected in ((3, 3), (2, 3)):
        text = re.sub(r'<site name="foot\d" pos="[\d.]+ 0 0"/>', hands, climbers.mjcf(4, joints))
        limbs, _ = limbs_in(saved(text))
        assert [len(limb.joints) for limb in limbs.values()] == [expected] * 4


def test_a_base_that_slides_beside_a_pebble_that_floats(saved):
    slides = PLAIN.replace("<freejoint/>", '<joint name="rx" type="slide" axis="1 0 0"/>')
    pebble = '<worldbody><body name="pebble"><freejoint/><geom size="0.1"/></body>'
    robot = Found(saved(slides.replace("<worldbody>", pebble)))
    assert robot.model.body(robot.base).name == "trunk"


def test_a_file_that_begins_at_a_foot(saved):
    """Turned round it moves as before, and with its base named it is the robot whose file begins there."""
    whole = saved(climbers.mjcf(4, 3))
    model = model_of(whole)
    spec = rerooted(model, "L1_2")
    other = spec.compile()
    turned = saved(spec.to_xml(), "turned.xml")  # in six digits
    assert other.body(1).name == "L1_2"
    placed = []
    angles = np.random.default_rng(0).uniform(-0.5, 0.5, 12)
    for each in (model, other):
        data = mujoco.MjData(each)
        for n, angle in enumerate(angles):
            data.joint(f"L{n // 3}_{n % 3}").qpos[:] = angle
        mujoco.mj_kinematics(each, data)
        places = np.array([data.site("foot3").xpos, data.site("foot1").xpos, data.body("L1_2").xipos])
        placed.append((places - data.body("trunk").xpos) @ data.body("trunk").xmat.reshape(3, 3))
    np.testing.assert_allclose(*placed, atol=1e-12)
    files = ((whole, None), (turned, "trunk"))
    sections = [propose(file, base=base).sections["robot"] for file, base in files]
    assert sections[1]["base"] == "trunk" and set(sections[1]["limbs"]) == set(sections[0]["limbs"])
    ours, theirs = (robot_of(climbers.config(file, 4, 3, base=base)) for file, base in files)
    for name in ("base_mass", "link_mass", "link_inertia", "frame_position", "foot_center", "stance_joints"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-5)
    with pytest.raises(mc.RobotError, match=r"robot\.base: expected a body of the file"):
        propose(turned, base="torso")


def test_one_row_of_joints_begins_at_a_foot(saved):
    """Its base is in the middle, and what hangs on it either way are the limbs."""
    text = rerooted(model_of(saved(climbers.mjcf(2, 7))), "L0_6").to_xml()
    proposal = propose(saved(text, "worm.xml"))
    robot = proposal.sections["robot"]
    assert robot["base"] == "trunk" and "from foot to foot" in " ".join(map(" ".join, proposal.notes))
    joints = [[f"L{limb}_{joint}" for joint in range(7)] for limb in range(2)]
    assert sorted(limb["joints"] for limb in robot["limbs"].values()) == joints


def test_arms_above_legs_are_asked_for(saved, ended):
    """Two limbs start and end a way above two others: one line names them and the option, by which they are held."""
    legs, arms = (re.findall(r'<body name="L\d_0".*?</body></body></body>', climbers.mjcf(2, 3)) for _ in range(2))
    arms = [re.sub(r'"(L|foot)(\d)', r'"arm_\1\2', arm).replace('0.0 0"', '0.0 0.8"') for arm in arms]
    arms = [re.sub(r'(pos="\S+ \S+) 0"', r'\1 0.8"', arm, count=1) for arm in arms]
    trunk = climbers.mjcf(2, 3).split('<body name="L0_0"')[0]
    file = saved(trunk + "".join(legs + arms) + "</body></worldbody></mujoco>")
    with pytest.raises(mc.RobotError, match="got arm_L0, arm_L1 above L0, L1: choose with --limbs L0,L1, or"):
        propose(file)
    assert list(Found(file, stand_on=["L1", "L0"]).limbs) == ["L0", "L1"]
    code, _, error = ended(file, "--limbs", "L0,leg")
    assert code == 2 and "--limbs: expected two or more of L0, L1, arm_L0" in error


def test_what_is_told_of_a_robot_with_little_in_its_file(saved):
    """On a waist, without limits, with a short keyframe, a switched off constraint, and more that is passed over."""
    text = re.sub(r' range="[^"]*"', "", PLAIN)
    text = text.replace('<body name="trunk">\n<freejoint/>', '<body name="pelvis"><freejoint/><inertial pos="0 0 0" '
        'mass="1" diaginertia="1e-2 1e-2 1e-2"/><body name="trunk" gravcomp="1"><joint name="waist"/>')  # fmt: skip
    text = text.replace("</worldbody>", '</body></worldbody><keyframe><key name="home" qpos="0 0 1"/></keyframe>'
        '<equality><joint joint1="L0_1" joint2="L1_1" active="false"/></equality>')  # fmt: skip
    text = text.replace('joint name="L0_1"', 'joint name="L0_1" damping="0.1 0.2"')
    proposal = propose(saved(text))
    told = "\n".join(" ".join(note) for note in proposal.notes)
    for line in ("taken base 'pelvis'", "changed joint 'waist' of no limb", "ignored damping and stiffness beyond",
                 "ignored 1 keyframes not of the 20 positions", "ignored gravity compensation",
                 "changed limits of 12 joints the file has none"):  # fmt: skip
        assert line in told
    assert robot_of(proposal.sections | {"time_step": 1e-4}).base_mass == pytest.approx(2.2)


def test_the_time_step_is_short_enough_where_a_swing_ends(saved):
    """A foot that comes near its yaw axis leaves the joint little inertia: explicit damping holds for h kd < 2 I."""
    limbs = "".join(
        f'<body name="B{n}" pos="{0.15 * x} {0.15 * y} 0" euler="0 0 {turn}"><joint name="B{n}_slide" type="slide" '
        'axis="0 0 1" range="-0.08 0.08"/><inertial pos="0 0 0" mass="0.2" diaginertia="2e-4 2e-4 2e-4"/>'
        f'<body pos="0.02 0 0"><joint name="B{n}_yaw" axis="0 0 1" range="-50 50"/><inertial pos="0 0 0" mass="0.1" '
        f'diaginertia="1e-4 1e-4 1e-4"/><body pos="0.02 0 0"><joint name="B{n}_pitch" axis="0 1 0" range="0 100"/>'
        f'<inertial pos="0.1 0 0" mass="0.2" diaginertia="1e-4 8e-4 8e-4"/><site name="foot{n}" pos="0.22 0 0"/>'
        "</body></body></body>"
        for n, (x, y, turn) in enumerate(((1, 0, 0), (0, 1, 90), (-1, 0, 180), (0, -1, 270)))
    )
    hub = '<body name="hub"><freejoint/><inertial pos="0 0 0" mass="3" diaginertia="0.02 0.02 0.03"/>'
    file = saved(f"<mujoco><worldbody>{hub}{limbs}</body></worldbody></mujoco>")
    out, stride, kd = 0.051, 0.045, 6.5  # m, from the pitch axis; m; N m s/rad
    far = 0.19 + out
    limbs = {
        f"B{n}": {"joints": [f"B{n}_slide", f"B{n}_yaw", f"B{n}_pitch"], "foot": f"foot{n}", "foothold": foot}
        for n, foot in enumerate(([far, 0], [0, far], [-far, 0], [0, -far]))
    }
    scenario = mc.Scenario.model_validate({
        "robot": {"file": str(file), "height": 0.17, "limbs": limbs}, "time_step": 1e-5,
        "gait": {"sequence": list(limbs), "stride": stride}, "control": {"kp": 1600.0, "kd": kd},
    })  # fmt: skip
    model = load_model(scenario.robot)
    data, mass = mujoco.MjData(model), np.empty((model.nv, model.nv))
    data.qpos[:] = model.key_qpos[0]
    limb = next(n for n in range(4) if model.site(n).name == "B2_foot")
    data.qpos[7 + 3 * limb + 2] = np.arccos((out - stride) / 0.22)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    inertia = 1 / np.linalg.inv(mass)[6 + 3 * limb + 1, 6 + 3 * limb + 1]
    assert growth(scenario, 2.2 * inertia / kd) > 1


def test_a_held_joint_is_a_body_turned(saved):
    """Mass matrix and bias of a robot with a joint held are those of one whose body is written turned, without it."""
    arm = '<body pos="0 0 0.03"{}>{}<inertial pos="0.02 0 0.1" mass="0.4" diaginertia="1e-3 2e-3 1.5e-3"/></body>'
    held = climbers.mjcf(2, 3, on_base=arm.format("", '<joint name="mast" axis="0 1 0"/>'))
    turned = climbers.mjcf(2, 3, on_base=arm.format(f' euler="0 {np.degrees(0.7)} 0"', ""))
    rng, found = np.random.default_rng(0), []
    position, rate = rng.uniform(-0.5, 0.5, 6), rng.normal(size=12)
    with pytest.raises(mc.RobotError, match=r"robot.limbs: expected no joints but those named .*robot.locked.mast: 0"):
        robot_of(climbers.config(saved(held, "free.xml"), 2, 3))
    for name, text, locked in (("held.xml", held, {"mast": 0.7}), ("turned.xml", turned, {})):
        sections = climbers.config(saved(text, name), 2, 3, locked=locked)
        model = load_model(mc.Scenario.model_validate(sections).robot)
        data, mass = mujoco.MjData(model), np.empty((12, 12))
        data.qpos[:], data.qvel[:] = [0, 0, 0, 0.6, 0.8, 0, 0, *position], rate
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        found.append((mass, data.qfrc_bias.copy()))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
