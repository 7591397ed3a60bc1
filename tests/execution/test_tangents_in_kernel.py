"""Slopes by the GPU kernel, carried out on the CPU, against JAX's own forward derivatives."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.execution import batches, gpu_kernel, paths
from mjx_climb.execution.gpu_kernel import tangents_over_robots
from tests.execution import primitives

ROBOTS, DIRECTIONS = 3, 2
NO_SLOPES = {"custom_vjp_call", "nextafter"}  # nor has JAX
BEYOND_JAX = {"clamp", "reductions of nothing"}  # between scalars that move; of nothing JAX has no tangent


def own():
    rng = np.random.default_rng(5)
    vectors, rates = rng.uniform(-2.5, 2.5, (ROBOTS, 3)), rng.normal(size=(ROBOTS, DIRECTIONS, 3))
    return vectors, rates, rng.uniform(-2.5, 2.5, (4, 3)), np.arange(ROBOTS, dtype=np.int32)


def agree(function):
    """Compare the tangents (B, k, ...) of results that are real numbers with those of JAX's forward derivatives."""
    vectors, rates, matrix, numbers = own()

    def tangents(vector, rate, number):
        def real(vector):
            found = jax.tree.leaves(function(vector, matrix, number))
            return [value for value in found if jnp.issubdtype(value.dtype, jnp.floating)]

        return jax.jvp(real, (vector,), (rate,))[1]

    _, found = jax.jit(tangents_over_robots(function, [True, False, True]))(rates, vectors, matrix, numbers)
    expected = jax.jit(jax.vmap(jax.vmap(tangents, (None, 0, None))))(vectors, rates, numbers)
    for mine, jaxs in zip(jax.tree.leaves(found), expected, strict=True):
        np.testing.assert_allclose(mine, jaxs, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in primitives.KNOWN if name not in BEYOND_JAX])
def test_every_operation_has_jaxs_tangent(name, interpreted):
    """In float64; what has no forward derivative is refused."""
    refused = pytest.raises(NotImplementedError, match=r"operation custom|nextafter")
    with refused if name in NO_SLOPES else contextlib.nullcontext():
        agree(lambda v, m, n: primitives.KNOWN[name](v, m * v[1], n))


def squared(_, vector, number):
    return {"squared": vector**2 + number}


def test_robots_share_directions(interpreted):
    """In a kernel as by XLA's own."""
    vectors, rates, _, numbers = own()
    call = batches._Call(squared, None, (True, True, False), derivatives=batches._TANGENT)
    kernel, plain = (
        batches._carried_out(call._replace(path=path), vectors, numbers, rates[0]) for path in ("kernel", "plain")
    )
    assert kernel["tangent of squared"].shape == (ROBOTS, DIRECTIONS, 3)
    jax.tree.map(np.testing.assert_allclose, kernel, plain)


def test_a_batch_of_another_size_has_the_same_kernel(without_nvrtc):
    """It is written once."""
    known = [made.cache_info().misses for made in (gpu_kernel._moved, gpu_kernel.written)]
    call = batches._Call(squared, None, (True, True, False), "kernel", derivatives=batches._TANGENT)
    with jax.enable_x64(False):
        for robots in (3, 5):
            given = np.ones((robots, 3), "f4"), np.ones(robots, "i4"), np.ones((2, 3), "f4")
            jax.jit(batches._carried_out, static_argnums=0).trace(call, *given).lower(lowering_platforms=("cuda",))
    assert [made.cache_info().misses for made in (gpu_kernel._moved, gpu_kernel.written)] == [n + 1 for n in known]
    assert len(without_nvrtc) == 2 and len(set(without_nvrtc)) == 1


