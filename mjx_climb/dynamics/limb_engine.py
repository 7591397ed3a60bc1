"""The equations of motion written for what the robot is: a base with limbs, each a chain of joints.

The limbs meet in the base alone, so the mass matrix is an arrow: a 6 x 6 block of the base, an N x N block for each
limb of N joints and 6 x N couplings between them. Composite inertias and Newton-Euler run per limb, the limbs are
eliminated with N x N factors, written out, and a 6 x 6 Schur complement is left for the base (Featherstone, Rigid Body
Dynamics Algorithms, 2008: chapters 5 and 6). Everything is elementwise over (limb, batch). World axes; moments about
the base's centre of mass.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from mjx_climb.dynamics.inverse_dynamics import Forces, Wrench, missing_forces
from mjx_climb.dynamics.kinematics import LimbFrames, limb_frames
from mjx_climb.dynamics.spatial import chosen, compose, cross, dot, quaternion_to_matrix, rotate, rotate_back
from mjx_climb.dynamics.state import Acceleration, State
from mjx_climb.robot.constants import Robot

_Parts = tuple[Array, Array, Array]  # of an `Acceleration`, as JAX can take it apart


class Inertia(NamedTuple):
    """Rigid-body inertia about the base's centre of mass: m, h = m c, and I as xx, yy, zz, xy, xz, yz."""

    mass: Array  # (...) kg
    moment: Array  # (3, ...) kg m
    rotational: Array  # (6, ...) kg m^2

    def plus(self, other: "Inertia") -> "Inertia":
        return Inertia(self.mass + other.mass, self.moment + other.moment, self.rotational + other.rotational)


def symmetric_times(symmetric: Array, vector: Array) -> Array:
    """Return the product of a symmetric matrix (xx, yy, zz, xy, xz, yz) and a vector."""
    xx, yy, zz, xy, xz, yz = symmetric
    x, y, z = vector
    return jnp.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])


def rotated_inertia(rotation: Array, inertia: Array | np.ndarray) -> Array:
    """Return `R I R^T` of a symmetric I (3, 3, ...), as xx, yy, zz, xy, xz, yz."""
    product = compose(rotation, inertia)
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return jnp.stack([dot(product[i], rotation[j]) for i, j in pairs])


def about_base(mass: Array, center: Array, rotational: Array) -> Inertia:
    """Return the inertia about the base of a body with `rotational` (6, ...) about its own centre of mass `center`."""
    moment = mass * center
    x, y, z = center
    hx, hy, hz = moment
    shift = jnp.stack([hy * y + hz * z, hx * x + hz * z, hx * x + hy * y, -hx * y, -hx * z, -hy * z])
    return Inertia(mass, moment, rotational + shift)


def momentum(inertia: Inertia, linear: Array, angular: Array) -> Wrench:
    """Return the momentum of a body whose point at the base's centre of mass moves with `linear`, about that point."""
    return Wrench(
        inertia.mass * linear + cross(angular, inertia.moment),
        symmetric_times(inertia.rotational, angular) + cross(inertia.moment, linear),
    )


class Limbs(NamedTuple):
    """Mass matrix and bias of the limbs, all of it (..., L, B)."""

    inertia: Inertia  # of each whole limb
    bias: Wrench  # on the base, of what the ground does to the feet too
    joint_bias: Array  # (N, L, B) N m
    joint_mass: dict[tuple[int, int], Array]  # M_jj, upper triangle
    coupling: list[Wrench]  # M_bj, a column for each joint


def joint_motion(robot: Robot, frames: LimbFrames, joint: int) -> tuple[Array, Array]:
    """Return the motion of the links beyond a joint per unit of its rate: angular, and linear at the base's centre."""
    axis, slides = frames.rotation[joint][:, 2], robot.sliding(joint)
    turning = cross(frames.position[joint], frames.rotation[joint][:, 2])
    if slides is None:
        return axis, turning
    return chosen(slides, jnp.zeros_like(axis), axis), chosen(slides, axis, turning)


