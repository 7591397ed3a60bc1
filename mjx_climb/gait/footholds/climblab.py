"""ClimbLab's rule: the largest step towards the goal under a stride cap, of the limb with most holds ahead.

In a free order the limb with most holds ahead offers its largest step. A step that may not be taken is dropped, and the
next offer is that of the limb with most holds then. A limb that has none left ends the walk in ClimbLab; here it stays.

Uno et al., "Non-periodic gait planning based on salient region detection for a planetary cave exploration robot",
i-SAIRAS 2020.
"""

import jax.numpy as jnp
from jax import Array

from mjx_climb.component import option, parameter
from mjx_climb.gait.footholds.footholds import Candidate, Footholds, Prospects, Situation, level
from mjx_climb.physics.spatial import norm

_APART = 5e-3  # m, between a new foothold and any foot


class ClimbLab(Footholds):
    """A limb takes the largest step ahead whose level length is within a cap."""

    KIND = "climblab"

    stride_cap: Array = parameter("m", bounds=(0.0, 10.0), default=0.1, long_name="longest step of a limb")
    reach_a_stride_on: bool = option(False, "a hold must be in reach from the base a stride further on, too")
    reach_by_height: bool = option(True, "reach by ClimbLab's table of reach by height")
    base_must_follow: bool = option(True, "no step that leaves a foot out of reach of the base in its new place")

    def score(self, situation: Situation, candidate: Candidate) -> Array:
        """The way ahead, (limb,) m; -inf of a step that is longer than the cap."""
        step = candidate.position - situation.feet
        short = jnp.sum(level(step) ** 2, axis=1) <= self.stride_cap**2
        return jnp.where(short, jnp.sum(step * situation.forward, axis=1), -jnp.inf)

    def apart(self, situation: Situation, position: Array) -> Array:
        """Whether points (limb, 3) m are far enough from where feet stand, (limb,) bool: the limb's own too."""
        return jnp.asarray((norm(position[:, None] - situation.feet) > _APART).all(1))

    def limb_worth(self, prospects: Prospects) -> Array:
        """The number of holds ahead but for those that were offered in vain, (limb,)."""
        return prospects.near - prospects.in_vain
