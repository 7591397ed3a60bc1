"""`mjx-climb robot`: files with the oddities of public ones become scenarios that hold what is in them."""

import dataclasses
import re
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
import yaml

import mjx_climb as mc
from mjx_climb.inputs.time_step import check_time_step, growth, largest_time_step
from mjx_climb.physics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.postures import least_singular_values, limb_joints
from mjx_climb.robot_import.bodies import rerooted
from mjx_climb.robot_import.description import bare, compiled, described
from mjx_climb.robot_import.load import load_model, load_robot
from mjx_climb.viz import rendering
from tests.robot import climbers
from tests.robot.test_robot_file import robot_of, urdf
from tuning.comparisons import first_walks
from tuning.proposal import propose as proposing
from tuning.proposal.limbs import Found, driven_joints
from tuning.proposal.propose import propose
from tuning.proposal.stance import Stance, Standing
from tuning.proposal.stand import on_stand

PLAIN = climbers.mjcf(4, 3).replace("><", ">\n<")
FEET = re.compile(r'<site name="foot\d" pos="0.15 0 0"/>')

LEGS = {"FL": (1, 1), "FR": (1, -1), "RL": (-1, 1), "RR": (-1, -1)}


def weight(place, mass, moments):
    return f'<inertial pos="{place}" mass="{mass}" diaginertia="{moments}"/>'


def dog():
    """Return a robot as many a public MJCF has it: looks from missing files, feet that are spheres, a head."""
    legs, motors = [], []
    for leg, (x, y) in LEGS.items():
        legs.append(
            f'<body name="{leg}_hip" pos="{0.19 * x} {0.05 * y} 0">{weight("0 0 0", 0.7, "1e-3 1e-3 1e-3")}'
            f'<joint name="{leg}_hip_joint" class="joint" axis="1 0 0" range="-1.05 1.05"/>'
            f'<geom class="looks" mesh="hip"/>'
            f'<body name="{leg}_thigh" pos="0 {0.09 * y} 0">{weight("0 0 -0.03", 1.1, "6e-3 6e-3 1e-3")}'
            f'<joint name="{leg}_thigh_joint" class="joint" axis="0 1 0" range="-1.5 3.4"/>'
            f'<body name="{leg}_calf" pos="0 0 -0.213">{weight("0 0 -0.1", 0.2, "3e-3 3e-3 1e-4")}'
            f'<joint name="{leg}_calf_joint" class="joint" axis="0 1 0" range="-2.7 -0.84" actuatorfrcrange="-45 45"/>'
            f'<geom type="sphere" size="0.022" pos="-0.002 0 -0.213"/></body></body></body>'
        )
        motors += [f'<motor joint="{leg}_{part}_joint"/>' for part in ("hip", "thigh", "calf")]
    return f"""<mujoco><compiler angle="radian" autolimits="true" meshdir="nowhere"/>
<default><default class="joint"><joint damping="0.1" armature="0.01" frictionloss="0.2"/></default>
<default class="looks"><geom type="mesh" contype="0" conaffinity="0" material="metal"/></default></default>
<asset><texture name="steel" type="2d" file="steel.png"/><material name="metal" texture="steel"/>
<mesh file="hip.obj"/></asset>
<worldbody><geom type="plane" size="1 1 1"/><body name="trunk" pos="0 0 0.4"><freejoint/>
{weight("0.02 0 0", 6.9, "0.1 0.1 0.02")}<site name="imu"/>{"".join(legs)}
<body pos="0.25 0 0.1"><joint name="neck" axis="0 1 0"/>{weight("0.05 0 0", 0.3, "1e-3 1e-3 1e-3")}
</body></body></worldbody><actuator>{"".join(motors)}</actuator><sensor><gyro site="imu"/></sensor>
<keyframe><key name="home" qpos="0 0 0.27 1 0 0 0 {"0 0.9 -1.8 " * 4} 0.1"
  ctrl="{"0 0.9 -1.8 " * 4}"/></keyframe></mujoco>"""


def scenario_of(proposal):
    return mc.Scenario.model_validate(proposal.sections | {"time_step": 1e-4})


def told(robot):
    return "\n".join(map(" ".join, robot.notes))


def driving(text, actuators):
    return text.replace("</worldbody>", f"</worldbody><actuator>{actuators}</actuator>")


def model_of(file):
    return compiled(str(file), bare(str(file)))


def test_a_dog_as_it_is_published(saved):
    """Missing looks do not matter; legs, their drives and their stance come from the file, and the head is held."""
    proposal = propose(saved(dog()))
    robot = proposal.sections["robot"]
    assert set(robot["limbs"]) == set(LEGS)
    assert robot["limbs"]["FL"]["joints"] == ["FL_hip_joint", "FL_thigh_joint", "FL_calf_joint"]
    assert (robot["limbs"]["FL"]["foot"], robot["limbs"]["FL"]["at"]) == ("FL_calf", [-0.002, 0, -0.213])
    assert robot["locked"] == {"neck": 0.1}
    assert robot["height"] == pytest.approx(2 * 0.213 * np.cos(0.9), abs=2e-3)
    assert robot["limbs"]["FL"]["foothold"][1] == pytest.approx(0.14, abs=1e-4)
    assert proposal.sections["gait"]["sequence"] == ["RL", "FL", "RR", "FR"]
    for line in ("taken stance of keyframe 'home'", "ignored 1 meshes", "taken torque limits", "taken dry friction",
                 "changed joint 'neck'", "changed 12 actuators", "ignored 1 sensors"):  # fmt: skip
        assert line in told(proposal)
    scenario = scenario_of(proposal)
    check_time_step(scenario)
    loaded = load_robot(scenario.robot)
    assert loaded.total_mass == pytest.approx(6.9 + 0.3 + 4 * 2.0)
    for field, value in (("armature", 0.01), ("damping", 0.1), ("friction", 0.2)):  # and torque limits of knees alone
        np.testing.assert_array_equal(getattr(loaded, field), np.full((4, 3), value))
    np.testing.assert_array_equal(loaded.torque_limit, [[np.inf, np.inf, 45]] * 4)


