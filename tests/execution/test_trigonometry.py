"""Sine, cosine and angle of vector operations against NumPy's in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.execution import devices, over_robots
from mjx_climb.execution.array_writer import in_single


@pytest.fixture(autouse=True)
def on_a_cpu():
    with devices.on_host():
        yield


def replaced(name):
    return lambda *operands: in_single(name, operands)


EXACT = {"sin": np.sin, "cos": np.cos, "atan2": np.arctan2}
MINE = {name: replaced(name) for name in EXACT}
ANGLES = pytest.mark.parametrize("name", ["sin", "cos"])
# of one number, by JAX: `over_robots` puts the others in the place of these
FUNCTIONS = {"sin": jnp.sin, "cos": jnp.cos, "atan2": lambda x: jnp.arctan2(x, 1 + x**2)}


@ANGLES
@pytest.mark.parametrize("largest", [1e-3, 0.8, 4.0, 1e3])
def test_of_an_angle(name, largest):
    """In units in the last place of one."""
    angles = np.random.default_rng(1).uniform(-largest, largest, 100_000).astype(np.float32)
    found, exact = np.asarray(jax.jit(MINE[name])(angles), float), EXACT[name](angles.astype(float))
    assert (np.abs(found - exact) / np.spacing(np.maximum(np.abs(exact), 1.0).astype(np.float32))).max() < 1.6


@ANGLES
def test_near_its_zeros(name):
    """Relative to what is left of them; three parts hold half pi to 2e-14."""
    zeros = (np.array([0, np.pi, -np.pi]) + (np.pi / 2 if name == "cos" else 0)).astype(np.float32)
    near = np.concatenate([zeros + step * np.spacing(np.float32(1)) for step in range(-9, 10)]).astype(np.float32)
    np.testing.assert_allclose(MINE[name](near), EXACT[name](near.astype(float)), rtol=1e-6, atol=2e-14)


@ANGLES
def test_of_what_is_no_angle_any_more(name):
    """A diverged walk's angles: within one as long as they are finite, and not a number from then on."""
    assert np.abs(MINE[name](jnp.float32([1e8, -3e20, 3e38]))).max() <= 1
    assert np.isnan(MINE[name](jnp.float32([np.inf, -np.inf, np.nan]))).all()


def test_angle_of_a_vector():
    random = np.random.default_rng(2)
    y, x = (random.normal(size=100_000) * 10 ** random.uniform(-6, 6, 100_000) for _ in "yx")
    y, x = y.astype(np.float32), x.astype(np.float32)
    found, exact = np.asarray(jax.jit(MINE["atan2"])(y, x), float), np.arctan2(y.astype(float), x.astype(float))
    assert (np.abs(found - exact) / np.spacing(np.abs(exact).astype(np.float32))).max() < 2.8


def test_angle_along_the_axes_and_of_nothing():
    """All signs of zero count: half a turn lies between a vector on one side of the negative axis and on the other."""
    values = np.float32([0.0, -0.0, 1.0, -1.0])
    y, x = (each.ravel() for each in np.meshgrid(values, values))
    found, exact = np.asarray(MINE["atan2"](y, x)), np.arctan2(y, x)
    np.testing.assert_allclose(found, exact, rtol=3e-7)
    np.testing.assert_array_equal(np.signbit(found), np.signbit(exact))
    assert np.isnan(MINE["atan2"](np.float32([np.nan, 1.0]), np.float32([1.0, np.nan]))).all()


@ANGLES
def test_derivatives_of_an_angle(name):
    """The first, and the derivative of that."""
    angles = jnp.linspace(-7, 7, 20_001, dtype=jnp.float32)
    along = (jnp.ones_like(angles),)
    first, second = jax.jvp(lambda x: jax.jvp(MINE[name], (x,), along)[1], (angles,), along)
    sine, cosine = np.sin(np.asarray(angles, float)), np.cos(np.asarray(angles, float))
    np.testing.assert_allclose(first, cosine if name == "sin" else -sine, atol=1e-6)
    np.testing.assert_allclose(second, -sine if name == "sin" else -cosine, atol=6e-7)


@pytest.mark.parametrize(
    ("y", "x"), [(0.0, 1.0), (-0.0, 1.0), (0.0, -2.0), (1.0, 0.0), (-3.0, 0.0), (2.0, 2.0), (-2.0, 2.0), (1.0, -0.3)]
)
def test_derivatives_of_the_angle_of_a_vector(y, x):
    """On the axes and on the diagonals too, where absolute values and maxima have none."""
    at = jnp.float32(y), jnp.float32(x)
    for along, exact in (((1.0, 0.0), x / (x * x + y * y)), ((0.0, 1.0), -y / (x * x + y * y))):
        slope = jax.jvp(MINE["atan2"], at, tuple(map(jnp.float32, along)))[1]
        np.testing.assert_allclose(slope, exact, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", EXACT)
def test_takes_the_place_of_the_library_in_single_precision_alone(name):
    library = {"sin": "stablehlo.sine", "cos": "stablehlo.cosine", "atan2": "stablehlo.atan2"}[name]
    for dtype, expected in ((np.float32, True), (np.float64, False)):
        batch = jax.jit(jax.vmap(over_robots(FUNCTIONS[name])))
        assert (library not in batch.lower(np.linspace(0, 1, 5).astype(dtype)).as_text()) == expected


@pytest.mark.parametrize("name", EXACT)
def test_tangents_in_many_directions(name):
    """As walks take them: mapped over directions."""
    at, along = jnp.linspace(0, 1, 5, dtype=jnp.float32), jnp.eye(5, dtype=jnp.float32)
    batch = jax.vmap(over_robots(FUNCTIONS[name]))
    found = jax.vmap(lambda rate: jax.jvp(batch, (at,), (rate,))[1])(along)
    exact = jax.vmap(lambda rate: jax.jvp(FUNCTIONS[name], (at,), (rate,))[1])(along)
    np.testing.assert_allclose(found, exact, rtol=1e-6)


def test_operands_broadcast_and_are_mapped_alone():
    x, y = np.linspace(-2, 2, 6, dtype=np.float32).reshape(2, 3), np.float32([1, 2, -3])
    for axes, operands in (((0, None), (x, y)), ((None, 0), (y, x))):
        np.testing.assert_allclose(jax.vmap(MINE["atan2"], axes)(*operands), np.arctan2(*operands), rtol=1e-6)
    np.testing.assert_allclose(MINE["atan2"](x[:, :1], x), np.arctan2(x[:, :1], x), rtol=1e-6)


def test_other_operands_stay_as_they_are():
    assert in_single("tan", [np.float32(1)]) is None
    assert in_single("atan2", [np.float64(1), np.float32(1)]) is None
