"""Rates of change of the accelerations: by the inverse dynamics, against derivatives of the equations themselves."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_climb.compilation.cpu_pieces import in_kernels
from mjx_climb.dynamics import limb_engine
from mjx_climb.dynamics.inverse_dynamics import missing_forces
from mjx_climb.dynamics.state import Acceleration, State
from mjx_climb.robot.constants import load_robot, robot_from_model
from tests.dynamics.test_shapes import SHAPES, mjcf

BATCH = 5
QUICK = "two of three, one slides"  # XLA compiles by the number of links
ROBOTS = {QUICK: (2, 3, (1,), 0.0), "hubrobo": None}
ROBOTS |= {name: SHAPES[name] for name in ("three of four, one slides", "four booms", "four of two")}


def by_the_equations(robot, *given):
    """Return the accelerations (linear, angular, joints) with the derivatives of every operation."""
    made = limb_engine.accelerations(*limb_engine.equations(robot, *given))
    return made.base_linear, made.base_angular, made.joints


def by_the_engine(robot, *given):
    made = limb_engine.build(robot)(*given)
    return made.base_linear, made.base_angular, made.joints


@pytest.fixture(params=[pytest.param(name, marks=() if name == QUICK else pytest.mark.slow) for name in ROBOTS])
def robot(request):
    shape = ROBOTS[request.param]
    if shape is None:
        return jax.tree.map(jnp.asarray, load_robot("hubrobo_v3_2"))
    read = robot_from_model(mujoco.MjModel.from_xml_string(mjcf(*shape)), "random")
    armature = np.random.default_rng(2).uniform(0.01, 0.05, read.joint_lower.shape)
    return jax.tree.map(jnp.asarray, dataclasses.replace(read, armature=armature))


@pytest.fixture
def given(robot):
    """State, torque, foot force, base wrench, cargo and gravity at random, in the layout of the hot path."""
    rng, (joints, limbs) = np.random.default_rng(0), (robot.joints, len(robot.limbs))
    draw = lambda *shape: jnp.asarray(rng.normal(size=(*shape, BATCH)))  # noqa: E731
    orientation = draw(4)
    orientation = orientation / jnp.linalg.norm(orientation, axis=0)
    state = State(draw(3), orientation, draw(3), draw(3), draw(joints, limbs), draw(joints, limbs))
    return state, draw(joints, limbs), draw(3, limbs), draw(6), jnp.abs(draw()), draw(3)


@pytest.fixture
def rates(given):
    """Rates of all of it; the orientation keeps its length."""
    rng = np.random.default_rng(1)
    state, *acting = jax.tree.map(lambda value: jnp.asarray(rng.normal(size=value.shape)), given)
    orientation, rate = given[0].base_orientation, state.base_orientation
    turning = rate - orientation * (orientation * rate).sum(0)
    return dataclasses.replace(state, base_orientation=turning), *acting


def both(derivative, *values):
    """Return a derivative of the engine's accelerations, and of the equations', where something has some values."""
    wholes = [functools.partial(derivative, function) for function in (by_the_engine, by_the_equations)]
    return [jax.jit(in_kernels(whole))(*values) for whole in wholes]  # in one piece they take long to compile


def close(mine, expected):
    for one, other in zip(jax.tree.leaves(mine), jax.tree.leaves(expected), strict=True):
        scale = np.abs(other).max()
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-10 * scale)


def test_nothing_is_missing_at_the_accelerations_of_the_equations(robot, given):
    """The inverse dynamics, in frames of the links, of what the equations give, in those of the world."""
    state, *acting = given
    found = jax.jit(missing_forces)(robot, state, Acceleration(*jax.jit(by_the_equations)(robot, *given)), *acting)
    size = np.abs(found.limbs.force).max()
    assert size > 1
    for missing in (
        found.joint,
        found.base.force + found.limbs.force.sum(1),
        found.base.moment + found.limbs.moment.sum(1),
    ):
        np.testing.assert_allclose(missing, 0, atol=1e-11 * size)


def test_rates_are_the_derivatives_of_the_equations(robot, given, rates):
    def derivative(function, robot, given, rates):
        return jax.jvp(lambda *given: function(robot, *given), given, rates)

    close(*both(derivative, robot, given, rates))


@pytest.mark.parametrize(
    "moving", [pytest.param((0,), marks=pytest.mark.slow), (1, 3), pytest.param((4,), marks=pytest.mark.slow)]
)
def test_rates_where_some_of_it_moves(robot, given, rates, moving):
    def derivative(function, robot, given, rates):
        def some(*values):
            every = list(given)
            for place, value in zip(moving, values, strict=True):
                every[place] = value
            return function(robot, *every)

        return jax.jvp(some, tuple(given[place] for place in moving), tuple(rates[place] for place in moving))

    close(*both(derivative, robot, given, rates))


def test_rates_by_the_masses_of_the_robot(robot, given):
    """Everything about the robot that may differ from one to the other has its part."""
    names = ["base_mass", "base_inertia", "link_mass", "link_center", "link_inertia", "frame_position", "foot_center"]
    names += ["armature"] if robot.armature is not None else []

    def derivative(function, robot, given):
        def heavier(scale):
            changed = {name: getattr(robot, name) * (1 + scale * n) for n, name in enumerate(names, 1)}
            return function(dataclasses.replace(robot, **changed), *given)

        return jax.jvp(heavier, (0.0,), (1.0,))

    close(*both(derivative, robot, given))


def test_gradients_are_those_of_the_equations(robot, given):
    def derivative(function, robot, given):
        def size(torque):
            state, _, *others = given
            return sum((part**2).sum() for part in function(robot, state, torque, *others))

        return jax.grad(size)(given[1])

    close(*both(derivative, robot, given))
