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
from mjx_climb.control.motion import Mass, Motion, begin, move
from mjx_climb.control.virtual_model import VirtualState, rest
from mjx_climb.dynamics.spatial import quaternion_to_matrix, rotate, rotate_back


class Feet(NamedTuple):
    """The virtual masses of the feet, and the shift that the base never makes."""

    model: Mass  # (3, L, B)
    no_shift: Array  # (6, B)


class EndEffectorAdmittance(ThreeAxes):
    """Eq. 2 for the feet of a robot."""

    motion: Motion = Motion()

    def init(self, start: Start) -> Feet:
        """Return the virtual masses of the feet at rest."""
        model = begin(self.motion, self._every_foot(), start.period, rest(start.reference.foot_position))
        return Feet(model, no_shift(start))

    def step(self, state: Feet, measurement: Measurement, reference: Reference) -> tuple[Feet, Command]:
        """Return the reference with the supporting feet shifted."""
        model, rotation = state.model, quaternion_to_matrix(reference.base_orientation)[:, :, None]
        model = move(self.motion, self._every_foot(), model, rotate_back(rotation, measurement.foot_force))
        moved = VirtualState(*(jnp.where(measurement.support, value, 0.0) for value in model.state))
        target = reference.foot_position + rotate(rotation, moved.displacement)
        command = Command(reference.base_position, reference.base_orientation, target, state.no_shift)
        return state._replace(model=model._replace(state=moved)), command

    def _every_foot(self) -> "EndEffectorAdmittance":
        """Return the gains with an axis of feet, (3, 1, B)."""
        wide: EndEffectorAdmittance = jax.tree.map(lambda gain: gain[:, None], self)
        return wide
