"""Forward dynamics of a robot whose base is held still, its feet in the air: each limb is a robot of its own."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.physics.inverse_dynamics import limbs_of, load_torque
from mjx_climb.physics.kinematics import joint_axes, limb_frames
from mjx_climb.physics.limb_engine import Primals, Tangents, eliminated, missing_change
from mjx_climb.physics.state import Acceleration, Loads, State
from mjx_climb.robot.constants import Robot


def held_accelerations(robot: Robot, state: State, joint_torque: Array, gravity: Array) -> Array:
    """Return the joints' accelerations (limb, joint) rad/s^2 of a robot whose base is held still, its feet in the air.

    Each limb is then a robot of its own, `H qdd + c = tau`; `joint_torque` is (limb, joint) N m, `gravity` (3,) m/s^2
    in world axes.
    """
    still = jnp.zeros_like(gravity)
    loads = Loads(joint_torque, jnp.zeros_like(robot.foot_center), jnp.zeros_like(gravity, shape=6), still[0], gravity)
    state = dataclasses.replace(state, base_linear_velocity=still, base_angular_velocity=still)
    return jnp.asarray(_held(robot, state, *loads))


def held_mobility(robot: Robot, state: State) -> Array:
    """Return the inverse of each limb's mass matrix (limb, N, N) 1/(kg m^2), the base held still."""
    frames = limb_frames(robot, None, state.joint_angles)
    (inverse, *_), _ = jax.vmap(eliminated)(limbs_of(robot), frames, joint_axes(robot, frames))
    return jnp.asarray(inverse)


@jax.custom_jvp
def _held(robot: Robot, state: State, *acting: Array) -> Array:
    return _held_solved(robot, state, Loads(*acting))[1]


def _held_solved(robot: Robot, state: State, loads: Loads) -> tuple[Array, Array]:
    """Return the inverse of each limb's mass matrix (limb, N, N), and the accelerations of the joints."""
    inverse = held_mobility(robot, state)
    return inverse, jnp.matvec(inverse, load_torque(robot, state, loads))


@functools.partial(_held.defjvp, symbolic_zeros=True)
def _held_jvp(primals: Primals, tangents: Tangents) -> tuple[Array, Array]:
    """Return the joints' accelerations and their tangents, as those of `limb_engine`."""
    robot, state, *acting = primals
    inverse, joints = _held_solved(robot, state, Loads(*acting))
    still = jnp.zeros_like(state.base_position)
    change = missing_change(primals, tangents, Acceleration(still, still, joints))
    return joints, jnp.matvec(inverse, change.joint)
