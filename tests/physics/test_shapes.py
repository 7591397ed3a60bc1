"""Robots of all shapes, two to eight limbs of two to seven joints, made at random: both engines against MuJoCo."""

import dataclasses
import re

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.physics import mjx_engine
from mjx_climb.robot.constants import robot_from_model
from tests.physics.mujoco_dynamics import mujoco_acceleration, relative_error, stacked

STATES = 100
GRAVITY = (0.3, -0.2, -4.0)
# limbs, joints of each, which of them slide, armature
SHAPES = {
    "two arms of seven": (2, 7, (), 0.0),
    "three of four, one slides": (3, 4, (2,), 0.0),
    "four of two": (4, 2, (), 0.0),
    "four of three with armature": (4, 3, (), 0.02),
    "four of four": (4, 4, (), 0.0),
    "four of six": (4, 6, (), 0.0),
    "four booms": (4, 3, (2,), 0.01),
    "six of three": (6, 3, (), 0.0),
    "four of seven, armature, two slide": (4, 7, (0, 4), 0.01),
    "eight of three": (8, 3, (), 0.0),
}
SLOW = ("four of three with armature", "three of four, one slides")


def numbers(values):
    return " ".join(f"{value:.17g}" for value in np.atleast_1d(values))


def unit(rng, size):
    vector = rng.normal(size=size)
    return vector / np.linalg.norm(vector)


def weight(rng):
    """Return an inertial element that a body can have, its axes turned."""
    sides = rng.uniform(0.02, 0.1, 3)
    mass = rng.uniform(0.1, 0.5)
    inertia = mass * (np.sum(sides**2) - sides**2)
    return f'quat="{numbers(unit(rng, 4))}" mass="{mass:.17g}" diaginertia="{numbers(inertia)}"/>'


def mjcf(limbs, joints, slides=(), armature=0.0, seed=0):
    """Return a robot with frames, axes, anchors and masses at random; a lone slide is one in every other limb."""
    rng = np.random.default_rng(seed)
    parts, qpos = [], [0, 0, 0.2, 1, 0, 0, 0]
    for limb in range(limbs):
        for joint in range(joints):
            kind = "slide" if joint in slides and (limb % 2 == 0 or len(slides) > 1) else "hinge"
            drive = armature * rng.uniform(0.5, 1.5)
            parts.append(
                f'<body name="limb{limb}_{joint}" pos="{numbers(rng.normal(scale=0.05, size=3))}" '
                f'quat="{numbers(unit(rng, 4))}"><joint type="{kind}" axis="{numbers(unit(rng, 3))}" '
                f'pos="{numbers(rng.normal(scale=0.02, size=3))}" armature="{drive:.17g}"/>'
                f'<inertial pos="{numbers(rng.normal(scale=0.03, size=3))}" {weight(rng)}'
            )
        parts.append(f'<site name="foot{limb}" pos="{numbers(rng.normal(scale=0.05, size=3))}"/>' + "</body>" * joints)
        qpos += [0.0] * joints
    return (
        '<mujoco><option><flag contact="disable" constraint="disable"/></option><worldbody><body name="base">'
        f'<freejoint/><inertial pos="0 0 0" {weight(rng)}{"".join(parts)}</body></worldbody>'
        f'<keyframe><key qpos="{numbers(qpos)}"/></keyframe></mujoco>'
    )


@pytest.mark.parametrize(
    ("engine", "name"),
    [pytest.param("limb", name, marks=pytest.mark.slow) for name in SLOW]
    + [pytest.param("limb", name, marks=pytest.mark.nightly) for name in SHAPES if name not in SLOW]
    + [pytest.param("mjx", name, marks=pytest.mark.nightly) for name in SHAPES],  # slow to compile
)
def test_accelerations_are_those_of_mujoco(engine, name):
    """A hundred random states under torques, foot forces and a push: each acceleration to 1e-9 of its vector."""
    limbs, joints, slides, armature = SHAPES[name]
    model = mujoco.MjModel.from_xml_string(mjcf(*SHAPES[name]))
    robot = robot_from_model(model, "random")
    assert (len(robot.limbs), robot.joints) == (limbs, joints)
    assert (robot.armature is not None) == (armature > 0) and bool(robot.slides) == bool(slides)
    rng = np.random.default_rng(1)
    batch = lambda *shape: rng.normal(size=(STATES, *shape))  # noqa: E731
    orientation = batch(4)
    orientation /= np.linalg.norm(orientation, axis=-1, keepdims=True)
    state = mc.State(batch(3), orientation, batch(3), batch(3), batch(limbs * joints), batch(limbs * joints))
    given = state, batch(limbs * joints), batch(limbs, 3), batch(6)
    ours = mc.forward_dynamics(*given, 0.0, robot=robot, engine=engine, gravity=GRAVITY)
    model.opt.gravity[:] = GRAVITY
    assert relative_error(stacked(ours), mujoco_acceleration(model, given[0], given[1:])) < 1e-9


def test_the_model_of_mjx_has_a_robots_armature_once_and_its_cargo():
    """Whatever armature the file has: that of the robot, of which a walk makes more, takes its place."""
    model = mujoco.MjModel.from_xml_string(mjcf(*SHAPES["four of three with armature"]))
    robot = robot_from_model(model, "random")
    assert model.dof_armature[6:].min() > 0
    robot = dataclasses.replace(robot, armature=1.5 * robot.armature)
    ours, _ = mjx_engine.model_of(robot, jnp.asarray(0.7), jnp.asarray(GRAVITY), jnp.float64)
    np.testing.assert_allclose(ours.dof_armature[6:], 1.5 * model.dof_armature[6:], rtol=1e-12)
    mass = model.body_mass.copy()
    mass[1] += 0.7
    np.testing.assert_allclose(ours.body_mass, mass, rtol=1e-12)
    np.testing.assert_array_equal(ours.opt.gravity, GRAVITY)


GOOD = mjcf(2, 2)
LONE = re.sub(r'<body name="limb.*</body></body>(?=</body></worldbody>)', "", GOOD)
NO_ROBOTS = {
    "nothing": "<mujoco/>",
    "no limb": LONE,
    "feet without links": LONE.replace("</body></worldbody>", "<site/></body></worldbody>"),
    "a base beside its centre of mass": GOOD.replace('<inertial pos="0 0 0"', '<inertial pos="0 0 1e-3"'),
    "two joints in a link": GOOD.replace("<joint", '<joint axis="1 0 0"/><joint', 1),
    "no feet": re.sub("<site[^>]*>", "", GOOD),
    "links that do not share out": re.sub(r'<body name="limb1_1".*?</body>', "<site/>", GOOD),
    "no stance": re.sub("<keyframe>.*</keyframe>", "", GOOD),
}


@pytest.mark.parametrize("name", NO_ROBOTS)
def test_a_model_that_is_no_robot_of_limbs_is_refused(name):
    text = re.sub("<keyframe>.*</keyframe>", "", NO_ROBOTS[name]) if name != "no stance" else NO_ROBOTS[name]
    model = mujoco.MjModel.from_xml_string(text)
    assert len(robot_from_model(mujoco.MjModel.from_xml_string(GOOD), "good").limbs) == 2
    stance = None if name == "no stance" else model.qpos0
    with pytest.raises(mc.RobotError, match=r"^name: expected a floating base with its frame"):
        robot_from_model(model, "name", stance)
