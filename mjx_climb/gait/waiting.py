"""A gait that waits: no limb lifts off while another that should hold does not.

A foot that missed the rock, or whose grip failed, goes to its hold again, farther by as much as it was off; then to the
nearest other hold, and the next; then the robot stands. Meanwhile the gait's own time stands still.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import Component
from mjx_climb.control import Reference
from mjx_climb.gait.around import AroundGait
from mjx_climb.gait.footholds.choice import Candidates, best
from mjx_climb.gait.footholds.footholds import SAME
from mjx_climb.gait.footholds.held import Held, of_some
from mjx_climb.gait.footholds.reach import within_reach
from mjx_climb.gait.gait import Body
from mjx_climb.gait.own_swings import Swings
from mjx_climb.gait.schedule import Schedule, settled_phase
from mjx_climb.gait.swing import rest_to_rest
from mjx_climb.physics.contact.contact import Grip
from mjx_climb.physics.spatial import norm
from mjx_climb.scenario import declared

_BESIDE = 8  # footholds around one on ground that is all held, each farther off than the one before


class Waiting(declared.Waiting, Component):
    """How often a foot that does not hold tries again."""


class Waits(NamedTuple):
    """Memory of a gait that waits."""

    failed: Array  # (limb,) bool: the gripper is shut, does not hold, and will not by itself
    tries: Array  # (limb,) number of landings since the foot last held
    first: Array  # (limb, 3) m, world, foothold of the first of them
    aim: Array  # (limb, 3) m, how far beside its foothold the foot is sent
    stands: Array  # (limb,) bool: it has tried all that it may


class WaitingGait(AroundGait):
    """A gait around another one, whose swings it lets begin where all other feet hold."""

    waiting: Waiting = dataclasses.field(metadata={"tree": True})

    def init(self) -> tuple[Swings, Reference]:
        """The memory of a robot whose feet all hold."""
        memory, reference = super().init()
        none, nowhere = jnp.zeros_like(memory.span), jnp.zeros_like(memory.goal)
        return memory._replace(waits=Waits(none > 0, none, memory.goal, nowhere, none > 0)), reference

    def reference(
        self, memory: Swings, now: Schedule, step: Array, base_position: Array, grip_point: Array
    ) -> tuple[Swings, Reference]:
        """The reference of the gait, with feet that try again sent beside their footholds."""
        memory, found = super().reference(memory, now, step, base_position, grip_point)
        beside = rest_to_rest(settled_phase(self.plan, now))[:, None] * memory.waits.aim
        return memory, found._replace(foot_position=found.foot_position + beside)

    def lift_off(self, memory: Swings, now: Schedule, base_path: Array, body: Body) -> Swings:
        """The memory with new swings: those of the gait where all feet hold, and of feet that try again."""
        holds = jnp.where(now.closed, body.support, memory.waits.tries == 0).all()
        swings = super().lift_off(memory._replace(running=memory.running * holds), now, base_path, body)
        return self._tried_again(swings._replace(running=memory.running), now, body)

    def after_contacts(self, memory: Swings, now: Schedule, step: Array, grip: Grip) -> Swings:
        """The memory after a step: its time stands still where a foot that should hold does not.

        Swings that have been decided begin later then. None begins in the step in which another foot lands.
        """
        waits, following = memory.waits, step.astype(memory.begun.dtype) + 1
        holds, lacks = now.closed & grip.support, now.closed & ~grip.support
        lands = (~now.closed & (memory.begun + memory.span <= following)).any()
        trying = ~now.closed & (waits.tries > 0)
        stop = (lacks | trying).any() | (lands & (memory.begun == following).any())
        return memory._replace(
            step=memory.step + stop,
            begun=memory.begun + (stop & (memory.begun >= following)),
            waits=Waits(
                failed=lacks & (waits.failed | grip.missed | grip.detached),
                tries=jnp.where(holds, 0.0, waits.tries),
                first=waits.first,
                aim=jnp.where(holds[:, None], 0.0, waits.aim),
                stands=waits.stands & lacks,
            ),
        )

    def stands(self, memory: Swings, grip: Grip) -> Array:
        """Which limbs have tried all that they may, (limb,) bool."""
        stands: Array = memory.waits.stands
        return stands

    def _tried_again(self, memory: Swings, now: Schedule, body: Body) -> Swings:
        """The memory with swings of feet whose grips failed, to the same hold or to another one."""
        waits, own = memory.waits, self.waiting
        again, landings = waits.failed & now.closed & ~waits.stands, own.retries + 1
        tries = waits.tries + again
        first = of_some(waits.tries == 0, memory.goal, waits.first)
        moves = again & (jnp.mod(tries, landings) == 0)
        goal, held = jax.lax.cond(
            moves.any(), lambda: self._other_holds(memory, first, body), lambda: (memory.goal, memory.held)
        )
        found = ((goal - first) ** 2).sum(1) > SAME**2
        gives_up = moves & ((tries >= landings * (own.other_holds + 1)) | ~found)
        swings, moves = again & ~gives_up, moves & ~gives_up
        off = waits.aim + jnp.where(again[:, None], memory.goal - body.feet, 0.0)
        aim = off * jnp.minimum(self.plan.step_height / norm(off, at_zero=1.0), 1.0)[:, None]
        goal, held = of_some(moves, (goal, held), (memory.goal, memory.held))
        left = None if memory.held is None else memory.held.normal
        start, wait = body.grip_point, jnp.zeros_like(tries)
        memory = self.swung(memory, swings, wait, start=start, goal=goal, below=start[:, 2], held=held, left=left)
        aim = jnp.where(again[:, None], aim, waits.aim)
        return memory._replace(waits=Waits(waits.failed & ~swings, tries, first, aim, waits.stands | gives_up))

    def _other_holds(self, memory: Swings, first: Array, body: Body) -> tuple[Array, Held | None]:
        """The nearest footholds to the `first` ones (limb, 3) m beyond the last ones, these where there is none."""
        away = ((memory.goal - first) ** 2).sum(1)
        others = ~np.eye(len(first), dtype=bool)

        def allowed(position: Array) -> Array:
            apart = ((position[:, None] - memory.goal) ** 2).sum(2) > SAME**2
            beyond = ((position - first) ** 2).sum(1) > away + SAME**2
            target = (position - body.base_position) @ body.base_rotation
            return jnp.asarray((apart | ~others).all(1) & beyond & within_reach(self.robot, self.geometry, target))

        if self.holds is None:
            number = np.arange(1, _BESIDE + 1)
            angle = number * np.pi * (3 - np.sqrt(5))  # of a sunflower's seeds
            spiral = (number / _BESIDE)[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
            ways = jnp.asarray(spiral, first.dtype) * self.waiting.reach
            each = Candidates(ways, jnp.ones_like(ways[:, 0]))
        else:
            each = Candidates.of(self.holds)
        return best(
            lambda position, _: -((position - first) ** 2).sum(1), allowed, each, (first, memory.held), body.weight
        )
