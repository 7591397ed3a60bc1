"""Grippers that may fail: with neither spread nor test they are `Gripper`; a grip that fails is tried again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.physics.contact.gripper import Gripper
from mjx_climb.physics.contact.uncertain import UncertainGripper
from mjx_climb.physics.kinematics import Feet
from mjx_climb.physics.noise import normal

LIMBS, RETRY = 4, 3.0
OPEN, SHUT = np.zeros(LIMBS, bool), np.ones(LIMBS, bool)


def gripper(**values):
    """Return a gripper in double precision, and the plain one of the same values."""
    same = {"stiffness": 1e4, "damping": 20.0, "holding_limit": 15.0, "capture_distance": np.inf}
    same |= {"rotational_stiffness": 0.0, "rotational_damping": 0.0}
    inner = Gripper(**{name: jnp.asarray(value) for name, value in same.items()})
    values = {"spread": 0.0, "tested_pull": 0.0, "retry_steps": RETRY, "tries": 3.0, "seed": 5.0} | values
    return UncertainGripper(**{name: jnp.asarray(value) for name, value in (same | values).items()}), inner


def walked(contact, commands, height):
    """Return the grips of steps with grippers commanded (time, limb) shut and feet at heights (time,) m."""
    start = np.zeros((LIMBS, 3))
    memory = contact.init(jnp.asarray(start), jnp.zeros((LIMBS, 3, 3)))
    found = []
    for closed, z in zip(commands, height, strict=True):
        position = jnp.asarray(start + np.array([0, 0, z]))
        memory, grip = contact.step(
            memory, Feet(position, 0 * position, position), None, jnp.asarray(closed), jnp.zeros(LIMBS)
        )
        found.append(grip)
    return memory, found


def test_without_spread_and_test_it_is_the_gripper():
    """Forces, supports and losses are those of `Gripper` to the bit, until one of them opens after a loss."""
    uncertain, plain = gripper()
    commands, height = [SHUT, SHUT, OPEN, OPEN, SHUT, SHUT], [0.0, 1e-3, 0.01, 0.02, 0.0, 2e-3]
    for one, other in zip(walked(uncertain, commands, height)[1], walked(plain, commands, height)[1], strict=True):
        for name in one._fields:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_a_grip_that_was_torn_off_holds_again_after_a_swing():
    commands, height = [SHUT, SHUT, SHUT, OPEN, SHUT, SHUT], [0.0, 2e-3, 0.0, 0.01, 0.0, 0.0]
    grips = walked(gripper()[0], commands, height)[1]
    assert grips[1].torn_off.all() and not grips[2].support.any() and grips[5].support.all()


def test_limits_spread_by_seed_limb_and_try():
    """The limit of the first grip after a swing is 15 N times a normal number, which noise of the robot's makes."""
    memory, _ = walked(gripper(spread=0.3)[0], [SHUT, OPEN, SHUT], [0.0, 0.01, 0.0])
    noise = normal(jnp.asarray(5.0), jnp.ones(LIMBS), jnp.arange(LIMBS), np.float64)
    np.testing.assert_allclose(memory.limit, 15 * (1 + 0.3 * np.asarray(noise)))
    assert len(np.unique(memory.limit)) == LIMBS


def test_the_first_grips_bear_the_pull_of_the_test():
    memory = gripper(spread=0.3, tested_pull=15.0)[0].init(jnp.zeros((LIMBS, 3)), jnp.zeros((LIMBS, 3, 3)))
    assert (memory.limit >= 15).all() and (memory.limit > 15).any()


def test_a_grip_whose_limit_is_the_pull_of_the_test_passes():
    _, grips = walked(gripper(tested_pull=15.0)[0], [OPEN, SHUT], [0.0, 0.0])
    assert grips[1].support.all() and not grips[1].missed.any()


@pytest.mark.parametrize("tries", [1, 3])
def test_a_grip_that_never_passes_is_tried_so_often_and_then_missed(tries):
    last = (tries - 1) * int(RETRY + 1) + 1
    contact = gripper(tested_pull=1e3, tries=float(tries))[0]
    memory, grips = walked(contact, [OPEN] + [SHUT] * (last + 8), np.zeros(last + 9))
    np.testing.assert_array_equal(memory.draws, tries)
    missed = np.array([grip.missed for grip in grips])
    assert missed[last].all() and not missed[:last].any() and not any(grip.support.any() for grip in grips[1:])


def test_a_grip_that_fails_its_test_is_tried_again_so_many_times():
    """Each try draws anew: a limb holds from the first try on whose limit bears the pull, or gives up after three."""
    steps = 3 * int(RETRY) + 4
    contact = gripper(spread=0.3, tested_pull=15.0)[0]
    _, grips = walked(contact, [SHUT, OPEN, *[SHUT] * steps], [0.0, 0.01, *[0.0] * steps])
    draws = np.array([normal(jnp.asarray(5.0), jnp.full(LIMBS, n), jnp.arange(LIMBS), np.float64) for n in (1.0, 2, 3)])
    bears = draws >= 0
    for limb in range(LIMBS):
        held = np.array([bool(grip.support[limb]) for grip in grips[2:]])
        missed = np.array([bool(grip.missed[limb]) for grip in grips[2:]])
        if bears[:, limb].any():
            tries = int(bears[:, limb].argmax())
            assert held.argmax() == tries * int(RETRY + 1) and held[held.argmax() :].all() and not missed.any()
        else:
            assert not held.any() and missed.sum() == 1
    assert 0 < bears[0].sum() < LIMBS


def test_an_unbreakable_one_passes_its_tests_and_a_torn_one_forgets_nothing_else():
    contact, inner = gripper(spread=0.3, tested_pull=4.0)
    sure = contact.unbreakable()
    assert contact.breaks and not sure.breaks and sure.tested_pull == 0.0
    assert [getattr(sure, name) for name in ("spread", "tries", "stiffness")] == [0.3, 3.0, 1e4]
    memory, [*_, grip] = walked(contact, [SHUT, SHUT], [0.0, 0.0])
    torn = np.arange(LIMBS) == 2
    after, gone = contact.tear_off(memory, grip, jnp.asarray(torn))
    same, expected = inner.tear_off(memory.gripper, grip, jnp.asarray(torn))
    for one, other in ((gone, expected), (after.gripper, same)):
        jax.tree.map(np.testing.assert_array_equal, one, other)
    np.testing.assert_array_equal(gone.torn_off, grip.torn_off | torn)
    assert after._replace(gripper=None) == memory._replace(gripper=None)
