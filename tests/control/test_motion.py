"""Deadband, bounds and semi-implicit steps of a virtual mass, each against its closed form."""

import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.control.motion import LONGEST_PERIOD, Motion, begin, bounded, dead, inward, move
from mjx_climb.control.virtual_model import VirtualState, rest

GAINS = SimpleNamespace(inertia=jnp.asarray(2.0), damping=jnp.asarray(30.0), stiffness=jnp.asarray(400.0))
ROBOT = Motion(semi_implicit=True)
AT_REST = rest(jnp.zeros((3, 1)))


def pushed(motion, force, period=1e-3, steps=1, state=AT_REST, gains=GAINS):
    mass = begin(motion, gains, period, state)
    for _ in range(steps):
        mass = move(motion, gains, mass, jnp.asarray(force, float).reshape(3, 1))
    return mass.state


def central(function, at, width=1e-6):
    return (function(at + width) - function(at - width)) / (2 * width)


def slope(function, at):
    return jax.jvp(function, (jnp.asarray(at),), (jnp.asarray(1.0),))[1]


def test_deadband_counts_a_whole_vector():
    small, large = jnp.asarray([0.3, 0.0, 0.39]), jnp.asarray([0.3, 0.0, 0.41])
    np.testing.assert_array_equal(dead(small, 0.5), 0)
    np.testing.assert_array_equal(dead(large, 0.5), large)


def test_a_bounded_vector_keeps_its_direction():
    np.testing.assert_allclose(bounded(jnp.asarray([3.0, 0.0, 4.0]), 2.0), [1.2, 0.0, 1.6], rtol=1e-12)
    np.testing.assert_array_equal(bounded(jnp.asarray([0.3, 0.0, 0.4]), 2.0), [0.3, 0.0, 0.4])
    np.testing.assert_array_equal(bounded(jnp.zeros(3), 2.0), 0)