@pytest.mark.parametrize("moments", ["1e-3 1e-3 2.0000001e-3", "1e-3 1e-3 0", "0 0 0"])
def test_plates_rods_and_points_with_rounded_moments(saved, moments):
    """Moments on the limit of what a body can have are taken as they are, to rounding."""
    file = saved(dog().replace("1e-3 1e-3 1e-3", moments, 1))
    assert "moments of inertia" not in told(propose(file))


def test_the_end_of_a_link_that_the_file_does_not_have(saved):
    """Without a foot, a shape or a centre of mass it is as long as the one before, square to the joint, and told."""
    text, _ = urdf(1)
    text = re.sub(r'<link name="\w+_toe"/>|<joint name="\w+_ankle".*?</joint>', "", text)
    text = re.sub(r'(<link name="\w+_shank"><inertial><origin) xyz="[^"]*"', r'\1 xyz="0 0 0"', text)
    proposal = propose(saved(text, "endless.urdf"))
    assert "changed ends of last links not in the file" in told(proposal)
    limb = proposal.sections["robot"]["limbs"]["LH"]
    thigh = [float(v) for v in re.search(r'name="LH_knee".*?xyz="([^"]*)"', text)[1].split()]
    assert limb["foot"] == "LH_shank"
    assert np.linalg.norm(limb["at"]) == pytest.approx(np.linalg.norm(thigh), abs=2e-5)
    assert limb["at"][2] == 0.0  # the knee's axis


def test_one_link_that_is_named_a_foot_leaves_the_robot_its_other_limbs(saved):
    text = re.sub(r'<site name="foot[1-3]"[^>]*/>', "", climbers.mjcf(4, 3))
    assert text.count("<site") == 1
    assert len(propose(saved(text)).sections["robot"]["limbs"]) == 4


@pytest.mark.slow
def test_a_urdf_with_odd_numbers(saved):
    """Inertias that no body can have are mended and named; limits beyond a turn are none."""
    text, _ = urdf(1)
    text = re.sub(r'izz="[^"]*"', 'izz="0.9"', text, count=1)
    text = text.replace('lower="-1.2" upper="1.2"', 'lower="-9.4" upper="9.4"')
    for link, moments, off in (("LH_shank", 1, 1), ("RH_shank", 0, 1e-20)):
        inertia = " ".join(f'{axes}="{moments if axes[1] == axes[2] else off}"'
                           for axes in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))  # fmt: skip
        text = re.sub(rf'(<link name="{link}">.*?<inertia) [^>]*/>', rf"\1 {inertia}/>", text, count=1)
    proposal = propose(saved(text, "odd.urdf"))
    assert set(proposal.sections["robot"]["limbs"]) == {"LF", "LH", "RH", "RF"}
    assert proposal.sections["robot"]["limbs"]["LH"]["foot"] == "LH_toe"
    assert "changed moments of inertia no body can have those of 'trunk', 'LH_shank': made equal" in told(proposal)
    assert "changed stance" in told(proposal)
    assert proposal.sections["gait"]["sequence"] == ["LH", "LF", "RH", "RF"]
    robot = load_robot(scenario_of(proposal).robot)
    np.testing.assert_allclose(robot.joint_upper[:, 0], np.pi)


def either_way():
    """Return a dog without limits or keyframe: its knees bend either way, and are straight at zero."""
    return re.sub(r"<keyframe>.*?</keyframe>", "", re.sub(r' range="[^"]*"', "", dog()), flags=re.DOTALL)


def test_a_foot_is_met_in_the_posture_of_the_rest_stance(saved):
    """Also where knees bend either way; a hip swung over the back has no closed form: found by steps from it."""
    robot = load_robot(scenario_of(propose(saved(either_way()))).robot)
    stance, over = robot.stance_joints, robot.stance_joints + np.array([2.4, 1.8, 0.0])
    assert np.abs(stance[:, 0]).max() < 0.5  # hips are not swung over the back
    for rest in (stance, stance * [1, -1, -1], over):
        other = dataclasses.replace(robot, stance_joints=rest)
        feet = limb_frames(other, None, rest).foot
        np.testing.assert_allclose(inverse_kinematics(limb_geometry(other), feet).joint_angles, rest, atol=1e-9)
    closed = inverse_kinematics(limb_geometry(robot), feet)
    np.testing.assert_allclose(limb_frames(robot, None, closed.joint_angles).foot, feet, atol=1e-9)
    assert np.abs(closed.joint_angles - over).max() > 1.0


FEW = {(6, 3), (2, 7), (4, 2)}
MANY = [(limbs, joints) for limbs in range(2, 9) for joints in range(2, 8)]


@pytest.mark.parametrize(
    ("limbs", "joints"),
    [
        pytest.param(*shape, marks=() if shape in FEW else pytest.mark.nightly if sum(shape) % 2 else pytest.mark.slow)
        for shape in MANY
    ],
)
def test_any_number_of_limbs(saved, limbs, joints):
    """The limbs of a climber are found, it stands with its joints off their limits, and one limb swings at a time."""
    scenario = scenario_of(propose(saved(climbers.mjcf(limbs, joints))))
    robot = load_robot(scenario.robot)
    assert (len(robot.limbs), robot.joints) == (limbs, joints)
    assert (robot.stance_joints > robot.joint_lower).all() and (robot.stance_joints < robot.joint_upper).all()
    assert len(scenario.gait.sequence) == limbs and scenario.gait.duty >= 1 - 1 / limbs
    assert scenario.gait.cycle == limbs * max(1, 3 / (limbs - 1))  # as four limbs have it, for the load on a foot
    assert (scenario.contact.rotational_stiffness > 0) == (limbs <= 3)