def limb_dynamics(robot: Robot, frames: LimbFrames, state: State, foot_force: Array, gravity: Array) -> Limbs:
    """Return what the limbs contribute: Newton-Euler outward with the accelerations at zero, composites inward."""
    angular_velocity = state.base_angular_velocity[:, None]
    angular_acceleration = jnp.zeros_like(angular_velocity)
    anchor_acceleration = -gravity[:, None]
    anchor = jnp.zeros_like(angular_velocity)
    inertias, forces = [], []
    for link in range(robot.joints):
        axis, position = frames.rotation[link][:, 2], frames.position[link]
        arm = position - anchor
        anchor_acceleration = (
            anchor_acceleration
            + cross(angular_acceleration, arm)
            + cross(angular_velocity, cross(angular_velocity, arm))
        )
        anchor = position
        spin = axis * state.joint_rates[link]
        if (slides := robot.sliding(link)) is not None:
            coriolis = 2 * cross(angular_velocity, spin)
            anchor_acceleration = anchor_acceleration + chosen(slides, coriolis, jnp.zeros_like(coriolis))
            spin = chosen(slides, jnp.zeros_like(spin), spin)
        angular_acceleration = angular_acceleration + cross(angular_velocity, spin)
        angular_velocity = angular_velocity + spin

        offset = rotate(frames.rotation[link], robot.link_center[link])
        rotational = rotated_inertia(frames.rotation[link], robot.link_inertia[link])
        acceleration = (
            anchor_acceleration
            + cross(angular_acceleration, offset)
            + cross(angular_velocity, cross(angular_velocity, offset))
        )
        force = robot.link_mass[link] * acceleration
        moment = symmetric_times(rotational, angular_acceleration) + cross(
            angular_velocity, symmetric_times(rotational, angular_velocity)
        )
        center = position + offset
        inertias.append(about_base(robot.link_mass[link], center, rotational))
        forces.append(Wrench(force, moment + cross(center, force)))

    composite = inertias[-1]
    bias = Wrench(forces[-1].force - foot_force, forces[-1].moment - cross(frames.foot, foot_force))
    joint_bias: dict[int, Array] = {}
    joint_mass: dict[tuple[int, int], Array] = {}
    coupling: dict[int, Wrench] = {}
    motions = [joint_motion(robot, frames, joint) for joint in range(robot.joints)]
    for joint in reversed(range(robot.joints)):
        if joint < robot.joints - 1:
            composite, bias = composite.plus(inertias[joint]), bias.plus(forces[joint])
        angular, linear = motions[joint]
        joint_bias[joint] = dot(angular, bias.moment) + dot(linear, bias.force)
        coupling[joint] = momentum(composite, linear, angular)
        for other in range(joint + 1):
            angular, linear = motions[other]
            joint_mass[other, joint] = dot(angular, coupling[joint].moment) + dot(linear, coupling[joint].force)
        if robot.armature is not None:
            joint_mass[joint, joint] = joint_mass[joint, joint] + robot.armature[joint]
    joint_biases = jnp.stack([joint_bias[joint] for joint in range(robot.joints)])
    return Limbs(composite, bias, joint_biases, joint_mass, [coupling[joint] for joint in range(robot.joints)])


class Factor(NamedTuple):
    """Unit lower triangle and inverse diagonal of `L D L^T`."""

    lower: dict[tuple[int, int], Array]  # by row and column
    inverse: list[Array]


def factorize(upper: Mapping[tuple[int, int], Array]) -> Factor:
    """Return the factors of a symmetric positive definite matrix, given by the elements of its upper triangle."""
    size = max(upper)[1] + 1
    lower: dict[tuple[int, int], Array] = {}
    scaled: dict[tuple[int, int], Array] = {}  # (D L^T)
    inverse: list[Array] = []
    for row in range(size):
        for column in range(row, size):
            value = upper[row, column]
            for k in range(row):
                value = value - lower[column, k] * scaled[k, row]
            if column == row:
                inverse.append(1 / value)
            else:
                scaled[row, column], lower[column, row] = value, value * inverse[row]
    return Factor(lower, inverse)


