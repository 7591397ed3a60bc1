"""End-effector admittance, the paper's Eq. 2: every supporting foot gives way to its own force.

`M dxdd + D dxd + K dx = F_e` for each foot and each translation, integrated exactly; the target of the foot is
shifted by dx, which goes back to zero at once when the gripper opens. The gains of the three translations apply to
every foot.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.control.impedance import ThreeAxes
from mjx_climb.control.law import Command, Measurement, Reference, Start, no_shift
from mjx_climb.control.virtual_model import VirtualModel, VirtualState, advance, discretize, rest
from mjx_climb.dynamics.spatial import quaternion_to_matrix, rotate, rotate_back


class Feet(NamedTuple):
    """The virtual masses of the feet, and the shift that the base never makes."""

    model: VirtualModel  # (3, L, B)
    no_shift: Array  # (6, B)


class EndEffectorAdmittance(ThreeAxes):
    """Eq. 2 for the feet of a robot."""

    def init(self, start: Start) -> Feet:
        """Return the virtual masses of the feet at rest."""
        every_foot = jax.tree.map(lambda gain: gain[:, None], self)
        model = VirtualModel(discretize(every_foot, start.period), rest(start.reference.foot_position))
        return Feet(model, no_shift(start))

    def step(self, state: Feet, measurement: Measurement, reference: Reference) -> tuple[Feet, Command]:
        """Return the reference with the supporting feet shifted."""
        model, rotation = state.model, quaternion_to_matrix(reference.base_orientation)[:, :, None]
        moved = advance(model.transition, model.mass, rotate_back(rotation, measurement.foot_force))
        moved = VirtualState(*(jnp.where(measurement.support, value, 0.0) for value in moved))
        target = reference.foot_position + rotate(rotation, moved.displacement)
        command = Command(reference.base_position, reference.base_orientation, target, state.no_shift)
        return state._replace(model=model._replace(mass=moved)), command