def test_grips_of_a_biped_resist_turns_by_the_square_of_its_reach(saved):
    """As moments do of robots alike, of which only the lengths differ."""
    stiffness, reaches = [], []
    for reach in (0.3, 0.6):
        proposal = propose(saved(climbers.mjcf(2, 3, reach=reach)))
        stiffness.append(proposal.sections["contact"]["rotational_stiffness"])
        reaches.append(float(re.search(r"in proportion to \S+ kg and (\S+) m", told(proposal))[1]))
    assert stiffness[1] / stiffness[0] == pytest.approx((reaches[1] / reaches[0]) ** 2, rel=0.1)


def test_room_to_joint_limits_counts_for_a_stance_up_to_a_share_of_their_range(saved):
    """Beyond it the worth is the smallest singular value alone; it falls to nothing towards the limits."""
    text = climbers.mjcf(4, 3)
    stance, found = Stance(0.12, np.array([[0.2, 0.2], [-0.2, 0.2], [-0.2, -0.2], [0.2, -0.2]])), []
    for wide in (0.7, 1.0, 2.0):
        limits = lambda at, wide=wide: f'range="{wide * float(at[1])} {wide * float(at[2])}"'  # noqa: E731
        file = saved(re.sub(r'range="(\S+) (\S+)"', limits, text))
        section = propose(file).sections["robot"]
        standing = Standing(section, stance.footholds)
        robot = standing.robot
        feet = np.column_stack([stance.footholds, np.full(4, -0.12)])[standing.rows] - standing.offset
        angles = limb_joints(robot, feet).angles
        room = np.minimum(angles - robot.joint_lower, robot.joint_upper - angles)
        share = float((room / (robot.joint_upper - robot.joint_lower)).min())
        least = float(least_singular_values(robot, angles, False).min())
        assert standing.worth(stance) == pytest.approx(least * min(share / 0.15, 1.0))
        found.append(share)
    assert min(found) < 0.15 < max(found)
    for low, high in ((0.05, 1.0), (1.0, 0.05)):
        standing.robot = dataclasses.replace(robot, joint_lower=angles - low, joint_upper=angles + high)
        assert standing.worth(stance) == pytest.approx(least * 0.05 / 1.05 / 0.15)


def test_a_stance_at_random_is_out_from_the_base_and_in_the_middle_of_its_joints(saved):
    section = propose(saved(climbers.mjcf(4, 3))).sections["robot"]
    corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    standing = Standing(section, 0.2 * corners)
    found = standing.sampled(corners / np.sqrt(2), 0.4)
    feet = np.column_stack([found.footholds, np.full(4, -found.height)])[standing.rows] - standing.offset
    joints = limb_joints(standing.robot, feet)
    share = (joints.angles - standing.robot.joint_lower) / (standing.robot.joint_upper - standing.robot.joint_lower)
    assert (joints.errors < 1e-6).all() and 0.2 < share.min() and share.max() < 0.8
    outward = (found.footholds * corners).sum(1)
    assert outward.sum() > 1.81 and standing.worth(found) > 0  # 1.78 m in all, were no foot to be far out


@pytest.mark.slow
def test_a_stance_is_not_singular_for_what_the_grips_hold(saved):
    """Six joints whose third pitch follows a roll: with the roll in the middle of its range four axes are parallel.

    Of stances as far off the joints' limits none is farther from singular.
    """
    model = load_model(scenario_of(propose(saved(climbers.mjcf(3, 6)))).robot)
    data, jacobian = mujoco.MjData(model), np.empty((6, model.nv))
    data.qpos[:] = model.key_qpos[0]
    mujoco.mj_forward(model, data)
    for limb in range(3):
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], limb)
        jacobian[:3] /= 0.33  # m, a limb's length
        assert np.linalg.svd(jacobian[:, 6 + 6 * limb : 12 + 6 * limb], compute_uv=False)[-1] > 0.02
    section = propose(saved(climbers.mjcf(4, 3))).sections["robot"]
    feet = np.array([limb["foothold"] for limb in section["limbs"].values()])
    worth = Standing(section, feet).worth
    others = [Stance(height, share * feet) for height in (0.05, 0.12, 0.2) for share in (0.6, 0.8, 1.0, 1.2)]
    assert worth(Stance(section["height"], feet)) >= max(worth(stance) for stance in others) > 0


def test_a_singular_stance_is_named_and_refused(saved, monkeypatch):
    """Limbs stretched straight; grips that hold attitudes on limbs that cannot turn their feet about every axis."""
    file = saved(climbers.mjcf(4, 3))
    straight = {"foothold": 0.11 + np.sqrt(0.3**2 - 0.08**2) - 1e-6, "height": 0.08}
    stretched = mc.Scenario.model_validate(climbers.config(file, 4, 3, **straight))
    for walk in (mc.rollout, mc.simulator):
        with pytest.raises(mc.ConfigError, match=r"robot.limbs.limb\d.foothold: expected .* singular"):
            walk(stretched.with_overrides({"duration": 0.004, "time_step": 0.0001}))
    monkeypatch.setattr(climbers, "ROLLS", ())
    file.write_text(climbers.mjcf(2, 6))
    with pytest.raises(mc.RobotError, match="singular ones alone"):
        propose(file)


def six_limbs():
    """Return a URDF of six limbs of three joints, armed with nothing: no armature, no damping, no limits."""
    text, _ = urdf(1)
    text = re.sub(r'<limit lower="[^"]*" upper="[^"]*"', "<limit", text).replace("revolute", "continuous")
    for side, y in (("L", 1), ("R", -1)):
        limb = re.findall(rf'<link name="{side}F_\w+".*?(?=<link name="(?!{side}F)|$)', text, re.DOTALL)[0]
        middle = limb.replace(f"{side}F_", f"{side}M_").replace("</robot>", "")
        middle = re.sub(r'(name="' + side + r'M_yaw".*?<origin xyz=")[^"]*(" rpy=")[^"]*',
                        rf"\g<1>0 {0.08 * y} 0\g<2>0 0 {y * np.pi / 2}", middle, flags=re.DOTALL)  # fmt: skip
        text = text.replace("</robot>", middle + "</robot>")
    return text


