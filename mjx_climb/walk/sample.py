"""Everything that can be known about one step of a walk, in the layout of the hot path."""

from typing import NamedTuple

from jax import Array


class Sample(NamedTuple):
    """One step: state, forces and accelerations at its start.

    SI units, world axes, B or 1 environments, L limbs of N joints.
    """

    time: Array  # () s
    base_position: Array  # (3, B) m, of the base's centre of mass
    base_orientation: Array  # (4, B) wxyz
    base_linear_velocity: Array  # (3, B) m/s
    base_angular_velocity: Array  # (3, B) rad/s
    base_linear_acceleration: Array  # (3, B) m/s^2
    base_angular_acceleration: Array  # (3, B) rad/s^2
    joint_angles: Array  # (N, L, B) rad, of sliding joints m
    joint_rates: Array  # (N, L, B) rad/s, m/s
    joint_accelerations: Array  # (N, L, B) rad/s^2, m/s^2
    joint_targets: Array  # (N, L, B) rad, m
    joint_torque: Array  # (N, L, B) N m, N
    foot_position: Array  # (3, L, B) m
    foot_velocity: Array  # (3, L, B) m/s
    foot_target: Array  # (3, L, B) m
    foot_force: Array  # (3, L, B) N, of the ground on the foot
    foot_moment: Array  # (3, L, B) N m, of the ground on the foot
    grip_point: Array  # (3, L, B) m
    support: Array  # (L, B) bool: the gripper is shut and holds
    contact: Array  # (L, B) bool: the ground acts on the foot
    detached: Array  # (L, B) bool: the gripper was torn off before this step
    torn_off: Array  # (L, B) bool: it is torn off in this step
    missed: Array  # (L, B) bool: it shuts out of reach in this step
    reachable: Array  # (L, B) bool: the target was within the limb's reach
    base_reference: Array  # (3, B) m
    base_displacement: Array  # (6, B) m, rad: shift of the base by the control law, reference axes
    base_wrench: Array  # (6, B) N, N m: `J_b^T F_e`
    push: Array  # (6, B) N, N m, on the base from outside
    cargo_mass: Array  # (B,) kg
    center_of_mass: Array  # (3, B) m, of robot and cargo
    tsm: Array  # (B,) m
    gia_margin: Array  # (B,) m/s^2
