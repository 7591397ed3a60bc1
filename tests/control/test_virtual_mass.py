"""The virtual mass, damper and spring of Eqs. 2 and 3: the exact motion against the matrix exponential, the steps and
bounds of the author's library against their closed forms."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, expm_frechet

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.control.virtual_mass import EXACT, Motion, advance, at_rest, bounded, dead, discretize, inward

STEP = 1e-3
GAINS = {  # M, D, K
    "paper's case 1.1": (1.0, 1e4, 4e5),
    "paper's case 1.2": (1.0, 5e3, 5e4),
    "underdamped": (1.0, 10.0, 4e4),
    "critical": (1.0, 400.0, 4e4),
    "almost undamped": (2.0, 1e-6, 1e4),
    "soft": (10.0, 1e2, 1.0),
}
ROBOT = Motion(semi_implicit=True)


def examples(test):
    """Have a test of any gains run with those of `GAINS` too."""
    for values in GAINS.values():
        test = example(*values)(test)
    return test


def power(low, high):
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


inertias, dampings, stiffnesses = power(-2, 2), power(-3, 6), power(-2, 7)


def continuous(inertia, damping, stiffness):
    """Return the continuous model of displacement, rate and a constant force, (3, 3)."""
    return np.array([[0, 1, 0], [-stiffness / inertia, -damping / inertia, 1 / inertia], [0, 0, 0]])


@jax.jit
def step_matrix(gains, period=STEP):
    """Return displacement and rate after a period, of displacement, rate and a held force, (2, 3)."""
    t = discretize(gains, period)
    return jnp.array([[1 + t.xx, t.xv, t.xf], [t.vx, 1 + t.vv, t.vf]])


def natural(matrix, inertia, stiffness):
    """Return a step in units of the virtual mass itself, in which its elements compare: sqrt(M) v, sqrt(K) x, f."""
    row = np.array([np.sqrt(stiffness), np.sqrt(inertia)])
    return row[:, None] * np.asarray(matrix) / np.array([*row, 1.0])


@examples
@given(inertias, dampings, stiffnesses)
def test_the_zero_order_hold_is_the_matrix_exponential(inertia, damping, stiffness):
    """For any positive gains; of the named ones every element, the small increments included, to ten digits."""
    ours = np.asarray(step_matrix(mc.Gains(inertia, damping, stiffness)))
    exact = expm(continuous(inertia, damping, stiffness) * STEP)[:2]
    if (inertia, damping, stiffness) in GAINS.values():
        np.testing.assert_allclose(ours, exact, rtol=1e-10)
    ours, exact = (natural(matrix, inertia, stiffness) for matrix in (ours, exact))
    np.testing.assert_allclose(ours, exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())


@jax.jit
def tangents(values):
    """Return the tangents of a step by the logarithm of each gain, (gain, 2, 3)."""
    return jax.vmap(lambda way: jax.jvp(lambda g: step_matrix(mc.Gains(*g)), (values,), (way,))[1])(jnp.diag(values))


@pytest.mark.slow
@examples
@given(inertias, dampings, stiffnesses)
def test_tangents_are_those_of_the_matrix_exponential(inertia, damping, stiffness):
    """By each gain, at critical damping too, where the poles meet and the closed form has no derivative."""
    values = np.array([inertia, damping, stiffness])
    by_gain = np.zeros((3, 3, 3))  # of the continuous matrix by M, D, K
    by_gain[:, 1] = (
        [stiffness / inertia**2, damping / inertia**2, -1 / inertia**2], [0, -1 / inertia, 0], [-1 / inertia, 0, 0]
    )  # fmt: skip
    matrix = continuous(*values) * STEP
    for ours, by, value in zip(tangents(values), by_gain, values, strict=True):
        exact = natural(expm_frechet(matrix, by * value * STEP, compute_expm=False)[:2], inertia, stiffness)
        ours = natural(ours, inertia, stiffness)
        np.testing.assert_allclose(ours, exact, rtol=1e-8, atol=1e-9 * max(1e-5, np.abs(exact).max()))


def test_single_precision_keeps_the_slow_motion():
    """In float32 the step response of the paper's stiff damper stays within 1e-5 of the exact one."""
    values = GAINS["paper's case 1.2"]
    mass, step = at_rest(mc.Gains(*map(np.float32, values)), STEP, jnp.float32(0.0)), jax.jit(advance)
    for _ in range(100):
        mass = step(mass, jnp.float32(1.0))
    end = mass.displacement
    assert end.dtype == jnp.float32
    assert abs(end / expm(continuous(*values) * STEP * 100)[0, 2] - 1) < 1e-5


