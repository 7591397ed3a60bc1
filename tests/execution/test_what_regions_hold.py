"""Which operations a CPU's region writes as elements: by kind, size, and what loops and branches hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.element_rules import can_write, results
from mjx_climb.execution.elements import Unsupported, Value, as_array
from mjx_climb.execution.flat import flat
from mjx_climb.execution.limbs import LimbAxes
from mjx_climb.execution.simpler import rule_of, simpler
from tests.execution.rows import Rows


def loop(carry, length, body=lambda carry: carry + 1):
    return lambda x: lax.scan(lambda now, _: (body(now), None), carry, length=length)[0]


def times(count):
    def long(x):
        for _ in range(count):
            x = x * 2.0
        return x

    return long


def branches(count, first=lambda x: x):
    return lambda x: lax.cond(x[0] > 0, first, times(count), x)


def numbers(*shape):
    return np.ones(shape)


# function whose equation of a name is asked for, or the last one; its operand; whether it is written
CASES = {
    "elementwise": (jnp.sin, numbers(3), True),
    "a move": (lambda x: x.T, numbers(3, 2), True),
    "a reduction": (lambda x: x.sum(), numbers(3), True),
    "places in order": (lambda x: lax.iota(np.int32, 5), numbers(3), True),
    "an operation by number": (lambda x: lax.pad(x, 0.0, [(1, 1, 0)]), numbers(3), True),
    "as many numbers as it may be": (lambda x: x * x, numbers(333), True),
    "more numbers": (lambda x: x * x, numbers(334), False),
    "as many products as it may be": (lambda x: x @ x.T, numbers(10, 10), True),
    "more products": (lambda x: lax.dot(numbers(10, 11), x), numbers(11, 10), False),
    "products of a batch": (lambda x: jnp.einsum("bij,bjk->bik", x, x), numbers(5, 6, 6), False),
    "products of a small batch": (lambda x: jnp.einsum("bij,bjk->bik", x, x), numbers(4, 6, 6), True),
    "no rule": (lambda x: jnp.fft.fft(x).real, numbers(3), False),
    "to complex numbers": (lambda x: lax.complex(x, x), numbers(3), False),
    "from complex numbers": (lax.abs, numbers(3) + 1j, False),
    "converted to complex numbers": (lambda x: x.astype(complex), numbers(3), False),
    "of random keys": (jax.random.wrap_key_data, np.zeros(2, np.uint32), False),
    "with an effect": (lambda x: jax.debug.print("{}", x), numbers(3), False),
    "a condition's loop": (lambda x: lax.while_loop(lambda y: y[0] < 3, lambda y: y + 1, x), numbers(3), False),
    "a loop over real numbers": (loop(0.0, 3), numbers(3), False),
    "a search": (loop(0, 64), numbers(3), True),
    "a search of truth values": (loop(False, 3, lambda flag: ~flag), numbers(3), True),
    "a long search": (loop(0, 65), numbers(3), False),
    "a search by an unknown operation": (loop(0, 3, lambda n: n + lax.population_count(n)), numbers(3), False),
    "a loop that carries nothing": (lambda x: lax.scan(lambda _, __: (None, None), None, length=3), numbers(3), False),
    "branches": (branches(100), numbers(3), True),
    "long branches": (branches(101), numbers(3), False),
    "long branches together": (branches(60, times(50)), numbers(3), False),
    "a branch that is not written": (branches(1, lambda x: jnp.fft.fft(x).real), numbers(3), False),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_region_holds_small_operations_that_it_knows(name):
    function, operand, expected = CASES[name]
    *_, equation = jax.make_jaxpr(function)(operand).jaxpr.eqns
    assert can_write(equation) == expected


TO_A_PLACE = lax.ScatterDimensionNumbers((), (0,), (0,))
# an operation; shapes of the largest operands that are taken apart into numbers, and of some that are not
TAKEN_APART = {
    "sort": (lambda x: lax.sort(x, dimension=0), [(24, 4)], [(25,)], [(24, 5)], [(0, 3)]),
    "top_k": (lambda x: lax.top_k(x, 1, axis=0), [(24, 4)], [(25,)], [(24, 5)]),
    "cumsum": (lax.cumsum, [(2048,)], [(2049,)], [(0,)]),
    "argmax": (lambda x: lax.argmax(x, 0, np.int32), [(2048,)], [(2049,)]),
    "scatter": (
        lambda x, u: lax.scatter(x, np.zeros((*u.shape, 1), np.int32), u, TO_A_PLACE),
        [(32,), (64,)], [(683,), (3,)],
    ),
    "conv_general_dilated": (
        lambda x, k: lax.conv_general_dilated(x, k, (1,), "VALID"),
        [(1, 1, 1025), (1, 1, 2)], [(1, 1, 1026), (1, 1, 2)],
    ),
    "lu": (lax.linalg.lu, [(6, 6)], [(1, 15)], [(7, 7)]),
    "qr": (lax.linalg.qr, [(6, 6)], [(1, 15)], [(7, 7)]),
    "cholesky": (lambda x: lax.linalg.cholesky(x, symmetrize_input=False), [(18, 18)], [(19, 19)]),
    "triangular_solve": (
        lambda x, b: lax.linalg.triangular_solve(x, b, left_side=True),
        [(18, 18), (18, 18)], [(18, 18), (18, 19)], [(19, 19), (19, 1)],
    ),
    "lu_pivots_to_permutation": (
        lambda x: lax.linalg.lu_pivots_to_permutation(x.astype(np.int32), 3000), [(2048,)], [(2049,)],
    ),
}  # fmt: skip
OF_MATRICES = {"lu", "qr", "cholesky", "triangular_solve", "lu_pivots_to_permutation"}


def equation_of(name, function, shapes, dtype=float):
    equations = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(shape, dtype) for shape in shapes)).jaxpr.eqns
    [found] = [each for each in equations if each.primitive.name == name]
    return found


@pytest.mark.parametrize("name", TAKEN_APART)
def test_small_operations_are_taken_apart(name):
    """Where a derivative is taken, JAX's own rules do it for matrices; never of complex numbers."""
    function, largest, *others = TAKEN_APART[name]
    for shapes, expected in ((largest, True), *((each, False) for each in others)):
        equation = equation_of(name, function, shapes)
        found = [rule_of(equation, differentiated=derived) is not None for derived in (False, True)]
        assert found == [expected, expected and name not in OF_MATRICES], shapes
    if name in ("sort", "cumsum", "qr"):
        assert rule_of(equation_of(name, function, largest, complex), differentiated=False) is None
    assert simpler(equation_of(name, function, others[0]), differentiated=False) is None


