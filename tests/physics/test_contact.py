"""Grippers: what they hold, what tears them off, what is out of their reach, and how they keep a foot from turning."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_climb.physics.contact.gripper import Attitude, Gripper, GripperMemory, Reach
from mjx_climb.physics.contact.polyhedron import PolyhedralGripper, magnet, microspines
from mjx_climb.physics.contact.uncertain import UncertainGripper
from mjx_climb.physics.kinematics import Feet, Surface, Turning

OPEN = jnp.zeros(4, bool)
CONTACT = Gripper(
    stiffness=jnp.asarray(1e4), damping=jnp.asarray(20.0), holding_limit=jnp.asarray(jnp.inf),
    capture_distance=jnp.asarray(0.005), rotational_stiffness=jnp.asarray(5.0), rotational_damping=jnp.asarray(0.1),
)  # fmt: skip
AWAY = GripperMemory(jnp.zeros((4, 3)), OPEN, OPEN, Reach(OPEN, OPEN))


def feet(*heights, slide=(0.0, 0.0), velocity=(0.0, 0.0, 0.0)):
    position = jnp.array([[*slide, height] for height in heights])
    return Feet(position, jnp.broadcast_to(jnp.array(velocity), (4, 3)), position)


def gripped(contact, foot, *closed, ground=(0.0,) * 4, turning=None, **changes):
    changes = {name: jnp.asarray(value) for name, value in changes.items()}
    stages = {"limited_reach": bool(contact.reach), "rotational": bool(contact.attitude)}
    own = dataclasses.replace(CONTACT, **changes, **stages)
    return own.step(contact, foot, turning, jnp.array(closed), jnp.array(ground))


@pytest.mark.parametrize("ground", [0.0, 0.3, -0.2])
def test_a_gripper_holds_what_is_within_reach_of_the_ground(ground):
    """Where it misses it stays open, near or not, until its next swing."""
    level = np.array([ground] * 4)

    def walked(contact, heights, *closed):
        return gripped(contact, feet(*(ground + np.array(heights))), *closed, ground=level)

    contact, held = walked(AWAY, [0.004, 0.006, -0.001, 0.1], True, True, True, False)
    np.testing.assert_array_equal(held.support, [True, False, True, False])
    np.testing.assert_array_equal(held.missed, [False, True, False, False])
    np.testing.assert_allclose(contact.grip_point[0], [0, 0, ground])
    assert held.foot_force[0, 2] < 0 and held.foot_force[1, 2] == 0
    again, later = walked(contact, [0.004, 0.001, -0.001, 0.1], True, True, True, False)
    np.testing.assert_array_equal(later.support, [True, False, True, False])
    assert not later.missed.any()
    lifted, _ = walked(again, [0.004, 0.1, -0.001, 0.1], True, False, True, False)
    assert walked(lifted, [0.004, 0.001, -0.001, 0.1], True, True, True, False)[1].support[1]


def test_an_open_gripper_pushes_along_the_normal_and_does_not_stick():
    """A foot that slid is gripped where it is."""
    down, on_ground = (False,) * 4, (-0.001, 0.1, 0.1, 0.1)
    contact, held = gripped(AWAY, feet(*on_ground), *down)
    assert held.foot_force[0, 2] > 0
    _, slid = gripped(contact, feet(*on_ground, slide=(0.003, 0.0)), *down)
    np.testing.assert_array_equal(slid.foot_force[0, :2], 0)
    _, rising = gripped(contact, feet(*on_ground, velocity=(0.0, 0.0, 10.0)), *down)
    np.testing.assert_array_equal(rising.foot_force, 0)
    after, held = gripped(contact, feet(*on_ground, slide=(0.003, 0.0)), True, False, False, False)
    np.testing.assert_allclose(after.grip_point[0], [0.003, 0, 0])
    assert held.support[0]


def test_a_grip_on_its_very_limit_holds():
    """Of reach and of force; of numbers that are exact in binary."""
    just, beyond = 2.0**-8, float(np.nextafter(2.0**-8, 1))
    _, held = gripped(AWAY, feet(just, beyond, 0.0, 0.0), *[True] * 4, capture_distance=just)
    np.testing.assert_array_equal(held.missed, [False, True, False, False])
    strong = {"capture_distance": np.inf, "stiffness": 2.0**13, "damping": 0.0, "holding_limit": 8.0}
    shut, _ = gripped(AWAY, feet(0.0, 0.0, 0.0, 0.0), *[True] * 4, **strong)
    after, held = gripped(shut, feet(2.0**-10, float(np.nextafter(2.0**-10, 1)), -0.1, 0.0), *[True] * 4, **strong)
    np.testing.assert_array_equal(held.torn_off, [False, True, False, False])
    np.testing.assert_array_equal(held.utilization == 1, [True, False, False, False])
    np.testing.assert_array_equal(after.detached, held.torn_off)


def test_without_a_capture_distance_a_gripper_holds_from_anywhere():
    _, held = gripped(AWAY, feet(0.114, 0.1, 0.1, 0.1), True, False, False, False, capture_distance=np.inf)
    assert held.support[0] and not held.missed.any()
    np.testing.assert_allclose(held.foot_force[0, 2], -1140)


def test_a_grip_keeps_the_attitude_in_which_it_shut_last():
    """It resists by the sine of the angle and by the rate; when it grips again, the attitude is the new one."""

    def turned(angle, rate=0.0):
        rotation = jnp.broadcast_to(jnp.asarray(Rotation.from_rotvec([0, 0, angle]).as_matrix()), (4, 3, 3))
        return Turning(rotation, jnp.zeros((4, 3)).at[:, 2].set(rate), jnp.zeros((4, 3, 3)))

    on_ground, moments = feet(0.0, 0.0, 0.0, 0.0), []
    contact = AWAY._replace(reach=None, attitude=Attitude(turned(0.0).rotation, OPEN))
    for closed, turning in (
        (True, turned(0.2)), (True, turned(0.5)), (True, turned(0.5, rate=2.0)),
        (False, turned(0.9, rate=2.0)), (True, turned(0.9)), (True, turned(1.0)),
    ):  # fmt: skip
        contact, held = gripped(contact, on_ground, *[closed] * 4, turning=turning)
        moments.append(held.foot_moment[0])
    expected = [0, -5 * np.sin(0.3), -5 * np.sin(0.3) - 0.2, 0, 0, -5 * np.sin(0.1)]
    np.testing.assert_allclose(moments, [[0, 0, moment] for moment in expected], atol=1e-12)


# --- on a hold of any normal


GRIPS = {
    "gripper": Gripper(holding_limit=12.0, capture_distance=0.004, limited_reach=True),
    "bare": Gripper(holding_limit=12.0),
    "magnet": PolyhedralGripper(**magnet(12.0, 0.5)),
    "microspines": PolyhedralGripper(**microspines(0.8, 9.0)),
    "uncertain": UncertainGripper(spread=0.2, seed=jnp.asarray(0.0), holding_limit=12.0),
}


@pytest.mark.parametrize("name", GRIPS)
def test_a_hold_of_any_normal_holds_as_level_ground_does(name):
    """Twelve steps of feet that move at random on turned ground, moved elsewhere: level ground's, turned."""
    contact, random = GRIPS[name], np.random.default_rng(0)
    turn = Rotation.random(4, random).as_matrix()
    place = random.normal(size=(4, 3))

    def turned(vector):
        return jnp.asarray(jnp.matvec(turn, vector))

    begun = random.normal(0, 0.1, (4, 3)) * [1, 1, 0]
    level = contact.init(jnp.asarray(begun), jnp.asarray(turn))
    tilted, torn = contact.init(turned(begun) + place, jnp.asarray(turn)), 0
    if isinstance(contact, PolyhedralGripper):  # whose first grips are on level ground
        tilted = tilted._replace(outward=turned(level.outward))
    for _ in range(12):
        position, velocity, lever = random.normal(0, [[[0.001]], [[0.05]], [[0.1]]], (3, 4, 3))
        shut = jnp.asarray(random.uniform(size=4) < 0.6)
        feet = Feet(jnp.asarray(begun + position), jnp.asarray(velocity), jnp.asarray(lever))
        surface = Surface(turned(begun) + place, turned(np.tile([0.0, 0.0, 1.0], (4, 1))))
        there = Feet(turned(feet.position) + place, turned(velocity), turned(lever), surface)
        level, flat = contact.step(level, feet, None, shut, jnp.zeros(4))
        tilted, held = contact.step(tilted, there, None, shut, jnp.full(4, np.nan))
        torn += np.asarray(held.torn_off).sum()
        np.testing.assert_array_equal(held.torn_off, flat.torn_off)
        np.testing.assert_array_equal(held.missed, flat.missed)
        np.testing.assert_allclose(held.foot_force, turned(flat.foot_force), atol=1e-9)
        np.testing.assert_allclose(held.grip_point, turned(flat.grip_point) + place, atol=1e-12)
    assert torn


