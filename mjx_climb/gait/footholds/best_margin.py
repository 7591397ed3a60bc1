"""The point with which the coming support bears most before the robot tumbles, near the planned foothold."""

import jax.numpy as jnp
from jax import Array

from mjx_climb.component import parameter
from mjx_climb.gait.footholds.footholds import Candidate, Footholds, Situation
from mjx_climb.physics.margins import support_axes, tumbling_moment
from mjx_climb.physics.spatial import norm


class BestMargin(Footholds):
    """A limb swings to the point of the best compromise of margin and distance from the planned foothold.

    The margin is the smallest moment that tumbles the robot at rest over an axis of the support with the point in it,
    over its weight and the strongest grip's pull, m. Grips pull along the normals of their holds.
    """

    KIND = "best_margin"

    distance_weight: Array = parameter("1", bounds=(0.0, 100.0), default=1.0, long_name="weight of the distance")

    def score(self, situation: Situation, candidate: Candidate) -> Array:
        """The margin less the weighted distance, (limb,) m; limbs that swing together have one margin."""
        feet = jnp.where(situation.stands[:, None], situation.feet, candidate.position)
        axes = support_axes(feet, jnp.ones_like(situation.stands))
        reaction = -situation.weight
        wrench = reaction, jnp.cross(situation.center_of_mass, reaction)
        pull = jnp.where(situation.stands[:, None], situation.pull, candidate.pull * candidate.normal)
        scale = norm(situation.weight) + norm(situation.pull).max()
        margin = tumbling_moment(axes, wrench, pull) / jnp.where(scale > 0, scale, 1.0)
        away = norm(candidate.position - situation.planned)
        return jnp.asarray(margin - self.distance_weight * away)
