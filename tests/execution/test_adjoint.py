"""Gradients of a function of one robot: by its adjoint in regions and in kernels, against JAX's own reverse mode."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array, lax
from jax.extend import core
from jaxtyping import Float

from mjx_climb.execution import of_limbs, over_robots
from mjx_climb.execution.adjoint import with_gradients
from mjx_climb.execution.gpu_kernel import gradients_over_robots
from tests.execution.programs import SIZE, program

ROBOTS = 3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Limbs:
    """Angles of four limbs."""

    OF_LIMBS = ("angle",)
    angle: Float[Array, "limb n"]


def motion(steps, *, reverse=False):
    """Return a motion of limbs that pull at each other: it reads, writes, counts, and keeps its largest rate."""

    def walk(gain, start, targets):
        limbs = of_limbs(Limbs(start)).angle

        def step(carry, target):
            angle, rate, largest, count = carry
            pull = angle
            for _ in range(4):
                pull = jnp.sin(pull) * gain + 0.1 * pull.sum() * jnp.cos(pull[::-1])
            rate = 0.9 * rate - 0.05 * pull + 0.1 * target
            angle = angle + 0.1 * jnp.where(count % 3 == 0, rate, 0.5 * rate)
            size = (rate**2).sum()
            return (angle, rate, jnp.where(size > largest, size, largest), count + 1), (angle * rate).sum()

        begun = limbs, jnp.zeros_like(limbs), jnp.zeros(()), 0
        (angle, _, largest, count), work = lax.scan(step, begun, targets, reverse=reverse, length=steps)
        return {"count": count, "end": angle.sum() * gain, "largest": largest, "work": work.sum()}

    rng = np.random.default_rng(steps)
    return walk, (rng.uniform(1, 2, ROBOTS), rng.normal(size=(ROBOTS, 4, 1)), rng.normal(size=(steps, 1)))


def weighed(walk):
    """Return a number that depends on all real results of a walk, not linearly."""
    return lambda *given: (lambda found: found["end"] * found["largest"] + 0.1 * found["work"])(walk(*given))


# one level of checkpoints, two, two and a rest, and backwards
LENGTHS = [(30, False), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((300, False), (307, True)))]


@pytest.mark.parametrize(("steps", "reverse"), LENGTHS)
def test_gradients_in_regions_are_jaxs(steps, reverse):
    """Of robots that differ in two arguments of three, by all three."""
    walk, given = motion(steps, reverse=reverse)
    each = [weighed(over_robots(walk, regions=True)), weighed(walk)]

    def total(one):
        return lambda *given: jax.vmap(one, (0, 0, None))(*given).sum()

    found, expected = (jax.jit(jax.grad(total(one), (0, 1, 2)))(*given) for one in each)
    for mine, jaxs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine, jaxs, rtol=1e-9, atol=1e-12)


def test_a_long_loop_is_walked_back_stretch_by_stretch():
    """With a rest, backwards: as a loop in NumPy, by what it multiplies, begins with and reads, of end and records."""
    rng, steps = np.random.default_rng(0), 307
    read, of_records, gain, start, of_end = *rng.normal(size=(2, steps)), 0.9, 0.3, 0.7

    def walk(gain, start, read):
        return lax.scan(lambda x, r: (jnp.sin(x) * gain + r, x * r), start, read, reverse=True)

    program = jax.make_jaxpr(walk)(gain, start, read)
    back = with_gradients(program, (True,) * 3, (True,) * 2, values=True)
    end, records, *found = jax.jit(core.jaxpr_as_fun(back))(gain, start, read, of_end, of_records)
    x = [start]
    for r in read[::-1]:
        x.append(np.sin(x[-1]) * gain + r)
    np.testing.assert_allclose(end, x[-1], rtol=1e-9)
    np.testing.assert_allclose(records[::-1], np.array(x[:-1]) * read[::-1], rtol=1e-9, atol=1e-12)
    by_gain, slope, by_read = 0.0, of_end, np.zeros(steps)
    for n, before in enumerate(x[-2::-1]):
        by_read[n] = slope + of_records[n] * before
        by_gain += slope * np.sin(before)
        slope = slope * np.cos(before) * gain + of_records[n] * read[n]
    for mine, expected in zip(found, (by_gain, slope, by_read), strict=True):
        np.testing.assert_allclose(mine, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_second_derivatives_and_several_weights():
    """Rows of a Jacobian, of one robot and of several, and the second derivative of one."""
    walk, given = motion(30)
    one = tuple(value[0] if len(value) == ROBOTS else value for value in given)
    for mine, theirs in zip(
        *(
            (
                jax.jit(jax.vmap(jax.jacrev(lambda *of, walk=walk: walk(*of)["end"]), (0, 0, None)))(*given),
                jax.jit(jax.jacrev(lambda *of, walk=walk: jax.vmap(walk, (0, None, None))(*of)["work"], 1))(
                    given[0], one[1], given[2]
                ),
                jax.jit(jax.hessian(lambda gain, walk=walk: walk(gain, *one[1:])["end"]))(one[0]),
            )
            for walk in (over_robots(walk, regions=True), walk)
        ),
        strict=True,
    ):
        np.testing.assert_allclose(mine, theirs, rtol=1e-8, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [30, 300])
def test_gradients_in_the_kernel_are_jaxs(steps, interpreted):
    """Of two weighted sums, with the results, a thread for each limb."""
    walk, given = motion(steps)
    rng = np.random.default_rng(1)
    weights = {name: rng.normal(size=(ROBOTS, 2)) for name in ("work", "end")}
    moved = lambda moving, targets: walk(*moving, targets)  # noqa: E731
    batched = [True, True, False]
    values, found = jax.jit(gradients_over_robots(moved, batched))(weights, tuple(given[:2]), given[2])

    def one(gain, start, weights):
        _, pull_back = jax.vjp(lambda *of: {n: walk(*of, given[2])[n] for n in weights}, gain, start)
        return walk(gain, start, given[2]), jax.vmap(pull_back)(weights)

    expected = jax.jit(jax.vmap(one))(*given[:2], weights)
    for mine, jaxs in zip(jax.tree.leaves((values, found)), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(mine, jaxs, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("steps", [30, 300])
def test_what_has_no_weight_is_not_computed(steps):
    """Of a sum that a loop carries beside, in one level of checkpoints and in two, on no way."""

    def walk(gain):
        step = lambda carry, _: ((jnp.sin(carry[0]) * gain, carry[1] + jnp.tanh(carry[0])), None)  # noqa: E731
        (end, total), _ = lax.scan(step, (gain, gain), length=steps)
        return {"end": end, "total": total}

    program = jax.make_jaxpr(walk)(1.0)
    one, both = (
        str(with_gradients(program, (True,), weighed, values=False)) for weighed in ((True, False), (True,) * 2)
    )
    assert "tanh" in both
    assert "tanh" not in one


def test_results_that_do_not_move_have_no_gradient():
    """Though they depend on what moves: a place, a count, and what is held fixed."""

    def walk(gain: Array) -> dict[str, Array]:
        held = lax.stop_gradient(gain) * 2
        return {"count": (gain > 1).astype(gain.dtype), "held": held, "moved": gain**2 + held}

    gains = np.array([0.5, 1.5])
    gradient = jax.grad(lambda gains: sum(value.sum() for value in jax.vmap(over_robots(walk))(gains).values()))
    np.testing.assert_allclose(jax.jit(gradient)(gains), 2 * gains)


SEEDS = [pytest.param(seed, marks=pytest.mark.slow) for seed in range(20)]
SEEDS += [pytest.param(seed, marks=pytest.mark.nightly) for seed in range(20, 200)]


@pytest.mark.parametrize("seed", SEEDS)
def test_gradients_of_random_programs_are_those_of_forward_mode(seed, interpreted):
    """Of what laws are written with, in loops of one and of two levels of checkpoints, in float64 to 1e-8."""
    names, function = program(seed)
    rng, steps = np.random.default_rng(seed), 300 if seed % 4 == 3 else 30
    vectors, matrix = rng.normal(size=(ROBOTS, SIZE)), rng.normal(size=(SIZE, SIZE))
    places = np.arange(ROBOTS, dtype=np.int32)

    def summed(vector, place):
        step = lambda vector, _: (function(vector, matrix, place), None)  # noqa: E731
        return {"sum": (lax.scan(step, vector, length=steps)[0] * np.arange(1, SIZE + 1)).sum()}

    by_kernel = gradients_over_robots(summed, [True, True])
    _, found = jax.jit(by_kernel)({"sum": np.ones((ROBOTS, 1))}, vectors, places)
    expected = jax.jit(jax.vmap(jax.jacfwd(lambda *of: summed(*of)["sum"])))(vectors, places)
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-8, atol=1e-8 * abs(expected).max(), err_msg=str(names))