def test_at_the_bound_only_the_outward_rate_goes():
    out = jnp.asarray([2.0, 0.0, 0.0])
    np.testing.assert_allclose(inward(jnp.asarray([1.0, 3.0, 0.0]), out, 2.0), [0.0, 3.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(inward(jnp.asarray([-1.0, 3.0, 0.0]), out, 2.0), [-1.0, 3.0, 0.0])
    np.testing.assert_array_equal(inward(jnp.asarray([1.0, 3.0, 0.0]), out, 2.5), [1.0, 3.0, 0.0])


def test_one_step_is_semi_implicit_euler():
    before = VirtualState(jnp.asarray([[0.1], [0.0], [0.2]]), jnp.asarray([[0.5], [-1.0], [0.0]]))
    after = pushed(ROBOT, [4.0, 0.0, 1.0], state=before)
    rate = before.rate + 1e-3 * (np.array([[4.0], [0.0], [1.0]]) - 30 * before.rate - 400 * before.displacement) / 2
    np.testing.assert_allclose(after.rate, rate, rtol=1e-14)
    np.testing.assert_allclose(after.displacement, before.displacement + 1e-3 * rate, rtol=1e-14)


@pytest.mark.parametrize(
    ("period", "substeps", "length"), [(2e-3, 1, 2e-3), (5e-3, 3, 5e-3), (0.02, 10, 0.02), (0.1, 10, 0.02)]
)
def test_substeps_are_of_2_ms_at_most_and_the_period_is_cut(period, substeps, length):
    once = pushed(ROBOT, [1.0, 2.0, 3.0], period=period)
    many = pushed(ROBOT, [1.0, 2.0, 3.0], period=length / substeps, steps=substeps)
    np.testing.assert_allclose(once.displacement, many.displacement, rtol=1e-12)
    assert length <= LONGEST_PERIOD


def test_a_batch_may_have_a_period_for_each_robot():
    periods = jnp.asarray([1e-3, 5e-3, 0.1])
    mass = begin(ROBOT, GAINS, periods, rest(jnp.zeros((3, 3))))
    together = move(ROBOT, GAINS, mass, jnp.ones((3, 3))).state
    for row, period in enumerate(periods):
        np.testing.assert_array_equal(together.rate[:, row], pushed(ROBOT, [1.0, 1.0, 1.0], period=period).rate[:, 0])


def test_small_steps_approach_the_exact_motion():
    exact = pushed(Motion(), [1.0, 0.0, 0.0], steps=200).displacement[0, 0]
    errors = [
        abs(float(pushed(ROBOT, [1.0, 0.0, 0.0], period=1e-3 / n, steps=200 * n).displacement[0, 0] - exact))
        for n in (1, 2)
    ]
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.02)  # first order


@pytest.mark.parametrize("motion", [Motion(), ROBOT])
def test_bounds_hold_and_are_left_again(motion):
    bounds = motion._replace(max_offset=(0.01, math.inf), max_velocity=(0.05, math.inf))
    mass = begin(bounds, GAINS, 1e-3, AT_REST)
    step = jax.jit(lambda mass, force: move(bounds, GAINS, mass, force))
    for _ in range(300):
        mass = step(mass, jnp.asarray([[30.0], [0.0], [40.0]]))
        assert np.linalg.norm(mass.state.displacement) <= 0.01 * (1 + 1e-12)
        assert np.linalg.norm(mass.state.rate) <= 0.05 * (1 + 1e-12)
    np.testing.assert_allclose(mass.state.displacement[:, 0], [0.006, 0, 0.008], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(mass.state.rate, 0, atol=1e-12)
    back = move(bounds, GAINS, mass, jnp.asarray([[-30.0], [0.0], [-40.0]])).state
    assert np.linalg.norm(back.displacement) < 0.01


def test_without_options_nothing_is_touched():
    plain, wide = pushed(Motion(), [1.0, 2.0, 3.0], steps=3), begin(Motion(), GAINS, 1e-3, AT_REST)
    assert str(jax.make_jaxpr(lambda f: move(Motion(), GAINS, wide, f))(jnp.ones((3, 1)))).count("sqrt") == 0
    assert np.isfinite(plain.displacement).all()


@pytest.mark.slow
@pytest.mark.parametrize("gain", ["inertia", "damping", "stiffness"])
@pytest.mark.parametrize("force", [1.0, 60.0])
def test_derivative_of_bounded_motion(gain, force):
    bounds = ROBOT._replace(max_offset=(0.01, math.inf), max_velocity=(0.3, math.inf), deadband=(0.5, 0.0))

    def displacement(value):
        gains = SimpleNamespace(**(vars(GAINS) | {gain: value}))
        return pushed(bounds, [force, 0.0, 0.3], period=3e-3, steps=12, gains=gains).displacement

    at = float(getattr(GAINS, gain))
    np.testing.assert_allclose(slope(displacement, at), central(displacement, at, 1e-5 * at), rtol=1e-6, atol=1e-12)


def test_a_config_names_them_for_forces_and_moments():
    scenario = mc.Scenario().with_overrides(
        {"control": {"integration": "semi_implicit", "deadband": [0.5, 0.02], "max_offset": 0.03}}
    )
    law = law_of(scenario)
    assert law.motion == Motion(True, (0.5, 0.02), (0.03, 0.03), (math.inf, math.inf))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"deadband": 1.0, "reading": "measured_pose"}, "control.deadband: expected none with measured_pose"),
        ({"max_offset": 0.0}, "control.max_offset: expected a finite number above 0"),
        ({"max_velocity": [1.0, 2.0, 3.0]}, "control.max_velocity: expected a finite number above 0, two of them"),
        ({"integration": "euler"}, "control.integration: expected 'exact' or 'semi_implicit'"),
    ],
)
def test_what_cannot_be_is_refused(changes, words):
    with pytest.raises(mc.ConfigError, match=words):
        mc.Scenario().with_overrides({"control": changes})