def oddities():
    """Return the texts of files as odd as public ones."""
    text, _ = urdf(2)
    odd = re.sub(r'izz="[^"]*"', 'izz="0.9"', text, count=1).replace('lower="-1.2" upper="1.2"', 'lower="-9" upper="9"')
    motors = "".join(f'<motor joint="L{n}_{k}"/>' for n in range(4) for k in range(3))
    hip = '<joint name="L0_1" type="hinge" axis="0 -1 0" range="-20 100" />'
    two = climbers.mjcf(4, 3)
    assert hip in two
    return {
        "a dog": dog(),
        "knees that bend either way": either_way(),
        "inertias of no body": odd,
        "six limbs without limits": six_limbs(),
        "passive ankles": driving(climbers.mjcf(4, 4), motors),
        "two joints in a body": two.replace(hip, hip + '<joint name="L0_r" axis="1 0 0" range="-20 20"/>'),
        "a ball for a hip": two.replace(hip, '<joint name="L0_1" type="ball" range="0 80"/>'),
        "joints without names": re.sub(r'joint name="L\d_\d"', "joint", two),
        "a weightless link": re.sub('mass="0.15" diaginertia="[^"]*"', 'mass="0" diaginertia="0 0 0"', two, count=1),
        "two joints a limb": climbers.mjcf(4, 2),
        "two arms of seven": climbers.mjcf(2, 7),
    }


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", oddities())
def test_odd_files_walk_on_a_slope(saved, name):
    """Each walks a cycle up 30 degrees under lunar gravity, all grippers holding."""
    proposed = propose(saved(oddities()[name])).sections  # a URDF is one by what is in it
    scenario = mc.Scenario.model_validate({**proposed, "time_step": 0.001})
    scenario = scenario.with_overrides({"time_step": min(0.001, largest_time_step(scenario))})
    cycle = scenario.gait.cycle
    walk = mc.rollout(scenario.with_overrides({"gravity": [-0.81, 0.0, -1.403], "duration": cycle}))
    measured = mc.metrics(walk)
    assert not measured["diverged"] and not walk.detached.any()
    # three or four feet held as points leave a base on limbs of two joints no way ahead: it can only hold on
    way = scenario.gait.stride if load_robot(scenario.robot).joints > 2 else 0.0
    assert measured["travel"] == pytest.approx(way, abs=0.3 * scenario.gait.stride)


@pytest.mark.parametrize(
    ("gravity", "asked", "lies", "turned"),
    [
        (9.81, [], "level ground; --grav", (0, 0, -9.81)),
        (1.62, ["--gravity", "1.62"], "level ground; --grav", (0, 0, -1.62)),
        (
            1.62,
            ["--gravity", "1.62", "--slope", "30"],
            "a slope of 30 degrees\n",
            (-0.81, 0, -1.62 * np.cos(np.pi / 6)),
        ),
        (9.81, ["--slope", "90"], "a slope of 90 degrees\n", (-9.81, 0, 0)),
        (9.81, ["--roof"], "a roof\n", (0, 0, 9.81)),
    ],
)
def test_the_gravity_is_the_earths_unless_told(saved, gravity, asked, lies, turned, monkeypatch, ended):
    """It is said and written, also where the walk says that it does not hold; no time is spent on walking here."""
    monkeypatch.setattr(first_walks, "with_joint_gains", lambda scenario, *_: (scenario, "as they were"))
    monkeypatch.setattr(first_walks, "slow_enough", lambda scenario, *_: (scenario, False, "falls", np.nan, {}))
    monkeypatch.setattr(rendering, "stance", picture := Mock(side_effect=rendering.RenderingError("no OpenGL")))
    file = saved(dog())
    config = file.with_suffix(".yaml")
    code, out, _ = ended(file, "--write", config, *asked)
    assert code == 1 and re.search(r"failed +walk +falls", out)
    assert re.search(rf"taken +gravity {gravity} m/s\^2 +on {lies}", out)
    assert mc.load_scenario(config).gravity == pytest.approx(turned)
    assert "no picture: no OpenGL" in out and picture.call_args.args[0].file == str(file)
    assert not config.with_suffix(".png").exists()


def test_what_the_first_walks_show_is_said(saved, monkeypatch, ended):
    """Joint gains that were found are written; a load and a ceiling that a robot may not bear are warned of."""
    changed = lambda scenario: scenario.with_overrides({"control.kp": 77.0, "control.kd": 0.7})  # noqa: E731
    monkeypatch.setattr(
        first_walks, "with_joint_gains", lambda scenario, told: told(15) or (changed(scenario), "found")
    )
    monkeypatch.setattr(first_walks, "slow_enough", lambda scenario, *_: (scenario, True, "holds", 1e4, {}))
    monkeypatch.setattr(first_walks, "on_ceiling", lambda scenario, *_: (False, "lets go"))
    code, out, err = ended(saved(dog()))
    words = " ".join(err.split())
    assert re.search(r"47 walks of [\d,]+ time steps: about .* on one core, once compiled .*: 15 of 47 walks", words)
    assert code == 0 and "kp: 77.0\n  kd: 0.7\n" in out
    for line in ("changed +kp 77, kd 0.7 +found", "taken +walk +holds", "warning +ceiling +lets go",
                 r"warning +load +1e\+04 N on one foot, 67 times its weight on Earth"):  # fmt: skip
        assert re.search(line, out)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["--gravity", "inf"], "gravity: expected a list of three"),
        (["--gravity", "-9.81"], "--gravity: expected its strength, 0 or more, got -9.81; --roof turns it round"),
        (["--slope", "200"], "--slope: expected 180 at most, got "),
        (["--slope", "20", "--roof"], "--roof: expected none with --slope 20"),
        (["--gravity", "0", "--roof"], "--roof: expected gravity, got none"),
        (["--write", "robot.xml"], "another file than the robot's own"),
    ],
)
def test_what_makes_no_config_is_refused(saved, ended, monkeypatch, asked, said):
    file = saved(dog())
    monkeypatch.chdir(file.parent)
    code, _, error = ended(file, *asked)
    assert code == 2 and said in error and file.read_text() == dog()


