"""Laws without sensors: offsets of the feet by how far each is through its stance, or by the time of the walk.

What they hold is an array of gains, so that `tuning` searches it, and `combined` adds it to a law that reads forces.
"""

import jax.numpy as jnp
import numpy as np

import mjx_climb as mc
from mjx_climb.control.foot_offsets import Offsets, feet_shifted, released
from mjx_climb.physics.spatial import quaternion_to_matrix

FEET, LIMIT, FAR = 4, 10.0, 1e6  # mm, and a place before the first node and after the last one
# shares of a stance between which offsets are straight lines; closer where the foot itself lands and lifts off
NODES = np.array([0.0, 0.01, 0.025, 0.05, *np.arange(0.1, 0.91, 0.05), 0.95, 0.975, 0.99, 1.0])
KNOTS = np.arange(0.0, 8.21, 0.2)  # s


def shares(at, nodes):
    """Return by how much each node counts at some places (...), on straight lines between nodes, (..., node)."""
    before, after = np.array([-FAR, *nodes[:-1]]), np.array([*nodes[1:], FAR])
    up = (at[..., None] - before) / (nodes - before)
    return jnp.clip(jnp.minimum(up, (after - at[..., None]) / (after - nodes)), 0.0, 1.0)


class PlannedFeet(mc.Law):
    """Each standing foot is held off its grip point by `offsets`; a swinging foot comes down with the first of them."""

    offsets: object = mc.gain("mm", shape=(FEET, len(NODES), 3), bounds=(-LIMIT, LIMIT), default=0.0)

    def init(self, start):
        """Return no offsets."""
        return Offsets.begin(start)

    def step(self, state, measured, reference):
        """Move each foot along its table."""
        since, until = reference.since_touchdown, reference.until_lift_off
        share = since / jnp.maximum(since + until, 1e-6)
        planned = 1e-3 * (shares(share, NODES)[..., None] * self.offsets).sum(1)
        stands = (until > 0)[:, None]
        moved = jnp.where(stands, planned, released(state, 1e-3 * self.offsets[:, 0]))
        state = state._replace(displacement=moved)
        return state, feet_shifted(reference, state, quaternion_to_matrix(reference.base_orientation))


class TimedFeet(mc.Law):
    """Each foot is held off where the gait wants it by `timed`, on straight lines between knots in time."""

    timed: object = mc.gain("mm", shape=(FEET, len(KNOTS), 3), bounds=(-LIMIT, LIMIT), default=0.0)

    def init(self, start):
        """Return the time, s, and no offsets."""
        return jnp.zeros(()), Offsets.begin(start)

    def step(self, state, measured, reference):
        """Move the feet along their table."""
        time, offsets = state
        moved = 1e-3 * (shares(time, KNOTS)[:, None] * self.timed).sum(1)
        offsets = offsets._replace(displacement=moved)
        command = feet_shifted(reference, offsets, quaternion_to_matrix(reference.base_orientation))
        return (time + offsets.period, offsets), command
