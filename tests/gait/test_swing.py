"""Swings that disturb the base little: their reaction against MuJoCo's, what is gained, and what stays as it was."""

import copy
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.polynomial import Chebyshev

import mjx_climb as mc
from mjx_climb.gait import schedule as gait
from mjx_climb.gait import swing
from mjx_climb.gait.swing import heights, swing_path
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from tests.robot import climbers

LOW = {"gait.swing": "low_reaction"}
STANCES = {
    "three limbs of five": (3, 5, {}, {}),
    "the last slides": (4, 3, {"slides": (2,)}, {"foothold": 0.45, "height": 0.1}),
    "two joints": (4, 2, {}, {"foothold": 0.11 + 0.3 * np.sqrt(1 - 0.3**2), "height": 0.09}),
}
SHAPES = ["hubrobo", "two at a time", *STANCES]


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    """Return scenarios with low-reaction swings: HubRobo one limb at a time, two at a time, and other shapes."""
    found = {"hubrobo": mc.Scenario().with_overrides(LOW)}
    two = {"gait.sequence": [["LF", "RH"], ["LH", "RF"]], "gait.duty": 0.5}
    found["two at a time"] = found["hubrobo"].with_overrides(two)
    for name, (limbs, joints, kind, stance) in STANCES.items():
        path = tmp_path_factory.mktemp("robots") / "robot.xml"
        path.write_text(climbers.mjcf(limbs, joints, **kind))
        data = climbers.config(path, limbs, joints, **stance)
        found[name] = mc.Scenario.model_validate(data).with_overrides({**LOW, "gait.stride": 0.04})
    return found


def swing_reaction(scenario, path):
    return swing.swing_reaction(load_robot(scenario.robot), scenario.gait, False, path)


def by_mujoco(scenario, walked, limb):
    """Return force and moment of a limb on the base by inverse dynamics of a model that weighs nothing elsewhere."""
    robot, cycle = load_robot(scenario.robot), scenario.gait.cycle
    model = copy.copy(robot.model)
    others = np.ones(model.nbody, bool)
    others[2 + limb * robot.joints : 2 + (limb + 1) * robot.joints] = False
    model.body_mass[others], model.body_inertia[others], model.opt.gravity[:] = 0.0, 0.0, 0.0
    data, total, found = mujoco.MjData(model), np.zeros(model.nv), []
    data.qpos[:] = model.key_qpos[0]
    own, middle = limb * robot.joints + np.arange(robot.joints), len(walked.time) // 2
    for half in (slice(0, middle), slice(middle, None)):
        times = walked.time[half]
        curves = [Chebyshev.fit(times, joint, middle - 1) for joint in walked.joints[half, limb].T]
        for time in times:
            data.qpos[7 + own], data.qvel[6 + own], data.qacc[6 + own] = (
                [curve.deriv(order)(time) if order else curve(time) for curve in curves] for order in range(3)
            )
            phase = scenario.gait.lift_off[robot.limbs[limb]] + time / cycle
            data.qacc[0] = scenario.gait.stride * (6 - 12 * phase) / cycle**2
            for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
                stage(model, data)
            mujoco.mj_rne(model, data, 1, total)
            found.append([-total[:3], -data.xmat[1].reshape(3, 3) @ total[3:6]])
    return np.moveaxis(np.array(found), 1, 0)


def test_a_swing_that_settles_is_one_of_a_shorter_time():
    """A fifth of it over the foothold: as in a gait whose feet stand for longer."""
    path = np.random.default_rng(0).normal(0, 0.01, (4, 3, swing.COUNT))
    settles, longer, neither = (
        jax.tree.leaves(swing_reaction(mc.Scenario().with_overrides(LOW | gait), path))
        for gait in ({"gait.settling": 0.2, "gait.duty": 0.75}, {"gait.duty": 0.8}, {"gait.duty": 0.75})
    )
    for one, same in zip(settles, longer, strict=True):
        np.testing.assert_allclose(one, same, rtol=1e-7, atol=1e-9)
    assert not all(np.allclose(one, other) for one, other in zip(settles, neither, strict=True))


