"""A gait around another one, which decides all that it does not decide itself."""

import dataclasses
from typing import Any, Self

from jax import Array

from mjx_climb.control import Reference
from mjx_climb.gait.gait import Body
from mjx_climb.gait.own_swings import OwnSwings, Swings
from mjx_climb.gait.schedule import Schedule
from mjx_climb.physics.contact.contact import Grip


class AroundGait(OwnSwings):
    """Base of gaits around another one: each method is the other gait's, on the same memory."""

    gait: OwnSwings = dataclasses.field(metadata={"tree": True})

    @classmethod
    def of(cls, gait: OwnSwings, *values: Any) -> Self:
        """The gait around another one; `values` are its further fields."""
        made: Any = cls
        own: Self = made(*(getattr(gait, field.name) for field in dataclasses.fields(OwnSwings)), gait, *values)
        return own

    def init(self) -> tuple[Swings, Reference]:
        """The memory of a robot that has not swung."""
        return self.gait.init()

    def until_lift_off(self, clock: Array, elapsed: Array) -> Array:
        """The steps until limbs that stand lift off."""
        return self.gait.until_lift_off(clock, elapsed)

    def base_path(self, memory: Swings, now: Schedule, step: Array, start: Array) -> Array:
        """Where the base should be, (3,) m."""
        return self.gait.base_path(memory, now, step, start)

    def reference(
        self, memory: Swings, now: Schedule, step: Array, base_position: Array, grip_point: Array
    ) -> tuple[Swings, Reference]:
        """The memory after a step, and the reference at it."""
        return self.gait.reference(memory, now, step, base_position, grip_point)

    def lift_off(self, memory: Swings, now: Schedule, base_path: Array, body: Body) -> Swings:
        """The memory with new swings."""
        return self.gait.lift_off(memory, now, base_path, body)

    def after_contacts(self, memory: Swings, now: Schedule, step: Array, grip: Grip) -> Swings:
        """The memory after a step whose contacts are known."""
        after: Swings = self.gait.after_contacts(memory, now, step, grip)
        return after

    def stands(self, memory: Swings, grip: Grip) -> Array:
        """Which limbs found no grip, (limb,) bool."""
        return self.gait.stands(memory, grip)
