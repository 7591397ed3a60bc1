"""Laws that scatter, sort, solve and convolve: they walk by the fast paths, and their tangents are right."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import mjx_climb as mc
from mjx_climb.execution import gpu_kernel
from mjx_climb.inputs.resolve import resolve_in
from mjx_climb.walk.structure import structure
from mjx_climb.walks import metrics_of_moved
from tests.execution.programs import SIZE, program

ROBOTS = 3
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 5))]
SEEDS += [pytest.param(seed, marks=pytest.mark.nightly) for seed in range(5, 200)]


@pytest.mark.parametrize("seed", SEEDS)
def test_random_programs_and_their_tangents_are_xlas(seed, interpreted):
    """By the kernel's rules in float64, to 1e-11 of values near one."""
    names, function = program(seed)
    rng = np.random.default_rng(seed)
    vectors, matrix = rng.normal(size=(ROBOTS, SIZE)), rng.normal(size=(SIZE, SIZE))
    places, along = np.arange(ROBOTS, dtype=np.int32), rng.normal(size=(ROBOTS, 1, SIZE))

    def derivative(vector, rate, place):
        return jax.jvp(lambda vector: function(vector, matrix, place), (vector,), (rate,))

    expected = jax.jit(jax.vmap(derivative))(vectors, along[:, 0], places)
    by_kernel = gpu_kernel.tangents_over_robots(function, [True, False, True])
    values, tangents = jax.jit(by_kernel)(along, vectors, matrix, places)
    for mine, xla in zip((values, tangents[:, 0]), expected, strict=True):
        np.testing.assert_allclose(mine, xla, rtol=1e-11, atol=1e-11, err_msg=str(names))


class Written(mc.Law):
    """Uses each operation for something small that its gain scales."""

    damping: object = mc.gain("N s/m", length=3, bounds=(1.0, 1e5), default=1e2)

    def init(self, start):
        return jnp.zeros((5, 6)), start.period

    def step(self, state, measured, reference):
        past, period = state
        past = past.at[1:].set(past[:-1]).at[0].set(measured.wrench)
        force = jnp.sqrt((measured.foot_force**2).sum(-1) + 1e-3)
        weights = jnp.zeros(6).at[2].set(0.5).at[force.argmax()].add(0.2).at[0].max(0.1)
        weights = weights + 0.01 * jax.ops.segment_sum(jnp.cumsum(force), jnp.array([0, 1, 2, 0]), 6)
        middle = jnp.median(force) + lax.top_k(force, 2)[0][1] + jnp.sort(force)[1] + lax.cummax(force)[2]
        stiff = 10 * jnp.eye(6) + 0.01 * jnp.outer(measured.wrench, weights)
        smooth = jnp.convolve(past[:, 2], jnp.array([0.5, 0.3, 0.2]), mode="valid").sum() + jnp.cumprod(weights)[1]
        moved = jnp.linalg.solve(stiff, past.mean(0)) + jnp.linalg.inv(stiff)[0] * smooth
        moved = moved + 1e-3 * jnp.linalg.qr(stiff)[1][0] + 1e-3 * measured.wrench[jnp.argsort(weights)] * middle
        shift = jnp.zeros(6).at[:3].add(-period * moved[:3] / self.damping)
        return (past, period), mc.control.shifted(reference, shift)


SHORT = (("duration", 0.02), ("gait.cycle", 0.02), ("disturbance.cargo.start", 0.01), ("disturbance.cargo.mass", 0.5))


EFFORT = (("hardware.force_sensor", {"source": "joint_effort", "axes": "z", "drift": 0.1}),)
PLANNED = ("PlannedTransfer+FootOffsets@upward", "normal_damping", EFFORT), ("LoadTransfer", "normal_damping", EFFORT)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "gain", "sensor"), [("", "damping", ()), *PLANNED])
def test_such_a_law_is_one_kernel(name, gain, sensor, case, without_nvrtc):
    """Its values and its tangents."""
    scenario = case("case_1_2", "virtual_model", SHORT + sensor)
    law = mc.control.shipped(name) if name else Written()
    with jax.enable_x64(False):
        found = resolve_in(scenario, law, None, None, np.float32)
        shape = structure(scenario, "limb", found.parameters, law=law)
        walk = functools.partial(metrics_of_moved, shape)
        size = law.GAINS[gain].shape
        moving = {gain: np.full((ROBOTS, *size), 1e2, "f4")}
        batched = [True] + [False] * len(jax.tree.leaves((found.law, found.parameters)))
        by_kernel = jax.jit(gpu_kernel.tangents_over_robots(walk, batched))
        given = {gain: np.ones((ROBOTS, 2, *size), "f4")}, moving, found.law, found.parameters
        lowered = by_kernel.trace(*given).lower(lowering_platforms=("cuda",)).as_text()
    assert lowered.count("__gpu$xla.gpu.ptx") == 1
    assert len(without_nvrtc) == 1


@pytest.mark.slow
def test_such_a_law_walks_in_regions(case):
    """Without a warning; its tangents are its differences."""
    simulation = mc.Simulation(case("case_1_2", "virtual_model", SHORT), Written())
    damping = np.full((2, 3), 1e2)
    step = 1e-3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, tangents = simulation.jvp({"damping": damping}, {"damping": np.ones((1, 2, 3))}, dtype=np.float64)
        sides = damping[:1] + step * np.array([[1.0], [-1.0]])
        moved = simulation.metrics({"damping": sides}, dtype=np.float64)
    for name in ("peak_foot_force", "base_deviation"):
        difference = (moved[name][0] - moved[name][1]) / (2 * step)
        assert difference != 0
        np.testing.assert_allclose(tangents[name][0], difference, rtol=1e-4)
