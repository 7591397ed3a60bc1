"""Forward dynamics behind one seam: state, torques and forces in, accelerations out.

An engine is one module with `build(robot) -> ForwardDynamics`, for one robot; nothing outside this package knows which
one runs.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import cast

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_climb.physics import limb_engine
from mjx_climb.physics.state import Acceleration, Loads, State
from mjx_climb.robot.constants import Robot, load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.shapes import check_shape

# state, joint torque (limb, joint), foot force (limb, 3), base wrench (6,), cargo mass (), gravity (3,)
ForwardDynamics = Callable[[State, Array, Array, Array, Array, Array], Acceleration]


def _mjx(robot: Robot) -> ForwardDynamics:
    from mjx_climb.physics import mjx_engine  # takes longer to import than all the rest

    return mjx_engine.build(robot)


ENGINES: dict[str, Callable[[Robot], ForwardDynamics]] = {"mjx": _mjx, "limb": limb_engine.build}
DEFAULT_ENGINE = "limb"
STANDARD_GRAVITY = (0.0, 0.0, -9.81)


def checked_engine(name: str) -> str:
    """Return the name of an engine as it is.

    Raises:
        ConfigError: no such engine.
    """
    if name not in ENGINES:
        raise ConfigError(f"engine: expected one of {', '.join(ENGINES)}, got {name!r}")
    return name


def forward_dynamics(
    state: State,
    tau: ArrayLike,
    foot_force: ArrayLike,
    base_wrench: ArrayLike,
    cargo_mass: ArrayLike,
    *,
    gravity: ArrayLike | tuple[float, float, float] = STANDARD_GRAVITY,
    robot: str | Robot = "hubrobo_v3_2",
    engine: str = DEFAULT_ENGINE,
) -> Acceleration:
    """Solve the equations of motion for the accelerations (paper Eq. 1).

    Arguments:
        state: with any leading batch axes, or none.
        tau: joint torques (..., joints) N m, forces N of sliding joints, limb after limb.
        foot_force: force of the ground on each foot (..., limbs, 3) N, world axes.
        base_wrench: force and moment on the base at its centre of mass (..., 6) N and N m, world axes.
        cargo_mass: point mass at the base's centre of mass (...,) kg.
        gravity: (..., 3) m/s^2, world axes.
        robot: name of a robot or its constants.
        engine: one of `mjx_climb.ENGINES`.

    Raises:
        ConfigError: no such engine.
        ValueError: a state or loads of another shape.
    """
    checked_engine(engine)
    robot = load_robot(robot) if isinstance(robot, str) else robot
    sizes, batch = {"limbs": len(robot.limbs), "joints": robot.joint_lower.size}, jnp.shape(state.base_position)[:-1]
    own = zip(vars(state), ("3", "4", "3", "3", "joints", "joints"), strict=True)
    dims = {f"state.{name}": (getattr(state, name), each) for name, each in own}
    dims |= {"tau": (tau, "joints"), "foot_force": (foot_force, "limbs 3"), "base_wrench": (base_wrench, "6")}
    for name, (value, each) in (dims | {"cargo_mass": (cargo_mass, ""), "gravity": (gravity, "3")}).items():
        check_shape(name, jnp.shape(value), each, sizes, batch)
    loads = Loads(*(jnp.asarray(load) for load in (tau, foot_force, base_wrench, cargo_mass, gravity)))
    return cast(Acceleration, _forward_dynamics(state, loads, robot, engine))


@functools.partial(jax.jit, static_argnames="engine")
def _forward_dynamics(state: State, loads: Loads, robot: Robot, engine: str) -> Acceleration:
    dtype, shape = jnp.result_type(state.base_position), jnp.shape(state.base_position)[:-1]
    joints = (len(robot.limbs), robot.joints)
    solve = ENGINES[engine](robot)

    def alone(state: State, loads: Loads) -> Acceleration:
        angles, rates = state.joint_angles.reshape(joints), state.joint_rates.reshape(joints)
        state = dataclasses.replace(state, joint_angles=angles, joint_rates=rates)
        result = solve(state, loads.joint_torque.reshape(joints), *loads[1:])
        return dataclasses.replace(result, joints=result.joints.ravel())

    def in_batch(value: Array, *own: int) -> Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype), (*shape, *own)).reshape(-1, *own)

    batch = jax.tree.map(lambda value: in_batch(value, value.shape[-1]), state)
    own: list[tuple[int, ...]] = [(math.prod(joints),), (joints[0], 3), (6,), (), (3,)]  # shapes of one robot's
    acting = Loads(*(in_batch(load, *size) for load, size in zip(loads, own, strict=True)))
    # XLA's default for float32 on a GPU is TF32, of ten bits
    with jax.default_matmul_precision("highest"):
        result = jax.vmap(alone)(batch, acting)
    return cast(Acceleration, jax.tree.map(lambda value: value.reshape(*shape, *value.shape[1:]), result))