@pytest.mark.slow
def test_the_command_leaves_a_config_that_runs(saved, ended):
    file = saved(dog())
    config = file.with_suffix(".yaml")
    code, out, _ = ended(file, "--write", config)
    assert code == 0 and "holds for 8 s at a cycle of 4 s" in out
    assert config.with_suffix(".png").exists() or "no picture: " in out
    assert "taken    base 'trunk'" in out and f"mjx-climb run {config}" in out
    assert yaml.safe_load(config.read_text())["robot"]["file"] == "robot.xml"
    check_time_step(mc.load_scenario(config))


# ------------------------------------------------------------------------------------------------------------
# What a file may hold that its author meant otherwise than a quick reader takes it


@pytest.mark.parametrize(
    ("shape", "at"),
    [
        ('<frame pos="0.08 0 0"><geom type="capsule" size="0.01 0.07" euler="0 90 0"/></frame>', [0.15, 0, 0]),
        ('<geom type="box" size="0.07 0.01 0.01" pos="0.08 0 0"/>', [0.15, 0, 0]),
        ('<geom type="box" size="0.01 0.01 0.07" pos="0 0 -0.08"/>', [0, 0, -0.15]),
        ('<body pos="0.1 0 0"><geom type="box" size="0.02 0.03 0.01" pos="0.03 0 0"/></body>', [0.15, 0, 0]),
        ("", [0.15, 0.004, 0]),
    ],
)
def test_a_limb_ends_where_its_shape_does(saved, shape, at):
    """In a frame, turned by angles, in a part welded on: where MuJoCo has the shape; an end that is guessed is told."""
    robot = Found(saved(FEET.sub(shape, PLAIN)))
    for limb in robot.limbs.values():
        np.testing.assert_allclose(limb.at, at, atol=1e-5)
    assert ("ends of last links not in the file" in told(robot)) == ("ends" in told(robot)) == (not shape)


def test_grip_gains_and_gait_are_hubrobos_in_proportion_to_mass_and_reach(saved):
    """Limbs of 0.33 and 0.63 m of one mass, and heavier ones: to the two digits that are written."""
    short, long = (propose(saved(climbers.mjcf(4, 3, reach=reach))).sections for reach in (0.3, 0.6))
    heavy = propose(saved(climbers.mjcf(4, 3).replace('mass="0.15"', 'mass="0.6"'))).sections
    for (section, name), power in {
        ("contact", "stiffness"): 0, ("contact", "damping"): 0, ("contact", "capture_distance"): 1,
        ("control", "kp"): 1, ("control", "kd"): 1, ("control", "stiffness"): 0, ("gait", "stride"): 1,
        ("gait", "step_height"): 1,
    }.items():  # fmt: skip
        assert long[section][name] / short[section][name] == pytest.approx((0.63 / 0.33) ** power, rel=0.06), name
        lighter = section == "gait" or name == "capture_distance"
        ratio = 1.0 if lighter else (1.2 + 12 * 0.6) / (1.2 + 12 * 0.15)
        assert heavy[section][name] / short[section][name] == pytest.approx(ratio, rel=0.06), name
    hubrobo, own = mc.Scenario(), load_robot("hubrobo_v3_2")
    weight = (1.2 + 12 * 0.15) / float(own.total_mass)
    for name, part in (("stiffness", "contact"), ("damping", "contact"), ("stiffness", "control")):
        assert short[part][name] == pytest.approx(weight * getattr(getattr(hubrobo, part), name), rel=0.06), name
    assert short["control"]["kp"] / short["control"]["kd"] == pytest.approx(
        hubrobo.control.kp / hubrobo.control.kd, rel=0.06
    )


@pytest.mark.parametrize(("limbs", "cycle", "duty"), [(4, 4.0, 0.75), (6, 6.0, 0.84), (8, 8.0, 0.88)])
def test_a_crawl_goes_up_one_side_from_behind_and_then_up_the_other(saved, limbs, cycle, duty):
    found = propose(saved(climbers.mjcf(limbs, 3))).sections
    gait = found["gait"]
    assert (gait["cycle"], gait["duty"], found["duration"]) == (pytest.approx(cycle), duty, pytest.approx(2 * cycle))
    feet = {name: limb["foothold"] for name, limb in found["robot"]["limbs"].items()}
    places = np.array([feet[name] for name in gait["sequence"]])
    half = limbs // 2
    assert (places[:half, 1] > 0).all() and (places[half:, 1] < 0).all()
    assert (np.diff(places[:half, 0]) > 0).all() and (np.diff(places[half:, 0]) > 0).all()


def arm(joints, name="arm", end='<site name="foot_of_arm" pos="0 0 -0.05"/>'):
    """Return a row of bodies that ends in a foot of its own."""
    rows = "".join(
        f'<body name="{name}{n}" pos="0 0 {-0.03 if n else 0}"><joint name="{name}{n}" axis="{n % 2} {1 - n % 2} 0"/>'
        f"{weight('0 0 -0.01', 0.1, '1e-4 1e-4 1e-4')}"
        for n in range(joints)
    )
    return f"{rows}{end}{'</body>' * joints}"


@pytest.mark.parametrize(("joints", "limbs"), [(1, 4), (2, 5), (5, 5), (6, 4)])
def test_limbs_have_about_as_many_joints_as_most_of_them(saved, joints, limbs):
    """Of three joints each: a row of up to two more or less is one too."""
    robot = Found(saved(climbers.mjcf(4, 3, on_base=arm(joints))))
    assert len(robot.limbs) == limbs