def motion(vector, matrix, number):
    """Return the end of a motion of limbs that pull at each other: chained, chosen, clipped, some of them equal."""

    stiffness = vector[0] + 0.3 * vector[2] ** 2  # in the loop and after it

    def step(carry, _):
        angle, rate, seen = carry
        pull = jnp.sqrt(1 + angle**2) / (2 + jnp.cos(angle[::-1]))
        pull = jnp.where(pull > 0.6, pull, jnp.minimum(0.3 * rate, pull)) - 0.1 * angle.sum(1, keepdims=True)
        rate = rate - 0.1 * pull * stiffness
        angle = jnp.clip(angle + 0.1 * rate, -2, 2)
        return (angle, rate, jnp.maximum(seen, jnp.abs(angle).max())), None

    begin = jnp.stack([vector, vector, vector * vector[2], jnp.ones(3)], 1)[..., None]  # (3, limbs, 1)
    angle, rate, seen = jax.lax.scan(step, (begin, jnp.zeros_like(begin), jnp.zeros(())), length=5)[0]
    return {"end": angle[..., 0], "rate": rate.sum() * stiffness, "seen": seen, "steps": number + 1}


@pytest.mark.slow
def test_a_motion_of_limbs(interpreted):
    """What the loop's start does not move, but moves later, and shares of equal ones."""
    agree(motion)


def test_tangents_by_a_rule_of_ones_own(interpreted):
    """Of some operands or all, in a loop, for what the lanes have of their own and for what is of all of them."""

    @jax.custom_jvp
    def spring(angle, shared, still):
        return angle * shared**2 + still, angle.sum(1) * shared

    @spring.defjvp
    def rates_of_spring(given, rates):  # not the derivatives: so it is seen
        (angle, shared, still), (turn, change, _) = given, rates
        return spring(angle, shared, still), (3 * turn * still + angle * change, turn[:, 0] * shared + turn.sum(1))

    def function(vector, matrix, number):
        def step(carry, _):
            angle, shared, passive = carry
            (angle, total), (passive, _) = spring(angle, shared, matrix[0, 0]), spring(passive, matrix[0, 1], 2.0)
            return (jnp.sin(angle), jnp.cos(total[0] + shared), passive[:, ::-1] * 0.1), None

        begin = jnp.stack([vector, 2 * vector, vector * vector[2], jnp.ones(3)], 1)[..., None]  # (3, limbs, 1)
        start = begin, vector[:1], jnp.broadcast_to(matrix.T[..., None], begin.shape)
        angle, shared, passive = jax.lax.scan(step, start, length=3)[0]
        return {"angle": angle[..., 0], "shared": shared, "passive": passive + number}

    agree(function)


def test_tangents_are_as_precise_as_values(without_nvrtc):
    """Single precision stays that, where double precision is allowed."""

    def function(vector):
        return jnp.maximum(vector, vector[0]) / jnp.sqrt(jnp.minimum(vector, 1) ** 2) + jnp.abs(vector) ** 3

    vector = np.ones((ROBOTS, 3), np.float32)
    sloped = tangents_over_robots(function, [True])
    jax.jit(sloped).trace(vector[:, None], vector).lower(lowering_platforms=("cuda",))
    [kernel] = without_nvrtc
    assert "double" not in kernel


def test_what_nothing_moves_has_no_tangents(without_nvrtc):
    """A loop carries the rates of what depends on the first argument, and of nothing else."""

    def function(vector, matrix, number):
        def step(carry, _):
            moved, still = carry
            return (moved * 0.9 + still, jnp.sin(still)), None

        return jax.lax.scan(step, (vector[0], matrix[0, 0]), length=5)[0]

    vectors, rates, matrix, numbers = own()
    with jax.enable_x64(False):
        sloped = tangents_over_robots(function, [True, False, True])
        jax.jit(sloped).trace(rates, vectors, matrix, numbers).lower(lowering_platforms=("cuda",))
    [kernel] = without_nvrtc
    assert kernel.count("float next_") == 2 + 1


@pytest.mark.slow
def test_the_trial_of_the_kernel_sees_wrong_tangents(interpreted, monkeypatch, capsys):
    """Values alone do not make a verdict."""
    paths.take("kernel")
    assert capsys.readouterr().out.strip() == paths.SAME

    def off(*given, **how):
        right = tangents_over_robots(*given, **how)
        return lambda *values: jax.tree.map(lambda x: 1.01 * x, right(*values))

    monkeypatch.setattr(gpu_kernel, "tangents_over_robots", off)
    paths.take("kernel")
    assert "off in float32" in capsys.readouterr().out
