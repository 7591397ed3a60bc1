"""The equations of motion written for what the robot is: a base with limbs, each a chain of joints.

The limbs meet in the base alone, so the mass matrix is an arrow: a 6 x 6 block of the base, an N x N block for each
limb of N joints and 6 x N couplings between them. Composite inertias and Newton-Euler run per limb, the limbs are
eliminated with N x N factors, written out, and a 6 x 6 Schur complement is left for the base (Featherstone, Rigid Body
Dynamics Algorithms, 2008: chapters 5 and 6). Everything is elementwise over (limb, batch). World axes; moments about
the base's centre of mass.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.dynamics.kinematics import LimbFrames, base_wrench_of_foot_force, foot_velocity_per_rate, limb_frames
from mjx_climb.dynamics.spatial import chosen, compose, cross, dot, quaternion_to_matrix, rotate, rotate_back
from mjx_climb.dynamics.state import Acceleration, State
from mjx_climb.robot.constants import Robot


class Inertia(NamedTuple):
    """Rigid-body inertia about the base's centre of mass: m, h = m c, and I as xx, yy, zz, xy, xz, yz."""

    mass: Array  # (...) kg
    moment: Array  # (3, ...) kg m
    rotational: Array  # (6, ...) kg m^2

    def plus(self, other: "Inertia") -> "Inertia":
        return Inertia(self.mass + other.mass, self.moment + other.moment, self.rotational + other.rotational)


class Wrench(NamedTuple):
    """A force and its moment about the base's centre of mass."""

    force: Array  # (3, ...) N
    moment: Array  # (3, ...) N m

    def plus(self, other: "Wrench") -> "Wrench":
        return Wrench(self.force + other.force, self.moment + other.moment)


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
    bias: Wrench  # on the base
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


def limb_dynamics(robot: Robot, frames: LimbFrames, state: State, gravity: Array) -> Limbs:
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

    composite, bias = inertias[-1], forces[-1]
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


def solve_base(linear: Array, mixed: Array, rotational: Array, force: Array, moment: Array) -> tuple[Array, Array]:
    """Solve `[A C; C^T D] [a; alpha] = [f; n]` by blocks, for symmetric A, D (6, B) and C (3, 3, B)."""
    order = (0, 3, 4, 1, 5, 2)
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    first = factorize({pair: linear[k] for pair, k in zip(pairs, order, strict=True)})
    columns = jnp.stack([solve(first, mixed[:, j]) for j in range(3)], axis=1)  # A^-1 C
    schur = {(i, j): rotational[k] - dot(mixed[:, i], columns[:, j]) for k, (i, j) in zip(order, pairs, strict=True)}
    angular = solve(factorize(schur), moment - rotate_back(columns, force))
    return solve(first, force) - rotate(columns, angular), angular


def build(robot: Robot) -> Callable[[State, Array, Array, Array, Array, Array], Acceleration]:
    """Return the forward dynamics of a robot in the layout of the hot path: see `ForwardDynamics`."""

    def forward_dynamics(
        state: State, torque: Array, foot_force: Array, base_wrench: Array, cargo_mass: Array, gravity: Array
    ) -> Acceleration:
        rotation = quaternion_to_matrix(state.base_orientation)
        frames = limb_frames(robot, rotation, state.joint_angles)
        limbs = limb_dynamics(robot, frames, state, gravity)

        # right-hand sides: what acts, less the bias
        lever = [frames.foot - position for position in frames.position]
        joint_force = torque - limbs.joint_bias
        joint_force = joint_force + jnp.stack(
            [
                dot(foot_velocity_per_rate(robot, k, frames.rotation[k][:, 2], lever[k]), foot_force)
                for k in range(robot.joints)
            ]
        )
        base_rotational = rotated_inertia(rotation, robot.base_inertia)
        omega = state.base_angular_velocity
        wrench = base_wrench + base_wrench_of_foot_force(frames.foot, foot_force)
        base_mass = robot.base_mass + cargo_mass
        force = wrench[:3] + base_mass * gravity - limbs.bias.force.sum(1)
        moment = wrench[3:] - cross(omega, symmetric_times(base_rotational, omega)) - limbs.bias.moment.sum(1)

        # eliminate the joints: G = M_jj^-1 M_bj^T, a column for each of the base's six axes
        factor = factorize(limbs.joint_mass)
        force_rows = jnp.stack([column.force for column in limbs.coupling])  # (joint, 3, L, B)
        moment_rows = jnp.stack([column.moment for column in limbs.coupling])
        force_solved, moment_solved = solve(factor, force_rows), solve(factor, moment_rows)
        freed = solve(factor, joint_force)
        force = force - rotate_back(force_rows, freed).sum(1)
        moment = moment - rotate_back(moment_rows, freed).sum(1)

        # Schur complement on the base
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        total_mass = base_mass + limbs.inertia.mass.sum(0)
        hx, hy, hz = limbs.inertia.moment.sum(1)
        zero = jnp.zeros_like(hx)
        diagonal = jnp.stack([total_mass + zero] * 3 + [zero] * 3)
        linear = diagonal - jnp.stack([dot(force_rows[:, i], force_solved[:, j]).sum(0) for i, j in pairs])
        rotational = (
            base_rotational
            + limbs.inertia.rotational.sum(1)
            - jnp.stack([dot(moment_rows[:, i], moment_solved[:, j]).sum(0) for i, j in pairs])
        )
        skew = jnp.stack([jnp.stack([zero, hz, -hy]), jnp.stack([-hz, zero, hx]), jnp.stack([hy, -hx, zero])])
        mixed = skew - jnp.stack(
            [jnp.stack([dot(force_rows[:, i], moment_solved[:, j]).sum(0) for j in range(3)]) for i in range(3)]
        )
        base_linear, base_angular = solve_base(linear, mixed, rotational, force, moment)
        joints = freed - rotate(force_solved, base_linear[:, None]) - rotate(moment_solved, base_angular[:, None])
        return Acceleration(base_linear, base_angular, joints)

    return forward_dynamics