@pytest.mark.parametrize("angle", [0.0, 45.0, 90.0, 135.0, 180.0])
def test_a_magnet_on_a_wall_slides_off_where_its_friction_ends(angle):
    """A foot that carries 1 kg, by hand: shear m g sin a, pull -m g cos a, held while shear <= mu (L - pull)."""
    slope, weight, friction = np.deg2rad(angle), 9.81, 0.4
    normal = np.array([-np.sin(slope), 0.0, np.cos(slope)])
    shear, pull = weight * np.sin(slope), -weight * np.cos(slope)
    needed = pull + shear / friction
    for limit, holds in ((1.02 * needed, True), (0.98 * needed, False)):
        if limit <= 0:
            continue
        magnetic = PolyhedralGripper(**magnet(limit, friction, 256))
        memory = magnetic.init(jnp.zeros((4, 3)), jnp.broadcast_to(jnp.eye(3), (4, 3, 3)))
        # the spring bears the weight: the foot hangs m g / k below its grip point
        hangs = jnp.broadcast_to(jnp.array([0.0, 0.0, -weight / float(magnetic.stiffness)]), (4, 3))
        uphill = jnp.broadcast_to(jnp.array([np.cos(slope), 0.0, np.sin(slope)]), (4, 3))
        surface = Surface(jnp.zeros((4, 3)), jnp.broadcast_to(jnp.asarray(normal), (4, 3)))
        still = Feet(hangs, jnp.zeros((4, 3)), uphill, surface)
        memory = memory._replace(gripper=memory.gripper._replace(touching=~OPEN), outward=uphill)
        _, held = magnetic.step(memory, still, None, ~OPEN, jnp.zeros(4))
        np.testing.assert_allclose(held.foot_force, np.tile([0.0, 0.0, weight], (4, 1)), rtol=1e-12)
        np.testing.assert_array_equal(held.torn_off, [not holds] * 4)
