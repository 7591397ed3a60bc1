"""Recovery: when a walk is interrupted, where a limb in the air comes down, and what the base does.

A planner looks at the robot every planning period. Where the base is too far from its reference, a grip is near its
limit, or the margin is small, the gait's own time stands still for a while, limbs in the air come down on the point
that lets the feet bear best the force which stops the robot, and the base reference moves to where the base is, or so
far towards it. From there it returns to the planned path as the gait goes on.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import Component, parameter
from mjx_climb.control import Law
from mjx_climb.physics.margins import gia_margin, support_axes, tumbling_moment
from mjx_climb.physics.spatial import norm


class Recovery(Component):
    """Thresholds, any of which interrupts the gait, and how it is interrupted."""

    shift: Array = parameter("m", bounds=(0.0, np.inf), default=np.inf, long_name="shift of the base that interrupts")
    utilization: Array = parameter("1", bounds=(0.0, np.inf), default=np.inf, long_name="use of a grip that interrupts")
    margin: Array = parameter("m/s^2", bounds=(0.0, np.inf), default=0.0, long_name="GIA margin that interrupts")
    lead_time: Array = parameter("s", bounds=(0.0, np.inf), default=0.02, long_name="time until the predicted use")
    landing_time: Array = parameter("s", bounds=(0.0, np.inf), default=0.25, long_name="time of a landing")
    rest_time: Array = parameter("s", bounds=(0.0, np.inf), default=1.2, long_name="time at rest after a landing")
    take_over: Array = parameter("1", bounds=(0.0, 1.0), default=0.3, long_name="share of a shift that is taken over")
    return_time: Array = parameter("s", bounds=(0.0, np.inf), default=1.0, long_name="time of the base's return")
    reach: Array = parameter("m", bounds=(0.0, np.inf), default=0.03, long_name="how far beside itself a foot may land")


def recovery_of(law: Law, own: Recovery | None) -> Recovery | None:
    """Return a recovery in which values are those of a law's gains that are called `recovery_NAME`."""
    values = {name: getattr(law, gain) for name in Recovery.VALUES if (gain := f"recovery_{name}") in law.GAINS}
    return dataclasses.replace(own or Recovery(), **values) if values else own


class Danger(NamedTuple):
    """What thresholds are compared with."""

    shift: Array  # () m, of the base from its reference
    utilization: Array  # () 1, largest predicted share of a grip's limit
    margin: Array  # () m/s^2, GIA margin


class Body(NamedTuple):
    """What is known of the robot as a whole; world axes."""

    mass: Array  # () kg
    center_of_mass: Array  # (3,) m
    velocity: Array  # (3,) m/s, of the base
    weight: Array  # (3,) N
    feet: Array  # (limb, 3) m
    support: Array  # (limb,) bool
    foot_force: Array  # (limb, 3) N
    holding_force: Array  # () N, pull that a grip bears; 0: any, or none
    normal: Array  # (limb, 3) 1, of the ground at the feet
    pull: Array  # () N, that margins may count on; on holds (limb, 3), times their normals


def danger(recovery: Recovery, body: Body, force_rate: Array, shift: Array) -> Danger:
    """Return how near the robot is to losing its grips.

    Arguments:
        force_rate: (limb, 3) N/s, of the forces of the ground on the feet.
        shift: (3,) m, of the base from its reference.
    """
    force = body.foot_force + recovery.lead_time * force_rate
    pulled, limited = body.support & ((force * body.normal).sum(1) < 0), body.holding_force > 0
    used = norm(force) / jnp.where(limited, body.holding_force, 1.0)
    axes = support_axes(body.feet, body.support)
    margin = gia_margin(axes, body.center_of_mass, body.foot_force.sum(0), body.mass, body.pull)
    return Danger(norm(shift), jnp.where(pulled & limited, used, 0.0).max(), margin)


def interrupts(recovery: Recovery, danger: Danger) -> Array:
    """Return whether a threshold is passed, () bool."""
    far, near = danger.shift > recovery.shift, danger.utilization > recovery.utilization
    return far | near | (danger.margin < recovery.margin)


def ways_beside(dtype: jnp.dtype) -> Array:
    """Return ways (17, 3) from a place to itself and to level ones around it, of length 1 at most."""
    angles = np.pi / 4 * np.arange(8)
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    return jnp.asarray(np.concatenate([np.zeros((1, 3)), 0.5 * ring, ring]), dtype)


def stopping_margin(recovery: Recovery, body: Body, landing: Array, position: Array) -> Array:
    """Return the smallest moment that tumbles a robot whose feet stop it, with some limbs landed at points, () N m.

    The force that stops the base in the landing time acts at the centre of mass.

    Arguments:
        landing: (limb,) bool, which limbs land.
        position: (limb, 3) m, where.
    """
    feet, support = jnp.where(landing[:, None], position, body.feet), body.support | landing
    time = jnp.maximum(recovery.landing_time, 1e-3)
    force = -body.weight - body.mass * body.velocity / time
    middle = body.center_of_mass + body.velocity * time / 2
    return tumbling_moment(support_axes(feet, support), (force, jnp.cross(middle, force)), body.pull)
