"""Robots of other shapes than HubRobo's: read from a file, posed, and walked as MuJoCo walks them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.physics.inverse_kinematics import Chain, inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from tests import oracle
from tests.robot import climbers

MOON = (0.8, 0.0, -1.4)  # m/s^2, on a slope of 30 degrees
OF_SLIDES = {"foothold": 0.45, "height": 0.1}  # m, a stance well within the limits of limbs whose last joint slides
ON_AN_ARC = {"foothold": 0.11 + 0.3 * np.sqrt(1 - 0.3**2), "height": 0.09}  # m, where two joints can put a foot


@pytest.fixture
def climber(tmp_path):
    """Return the scenario of a climber, `climber(limbs, joints, keys={...}, more={...})`, `more` about the robot."""

    def build(limbs, joints, keys=(), foothold=0.24, height=0.12, more=None, **how):
        path = tmp_path / "climber.xml"
        path.write_text(climbers.mjcf(limbs, joints, **how))
        data = climbers.config(path, limbs, joints, foothold=foothold, height=height, **more or {})
        return mc.Scenario.model_validate(data).with_overrides(dict(keys))

    return build


def feet_of(robot, angles):
    return limb_frames(robot, None, angles).foot


def case(*values, name="", marks=pytest.mark.nightly):
    return pytest.param(*values, id=name, marks=marks)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joints", "slides", "stance"),
    [
        case(2, (), ON_AN_ARC, name="two", marks=pytest.mark.slow),
        case(4, (), {}, name="four", marks=()),
        *(case(joints, (), {}, name=str(joints)) for joints in (5, 6, 7)),
        case(3, (2,), OF_SLIDES, name="the last slides"),
        case(7, (2, 5), OF_SLIDES, name="of seven two slide", marks=pytest.mark.nightly),
    ],
)
def test_ten_thousand_targets_are_met_from_nearby(climber, joints, slides, stance):
    """A foothold that the joints can reach is met to 1e-6 m from the posture of one a few centimetres off."""
    robot = load_robot(climber(2, joints, slides=slides, **stance).robot)
    geometry = limb_geometry(robot)
    assert isinstance(geometry, Chain)
    rng = np.random.default_rng(0)
    middle, half = (robot.joint_lower + robot.joint_upper) / 2, (robot.joint_upper - robot.joint_lower) / 2
    angles = middle + 0.8 * half * rng.uniform(-1, 1, (joints, 2, 5000)).T
    feet, last = feet_of(robot, angles), angles + 0.02 * half * rng.uniform(-1, 1, (joints, 2, 5000)).T
    found, reachable = inverse_kinematics(geometry, feet, last)
    missed = np.linalg.norm(feet_of(robot, found) - feet, axis=-1)
    moved = np.linalg.norm(feet_of(robot, last) - feet, axis=-1)
    assert np.median(moved) > 2e-3
    # a limb stretched straight has no nearby postures: seven in ten thousand of those of four joints
    straight = np.abs(angles[..., 2]) < 0.3 if joints == 4 else np.zeros(moved.shape, bool)
    assert missed[~straight].max() < 1e-6
    assert np.median(missed) < 1e-13  # the last steps are exact: no pull towards the rest posture in them
    assert reachable.all()
    # central differences confirm the derivative, where the foot is not next to an axis of the hip
    push = 1e-6 * rng.normal(size=feet.T.shape).T
    there, here = (inverse_kinematics(geometry, feet + sign * push, last)[0] for sign in (1, -1))
    follow = lambda foot, last, way: jax.jvp(lambda f: inverse_kinematics(geometry, f, last)[0], (foot,), (way,))[1]  # noqa: E731
    slope = np.asarray(jax.jit(jax.vmap(follow))(feet, last, push / 1e-6))
    calm = ~straight & (np.abs(slope).max(-1) < 100)
    assert calm.mean() > 0.8
    np.testing.assert_allclose(slope[calm], ((there - here) / 2e-6)[calm], rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_out_of_reach_is_flagged_and_finite(climber):
    """A mile away, at the hip and at the base: values and derivatives are numbers, and what is out of reach says so."""
    robot = load_robot(climber(4, 4).robot)
    geometry = limb_geometry(robot)
    stance = feet_of(robot, robot.stance_joints)
    targets = np.stack([1e3 * stance, 3 * stance, 0 * stance, robot.frame_position[:, 0]])
    posture = np.stack([robot.stance_joints] * 4)
    solve = lambda foot, last: inverse_kinematics(geometry, foot, last)  # noqa: E731
    follow = jax.jit(jax.vmap(lambda foot, last: jax.jvp(lambda f: solve(f, last), (foot,), (jnp.ones_like(foot),))))
    for _ in range(30):
        solved, tangent = follow(targets, posture)
        posture = solved.joint_angles
        assert np.isfinite(posture).all() and np.isfinite(tangent.joint_angles).all()
        assert not solved.reachable[:2].any()


def test_springs_of_the_file_are_taken(climber):
    robot = load_robot(climber(4, 3, attributes='stiffness="2" springref="20"').robot)
    np.testing.assert_allclose(robot.spring, np.full((4, 3), 2.0))
    np.testing.assert_allclose(robot.spring_rest, np.full((4, 3), np.radians(20)))


def test_attitudes_are_kept_where_every_limb_can_turn_its_foot(climber):
    """Six driven joints in each limb, not in some."""
    springs = {"springs": {"L1_5": {"stiffness": 2.0, "damping": 0.02}}}
    geometries = [limb_geometry(load_robot(climber(3, 6, more=more).robot), turned=True) for more in ({}, springs)]
    assert [geometry.attitude is not None for geometry in geometries] == [True, False]


def test_limbs_of_fewer_joints_are_filled_up(climber):
    """A limb that names one joint less, the last held, stands and moves as MuJoCo has it."""
    limbs = climbers.config("", 4, 4)["robot"]["limbs"]
    limbs["limb2"]["joints"].pop()
    robot = load_robot(climber(4, 4, more={"limbs": limbs, "locked": {"L2_3": 0.3}}).robot)
    assert robot.joints == 4 and len(robot.limbs) == 4
    limb = robot.limbs.index("limb2")
    turned = robot.stance_joints.copy()
    turned[limb, 3] = 1.0
    np.testing.assert_allclose(feet_of(robot, turned)[limb], feet_of(robot, robot.stance_joints)[limb], atol=1e-12)
    assert robot.link_mass[limb, 3] < 1e-6 and robot.armature[limb, 3] > 0


HELD = {
    "contact.rotational_stiffness": 20.0, "contact.rotational_damping": 0.05, "contact.holding_limit": None,
    "duration": 2.0, "gait.cycle": 2.0, "gait.stride": 0.01, "gait.step_height": 0.005,
}  # fmt: skip
TRIPOD = {"gait.sequence": [["limb0", "limb2", "limb4"], ["limb1", "limb3", "limb5"]], "gait.duty": 0.6}
WALKS = {
    "four of four with damping and armature": (4, 4, {"duration": 0.4}),
    "six of three, tripod": (6, 3, TRIPOD),
    "four of seven": (4, 7, {}),
    "three, one slides": (3, 3, {}),
    "six of three, ripple": (6, 3, {"gait.phases": {f"limb{n}": n / 8 for n in range(6)}}),
    "eight of three": (8, 3, {"gait.duty": 0.9}),
    "four of four, ankles on springs": (4, 4, {}),
    "two of six, held by moments": (2, 6, HELD),
    "two of seven, held by moments": (2, 7, HELD),
    "four of six": (4, 6, {}),
    "four of two": (4, 2, {}),
    "four of three, booms that slide": (4, 3, {}),
}


@pytest.mark.parametrize(
    "name", [case(n, name=n, marks=pytest.mark.slow if "armature" in n else pytest.mark.nightly) for n in WALKS]
)
def test_a_walk_is_that_of_mujoco(climber, name):
    """On a lunar slope, all grippers holding, the oracle finds every history again."""
    limbs, joints, gait = WALKS[name]
    attributes = 'damping="0.05" armature="0.002"' if "damping" in name else ""
    slides = (2,) if "slide" in name else ()
    keys = {
        "control.controller": "pd", "gravity": list(MOON), "duration": 1.0, "gait.cycle": 0.8,
        "gait.stride": 0.02, "gait.step_height": 0.01, "contact.stiffness": 2e3, "time_step": 0.0005, **gait,
    }  # fmt: skip
    stance = OF_SLIDES if slides else ON_AN_ARC if joints == 2 else {}
    ankles = {f"L{limb}_3": {"stiffness": 2.0, "damping": 0.02} for limb in range(limbs) if "ankles" in name}
    scenario = climber(limbs, joints, keys, more={"springs": ankles}, slides=slides, attributes=attributes, **stance)
    check_time_step(scenario)
    walk = mc.rollout(scenario)
    assert not walk.detached.any() and (walk.reachable.mean() > 0.999) == (joints > 2)  # two joints reach a surface
    assert (np.abs(walk.foot_moment).max() > 0.1) == ("moments" in name)
    if ankles:
        assert np.abs(walk.joint_angles[..., 3]).max() > 1e-3 and not walk.joint_torque[..., 3].any()
    oracle.assert_is(walk)
    assert np.ptp(walk.joint_angles, axis=0).max() > 0.01


@pytest.mark.slow
@pytest.mark.nightly
def test_the_gradient_of_a_walk_of_an_odd_shape(climber):
    """Three limbs of four joints, the last on springs, grips that hold turns: slopes are central differences."""
    springs = {f"L{limb}_3": {"stiffness": 2.0, "damping": 0.02} for limb in range(3)}
    keys = {
        "gravity": list(MOON), "duration": 0.1, "gait.cycle": 0.4, "gait.stride": 0.01, "gait.step_height": 0.005,
        "contact.stiffness": 2e3, "contact.rotational_stiffness": 5.0, "contact.rotational_damping": 0.01,
        "time_step": 0.0005,
    }  # fmt: skip
    scenario = climber(3, 4, keys, more={"springs": springs}, attributes='damping="0.05"')
    six = np.ones((1, 6))
    gains = mc.Gains(six, 1e2 * six, 3e3 * six, kp=np.full(1, 50.0), kd=np.full(1, 0.2))
    rates = mc.Gains(
        np.zeros((2, 1, 6)), np.stack([1e2 * six, 0 * six]), np.stack([3e3 * six, 0 * six]),
        kp=np.array([[0.0], [50.0]]), kd=np.array([[0.0], [0.2]]),
    )  # fmt: skip
    walk = {"dtype": np.float64, "smooth": True}
    _, slopes = mc.rollout_jvp(scenario, gains, rates, **walk)
    step, moved = 1e-5, []
    for sign in (1, -1):
        there = jax.tree.map(lambda g, r, sign=sign: g + sign * step * r[:, 0], gains, rates)
        moved.append(mc.rollout_metrics(scenario, there, **walk))
    for name in ("peak_foot_force", "force_variation", "base_deviation", "travel", "cost_of_transport"):
        differences = (moved[0][name] - moved[1][name]) / (2 * step)
        size = 1e-4 * np.abs(differences).max()
        np.testing.assert_allclose(slopes[name][:, 0], differences, rtol=1e-4, atol=size, err_msg=name)
        assert np.abs(differences).max() > 0
