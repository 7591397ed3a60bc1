"""Forward dynamics of a base with limbs, each a chain of joints.

The limbs meet in the base alone, so the mass matrix is an arrow: a 6 x 6 block of the base, an N x N block for each
limb of N joints and 6 x N couplings between them. Each limb is eliminated by its own block, and a 6 x 6 Schur
complement is left for the base. The mass matrix comes from composite rigid bodies, the bias from recursive
Newton-Euler at zero acceleration. All in the base's axes, where the mass matrix depends on the joints alone; moments
about the base's centre of mass.

References:
    R. Featherstone, Rigid Body Dynamics Algorithms, 2008: chapters 5 and 6.
    J. Carpentier, N. Mansard, Analytical Derivatives of Rigid Body Dynamics Algorithms, 2018.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.numpy import cross

from mjx_climb.physics.inverse_dynamics import Forces, Limb, limbs_of, missing_forces
from mjx_climb.physics.kinematics import JointAxes, LimbFrames, joint_axes, limb_frames
from mjx_climb.physics.spatial import inverse_3x3, quaternion_to_matrix, skew, solve_symmetric, symmetric
from mjx_climb.physics.state import Acceleration, Loads, State
from mjx_climb.robot.constants import Robot

_Three = tuple[Array, Array, Array]
Primals = tuple[Robot, State, *tuple[Array, ...]]  # robot, state and the fields of `Loads`
Tangents = tuple[object, ...]  # of these, with a `SymbolicZero` for each array that does not move


class Factors(NamedTuple):
    """The mass matrix, factorised: joints first, then the base by blocks `[A C; C^T D]`."""

    joints: Array  # (limb, N, N), inverse of the block of a limb's joints
    force: Array  # (limb, 3, N), coupling times that inverse: force on the base
    moment: Array  # (limb, 3, N)
    linear: Array  # (3, 3), A^-1
    columns: Array  # (3, 3), A^-1 C
    angular: Array  # (3, 3), (D - C^T A^-1 C)^-1


def factorized(robot: Robot, joint_angles: Array, cargo_mass: Array) -> Factors:
    """Return the factors of the mass matrix, for joint angles (limb, joint) rad and a cargo () kg."""
    frames = limb_frames(robot, None, joint_angles)
    joints, blocks = jax.vmap(eliminated)(limbs_of(robot), frames, joint_axes(robot, frames))
    linear, mixed, angular = (block.sum(0) for block in blocks)
    linear = inverse_3x3((robot.base_mass + cargo_mass) * jnp.eye(3, dtype=joint_angles.dtype) + linear)
    columns = linear @ mixed
    return Factors(*joints, linear, columns, inverse_3x3(robot.base_inertia + angular - mixed.T @ columns))


def eliminated(limb: Limb, frames: LimbFrames, axes: JointAxes) -> tuple[_Three, _Three]:
    """The factors of a limb's joints, and the Schur complement on the base: its inertia less the joints' part.

    The former are the first three of `Factors`, the latter the blocks A, C, D of the mass matrix (3, 3).
    """
    links, angular = range(len(limb.mass)), axes.angular
    linear = cross(frames.position, angular)  # motion at the base's centre of mass per rate, as `angular`
    if axes.linear is not None:
        linear = linear + axes.linear
    body: _Three | None = None
    forces, moments, mass = {}, {}, {}
    # composite rigid bodies (Featherstone, section 6.2): all that is beyond a joint moves as one
    for j in reversed(links):
        turn, mass_of_link = frames.rotation[j], limb.mass[j]
        center = frames.position[j] + turn @ limb.center[j]
        moment, inertia = mass_of_link * center, symmetric(turn @ limb.inertia[j] @ turn.T)
        # m, h = m c, and I about the base's centre of mass by the parallel-axis theorem
        link = mass_of_link, moment, symmetric(inertia - skew(moment) @ skew(center))
        m, h, inertia = body = link if body is None else jax.tree.map(jnp.add, body, link)
        forces[j] = m * linear[j] + cross(angular[j], h)
        moments[j] = inertia @ angular[j] + cross(h, linear[j])
        for i in range(j + 1):
            mass[i, j] = mass[j, i] = jnp.dot(angular[i], moments[j]) + jnp.dot(linear[i], forces[j])
        if limb.armature is not None:
            mass[j, j] = mass[j, j] + limb.armature[j]
    size = len(links)
    block = jnp.stack([mass[i, j] for i in links for j in links]).reshape(size, size)
    inverse = inverse_3x3(block) if size == 3 else solve_symmetric(block, jnp.eye(size, dtype=block.dtype))
    force, moment = (jnp.stack([column[j] for j in links], axis=1) for column in (forces, moments))
    force_way, moment_way = force @ inverse, moment @ inverse
    # the Schur complement of the joints' block
    left = (
        m * jnp.eye(3, dtype=force.dtype) - symmetric(force_way @ force.T),
        -skew(h) - force_way @ moment.T,
        inertia - symmetric(moment_way @ moment.T),
    )
    return (inverse, force_way, moment_way), left


def accelerations(factors: Factors, forces: Forces) -> _Three:
    """Return the accelerations `H^-1 f` of generalised forces, in the base's axes: the fields of an `Acceleration`."""
    # the limbs' forces pass to the base, less those that only accelerate their joints; then the base by its blocks
    force = forces.force + (forces.limb_force - jnp.matvec(factors.force, forces.joint)).sum(0)
    moment = forces.moment + (forces.limb_moment - jnp.matvec(factors.moment, forces.joint)).sum(0)
    angular = factors.angular @ (moment - factors.columns.T @ force)
    linear = factors.linear @ force - factors.columns @ angular
    # back substitution: the joints' own forces, less those for the base's acceleration
    joints = jnp.matvec(factors.joints, forces.joint) - linear @ factors.force - angular @ factors.moment
    return linear, angular, joints


