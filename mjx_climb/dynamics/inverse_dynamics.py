"""What the equations of motion leave over at given accelerations, by Newton-Euler in the links' own frames.

In its own frame a link's inertia, and where the next joint is, do not change, so that all of it has short derivatives:
those of the accelerations are made of them (`mjx_climb.dynamics.limb_engine`).

References:
    J. Y. S. Luh, M. W. Walker, R. P. C. Paul, On-Line Computational Scheme for Mechanical Manipulators, 1980.
    R. Featherstone, Rigid Body Dynamics Algorithms, 2008: section 5.3.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.dynamics.spatial import chosen, cross, dot, quaternion_to_matrix, rotate, rotate_back
from mjx_climb.dynamics.state import Acceleration, State
from mjx_climb.robot.constants import Robot


class Wrench(NamedTuple):
    """A force and its moment about a point: the base's centre of mass, or where it says so another one."""

    force: Array  # (3, ...) N
    moment: Array  # (3, ...) N m

    def plus(self, other: "Wrench") -> "Wrench":
        return Wrench(self.force + other.force, self.moment + other.moment)


class Forces(NamedTuple):
    """Generalised forces: on the base those by way of each limb, and the others."""

    joint: Array  # (N, L, B) N m, forces N of sliding joints
    limbs: Wrench  # (3, L, B), world
    base: Wrench  # (3, B), world


def missing_forces(
    robot: Robot,
    state: State,
    acceleration: Acceleration,
    torque: Array,
    foot_force: Array,
    base_wrench: Array,
    cargo_mass: Array,
    gravity: Array,
) -> Forces:
    """Return what acts less what the accelerations need: at the joints, of the base by each limb, and of its own.

    At the accelerations that obey the equations of motion the joints' are zero, and so is the sum over the base.
    Layout of the hot path; arguments as those of `mjx_climb.dynamics.ForwardDynamics`.
    """
    rotation = quaternion_to_matrix(state.base_orientation)
    velocity = rotate_back(rotation, state.base_angular_velocity)
    turning = rotate_back(rotation, acceleration.base_angular)
    linear = rotate_back(rotation, acceleration.base_linear - gravity)
    foot_force = rotate_back(rotation[:, :, None], foot_force)
    needed, limbs = _limbs(robot, state, acceleration, velocity, turning, linear, foot_force)
    mass = robot.base_mass + cargo_mass
    base = _load(_body(mass, jnp.zeros_like(linear), robot.base_inertia), linear, _stretch(velocity, turning))
    joint = torque - needed
    if robot.armature is not None:
        joint = joint - robot.armature * acceleration.joints
    limbs = Wrench(*(-rotate(rotation[:, :, None], vector) for vector in limbs))
    return Forces(
        joint,
        limbs,
        Wrench(base_wrench[:3] - rotate(rotation, base.force), base_wrench[3:] - rotate(rotation, base.moment)),
    )


def _limbs(
    robot: Robot,
    state: State,
    acceleration: Acceleration,
    velocity: Array,
    turning: Array,
    linear: Array,
    foot_force: Array,
) -> tuple[Array, Wrench]:
    """Return what the limbs need at their joints (N, L, B), and each of the base (3, L, B), in the base's axes.

    Arguments:
        velocity, turning, linear: (3, B), of the base: angular velocity, its rate, and acceleration less gravity.
        foot_force: (3, L, B), all in the base's axes.
    """
    velocity, turning, linear = velocity[:, None], turning[:, None], linear[:, None]
    stretch = _stretch(velocity, turning)
    loads, turns = [], []
    for link in range(robot.joints):
        turn = _turn(robot, link, state.joint_angles[link])
        rate, quickening = state.joint_rates[link], acceleration.joints[link]
        linear = turn.into(linear + rotate(stretch, turn.arm))
        velocity, turning, foot_force = turn.into(velocity), turn.into(turning), turn.into(foot_force)
        slides = robot.sliding(link)
        if slides is not None:
            along = _along_axis(velocity, 2 * rate, quickening)
            linear = linear + chosen(slides, along, jnp.zeros_like(along))
            still = jnp.zeros_like(rate)
            rate, quickening = chosen(slides, still, rate), chosen(slides, still, quickening)
        turning = turning + _along_axis(velocity, rate, quickening)
        x, y, z = velocity
        velocity = jnp.stack([x, y, z + rate])
        stretch = _stretch(velocity, turning)
        body = _body(robot.link_mass[link], robot.link_center[link], robot.link_inertia[link])
        loads.append(_load(body, linear, stretch))
        turns.append(turn)

    load = Wrench(-foot_force, cross(foot_force, robot.foot_center))
    joint = []
    for link in reversed(range(robot.joints)):
        load, turn, slides = load.plus(loads[link]), turns[link], robot.sliding(link)
        joint.append(load.moment[2] if slides is None else chosen(slides, load.force[2], load.moment[2]))
        force = turn.out(load.force)
        load = Wrench(force, turn.out(load.moment) + cross(turn.arm, force))
    return jnp.stack(joint[::-1]), load


