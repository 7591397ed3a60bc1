"""Where the limbs are in a program's values: limbs in another order have results in that order along the axis."""

import dataclasses
import itertools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.ad_checkpoint import checkpoint_name

from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.element_rules import results
from mjx_climb.execution.flat import flat, reached
from mjx_climb.execution.limbs import LimbAxes, of_limbs
from tests.execution.rows import carried_out

LIMBS = 4
OTHER = np.random.default_rng(0).normal(size=(LIMBS, LIMBS))
ALIKE = np.ones((LIMBS, 3))


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Limbs:
    OF_LIMBS: ClassVar[tuple[str, ...]] = ("own",)
    own: object


def marked(array):
    return of_limbs(Limbs(array)).own


def of_batches(array, batch):
    """Return a product with matrices (2, limb, 2, 3)."""
    return lax.dot_general(jnp.ones((2, LIMBS, 2, 3)), jnp.broadcast_to(array, (2, LIMBS, 3)), (((3,), (2,)), batch))


def twice(start, other):
    return lax.fori_loop(0, 2, lambda _, y: y * 2 + other, start)


def many_sums(array):
    """Return sums over three steps of numbers of each limb, of one number alone, and of zeros and known ones."""
    single = array.astype(np.float32)

    def step(carry, _):
        own, *totals = carry
        wide = jnp.concatenate([own[:, :, None] * jnp.arange(1.0, 7.0, dtype=np.float32), 0 * own[:, :, None]], 2)
        terms = wide, own.sum(), jnp.ones(3, np.float32), own.max(0)
        return (own * 2, *(total + term for total, term in zip(totals, terms, strict=True))), None

    begun = jnp.ones((LIMBS, 3, 7)), 2.0, jnp.zeros(3), jnp.zeros(3)
    _, wide, *others = lax.scan(step, (single, *(jnp.float32(each) for each in begun)), length=3)[0]
    return wide + others[0] + others[1].sum() + others[2].sum()


