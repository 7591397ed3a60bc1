"""Components of a reader's own, as a config names them by FILE.py:NAME: a contact, a drive and a disturbance."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

import mjx_climb as mc
from mjx_climb.physics.contact.contact import along_normal, clearance


class Pads(NamedTuple):
    """What sticky pads remember."""

    anchor: Array  # (limb, 3) m, world
    touching: Array  # (limb,) bool
    detached: Array  # (limb,) bool


class Sticky(mc.Contact):
    """A sticky pad under each foot, softer the more it is spread, which peels off where the ground pulls too hard."""

    pull: Array = mc.parameter("N", bounds=(0.0, 1e3), default=40.0, long_name="pull of a pad")
    hardness: Array = mc.parameter("N/m", bounds=(1.0, 1e6), default=1e4)
    loss: Array = mc.parameter("N s/m", bounds=(0.0, 1e4), default=20.0)
    spread: Array = mc.parameter("1", bounds=(0.0, 1.0), default=0.1)
    peels: bool = True

    def init(self, grip_point, rotation):
        shut = jnp.ones(len(grip_point), bool)
        return Pads(grip_point, shut, ~shut)

    def step(self, memory, feet, turning, closed, ground):
        off, below = clearance(feet, ground)
        support = closed & ~memory.detached
        touching = support | (off <= 0)
        anchor = jnp.where((touching & ~memory.touching)[:, None], below, memory.anchor)
        force = self.hardness * (1 - self.spread / 2) * (anchor - feet.position) - self.loss * feet.velocity
        force = jnp.where(touching[:, None], force, 0.0)
        used = jnp.where(support, jnp.maximum(-along_normal(force, feet), 0.0) / jnp.maximum(self.pull, 1e-9), 0.0)
        none = jnp.zeros_like(closed)
        torn = used > 1 if self.peels else none
        grip = mc.Grip(force, 0 * force, anchor, support, touching, memory.detached, none, none, used)
        return self.tear_off(Pads(anchor, touching, memory.detached), grip, torn)

    def tear_off(self, memory, grip, torn):
        return memory._replace(detached=memory.detached | torn), grip._replace(torn_off=grip.torn_off | torn)

    def holding_force(self):
        return self.pull

    def springs(self):
        return mc.Springs(self.hardness * (1 - self.spread / 2), self.loss)

    def unbreakable(self):
        return dataclasses.replace(self, peels=False)


class Belts(mc.Actuator):
    """Joints that belts pull to their targets; they do not read kp and kd."""

    tension: Array = mc.parameter("N m/rad", bounds=(1.0, 1e3), default=50.0)
    drag: Array = mc.parameter("N m s/rad", bounds=(0.0, 10.0), default=0.2)

    def init(self, angles):
        return ()

    def spring(self, period):
        return mc.JointSpring(self.tension, self.drag)

    def step(self, memory, targets, gains, joints, period):
        torque = self.tension * (targets - joints.angles) - self.drag * joints.rates
        return memory, mc.Drive(torque, torque)


class Gust(mc.Disturbance):
    """A wind along x that blows on the base from a moment on."""

    strength: Array = mc.parameter("N", bounds=(-1e3, 1e3), default=1.0)
    start: Array = mc.parameter("s", bounds=(0.0, 1e3), default=0.03, in_steps=True)

    def begins(self):
        return jnp.where(jnp.asarray(self.strength) != 0, self.start, jnp.inf)

    def act(self, time, body):
        nothing = body.untouched()
        return nothing._replace(
            base_wrench=nothing.base_wrench.at[0].set(jnp.where(time >= self.start, self.strength, 0.0))
        )
