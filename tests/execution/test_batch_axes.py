"""Batch axes of laws and parameters: which values vary over a batch, and what all of them broadcast to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance
from mjx_climb.execution.batch_axes import axes_behind, batch_shape, is_traced, over_batch, own_axes
from mjx_climb.inputs.from_scenario import own_parameters

PARAMETERS = own_parameters(mc.load_scenario("case_1_2"))


def law(*shape):
    rows = np.arange(1.0, 1 + np.prod(shape)).reshape(*shape, 1) * np.ones(6)
    return VirtualModelAdmittance(np.ones(6), rows, 2 * rows)


def test_a_value_of_one_robot_has_as_many_axes_as_its_field_says():
    assert (own_axes(law()).damping, own_axes(law(5, 2)).damping) == (1, 1)
    own = own_axes(PARAMETERS)
    assert (own.gravity, own.mass_scale, own.contact.stiffness, own.force_sensor.dead) == (1, 0, 0, 1)
    assert own_axes((law(), PARAMETERS))[1].gravity == 1
    assert axes_behind(law(5, 2), (5,)).damping == 2 and axes_behind(law(5, 2), (5, 2)).damping == 1


def test_batch_axes_of_all_values_broadcast_or_are_named():
    own = PARAMETERS.replace({"contact.stiffness": np.ones((3, 1)), "gravity": np.ones((3, 1, 3))})
    assert batch_shape(law(), PARAMETERS) == () and batch_shape(law(4), own) == (3, 4)
    assert batch_shape(law(), others={"kp": (2, 1)}) == (2, 1)
    with pytest.raises(
        ValueError, match=r"expected some that broadcast, got damping \(4,\), contact.stiffness \(3,\)$"
    ):
        batch_shape(law(4), PARAMETERS.replace({"contact.stiffness": np.ones(3)}))
    with pytest.raises(ValueError, match=r"got damping \(4,\), kp \(3,\)$"):
        batch_shape(law(4), others={"kp": (3,)})


def test_robots_of_a_batch_are_carried_out_one_by_one_and_shared_values_once():
    seen = []

    def one(own, mass, gravity):
        seen.append((own.damping.shape, mass.shape, gravity.shape, jnp.ndim(gravity)))
        return {"force": own.damping * mass + gravity.sum(), "shared": gravity}

    given, mass, gravity = law(2, 3), jnp.arange(3.0)[None] + jnp.ones((2, 1)), jnp.array([0.0, 0.0, -9.0])
    axes = own_axes(given), 0, 1
    found = over_batch(one, (given, mass, gravity), axes, (2, 3))
    assert found["force"].shape == (2, 3, 6) and found["shared"].shape == (2, 3, 3)
    np.testing.assert_allclose(found["force"], given.damping * mass[..., None] - 9.0)
    assert seen == [((6,), (), (3,), 1)]
    alone = over_batch(one, (law(), jnp.ones(()), gravity), axes, ())
    assert alone["force"].shape == (6,)
    of_one = over_batch(one, (law(1), jnp.ones(()), gravity), axes, (1,))
    assert of_one["force"].shape == (1, 6)
    assert seen[1:] == [((6,), (), (3,), 1)] * 2


def test_a_tree_is_traced_where_any_value_is():
    found = []
    jax.jit(lambda value: found.append((is_traced({"a": 1.0, "b": value}), is_traced({"a": 1.0}))))(1.0)
    assert found == [(True, False)]