@pytest.mark.slow
@settings(max_examples=500, deadline=None, derandomize=True)
@given(power(-9, 9), power(-9, 9), power(-9, 9), st.sampled_from([np.float32, np.float64]))
def test_stable_for_any_positive_gains(inertia, damping, stiffness, dtype):
    """Eighteen decades of each gain, in both precisions: finite, and no pole outside of the unit circle."""
    gains = mc.Gains(*(jnp.asarray(value, dtype) for value in (inertia, damping, stiffness)))
    step = np.asarray(step_matrix(gains)).astype(float)
    assert np.isfinite(step).all()
    assert np.abs(np.linalg.eigvals(step[:, :2])).max() <= 1 + 20 * np.finfo(dtype).eps


# --- As the paper's first author moves it on a robot

SOFT = mc.Gains(2.0, 30.0, 400.0)


def pushed(motion, force, period=STEP, steps=1, gains=SOFT, displacement=(0.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0)):
    force = jnp.asarray(force, float)
    start = {"displacement": jnp.asarray(displacement), "rate": jnp.asarray(rate)}
    mass = at_rest(gains, period, force, motion)._replace(**start)
    for _ in range(steps):
        mass = advance(mass, force, motion)
    return mass


@pytest.mark.parametrize(
    ("function", "arguments", "expected"),
    [
        (dead, ([0.3, 0.0, 0.39], 0.5), [0.0, 0.0, 0.0]),  # a deadband counts the whole vector
        (dead, ([0.3, 0.0, 0.41], 0.5), [0.3, 0.0, 0.41]),
        (dead, ([3.0, 0.0, 4.0], 5.0), [3.0, 0.0, 4.0]),
        (bounded, ([3.0, 0.0, 4.0], 2.0), [1.2, 0.0, 1.6]),  # keeps its direction
        (bounded, ([0.3, 0.0, 0.4], 2.0), [0.3, 0.0, 0.4]),
        (bounded, ([0.0, 0.0, 0.0], 2.0), [0.0, 0.0, 0.0]),
        (inward, ([1.0, 3.0, 0.0], [2.0, 0.0, 0.0], 2.0), [0.0, 3.0, 0.0]),  # at the bound only the outward rate goes
        (inward, ([-1.0, 3.0, 0.0], [2.0, 0.0, 0.0], 2.0), [-1.0, 3.0, 0.0]),
        (inward, ([1.0, 3.0, 0.0], [2.0, 0.0, 0.0], 2.5), [1.0, 3.0, 0.0]),
    ],
)
def test_deadband_and_bounds_count_whole_vectors(function, arguments, expected):
    *vectors, limit = arguments
    vectors = [jnp.asarray(vector) for vector in vectors]
    np.testing.assert_allclose(function(*vectors, limit), expected, rtol=1e-12, atol=1e-15)
    feet = [jnp.stack([vector, 0 * vector]) for vector in vectors]  # and those of each foot apart
    np.testing.assert_allclose(function(*feet, limit), [expected, np.zeros(3)], rtol=1e-12, atol=1e-15)


def test_translations_and_rotations_have_limits_of_their_own():
    motion = Motion(deadband=(2.0, 0.0), max_offset=(math.inf, 1e-3))
    mass = pushed(motion, [1.0, 1.0, 1.0, 60.0, 0.0, 80.0], 0.1, displacement=np.zeros(6), rate=np.zeros(6))
    np.testing.assert_array_equal(mass.displacement[:3], 0)
    np.testing.assert_allclose(mass.displacement[3:], [6e-4, 0, 8e-4], rtol=1e-9)


