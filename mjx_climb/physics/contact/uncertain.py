"""Grippers that may fail: a limit that differs from grip to grip, a test by load, and another try.

A gripper that shuts pulls at the ground. Where that tears it off, it lets go and tries again a little later, so many
times; then it stays open until its next swing.
"""

import dataclasses
from typing import ClassVar, NamedTuple, Self

import jax.numpy as jnp
from jax import Array

from mjx_climb.component import parameter
from mjx_climb.physics.contact.contact import Grip, clearance
from mjx_climb.physics.contact.gripper import Gripper, GripperMemory
from mjx_climb.physics.kinematics import Feet, Turning
from mjx_climb.physics.noise import normal


class UncertainMemory(NamedTuple):
    """Memory of grippers that may fail beside that of grippers."""

    gripper: GripperMemory
    shut: Array  # (limb,) bool: commanded shut at the last step
    limit: Array  # (limb,) N, holding limit of this grip
    failed: Array  # (limb,) bool: the ground did not bear the test
    wait: Array  # (limb,) steps until another try
    tries: Array  # (limb,) number of tries of this grip
    draws: Array  # (limb,) number of tries since the start


class UncertainGripper(Gripper):
    """Grippers as `Gripper`; each grip has a limit of its own and is tested by a pull when it shuts.

    The limit of a grip is the gripper's times a normal number of mean 1, drawn by seed, limb and number of the try.
    A gripper that was torn off grips again after its next swing.
    """

    KIND = "uncertain"
    may_fail: ClassVar[bool] = True

    spread: Array = parameter("1", bounds=(0.0, 1.0), default=0.0, long_name="spread of the holding limit")
    tested_pull: Array = parameter("N", bounds=(0.0, 1e4), default=0.0, long_name="pull that tests a grip")
    # a contact does not know the time step
    retry_steps: Array = parameter("1", bounds=(0.0, 1e6), default=200.0, long_name="time steps until another try")
    tries: Array = parameter("1", bounds=(1.0, 100.0), default=3.0, long_name="tries of a grip")
    seed: Array = parameter("1", bounds=(0.0, 2.0**24), default=0.0)

    def init(self, grip_point: Array, rotation: Array) -> UncertainMemory:
        """The memory of grippers that are shut, have passed their test and rest."""
        none = jnp.zeros_like(grip_point[:, 0])
        shut = jnp.ones(len(grip_point), bool)
        limit = jnp.maximum(self._drawn(none), self.tested_pull)
        return UncertainMemory(super().init(grip_point, rotation), shut, limit, ~shut, none, none, none)

    def step(
        self, memory: UncertainMemory, feet: Feet, turning: Turning | None, closed: Array, ground: Array
    ) -> tuple[UncertainMemory, Grip]:
        """The memory after a step, and the contacts in it: those of `Gripper`, where grips hold."""
        shuts = closed & ~memory.shut
        again = closed & memory.failed & (memory.wait <= 0) & (memory.tries < self.tries)
        tried = shuts | again
        draws, tries = memory.draws + tried, jnp.where(shuts, 1.0, memory.tries + again)
        limit = jnp.where(tried, self._drawn(draws), memory.limit)
        failed = closed & jnp.where(tried, limit < self.tested_pull, memory.failed)
        wait = jnp.where(tried, self.retry_steps, memory.wait - 1)
        fields = dataclasses.fields(Gripper)
        own = {field.name: getattr(self, field.name) for field in fields}
        holds = Gripper(**{**own, "holding_limit": jnp.maximum(limit, 0.0)})
        # a gripper that opens may grip anew
        before = memory.gripper._replace(detached=memory.gripper.detached & closed)
        after, grip = holds.step(before, feet, turning, closed & ~failed, ground)
        given_up = tried & failed & (tries >= self.tries)
        # a foot whose grip fails waits where its gripper shut, not where it stood before
        _, below = clearance(feet, ground)
        point = jnp.where((tried & failed & ~grip.contact)[:, None], below, grip.grip_point)
        after_this = UncertainMemory(after._replace(grip_point=point), closed, limit, failed, wait, tries, draws)
        return after_this, grip._replace(missed=grip.missed | given_up, grip_point=point)

    def tear_off(self, memory: UncertainMemory, grip: Grip, torn: Array) -> tuple[UncertainMemory, Grip]:
        """Memory and contacts with some grips torn off in this step."""
        gripper, grip = super().tear_off(memory.gripper, grip, torn)
        return memory._replace(gripper=gripper), grip

    def unbreakable(self) -> Self:
        """Grippers that never let go and pass all tests."""
        return dataclasses.replace(self, breaks=False, tested_pull=jnp.zeros_like(self.tested_pull))

    def _drawn(self, draws: Array) -> Array:
        """Holding limits (limb,) N by the number of the try, (limb,)."""
        noise = normal(self.seed, draws, jnp.arange(len(draws)), draws.dtype)
        return self.holding_limit * (1 + self.spread * noise)