# name: function of the limbs' numbers (limb, 3), and where limbs are in its result
OPERATIONS = {
    "nothing": (lambda x: x, 0),
    "elementwise": (lambda x: jnp.sin(x) * x[..., :1] + 1, 0),
    "another name": (lambda x: checkpoint_name(x.T, "another"), 1),
    "not at all": (lambda x: jnp.sin(OTHER), None),
    "reduce_sum behind": (lambda x: x.sum(1), 0),
    "reduce_max before": (lambda x: jnp.stack([x, x], 0).max(0), 0),
    "reduce_min of limbs": (lambda x: jnp.broadcast_to(x.min(0), (LIMBS, 3)), None),
    "argmax": (lambda x: x.argmax(1), 0),
    "argmin of limbs": (lambda x: x.argmin(0), None),
    "transpose": (lambda x: x.T, 1),
    "transpose of three": (lambda x: jnp.transpose(jnp.stack([x, x], 1), (1, 2, 0)), 2),
    "broadcast_in_dim": (lambda x: jnp.broadcast_to(x[:, :, None], (LIMBS, 3, 2)), 0),
    "broadcast in front": (lambda x: jnp.broadcast_to(x, (2, LIMBS, 3)), 1),
    "expand_dims": (lambda x: lax.expand_dims(x, (0, 2)), 1),
    "expand_dims behind": (lambda x: lax.expand_dims(x, (1, 3)), 0),
    "expand_dims twice": (lambda x: lax.expand_dims(x.T, (0, 2)), 3),
    "squeeze": (lambda x: lax.squeeze(x.reshape(1, LIMBS, 1, 3), (0, 2)), 0),
    "squeeze behind": (lambda x: lax.squeeze(lax.expand_dims(x, (1,)), (1,)), 0),
    "reshape behind": (lambda x: jnp.stack([x, x], 2).reshape(LIMBS, 6), 0),
    "reshape before": (lambda x: jnp.stack([x, x, x, x], 0).reshape(2, 2, LIMBS, 3), 2),
    "reshape of limbs": (lambda x: x.reshape(3, LIMBS), None),
    "reshape of as many": (lambda x: jnp.stack([x] * 4, 1).reshape(16, 3).reshape(LIMBS, LIMBS, 3), None),
    "rev behind": (lambda x: lax.rev(x, (1,)), 0),
    "rev of limbs": (lambda x: lax.rev(x, (0,)), None),
    "concatenate behind": (lambda x: lax.concatenate([x, x], 1), 0),
    "concatenate of limbs": (lambda x: lax.concatenate([x, x], 0), None),
    "slice behind": (lambda x: x[:, 1:], 0),
    "slice of limbs": (lambda x: x[1:], None),
    "split behind": (lambda x: lax.split(x, (1, 2), 1)[1], 0),
    "pad behind": (lambda x: lax.pad(x, jnp.zeros((), x.dtype), [(0, 0, 0), (1, 1, 0)]), 0),
    "dynamic_slice": (lambda x: lax.dynamic_slice(x, (0, jnp.argmax(x[0, 1:])), (LIMBS, 2)), 0),
    "gather": (lambda x: x[jnp.argsort(jnp.asarray(OTHER[0]))], None),
    "stack before": (lambda x: jnp.stack([x, x], 0), 1),
    "stack behind": (lambda x: jnp.stack([x, x], -1), 0),
    "unstack": (lambda x: jnp.unstack(x.T, axis=0)[1], 0),
    "unstack of limbs": (lambda x: jnp.unstack(x)[1], None),
    "product, left": (lambda x: x @ OTHER[:3], 0),
    "product, right": (lambda x: OTHER[:, :3] @ x.T, 1),
    "product, second on the right": (lambda x: jnp.einsum("ij,kjl->ikl", OTHER[:, :3], jnp.stack([x, x]).mT), 2),
    "product of a batch": (lambda x: jnp.einsum("li,lij->lj", x, jnp.stack([x, 2 * x], 2)), 0),
    "product of a second batch": (lambda x: of_batches(x, ((0, 1), (0, 1))), 1),
    "product of another first batch": (lambda x: of_batches(x, ((1, 0), (1, 0))), 0),
    "product, free behind a batch": (lambda x: jnp.einsum("bi,lbi->bl", OTHER[:2, :3], jnp.stack([x, x], 1)), 1),
    "product over limbs": (lambda x: x.T @ OTHER, None),
    "call": (lambda x: jax.jit(lambda y: y.T * 2)(x), 1),
    "cond": (lambda x: lax.cond(x.sum() > 0, lambda y: jnp.sin(y.T), lambda y: y.T, x), 1),
    "long branch": (lambda x: lax.cond(x.sum() > 99, lambda y: twice(y, x), jnp.sin, x), 0),
    "long branch taken": (lambda x: lax.cond(x.sum() < 99, lambda y: twice(y, x), jnp.sin, x), 0),
    "loop with sums": (many_sums, 0),
    "loop": (lambda x: twice(x, x), 0),
    "loop from zeros": (lambda x: lax.scan(lambda y, _: (y * 2 + x, None), jnp.zeros((LIMBS, 3)), length=2)[0], 0),
    "loop with a constant": (lambda x: lax.scan(lambda y, _: (y + x.sum(0), x.T), jnp.zeros(3), length=2)[1], 2),
    "loop that reads": (lambda x: lax.scan(lambda y, z: (y + z, y.T), x, jnp.stack([x, x]))[1], 2),
    "long loop that reads": (
        lambda x: lax.scan(lambda y, z: (0.5 * y + z, y.T), x, x * jnp.arange(70.0)[:, None, None])[1], 2,
    ),
    "long loop that reads backwards": (
        lambda x: lax.scan(lambda y, z: (0.5 * y + z, y.T), x, x * jnp.arange(70.0)[:, None, None], reverse=True)[1], 2,
    ),
    "loop over limbs of as many": (lambda x: lax.map(jnp.sin, x @ OTHER[:3]), None),
    "loop over limbs": (lambda x: lax.scan(lambda y, z: (y + z, z * 2), jnp.zeros(3), x)[1], None),
    "loop that reads alone": (lambda x: lax.scan(lambda y, z: (y + 1, z * 2), 0.0, jnp.stack([x, x]))[1], 1),
    "loop that carries two": (lambda x: lax.fori_loop(0, 3, lambda _, y: (y[1], y[1] + x), (x * 0, ALIKE))[0], 0),
}  # fmt: skip