def test_one_step_is_semi_implicit_euler():
    x, v, force = np.array([0.1, 0.0, 0.2]), np.array([0.5, -1.0, 0.0]), np.array([4.0, 0.0, 1.0])
    after = pushed(ROBOT, force, displacement=x, rate=v)
    rate = v + STEP * (force - 30 * v - 400 * x) / 2
    np.testing.assert_allclose(after.rate, rate, rtol=1e-14)
    np.testing.assert_allclose(after.displacement, x + STEP * rate, rtol=1e-14)


@pytest.mark.parametrize(
    ("period", "substeps", "length"),
    [(2e-3, 1, 2e-3), (5e-3, 3, 5e-3), (14e-3, 7, 14e-3), (0.02, 10, 0.02), (0.1, 10, 0.02)],
)
def test_substeps_are_of_2_ms_at_most_and_the_period_is_cut(period, substeps, length):
    once = pushed(ROBOT, [1.0, 2.0, 3.0], period=period)
    many = pushed(ROBOT, [1.0, 2.0, 3.0], period=length / substeps, steps=substeps)
    np.testing.assert_allclose(once.displacement, many.displacement, rtol=1e-12)


@pytest.mark.slow
def test_small_steps_approach_the_exact_motion():
    exact = pushed(EXACT, [1.0, 0.0, 0.0], steps=200).displacement[0]
    errors = [abs(pushed(ROBOT, [1.0, 0, 0], STEP / n, 200 * n).displacement[0] - exact) for n in (1, 2)]
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.02)  # first order


@pytest.mark.parametrize("motion", [EXACT, ROBOT])
def test_bounds_hold_and_are_left_again(motion):
    bounds = motion._replace(max_offset=(0.01, math.inf), max_velocity=(0.05, math.inf))
    mass, step = pushed(bounds, [0.0, 0.0, 0.0]), jax.jit(lambda mass, force: advance(mass, force, bounds))
    for _ in range(300):
        mass = step(mass, jnp.asarray([30.0, 0.0, 40.0]))
        assert np.linalg.norm(mass.displacement) <= 0.01 * (1 + 1e-12)
        assert np.linalg.norm(mass.rate) <= 0.05 * (1 + 1e-12)
    np.testing.assert_allclose(mass.displacement, [0.006, 0, 0.008], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(mass.rate, 0, atol=1e-12)
    assert np.linalg.norm(step(mass, jnp.asarray([-30.0, 0.0, -40.0])).displacement) < 0.01


def test_without_limits_no_norm_is_taken():
    mass = at_rest(SOFT, STEP, jnp.zeros(3))
    assert "sqrt" not in str(jax.make_jaxpr(advance)(mass, jnp.ones(3)))


@pytest.mark.slow
@pytest.mark.parametrize("gain", ["inertia", pytest.param("damping", marks=pytest.mark.nightly), "stiffness"])
@pytest.mark.parametrize("force", [pytest.param(1.0, marks=pytest.mark.nightly), 60.0])
def test_derivative_of_bounded_motion(gain, force):
    bounds = ROBOT._replace(max_offset=(0.01, math.inf), max_velocity=(0.3, math.inf), deadband=(0.5, 0.0))

    def displacement(value):
        gains = mc.Gains(**(vars(SOFT) | {gain: value}))
        return pushed(bounds, [force, 0.0, 0.3], period=3e-3, steps=12, gains=gains).displacement

    at = float(getattr(SOFT, gain))
    tangent, width = jax.jvp(displacement, (at,), (1.0,))[1], 1e-5 * at
    central = (displacement(at + width) - displacement(at - width)) / (2 * width)
    np.testing.assert_allclose(tangent, central, rtol=1e-6, atol=1e-12)


def test_a_config_names_limits_for_forces_and_moments():
    control = {"integration": "semi_implicit", "deadband": [0.5, 0.02], "max_offset": 0.03}
    scenario = mc.Scenario().with_overrides({"control": control})
    assert law_of(scenario).motion == Motion(True, (0.5, 0.02), (0.03, 0.03), (math.inf, math.inf))


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