def test_rows_that_end_in_no_foot_have_no_part_in_how_many_joints_limbs_have(saved):
    feelers = "".join(arm(7, f"feeler{n}_", "") for n in range(5))
    robot = Found(saved(climbers.mjcf(4, 3, on_base=feelers)))
    assert [len(chain.joints) for chain in robot.limbs.values()] == [3] * 4


@pytest.mark.parametrize(
    ("mass", "key", "root"), [("", "", "trunk"), (weight("0 0 0", 1.0, "1 1 1"), "", None), ("", "0 " * 12, None)]
)
def test_a_root_of_no_mass_gives_way_to_the_link_that_all_limbs_meet_in(saved, mass, key, root):
    """Not one that weighs something, nor one that a keyframe places."""
    text = PLAIN.replace('<body name="trunk">\n<freejoint/>', f'<body name="root">{mass}<body name="trunk">')
    key = f'<keyframe><key name="home" qpos="{key}"/></keyframe>' if key else ""
    found = Found(saved(text.replace("</worldbody>", f"</body></worldbody>{key}")))
    assert found.root == root and found.model.body(found.base).name == (root or "root") and len(found.limbs) == 4
    assert ("weigh nothing" in found.notes[0].why) == bool(root)


def test_legs_that_stand_on_a_robots_back_are_told(saved):
    straight = dog().replace("0 0.9 -1.8", "0 0.3 -0.9")
    hanging, standing = (Found(saved(re.sub(r' pos="(\S+) (\S+) -(\S+)"', way, straight))) for way in
                         (r' pos="\1 \2 -\3"', r' pos="\1 \2 \3"'))  # fmt: skip
    assert hanging.other_up(hanging.limbs) is None
    assert "'trunk' with limbs that hang along its +z: fix" in standing.other_up(standing.limbs)


@pytest.mark.parametrize(
    ("names", "taken"), [(("home", "stance"), "stance"), (("home", "stand"), "stand"), (("b", "a"), "b")]
)
def test_the_keyframe_of_a_stance_goes_by_its_name_before_its_place(saved, names, taken):
    keys = "".join(
        f'<key name="{name}" qpos="0 0 0.27 1 0 0 0 {f"0 {bend} {-2 * bend} " * 4} 0.1"/>'
        for name, bend in zip(names, (0.9, 0.8), strict=True)
    )
    text = re.sub(r"<keyframe>.*</keyframe>", f"<keyframe>{keys}</keyframe>", dog(), flags=re.DOTALL)
    proposal = propose(saved(text))
    bend = (0.9, 0.8)[names.index(taken)]
    assert f"taken stance of keyframe {taken!r}" in told(proposal)
    assert proposal.sections["robot"]["height"] == pytest.approx(2 * 0.213 * np.cos(bend), abs=3e-3)


@pytest.mark.parametrize(("joints", "springs", "firm"), [(6, 0, True), (7, 1, True), (5, 0, False), (6, 1, False)])
def test_grips_and_joints_are_firm_where_limbs_of_six_driven_joints_keep_their_attitude(joints, springs, firm):
    """By hand, for a robot of twice HubRobo's mass times reach squared; others walk with short strides."""
    names = [f"j{n}" for n in range(joints)]
    section = {"limbs": {"a": {"joints": names}, "b": {"joints": [*names, "more", "yet"]}}}
    section |= {"springs": dict.fromkeys(names[:springs])} if springs else {}
    contact, control, gait = {"stiffness": 1e4}, {"kp": 44.0, "kd": 0.21, "stiffness": 5e4}, {"stride": 0.06}
    robot = Mock()
    proposing._hold_turns(robot, section, {"contact": contact, "control": control}, gait, 2.0)
    assert contact == {"stiffness": 1e4, "rotational_stiffness": 600.0 if firm else 60.0,
                       "rotational_damping": 0.36 if firm else 0.12}  # fmt: skip
    assert control == {"kp": 440.0 if firm else 44.0, "kd": 0.63 if firm else 0.21, "stiffness": 5e4}
    assert gait == {"stride": 0.06 if firm else 0.0075}
    ((kind, what, why), _) = robot.note.call_args
    assert (kind, what) == ("changed", "grip") and ("firm enough for one foot" in why) == firm
    assert ("limbs of under 6 joints" in why) != firm


def test_a_robot_of_three_feet_has_grips_that_hold_turns(saved):
    assert propose(saved(climbers.mjcf(3, 3))).sections["contact"]["rotational_stiffness"] > 0


def test_rows_of_up_to_seven_joints_stand_on_a_stand(saved):
    """Each called by its first link; inner links are none of their own."""
    found = on_stand(saved(climbers.mjcf(2, 7)))
    assert {name: limb["joints"] for name, limb in found["limbs"].items()} == {
        "L0_0": [f"L0_{n}" for n in range(7)], "L1_0": [f"L1_{n}" for n in range(7)]
    }  # fmt: skip
    with pytest.raises(mc.RobotError, match=r"expected one to 7 joints in a row, got L0_0, .*, L0_7$"):
        on_stand(saved(climbers.mjcf(2, 8)))


def test_of_long_limbs_and_of_many_some_are_held(saved):
    robot = Found(saved(climbers.mjcf(4, 9)))
    assert {len(chain.joints) for chain in robot.limbs.values()} == {7}
    assert told(robot).count("the last beyond 7 are held") == 4
    many = Found(saved(climbers.mjcf(10, 3)))
    assert len(many.limbs) == 8 and "ignored 2 limbs" in told(many)
    assert "held" not in told(Found(saved(climbers.mjcf(8, 7))))


