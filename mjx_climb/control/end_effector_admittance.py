"""Admittance of each foot, the paper's Eq. 2, `M dxdd + D dxd + K dx = F_e`.

F_e is the force of the ground on the foot, dx the shift of its target, both along the axes of the base reference.
"""

from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.law import Command, Law, Measurement, Reference, Start, gain
from mjx_climb.control.virtual_mass import Motion, VirtualMass, advance, at_rest
from mjx_climb.physics.spatial import quaternion_to_matrix


class EndEffectorAdmittance(Law):
    """Eq. 2, `M dxdd + D dxd + K dx = F_e` for each foot and each translation, integrated exactly.

    The target of a foot is shifted by dx, which goes back to zero at once when its gripper opens. The gains of the
    three translations apply to every foot.
    """

    inertia: Array = gain(
        "kg", length=3, bounds=(1e-1, 1e2), default=1.0, long_name="virtual inertia M", searched=False
    )
    damping: Array = gain("N s/m", length=3, bounds=(1e0, 1e5), default=5e3, long_name="virtual damping D")
    stiffness: Array = gain("N/m", length=3, bounds=(1e2, 1e6), default=5e4, long_name="virtual stiffness K")
    motion: Motion = Motion()

    LIMBWISE: ClassVar[frozenset[str]] = frozenset({"inertia", "damping", "stiffness"})

    def init(self, start: Start) -> VirtualMass:
        """Return the virtual masses of the feet at rest, (limb, 3)."""
        return at_rest(self, start.period, start.reference.foot_position, self.motion)

    def step(self, masses: VirtualMass, measured: Measurement, reference: Reference) -> tuple[VirtualMass, Command]:
        """Let the masses move under the forces for one period, and shift the supporting feet by where they are."""
        rotation, support = quaternion_to_matrix(reference.base_orientation), measured.support[:, None]
        # Eq. 2, along the axes of the reference: each row of F R is R^T times a force
        moved = advance(masses, measured.foot_force @ rotation, self.motion)
        displacement, rate = jnp.where(support, moved.displacement, 0.0), jnp.where(support, moved.rate, 0.0)
        no_shift = jnp.zeros_like(reference.base_position, shape=6)
        target = reference.foot_position + displacement @ rotation.T
        moved = moved._replace(displacement=displacement, rate=rate)
        return moved, Command(reference.base_position, reference.base_orientation, target, no_shift)
