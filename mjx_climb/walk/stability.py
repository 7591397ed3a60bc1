"""Stability of a gripping robot: tumble stability margin (TSM), gravito-inertial acceleration (GIA) margin.

Arrays are laid out as in the rest of the hot path: components first, limbs second, batch last. Limbs must be
numbered counter-clockwise seen from above (LF, LH, RH, RF), z is the ground normal, and moments are about the
world origin. Both margins take the net external wrench (ground reactions and pushes, gravity excluded): by
Newton and Euler it equals the inertial minus the gravity wrench, summed over all links.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_climb.walk.chosen import smallest_row


def net_external_wrench(base_wrench: jax.Array, base_position: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Ground reactions and pushes summed: force (3, B) N, moment about the world origin (3, B) N m.

    `base_wrench` (6, B): the same force, N, and its moment about the base, N m; `base_position` (3, B) m. World axes.
    """
    force = base_wrench[:3]
    return force, base_wrench[3:] + _cross(base_position, force)


def tumble_stability_margin(
    foot_position: jax.Array,
    support: jax.Array,
    net_force: jax.Array,
    net_moment: jax.Array,
    mass: jax.Array,
    gravity: jax.Array,
    holding_force: jax.Array,
) -> jax.Array:
    """Tumble stability margin (B,) in m, after Yoneda & Hirose (1996), with grippers that hold.

    `foot_position` (3, L, B) m; `support` (L, B) bool; `net_force` (3, B) N and `net_moment` (3, B) N m, from
    `net_external_wrench`; `mass` (B,) kg with cargo; `gravity` (B,) m/s^2, its magnitude; `holding_force`
    (B,) N.

    The smallest moment |M_ab| that keeps the robot from tumbling over an axis of the support polygon, over
    m g; zero once it tumbles over any, and with fewer than three supporting feet. Without gravity a stable
    robot's margin is infinite.
    """
    axes = _support_axes(foot_position, support)
    length = _norm(axes.direction, at_zero=1.0)
    tumbling = _dot(net_moment[:, None], axes.direction) + _dot(net_force[:, None], axes.moment)
    # Only the gripper with the longest arm counts. F_hold acts along its triangle's normal, so its arm is its
    # distance from the axis; one across the axis (concave polygon, n_z < 0) could only tip and does not pull.
    longest = jnp.zeros_like(length)
    for held, n in axes.off_axis:
        longest = jnp.maximum(longest, jnp.where(held & (n[2] > 0.0), _norm(n), 0.0) / length)
    holding = holding_force * longest
    # ClimbLab's M_ab = tumbling / length - holding is negative while the axis is stable.
    smallest = _smallest_over_axes(holding - tumbling / length, axes)
    weight = mass * gravity
    weightless = weight == 0.0
    in_metres = smallest * (1 / jnp.where(weightless, 1.0, weight))
    return jnp.where(weightless & (smallest > 0.0), jnp.inf, in_metres)


def gia_margin(
    foot_position: jax.Array,
    support: jax.Array,
    center_of_mass: jax.Array,
    net_force: jax.Array,
    mass: jax.Array,
    holding_force: jax.Array,
) -> jax.Array:
    """Gravito-inertial acceleration margin (B,) in m/s^2, after Ribeiro et al. (2020).

    Arguments as in `tumble_stability_margin`, with `center_of_mass` (3, B) m. The distance of
    g_ia = g - a_com = -net_force / m from the limit polyhedron; zero outside of it and with fewer than three
    supporting feet. F_0 and M_0 of the limits are zero, as in ClimbLab: a push shows in g_ia alone, and only
    the grippers widen the polyhedron.
    """
    axes = _support_axes(foot_position, support)
    com = center_of_mass[:, None]
    normal = _cross(com - axes.start, com - axes.end)
    holding = holding_force * sum(jnp.where(held, n[2], 0.0) for held, n in axes.off_axis)
    holding_and_inertia = holding + _dot(net_force[:, None], normal)
    return _smallest_over_axes(holding_and_inertia / (mass * _norm(normal, at_zero=1.0)), axes)


class _Axes(NamedTuple):
    """One axis per supporting foot, to the next supporting one; entries of other feet carry no meaning."""

    polygon: jax.Array  # (L, B) bool: this foot starts an axis of a polygon, so at least three feet support
    start: jax.Array  # p_a (3, L, B)
    end: jax.Array  # p_b (3, L, B)
    direction: jax.Array  # p_a - p_b (3, L, B)
    moment: jax.Array  # p_b x p_a (3, L, B)
    off_axis: list[tuple[jax.Array, jax.Array]]  # of other feet j: supports (L, B), (p_a - p_j) x (p_b - p_j)


def _support_axes(foot_position: jax.Array, support: jax.Array) -> _Axes:
    limbs = support.shape[0]
    start = foot_position
    neighbours = [(jnp.roll(support, -s, 0), jnp.roll(foot_position, -s, 1)) for s in range(1, limbs)]
    end = neighbours[-1][1]
    for held, position in neighbours[-2::-1]:
        end = jnp.where(held, position, end)
    polygon = support & (support.astype(jnp.int32).sum(0) >= 3)
    # The foot that ends the axis is among these too: its triangle is empty and adds nothing.
    off_axis = [(held, _cross(start - position, end - position)) for held, position in neighbours[1:]]
    return _Axes(polygon, start, end, start - end, _cross(end, start), off_axis)


def _smallest_over_axes(margin: jax.Array, axes: _Axes) -> jax.Array:
    """Minimum over the axes of the polygon (B,), not below zero; zero where there is no polygon."""
    smallest = smallest_row(jnp.where(axes.polygon, margin, jnp.inf))
    return jnp.where(axes.polygon.any(0), jnp.maximum(smallest, 0.0), 0.0)


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _norm(a: jax.Array, at_zero: float = 0.0) -> jax.Array:
    """Length with a finite derivative (zero) at the zero vector, where it is `at_zero` (1 in a divisor)."""
    square = _dot(a, a)
    zero = square == 0.0
    return jnp.where(zero, at_zero, jnp.sqrt(jnp.where(zero, 1.0, square)))