@pytest.mark.parametrize("name", SHAPES)
def test_the_reaction_is_mujocos(robots, name):
    """Forces and moments of every limb's swing agree with inverse dynamics of the same joint path to 1e-8."""
    scenario = robots[name]
    walked = swing_reaction(scenario, swing_path(scenario, load_robot(scenario.robot)))
    for limb in range(walked.joints.shape[1]):
        force, moment = by_mujoco(scenario, walked, limb)
        np.testing.assert_allclose(walked.force[:, limb], force, atol=1e-8 * np.abs(force).max())
        np.testing.assert_allclose(walked.moment[:, limb], moment, atol=1e-8 * np.abs(moment).max())


def summed(walked, limbs):
    """Return the integral of the squared wrench of some limbs together."""
    wrench = np.concatenate([walked.force, walked.moment / walked.length], axis=-1)[..., limbs, :].sum(-2)
    return np.einsum("s,s...i,s...i->...", walked.weight, wrench, wrench)


@pytest.mark.parametrize("name", SHAPES)
def test_no_swing_nearby_puts_less_on_the_base(robots, name):
    """The integral is below the cubic's, and a twentieth of a step height in any direction does not lower it.

    Limbs of two joints cannot follow another path, and keep the cubic. Joints keep their limits, the feet their ways.
    """
    scenario = robots[name]
    robot, path = load_robot(scenario.robot), swing_path(scenario, load_robot(scenario.robot))
    lift_off = np.array([scenario.gait.lift_off[limb] for limb in robot.limbs])
    aside = path + 0.05 * np.random.default_rng(1).normal(size=(20, *path.shape))
    least, around = swing_reaction(scenario, path), swing_reaction(scenario, aside)
    cubic = swing_reaction(scenario, np.zeros_like(path))
    for start in np.unique(lift_off):
        limbs = np.flatnonzero(lift_off == start)
        ratio = summed(least, limbs) / summed(cubic, limbs)
        if name == "two joints":
            assert ratio == 1
        else:
            assert ratio < 0.995 and summed(around, limbs).min() > 0.999 * summed(least, limbs)
    lower = np.minimum(robot.joint_lower, cubic.joints.min(0))
    upper = np.maximum(robot.joint_upper, cubic.joints.max(0))
    assert (least.joints > lower - 1e-8).all() and (least.joints < upper + 1e-8).all()
    assert (least.missed.max(0) <= cubic.missed.max(0) + 1e-8).all()
    assert (heights(np.linspace(0, 1, 1001), path) > -1e-6).all()
    np.testing.assert_allclose(heights(np.array([0.0, 0.5, 1.0]), path).T, [[0, 1, 0]] * len(robot.limbs), atol=1e-12)


def test_the_nominal_posture_is_the_one_a_walk_settles_at(robots):
    """Five joints, two of them spare: the walk's own inverse kinematics stay where the nominal swing is."""
    scenario = robots["three limbs of five"]
    robot, walked = (
        load_robot(scenario.robot),
        swing_reaction(scenario, swing_path(scenario, load_robot(scenario.robot))),
    )
    feet = limb_frames(robot, None, walked.joints).foot
    follow = functools.partial(inverse_kinematics, limb_geometry(robot), feet)
    np.testing.assert_allclose(follow(walked.joints).joint_angles, walked.joints, atol=1e-9)
    pulled = follow(walked.joints + 0.01).joint_angles
    assert np.abs(pulled - walked.joints).max() > 1e-4  # another posture with the feet there does not stay


