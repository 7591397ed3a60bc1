"""One function for each of many operations of JAX's, each of a vector, a small matrix and a whole number."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

TABLE, MANY = np.linspace(-1.0, 2.0, 5), np.linspace(-1.0, 2.0, 100)
FRAME = np.array([[1.0, 0.0, -1.0], [0.0, 0.5, 1.0], [2.0, 0.0, 1.0]])


def _loop(vector, matrix, number):
    return lax.scan(lambda carry, row: (carry + row * number, (carry * row).sum()), vector, matrix)


def _backwards(vector, matrix, number):
    return lax.scan(lambda carry, row: (carry * 0.5 + row, carry), vector, matrix, reverse=True)


def _read(carry, given, number, times=120):
    """Return the next carry of a loop that is too long to be written out."""
    row, own = given
    for _ in range(times):
        carry = carry * 0.9 + row * own
    return carry - number, None


def _row_by_row(carry, given, number, reverse):
    """Return the next carry of a loop that reads rows of two tables, of which another loop reads the elements."""
    return lax.scan(lambda carry, each: _read(carry, each, number), carry, given, reverse=reverse)


def _well(matrix):
    """Return a matrix (3, 3) that is far from singular, and whose elimination exchanges rows."""
    return matrix[:3] * 0.2 + np.roll(np.eye(3), 1, 0) * 2


def _of_six(vector, matrix):
    """Return a matrix (6, 6) that is far from singular."""
    part = matrix[:3] * 0.2
    return jnp.block([[part, jnp.eye(3) * 3], [2 * jnp.eye(3) + part.T * vector, part.T]])


def _draw(vector, matrix, number):
    key = jax.random.fold_in(jax.random.key(3), number)
    first, second = jax.random.split(key)
    chosen = jax.random.wrap_key_data(jnp.where(number > 0, jax.random.key_data(first), jax.random.key_data(second)))
    return jax.random.uniform(chosen, (3,)) + vector, jax.random.bits(second, (2,)), jax.random.normal(first, (2,))


@jax.custom_vjp
def _own_rule(value):
    return jnp.sin(value)


_own_rule.defvjp(lambda value: (jnp.sin(value), value), lambda value, change: (change * jnp.cos(value),))

# name: function(vector (3,), matrix (4, 3), number ()), of and to anything
KNOWN = {
    "zeros and ones": lambda v, m, n: (jnp.ones(2), (FRAME * v).sum(1), (FRAME @ m.T).max(0), v * FRAME[0, 1]),
    "reduce_sum": lambda v, m, n: (
        m.sum(0) + m.sum(),
        (m[:, :, None] * v).sum((0, 2)),
        (m[:, :, None] * v).sum((1, 0)),
    ),
    "reduce_prod": lambda v, m, n: m.prod(1),
    "reduce_max": lambda v, m, n: (m.max(0), m.min(1)),
    "reduce_and": lambda v, m, n: ((m > 0).all(0), (m > 1).any(1)),
    "reductions of nothing": lambda v, m, n: (
        m[:, :0].sum(1),
        m[:0].prod(0),
        m[:, :0].max(1, initial=0.5),
        m[:0].min(initial=0.5, axis=0),
        (m[:, :0] > 0).all(1),
        (m[:0] > 0).any(0),
        jnp.round(m[:, :0]).astype(jnp.int32).max(1, initial=-9),
    ),
    "dot_general": lambda v, m, n: (m @ v, m @ m.T, jnp.einsum("ij,ij->i", m, m), jnp.dot(v, v)),
    "dot_general of whole numbers": lambda v, m, n: lax.dot(
        jnp.round(m).astype(jnp.int8), jnp.round(v).astype(jnp.int8), preferred_element_type=jnp.int32
    ),
    "select_n": lambda v, m, n: lax.select_n(jnp.clip(jnp.round(v), 0, 2).astype(jnp.int32), v, v + 1, 3 * v),
    "select_n of known cases": lambda v, m, n: jnp.where(v > 0, 1.0, 2.0) + jnp.where(v > 0, 1065353216, 0),
    "clamp": lambda v, m, n: (jnp.clip(v, -0.5, 0.5), lax.clamp(-1.0, v, v[0] ** 2)),
    "gather of known places": lambda v, m, n: (m[jnp.array([2, 0])], m[:, [2, 1]], v[::-1]),
    "scan": _loop,
    "scan backwards": _backwards,
    "fori_loop": lambda v, m, n: lax.fori_loop(0, 3, lambda step, total: total + step * v, v),
    "pad": lambda v, m, n: (jnp.pad(m, ((1, 2), (0, 1))), lax.pad(v, 1.5, [(-1, 2, 1)]), lax.pad(v, 0.0, [(1, -2, 0)])),
    "moves": lambda v, m, n: (m.T, m.reshape(3, 4), m[::-1, ::2], jnp.roll(m, 1, 0), jnp.concatenate([v, v * 2])),
    "split": lambda v, m, n: jnp.split(m, [1, 3]),
    "bits": lambda v, m, n: (n << 3, n >> 1, n ^ 5, ~n, n & 6, n | 8),
    "shift_right_logical": lambda v, m, n: lax.shift_right_logical(n, jnp.int32(2)),
    "whole numbers": lambda v, m, n: (
        n * 7 % 5,
        lax.rem(n, jnp.int32(2)),
        lax.rem(n, jnp.int32(-1)),
        n // 3,
        lax.rem(n, jnp.int32(4)),
        jnp.abs(n),
        jnp.sign(n),
    ),
    "pow of a whole number": lambda v, m, n: lax.pow(v, 3),
    "whole numbers beyond 24 bits": lambda v, m, n: (n * 2**20 + 12345, n.astype(jnp.uint32) + jnp.uint32(2**31)),
    "convert_element_type": lambda v, m, n: (v.astype(jnp.int32), n.astype(v.dtype), (v > 0).astype(jnp.int32)),
    "custom_vjp_call": lambda v, m, n: _own_rule(v),
    "stop_gradient": lambda v, m, n: lax.stop_gradient(v) * 2,
    "NaN": lambda v, m, n: (
        jnp.maximum(jnp.where(v > 0, jnp.nan, v), 0.5),
        jnp.maximum(0.5, jnp.where(v > 0, jnp.nan, v)),
        jnp.minimum(jnp.where(v > 0, jnp.nan, v), 0.5),
        jnp.minimum(0.5, jnp.where(v > 0, jnp.nan, v)),
        (lambda a: a - a)(jnp.where(v > 0, jnp.nan, v)),
    ),
    "halves": lambda v, m, n: jnp.round(n + jnp.arange(-3.5, 4.0)),
    "is_finite": lambda v, m, n: (jnp.isfinite(1 / jnp.round(v)), jnp.isnan(jnp.sqrt(v))),
    "round": lambda v, m, n: (jnp.round(v), jnp.floor(v), jnp.ceil(v), jnp.sign(v), jnp.trunc(v)),
    "powers": lambda v, m, n: (v**3, jnp.abs(v) ** 1.7, jnp.square(v), jnp.cbrt(v), lax.rsqrt(jnp.abs(v))),
    "exponents": lambda v, m, n: (jnp.exp(v), jnp.exp2(v), jnp.expm1(v), jnp.logaddexp(v, 1)),
    "logarithms": lambda v, m, n: (jnp.log(v**2), jnp.log1p(v**2)),
    "angles": lambda v, m, n: (jnp.sin(v), jnp.cos(v), jnp.tan(v), jnp.arctan2(v, v[0])),
    "inverse angles": lambda v, m, n: (jnp.arcsin(v / 9), jnp.arccos(v / 9), jnp.arctan(v)),
    "hyperbolic": lambda v, m, n: (jnp.tanh(v), jnp.sinh(v), jnp.cosh(v), jnp.arcsinh(v), jax.nn.sigmoid(v)),
    "comparisons": lambda v, m, n: (v > v[0], v >= v[0], v == v[0], v != v[0], (v < 0) & (v <= 1) | (v > 2), ~(v > 0)),
    "nextafter": lambda v, m, n: jnp.nextafter(v, 3.0),
    "rem": lambda v, m, n: (lax.rem(v, 0.7), jnp.mod(v, 0.7), jnp.maximum(v, 0.1), jnp.minimum(v, v[1])),
    "norm": lambda v, m, n: (jnp.linalg.norm(v), jnp.cross(v, m[0]), jnp.linalg.norm(m, axis=1)),
    "convolve": lambda v, m, n: jnp.diff(m, axis=0),
    "dynamic_slice": lambda v, m, n: (m[n], *(lax.dynamic_slice(m, (i, n), (2, 2)) for i in (n, jnp.int32(9)))),
    "dynamic_update_slice": lambda v, m, n: lax.dynamic_update_slice(m, m[1:3, :2] * 2, (n, n - 1)),
    "delay": lambda v, m, n: lax.dynamic_update_index_in_dim(m, v, n % 4, 0)[(n + 1) % 4],
    "gather": lambda v, m, n: (m[jnp.stack([n, n + 9, n - 9])], m[n, jnp.stack([n, n + 1])], m[:, n]),
    "gather that fills": lambda v, m, n: (
        m.at[n + 1].get(mode="fill", fill_value=7.0),
        m.at[jnp.stack([n, n + 2])].get(mode="fill"),
        jnp.arange(5).at[n].get(mode="fill"),
    ),
    "gather that clips": lambda v, m, n: m.at[n + 2].get(mode="clip"),
    "a table read": lambda v, m, n: TABLE[1] + jnp.asarray(TABLE)[jnp.clip(jnp.round(v), 0, 4).astype(jnp.int32)],
    "interp": lambda v, m, n: (
        jnp.interp(v, TABLE, TABLE**2 + 1),
        jnp.interp(v, TABLE, TABLE**3, left=-9.0, right="extrapolate"),
        jnp.interp(v[0], v[1] + TABLE, TABLE),
    ),
    "searchsorted": lambda v, m, n: (
        jnp.searchsorted(TABLE, v, side="right"),
        jnp.searchsorted(np.array([-1.0, 0.0, 0.0, np.inf]), v),
        jnp.searchsorted(np.arange(-2, 3), n),
    ),
    "digitize": lambda v, m, n: jnp.digitize(jnp.where(v > 1, jnp.nan, v), np.array([-1.0, -0.0, 2.0])),
    "cond": lambda v, m, n: (
        lax.cond(v[0] > 0, lambda a: (a * 2, 1), lambda a: (a - 1, 2), v),
        lax.cond(n > 0, lambda a: jnp.maximum(a, m[0]).sum(), lambda a: lax.cond(n < -2, jnp.sin, jnp.cos, a)[0], v),
    ),
    "cond of a loop": lambda v, m, n: [
        lax.cond(which, lambda a: lax.scan(lambda c, row: (c * 0.9 + row, None), a, m)[0], lambda a: a + n, v)
        for which in (v[0] > 0, v[0] <= 0)
    ],
    "a loop that reads": lambda v, m, n: [
        lax.scan(lambda c, row: _read(c, row, n), v, (v, TABLE[:3]), reverse=True)[0],
        lax.scan(lambda c, row: _read(c, row, n, 4), v, (v[0] * MANY, MANY > 1))[0],
    ],
    "a loop in a loop that reads": lambda v, m, n: [
        lax.scan(functools.partial(_row_by_row, number=n, reverse=reverse), v, (rows, m), reverse=reverse)[0]
        for rows, reverse in ((m, False), (jnp.sin(m), True))
    ],
    "switch": lambda v, m, n: lax.switch(n, [lambda a: a, lambda a: a * a, lambda a: -a], v),
    "scatter": lambda v, m, n: (
        m.at[n].set(1.0),
        m.at[n].add(v),
        m.at[n].max(0.5),
        m.at[n, 1].min(v[0]),
        m.at[n + 2].multiply(2.0, mode="clip"),
        v.at[jnp.stack([n, n])].add(v[:2]),
    ),
    "scatter to known places": lambda v, m, n: (
        jnp.zeros(6).at[2].set(v[0]),
        jnp.zeros(6).at[2:5].set(v),
        m.at[1:3, :2].add(v[:2]),
        jnp.zeros(6).at[::2].set(v),
        v.at[jnp.array([0, 0, 2])].add(v),
    ),
    "scatter of a window": lambda v, m, n: lax.scatter(
        m, n[None], m[:2] * 2, lax.ScatterDimensionNumbers((0, 1), (), (0,)), mode="drop"
    ),
    "scatter in rows": lambda v, m, n: jax.vmap(lambda row, at: row.at[at].set(7.0))(m, jnp.arange(4) + n),
    "segment_sum": lambda v, m, n: (
        jax.ops.segment_sum(m, np.array([0, 1, 0, 1]), 3),
        jax.ops.segment_sum(v, jnp.stack([n, n, n * 0]), 3),
    ),
    "cumsum": lambda v, m, n: (jnp.cumsum(m, 0), lax.cumsum(m, 1, reverse=True), jnp.cumprod(v)),
    "cummax": lambda v, m, n: (lax.cummax(m, 0), lax.cummin(m, 1, reverse=True)),
    "argmax": lambda v, m, n: (m.argmax(0), m.argmin(1), jnp.round(m).argmax(), jnp.stack([v, v]).argmax(0)),
    "argmax of NaN": lambda v, m, n: jnp.where(m > 1, jnp.nan, m).argmax(0),
    "a part of a product": lambda v, m, n: jnp.take_along_axis(m, jnp.argmax(m, 0)[None], 0),
    "sort": lambda v, m, n: (
        jnp.sort(m, 0),
        jnp.argsort(v),
        jnp.argsort(jnp.round(m).ravel()),
        jnp.lexsort((v, jnp.round(v))),
    ),
    "sort of NaN": lambda v, m, n: jnp.argsort(jnp.where(m > 1, jnp.nan, m), 1),
    "median": lambda v, m, n: (jnp.median(v), jnp.median(m, 0), jnp.percentile(v, 30.0)),
    "top_k": lambda v, m, n: (lax.top_k(v, 2), lax.top_k(jnp.round(m), 2)[1]),
    "solve": lambda v, m, n: (jnp.linalg.solve(_well(m), v), jnp.linalg.solve(_well(m), m.T)),
    "inv": lambda v, m, n: (jnp.linalg.inv(_well(m)), jnp.linalg.det(m[:3])),
    "inv of six": lambda v, m, n: jnp.linalg.inv(_of_six(v, m)),
    "qr": lambda v, m, n: (jnp.linalg.qr(_well(m)), jnp.linalg.qr(_well(m)[:, :2])),
    "inertia of a robot": lambda v, m, n: jax.scipy.linalg.cho_solve(
        jax.scipy.linalg.cho_factor(
            5 * jnp.eye(18) + jnp.outer(jnp.cos(jnp.arange(18.0) * v[0]), jnp.arange(18.0) / 18)
        ),
        jnp.arange(18.0) * v[1],
    ),
    "cholesky": lambda v, m, n: jnp.linalg.cholesky(m.T @ m + jnp.eye(3)),
    "convolve of a vector": lambda v, m, n: (
        jnp.convolve(v, m[0]),
        jnp.convolve(m.ravel(), v, mode="same"),
        jnp.correlate(m.ravel(), v),
    ),
    "checkpoint": lambda v, m, n: jax.checkpoint(jnp.sin)(v),
}
# what no kernel does: it may be refused, not wrong
OTHERS = {
    "qr of a wide matrix": lambda v, m, n: (jnp.linalg.qr(m.T), jnp.linalg.qr(m, mode="complete")),
    "a long sort": lambda v, m, n: jnp.sort(jnp.cos(jnp.arange(40.0)) * v[0]),
    "cond of a known choice": lambda v, m, n: lax.cond(jnp.asarray(TABLE[0] > 0), lambda a: a * 2, lambda a: a - 1, v),
    "reduce_xor": lambda v, m, n: lax.reduce_xor_p.bind((m * 8).astype(jnp.int32), axes=(0,)),
    "gather that fills at known places": lambda v, m, n: m.at[jnp.array([0, 9])].get(mode="fill", fill_value=7.0),
    "threefry": _draw,
    "known keys": lambda v, m, n: jax.random.normal(jax.random.key(1), (3,)) * v,
    "while_loop": lambda v, m, n: lax.while_loop(lambda a: a.sum() < 20, lambda a: jnp.abs(a) + 1, v),
    "erf": lambda v, m, n: jax.scipy.special.erf(v),
    "fft": lambda v, m, n: jnp.abs(jnp.fft.fft(v)),
    "reduce_window": lambda v, m, n: lax.reduce_window(m, 0.0, lax.add, (2, 1), (1, 1), "VALID"),
    "reduce": lambda v, m, n: lax.reduce(m, 0.0, lambda a, b: a + b * b, (0,)),
    "reduce_precision": lambda v, m, n: lax.reduce_precision(v, 5, 4),
    "bitcast to another size": lambda v, m, n: lax.bitcast_convert_type(jnp.round(v), jnp.uint16),
    "callback": lambda v, m, n: jax.pure_callback(
        lambda a: np.asarray(a) * 2, jax.ShapeDtypeStruct(v.shape, v.dtype), v, vmap_method="sequential"
    ),
    "a large product": lambda v, m, n: (
        jnp.linspace(0, 1, 1600).reshape(40, 40) * v[0] @ jnp.cos(jnp.arange(1600.0).reshape(40, 40))
    ).sum(0),
    "a large table": lambda v, m, n: jnp.arange(200.0)[jnp.abs(n)] + v,
    "a long loop": lambda v, m, n: lax.scan(lambda c, _: (c * 0.9, c), v, length=100)[1],
    "other random bits": lambda v, m, n: jax.random.uniform(jax.random.key(1, impl="rbg"), (3,)) + v,
    "associative_scan": lambda v, m, n: lax.associative_scan(jnp.add, m),
    "copy": lambda v, m, n: jnp.array(v, copy=True),
}
EVERY = KNOWN | OTHERS
