"""The law of Climb-SDK, the controller of the climbing robot LORIS (Robomechanics Lab, Carnegie Mellon University).

From its source, https://github.com/robomechanics/climb-sdk, `climb_control/src/force_controller.cpp`, and the gains in
`loris_bringup/config/params.yaml`; the robot: Nadan, Backus and Johnson, *LORIS: A Lightweight Free-Climbing Robot for
Extreme Terrain Exploration*, ICRA 2024. Twenty times a second:

    min (c / 2) sum |F*|^2 - margin,   sum G F* = sum G F,   margin <= F*_z of each foot that stands
    x += k_F (F - F*) + k_b (dp + dtheta x r)

F is measured, F* wanted, dp and dtheta are the base's error. The wrench is that of the measured forces, as in the
source: no mass is known to the law. (The source takes the rigid part of F - F* away: without a wrench it is nothing.)

Parts that need the robot's kinematics or another gripper are left out: limits of joint torque and the body's own search
for a place (here the gait says where it goes), limits along the ground (these grippers hold in any direction), pushes
while a gripper engages. Its bound on joint targets, 0.1 rad from the measured angle, is one on the feet here, 0.1 rad
of 0.2 m.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.foot_offsets import Offsets, base_error, feet_shifted, released, standing_forces
from mjx_climb.control.force_distribution import Sharing, moved_rigidly, net_wrench, pushed_up, sharing
from mjx_climb.control.law import Command, Law, Measurement, Reference, Start, scalar
from mjx_climb.control.virtual_mass import bounded
from mjx_climb.physics.spatial import quaternion_to_matrix

_SWEEPS = 12  # through the pairs of feet, which leave 0.01 N of margin in the hundredth worst of scenes
_FLAT = 1e-6  # added to a curvature, of one


class Clocked(NamedTuple):
    """Offsets, and the time since they were changed last."""

    offsets: Offsets
    since: Array  # () s


class ClimbSDK(Law):
    """Integrated error of the contact forces towards those of the largest margin, and of the base's pose."""

    force_gain: Array = scalar("m/N", "gain k_F of an update", bounds=(1e-6, 1e-2), default=1e-4)
    body_gain: Array = scalar("1", "gain k_b of an update", bounds=(1e-3, 1.0), default=0.1)
    force_cost: Array = scalar("1/N", "cost c of forces", bounds=(1e-4, 1e1), default=1e-2, searched=False)
    update_period: float = 0.05  # s
    max_offset: float = 0.02  # m

    def init(self, start: Start) -> Clocked:
        """Return no offsets, and an update that is due."""
        return Clocked(Offsets.begin(start), jnp.asarray(self.update_period))

    def step(self, state: Clocked, measured: Measurement, reference: Reference) -> tuple[Clocked, Command]:
        """Integrate, where an update is due, and shift the feet; the offset of an open gripper fades."""
        support = measured.support
        due = state.since > self.update_period - state.offsets.period / 2
        rotation = quaternion_to_matrix(reference.base_orientation)
        lever = (reference.foot_position - measured.base_position) @ rotation
        offsets, force, weight = state.offsets, standing_forces(measured, rotation), jnp.where(support, 1.0, 0.0)
        wanted = of_largest_margin(sharing(net_wrench(lever, force), lever, weight), support, self.force_cost)
        pushed = jnp.where(measured.forces_known, force - wanted, 0.0)
        change = self.force_gain * pushed + self.body_gain * moved_rigidly(
            lever, base_error(measured, reference, rotation)
        )
        moved = bounded(offsets.displacement + jnp.where(due, change, 0.0), self.max_offset)
        displacement = jnp.where(support[:, None], moved, released(offsets, 0.0))
        since = jnp.where(due, 0.0, state.since) + offsets.period
        offsets = offsets._replace(displacement=displacement)
        return Clocked(offsets, since), feet_shifted(reference, offsets, rotation)


def of_largest_margin(share: Sharing, bears: Array, cost: Array) -> Array:
    """Return the forces (limb, 3) N with the largest least normal force among feet that bear, less `cost / 2 |F|^2`.

    Its dual has a share of one for each foot; shares handed between two feet are found exactly, pair by pair.
    """
    limbs, counts = len(bears), jnp.where(bears, 1.0, 0.0)
    part = counts / jnp.maximum(counts.sum(), 1.0)
    parts = [part[limb] for limb in range(limbs)]
    pairs = [(i, j) for i in range(limbs) for j in range(i)]
    rows = {(i, j): (share.change[i] - share.change[j]) / cost for i, j in pairs}
    scale = {(i, j): counts[i] * counts[j] / (row[i] - row[j] + _FLAT / cost) for (i, j), row in rows.items()}
    for i, j in pairs * _SWEEPS:
        slope = share.vertical[i] - share.vertical[j] + sum(rows[i, j][limb] * parts[limb] for limb in range(limbs))
        given = jnp.minimum(jnp.maximum(scale[i, j] * slope, -parts[j]), parts[i])
        parts[i], parts[j] = parts[i] - given, parts[j] + given
    return pushed_up(share, jnp.stack(parts) / cost)