@pytest.mark.parametrize(
    ("name", "function", "shapes"),
    [
        ("conv_general_dilated", lambda x, k: lax.conv_general_dilated(
            x, k, (1,), "VALID", feature_group_count=2), [(1, 2, 4), (2, 1, 2)]),
        ("conv_general_dilated", lambda x, k: lax.conv_general_dilated(
            x, k, (1,), "VALID", batch_group_count=2), [(2, 1, 4), (2, 1, 2)]),
        ("scatter", lambda x: lax.scatter_apply(
            x, np.zeros((1, 1), np.int32), jnp.sin, TO_A_PLACE, update_shape=(1,)), [(3,)]),
        ("qr", lambda x: lax.linalg.qr(x, pivoting=True), [(3, 3)]),
    ],
)  # fmt: skip
def test_rarer_ways_of_an_operation_are_left_to_xla(name, function, shapes):
    assert rule_of(equation_of(name, function, shapes), differentiated=False) is None


class Silent(Rows):
    """A writer that computes nothing."""

    def operation(self, primitive, parameters, operands):
        return Value(None, np.dtype(parameters.get("new_dtype", operands[-1].dtype)))


def written(function, *given, before=None):
    """Write a function of numbers none of which is known."""
    program = flat(jax.make_jaxpr(function)(*given))
    do = Operations(Silent(1), LimbAxes(program), before)
    elements = [as_array((Value(None, n.dtype) for n in np.ravel(each)), each.shape) for each in given]
    return results(do, program, elements)


