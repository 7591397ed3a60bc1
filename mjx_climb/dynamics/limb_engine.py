"""Forward dynamics of a base with limbs, each a chain of joints.

The limbs meet in the base alone, so the mass matrix is an arrow: a 6 x 6 block of the base, an N x N block for each
limb of N joints and 6 x N couplings between them. Each limb is eliminated by its own block, and a 6 x 6 Schur
complement is left for the base. The bias comes from recursive Newton-Euler, the mass matrix from composite rigid
bodies. All in world axes, as the kinematics of a step, which are then worked out once; moments about the base's centre
of mass.

References:
    R. Featherstone, Rigid Body Dynamics Algorithms, 2008: chapters 5 and 6.
    J. Carpentier, N. Mansard, Analytical Derivatives of Rigid Body Dynamics Algorithms, 2018.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.numpy import cross

from mjx_climb.dynamics.inverse_dynamics import Forces, Limb, limbs_of, missing_forces
from mjx_climb.dynamics.kinematics import JointAxes, LimbFrames, joint_axes, limb_frames
from mjx_climb.dynamics.spatial import AnyArray, inverse_3x3, quaternion_to_matrix, skew, solve_symmetric
from mjx_climb.dynamics.state import Acceleration, State
from mjx_climb.robot.constants import Robot


class Symmetric(NamedTuple):
    """A symmetric matrix (3, 3) by its six elements."""

    diagonal: Array  # (3,): xx, yy, zz
    mixed: Array  # (3,): xy, yz, zx

    @property
    def matrix(self) -> Array:
        """The matrix (3, 3)."""
        (xx, yy, zz), (xy, yz, zx) = self.diagonal, self.mixed
        return jnp.stack([xx, xy, zx, xy, yy, yz, zx, yz, zz]).reshape(3, 3)


class Inertia(NamedTuple):
    """Rigid-body inertia about the base's centre of mass: m, h = m c, I."""

    mass: Array  # () kg
    moment: Array  # (3,) kg m
    rotational: Symmetric  # kg m^2


class LimbDynamics(NamedTuple):
    """A limb's part of the equations of motion: `M qdd + bias`."""

    inertia: Inertia  # of all its links
    joints: Array  # (N, N), block of its joints in the mass matrix
    force: Array  # (3, N), coupling: force on the base per acceleration of a joint
    moment: Array  # (3, N)
    joint_bias: Array  # (N,) N m, forces at zero acceleration, those on the foot among them
    force_bias: Array  # (3,) N, on the base
    moment_bias: Array  # (3,) N m


class Factors(NamedTuple):
    """The mass matrix, factorised: joints first, then the base by blocks `[A C; C^T D]`."""

    joints: Array  # (limb, N, N), inverses of the limbs' blocks
    force: Array  # (limb, 3, N), couplings
    moment: Array  # (limb, 3, N)
    linear: Array  # (3, 3), A^-1
    columns: Array  # (3, 3), A^-1 C
    angular: Array  # (3, 3), (D - C^T A^-1 C)^-1


def limb_dynamics(
    limb: Limb,
    frames: LimbFrames,
    axes: JointAxes,
    rates: Array,
    foot_force: Array,
    armature: AnyArray,
    base_angular_velocity: Array,
    gravity: Array,
) -> LimbDynamics:
    """Return what one limb contributes, for joint rates (N,) and a force on its foot (3,) N."""
    links = range(len(limb.mass))
    omega, alpha, acceleration = base_angular_velocity, jnp.zeros_like(gravity), -gravity
    inertias, forces, moments = [], [], []
    for i in links:  # outward: recursive Newton-Euler with all accelerations at zero
        arm = frames.position[i] - (frames.position[i - 1] if i else 0.0)
        acceleration = acceleration + cross(alpha, arm) + cross(omega, cross(omega, arm))
        if axes.linear is not None:
            acceleration = acceleration + cross(omega, 2 * rates[i] * axes.linear[i])
        spin = axes.angular[i] * rates[i]
        alpha = alpha + cross(omega, spin)
        omega = omega + spin

        offset = frames.rotation[i] @ limb.center[i]
        own = rotated(limb.inertia[i], frames.rotation[i])
        center = frames.position[i] + offset
        force = limb.mass[i] * (acceleration + cross(alpha, offset) + cross(omega, cross(omega, offset)))
        forces.append(force)
        moments.append(own.matrix @ alpha + cross(omega, own.matrix @ omega) + cross(center, force))
        inertias.append(about_base(limb.mass[i], center, own))

    body, force, moment = inertias[-1], forces[-1] - foot_force, moments[-1] - cross(frames.foot, foot_force)
    angular, linear = axes.angular, cross(frames.position, axes.angular)  # motion at the base's centre per rate
    if axes.linear is not None:
        linear = linear + axes.linear
    bias, mass, force_column, moment_column = {}, {}, {}, {}
    for j in reversed(links):  # inward: composite rigid bodies, and the bias on each joint
        if j < links[-1]:
            body, force, moment = jax.tree.map(jnp.add, (body, force, moment), (inertias[j], forces[j], moments[j]))
        bias[j] = jnp.dot(angular[j], moment) + jnp.dot(linear[j], force)
        force_column[j] = body.mass * linear[j] + cross(angular[j], body.moment)
        moment_column[j] = body.rotational.matrix @ angular[j] + cross(body.moment, linear[j])
        for i in range(j + 1):
            mass[i, j] = mass[j, i] = jnp.dot(angular[i], moment_column[j]) + jnp.dot(linear[i], force_column[j])
        if armature is not None:
            mass[j, j] = mass[j, j] + armature[j]
    joints = jnp.stack([mass[i, j] for i in links for j in links]).reshape(len(links), len(links))
    force_columns, moment_columns = (jnp.stack([c[j] for j in links], axis=1) for c in (force_column, moment_column))
    joint_bias = jnp.stack([bias[j] for j in links])
    return LimbDynamics(body, joints, force_columns, moment_columns, joint_bias, force, moment)


