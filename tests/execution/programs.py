"""Random programs of the operations that laws are written with, each by its number alone."""

import random

import jax
import jax.numpy as jnp
from jax import lax

SIZE = 4

# functions of a vector (SIZE,), a matrix (SIZE, SIZE) and a place () to vectors, of numbers of size one
STEPS = {
    "set": lambda v, m, n: v.at[n].set(m[0, 1]),
    "add": lambda v, m, n: v.at[jnp.stack([n, n])].add(m[0, :2]),
    "max": lambda v, m, n: v.at[n].max(m[1, 1]),
    "segment_sum": lambda v, m, n: jax.ops.segment_sum(m[:, 0], jnp.stack([n, n * 0, n, n * 0 + 1]), SIZE),
    "cumsum": lambda v, m, n: jnp.cumsum(v) / SIZE,
    "cumprod": lambda v, m, n: jnp.cumprod(v),
    "cummax": lambda v, m, n: lax.cummax(v),
    "argmax": lambda v, m, n: m[v.argmax()],
    "argmin": lambda v, m, n: v * v.argmin() / SIZE,
    "sort": lambda v, m, n: jnp.sort(v),
    "argsort": lambda v, m, n: m[0][jnp.argsort(v)],
    "median": lambda v, m, n: v - jnp.median(v),
    "top_k": lambda v, m, n: v.at[:2].set(lax.top_k(v, 2)[0]),
    "solve": lambda v, m, n: jnp.linalg.solve(_firm(m), v),
    "inv": lambda v, m, n: jnp.linalg.inv(_firm(m))[n],
    "qr": lambda v, m, n: jnp.linalg.qr(_firm(m))[1][0],
    "convolve": lambda v, m, n: jnp.convolve(v, m[0, :3], mode="same"),
    "cond": lambda v, m, n: lax.cond(v[0] > 0, lambda a: a @ m, jnp.sin, v),
    "loop": lambda v, m, n: lax.fori_loop(0, 3, lambda _, a: a - 0.1 * jnp.tanh(m @ a), v),
}


def _firm(matrix):
    return 3 * jnp.eye(SIZE) + jnp.tanh(matrix)[::-1]


def program(number):
    """Return the names of the steps of a random program, and it: of a vector, a matrix and a place, to a vector."""
    draw = random.Random(number)
    names = draw.sample(sorted(STEPS), 4)

    def function(vector, matrix, place):
        matrix = jnp.asarray(matrix)
        for name in names:
            vector = jnp.tanh(STEPS[name](vector, matrix, place)) + 0.3 * vector
            matrix = matrix + 0.1 * jnp.outer(vector, vector[::-1])
        return vector

    return names, function
