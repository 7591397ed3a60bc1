"""Forward dynamics behind one seam: state, torques and forces in, accelerations out.

An engine is one module with `build(robot) -> ForwardDynamics`, in the layout of the hot path; nothing outside this
package knows which one runs.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_climb.dynamics import limb_engine
from mjx_climb.dynamics.state import Acceleration, State, batch_last, joints_to_limbs, limbs_to_joints
from mjx_climb.robot.constants import Robot, load_robot
from mjx_climb.scenario.messages import ConfigError

# state, joint torque (N, L, B), foot force (3, L, B), base wrench (6, B), cargo mass (B,), gravity (3, B)
ForwardDynamics = Callable[[State, Array, Array, Array, Array, Array], Acceleration]


def _mjx(robot: Robot) -> ForwardDynamics:
    from mjx_climb.dynamics import mjx_engine  # takes longer to import than all the rest

    return mjx_engine.build(robot)


ENGINES: dict[str, Callable[[Robot], ForwardDynamics]] = {"mjx": _mjx, "limb": limb_engine.build}
DEFAULT_ENGINE = "limb"
ELEMENTWISE = {"limb"}  # engines made of elementwise operations throughout, which compile well in pieces
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
    """
    checked_engine(engine)
    robot = load_robot(robot) if isinstance(robot, str) else robot
    result: Acceleration = _forward_dynamics(state, tau, foot_force, base_wrench, cargo_mass, gravity, robot, engine)
    return result


@functools.partial(jax.jit, static_argnames="engine")
def _forward_dynamics(
    state: State,
    tau: ArrayLike,
    foot_force: ArrayLike,
    base_wrench: ArrayLike,
    cargo_mass: ArrayLike,
    gravity: ArrayLike | tuple[float, float, float],
    robot: Robot,
    engine: str,
) -> Acceleration:
    dtype = jnp.result_type(state.base_position)
    shape = state.base_position.shape[:-1]
    limbs, joints = len(robot.limbs), robot.joints

    def flat(value: ArrayLike | tuple[float, ...], *tail: int) -> Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype), (*shape, *tail)).reshape(-1, *tail)

    hot = batch_last(
        State(**{name: flat(value, value.shape[-1]) for name, value in vars(state).items()}),
        limbs,
    )
    result = ENGINES[engine](robot)(
        hot,
        joints_to_limbs(flat(tau, joints * limbs), limbs),
        jnp.moveaxis(flat(foot_force, limbs, 3), (0, 1, 2), (2, 1, 0)),
        flat(base_wrench, 6).T,
        flat(cargo_mass),
        flat(gravity, 3).T,
    )
    return Acceleration(
        base_linear=result.base_linear.T.reshape(*shape, 3),
        base_angular=result.base_angular.T.reshape(*shape, 3),
        joints=limbs_to_joints(result.joints).reshape(*shape, joints * limbs),
    )