def solve(factor: Factor, right: Array) -> Array:
    """Return the solution of the factorised system of N unknowns for a right-hand side (N, ...)."""
    size = len(factor.inverse)
    partial: list[Array] = []
    for row in range(size):
        value = right[row]
        for k in range(row):
            value = value - factor.lower[row, k] * partial[k]
        partial.append(value)
    solution: dict[int, Array] = {}
    for row in reversed(range(size)):
        value = partial[row] * factor.inverse[row]
        for k in range(row + 1, size):
            value = value - factor.lower[k, row] * solution[k]
        solution[row] = value
    return jnp.stack([solution[row] for row in range(size)])


class BaseFactor(NamedTuple):
    """A matrix `[A C; C^T D]` factorised by blocks."""

    linear: Factor  # of A
    columns: Array  # (3, 3, B), A^-1 C
    angular: Factor  # of D - C^T A^-1 C


def factorize_base(linear: Array, mixed: Array, rotational: Array) -> BaseFactor:
    """Return the factors of `[A C; C^T D]`, for symmetric A, D (6, B) and C (3, 3, B)."""
    order = (0, 3, 4, 1, 5, 2)
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    first = factorize({pair: linear[k] for pair, k in zip(pairs, order, strict=True)})
    columns = jnp.stack([solve(first, mixed[:, j]) for j in range(3)], axis=1)
    schur = {(i, j): rotational[k] - dot(mixed[:, i], columns[:, j]) for k, (i, j) in zip(order, pairs, strict=True)}
    return BaseFactor(first, columns, factorize(schur))


def solve_base(factor: BaseFactor, force: Array, moment: Array) -> tuple[Array, Array]:
    """Return the solution [a; alpha] of `[A C; C^T D] [a; alpha] = [f; n]`."""
    angular = solve(factor.angular, moment - rotate_back(factor.columns, force))
    return solve(factor.linear, force) - rotate(factor.columns, angular), angular


class Factors(NamedTuple):
    """The factorised mass matrix: of the limbs, and of the base when they are eliminated."""

    joints: Factor
    force_rows: Array  # (N, 3, L, B): force on the base per acceleration of a joint
    moment_rows: Array
    base: BaseFactor


def accelerations(factors: Factors, forces: Forces) -> Acceleration:
    """Return what generalised forces accelerate."""
    freed = solve(factors.joints, forces.joint)
    force = forces.base.force + (forces.limbs.force - rotate_back(factors.force_rows, freed)).sum(1)
    moment = forces.base.moment + (forces.limbs.moment - rotate_back(factors.moment_rows, freed)).sum(1)
    linear, angular = solve_base(factors.base, force, moment)
    given_way = rotate(factors.force_rows, linear[:, None]) + rotate(factors.moment_rows, angular[:, None])
    joints = solve(factors.joints, forces.joint - given_way)
    return Acceleration(linear, angular, joints)


def build(robot: Robot) -> Callable[[State, Array, Array, Array, Array, Array], Acceleration]:
    """Return the forward dynamics of a robot in the layout of the hot path: see `ForwardDynamics`."""

    def forward_dynamics(
        state: State, torque: Array, foot_force: Array, base_wrench: Array, cargo_mass: Array, gravity: Array
    ) -> Acceleration:
        parts = _forward_dynamics(robot, state, torque, foot_force, base_wrench, cargo_mass, gravity)
        return Acceleration(*parts)

    return forward_dynamics


@jax.custom_jvp
def _forward_dynamics(
    robot: Robot,
    state: State,
    torque: Array,
    foot_force: Array,
    base_wrench: Array,
    cargo_mass: Array,
    gravity: Array,
) -> _Parts:
    return _parts(accelerations(*equations(robot, state, torque, foot_force, base_wrench, cargo_mass, gravity)))


