"""Stability of a gripping robot: tumble stability margin (TSM), gravito-inertial acceleration (GIA) margin.

Limbs must be numbered counter-clockwise seen from above (LF, LH, RH, RF), z is the ground normal, and moments are about
the world origin. Both margins take the net external wrench (ground reactions and pushes, gravity excluded): by Newton
and Euler it equals the inertial minus the gravity wrench, summed over all links.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.numpy import cross

from mjx_climb.physics.spatial import norm


def net_external_wrench(base_wrench: Array, base_position: Array) -> tuple[Array, Array]:
    """Return ground reactions and pushes summed: force (3,) N, moment about the world origin (3,) N m.

    `base_wrench` (6,): the same force, N, and its moment about the base, N m; `base_position` (3,) m. World axes.
    """
    force = base_wrench[:3]
    return force, base_wrench[3:] + cross(base_position, force)


class Axes(NamedTuple):
    """One axis per supporting foot, to the next supporting one; entries of other feet carry no meaning."""

    polygon: Array  # (limb,) bool: this foot starts an axis of a polygon, so at least three feet support
    start: Array  # p_a (limb, 3) m
    end: Array  # p_b (limb, 3) m
    held: Array  # (limb, other) bool: which of the feet after the next one support
    normal: Array  # (limb, other, 3) m^2, (p_a - p_j) x (p_b - p_j) of these


def support_axes(foot_position: Array, support: Array) -> Axes:
    """The axes of the support polygon of feet (limb, 3) m that hold, by `support` (limb,)."""
    shifts = range(1, len(support))
    held = jnp.stack([jnp.roll(support, -s) for s in shifts], axis=1)
    others = jnp.stack([jnp.roll(foot_position, -s, axis=0) for s in shifts], axis=1)
    end = others[:, -1]
    for s in reversed(range(len(shifts) - 1)):
        end = jnp.where(held[:, s, None], others[:, s], end)
    polygon = support & (support.sum() >= 3)
    # the foot that ends the axis is among the others too: its triangle is empty and adds nothing
    off_axis = others[:, 1:]
    normal = cross(foot_position[:, None] - off_axis, end[:, None] - off_axis)
    return Axes(polygon, foot_position, end, held[:, 1:], normal)


def _moments_of_pulls(axes: Axes, pull: Array) -> Array:
    """Return the moments of pulls (limb, 3) N at feet off an axis, times its length, (limb, other) N m^2.

    A pull F along a hold's normal n has about the axis the moment `F n . N`, where N is the normal of the triangle. One
    that could only tip the robot is 0.
    """
    others = jnp.stack([jnp.roll(pull, -s, axis=0) for s in range(2, len(pull))], axis=1)
    return jnp.where(axes.held, jnp.maximum((others * axes.normal).sum(-1), 0.0), 0.0)


def tumbling_moment(axes: Axes, net_wrench: tuple[Array, Array], holding_force: Array) -> Array:
    """Return the smallest moment () N m that keeps the robot from tumbling over an axis of the support polygon.

    Zero once it tumbles over any, and with fewer than three supporting feet; arguments as of
    `tumble_stability_margin`.
    """
    net_force, net_moment = net_wrench
    direction = axes.start - axes.end
    length = norm(direction, at_zero=1.0)
    tumbling = direction @ net_moment + cross(axes.end, axes.start) @ net_force
    # Only the gripper with the longest arm counts. F_hold acts along its triangle's normal, so its arm is its
    # distance from the axis; one across the axis (concave polygon, n_z < 0) could only tip and does not pull.
    # On holds it acts along their normals.
    if on_holds := holding_force.ndim > 0:
        arms = _moments_of_pulls(axes, holding_force)
    else:
        pulls = axes.held & (axes.normal[..., 2] > 0.0)
        arms = jnp.where(pulls, norm(axes.normal), 0.0)
    # of two feet none is off the axis, and JAX has no tangent of a maximum over nothing
    longest = (arms.max(1) if arms.shape[1] else jnp.zeros_like(length)) / length
    # ClimbLab's M_ab = tumbling / length - holding is negative while the axis is stable.
    holding = longest if on_holds else holding_force * longest
    return _smallest_over_axes(holding - tumbling / length, axes)


def tumble_stability_margin(
    axes: Axes, net_wrench: tuple[Array, Array], mass: Array, gravity: Array, holding_force: Array
) -> Array:
    """Return the tumble stability margin () in m, after Yoneda & Hirose (1996), with grippers that hold.

    `net_wrench` is that of `net_external_wrench`; `mass` () kg with cargo; `gravity` () m/s^2, its magnitude;
    `holding_force` () N, or on holds (limb, 3) N: each foot's pull times the normal of its hold.

    The smallest moment |M_ab| that keeps the robot from tumbling over an axis of the support polygon, over m g; zero
    once it tumbles over any, and with fewer than three supporting feet. Without gravity a stable robot's is infinite.
    """
    smallest = tumbling_moment(axes, net_wrench, holding_force)
    weight = mass * gravity
    weightless = weight == 0.0
    in_metres = smallest / jnp.where(weightless, 1.0, weight)
    return jnp.where(weightless & (smallest > 0.0), jnp.inf, in_metres)


def gia_margin(axes: Axes, center_of_mass: Array, net_force: Array, mass: Array, holding_force: Array) -> Array:
    """Return the gravito-inertial acceleration margin () in m/s^2, after Ribeiro et al. (2020).

    The distance of g_ia = g - a_com = -net_force / m from the limit polyhedron; zero outside of it and with fewer than
    three supporting feet. F_0 and M_0 of the limits are zero, as in ClimbLab: a push shows in g_ia alone, and only the
    grippers widen the polyhedron. `center_of_mass` (3,) m; the others as of `tumble_stability_margin`.
    """
    normal = cross(center_of_mass - axes.start, center_of_mass - axes.end)
    if holding_force.ndim:
        holding = _moments_of_pulls(axes, holding_force).sum(1)
    else:
        holding = holding_force * jnp.where(axes.held, axes.normal[..., 2], 0.0).sum(1)
    return _smallest_over_axes((holding + normal @ net_force) / (mass * norm(normal, at_zero=1.0)), axes)


def _smallest_over_axes(margin: Array, axes: Axes) -> Array:
    """Return the minimum over the axes of the polygon (), not below zero; zero where there is no polygon."""
    smallest = jnp.where(axes.polygon, margin, jnp.inf).min()
    return jnp.where(axes.polygon.any(), jnp.maximum(smallest, 0.0), 0.0)
