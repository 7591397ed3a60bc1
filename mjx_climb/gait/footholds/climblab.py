"""ClimbLab's rule: the largest step towards the goal under a stride cap, of the limb with most holds ahead.

Uno et al., "Non-periodic gait planning based on salient region detection for a planetary cave exploration robot",
i-SAIRAS 2020.
"""

import jax.numpy as jnp
from jax import Array

from mjx_climb.component import parameter
from mjx_climb.gait.footholds.footholds import Candidate, Footholds, Prospects, Situation, level


class ClimbLab(Footholds):
    """A limb takes the largest step ahead whose level length is within a cap."""

    stride_cap: Array = parameter("m", bounds=(0.0, 10.0), default=0.1, long_name="longest step of a limb")

    def score(self, situation: Situation, candidate: Candidate) -> Array:
        """The way ahead, (limb,) m; -inf of a step that is longer than the cap."""
        step = candidate.position - situation.feet
        short = jnp.sum(level(step) ** 2, axis=1) <= self.stride_cap**2
        return jnp.where(short, jnp.sum(step * situation.forward, axis=1), -jnp.inf)

    def limb_worth(self, prospects: Prospects) -> Array:
        """The number of holds ahead, (limb,)."""
        return prospects.near
