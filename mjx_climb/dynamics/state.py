"""The mechanical state and its time derivative, in both layouts."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from mjx_climb.dynamics.spatial import quaternion_from_rotation_vector, quaternion_multiply, quaternion_normalize

# with leading batch axes, joints limb by limb or not; or in the layout of the hot path, stacked over time or not
_Vector = Float[Array, "*batch 3"] | Float[Array, "*time 3 B"]
_Quaternion = Float[Array, "*batch 4"] | Float[Array, "*time 4 B"]
_Joints = Float[Array, "*batch joints"] | Float[Array, "*batch N L"] | Float[Array, "*time N L B"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """Configuration and velocity of the robot; any leading batch axes, the same for every field."""

    base_position: _Vector  # m, world, of the base's centre of mass
    base_orientation: _Quaternion  # unit quaternion wxyz, base to world
    base_linear_velocity: _Vector  # m/s, world axes
    base_angular_velocity: _Vector  # rad/s, world axes
    joint_angles: _Joints  # rad, or m, limb after limb, from the base outwards
    joint_rates: _Joints  # rad/s, or m/s


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Acceleration:
    """What the equations of motion give; leading batch axes as in the state."""

    base_linear: _Vector  # m/s^2, world axes, of the base's centre of mass
    base_angular: _Vector  # rad/s^2, world axes
    joints: _Joints  # rad/s^2, or m/s^2


def joints_to_limbs(joints: Array, limbs: int) -> Array:
    """Turn joint values (B, L N) of robots with L limbs of N joints into the layout of the hot path, (N, L, B)."""
    return jnp.moveaxis(joints.reshape(joints.shape[0], limbs, -1), (0, 1, 2), (2, 1, 0))


def limbs_to_joints(limbs: Array) -> Array:
    """Turn joint values (N, L, B) of the hot path into (B, L N)."""
    return jnp.moveaxis(limbs, (0, 1, 2), (2, 1, 0)).reshape(limbs.shape[2], -1)


def batch_last(state: State, limbs: int) -> State:
    """Turn a state with one leading batch axis into the layout of the hot path: (3, B), (4, B), joints (N, L, B)."""
    moved = {
        field.name: joints_to_limbs(value, limbs) if field.name.startswith("joint") else jnp.moveaxis(value, 0, -1)
        for field in dataclasses.fields(state)
        for value in [getattr(state, field.name)]
    }
    return State(**moved)


def integrate(state: State, acceleration: Acceleration, time_step: float) -> State:
    """Advance a state by one step of semi-implicit Euler: velocities first, positions with the new velocities.

    The orientation turns by the exponential of the new angular velocity. Layout of the hot path.
    """
    linear = state.base_linear_velocity + time_step * acceleration.base_linear
    angular = state.base_angular_velocity + time_step * acceleration.base_angular
    rates = state.joint_rates + time_step * acceleration.joints
    turn = quaternion_from_rotation_vector(time_step * angular)
    return State(
        base_position=state.base_position + time_step * linear,
        base_orientation=quaternion_normalize(quaternion_multiply(turn, state.base_orientation)),
        base_linear_velocity=linear,
        base_angular_velocity=angular,
        joint_angles=state.joint_angles + time_step * rates,
        joint_rates=rates,
    )
