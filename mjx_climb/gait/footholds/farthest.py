"""The point farthest ahead."""

import jax.numpy as jnp
from jax import Array

from mjx_climb.gait.footholds.footholds import Candidate, Footholds, Situation


class Farthest(Footholds):
    """A limb swings as far ahead as its reach allows."""

    KIND = "farthest"

    def score(self, situation: Situation, candidate: Candidate) -> Array:
        """The way ahead, (limb,) m."""
        return jnp.sum((candidate.position - situation.feet) * situation.forward, axis=1)
