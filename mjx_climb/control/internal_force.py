"""Internal-force relaxation: the feet give way to the forces against each other, and to nothing else.

`F_int = F - W G^T (G W G^T)^-1 G F` has no net wrench: it leaves out the base's weight, and no gain lets the base
sag. Each foot that stands is moved by `D dx' + K dx = F_int`. A virtual mass is left out: it would add a lag
and nothing else, since the closed chain of limbs is stiff against internal forces.
"""

from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.foot_offsets import Offsets, feet_shifted, released, standing_forces
from mjx_climb.control.force_distribution import least_forces, net_wrench
from mjx_climb.control.law import Command, Law, Measurement, Reference, Start, gain
from mjx_climb.control.virtual_mass import bounded
from mjx_climb.physics.spatial import quaternion_to_matrix


class InternalForce(Law):
    """Admittance of each foot in the null space of the grasp map alone, exact under a force that is held."""

    damping: Array = gain("N s/m", length=3, bounds=(1e0, 1e5), default=5e2, long_name="virtual damping D")
    stiffness: Array = gain("N/m", length=3, bounds=(1e1, 1e6), default=1e3, long_name="virtual stiffness K")
    max_offset: float = 0.02  # m

    LIMBWISE: ClassVar[frozenset[str]] = frozenset({"damping", "stiffness"})

    def init(self, start: Start) -> tuple[Offsets, Array]:
        """Return no offsets, and the share (3,) of them that a step leaves."""
        return Offsets.begin(start), jnp.exp(-start.period * self.stiffness / self.damping)

    def step(
        self, state: tuple[Offsets, Array], measured: Measurement, reference: Reference
    ) -> tuple[tuple[Offsets, Array], Command]:
        """Let the feet that stand give way to internal forces; the offset of an open gripper fades."""
        offsets, kept = state
        rotation = quaternion_to_matrix(reference.base_orientation)
        lever = (reference.foot_position - measured.base_position) @ rotation
        force, weight = standing_forces(measured, rotation), jnp.where(measured.support, 1.0, 0.0)
        internal = force - least_forces(net_wrench(lever, force), lever, weight)
        moved = bounded(kept * offsets.displacement + (1 - kept) * internal / self.stiffness, self.max_offset)
        displacement = jnp.where(measured.support[:, None], moved, released(offsets, 0.0))
        offsets = offsets._replace(displacement=displacement)
        return (offsets, kept), feet_shifted(reference, offsets, rotation)
