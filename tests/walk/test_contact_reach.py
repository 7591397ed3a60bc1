"""Grippers with a reach: what is too far off the ground is not gripped, and an open gripper only pushes."""

import dataclasses

import jax.numpy as jnp
import numpy as np

import mjx_climb as mc
from mjx_climb.dynamics.kinematics import Feet
from mjx_climb.walk.contact import Contact, Reach, grip

LIMBS = 4
NUMBERS = dataclasses.replace(
    mc.parameters(mc.Scenario()), capture_distance=jnp.asarray(0.005), holding_limit=jnp.asarray(jnp.inf)
)


def feet(*heights, slide=0.0):
    position = jnp.zeros((3, LIMBS, 1)).at[2, :, 0].set(jnp.asarray(heights)).at[0].add(slide)
    return Feet(position, jnp.zeros_like(position), position, ())


def open_above():
    still = jnp.zeros((LIMBS, 1), bool)
    return Contact(jnp.zeros((3, LIMBS, 1)), still, still, Reach(still, still))


def shut(*values):
    return jnp.asarray(values)[:, None]


def walked(contact, foot, closed, numbers=NUMBERS):
    return grip(contact, foot, closed, jnp.zeros((LIMBS, 1)), numbers)


def test_a_gripper_holds_what_is_within_reach():
    contact, held = walked(open_above(), feet(0.004, 0.006, -0.001, 0.1), shut(True, True, True, False))
    np.testing.assert_array_equal(held.support[:, 0], [True, False, True, False])
    np.testing.assert_array_equal(held.missed[:, 0], [False, True, False, False])
    assert held.force[2, 0, 0] < 0 and held.force[2, 1, 0] == 0
    again, later = walked(contact, feet(0.004, 0.001, -0.001, 0.1), shut(True, True, True, False))
    np.testing.assert_array_equal(later.support[:, 0], [True, False, True, False])  # it stays open, near or not
    assert not later.missed.any()
    lifted, _ = walked(again, feet(0.004, 0.1, -0.001, 0.1), shut(True, False, True, False))
    _, gripped = walked(lifted, feet(0.004, 0.001, -0.001, 0.1), shut(True, True, True, False))
    assert gripped.support[1, 0]  # until its next swing


def test_an_open_gripper_pushes_and_does_not_stick():
    contact, held = walked(open_above(), feet(-0.001, 0.1, 0.1, 0.1), shut(False, False, False, False))
    assert held.force[2, 0, 0] > 0
    _, slid = walked(contact, feet(-0.001, 0.1, 0.1, 0.1, slide=0.003), shut(False, False, False, False))
    np.testing.assert_array_equal(slid.force[:2, 0, 0], 0)
    rising = feet(-0.001, 0.1, 0.1, 0.1)
    rising = rising._replace(velocity=rising.velocity.at[2].set(10.0))
    _, pulled = walked(contact, rising, shut(False, False, False, False))
    np.testing.assert_array_equal(pulled.force, 0)


def test_a_foot_that_slid_is_gripped_where_it_is():
    contact, _ = walked(open_above(), feet(-0.001, 0.1, 0.1, 0.1), shut(False, False, False, False))
    after, held = walked(contact, feet(-0.001, 0.1, 0.1, 0.1, slide=0.003), shut(True, False, False, False))
    np.testing.assert_allclose(after.grip_point[:, 0, 0], [0.003, 0, 0])
    assert held.support[0, 0]


def test_without_a_reach_a_gripper_holds_from_anywhere():
    plain = open_above()._replace(reach=())
    _, held = walked(plain, feet(0.114, 0.1, 0.1, 0.1), shut(True, False, False, False))
    assert held.support[0, 0] and held.missed == ()  # there is nothing to miss
    np.testing.assert_allclose(held.force[2, 0, 0], -1140)


def test_missed_grips_are_counted():
    """A robot that hangs from a ceiling by soft joints puts its foot down 0.5 to 1 mm off it."""
    changes = {"duration": 0.5, "gait.cycle": 1.0, "gravity": [0, 0, 4], "control.kp": 20.0}
    scenario = mc.load_scenario("case_1_1", {"control.controller": "pd", "contact.holding_limit": None, **changes})
    reaches = np.array([5e-4, 1e-3])
    numbers = mc.parameters(scenario.with_overrides({"disturbance.cargo.mass": 0.0}))
    walks = mc.rollout_metrics(
        scenario, numbers=dataclasses.replace(numbers, capture_distance=reaches), dtype=np.float64
    )
    np.testing.assert_array_equal(walks["missed_grips"], [1, 0])