@functools.partial(_forward_dynamics.defjvp, symbolic_zeros=True)
def _rates(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[_Parts, _Parts]:
    """Return the accelerations and their rates: `M^-1` times the rates of what the forces leave over at them.

    So the mass matrix and its factors need no derivatives (Carpentier and Mansard, Analytical Derivatives of Rigid Body
    Dynamics Algorithms, 2018). Orientations stay of unit length.
    """
    factors, forces = equations(*primals)
    acceleration = accelerations(factors, forces)
    leaves, tree = jax.tree.flatten(primals)
    rates = jax.tree.leaves(tangents, is_leaf=_is_zero)
    moving = [place for place, rate in enumerate(rates) if not _is_zero(rate)]

    def missing(values: list[Array]) -> Forces:
        every = list(leaves)
        for place, value in zip(moving, values, strict=True):
            every[place] = value
        robot, state, *acting = jax.tree.unflatten(tree, every)
        return missing_forces(robot, state, acceleration, *acting)

    change = jax.jvp(missing, ([leaves[place] for place in moving],), ([rates[place] for place in moving],))[1]
    rate = accelerations(factors, change)
    return _parts(acceleration), _parts(rate)


def _parts(acceleration: Acceleration) -> _Parts:
    return acceleration.base_linear, acceleration.base_angular, acceleration.joints


def _is_zero(rate: Any) -> bool:
    return isinstance(rate, SymbolicZero)


def equations(
    robot: Robot,
    state: State,
    torque: Array,
    foot_force: Array,
    base_wrench: Array,
    cargo_mass: Array,
    gravity: Array,
) -> tuple[Factors, Forces]:
    """Return the mass matrix, factorised, and what acts less the bias."""
    rotation = quaternion_to_matrix(state.base_orientation)
    frames = limb_frames(robot, rotation, state.joint_angles)
    limbs = limb_dynamics(robot, frames, state, foot_force, gravity)

    base_rotational = rotated_inertia(rotation, robot.base_inertia)
    omega = state.base_angular_velocity
    base_mass = robot.base_mass + cargo_mass
    spin = cross(omega, symmetric_times(base_rotational, omega))
    on_base = Wrench(base_wrench[:3] + base_mass * gravity, base_wrench[3:] - spin)
    forces = Forces(torque - limbs.joint_bias, Wrench(-limbs.bias.force, -limbs.bias.moment), on_base)

    # eliminate the joints: G = M_jj^-1 M_bj^T, a column for each of the base's six axes
    factor = factorize(limbs.joint_mass)
    force_rows = jnp.stack([column.force for column in limbs.coupling])  # (joint, 3, L, B)
    moment_rows = jnp.stack([column.moment for column in limbs.coupling])
    force_solved, moment_solved = solve(factor, force_rows), solve(factor, moment_rows)

    # Schur complement on the base: what each limb adds, less what its joints give way
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    mass, (hx, hy, hz) = limbs.inertia.mass, limbs.inertia.moment
    zero = jnp.zeros_like(hx)
    linear = jnp.stack([-dot(force_rows[:, i], force_solved[:, j]).sum(0) for i, j in pairs])
    linear = linear + jnp.stack([base_mass + mass.sum(0) + zero[0]] * 3 + [zero[0]] * 3)
    given_way = jnp.stack([dot(moment_rows[:, i], moment_solved[:, j]) for i, j in pairs])
    rotational = base_rotational + (limbs.inertia.rotational - given_way).sum(1)
    skew = ((zero, hz, -hy), (-hz, zero, hx), (hy, -hx, zero))
    mixed = jnp.stack(
        [
            jnp.stack([(skew[i][j] - dot(force_rows[:, i], moment_solved[:, j])).sum(0) for j in range(3)])
            for i in range(3)
        ]
    )
    base = factorize_base(linear, mixed, rotational)
    return Factors(factor, force_rows, moment_rows, base), forces
