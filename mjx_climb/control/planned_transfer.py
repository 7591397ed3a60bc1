"""Load transfer without a force sensor: the loads that are handed over are planned, from weight, gravity and gait.

In place of measured forces stand those of a level robot at rest, whose weight the feet that stand share; the base's
pose is the one in which the joints put these feet where they gripped.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from mjx_climb.control.foot_offsets import Offsets
from mjx_climb.control.force_distribution import least_forces, rigid_twist
from mjx_climb.control.law import Command, Measurement, Reference, Start, scalar, shifted
from mjx_climb.control.load_transfer import LoadTransfer
from mjx_climb.physics.spatial import quaternion_to_matrix

_OPEN = 1e-6  # share of a foot that does not stand


class Plan(NamedTuple):
    """The robot's weight and compliance, and the offsets of its feet."""

    offsets: Offsets
    weight: Array  # (3,) N, world axes, of the robot
    compliance: Array  # (limb, 3, 3) m/N, base axes, of the feet


class PlannedTransfer(LoadTransfer):
    """Load transfer by plan: it reads joint angles alone."""

    load: Array = scalar("1", "planned load over the robot's weight", bounds=(0.2, 5.0), default=1.0)
    sinking: Array = scalar("m/N", "way by which loaded feet sink into their grips", bounds=(0.0, 1e-3), default=1e-4)
    gravity: Array = scalar("1", "share of the joints' sag that is made up for", bounds=(0.0, 1.5), default=0.0)

    def init(self, start: Start) -> PyTree:
        """Return no offsets, and the robot's weight and compliance."""
        feet = start.reference.foot_position
        weight = jnp.broadcast_to(jnp.asarray(start.weight), 3)
        return Plan(Offsets.begin(start), weight, jnp.broadcast_to(jnp.asarray(start.compliance), (len(feet), 3, 3)))

    def step(self, plan: PyTree, measured: Measurement, reference: Reference) -> tuple[PyTree, Command]:
        """Let feet give way as load transfer does, under planned forces and from the base's pose by the joints."""
        rotation, support = quaternion_to_matrix(reference.base_orientation), measured.support
        where = (reference.foot_position - reference.base_position) @ rotation
        weight = -self.load * (plan.weight @ rotation)
        wrench = jnp.concatenate([weight, jnp.zeros_like(weight)])
        shared = least_forces(wrench, where, jnp.where(support, self.weights(reference), _OPEN))
        base = base_by_joints(measured, reference, where - self.sinking * shared)
        lever = (reference.foot_position - base.base_position) @ rotation
        evenly = least_forces(wrench, lever, jnp.where(support, 1.0, _OPEN))
        known = measured._replace(
            base_position=base.base_position, base_orientation=base.base_orientation,
            foot_force=evenly @ rotation.T, forces_known=jnp.asarray(True),
        )  # fmt: skip
        offsets, command = super().step(plan.offsets, known, reference)
        sag = -self.gravity * jnp.matvec(plan.compliance, shared)
        feet = command.foot_position + jnp.where(support[:, None], sag, 0.0) @ rotation.T
        return plan._replace(offsets=offsets), command._replace(foot_position=feet)


def base_by_joints(measured: Measurement, reference: Reference, feet: Array) -> Command:
    """Return the reference with its base where joints have it, if feet that stand are at `feet` (limb, 3) m.

    They are from the base of the reference, along its axes.
    """
    lever = jnp.asarray(measured.foot_lever)
    return shifted(reference, rigid_twist(lever, feet - lever, jnp.where(measured.support, 1.0, 0.0)))
