"""Cargo, pushes and wrenches on links, against windows of time in plain Python and forces on points that move."""

import itertools
import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_climb.disturbances.disturbance import Body, Disturbance, External, sum_of
from mjx_climb.disturbances.link_wrench import LinkWrench
from mjx_climb.disturbances.on_base import Cargo, Push
from mjx_climb.hardware.actuator import Actuator, Drive
from mjx_climb.physics.contact.contact import Contact
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.state import State
from tests.physics.test_kinematics_by_hand import forward, made

ROBOT = made(3, 4, (2,))
RNG = np.random.default_rng(0)
TURN = Rotation.random(random_state=1)
ANGLES = RNG.normal(0, 0.5, ROBOT.stance_joints.shape)
STATE = State(RNG.normal(size=3), jnp.asarray(TURN.as_quat(scalar_first=True)), *np.zeros((2, 3)), ANGLES, 0 * ANGLES)
BODY = Body(ROBOT, limb_frames(ROBOT, None, jnp.asarray(ANGLES)), STATE)


@pytest.mark.parametrize("time", [0.0, 0.999, 1.0, 1.5, 1.999, 2.0, 9.0])
def test_loads_act_from_their_start_until_before_their_stop(time):
    acts = 1.0 <= time < 2.0
    force, moment = RNG.normal(size=(2, 3))
    push = Push(force=force, moment=moment, start=1.0, stop=2.0).act(jnp.asarray(time), BODY)
    np.testing.assert_allclose(push.base_wrench, [*force, *moment] if acts else np.zeros(6))
    assert push.joint_torque is None and push.cargo_mass is None
    cargo = Cargo(mass=0.7, start=1.0, stop=2.0).act(jnp.asarray(time), BODY)
    assert cargo.cargo_mass == (0.7 if acts else 0.0) and cargo.base_wrench is None and cargo.joint_torque is None
    link = LinkWrench(limb=1.0, link=2.0, force=force, moment=moment, at=moment, start=1.0, stop=2.0)
    link = link.act(jnp.asarray(time), BODY)
    assert bool(np.any(link.joint_torque)) == acts and link.cargo_mass == 0


def test_the_instant_of_a_load_is_known_where_it_acts_at_all():
    for start, stop in [(1.0, 2.0), (2.0, 2.0), (3.0, 2.0), (0.0, math.inf)]:
        for one in range(6):
            wrench = np.where(np.arange(6) == one, -0.5, 0.0)
            for kind in (Push, LinkWrench):
                each = kind(force=wrench[:3], moment=wrench[3:], start=start, stop=stop)
                assert each.begins() == (start if stop > start else math.inf)
                none = kind(force=np.zeros(3), moment=np.zeros(3), start=start, stop=stop)
                assert none.begins() == math.inf
        assert Cargo(mass=0.1, start=start, stop=stop).begins() == (start if stop > start else math.inf)
        assert Cargo(mass=0.0, start=start, stop=stop).begins() == math.inf


@pytest.mark.parametrize("frame", ["world", "link"])
@pytest.mark.parametrize(("limb", "link"), [(0, 0), (1, 3), (2, 1)])
def test_a_wrench_on_a_link_works_as_it_does_on_a_point_that_the_joints_move(limb, link, frame):
    """Virtual work: torques are the force times the point's motion, and the moment times the link's turn."""
    force, moment, at = RNG.normal(size=(3, 3))
    found = LinkWrench(limb=float(limb), link=float(link), force=force, moment=moment, at=at, frame=frame).act(
        jnp.asarray(0.0), BODY
    )

    def pose(angles):
        """Of the link in the world, its base where it is."""
        _, _, places, _ = forward(ROBOT, limb, angles)
        return places[link], limb_frames(ROBOT, None, np.where(np.arange(3)[:, None] == limb, angles, ANGLES)).rotation[
            limb, link
        ]

    place, turned = pose(ANGLES[limb])
    turned = TURN.as_matrix() @ turned
    if frame == "link":
        force, moment = turned @ force, turned @ moment
    point = TURN.apply(place) + turned @ at
    expected = np.zeros_like(ANGLES)
    for joint in range(4):
        step = np.where(np.arange(4) == joint, 1e-6, 0.0)
        (a, ra), (b, rb) = pose(ANGLES[limb] + step), pose(ANGLES[limb] - step)
        ra, rb = TURN.as_matrix() @ ra, TURN.as_matrix() @ rb
        speed = (TURN.apply(a) + ra @ at - TURN.apply(b) - rb @ at) / 2e-6
        spin = Rotation.from_matrix(ra @ rb.T).as_rotvec() / 2e-6
        expected[limb, joint] = force @ speed + moment @ spin
    np.testing.assert_allclose(found.joint_torque, expected, atol=1e-7)
    np.testing.assert_allclose(found.base_wrench, [*force, *(moment + np.cross(point, force))], atol=1e-9)


class Nothing(Disturbance):
    """A disturbance of one's own, that says no more than it has to."""

    def act(self, time, body):
        return body.untouched()


class Held(Contact):
    """A contact of one's own, likewise."""

    def init(self, grip_point, rotation):
        return ()

    def step(self, memory, feet, turning, closed, ground):
        raise AssertionError


class Driven(Actuator):
    """An actuator of one's own, likewise."""

    def init(self, angles):
        return ()

    def step(self, memory, targets, gains, joints, period):
        return memory, Drive(targets, targets)


def test_a_component_of_ones_own_need_not_say_what_it_does_not_have():
    """It begins at no known instant, never breaks, holds by no known spring and feels no load."""
    nothing, held, driven = Nothing(), Held(), Driven()
    assert nothing.begins() is None and (Nothing.GROUP, Nothing.LISTED) == ("others", True)
    loads = nothing.act(0.0, BODY)
    assert [np.shape(each) for each in loads] == [(6,), ANGLES.shape, ()] and not any(np.any(each) for each in loads)
    assert held.set_up(1e-3) is held and held.unbreakable() is held and held.springs() is None
    assert (held.transmits_moments, held.may_fail, held.holding_force()) == (False, False, 0.0)
    with pytest.raises(NotImplementedError, match=r"^Held.tear_off$"):
        held.tear_off((), None, None)
    assert driven.feels_load is False and driven.spring(1e-3) is None


def test_loads_add_up_where_there_are_some():
    """Each part by itself; what nobody has stays none."""
    parts = {"base_wrench": np.arange(6.0), "joint_torque": np.ones((2, 3)), "cargo_mass": np.asarray(2.0)}
    some = [External(**dict(names)) for count in range(4) for names in itertools.combinations(parts.items(), count)]
    for one, other in itertools.product(some, some):
        total = sum_of([one, External(), other])
        for name, value in parts.items():
            count = sum(getattr(each, name) is not None for each in (one, other))
            found = getattr(total, name)
            assert (found is None) == (count == 0)
            if count:
                np.testing.assert_array_equal(found, count * value)
