"""Robots from a user's own file: the same robot as MuJoCo's, walked by every engine."""

import dataclasses
import importlib
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb import ground
from mjx_climb.gait.footholds.nearest import Nearest
from mjx_climb.gait.recovery import Recovery
from mjx_climb.hardware.actuator import JointLoop, JointSpring
from mjx_climb.hardware.velocity_commanded import VelocityCommanded
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.time_step import check_time_step, growth, largest_time_step
from mjx_climb.physics.contact.contact import Springs
from mjx_climb.physics.contact.gripper import Gripper
from mjx_climb.physics.inverse_kinematics import Chain, inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.description import files_of
from mjx_climb.robot_import.load import load_model, load_robot, model_path
from mjx_climb.robot_import.robot_file import SNAP
from mjx_climb.scenario.model import RobotFile
from tests.robot import climbers

LIMBS = {"LF": (1, 1), "LH": (-1, 1), "RH": (-1, -1), "RF": (1, -1)}  # signs of x and y
LINKS = ("yaw", "lift", "knee")
IMU = 'name="imu_mount" type="fixed"><parent link="trunk"/><child link="imu"/><origin xyz="0.02 0 0.03"/>'
REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "hubrobo_v2_2.json").read_text())["model"]


def row(values):
    return " ".join(map(str, values))