@pytest.mark.parametrize("name", OPERATIONS)
def test_limbs_in_another_order_have_results_in_that_order(name):
    function, axis = OPERATIONS[name]
    given, order = np.random.default_rng(1).normal(size=(LIMBS, 3)), np.array([2, 0, 3, 1])
    program = flat(jax.make_jaxpr(lambda x, _: function(marked(x)))(given, given))
    axes = LimbAxes(program)
    assert axes.of(program.jaxpr.outvars[0]) == axis
    [alone] = results(Operations(None, None), program, [given, given])
    [by_lanes] = carried_out(program, [given, given], LIMBS)
    rounding = 100 * np.finfo(alone.dtype).eps if alone.dtype.kind == "f" else 0
    np.testing.assert_allclose(by_lanes, alone, rounding, rounding)
    if axis is not None:
        assert axes.count == LIMBS
        [turned] = results(Operations(None, None), program, [given[order], given])
        np.testing.assert_allclose(np.take(alone, order, axis), turned, rounding, rounding)
        assert np.ptp(alone, axis).any()


def test_of_two_results_neither_is_known_to_keep_the_limbs():
    program = jax.make_jaxpr(lambda x: lax.approx_max_k(marked(x), 3))(ALIKE)
    assert [*map(LimbAxes(program).of, program.jaxpr.outvars)] == [None, None]


def test_what_a_limbs_class_has_not_is_passed_over():
    assert of_limbs(Limbs(None)).own is None
    with pytest.raises(TypeError, match=r"^dict: expected a class with OF_LIMBS, the fields whose first axis is the l"):
        of_limbs({})


def on_and_on(asks, moves):
    """A loop with a condition: `asks` says whether it goes on and `moves` what it carries next, of (a, b, count)."""
    return lambda x, y, z: lax.while_loop(lambda c: asks(c, z), lambda c: moves(c, z), (x, y, 0.0))


# a function of three numbers, and for each of its results which of them it depends on
DEPENDENCES = {
    "nothing": (lambda x, y, z: (x, 1.0, y + z), ["x", "", "yz"]),
    "a call": (lambda x, y, z: jax.jit(lambda a, b: (jnp.sin(a), b))(x * y, z), ["xy", "z"]),
    "a loop": (
        lambda x, y, z: lax.scan(lambda c, _: ((c[0] * 2, c[0] + c[1]), z), (x, y), length=3), ["x", "xy", "z"],
    ),
    "a loop that carries on": (
        lambda x, y, z: lax.scan(lambda c, _: ((c[1], c[2], c[2]), c[0]), (x, y, z), length=3),
        ["xyz", "yz", "z", "xyz"],
    ),
    "a branch": (
        lambda x, y, z: lax.cond(True, lambda: (x, y), lambda: (x, z)), ["x", "yz"],
    ),
    "a choice of branches": (
        lambda x, y, z: lax.cond(x > 0, lambda: (y, 1.0), lambda: (2.0, z)), ["xy", "xz"],
    ),
    "a condition that ends": (on_and_on(lambda c, z: c[2] < 3, lambda c, z: (c[0] * 2, c[1] + z, c[2] + 1)),
                              ["x", "yz", ""]),
    "a condition of what is carried": (on_and_on(lambda c, z: c[0] < 3, lambda c, z: (c[0] + 1, c[1] * 2, c[2] + 1)),
                                       ["x", "xy", "x"]),
    "a condition of a constant": (on_and_on(lambda c, z: c[2] < z, lambda c, z: (c[0] * 2, c[1] * 2, c[2] + 1)),
                                  ["xz", "yz", "z"]),
    "a condition of what moves later": (
        on_and_on(lambda c, z: c[2] < 9, lambda c, z: (c[0] * 2, c[0] + c[1], c[2] + c[1])), ["xy", "xy", "xy"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DEPENDENCES)
def test_what_a_result_depends_on_is_followed_through_loops_and_branches(name):
    function, expected = DEPENDENCES[name]
    program = jax.make_jaxpr(lambda *given: jax.tree.leaves(function(*given)))(1.0, 2.0, 3.0).jaxpr
    each = [reached(program, [own == other for own in "xyz"]) for other in "xyz"]
    found = ["".join(itertools.compress("xyz", own)) for own in zip(*each, strict=True)]
    assert found == expected
    assert reached(program, [False] * 3) == [False] * len(found)
