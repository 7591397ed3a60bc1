"""The point at which the grip that lands uses least of its pull, near the planned foothold.

On overhangs the base sags and the gripper shuts off the rock; a contact that holds at once tears the grip off in that
step (docs/studies/climb.md).
"""

import jax.numpy as jnp
from jax import Array

from mjx_climb.component import parameter
from mjx_climb.gait.footholds.footholds import Candidate, Footholds, Situation
from mjx_climb.physics.spatial import inverse_3x3, norm

_FEWEST = 3  # feet that bear a weight anywhere
_REGULARIZATION = 8.0  # in units of rounding: feet on a line bear no moment about it


class LeastUse(Footholds):
    """A limb swings to the point of the best compromise of its grip's use and distance from the planned foothold.

    The use is a pull over the one that the grip bears. At rest the base hangs on the feet that stand as a rigid body on
    equal springs, and the pull is what another spring at the point would bear: in proportion to the base's sag there.
    """

    KIND = "least_use"

    distance_weight: Array = parameter("1/m", bounds=(0.0, 100.0), default=1.4, long_name="weight of the distance")

    def score(self, situation: Situation, candidate: Candidate) -> Array:
        """Minus the use, less the weighted distance, (limb,) 1; of fewer than three standing feet the latter alone."""
        force = resting_forces(situation, candidate.position)
        pull = jnp.maximum(-(force * candidate.normal).sum(1), 0.0)
        predicted = (candidate.pull > 0) & (situation.stands.sum() >= _FEWEST)
        use = jnp.where(predicted, pull / jnp.where(candidate.pull > 0, candidate.pull, 1.0), 0.0)
        return jnp.asarray(-use - self.distance_weight * norm(candidate.position - situation.planned))


def resting_forces(situation: Situation, position: Array) -> Array:
    """Return the forces of the ground on equal springs at points (limb, 3) m of a base at rest, (limb, 3) N.

    At the feet that stand they are the forces of least squared sum that bear the weight.
    """
    stands = situation.stands.astype(position.dtype)[:, None]
    count = jnp.maximum(stands.sum(), 1.0)
    # about the feet's mean translation and rotation of the base part: f_i = -W / n + b x r_i, sum r_i x f_i = M
    mean = (stands * situation.feet).sum(0) / count
    lever = stands * (situation.feet - mean)
    squares = (lever[:, :, None] * lever[:, None]).sum(0)
    size = jnp.trace(squares)
    rounding = float(jnp.finfo(position.dtype).eps) * jnp.where(size > 0, size, 1.0)
    inertia = (size + _REGULARIZATION * rounding) * jnp.eye(3, dtype=position.dtype) - squares
    turn = inverse_3x3(inertia) @ jnp.cross(mean - situation.center_of_mass, situation.weight)
    return -situation.weight / count + jnp.cross(turn, position - mean)
