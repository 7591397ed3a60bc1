"""The free order of limbs: once all stand, the limb that gains most swings next."""

import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient

from mjx_climb.gait.chosen_footholds import ChosenFootholds
from mjx_climb.gait.footholds.footholds import AHEAD, Prospects, Situation
from mjx_climb.gait.gait import Body
from mjx_climb.gait.own_swings import Swings
from mjx_climb.gait.schedule import Schedule


class FreeOrder(ChosenFootholds):
    """Swings of one limb at a time, in no order."""

    def until_lift_off(self, clock: Array, elapsed: Array) -> Array:
        """Known once a limb is chosen; the others are not expected to lift off within a cycle."""
        return jnp.where(elapsed < 0, -elapsed, self.plan.cycle_steps)

    def next_swings(
        self, memory: Swings, now: Schedule, situation: Situation, body: Body, base: Array, ways: tuple[Array, Array]
    ) -> tuple[Array, Array, Situation]:
        """The limb that gains most, where all stand; it waits for the base."""
        wait = jnp.maximum(self.plan.cycle_steps / self.moves - self.plan.swing_steps, 0.0)
        stand = (memory.step >= memory.begun + memory.span).all() & (memory.running > 0)
        none = Prospects.none(situation.feet)
        prospects = jax.lax.cond(stand, lambda: self.prospects(situation, body, ways), lambda: none)
        return stand & first_largest(self.rule.limb_worth(prospects)), wait, situation

    def prospects(self, situation: Situation, body: Body, ways: tuple[Array, Array]) -> Prospects:
        """The prospects of each limb; arguments as of `choose`."""

        def look(found: Prospects, hold: tuple[Array, Array]) -> tuple[Prospects, None]:
            point, valid = hold
            position = stop_gradient(jnp.broadcast_to(point, situation.feet.shape))
            step = position - situation.feet
            ahead = (step * situation.forward).sum(1)
            may = self.allowed(situation, body, ways, position) & (valid > 0)
            near = may & (ahead > 0) & ((step * step).sum(1) <= AHEAD**2)
            farthest = jnp.where(may, jnp.maximum(found.farthest, ahead), found.farthest)
            return Prospects(farthest, found.near + near), None

        found, _ = jax.lax.scan(look, Prospects.none(situation.feet), (self.holds.position, self.holds.valid))
        return Prospects(*map(stop_gradient, found))


def first_largest(values: Array) -> Array:
    """Return which of values (limb,) is the largest, of equal ones the first, (limb,) bool."""
    largest, before, found = values.max(), jnp.asarray(False), []
    for limb in range(len(values)):
        is_it = (values[limb] == largest) & ~before
        before = before | is_it
        found.append(is_it)
    return jnp.stack(found)