@pytest.mark.parametrize("limbs", [["L0"], ["L0", "L9"], ["none", "L1"]])
def test_limbs_to_stand_on_are_two_or_more_of_the_robots(saved, limbs):
    with pytest.raises(mc.RobotError, match=r"--limbs: expected two or more of L0, L1, L2, L3, got"):
        Found(saved(climbers.mjcf(4, 3)), stand_on=limbs)
    chosen = Found(saved(climbers.mjcf(4, 3)), stand_on=["L3", "L1"])
    assert list(chosen.limbs) == ["L1", "L3"] and len(chosen.joints) == 6


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
    robot = Found(saved(text, "urdf/robot.urdf"))
    there = folder != "urdf/gone"
    for limb in robot.limbs.values():
        end = [0.15 * np.cos(1.2), 0.15 * np.sin(1.2), 0.01]
        assert (np.linalg.norm(np.subtract(limb.at, end)) < 1e-5) == there
    assert (f"{kind} mesh 'shin' of 'LF_shank'" in told(robot)) == there and ("guessed" in told(robot)) != there


def test_a_mesh_of_an_mjcf_and_one_that_is_none(saved):
    """A wheel's rim counts for its middle; a file that is no mesh is passed over, and said."""
    shape = '<geom type="mesh" mesh="shin" pos="0.01 0 0"/><geom type="cylinder" size="0.02 0.01" pos="0.1 0 0"/>'
    text = FEET.sub(shape, PLAIN).replace("<worldbody>", '<asset><mesh file="shin.stl"/></asset>\n<worldbody>')
    text = text.replace("<compiler", '<compiler meshdir="looks"')
    for mesh, at in ((stl(PRONGS), [0.16, 0, 0]), (b"solid nothing", [0.1, 0, 0])):
        saved(mesh, f"{len(mesh)}/looks/shin.stl")
        robot = Found(saved(text, f"{len(mesh)}/robot.xml"))
        np.testing.assert_allclose(robot.limbs["L0"].at, at, atol=1e-5)
        assert ("ignored meshes of the last links" in told(robot)) == (at[0] == 0.1)


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


def test_a_ball_joint_turns_as_far_either_way_about_each_axis(saved):
    ball = re.sub(r'<joint name="L0_1"[^>]*>', '<joint name="L0_1" type="ball" range="0 40"/>', PLAIN)
    made = described(str(saved(ball))).compile()
    for letter in "xyz":
        low, high = made.joint(f"L0_1_{letter}").range
        assert low == -high < 0 and made.joint(f"L0_1_{letter}").type == mujoco.mjtJoint.mjJNT_HINGE


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
        robot = Found(saved(text))
        assert [len(limb.joints) for limb in robot.limbs.values()] == [expected] * 4


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


def test_constraints_of_a_robot_that_is_turned_round_bind_what_they_bound(saved):
    constraints = """<equality><joint name="mimic" joint1="L0_1" joint2="L2_1" polycoef="0.1 2 0 0 0" active="false"/>
      <joint name="alone" joint1="L0_2"/><connect name="loop" site1="foot0" site2="foot2"/>
      <weld name="weld" body1="L0_2" body2="L1_2" active="false"/></equality></mujoco>"""
    model = model_of(saved(climbers.mjcf(4, 3).replace("</mujoco>", constraints)))
    told = []
    for each in (model, rerooted(model, "L1_2").compile()):
        kinds = [mujoco.mjtObj.mjOBJ_JOINT] * 2 + [mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY]
        ends = [
            [mujoco.mj_id2name(each, kind, int(ids[n])) for ids in (each.eq_obj1id, each.eq_obj2id)]
            for n, kind in enumerate(kinds)
        ]
        names = [each.equality(n).name for n in range(each.neq)]
        told.append(
            (names, ends, each.eq_type.tolist(), each.eq_active0.tolist(), each.eq_data[:, :11].round(9).tolist())
        )
    assert told[0] == told[1] and told[0][1][:2] == [["L0_1", "L2_1"], ["L0_2", None]]


def test_one_row_of_joints_begins_at_a_foot(saved):
    """Its base is in the middle, and what hangs on it either way are the limbs."""
    text = rerooted(model_of(saved(climbers.mjcf(2, 7))), "L0_6").to_xml()
    proposal = propose(saved(text, "worm.xml"))
    robot = proposal.sections["robot"]
    assert robot["base"] == "trunk" and "from foot to foot" in told(proposal)
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
    for line in ("taken base 'pelvis'", "changed joint 'waist' of no limb", "ignored damping and stiffness beyond",
                 "ignored 1 keyframes not of the 20 positions", "ignored gravity compensation",
                 "changed limits of 12 joints the file has none"):  # fmt: skip
        assert line in told(proposal)
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
    out, stride, kd = 0.051, 0.053, 6.5  # m, from the pitch axis; m; N m s/rad
    ahead = stride * (1 - 5 / 32)  # the base has gone 5/32 of its way at a quarter of the cycle
    far = 0.19 + out
    limbs = {
        f"B{n}": {"joints": [f"B{n}_slide", f"B{n}_yaw", f"B{n}_pitch"], "foot": f"foot{n}", "foothold": foot}
        for n, foot in enumerate(([far, 0], [0, far], [-far, 0], [0, -far]))
    }
    scenario = mc.Scenario.model_validate({
        "robot": {"file": str(file), "height": 0.17, "limbs": limbs}, "time_step": 1e-5,
        "gait": {"sequence": ["B2", "B1", "B0", "B3"], "stride": stride},
        "control": {"kp": 1600.0, "kd": kd},
    })  # fmt: skip
    model = load_model(scenario.robot)
    data, mass = mujoco.MjData(model), np.empty((model.nv, model.nv))
    data.qpos[:] = model.key_qpos[0]
    limb = next(n for n in range(4) if model.site(n).name == "B2_foot")
    data.qpos[7 + 3 * limb + 2] = np.arccos((out - ahead) / 0.22)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    inertia = 1 / np.linalg.inv(mass)[6 + 3 * limb + 1, 6 + 3 * limb + 1]
    assert growth(scenario, 2.05 * inertia / kd) > 1


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


