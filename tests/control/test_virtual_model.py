"""The virtual mass, damper and spring of Eqs. 2 and 3 in discrete time, against its analytic solution."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, expm_frechet

from mjx_climb.control.virtual_model import VirtualState, advance, discretize
from mjx_climb.quantities.parameters import Gains

STEP = 1e-3
GAINS = {  # M, D, K
    "paper's case 1.1": (1.0, 1e4, 4e5),
    "paper's case 1.2": (1.0, 5e3, 5e4),
    "underdamped": (1.0, 10.0, 4e4),
    "critical": (1.0, 400.0, 4e4),
    "almost undamped": (2.0, 1e-6, 1e4),
    "soft": (10.0, 1e2, 1.0),
}
discretized = jax.jit(discretize)


def matrix(inertia, damping, stiffness):
    """Return the continuous model of displacement, rate and a constant force, (3, 3)."""
    return np.array([[0, 1, 0], [-stiffness / inertia, -damping / inertia, 1 / inertia], [0, 0, 0]])


def transition_matrix(transition):
    """Return the discrete model as (2, 3): displacement and rate after the step, of displacement, rate and force."""
    t = jax.tree.map(np.asarray, transition)
    return np.array([[1 + t.xx, t.xv, t.xf], [t.vx, 1 + t.vv, t.vf]])


@pytest.mark.parametrize("name", GAINS)
def test_one_step_is_the_matrix_exponential(name):
    """The zero-order hold is exact: every element, the small increments included, to ten digits."""
    exact = expm(matrix(*GAINS[name]) * STEP)[:2]
    ours = discretized(Gains(*GAINS[name]), STEP)
    np.testing.assert_allclose(transition_matrix(ours), exact, rtol=1e-10)


@pytest.mark.parametrize("name", GAINS)
def test_a_thousand_steps_follow_the_step_response(name):
    """Displacement under a constant force is the analytic one all along, not at the end alone."""
    transition, force = discretized(Gains(*GAINS[name]), STEP), 3.0

    def step(state, _):
        after = advance(transition, state, force)
        return after, after

    start = VirtualState(jnp.asarray(0.0), jnp.asarray(0.0))
    ours = jax.jit(functools.partial(jax.lax.scan, step, length=1000))(start, None)[1]
    ours = jax.tree.map(lambda value: value[9::10], ours)
    exact = np.array([expm(matrix(*GAINS[name]) * STEP * n)[:2, 2] * force for n in range(10, 1001, 10)])
    assert np.abs(ours.displacement - exact[:, 0]).max() < 1e-9 * np.abs(exact[:, 0]).max()
    assert np.abs(ours.rate - exact[:, 1]).max() < 1e-9 * np.abs(exact[:, 1]).max()


def test_largest_pole_of_the_papers_gains():
    """M = 1, D = 1e4, K = 4e5 at 1 ms: 0.9606, where forward Euler has 8.96."""
    poles = np.linalg.eigvals(transition_matrix(discretized(Gains(*GAINS["paper's case 1.1"]), STEP))[:, :2])
    assert np.abs(poles).max() == pytest.approx(0.9606, abs=5e-5)


magnitude = st.floats(-9, 9).map(lambda exponent: 10.0**exponent)


@settings(max_examples=500, deadline=None, derandomize=True)
@given(magnitude, magnitude, magnitude, st.sampled_from([np.float32, np.float64]))
def test_stable_for_any_positive_gains(inertia, damping, stiffness, dtype):
    """Eighteen decades of each gain, in both precisions: finite, and no pole outside of the unit circle."""
    gains = Gains(*(jnp.asarray(value, dtype) for value in (inertia, damping, stiffness)))
    step = transition_matrix(discretized(gains, STEP)).astype(float)
    assert np.isfinite(step).all()
    assert np.abs(np.linalg.eigvals(step[:, :2])).max() <= 1 + 20 * np.finfo(dtype).eps


@pytest.mark.parametrize("name", ["paper's case 1.1", "underdamped", "critical"])
@pytest.mark.parametrize("gain", range(3), ids=["inertia", "damping", "stiffness"])
def test_derivative_is_that_of_the_matrix_exponential(name, gain):
    """Forward-mode derivatives by each gain are the exponential's own, at critical damping too."""
    values = np.array(GAINS[name])
    direction = np.eye(3)[gain] * values
    inertia, damping, stiffness = values
    # d/dM, d/dD, d/dK of the continuous matrix
    by_gain = [[0, 0, 0], [stiffness / inertia**2, damping / inertia**2, -1 / inertia**2], [0, 0, 0]], [
        [0, 0, 0], [0, -1 / inertia, 0], [0, 0, 0]], [[0, 0, 0], [-1 / inertia, 0, 0], [0, 0, 0]]  # fmt: skip
    slope_of_matrix = np.array(by_gain[gain]) * values[gain]
    exact = expm_frechet(matrix(*values) * STEP, slope_of_matrix * STEP, compute_expm=False)[:2]

    def step(*gains):
        t = discretize(Gains(*gains), STEP)
        return jnp.array([[t.xx, t.xv, t.xf], [t.vx, t.vv, t.vf]])

    slope = jax.jvp(step, tuple(values), tuple(direction))[1]
    np.testing.assert_allclose(slope, exact, rtol=1e-8, atol=1e-14 * np.abs(exact).max())
    h = 1e-5
    difference = (step(*(values + h * direction)) - step(*(values - h * direction))) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-9 * np.abs(exact).max())


def test_single_precision_keeps_the_slow_motion():
    """In float32 the step response of the paper's stiff damper stays within 1e-5 of the exact one."""
    values = GAINS["paper's case 1.2"]
    transition = discretized(Gains(*(jnp.float32(value) for value in values)), STEP)
    step = lambda state, _: (advance(transition, state, jnp.float32(1.0)), None)  # noqa: E731
    start = VirtualState(jnp.float32(0.0), jnp.float32(0.0))
    end = jax.jit(functools.partial(jax.lax.scan, step, length=100))(start, None)[0]
    exact = expm(matrix(*values) * STEP * 100)[0, 2]
    assert end.displacement.dtype == jnp.float32
    assert abs(end.displacement / exact - 1) < 1e-5
