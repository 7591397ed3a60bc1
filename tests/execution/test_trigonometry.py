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


FUNCTIONS = {"sin": (replaced("sin"), np.sin), "cos": (replaced("cos"), np.cos)}
angle_of = replaced("atan2")


def units_off(found, exact):
    """Return by how many units in the last place of one single precision is off."""
    return np.abs(np.asarray(found, float) - exact) / np.spacing(np.maximum(np.abs(exact), 1.0).astype(np.float32))


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("largest", [1e-3, 0.8, 4.0, 1e3])
def test_of_an_angle(name, largest):
    mine, exact = FUNCTIONS[name]
    angles = np.random.default_rng(1).uniform(-largest, largest, 100_000).astype(np.float32)
    assert units_off(jax.jit(mine)(angles), exact(angles.astype(float))).max() < 1.6


@pytest.mark.parametrize("name", FUNCTIONS)
def test_near_its_zeros(name):
    """Relative to what is left of them; three parts hold half pi to 2e-14."""
    mine, exact = FUNCTIONS[name]
    zeros = (np.array([0, np.pi, -np.pi]) + (np.pi / 2 if name == "cos" else 0)).astype(np.float32)
    near = np.concatenate([zeros + step * np.spacing(np.float32(1)) for step in range(-9, 10)]).astype(np.float32)
    np.testing.assert_allclose(mine(near), exact(near.astype(float)), rtol=1e-6, atol=2e-14)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_of_what_is_no_angle_any_more(name):
    """A diverged walk's angles: within one as long as they are finite, and not a number from then on."""
    mine, _ = FUNCTIONS[name]
    assert np.abs(mine(jnp.float32([1e8, -3e20, 3e38]))).max() <= 1
    assert np.isnan(mine(jnp.float32([np.inf, -np.inf, np.nan]))).all()


def test_angle_of_a_vector():
    random = np.random.default_rng(2)
    y, x = (random.normal(size=100_000) * 10 ** random.uniform(-6, 6, 100_000) for _ in "yx")
    y, x = y.astype(np.float32), x.astype(np.float32)
    found, exact = np.asarray(jax.jit(angle_of)(y, x), float), np.arctan2(y.astype(float), x.astype(float))
    assert (np.abs(found - exact) / np.spacing(np.abs(exact).astype(np.float32))).max() < 2.8


def test_angle_along_the_axes_and_of_nothing():
    """All signs of zero count: half a turn lies between a vector on one side of the negative axis and on the other."""
    values = np.float32([0.0, -0.0, 1.0, -1.0])
    y, x = (each.ravel() for each in np.meshgrid(values, values))
    found, exact = np.asarray(angle_of(y, x)), np.arctan2(y, x)
    np.testing.assert_allclose(found, exact, rtol=3e-7)
    np.testing.assert_array_equal(np.signbit(found), np.signbit(exact))
    assert np.isnan(angle_of(np.float32([np.nan, 1.0]), np.float32([1.0, np.nan]))).all()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_of_an_angle(name):
    mine, _ = FUNCTIONS[name]
    angles = jnp.linspace(-7, 7, 20_001, dtype=jnp.float32)
    slopes = jax.jvp(mine, (angles,), (jnp.ones_like(angles),))[1]
    exact = np.cos(np.asarray(angles, float)) if name == "sin" else -np.sin(np.asarray(angles, float))
    np.testing.assert_allclose(slopes, exact, atol=1e-6)


@pytest.mark.parametrize(
    ("y", "x"), [(0.0, 1.0), (-0.0, 1.0), (0.0, -2.0), (1.0, 0.0), (-3.0, 0.0), (2.0, 2.0), (-2.0, 2.0), (1.0, -0.3)]
)
def test_derivatives_of_the_angle_of_a_vector(y, x):
    """On the axes and on the diagonals too, where absolute values and maxima have none."""
    at = jnp.float32(y), jnp.float32(x)
    for along, exact in (((1.0, 0.0), x / (x * x + y * y)), ((0.0, 1.0), -y / (x * x + y * y))):
        slope = jax.jvp(angle_of, at, tuple(map(jnp.float32, along)))[1]
        np.testing.assert_allclose(slope, exact, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", [*FUNCTIONS, "atan2"])
def test_takes_the_place_of_the_library_in_single_precision_alone(name):
    function = {"sin": jnp.sin, "cos": jnp.cos, "atan2": lambda x: jnp.arctan2(x, 1 + x)}[name]
    for dtype, expected in ((np.float32, True), (np.float64, False)):
        with jax.enable_x64(True):
            batch = jax.jit(jax.vmap(over_robots(function)))
            lowered = batch.lower(np.linspace(0, 1, 5).astype(dtype)).as_text()
        library = {"sin": "stablehlo.sine", "cos": "stablehlo.cosine", "atan2": "stablehlo.atan2"}[name]
        assert (library not in lowered) == expected


def test_second_derivatives():
    angle = jnp.float32(0.7)
    sine = FUNCTIONS["sin"][0]
    rate = lambda x: jax.jvp(sine, (x,), (jnp.float32(1),))[1]  # noqa: E731
    np.testing.assert_allclose(jax.jvp(rate, (angle,), (jnp.float32(1),))[1], -np.sin(0.7), rtol=1e-6)


@pytest.mark.parametrize("name", [*FUNCTIONS, "atan2"])
def test_tangents_in_many_directions(name):
    """As walks take them: mapped over directions."""
    function = {"sin": jnp.sin, "cos": jnp.cos, "atan2": lambda x: jnp.arctan2(x, 1 + x**2)}[name]
    at, along = jnp.linspace(0, 1, 5, dtype=jnp.float32), jnp.eye(5, dtype=jnp.float32)
    found = jax.vmap(lambda rate: jax.jvp(jax.vmap(over_robots(function)), (at,), (rate,))[1])(along)
    exact = jax.vmap(lambda rate: jax.jvp(function, (at,), (rate,))[1])(along)
    np.testing.assert_allclose(found, exact, rtol=1e-6)


def test_mapped_over_either_operand():
    x, y = np.linspace(-2, 2, 6, dtype=np.float32).reshape(2, 3), np.float32([1, 2, -3])
    for axes in ((0, None), (None, 0)):
        operands = (x, y) if axes[0] == 0 else (y, x)
        np.testing.assert_allclose(jax.vmap(angle_of, axes)(*operands), np.arctan2(*operands), rtol=1e-6)


def test_operands_broadcast():
    x = np.linspace(-2, 2, 6, dtype=np.float32).reshape(2, 3)
    np.testing.assert_allclose(angle_of(x[:, :1], x), np.arctan2(x[:, :1], x), rtol=1e-6)


def test_other_operands_stay_as_they_are():
    assert in_single("tan", [np.float32(1)]) is None
    assert in_single("atan2", [np.float64(1), np.float32(1)]) is None