def inertial(rng, mass, reach):
    """Return an inertial element: any centre, any orientation of its axes, moments that a body can have."""
    a, b = rng.uniform(0.4, 1.0, 2) * mass * reach**2
    xyz, rpy = rng.uniform(-reach, reach, 3) / 4, rng.uniform(-3, 3, 3)
    return (
        f'<inertial><origin xyz="{row(xyz)}" rpy="{row(rpy)}"/><mass value="{mass}"/>'
        f'<inertia ixx="{a}" iyy="{b}" izz="{0.7 * (a + b)}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def urdf(seed=0, quarter="1.5707963267948966"):
    """Return a URDF of some climbing robot: lengths, masses, offsets, signs of axes at random, limbs out of order."""
    rng = np.random.default_rng(seed)
    mesh = '<collision><geometry><mesh filename="package://nowhere/trunk.stl"/></geometry></collision>'
    parts = [f'<link name="trunk">{inertial(rng, rng.uniform(0.5, 2), 0.1)}{mesh}</link>']
    parts += [f'<link name="imu">{inertial(rng, 0.05, 0.02)}</link>', f"<joint {IMU}</joint>"]
    hip, coxa, femur, tibia = rng.uniform(0.05, 0.08), *rng.uniform((0.02, 0.06, 0.1), (0.04, 0.12, 0.18))
    for limb in rng.permutation(list(LIMBS)):
        x, y = np.array(LIMBS[limb]) * hip
        knee = rng.choice([-1, 1])  # which way the tibia's axis points
        for link, mass in (("hip", 0.2), ("thigh", 0.1), ("shank", 0.15)):
            weight = inertial(rng, mass * rng.uniform(0.7, 1.3), 0.04)
            parts.append(f'<link name="{limb}_{link}">{weight}</link>')
        parts.append(f'<link name="{limb}_toe"/>')
        low, high = (-2.6, 0) if knee > 0 else (0, 2.6)
        lateral = rng.uniform(-0.004, 0.004)
        for name, kind, parent, child, xyz, rpy, axis, limits in (
            ("yaw", "revolute", "trunk", "hip", (x, y, 0), (0, 0, np.arctan2(y, x)), (0, 0, 1), (-1.2, 1.2)),
            ("lift", "revolute", "hip", "thigh", (coxa, 0, 0.01), (quarter, 0, 0), (0, 0, 1), (-1.5, 1.6)),
            ("knee", "revolute", "thigh", "shank", (femur, 0.0, lateral), (0, 0, 0), (0, 0, knee), (low, high)),
            ("ankle", "fixed", "shank", "toe", (tibia, 0.001, 0.002), (0, 0, 0), (0, 0, 1), (0, 0)),
        ):
            parent = parent if parent == "trunk" else f"{limb}_{parent}"
            parts.append(
                f'<joint name="{limb}_{name}" type="{kind}"><parent link="{parent}"/><child link="{limb}_{child}"/>'
                f'<origin xyz="{row(xyz)}" rpy="{row(rpy)}"/><axis xyz="{row(axis)}"/>'
                f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="9" velocity="9"/></joint>'
            )
    reach = hip + (coxa + 0.7 * np.hypot(femur, tibia)) * np.sqrt(0.5)
    return "<robot name='any'>" + "".join(parts) + "</robot>", reach


def keys(path, reach, height=0.1, links=LINKS, foot="toe"):
    limbs = {
        limb: {
            "joints": [f"{limb}_{link}" for link in links],
            "foot": f"{limb}_{foot}",
            "foothold": [x * reach, y * reach],
        }
        for limb, (x, y) in LIMBS.items()
    }
    return {"robot": {"file": str(path), "height": height, "limbs": limbs}}


def robot_of(sections):
    return load_robot(mc.Scenario.model_validate(sections).robot)


@pytest.fixture
def written(saved):
    """Return the keys of a robot file, with text of the URDF and keys replaced."""

    def write(seed=0, replace=(), change=lambda data: None, **how):
        text, reach = urdf(seed, **how)
        for old, new in replace:
            assert old in text
            text = text.replace(old, new)
        data = keys(saved(text, f"robot_{seed}.urdf"), reach)
        change(data["robot"])
        return data

    return write


@pytest.fixture
def loaded(written):
    """Return the robot of a file, by the arguments of `written`."""
    return lambda *given, **how: robot_of(written(*given, **how))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_a_urdf_moves_as_in_mujoco(written, engine, seed):
    """Every engine gives the accelerations that MuJoCo gives for the file itself, fixed links included, to 1e-9."""
    scenario = mc.Scenario.model_validate(written(seed))
    robot, gravity = load_robot(scenario.robot), (0.3, -0.2, -4.0)
    rng = np.random.default_rng(seed)
    angles = rng.uniform(robot.joint_lower.T, robot.joint_upper.T).T.ravel()
    rates, spin, tau = rng.normal(size=12), rng.normal(size=3), 0.1 * rng.normal(size=12)
    # no offset in velocity: the file's origin is at rest, so its centre of mass moves with spin x offset
    offset = robot.stance_position - [0, 0, scenario.robot.height]
    still = (np.zeros(3), np.array([1.0, 0, 0, 0]), np.cross(spin, offset), spin, angles, rates)
    state = mc.State(*map(jnp.asarray, still))
    ours = jax.jit(lambda *given: mc.forward_dynamics(*given, 0.0, gravity=gravity, robot=robot, engine=engine))(
        state, tau, jnp.zeros((4, 3)), jnp.zeros(6)
    )
    # the file set free, in MuJoCo: of the base's centre of mass, and of the joints by name
    spec = mujoco.MjSpec.from_file(scenario.robot.file)
    for part in (*spec.geoms, *spec.meshes):
        spec.delete(part)
    spec.compiler.fusestatic = False
    spec.body("trunk").add_freejoint()
    model = spec.compile()
    model.opt.gravity[:] = gravity
    data = mujoco.MjData(model)
    names = [f"{limb}_{link}" for limb in robot.limbs for link in LINKS]
    for name, angle, rate, torque in zip(names, angles, rates, tau, strict=True):
        data.joint(name).qpos[:], data.joint(name).qvel[:], data.joint(name).qfrc_applied[:] = angle, rate, torque
    data.qvel[3:6] = spin
    mujoco.mj_forward(model, data)
    a, alpha = data.qacc[:3], data.qacc[3:6]
    of_center = a + np.cross(alpha, offset) + np.cross(spin, np.cross(spin, offset))
    theirs = of_center, alpha, np.array([data.joint(name).qacc[0] for name in names])
    for mine, other in zip(dataclasses.astuple(ours), theirs, strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


@pytest.mark.parametrize("seed", range(3))
def test_the_closed_form_reaches_what_the_joints_reach(written, seed):
    """Inverse kinematics takes a foot ahead of its hip back to its posture, and the rest stance stands where told."""
    source = mc.Scenario.model_validate(written(seed)).robot
    robot = load_robot(source)
    geometry = limb_geometry(robot)
    rng = np.random.default_rng(seed)
    lower, upper = robot.joint_lower + 0.15, robot.joint_upper - 0.15  # off the stretched limb
    angles = np.concatenate([robot.stance_joints[None], rng.uniform(lower, upper, (400, 4, 3))])
    feet = limb_frames(robot, None, angles).foot
    solved = inverse_kinematics(geometry, feet)
    toward = np.stack([np.cos(angles[..., 0]), np.sin(angles[..., 0])], axis=-1)
    local = np.vecmat(feet - geometry.hip_position, geometry.hip_rotation)
    ahead = (local[..., :2] * toward).sum(-1) > 0.01
    assert ahead[0].all() and ahead.mean() > 0.3
    assert solved.reachable[ahead].all()
    assert np.abs(solved.joint_angles - angles)[ahead].max() < 1e-6
    again = limb_frames(robot, None, solved.joint_angles).foot
    assert np.abs(again - feet)[ahead].max() < 1e-9
    wanted = [(*getattr(source.limbs, limb).foothold, 0.0) for limb in robot.limbs]
    np.testing.assert_allclose(feet[0] + robot.stance_position, wanted, atol=1e-9)


def test_axes_along_each_other_are_exactly_so(loaded):
    """Kernels leave out what zeros and ones multiply, but not what 1e-17 does; 1.5708 is meant for a right angle."""
    robot = load_robot("hubrobo_v3_2")
    for value in (robot.frame_rotation, robot.frame_position):
        whole = np.round(value)
        near = abs(value - whole) < 1e-9
        assert near.any()
        np.testing.assert_array_equal(value[near], whole[near])
    rough, exact = (loaded(seed=1, quarter=quarter) for quarter in ("1.5708", "1.5707963267948966"))
    limb_geometry(rough)
    np.testing.assert_allclose(rough.frame_position, exact.frame_position, atol=1e-5)
    np.testing.assert_allclose(rough.stance_joints, exact.stance_joints, atol=1e-3)


def test_a_foot_off_a_frame_that_is_turned(loaded):
    """`at` is along the axes of the site, body or link that is named, not along the last link's or the world's."""
    plain = '" rpy="0 0 0"/><axis xyz="0 0 1"/><limit lower="0" upper="0"'
    at, rpy = np.array([0.01, -0.02, 0.015]), (0.3, -0.5, 1.1)
    feet = []
    for angles, offset in ((np.zeros(3), Rotation.from_euler("xyz", rpy).apply(at)), (rpy, at)):
        put_at = lambda robot, offset=offset: [limb.update(at=offset.tolist()) for limb in robot["limbs"].values()]  # noqa: E731
        feet.append(loaded(0, [(plain, plain.replace("0 0 0", row(angles), 1))], put_at).foot_center)
    np.testing.assert_allclose(feet[0], feet[1], atol=1e-12)


def put(value, *path):
    """Return a change of one key of a robot; None: without it."""

    def change(robot):
        for key in path[:-1]:
            robot = robot[key]
        robot[path[-1]] = value
        if value is None:
            del robot[path[-1]]

    return change


def test_friction_and_damping_of_the_file_are_taken(loaded):
    """A spring damps beside the file."""
    plain = loaded(0, [("</joint>", '<dynamics damping="0.1" friction="0.02"/></joint>')])
    np.testing.assert_array_equal(plain.damping, np.full((4, 3), 0.1))
    np.testing.assert_array_equal(plain.friction, np.full((4, 3), 0.02))
    slack = float(plain.stance_joints[plain.limbs.index("LF"), 2])
    springs = put({"LF_knee": {"stiffness": 2.0, "damping": 0.03, "rest": slack}}, "springs")
    robot = loaded(0, [("</joint>", '<dynamics damping="0.1"/></joint>')], springs)
    assert robot.damping[robot.limbs.index("LF"), 2] == pytest.approx(0.13)
    assert np.sort(robot.damping.ravel())[:-1] == pytest.approx(0.1)


JOINTS = [f"LF_{link}" for link in LINKS]
BAD = {  # text of the file that is replaced, keys that are, what is said
    "no file": ([], put("nowhere.urdf", "file"), "expected an MJCF or URDF"),
    "no XML": ([("<robot", "robot")], put(0.1, "height"), "expected an MJCF or URDF"),
    "no such joint": ([], put(["LF_yaw", "LF_lift", "elbow"], "limbs", "LF", "joints"), "LF.joints: expected revolute"),
    "order": ([], put(JOINTS[::-1], "limbs", "LF", "joints"), "limbs.LF.joints: expected a chain"),
    "another limb's joint": ([], put(["LF_yaw", "LH_lift", "LF_knee"], "limbs", "LF", "joints"), "expected a chain"),
    "twice": ([], put(JOINTS, "limbs", "LH", "joints"), "expected different joints"),
    "no such foot": ([], put("hoof", "limbs", "RF", "foot"), "limbs.RF.foot: expected a site"),
    "another's foot": ([], put("LF_toe", "limbs", "RF", "foot"), "limbs.RF.foot: expected a place"),
    "one joint more": ([(IMU, IMU.replace("fixed", "continuous"))], put(0.1, "height"), "no joints but those named"),
    "out of reach": ([], put([0.5, 0.5], "limbs", "LH", "foothold"), "limbs.LH.foothold: expected"),
    "no joint to hold": ([], put({"neck": 0.0}, "locked"), "robot.locked.neck: expected a revolute or prismatic joint"),
    "a limb's joint held": ([], put({"LF_yaw": 0.0}, "locked"), "robot.locked.LF_yaw: expected a joint of no limb"),
    "height of nothing": ([], put(0, "height"), "robot.height: expected a finite number above 0"),
    "three limbs": ([], put(None, "limbs", "LF"), "gait.sequence: expected the three limbs LH, RH, RF, each once"),
    "one joint": ([], put(["a"], "limbs", "LF", "joints"), "expected two joints or more of a limb that walks"),
    "places": ([], put([1, 2, 3], "limbs", "LF", "foothold"), "robot.limbs.LF.foothold: expected a list of two"),
    "another key": ([], put(1, "limbs", "LF", "toe"), "robot.limbs.LF.toe: expected one of joints, foot, at, foothold"),
    "misspelt": ([], put(1, "hight"), "did you mean height?"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_walked_is_refused_with_its_key(written, saved, name):
    replace, change, expected = BAD[name]
    config = saved(json.dumps(written(0, replace, change)), "walk.yaml")
    with pytest.raises((mc.RobotError, mc.ConfigError)) as refused:
        load_robot(mc.load_scenario(config).robot)
    assert expected in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_a_relative_path_starts_at_the_config(written, saved, monkeypatch):
    data = written(0)
    data["robot"]["file"] = Path(data["robot"]["file"]).name
    monkeypatch.chdir("/")
    scenario = mc.load_scenario(saved(json.dumps(data), "walk.yaml"))
    assert load_robot(scenario.robot).limbs == tuple(LIMBS)
    assert mc.load_scenario(saved(scenario.to_yaml(), "again.yaml")) == scenario


@pytest.mark.parametrize(
    ("theirs", "expected"),
    [
        (("{}_hip_joint", "{}_thigh_joint", "{}_calf_joint"), ("hip", "thigh", "calf")),
        (("j_c1_{}", "j_hip_pitch_{}", "j_tibia_{}"), ("c1", "hip pitch", "tibia")),
        (("{}.1", "{}.2", "{}.3"), ("joint1", "joint2", "joint3")),  # numbers are no names
        (("hip{}", "knee{}", "ankle{}"), ("joint1", "joint2", "joint3")),  # one word each, of every limb another
    ],
)
def test_joints_are_called_what_the_file_calls_them(loaded, theirs, expected):
    """In pictures and netCDF files, where the limb stands beside: without what tells the limbs apart."""
    own = {f"{limb}_{link}": name.format(limb) for limb in LIMBS for name, link in zip(theirs, LINKS, strict=True)}

    def renamed(robot):
        for limb in robot["limbs"].values():
            limb["joints"] = [own[name] for name in limb["joints"]]

    robot = loaded(0, [(f'joint name="{name}"', f'joint name="{other}"') for name, other in own.items()], renamed)
    assert (robot.joint_names, robot.limbs) == (expected, tuple(LIMBS))


def test_an_mjcf_is_a_file_like_any_other():
    """HubRobo's own MJCF as a user's: the robot is the one that comes by name."""
    ours = robot_of(keys(model_path("hubrobo_v3_2"), 0.14, 0.11, ("coxa", "femur", "tibia"), "foot"))
    named = load_robot("hubrobo_v3_2")
    np.testing.assert_allclose(ours.total_mass, named.total_mass)
    np.testing.assert_allclose(ours.stance_joints, named.stance_joints, atol=1e-9)
    np.testing.assert_allclose(ours.stance_position, named.stance_position, atol=1e-12)


# ------------------------------------------------------------------------------------------------------------
# HubRobo v2.2


def test_hubrobo_v2_2_is_climblabs():
    """Centres of mass, orientations, inertias and feet of the MJCF are those of the reference, at random angles."""
    model = load_model("hubrobo_v2_2")
    data = mujoco.MjData(model)
    angles = np.random.default_rng(0).uniform(-1, 1, 12)
    data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *angles]
    mujoco.mj_kinematics(model, data)
    of = lambda name: np.array([v if v is not None else [0, 0, 0] for v in REFERENCE[name]], float)  # noqa: E731
    start, own, child, foot, qi = map(of, ("base_com_to_joint_c0", "link_com_to_own_joint_cc_ii",
                                           "link_com_to_child_joint_cc", "end_link_com_to_foot_ce", "Qi"))  # fmt: skip
    for limb in range(4):
        axes, joint = np.eye(3), start[3 * limb]
        for link in range(3 * limb, 3 * limb + 3):
            axes = axes @ Rotation.from_euler("XYZ", qi[link] + [0, 0, angles[link]]).as_matrix()
            center = joint - axes @ own[link]
            np.testing.assert_allclose(data.xipos[2 + link], center, atol=1e-12)
            principal = data.ximat[2 + link].reshape(3, 3)
            inertia = principal @ np.diag(model.body_inertia[2 + link]) @ principal.T
            expected = axes @ np.array(REFERENCE["link_inertia_about_com_in_link_frame"][link]) @ axes.T
            np.testing.assert_allclose(inertia, expected, atol=1e-15)
            joint = center + axes @ child[link]
        np.testing.assert_allclose(data.site_xpos[limb], center + axes @ foot[3 * limb + 2], atol=1e-12)
    np.testing.assert_allclose(model.body_mass[1:], [REFERENCE["base_mass"], *REFERENCE["link_mass"]])
    limits = np.degrees(model.jnt_range[1:]).reshape(4, 3, 2)
    np.testing.assert_allclose(limits, np.broadcast_to(REFERENCE["joint_limit_deg"], (4, 3, 2)))


def test_a_step_too_long_for_the_contacts_is_known_before_the_walk():
    """1 ms is short enough for v3.2 and too long for v2.2, for which 0.1 ms is."""
    heavy, light = mc.Scenario(robot="hubrobo_v3_2"), mc.Scenario(robot="hubrobo_v2_2")
    assert growth(heavy) < 1 < growth(light)
    assert largest_time_step(light) == 1e-4
    assert growth(light, 1e-4) < 1 < growth(light, 2e-4)
    softer = light.with_overrides({"contact.stiffness": 1e3, "contact.damping": 0.5, "control.kd": 0.01})
    assert largest_time_step(softer) > largest_time_step(light)


def long_strides(kd):
    """v3.2 with strides of twice the usual length; its limbs go 84 mm of each from the stance, ahead or back."""
    return mc.Scenario().with_overrides({"gait.cycle": 8.0, "gait.stride": 0.1, "control.kd": kd})


def test_the_time_step_is_that_of_the_postures_which_the_gait_plans():
    """Between kd 0.55 and 0.6 the walks begin to diverge; a gait among the gains counts as the scenario's own."""
    assert growth(long_strides(0.55)) < 1 < growth(long_strides(0.6))
    usual = mc.Scenario().with_overrides({"control.kd": 0.59})
    check_time_step(usual)
    with pytest.raises(mc.ConfigError, match=r"control.kd 0.59, got 0\.001"):
        mc.rollout(usual, gains={"gait.cycle": 8.0})


@pytest.mark.slow
def test_walks_diverge_where_the_time_step_is_too_long_for_a_planned_posture():
    """In weightlessness pd holds with 0.1 N."""
    walks = long_strides(0.2).with_overrides({"control.controller": "pd", "gravity": [0, 0, 0], "duration": 2.5})
    forces = mc.rollout_metrics(walks, {"kd": (kd := np.array([0.55, 0.6]))}, unsteady=True)["peak_foot_force"]
    assert [growth(long_strides(each)) > 1 for each in kd] == (forces > 10).tolist() == [False, True]


def test_limbs_that_are_stretched_to_chosen_footholds_take_a_shorter_step():
    """1 ms is short enough for the stances that v3.2 plans, and not for the farthest holds that it may choose."""
    rock = mc.load_scenario("hubrobo_v3_2_rock")
    assert growth(rock) < 1 < growth(rock, 1e-3)
    planned = mc.Scenario(robot="hubrobo_v3_2")
    holds = own_parameters(planned)
    holds = dataclasses.replace(holds, ground=dataclasses.replace(holds.ground, holds=ground.of(np.zeros((1, 3)))))
    check_time_step(planned, parameters=holds)
    for changes in ({"footholds": Nearest()}, {"recovery": Recovery()}):
        with pytest.raises(mc.ConfigError, match=r"0\.2, limbs stretched to .* got 0\.001 .*: 0\.0005 would do"):
            check_time_step(planned, parameters=dataclasses.replace(holds, **changes))


class Bare(mc.Contact):
    """It does not say by which springs it holds."""

    def init(self, grip_point, rotation):
        return ()

    def step(self, memory, feet, turning, closed, ground):
        raise AssertionError("nobody walks")


class Springy(Bare):
    """It says by which springs it holds."""

    stiff: object = mc.parameter("N/m", bounds=(0.0, np.inf))

    def springs(self):
        return Springs(self.stiff, np.asarray(20.0))


class Damped(Springy):
    """Its springs have dampers of their own."""

    damped: object = mc.parameter("N s/m", bounds=(0.0, np.inf))

    def springs(self):
        return Springs(self.stiff, self.damped)


class Sprung(mc.Actuator):
    """It says by which springs it holds."""

    stiff: object = mc.parameter("N m/rad", bounds=(0.0, np.inf))
    damped: object = mc.parameter("N m s/rad", bounds=(0.0, np.inf))
    heavy: object = mc.parameter("kg m^2", bounds=(0.0, np.inf), default=0.0)

    def spring(self, period):
        return JointSpring(self.stiff, self.damped, self.heavy)

    def init(self, angles):
        return ()

    def step(self, memory, targets, gains, joints, period):
        raise AssertionError("nobody walks")


@pytest.mark.filterwarnings("ignore:Bare has no method springs")
def test_a_contact_and_an_actuator_of_ones_own_are_checked_by_their_own_springs():
    scenario = mc.Scenario()
    contact, control, own = scenario.contact, scenario.control, own_parameters(scenario)
    stiff = scenario.with_overrides({"contact.stiffness": 1e6, "control.kp": 2e3, "control.kd": 30.0})
    alike = {"contact": Springy(contact.stiffness), "drive": Sprung(control.kp, control.kd)}
    assert growth(scenario, None, dataclasses.replace(own, **alike)) == growth(scenario)
    assert growth(scenario, None, dataclasses.replace(own, drive=Sprung(2e3, 30.0, 0.03))) < growth(stiff)
    heavier = {"hardware.servo.armature": np.array([0.02, 0.03])}
    check_time_step(scenario, parameters=own.replace({"control.kp": 2e3, "control.kd": 30.0} | heavier))
    soft = {"contact": Gripper(), "drive": VelocityCommanded(velocity_gain=np.array([1.0, 5.0]))}
    check_time_step(stiff, parameters=dataclasses.replace(own_parameters(stiff), **soft))
    for changes, said in (
        ({"contact": Springy(np.array([9e3, 1e6]))}, "with Springy of 1e+06 N/m and 20 N s/m, control.kp"),
        # the softer one of two is damped too much
        (
            {"contact": Damped(np.array([9e3, 1e4]), np.array([5e3, 20.0]))},
            "with Damped of 9000 N/m and 5000 N s/m, control.kp",
        ),
        (
            {"contact": Gripper(stiffness=np.array([9e3, 1e6]))},
            "with contact.stiffness 1e+06, contact.damping 20, control.kp",
        ),
        (
            {"contact": Bare(), "joint_loop": JointLoop(kp=np.asarray(2e3), kd=np.asarray(30.0))},
            "with Bare, whose springs are not known, control.kp 2000 and",
        ),
    ):
        with pytest.raises(mc.ConfigError, match=re.escape(said)):
            check_time_step(scenario, parameters=dataclasses.replace(own, **changes))


@pytest.mark.parametrize("given", ["gains", "numbers"])
def test_joint_gains_that_are_given_count_for_the_time_step(given):
    """kp and kd from elsewhere than the scenario: what is too stiff for the step is refused, its own gains are not."""
    scenario = mc.Scenario(robot="hubrobo_v3_2")
    stiff = {"kp": 2e3, "kd": 30.0}
    numbers = mc.parameters(scenario)
    check_time_step(scenario, parameters=numbers)
    replaced = numbers.replace({f"control.{name}": np.asarray(value) for name, value in stiff.items()})
    with pytest.raises(mc.ConfigError, match=r"control.kp 2000 and control.kd 30, got 0\.001"):
        mc.rollout(scenario, **({"gains": stiff} if given == "gains" else {"parameters": replaced}))


STIFF = r"^scenario: time_step: .* control.kp 2000 and control.kd 30, got 0\.001"


@pytest.mark.parametrize("given", ["gains", "numbers"])
def test_each_robot_of_a_batch_counts_for_the_time_step(given):
    """By every method: one that is too stiff is named, though each of its values is that of a robot that is not."""
    scenario = mc.Scenario(robot="hubrobo_v3_2")
    stiff = {"kp": np.array([50.0, 2e3, 40.0]), "kd": np.array([0.2, 30.0, 0.1])}
    numbers = mc.parameters(scenario)
    replaced = numbers.replace({f"control.{name}": value for name, value in stiff.items()})
    call = {"gains": stiff} if given == "gains" else {"parameters": replaced}
    simulation = mc.Simulation(scenario)
    for method in (simulation.metrics, simulation.histories, simulation.simulate, simulation.reset):
        with pytest.raises(mc.ConfigError, match=STIFF):
            method(**call)
    with pytest.raises(mc.ConfigError, match=STIFF):
        simulation.jvp({"damping": 1e2}, {"damping": np.ones(1)}, replaced)


@pytest.mark.slow
def test_robots_of_a_batch_that_are_stiff_in_turn_are_not_one_that_is_so_in_all():
    """Against the eigenvalues of each robot alone."""
    scenario = mc.Scenario(robot="hubrobo_v3_2")
    rng = np.random.default_rng(1)
    paths = ("control.kp", "control.kd", "contact.stiffness", "contact.damping")
    own = {path: float(mc.parameters(scenario).at(path)) for path in paths}
    rows = [{path: value * np.exp(rng.uniform(-3, 4)) for path, value in own.items()} for _ in range(24)]
    short = [growth(scenario.with_overrides(row)) <= 1 + 1e-7 for row in rows]
    assert 3 < sum(short) < 21
    assert growth(scenario.with_overrides({path: max(row[path] for row in rows) for path in paths})) > 1

    def batch(rows):
        return mc.parameters(scenario).replace({path: np.array([row[path] for row in rows]) for path in paths})

    sound = [row for row, fine in zip(rows, short, strict=True) if fine]
    check_time_step(scenario, parameters=batch(sound))
    for row in (row for row, fine in zip(rows, short, strict=True) if not fine):
        with pytest.raises(mc.ConfigError, match=rf"control\.kp {row['control.kp']:g} and"):
            check_time_step(scenario, parameters=batch([*sound, row]))


@pytest.mark.nightly
def test_the_suggested_step_works_and_the_next_does_not(monkeypatch):
    """v2.2 walks at 0.1 ms, forces calm; 0.2 ms is refused, rightly: walked all the same, it blows up."""
    walks = mc.Scenario(robot="hubrobo_v2_2", duration=1.2).with_overrides({"control.controller": "pd"})
    good = mc.metrics(mc.rollout(walks.with_overrides({"time_step": largest_time_step(walks)})))
    too_long = walks.with_overrides({"time_step": 2e-4})
    with pytest.raises(mc.ConfigError, match=r"0\.0001 would do"):
        mc.rollout(too_long)
    monkeypatch.setattr(importlib.import_module("mjx_climb.simulation"), "check_time_step", lambda *_, **__: None)
    bad = mc.metrics(mc.rollout(too_long))
    assert not good["diverged"]
    assert good["peak_foot_force"] < 2 * 1.705 * 9.81
    assert bad["diverged"] or bad["peak_foot_force"] > 1e3


@pytest.mark.parametrize("name", ["case_1_2", "hexapod_ceiling", "station_arms_handrail"])
def test_a_scenario_names_the_limbs_in_the_robots_order(name):
    scenario = mc.load_scenario(name)
    assert scenario.limbs == load_robot(scenario.robot).limbs


def test_the_files_of_a_robot_are_those_beside_it_and_beside_its_includes(tmp_path):
    """An asset counts in the folders of the file and of each include, and of each of these in all above its own."""
    leg, toe = tmp_path / "parts" / "leg.xml", tmp_path / "parts" / "more" / "toe.xml"
    toe.parent.mkdir(parents=True)
    mesh = '<mesh name="{0}" file="deep/{0}.stl"/>'
    own = '<mujoco><compiler meshdir="geo"/><include file="parts/leg.xml"/><asset>{}</asset></mujoco>'
    (tmp_path / "robot.xml").write_text(own.format(mesh.format("a")))
    leg.write_text('<mujoco><include file="more/toe.xml"/></mujoco>')
    toe.write_text(f"<mujoco><asset>{mesh.format('b')}</asset></mujoco>")
    found = files_of(tmp_path / "robot.xml")
    beside = (tmp_path, leg.parent, toe.parent)
    places = [folder / place for folder in beside for place in ("geo/deep", "geo", ".")]
    assets = {place / f"{name}.stl" for place in places for name in "ab"}
    within = {each for each in found if each.is_relative_to(tmp_path)}
    assert within == {tmp_path / "robot.xml", leg, toe, *assets}
    assert {each.name for each in found - within} == {"a.stl", "b.stl"}


def test_the_files_of_a_robot_grow_with_its_meshes(tmp_path):
    """Each mesh in two folders counts alone: forty have four times as many places as ten."""
    counts = []
    for number in (10, 40):
        meshes = "".join(f'<mesh name="m{n}" file="m{n}.stl"/>' for n in range(number))
        file = tmp_path / f"robot{number}.xml"
        file.write_text(f'<mujoco><compiler meshdir="geo/obj"/><asset>{meshes}</asset></mujoco>')
        counts.append(len(files_of(file)) - 1)
    assert counts[1] == 4 * counts[0]


def test_a_robot_from_a_file_is_drawn_as_plain_shapes(saved):
    """A box around the first joints, one ahead in it, and for each joint a servo and a link; then a gripper."""
    model = load_model(RobotFile.model_validate(climbers.config(saved(climbers.mjcf(4, 3)), 4, 3)["robot"]))
    assert (model.geom_contype[:] | model.geom_conaffinity[:]).sum() == 0
    found = [
        (model.body(model.geom_bodyid[n]).name, mujoco.mjtGeom(model.geom_type[n]).name[7:].lower(),
         model.mat(model.geom_matid[n]).name, model.geom_pos[n].round(6).tolist(), model.geom_size[n].round(6).tolist())
        for n in range(1, model.ngeom)
    ]  # fmt: skip
    hip = 0.08 / np.sqrt(2)  # the base's centre is 3 mm ahead
    x, y = hip + 0.003, hip
    shapes = [
        ("base", "box", "shell", [0, 0, 0], [0.95 * x, 0.95 * y, 0.2 * y]),
        ("base", "box", "frame", [0.7 * x, 0, 0], [0.06 * x, 0.6 * y, 0.22 * y]),
    ]
    for limb in range(4):
        for joint, (length, material) in enumerate(((0.03, "frame"), (0.15, "shell"), (0.15, "frame")), 1):
            thick, end = min(0.12 * length, 0.014), length * (0.85 if joint == 3 else 1.0)
            body = f"limb{limb}_joint{joint}"
            shapes.append((body, "cylinder", "servo", [0, 0, 0], [1.2 * thick, 1.4 * thick, 0]))
            shapes.append((body, "capsule", material, [end / 2, 0, 0], [0.7 * thick, end / 2, 0]))
        shapes.append((body, "capsule", "gripper", [(length + end) / 2, 0, 0], [thick, (length - end) / 2, 0]))
    for one, other in zip(found, shapes, strict=True):
        assert one[:3] == other[:3]
        np.testing.assert_allclose(one[3], other[3], atol=2e-6)
        np.testing.assert_allclose(one[4], other[4], atol=2e-6)


@pytest.mark.parametrize("which", ["0 -1 {}", "{} -1 0"])
@pytest.mark.parametrize("tilt", [0.0, 0.4, 3.0])
def test_axes_near_a_yaw_and_two_pitches_are_exactly_these_and_others_the_files(which, tilt, saved):
    """By tilts in units of the tolerance: of both pitches along the yaw, or of the first one across the other."""
    text, axis = climbers.mjcf(4, 3), 'name="L1_{}" type="hinge" axis="{}"'
    for joint in (1, 2) if which == "0 -1 {}" else (1,):
        text = text.replace(axis.format(joint, "0 -1 0"), axis.format(joint, which.format(tilt * SNAP)))
    robot = load_robot(RobotFile.model_validate(climbers.config(saved(text), 4, 3)["robot"]))
    assert isinstance(limb_geometry(robot), Chain) == (tilt > 1)
    file, ours = mujoco.MjModel.from_xml_string(text), robot.model
    data, own = mujoco.MjData(file), mujoco.MjData(ours)
    angles = np.random.default_rng(0).uniform(-0.3, 0.3, 3)
    for joint, angle in enumerate(angles):
        data.joint(f"L1_{joint}").qpos[:] = angle
        own.joint(f"limb1_joint{joint + 1}").qpos[:] = angle
    mujoco.mj_kinematics(file, data)
    mujoco.mj_kinematics(ours, own)
    away = own.site("limb1_foot").xpos - own.body("base").xpos - (data.site("foot1").xpos - data.body("trunk").xipos)
    assert (np.abs(away).max() < 1e-9) == (tilt != 0.4)
