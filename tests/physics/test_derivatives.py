"""Derivatives of the accelerations: by the inverse dynamics, against derivatives of the equations themselves."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_climb.physics import limb_engine
from mjx_climb.physics.inverse_dynamics import missing_forces
from mjx_climb.physics.state import Acceleration, Loads, State
from mjx_climb.robot.constants import robot_from_model
from mjx_climb.robot_import.load import load_robot
from tests.physics.mujoco_dynamics import apply, set_state
from tests.physics.test_shapes import SHAPES, mjcf

BATCH = 5
QUICK = "two of two, one slides"  # XLA compiles by the number of links
ROBOTS = {QUICK: (2, 2, (1,), 0.0), "hubrobo": None}
NIGHTLY = ("three of four, one slides", "four of two", "four booms")
ROBOTS |= {name: SHAPES[name] for name in NIGHTLY}


def by_the_equations(robot, state, *acting):
    """Return the accelerations with the derivatives of every operation."""
    return limb_engine.solved(robot, state, Loads(*acting))[1]


def by_the_engine(robot, *given):
    return limb_engine.build(robot)(*given)


def read(name):
    if name == "hubrobo":
        return jax.tree.map(jnp.asarray, load_robot("hubrobo_v3_2"))
    robot = robot_from_model(mujoco.MjModel.from_xml_string(mjcf(*ROBOTS[name])), "random")
    armature = np.random.default_rng(2).uniform(0.01, 0.05, robot.joint_lower.shape)
    return jax.tree.map(jnp.asarray, dataclasses.replace(robot, armature=armature))


def drawn(robot, seed=0):
    """Return state, torque, foot force, base wrench, cargo and gravity at random, of some robots."""
    rng, joints = np.random.default_rng(seed), robot.stance_joints.shape
    draw = lambda *shape: jnp.asarray(rng.normal(size=(BATCH, *shape)))  # noqa: E731
    orientation = draw(4)
    orientation = orientation / jnp.linalg.norm(orientation, axis=1, keepdims=True)
    state = State(draw(3), orientation, draw(3), draw(3), draw(*joints), draw(*joints))
    return state, draw(*joints), draw(joints[0], 3), draw(6), jnp.abs(draw()), draw(3)


def directions(given):
    """Return directions of all of it; the orientation keeps its length."""
    rng = np.random.default_rng(1)
    state, *acting = jax.tree.map(lambda value: jnp.asarray(rng.normal(size=value.shape)), given)
    orientation, change = given[0].base_orientation, state.base_orientation
    turning = change - orientation * (orientation * change).sum(1, keepdims=True)
    return dataclasses.replace(state, base_orientation=turning), *acting


def tangents(function, robot, given, ways, by_masses=1.0):
    """Return the derivatives of accelerations where the robot's constants move too, `by_masses` times theirs."""
    names = ["base_mass", "base_inertia", "link_mass", "link_center", "link_inertia", "frame_position", "foot_center"]
    names += ["armature"] if robot.armature is not None else []
    moved = {name: by_masses * n * getattr(robot, name) for n, name in enumerate(names, 1)}
    ways_of_robot = dataclasses.replace(jax.tree.map(jnp.zeros_like, robot), **moved)
    one = lambda given, ways: jax.jvp(function, (robot, *given), (ways_of_robot, *ways))[1]  # noqa: E731
    return jax.jit(jax.vmap(one))(given, ways)


def assert_equal(mine, theirs):
    for one, other in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-10 * np.abs(other).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.nightly] * (n != "hubrobo")) for n in ROBOTS])
def test_tangents_are_those_of_the_equations(name):
    """By the state, by all that acts, and by everything about the robot that may differ from one to the other."""
    robot = read(name)
    given = drawn(robot)
    both = (tangents(function, robot, given, directions(given)) for function in (by_the_engine, by_the_equations))
    assert_equal(*both)