@pytest.mark.slow
def test_swings_stay_above_uneven_ground(robots):
    """On steps up and down the added path comes on top: nowhere below the terrace under the foot.

    `tests/walk/test_oracle.py` has the path itself, its turn with the heading and its growth with the step height.
    """
    rough = {"LF": [0.0, 0.02], "LH": [0.02, 0.0], "RH": [0.01, 0.0], "RF": [0.0, 0.0]}
    scenario = robots["hubrobo"].with_overrides({"ground.footholds": rough})
    robot = load_robot(scenario.robot)
    feet = limb_frames(robot, None, robot.stance_joints).foot + robot.stance_position
    lift_off = tuple(scenario.gait.lift_off.items())
    plan = gait.plan(robot, feet, mc.parameters(scenario), lift_off, scenario.time_step)

    def at(step):
        return gait.foot_targets(plan, gait.schedule(plan, step), gait.first_footholds(plan))

    height = np.asarray(jax.vmap(at)(jnp.arange(0, 1000, 10)))[:, 1, 2]
    assert (height[:50] >= 0.02 - 1e-12).all() and (height[50:] >= -1e-12).all()
    assert height.max() >= 0.02 + scenario.gait.step_height


def test_a_swing_out_of_reach_stays_the_cubic(robots):
    """A stride that only two of HubRobo's limbs can follow: the others keep what they have."""
    scenario = robots["hubrobo"].with_overrides({"gait.stride": 0.3})
    path = swing_path(scenario, load_robot(scenario.robot))
    walked, cubic = (swing_reaction(scenario, one) for one in (path, np.zeros_like(path)))
    missed = cubic.missed.max(0) > 1e-9
    assert 0 < missed.sum() < 4
    np.testing.assert_array_equal((path != 0).any((1, 2)), ~missed)
    each = np.arange(4)[:, None]
    assert (summed(walked, each) <= summed(cubic, each)).all()


@pytest.mark.nightly
def test_tangents_through_low_reaction_swings(robots):
    """Derivatives of a walk by a gain and by the added path agree with central differences."""
    small = {"duration": 0.3, "gait.cycle": 0.8, "gait.stride": 0.01, "gait.step_height": 0.01}
    scenario = robots["hubrobo"].with_overrides({**small, "gravity": [0, 0, -1.6]})
    walk, numbers = mc.simulator(scenario, smooth=True), mc.parameters(scenario)

    def measured(change):
        gains = mc.Gains(jnp.ones(6), 1e2 * (1 + change[0]) * jnp.ones(6), jnp.full(6, 3e3))
        walked = walk(gains, numbers.replace({"gait.swing_path": numbers.gait.swing_path * (1 + change[1])}))
        return jnp.stack([walked["force_variation"], walked["cost_of_transport"]])

    values, slopes = jax.jit(jax.vmap(lambda way: jax.jvp(measured, (jnp.zeros(2),), (way,))))(jnp.eye(2))
    plain, step = jax.jit(measured), 1e-5
    for way, slope in zip(np.eye(2), slopes, strict=True):
        difference = (plain(step * way) - plain(-step * way)) / (2 * step)
        np.testing.assert_allclose(slope, difference, rtol=1e-5)
        assert (np.abs(slope) > 1e-6 * np.abs(values[0])).all()


@pytest.mark.parametrize("firm", [False, True])
def test_a_swing_is_planned_for_feet_as_the_grips_hold_them(tmp_path, firm):
    """Grips that transmit moments keep the attitude of a foot, where limbs have six joints."""
    (tmp_path / "robot.xml").write_text(climbers.mjcf(3, 6))
    data = climbers.config(tmp_path / "robot.xml", 3, 6)
    change = {**LOW, "gait.stride": 0.04, "contact.rotational_stiffness": 5.0 if firm else 0.0}
    scenario = mc.Scenario.model_validate(data).with_overrides(change)
    path, robot = own_parameters(scenario).gait.swing_path, load_robot(scenario.robot)
    np.testing.assert_array_equal(path, swing_path(scenario, robot, firm))
    assert np.abs(path - swing_path(scenario, robot, not firm)).max() > 1e-6
