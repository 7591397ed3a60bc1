"""The periodic gait: its values, and the gait that they make."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from mjx_climb.component import Component, parameter
from mjx_climb.control import Reference
from mjx_climb.gait import schedule as functions
from mjx_climb.gait.gait import Gait
from mjx_climb.physics.kinematics import Surface
from mjx_climb.scenario import declared
from mjx_climb.value_field import FINITE


class PeriodicGait(declared.PeriodicGait, Component):
    """How far, how high and when the limbs swing."""

    # (limb, 3, K) step heights, added to each swing; K = 0: nothing
    swing_path: Array = parameter("1", shape=(None, 3, None), bounds=FINITE, default=np.zeros((4, 3, 0)))


class Periodic(Gait):
    """The gait of a plan without decisions. It remembers where the base began its cycle, (3,) m, without its sway."""

    plan: functions.Plan = dataclasses.field(metadata={"tree": True})
    time_step: float
    # as in ClimbLab: a cycle starts where the base is, not where the last one should have ended
    from_actual: bool

    def init(self) -> tuple[PyTree, Reference]:
        """The memory at the start, and the reference there."""
        now = functions.schedule(self.plan, jnp.zeros_like(self.plan.cycle_steps))
        start, feet = functions.planned_start(self.plan, now.cycle), functions.first_footholds(self.plan)
        reference = functions.reference(self.plan, now, start, feet, self.time_step)._replace(foot_position=feet)
        return functions.unswayed(self.plan, now, reference.base_position), reference

    def schedule(self, memory: PyTree, step: Array) -> functions.Schedule:
        """The phases by the number of the step alone."""
        return functions.schedule(self.plan, step)

    def ground(self, memory: PyTree, now: functions.Schedule) -> tuple[Array, Surface | None]:
        """The heights of the footholds."""
        return functions.foothold_height(self.plan, now.foothold), None

    def reference(
        self, memory: PyTree, now: functions.Schedule, step: Array, base_position: Array, grip_point: Array
    ) -> tuple[PyTree, Reference]:
        """The start of the cycle, and the reference from there."""
        memory, start = self.cycle_start(memory, now, base_position)
        return memory, functions.reference(self.plan, now, start, grip_point, self.time_step)

    def cycle_start(self, before: Array, now: functions.Schedule, base_position: Array) -> tuple[Array, Array]:
        """Where the base began its cycle, (3,) m: for the memory, after `before`, and for the reference."""
        start = functions.planned_start(self.plan, now.cycle)
        if not self.from_actual:
            return before, start
        here = functions.unswayed(self.plan, now, base_position)
        start = jnp.where(now.cycle_phase == 0, here, before)
        return start, start
