"""The equations of motion by MJX's smooth stages: kinematics, composite inertia, factorisation, Newton-Euler, solve."""

import contextlib
import functools
import io
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.dynamics.kinematics import (
    base_wrench_of_foot_force,
    foot_kinematics,
    joint_torque_of_foot_force,
    limb_frames,
)
from mjx_climb.dynamics.spatial import quaternion_to_matrix, rotate, rotate_back
from mjx_climb.dynamics.state import Acceleration, State, joints_to_limbs, limbs_to_joints
from mjx_climb.mujoco_import import mujoco
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


def _accelerations(
    model: mjx.Model,
    data: mjx.Data,
    qpos: Array,
    qvel: Array,
    force: Array,
    cargo_mass: Array,
    gravity: Array,
    armature: Array,
) -> Array:
    """Return MuJoCo's qacc (6 + joints,) of one robot: linear in world axes, angular in base axes, joints."""
    model = model.replace(
        body_mass=model.body_mass.at[_BASE].add(cargo_mass),
        dof_armature=model.dof_armature.at[6:].set(armature),
        opt=model.opt.replace(gravity=gravity),
    )
    data = data.replace(qpos=qpos, qvel=qvel)
    data = smooth.kinematics(model, data)
    data = smooth.com_pos(model, data)
    data = smooth.crb(model, data)
    data = smooth.factor_m(model, data)
    data = smooth.com_vel(model, data)
    data = smooth.rne(model, data)
    return jnp.asarray(smooth.solve_m(model, data, force - data.qfrc_bias))


def build(robot: Robot) -> Callable[[State, Array, Array, Array, Array, Array], Acceleration]:
    """Return MJX's forward dynamics of a robot in the layout of the hot path: see `ForwardDynamics`."""

    def forward_dynamics(
        state: State, torque: Array, foot_force: Array, base_wrench: Array, cargo_mass: Array, gravity: Array
    ) -> Acceleration:
        dtype = state.base_position.dtype
        model, data = _put_model(robot.model, jnp.result_type(float) == jnp.float64)
        model, data = (
            jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)
            for tree in (model, data)
        )
        rotation = quaternion_to_matrix(state.base_orientation)
        feet = foot_kinematics(robot, limb_frames(robot, rotation, state.joint_angles), state)
        wrench = base_wrench + base_wrench_of_foot_force(feet.lever, foot_force)
        joint_force = torque + joint_torque_of_foot_force(feet, foot_force)
        # MuJoCo's free joint: linear velocity in world axes, angular velocity in the body's own
        qpos = jnp.concatenate([state.base_position, state.base_orientation, limbs_to_joints(state.joint_angles).T])
        qvel = jnp.concatenate(
            [
                state.base_linear_velocity,
                rotate_back(rotation, state.base_angular_velocity),
                limbs_to_joints(state.joint_rates).T,
            ]
        )
        force = jnp.concatenate([wrench[:3], rotate_back(rotation, wrench[3:]), limbs_to_joints(joint_force).T])
        batch = qpos.shape[-1]
        cargo_mass = jnp.broadcast_to(cargo_mass, (batch,))
        gravity = jnp.broadcast_to(gravity, (3, batch))
        armature = jnp.zeros((), dtype) if robot.armature is None else jnp.asarray(robot.armature, dtype)
        armature = jnp.broadcast_to(armature, state.joint_angles.shape)
        qacc = jax.vmap(functools.partial(_accelerations, model, data), in_axes=-1, out_axes=-1)(
            qpos, qvel, force, cargo_mass, gravity, limbs_to_joints(armature).T
        )
        return Acceleration(
            base_linear=qacc[:3],
            base_angular=rotate(rotation, qacc[3:6]),
            joints=joints_to_limbs(qacc[6:].T, len(robot.limbs)),
        )

    return forward_dynamics
