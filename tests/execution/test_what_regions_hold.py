"""Which operations a CPU's region writes as elements: by kind, size, and what loops and branches hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_climb.execution.element_rules import can_write


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
    "branches": (branches(98), numbers(3), True),
    "long branches": (branches(101), numbers(3), False),
    "long branches together": (branches(60, times(50)), numbers(3), False),
    "a branch that is not written": (branches(1, lambda x: jnp.fft.fft(x).real), numbers(3), False),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_region_holds_small_operations_that_it_knows(name):
    function, operand, expected = CASES[name]
    *_, equation = jax.make_jaxpr(function)(operand).jaxpr.eqns
    assert can_write(equation) == expected
