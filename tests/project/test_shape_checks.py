"""Shapes in signatures are checked while the tests run, see `tests/shapes.py`: wrong ones are seen, right ones pass."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

import mjx_climb as mc
from mjx_climb.dynamics.spatial import norm, quaternion_multiply, quaternion_to_matrix


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: quaternion_to_matrix(jnp.ones(3)),
        lambda: quaternion_multiply(jnp.ones(4), jnp.ones(3)),
        lambda: mc.Gains(np.ones(5), 1.0, 2.0),
        lambda: mc.State(*[np.ones((2, 3))] * 6),  # its orientation has four components
    ],
)
def test_wrong_shapes_are_seen(wrong):
    with pytest.raises(TypeCheckError):
        wrong()


def test_right_shapes_pass():
    """Batch axes that broadcast, arrays of numpy for those of JAX, and what JAX puts into trees on its way."""
    gains = mc.Gains(1, np.ones((64, 1)), 3e3)
    assert jax.tree.map(jnp.ndim, gains).damping == 2
    assert jax.tree.map(lambda _: True, gains).damping is True
    batch = mc.Gains(*[np.ones((3, 6))] * 3)
    assert jax.vmap(lambda one: one.damping)(batch).shape == (3, 6)
    assert norm(np.ones((5, 4))).shape == (5,)