def test_what_is_missing_at_any_accelerations_is_what_mujocos_inverse_dynamics_leave():
    """Of a robot with armature, a sliding joint and cargo: `tau + J^T F - (H qdd + c)`."""
    robot, model = read(QUICK), mujoco.MjModel.from_xml_string(mjcf(*ROBOTS[QUICK]))
    state, torque, foot_force, push, cargo, gravity = jax.tree.map(lambda value: value[0], drawn(robot))
    rng, joints = np.random.default_rng(3), robot.stance_joints.shape
    wanted = Acceleration(rng.normal(size=3), rng.normal(size=3), rng.normal(size=joints))
    loads = Loads(torque, foot_force, push, cargo, gravity)
    found = jax.jit(missing_forces)(robot, state, jax.tree.map(jnp.asarray, wanted), loads)

    model.opt.gravity[:], model.dof_armature[6:] = gravity, np.ravel(robot.armature)
    model.body_mass[1] += float(cargo)
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    set_state(data, *(np.asarray(each) for each in vars(state).values()))
    apply(model, data, np.ravel(torque), np.asarray(foot_force), np.asarray(push))
    push = np.asarray(push)
    mujoco.mj_applyFT(model, data, push[:3], push[3:], data.xipos[1], 1, data.qfrc_applied)
    to_base = data.xmat[1].reshape(3, 3).T
    data.qacc[:] = [*wanted.base_linear, *(to_base @ wanted.base_angular), *wanted.joints.ravel()]
    applied = data.qfrc_applied.copy()
    mujoco.mj_inverse(model, data)
    left = applied - data.qfrc_inverse
    force, moment = found.force + found.limb_force.sum(0), found.moment + found.limb_moment.sum(0)
    np.testing.assert_allclose(force, to_base @ left[:3], atol=1e-9)
    np.testing.assert_allclose(moment, left[3:6], atol=1e-9)
    np.testing.assert_allclose(np.ravel(found.joint), left[6:], atol=1e-9)


@pytest.mark.slow
def test_nothing_is_missing_at_the_accelerations_of_the_equations():
    """The inverse dynamics at what the forward dynamics give: no forces are left over, where those of 1 N act."""
    robot = read(QUICK)

    def missing(state, *acting):
        return missing_forces(robot, state, by_the_engine(robot, state, *acting), Loads(*acting))

    joint, *of_limbs, force, moment = jax.jit(jax.vmap(missing))(*drawn(robot))
    on_base = [own + limbs.sum(1) for own, limbs in zip((force, moment), of_limbs, strict=True)]
    for left in (joint, *on_base):
        np.testing.assert_allclose(left, 0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [(1, 3), *(pytest.param(m, marks=pytest.mark.nightly) for m in ((0,), (4,)))])
def test_tangents_where_some_of_it_moves(moving):
    """What does not move has no part: as where it moves by nothing."""
    robot = read(QUICK)
    given = drawn(robot)
    ways = directions(given)
    still = [way if n in moving else jax.tree.map(jnp.zeros_like, way) for n, way in enumerate(ways)]

    def some(values, ways):
        def accelerations(*moved):
            every = dict(enumerate(values)) | dict(zip(moving, moved, strict=True))
            return by_the_engine(robot, *every.values())

        return jax.jvp(accelerations, [values[n] for n in moving], [ways[n] for n in moving])[1]

    assert_equal(jax.jit(jax.vmap(some))(given, ways), tangents(by_the_engine, robot, given, still, 0.0))


@pytest.mark.slow
def test_gradients_are_the_tangents_turned_around():
    robot = read(QUICK)
    given = drawn(robot)
    state, torque, *others = jax.tree.map(lambda value: value[0], given)

    def size(torque):
        return sum((part**2).sum() for part in jax.tree.leaves(by_the_engine(robot, state, torque, *others)))

    way = directions(given)[1][0]
    along = jax.jit(lambda: jax.jvp(size, (torque,), (way,))[1])()
    assert float((jax.jit(jax.grad(size))(torque) * way).sum()) == pytest.approx(float(along), rel=1e-10)
