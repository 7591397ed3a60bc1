"""The mechanical state, its accelerations, and a step of time."""

import dataclasses
from typing import ClassVar, NamedTuple

import jax
from jax import Array
from jaxtyping import Float

from mjx_climb.physics.spatial import quaternion_from_rotation_vector, quaternion_multiply, quaternion_normalize

# of one robot; at public functions with leading batch axes, and with joints in a row
_Vector = Float[Array, "*batch 3"]
_Joints = Float[Array, "*batch limb joint"] | Float[Array, "*batch joints"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """Configuration and velocity of the robot."""

    OF_LIMBS: ClassVar[tuple[str, ...]] = ("joint_angles", "joint_rates")  # whose first axis runs over the limbs

    base_position: _Vector  # m, world, of the base's centre of mass
    base_orientation: Float[Array, "*batch 4"]  # unit quaternion wxyz, base to world
    base_linear_velocity: _Vector  # m/s, world axes
    base_angular_velocity: _Vector  # rad/s, world axes
    joint_angles: _Joints  # rad, or m, from the base outwards
    joint_rates: _Joints  # rad/s, or m/s


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Acceleration:
    """The result of the equations of motion."""

    base_linear: _Vector  # m/s^2, world axes, of the base's centre of mass
    base_angular: _Vector  # rad/s^2, world axes
    joints: _Joints  # rad/s^2, or m/s^2


class Loads(NamedTuple):
    """The loads on a robot, beside the bias."""

    joint_torque: Array  # (limb, joint) N m, N of sliding joints
    foot_force: Array  # (limb, 3) N, of the ground, world axes
    base_wrench: Array  # (6,) N, N m, at the base's centre of mass, world axes
    cargo_mass: Array  # () kg, at the base's centre of mass
    gravity: Array  # (3,) m/s^2, world axes


def integrate(state: State, acceleration: Acceleration, time_step: float) -> State:
    """Advance a state by one step of semi-implicit Euler: velocities first, positions with the new velocities.

    The orientation turns by the exponential of the new angular velocity.
    """
    linear = state.base_linear_velocity + time_step * acceleration.base_linear
    angular = state.base_angular_velocity + time_step * acceleration.base_angular
    rates = state.joint_rates + time_step * acceleration.joints
    # in world axes, so the turn comes before the attitude
    turn = quaternion_from_rotation_vector(time_step * angular)
    return State(
        base_position=state.base_position + time_step * linear,
        base_orientation=quaternion_normalize(quaternion_multiply(turn, state.base_orientation)),
        base_linear_velocity=linear,
        base_angular_velocity=angular,
        joint_angles=state.joint_angles + time_step * rates,
        joint_rates=rates,
    )
