"""End-effector admittance, the paper's Eq. 2: every supporting foot gives way to its own force.

`M dxdd + D dxd + K dx = F_e` for each foot and each translation, integrated exactly; the target of the foot is
shifted by dx, which goes back to zero at once when the gripper opens. The gains of the three translations apply to
every foot.
"""

import jax
import jax.numpy as jnp

from mjx_climb.control.impedance import ThreeAxes
from mjx_climb.control.law import Command, Measurement, Reference, Start
from mjx_climb.control.virtual_model import VirtualModel, VirtualState, advance, discretize, rest
from mjx_climb.dynamics.spatial import quaternion_to_matrix, rotate, rotate_back


class EndEffectorAdmittance(ThreeAxes):
    """Eq. 2 for the feet of a robot."""

    def init(self, start: Start) -> VirtualModel:
        """Return the virtual masses of the feet at rest, (3, L, B)."""
        every_foot = jax.tree.map(lambda gain: gain[:, None], self)
        return VirtualModel(discretize(every_foot, start.period), rest(start.reference.foot_position))

    def step(self, state: VirtualModel, measurement: Measurement, reference: Reference) -> tuple[VirtualModel, Command]:
        """Return the reference with the supporting feet shifted."""
        rotation = quaternion_to_matrix(reference.base_orientation)[:, :, None]
        moved = advance(state.transition, state.mass, rotate_back(rotation, measurement.foot_force))
        moved = VirtualState(*(jnp.where(measurement.support, value, 0.0) for value in moved))
        target = reference.foot_position + rotate(rotation, moved.displacement)
        no_shift = jnp.zeros_like(measurement.wrench)
        command = Command(reference.base_position, reference.base_orientation, target, no_shift)
        return state._replace(mass=moved), command