class _Body(NamedTuple):
    """Moments of a body's mass about the origin of its frame."""

    mass: Array  # kg
    first: Array  # (3, ...) kg m
    second: Array  # (3, 3, ...) kg m^2, of r r^T


def _body(mass: Array | np.ndarray, center: Array | np.ndarray, inertia: Array | np.ndarray) -> _Body:
    """Return the moments of a body with `inertia` (3, 3, ...) about its own centre of mass."""
    trace = inertia[0, 0] + inertia[1, 1] + inertia[2, 2]
    own = jnp.eye(3, dtype=inertia.dtype)[(..., *[None] * (inertia.ndim - 2))] * (trace / 2) - inertia
    second = own + mass * center[:, None] * center[None]
    return _Body(jnp.asarray(mass), jnp.asarray(mass * center), jnp.asarray(second))


def _load(body: _Body, linear: Array, stretch: Array) -> Wrench:
    """Return what a body needs whose origin accelerates with `linear`: a force, and its moment about the origin."""
    force = body.mass * linear + rotate(stretch, body.first)

    def product(i: int, j: int) -> Array:
        return dot(stretch[i], body.second[j])

    moment = jnp.stack([product(2, 1) - product(1, 2), product(0, 2) - product(2, 0), product(1, 0) - product(0, 1)])
    return Wrench(force, moment + cross(body.first, linear))


def _stretch(velocity: Array, turning: Array) -> Array:
    """Return the matrix (3, 3, ...) that times a body's point is its acceleration against the origin."""
    (x, y, z), (a, b, c) = velocity, turning
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    rows = [[-(yy + zz), xy - c, xz + b], [xy + c, -(xx + zz), yz - a], [xz - b, yz + a, -(xx + yy)]]
    return jnp.stack([jnp.stack(row) for row in rows])


class _Turn(NamedTuple):
    """The step from a link's parent to the link, and back."""

    zero: Array  # (3, 3, L, 1): of the link's frame with the joint at zero, in the parent's
    arm: Array  # (3, L, 1 or B) m, of the joint, in the parent's frame
    cosine: Array  # (L, B), of the joint's angle
    sine: Array

    def into(self, vector: Array) -> Array:
        """Return a vector (3, L, B) of the parent's frame in the link's."""
        x, y, z = rotate_back(self.zero, vector)
        turned = self.cosine * x + self.sine * y
        return jnp.stack([turned, self.cosine * y - self.sine * x, jnp.broadcast_to(z, turned.shape)])

    def out(self, vector: Array) -> Array:
        """Return a vector (3, L, B) of the link's frame in the parent's."""
        x, y, z = vector
        return rotate(self.zero, jnp.stack([self.cosine * x - self.sine * y, self.sine * x + self.cosine * y, z]))


def _turn(robot: Robot, link: int, value: Array) -> _Turn:
    zero, arm = robot.frame_rotation[link], robot.frame_position[link]
    slides, still = robot.sliding(link), jnp.zeros_like(value)
    if slides is not None:
        arm = arm + zero[:, 2] * chosen(slides, value, still)
        value = chosen(slides, still, value)
    return _Turn(zero, arm, jnp.cos(value), jnp.sin(value))


def _along_axis(velocity: Array, rate: Array, quickening: Array) -> Array:
    """Return the rate of change (3, L, B) of a vector `rate` along a joint's axis, which turns with `velocity`."""
    x, y, _ = velocity
    return jnp.stack([y * rate, -x * rate, jnp.broadcast_to(quickening, (y * rate).shape)])