def build(robot: Robot) -> Callable[[State, Array, Array, Array, Array, Array], Acceleration]:
    """Return the forward dynamics of a robot: see `mjx_climb.physics.equations_of_motion.ForwardDynamics`."""

    def forward_dynamics(state: State, *acting: Array) -> Acceleration:
        return Acceleration(*_forward_dynamics(robot, state, *acting))

    return forward_dynamics


def solved(robot: Robot, state: State, loads: Loads) -> tuple[Factors, tuple[Array, ...]]:
    """Return the factors of the mass matrix and the accelerations (paper Eq. 1), in world axes."""
    still = Acceleration(*map(jnp.zeros_like, (loads.gravity, loads.gravity, loads.joint_torque)))
    factors = factorized(robot, state.joint_angles, loads.cargo_mass)
    return factors, _in_world_axes(state, *accelerations(factors, missing_forces(robot, state, still, loads)))


def _in_world_axes(state: State, linear: Array, angular: Array, joints: Array) -> _Three:
    rotation = quaternion_to_matrix(state.base_orientation)
    return rotation @ linear, rotation @ angular, joints


# of a plain tuple: JAX makes trees of texts like the result, which no `Acceleration` can hold while types are checked
@jax.custom_jvp
def _forward_dynamics(robot: Robot, state: State, *acting: Array) -> tuple[Array, ...]:
    return solved(robot, state, Loads(*acting))[1]


@functools.partial(_forward_dynamics.defjvp, symbolic_zeros=True)
def _jvp(primals: Primals, tangents: Tangents) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return the accelerations and their tangents: `M^-1` times the tangents of the forces missing at them.

    So the mass matrix and its factors need no derivatives (Carpentier and Mansard). Orientations stay of unit length.
    """
    robot, state, *acting = primals
    factors, acceleration = solved(robot, state, Loads(*acting))
    # the missing terms are zero, with those of the turn of the base's axes
    change = missing_change(primals, tangents, Acceleration(*acceleration))
    return acceleration, _in_world_axes(state, *accelerations(factors, change))


def missing_change(primals: Primals, tangents: Tangents, acceleration: Acceleration) -> Forces:
    """Return the tangents of the forces that are missing at accelerations which stay as they are."""
    leaves, tree = jax.tree.flatten(primals)
    directions = jax.tree.leaves(tangents, is_leaf=lambda tangent: isinstance(tangent, SymbolicZero))
    moving = [place for place, direction in enumerate(directions) if not isinstance(direction, SymbolicZero)]

    def missing(values: list[Array]) -> Forces:
        every = list(leaves)
        for place, value in zip(moving, values, strict=True):
            every[place] = value
        robot, state, *acting = jax.tree.unflatten(tree, every)
        return missing_forces(robot, state, acceleration, Loads(*acting))

    change: Forces
    _, change = jax.jvp(missing, ([leaves[place] for place in moving],), ([directions[place] for place in moving],))
    return change
