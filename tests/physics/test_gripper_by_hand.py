"""Grippers over random sequences of steps, against one foot after the other by the rules of their documentation."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_climb.physics.contact.gripper import Gripper
from mjx_climb.physics.kinematics import Feet, Surface, Turning

STEP, STEPS = 1e-3, 60


class Foot:
    """One foot with its gripper: Eq. 5, a reach, a closing time, and moments."""

    def __init__(self, own, point, rotation):
        self.own, self.point, self.rotation = own, np.array(point), rotation
        self.touching, self.detached, self.shut, self.lacks = True, False, True, False
        self.held = self.closing_held = True
        self.attitude_held, self.pressed, self.closure = False, True, 1.0

    def step(self, foot, velocity, closed, surface, turned, spin):
        """The force, moment, whether it holds, touches and misses, and the share of its limit."""
        own, (at, normal) = self.own, surface
        off = float((foot - at) @ normal)
        below = foot - off * normal
        holds = closed and not self.detached
        fresh_shut = missed = False
        limited = np.isfinite(own["capture_distance"])
        if own["reach"]:
            fresh_shut = holds and not self.shut and limited
            missed = bool(fresh_shut and off > own["capture_distance"])
            self.lacks = bool(closed and (self.lacks or missed))
            self.shut = closed
            holds = holds and not self.lacks
        touches = holds or off <= 0
        fresh = (touches and not self.touching) or fresh_shut
        slow = own["closes"] and own["closing_time"] > 0
        if fresh:
            self.point = foot.copy() if slow and holds and off > 0 else below
        drag = own["damping"] * velocity
        if own["closes"]:
            shuts = holds and not self.closing_held
            share = 1 - np.exp(-STEP / own["closing_time"]) if slow else 1.0
            gap = float((self.point - at) @ normal)
            if holds and not shuts and slow and gap > 0:
                # drawn to the ground, but no harder than the closing force pulls
                lowest = off - own["closing_force"] / own["stiffness"]
                self.point = self.point - (gap - max(gap * (1 - share), min(gap, lowest))) * normal
            if shuts:
                self.closure = 0.0 if slow and (fresh or not self.touching) else 1.0
                self.pressed = off <= 0
            else:
                self.closure += (1 - self.closure) * share
            self.closure = self.closure if holds else 1.0
            self.closing_held = holds
            along = drag @ normal
            drag = self.closure * drag + (along * (1 - self.closure) if self.pressed else 0.0) * normal
        force = own["stiffness"] * (self.point - foot) - drag if touches else np.zeros(3)
        if own["reach"] and limited and not holds:
            force = max(force @ normal, 0.0) * normal
        moment = np.zeros(3)
        if own["rotational"]:
            if not (holds and self.attitude_held):
                self.rotation = turned
            if holds:
                sides = sum(np.cross(turned[:, n], self.rotation[:, n]) for n in range(3)) / 2
                moment = own["rotational_stiffness"] * sides - own["rotational_damping"] * spin
            self.attitude_held = holds
        self.touching = touches
        used = np.linalg.norm(force) / own["holding_limit"] if holds and force @ normal < 0 else 0.0
        before, self.detached = self.detached, self.detached or used > 1
        return force, moment, holds, touches, missed, used, before, used > 1


def walked(gripper, own, kind, seed):
    """Compare a random walk of four feet, on level ground or on the surfaces of holds."""
    rng = np.random.default_rng(seed)
    if kind == "level":
        normals, heights = np.tile([0.0, 0, 1], (4, 1)), rng.normal(size=4) * 0.1
        surface, points = None, np.column_stack([np.zeros((4, 2)), heights])
    else:
        normals = rng.normal(size=(4, 3)) + np.array([0, 0, 2.0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        points = rng.normal(size=(4, 3)) * 0.1
        heights, surface = np.zeros(4), Surface(*map(jnp.asarray, (points, normals)))
    closed, off = np.ones(4, bool), np.zeros(4)
    place, turned = points + 0.0, Rotation.random(4, random_state=seed)
    memory = gripper.init(jnp.asarray(place), jnp.asarray(turned.as_matrix()))
    feet = [Foot(own, place[n], turned.as_matrix()[n]) for n in range(4)]
    step = jax.jit(lambda *given: gripper.step(*given, jnp.asarray(heights)))
    seen = []
    for _ in range(STEPS):
        closed = np.where(rng.uniform(size=4) < 0.25, ~closed, closed)
        off = np.where(rng.uniform(size=4) < 0.3, rng.normal(0, 0.004, 4), off + rng.normal(0, 3e-4, 4))
        place = points + rng.normal(0, 3e-3, (4, 3))
        place += (off - ((place - points) * normals).sum(1))[:, None] * normals
        velocity, spin = rng.normal(0, 0.05, (2, 4, 3))
        turned = Rotation.from_rotvec(rng.normal(0, 0.05, (4, 3))) * turned
        given = Feet(jnp.asarray(place), jnp.asarray(velocity), jnp.asarray(place), surface)
        turning = Turning(jnp.asarray(turned.as_matrix()), jnp.asarray(spin), jnp.zeros((4, 3, 3)))
        memory, grip = step(memory, given, turning if own["rotational"] else None, jnp.asarray(closed))
        wanted = [
            foot.step(place[n], velocity[n], bool(closed[n]), (points[n], normals[n]), turned.as_matrix()[n], spin[n])
            for n, foot in enumerate(feet)
        ]
        found = (grip.foot_force, grip.foot_moment, grip.support, grip.contact, grip.missed, grip.utilization,
                 grip.detached, grip.torn_off)  # fmt: skip
        for mine, each in zip(found, zip(*wanted, strict=True), strict=True):
            np.testing.assert_allclose(mine, np.array(each), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(grip.grip_point, [foot.point for foot in feet], rtol=1e-9, atol=1e-12)
        seen.append([grip.support, grip.missed, grip.torn_off])
    return np.mean(seen, axis=(0, 2))


ALL = [*itertools.product([False, True], [False, True], [False, True], ["level", "holds"])]
QUICK = {(True, True, True, "holds"), (True, True, True, "level"), (False, True, False, "holds"),
         (True, False, False, "level"), (False, False, True, "holds")}  # fmt: skip


@pytest.mark.parametrize(
    ("reach", "closes", "rotational", "ground"),
    [pytest.param(*each, marks=[] if each in QUICK else pytest.mark.slow) for each in ALL],
)
def test_grippers_do_in_any_order_what_one_foot_does(reach, closes, rotational, ground):
    """Shut and opened at random, in and out of reach, pressed and pulled, torn off; with every stage and without."""
    values = {
        "stiffness": 1e4, "damping": 20.0, "holding_limit": 90.0, "capture_distance": 0.003 if reach else np.inf,
        "closing_time": 0.005 if closes else 0.0, "closing_force": 15.0,
        "rotational_stiffness": 5.0 if rotational else 0.0, "rotational_damping": 0.1,
    }  # fmt: skip
    gripper = Gripper(**{name: jnp.asarray(value) for name, value in values.items()}).compiled_for().set_up(STEP)
    assert (gripper.limited_reach, gripper.closes, gripper.rotational) == (reach, closes, rotational)
    own = values | {"reach": reach, "closes": closes, "rotational": rotational}
    held, missed, torn = walked(gripper, own, ground, int(f"{reach:d}{closes:d}{rotational:d}", 2))
    assert 0.1 < held < 0.9 and missed + torn > 0 and (reach or not missed), (held, missed, torn)


def test_a_robot_of_a_batch_without_a_value_does_as_without_its_stage():
    """Others have a reach, a closing time and moments: the stages are there, and do nothing for it."""
    values = {"stiffness": 1e4, "damping": 20.0, "holding_limit": 90.0, "capture_distance": np.inf,
              "closing_time": 0.0, "closing_force": 15.0, "rotational_stiffness": 0.0,
              "rotational_damping": 0.0}  # fmt: skip
    gripper = Gripper(**{name: jnp.asarray(value) for name, value in values.items()})
    stages = gripper.compiled_for(["capture_distance", "closing_time", "rotational_stiffness"]).set_up(STEP)
    own = values | {"reach": True, "closes": True, "rotational": True}
    held, missed, torn = walked(stages, own, "level", 3)
    assert 0.1 < held < 0.9 and not missed and torn > 0
    assert walked(
        gripper.compiled_for(), values | {"reach": False, "closes": False, "rotational": False}, "level", 3
    ) == (pytest.approx([held, missed, torn]))


def test_stages_of_a_gripper_are_those_of_some_robot():
    """Finite, above zero, or moving: a derivative along it is asked for."""
    plain = Gripper(capture_distance=jnp.asarray(jnp.inf)).compiled_for()
    assert not (plain.limited_reach or plain.rotational or plain.closes or plain.transmits_moments)
    stages = {"capture_distance": "limited_reach", "rotational_stiffness": "rotational", "closing_time": "closes"}
    for field, stage in stages.items():
        idle = jnp.inf if field == "capture_distance" else 0.0
        some = dataclasses.replace(plain, **{field: jnp.asarray([idle, 0.02])}).compiled_for()
        assert [getattr(some, name) for name in ("limited_reach", "rotational", "closes")] == [
            name == stage for name in ("limited_reach", "rotational", "closes")
        ]
        assert getattr(plain.compiled_for([field]), stage) and not getattr(plain.compiled_for(["other"]), stage)
    springs = dataclasses.replace(plain, rotational_stiffness=jnp.asarray(3.0), rotational_damping=jnp.asarray(0.2))
    assert springs.springs().rotational_stiffness == 0.0
    turning = springs.compiled_for().springs()
    assert (float(turning.rotational_stiffness), float(turning.rotational_damping)) == pytest.approx((3.0, 0.2))
    assert springs.compiled_for().transmits_moments and springs.unbreakable().breaks is False
    limits = dataclasses.replace(plain, holding_limit=jnp.asarray([20.0, jnp.inf]))
    np.testing.assert_array_equal(limits.holding_force(), [20.0, 0.0])
    assert plain.set_up(0.25).time_step == plain.time_step
    assert dataclasses.replace(plain, closes=True).set_up(0.25).time_step == 0.25