def rotated(inertia: AnyArray, rotation: Array) -> Symmetric:
    """Return `R I R^T` of an inertia (3, 3)."""
    product = rotation @ inertia
    return Symmetric(jnp.vecdot(product, rotation), jnp.vecdot(product, jnp.roll(rotation, -1, axis=0)))


def about_base(mass: Array, center: Array, inertia: Symmetric) -> Inertia:
    """Return the inertia about the base of a body at `center`, by the parallel-axis theorem."""
    moment = mass * center
    diagonal = inertia.diagonal + jnp.dot(moment, center) - moment * center
    return Inertia(mass, moment, Symmetric(diagonal, inertia.mixed - moment * jnp.roll(center, -1)))


def equations(
    robot: Robot,
    state: State,
    joint_torque: Array,
    foot_force: Array,
    base_wrench: Array,
    cargo_mass: Array,
    gravity: Array,
) -> tuple[Factors, Forces]:
    """Return the mass matrix, factorised, and what acts less the bias. Arguments as those of `ForwardDynamics`."""
    rotation, omega = quaternion_to_matrix(state.base_orientation), state.base_angular_velocity
    frames = limb_frames(robot, rotation, state.joint_angles)
    limbs = jax.vmap(limb_dynamics, in_axes=(0, 0, 0, 0, 0, 0, None, None))(
        limbs_of(robot),
        frames,
        joint_axes(robot, frames),
        state.joint_rates,
        foot_force,
        robot.armature,
        omega,
        gravity,
    )
    base_mass, base_inertia = robot.base_mass + cargo_mass, rotated(robot.base_inertia, rotation).matrix
    forces = Forces(
        joint=joint_torque - limbs.joint_bias,
        force=base_wrench[:3] + base_mass * gravity - limbs.force_bias.sum(0),
        moment=base_wrench[3:] - cross(omega, base_inertia @ omega) - limbs.moment_bias.sum(0),
    )

    # Schur complement on the base: what each limb adds, less what its joints give way
    inverse, inertia = jax.vmap(_inverse)(limbs.joints), jax.tree.map(lambda part: part.sum(0), limbs.inertia)
    force, moment = limbs.force @ inverse, limbs.moment @ inverse
    mass = (base_mass + inertia.mass) * jnp.eye(3, dtype=force.dtype)
    linear = inverse_3x3(mass - (force @ limbs.force.mT).sum(0))
    mixed = -skew(inertia.moment) - (force @ limbs.moment.mT).sum(0)
    angular = base_inertia + inertia.rotational.matrix - (moment @ limbs.moment.mT).sum(0)
    columns = linear @ mixed
    angular = inverse_3x3(angular - mixed.T @ columns)
    return Factors(inverse, limbs.force, limbs.moment, linear, columns, angular), forces


def _inverse(matrix: Array) -> Array:
    size = len(matrix)
    return inverse_3x3(matrix) if size == 3 else solve_symmetric(matrix, jnp.eye(size, dtype=matrix.dtype))


def accelerations(factors: Factors, forces: Forces) -> tuple[Array, Array, Array]:
    """Return what generalised forces accelerate: the fields of an `Acceleration`."""
    freed = jnp.matvec(factors.joints, forces.joint)
    force = forces.force - jnp.matvec(factors.force, freed).sum(0)
    moment = forces.moment - jnp.matvec(factors.moment, freed).sum(0)
    angular = factors.angular @ (moment - factors.columns.T @ force)
    linear = factors.linear @ force - factors.columns @ angular
    given_way = linear @ factors.force + angular @ factors.moment
    return linear, angular, jnp.matvec(factors.joints, forces.joint - given_way)


def build(robot: Robot) -> Callable[[State, Array, Array, Array, Array, Array], Acceleration]:
    """Return the forward dynamics of a robot: see `mjx_climb.dynamics.ForwardDynamics`."""

    def forward_dynamics(state: State, *acting: Array) -> Acceleration:
        return Acceleration(*_forward_dynamics(robot, state, *acting))

    return forward_dynamics


# of a plain tuple: JAX makes trees of texts like the result, which no `Acceleration` can hold while types are checked
@jax.custom_jvp
def _forward_dynamics(robot: Robot, state: State, *acting: Array) -> tuple[Array, ...]:
    return accelerations(*equations(robot, state, *acting))


@functools.partial(_forward_dynamics.defjvp, symbolic_zeros=True)
def _jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return the accelerations and their tangents: `M^-1` times the tangents of the forces missing at them.

    So the mass matrix and its factors need no derivatives (Carpentier and Mansard). Orientations stay of unit length.
    """
    factors, forces = equations(*primals)
    acceleration = accelerations(factors, forces)
    leaves, tree = jax.tree.flatten(primals)
    directions = jax.tree.leaves(tangents, is_leaf=_is_zero)
    moving = [place for place, direction in enumerate(directions) if not _is_zero(direction)]

    def missing(values: list[Array]) -> Forces:
        every = list(leaves)
        for place, value in zip(moving, values, strict=True):
            every[place] = value
        robot, state, *acting = jax.tree.unflatten(tree, every)
        return missing_forces(robot, state, Acceleration(*acceleration), *acting)

    _, change = jax.jvp(missing, ([leaves[place] for place in moving],), ([directions[place] for place in moving],))
    to_world = quaternion_to_matrix(primals[1].base_orientation)  # what is missing is zero: so is what its turn adds
    change = Forces(change.joint, to_world @ change.force, to_world @ change.moment)
    return acceleration, accelerations(factors, change)


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)
