"""`mjx-climb robot`: files with the oddities of public ones become scenarios that hold what is in them."""

import dataclasses
import re
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
import yaml

import mjx_climb as mc
from mjx_climb import rendering
from mjx_climb.checks.time_step import check_time_step, largest_time_step
from mjx_climb.dynamics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.dynamics.kinematics import limb_frames
from mjx_climb.robot.constants import load_model, load_robot
from mjx_climb.robot.proposal import propose
from mjx_climb.robot.stance import Stance, Standing
from mjx_climb.rollouts import remedies
from tests.robot import climbers
from tests.robot.test_robot_file import urdf

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


def told(proposal):
    return "\n".join(" ".join(note) for note in proposal.notes)


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
    ("limbs", "joints"), [pytest.param(*shape, marks=() if shape in FEW else pytest.mark.slow) for shape in MANY]
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
    """Return files as odd as public ones, by name: suffix and text."""
    text, _ = urdf(2)
    odd = re.sub(r'izz="[^"]*"', 'izz="0.9"', text, count=1).replace('lower="-1.2" upper="1.2"', 'lower="-9" upper="9"')
    motors = "".join(f'<motor joint="L{n}_{k}"/>' for n in range(4) for k in range(3))
    passive = climbers.mjcf(4, 4).replace("</worldbody>", f"</worldbody><actuator>{motors}</actuator>")
    hip = '<joint name="L0_1" type="hinge" axis="0 -1 0" range="-20 100" />'
    two = climbers.mjcf(4, 3)
    assert hip in two
    return {
        "a dog": ("xml", dog()),
        "knees that bend either way": ("xml", either_way()),
        "inertias of no body": ("urdf", odd),
        "six limbs without limits": ("urdf", six_limbs()),
        "passive ankles": ("xml", passive),
        "two joints in a body": ("xml", two.replace(hip, hip + '<joint name="L0_r" axis="1 0 0" range="-20 20"/>')),
        "a ball for a hip": ("xml", two.replace(hip, '<joint name="L0_1" type="ball" range="0 80"/>')),
        "joints without names": ("xml", re.sub(r'joint name="L\d_\d"', "joint", two)),
        "a weightless link": ("xml", two.replace('mass="0.15" diaginertia="1e-4 1.2e-4 1e-4"',
                                                  'mass="0" diaginertia="0 0 0"', 1)),
        "two joints a limb": ("xml", climbers.mjcf(4, 2)),
        "two arms of seven": ("xml", climbers.mjcf(2, 7)),
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", oddities())
def test_odd_files_walk_on_a_slope(saved, name):
    """Each walks a cycle up 30 degrees under lunar gravity, all grippers holding."""
    suffix, text = oddities()[name]
    proposed = propose(saved(text, f"robot.{suffix}")).sections
    scenario = mc.Scenario.model_validate({**proposed, "time_step": 0.001})
    scenario = scenario.with_overrides({"time_step": min(0.001, largest_time_step(scenario))})
    cycle = scenario.gait.cycle
    walk = mc.rollout(scenario.with_overrides({"gravity": [-0.81, 0.0, -1.403], "duration": cycle}))
    measured = mc.metrics(walk)
    assert not measured["diverged"] and not walk.detached.any()
    # three or four feet held as points leave a base on limbs of two joints no way ahead: it can only hold on
    way = scenario.gait.stride if load_robot(scenario.robot).joints > 2 else 0.0
    assert measured["travel"] == pytest.approx(way, abs=0.3 * scenario.gait.stride)


@pytest.mark.parametrize(("gravity", "asked"), [(9.81, []), (1.62, ["--gravity", "1.62"])])
def test_the_gravity_is_the_earths_unless_told(saved, gravity, asked, monkeypatch, ended):
    """It is said and written, also where the walk says that it does not hold; no time is spent on walking here."""
    monkeypatch.setattr(remedies, "slow_enough", lambda scenario: (scenario, False, "falls"))
    monkeypatch.setattr(rendering, "stance", picture := Mock(side_effect=rendering.RenderingError("no OpenGL")))
    file = saved(dog())
    config = file.with_suffix(".yaml")
    code, out, _ = ended(file, "--write", config, *asked)
    assert code == 1 and re.search(r"failed +walk +falls", out)
    assert f"taken    gravity {gravity} m/s^2" in out
    assert mc.load_scenario(config).gravity == (0, 0, -gravity)
    assert "no picture: no OpenGL" in out and picture.call_args.args[0].file == str(file)
    assert not config.with_suffix(".png").exists()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["--gravity", "inf"], "gravity: expected a list of three"),
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