@pytest.mark.parametrize(
    ("limbs", "joints"),
    [pytest.param(*shape, marks=pytest.mark.slow if shape == MANY[0] else pytest.mark.nightly) for shape in MANY],
)
def test_every_shape_walks_alone_in_a_batch_and_with_tangents(saved, limbs, joints):
    """As proposed, for some steps: a batch walks as the rollout does, tangents are central differences."""
    scenario = scenario_of(propose(saved(climbers.mjcf(limbs, joints))))
    time_step = min(scenario.time_step, largest_time_step(scenario))
    scenario = scenario.with_overrides({"time_step": time_step, "duration": 12 * time_step})
    # with a tenth of it the rounding of two arms of seven is 0.3 % of a difference, with thrice it 0.001 % are left
    damping, step = np.array([1e2, 2e2]), 1e-3
    measured = mc.metrics(mc.rollout(scenario, {"damping": damping[1]}))
    ends = np.append(damping, damping[1] * (1 + np.array([step, -step])))[:, None]
    walked = mc.rollout_metrics(scenario, {"damping": ends}, dtype=np.float64)
    _, tangents = mc.rollout_jvp(
        scenario, {"damping": damping[:, None]}, {"damping": np.ones((1, 1, 6))}, dtype=np.float64
    )
    # in so few steps the base travels 1e-10 m: its rounding makes a staircase of the cost, not of the work
    travel, cost = walked["travel"], walked["cost_of_transport"]
    np.testing.assert_allclose(cost[1], measured["cost_of_transport"], rtol=1e-5)
    walked["work"], measured["work"] = cost * travel, measured["cost_of_transport"] * measured["travel"]
    tangents["work"] = tangents["travel"] * cost[:2] + tangents["cost_of_transport"] * travel[:2]
    for name in ("peak_foot_force", "peak_joint_torque", "work", "base_deviation"):
        np.testing.assert_allclose(walked[name][1], measured[name], rtol=1e-8, err_msg=name)
        slope = (walked[name][2] - walked[name][3]) / (2 * step * damping[1])
        floor = 1e-9 * abs(measured[name]) / (step * damping[1])
        np.testing.assert_allclose(tangents[name][0, 1], slope, rtol=1e-3, atol=floor, err_msg=name)
    assert not walked["diverged"].any()


def footprint(text, height):
    """Return a URDF whose root is a link without a mass, so high below the trunk, m."""
    ends = '<parent link="base_footprint"/><child link="trunk"/>'
    joint = f'<joint name="up" type="fixed">{ends}<origin xyz="0 0 {height}"/></joint>'
    return text.replace('<link name="trunk">', f'<link name="base_footprint"/>{joint}<link name="trunk">')


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.3, *(pytest.param(h, marks=pytest.mark.slow) for h in (0.0, 0.25, -0.1))])
def test_a_root_that_weighs_nothing_changes_no_stance(saved, height):
    """`base_footprint` lies anywhere below or above the trunk; fingers that mimic each other hang on a limb."""
    text, _ = urdf(1)
    finger = (
        '<link name="f{0}"><inertial><mass value="0.01"/><inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" '
        'iyz="0"/></inertial></link><joint name="f{0}" type="prismatic"><parent link="trunk"/><child link="f{0}"/>'
        '<limit lower="0" upper="0.02" effort="1" velocity="1"/>{1}</joint>'
    )
    fingers = finger.format(1, "") + finger.format(2, '<mimic joint="f1" multiplier="1"/>')
    text = text.replace("</robot>", f"{fingers}</robot>")
    own, other = propose(saved(text, "own.urdf")), propose(file := saved(footprint(text, height), "other.urdf"))
    assert other.sections["robot"] == own.sections["robot"] | {"base": "trunk", "file": str(file)}
    assert other.sections["gait"] == own.sections["gait"]
    assert "taken base 'trunk' the link that all limbs meet in" in told(other)
    assert "ignored 1 mimics not simulated" in told(other)
    loaded, expected = (scenario_of(each).robot for each in (other, own))
    np.testing.assert_allclose(load_robot(loaded).stance_joints, load_robot(expected).stance_joints, atol=1e-9)


@pytest.mark.slow
def test_what_a_urdf_limits_is_said(saved):
    """Speeds, which nothing limits here, and torques of 0, which MuJoCo takes for none."""
    text = urdf(1)[0].replace('effort="9" velocity="9"', 'effort="0" velocity="4"', 3)
    proposal = told(propose(saved(text, "robot.urdf")))
    assert "taken torque limits 9 to 9, of 9 joints" in proposal
    assert 'changed torque limits of 3 joints effort="0" in the file' in proposal
    assert "ignored velocity limits of 12 joints 4 to 9 in the file" in proposal
    assert "velocity limits" not in told(propose(saved(PLAIN)))


def test_a_mimic_is_called_so(saved):
    mimic = 'velocity="9"/><mimic joint="LF_lift" multiplier="-1"/>'
    text = urdf(1)[0].replace("></", ">\n</")
    knee = text.index('name="LF_knee"')
    file = saved(text[:knee] + text[knee:].replace('velocity="9"/>', mimic, 1), "robot.urdf")
    line = text[:knee].count("\n") + 1
    with pytest.raises(mc.RobotError, match=rf"urdf:{line}: .* expected no mimic between .* got one at 'LF_knee'"):
        propose(file)


def test_a_loop_closed_by_sites(saved):
    """Between held parts it holds nothing that moves; between a held part and a limb it is refused by its site."""
    mast = (
        '<body name="mast" pos="0 0 0.05"><joint name="mast"/><site name="end" pos="0 0 0.1"/>'
        '<inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/></body><site name="hook" pos="0 0 0.15"/>'
    )
    text = climbers.mjcf(4, 3, on_base=mast)
    loop = '</worldbody><equality><connect site1="end" site2="{}"/></equality>'
    proposal = propose(saved(text.replace("</worldbody>", loop.format("hook"))))
    assert scenario_of(proposal).robot.locked.items() == {("mast", 0.0)}
    assert "ignored 1 equality constraints" in told(proposal)
    with pytest.raises(mc.RobotError, match="no equality constraints between moving parts, got one at 'end'"):
        propose(saved(text.replace("</worldbody>", loop.format("foot0"))))
