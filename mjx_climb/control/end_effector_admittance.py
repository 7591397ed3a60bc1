"""End-effector admittance, the paper's Eq. 2: every supporting foot gives way to its own force.

`M dxdd + D dxd + K dx = F_e` for each foot and each translation, integrated exactly; the target of the foot is
shifted by dx, which goes back to zero at once when the gripper opens. The gains of the three translations apply to
every foot.
"""

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.control.law import Command, Law, Measurement, Reference
from mjx_climb.control.virtual_model import VirtualState, advance, discretize, rest
from mjx_climb.dynamics.spatial import quaternion_to_matrix, rotate, rotate_back
from mjx_climb.quantities.parameters import Gains

_LIMBS = 4


def build(gains: Gains, time_step: float | Array) -> Law:
    """Return Eq. 2 for the feet of a four-limbed robot."""
    translations = jax.tree.map(lambda gain: gain[:3, None], gains)
    transition = discretize(translations, time_step)
    no_shift = jnp.zeros_like(gains.stiffness)

    def command(state: VirtualState, measurement: Measurement, reference: Reference) -> tuple[VirtualState, Command]:
        rotation = quaternion_to_matrix(reference.base_orientation)[:, :, None]
        state = advance(transition, state, rotate_back(rotation, measurement.foot_force))
        state = jax.tree.map(lambda value: jnp.where(measurement.support, value, 0.0), state)
        target = reference.foot_position + rotate(rotation, state.displacement)
        return state, Command(reference.base_position, reference.base_orientation, target, no_shift)

    return Law(
        initial=rest(jnp.broadcast_to(translations.stiffness, (3, _LIMBS, no_shift.shape[1]))),
        command=command,
    )
