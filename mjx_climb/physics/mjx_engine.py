"""The equations of motion by MJX's smooth stages: kinematics, composite inertia, factorisation, Newton-Euler, solve."""

import contextlib
import functools
import io
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.mujoco_import import mujoco
from mjx_climb.physics.kinematics import base_wrench_of_foot_force, foot_jacobian, limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.physics.state import Acceleration, State
from mjx_climb.robot.constants import Robot

with contextlib.redirect_stdout(io.StringIO()):  # mjx prints which optional backends are missing
    from mujoco import mjx
    from mujoco.mjx._src import smooth

_BASE = 1


@functools.cache
def _put_model(model: mujoco.MjModel, x64: bool) -> tuple[mjx.Model, mjx.Data]:
    del x64  # a key of the cache alone: the arrays take the precision in force
    with jax.ensure_compile_time_eval():
        return mjx.put_model(model), mjx.make_data(model)


def model_of(robot: Robot, cargo_mass: Array, gravity: Array, dtype: jnp.dtype) -> tuple[mjx.Model, mjx.Data]:
    """Return MJX's model of a robot with cargo on its base, () kg, under gravity (3,) m/s^2, and data for it.

    The armature is the robot's, (limb, joint) kg m^2, in place of the model's own.
    """

    def in_precision(leaf: Array) -> Array:
        return leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    model, data = jax.tree.map(in_precision, _put_model(robot.model, jnp.result_type(float) == jnp.float64))
    armature = 0.0 if robot.armature is None else jnp.asarray(robot.armature, dtype).ravel()
    loaded = model.replace(
        body_mass=model.body_mass.at[_BASE].add(cargo_mass),
        dof_armature=model.dof_armature.at[6:].set(armature),
        opt=model.opt.replace(gravity=gravity),
    )
    return loaded, data


def build(robot: Robot) -> Callable[[State, Array, Array, Array, Array, Array], Acceleration]:
    """Return MJX's forward dynamics of a robot: see `mjx_climb.physics.equations_of_motion.ForwardDynamics`."""

    def forward_dynamics(
        state: State, joint_torque: Array, foot_force: Array, base_wrench: Array, cargo_mass: Array, gravity: Array
    ) -> Acceleration:
        rotation = quaternion_to_matrix(state.base_orientation)
        frames = limb_frames(robot, rotation, state.joint_angles)
        wrench = base_wrench + base_wrench_of_foot_force(frames.foot, foot_force)
        joint_force = joint_torque + jnp.vecmat(foot_force, foot_jacobian(robot, frames))
        # MuJoCo's free joint: linear velocity in world axes, angular velocity in the body's own
        spin, moment = rotation.T @ state.base_angular_velocity, rotation.T @ wrench[3:]
        qpos = jnp.concatenate([state.base_position, state.base_orientation, state.joint_angles.ravel()])
        qvel = jnp.concatenate([state.base_linear_velocity, spin, state.joint_rates.ravel()])
        force = jnp.concatenate([wrench[:3], moment, joint_force.ravel()])

        model, data = model_of(robot, cargo_mass, gravity, qpos.dtype)
        data = data.replace(qpos=qpos, qvel=qvel)
        for stage in (smooth.kinematics, smooth.com_pos, smooth.crb, smooth.factor_m, smooth.com_vel, smooth.rne):
            data = stage(model, data)
        qacc = smooth.solve_m(model, data, force - data.qfrc_bias)
        return Acceleration(qacc[:3], rotation @ qacc[3:6], qacc[6:].reshape(state.joint_angles.shape))

    return forward_dynamics
