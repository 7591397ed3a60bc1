"""The point nearest to the planned foothold."""

import jax.numpy as jnp
from jax import Array

from mjx_climb.gait.footholds.footholds import Candidate, Footholds, Situation


class Nearest(Footholds):
    """A limb swings to the point that is nearest to the foothold of the periodic gait."""

    KIND = "nearest"

    def score(self, situation: Situation, candidate: Candidate) -> Array:
        """Minus the squared distance, (limb,) m^2."""
        way = candidate.position - situation.planned
        return -jnp.sum(way * way, axis=1)
