"""Load transfer: the load of a foot is handed over to the others before it lifts off, and back after it has landed.

Shifts of the base change the wrench on the base, not how the closed chain of limbs shares it. So here each foot gives
way on its own, `D dx' = F - F_wanted - leak D dx`, where the wanted forces share the measured wrench anew among the
feet that stand, with weights that fall before a lift-off and rise after a touchdown. It integrates: a servo's friction,
which a spring does not overcome, holds nothing back for long. Three feet are statically determined along the ground's
normal: there must be a while on all feet (a duty above 1 - 1 / limbs) in which loads can be handed over.

The law knows no joint limits and no reach. Offsets towards targets out of reach are bounded by `max_offset`
and leak away; of servos at their `torque_limit` it gets the reports, and lets the offset of such a limb only shrink.
"""

import math
from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.foot_offsets import LEAST, Offsets, base_error, feet_shifted, released, standing_forces
from mjx_climb.control.force_distribution import distributed, moved_rigidly, net_wrench, rigid_part
from mjx_climb.control.law import Command, Law, Measurement, Reference, Start, scalar
from mjx_climb.control.virtual_mass import bounded
from mjx_climb.physics.spatial import quaternion_to_matrix


class LoadTransfer(Law):
    """Integral force control of each foot towards its share of the measured wrench."""

    normal_damping: Array = scalar("N s/m", "damping D along the ground's normal", bounds=(1e1, 1e4), default=1e2)
    tangential_damping: Array = scalar("N s/m", "damping D along the ground", bounds=(1e2, 1e6), default=1e4)
    leak: Array = scalar("1/s", "leak of the offsets", bounds=(1e-2, 1e1), default=0.3)
    leveling: Array = scalar("1/s", "rate at which the base levels", bounds=(1e-1, 2e1), default=1.0)
    unloading: Array = scalar("s", "time of unloading", bounds=(2e-2, 1.0), default=0.1)
    loading: Array = scalar("s", "time of loading", bounds=(2e-2, 1.0), default=0.1)
    landing: Array = scalar("1", "share of the base's error", bounds=(1e-2, 1.5), default=1.0)
    pull_limit: Array = scalar(
        "N", "pull that the law asks for, at most", bounds=(1e-1, 1e1), default=2.0, searched=False
    )
    max_offset: float = 0.02  # m
    max_rate: float = 0.1  # m/s
    torque_limit: float = math.inf  # N m, of the servos: from there on more offset makes no more force

    LIMBWISE: ClassVar[frozenset[str]] = frozenset(
        {"normal_damping", "tangential_damping", "leak", "leveling", "unloading", "loading", "landing"}
    )

    def init(self, start: Start) -> Offsets:
        """Return no offsets."""
        return Offsets.begin(start)

    def step(self, offsets: Offsets, measured: Measurement, reference: Reference) -> tuple[Offsets, Command]:
        """Let the feet that stand give way towards the wanted forces; the offset of an open gripper fades."""
        rotation = quaternion_to_matrix(reference.base_orientation)
        lever = (reference.foot_position - measured.base_position) @ rotation
        force = standing_forces(measured, rotation)
        weight = jnp.where(measured.support, self.weights(reference), 0.0)
        wanted = self.wanted(net_wrench(lever, force), lever, weight)
        pushed = jnp.where(measured.forces_known, force - wanted, 0.0)

        # the rigid part of the offsets shifts and turns the base alone: it decays at a rate of its own, `leveling`
        before = offsets.displacement
        rigid = rigid_part(lever, before, jnp.where(measured.support, 1.0, 0.0))
        along, normal = jnp.atleast_1d(self.tangential_damping), jnp.atleast_1d(self.normal_damping)
        damping = jnp.concatenate(jnp.broadcast_arrays(along, along, normal), axis=-1)
        back = -self.leak * (before - rigid) - self.leveling * rigid
        yielding = bounded(pushed / damping + back, self.max_rate)
        if self.torque_limit < math.inf:
            saturated = (jnp.abs(measured.joint_torque) >= self.torque_limit).any(1)
            outward = saturated & (jnp.vecdot(yielding, before) > 0)
            yielding = jnp.where(outward[:, None], 0.0, yielding)
        moved = bounded(before + offsets.period * yielding, self.max_offset)
        lands = -self.landing * moved_rigidly(lever, base_error(measured, reference, rotation))
        displacement = jnp.where(measured.support[:, None], moved, released(offsets, lands))
        offsets = offsets._replace(displacement=displacement)
        return offsets, feet_shifted(reference, offsets, rotation)

    def wanted(self, wrench: Array, lever: Array, weight: Array) -> Array:
        """Return the forces (limb, 3) N that share a wrench (6,) among feet at levers (limb, 3) m with some weights."""
        return distributed(wrench, lever, weight, self.pull_limit)

    def weights(self, reference: Reference) -> Array:
        """Return the shares (limb,) that the gait wants the feet to have, if they stand."""
        until = jnp.clip(reference.until_lift_off / jnp.ravel(self.unloading), 0.0, 1.0)
        since = jnp.clip(reference.since_touchdown / jnp.ravel(self.loading), 0.0, 1.0)
        return jnp.maximum(until * since, LEAST)
