"""Everything that can be known about one step of a walk."""

from typing import NamedTuple

from jax import Array


class Sample(NamedTuple):
    """One step of one robot: state, forces and accelerations at its start; SI units, world axes."""

    time: Array  # () s
    base_position: Array  # (3,) m, of the base's centre of mass
    base_orientation: Array  # (4,) wxyz
    base_linear_velocity: Array  # (3,) m/s
    base_angular_velocity: Array  # (3,) rad/s
    base_linear_acceleration: Array  # (3,) m/s^2
    base_angular_acceleration: Array  # (3,) rad/s^2
    joint_angles: Array  # (limb, joint) rad, of sliding joints m
    joint_rates: Array  # (limb, joint) rad/s, m/s
    joint_accelerations: Array  # (limb, joint) rad/s^2, m/s^2
    joint_targets: Array  # (limb, joint) rad, m
    joint_torque: Array  # (limb, joint) N m, N
    foot_position: Array  # (limb, 3) m
    foot_velocity: Array  # (limb, 3) m/s
    foot_target: Array  # (limb, 3) m
    foot_force: Array  # (limb, 3) N, of the ground on the foot
    foot_moment: Array  # (limb, 3) N m, of the ground on the foot
    grip_point: Array  # (limb, 3) m
    support: Array  # (limb,) bool: the gripper is shut and holds
    contact: Array  # (limb,) bool: the ground acts on the foot
    detached: Array  # (limb,) bool: the gripper was torn off before this step
    torn_off: Array  # (limb,) bool: it is torn off in this step
    missed: Array  # (limb,) bool: it shuts out of reach in this step
    reachable: Array  # (limb,) bool: the target was within the limb's reach
    sensor_lost: Array  # (limb,) bool: the law does without the foot's force sensor
    base_reference: Array  # (3,) m
    base_displacement: Array  # (6,) m, rad: shift of the base by the control law, reference axes
    base_wrench: Array  # (6,) N, N m: `J_b^T F_e`
    push: Array  # (6,) N, N m, on the base from outside
    cargo_mass: Array  # () kg
    center_of_mass: Array  # (3,) m, of robot and cargo
    tsm: Array  # () m
    gia_margin: Array  # () m/s^2