def rows_of(count, steps=100):
    """A loop of so many steps that writes so many numbers at each."""
    return lambda x: lax.scan(lambda c, _: (c * 0.5, jnp.broadcast_to(c, (count,))), x, length=steps)


PLACE, MANY = np.array([1], np.int32)[0], {number: (None, None) for number in range(49_999)}
TOO_MUCH = {
    "products": (lambda a, b: a @ b, (numbers(18, 18), numbers(18, 19)),
                 "a product of matrices of more than 5832 products"),
    "products of a batch": (lambda a, b: jnp.einsum("bij,bjk->bik", a, b), (numbers(2, 18, 18), numbers(2, 18, 10)),
                            "a product of matrices of more than 5832 products"),
    "places": (lambda t, n: lax.dynamic_slice(t, (n,), (1,)), (numbers(65), np.asarray(PLACE)),
               "the operation dynamic_slice at one of more than 64 places"),
    "places of two axes": (lambda t, n: lax.dynamic_slice(t, (n, n), (1, 2)), (numbers(13, 6), np.asarray(PLACE)),
                           "the operation dynamic_slice at one of more than 64 places"),
    "records": (rows_of(2001), (numbers(),), "a loop that writes more than 200000 numbers"),
    "operations": (lambda x: jnp.sin(x) + x, (numbers(),),
                   "a program of more than 50000 operations on single numbers"),
    "a loop of no steps": (rows_of(1, 0), (numbers(),), "a loop of no steps that reads or writes something at each"),
    "an effect": (lambda x: jax.debug.print("{}", x), (numbers(),),
                  "the operation debug_print, which has effects,"),
    "complex numbers": (lambda x, y: lax.complex(x, y), (numbers(3), numbers(3)),
                        "the operation complex on complex numbers or random keys"),
    "no rule": (lambda x: lax.erf(x), (numbers(3),), "the operation erf"),
    "a parameter": (lambda x: lax.exp(x, accuracy=lax.AccuracyMode.HIGHEST), (numbers(3),),
                    "the operation exp with accuracy=AccuracyMode.HIGHEST"),
}  # fmt: skip
AS_MUCH = {
    "products": (lambda a, b: a @ b, (numbers(18, 18), numbers(18, 18))),
    "places": (lambda t, n: lax.dynamic_slice(t, (n,), (1,)), (numbers(64), np.asarray(PLACE))),
    "places of two axes": (lambda t, n: lax.dynamic_slice(t, (n, n), (1, 2)), (numbers(16, 5), np.asarray(PLACE))),
    "operations": (jnp.sin, (numbers(),)),
    "one step": (rows_of(2, 1), (numbers(),)),
}  # fmt: skip


@pytest.mark.parametrize("name", TOO_MUCH)
def test_what_is_too_much_to_be_written_is_refused_with_its_line(name):
    function, given, said = TOO_MUCH[name]
    with pytest.raises(Unsupported, match=rf"^{said} \(.*test_what_regions_hold\.py:\d+") as refused:
        written(function, *given, before=MANY if name == "operations" else None)
    assert refused.value.equation.primitive.name in said or name in ("products", "products of a batch", "records",
                                                                    "operations", "a loop of no steps")  # fmt: skip


@pytest.mark.parametrize("name", AS_MUCH)
def test_as_much_as_there_may_be_is_written(name):
    function, given = AS_MUCH[name]
    found = written(function, *given, before=MANY if name == "operations" else None)
    shapes = [each.shape for each in jax.tree.leaves(jax.eval_shape(function, *given))]
    assert [each.shape for each in found] == shapes
