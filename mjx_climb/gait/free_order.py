"""The free order of limbs: once all stand, the limb that gains most swings next."""

import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient

from mjx_climb.gait.chosen_footholds import ChosenFootholds
from mjx_climb.gait.footholds.choice import Candidates
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
        """The limb that gains most, where all stand and it has a hold to go to; it waits for the base."""
        wait = jnp.maximum(self.plan.cycle_steps / self.moves - self.plan.swing_steps, 0.0)
        stand = (memory.step >= memory.begun + memory.span).all() & (memory.running > 0)
        none = Prospects.none(situation.feet)
        prospects = jax.lax.cond(stand, lambda: self.prospects(situation, body, ways), lambda: none)
        lifts = stand & first_largest(self.rule.limb_worth(prospects)) & (prospects.farthest > -jnp.inf)
        return lifts, wait, situation

    def prospects(self, situation: Situation, body: Body, ways: tuple[Array, Array]) -> Prospects:
        """The prospects of each limb; arguments as of `choose`."""
        reached, allowed = self.reached(body, ways), self.allowed(situation, body, ways)

        def seen(one: Candidates) -> tuple[Array, Array, Array, Array]:
            """How far a hold is ahead, whether it is near and whether it may be chosen, and its score."""
            position = stop_gradient(jnp.broadcast_to(one.vector, situation.feet.shape))
            step = position - situation.feet
            ahead, there = (step * situation.forward).sum(1), reached(position) & (one.valid > 0)
            near = there & (ahead > 0) & ((step * step).sum(1) <= AHEAD**2)
            score = self.score(situation, position, one)
            return ahead, near, there & allowed(position) & (score > -jnp.inf), score

        def look(found: tuple[Array, Array, Array], one: Candidates) -> tuple[tuple[Array, Array, Array], None]:
            farthest, count, most = found
            ahead, near, may, score = seen(one)
            farthest, most = (
                jnp.where(may, jnp.maximum(old, new), old) for old, new in ((farthest, ahead), (most, score))
            )
            return (farthest, count + near, most), None

        nothing = Prospects.none(situation.feet)
        begun, each = (*nothing[:2], nothing.farthest), Candidates.of(self.holds)
        (farthest, count, most), _ = jax.lax.scan(look, begun, each)

        def look_again(found: Array, one: Candidates) -> tuple[Array, None]:
            _, near, _, score = seen(one)
            return found + (near & (score > most)), None

        in_vain, _ = jax.lax.scan(look_again, nothing.in_vain, each)
        return Prospects(*map(stop_gradient, (farthest, count, in_vain)))


def first_largest(values: Array) -> Array:
    """Return which of values (limb,) is the largest, of equal ones the first, (limb,) bool."""
    largest, before, found = values.max(), jnp.asarray(False), []
    for limb in range(len(values)):
        is_it = (values[limb] == largest) & ~before
        before = before | is_it
        found.append(is_it)
    return jnp.stack(found)
