"""Grip: a spring-damper between a foot and the point where it gripped, and its letting go."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.dynamics.kinematics import Feet, Turning, turn_between
from mjx_climb.dynamics.spatial import norm
from mjx_climb.quantities.parameters import Parameters


class Contact(NamedTuple):
    """What the contacts remember between steps."""

    grip_point: Array  # (3, L, B) m, world
    touching: Array  # (L, B) bool: the ground acted on the foot at the last step
    detached: Array  # (L, B) bool: the gripper was torn off, for good
    reach: Any = ()  # `Reach` where grippers hold only what is within reach
    attitude: Any = ()  # `Attitude` where grips transmit moments


class Reach(NamedTuple):
    """What grippers with a reach remember."""

    shut: Array  # (L, B) bool: commanded shut at the last step
    missed: Array  # (L, B) bool: shut out of reach, and open since


class Attitude(NamedTuple):
    """What grips that transmit moments remember."""

    rotation: Array  # (3, 3, L, B), of the foot when its gripper last shut
    held: Array  # (L, B) bool: the gripper held at the last step


class Grip(NamedTuple):
    """Contacts of one step."""

    force: Array  # (3, L, B) N, of the ground on the foot, world axes
    support: Array  # (L, B) bool: the gripper holds
    torn_off: Array  # (L, B) bool: the holding limit was passed in this step
    missed: Any  # (L, B) bool: it shut out of reach in this step; () without a `Reach`
    moment: Any  # (3, L, B) N m, of the ground on the foot, world axes; () without an `Attitude`


def grip(
    contact: Contact,
    feet: Feet,
    closed: Array,
    ground: Array,
    numbers: Parameters,
    turning: Turning | None = None,
) -> tuple[Contact, Grip]:
    """Return the contacts after this step and the forces in it.

    `ground` is the height of the ground below each foot, (L, B) m. A shut gripper holds its foot to the grip point both
    ways. An open one, or one torn off, feels the ground while its foot is at or below it. The grip point is below the
    foot, at the ground's height, where the gripper shuts or the foot first touches. A supporting limb lets go, from the
    next step on, when the ground pulls its foot down with more than the holding limit in all (ClimbLab's rule).

    With a `Reach` and a finite capture distance a gripper that shuts further off the ground than the capture
    distance holds nothing and stays open until its next swing, and the ground only pushes a foot whose gripper is
    open, along its normal.

    With an `Attitude` a gripper that holds also keeps its foot from turning, by the sine of the angle from the attitude
    in which it shut (the gradient of a potential of 1 - cos) and by the rate; it lets go by its force alone.
    """
    ground = jnp.broadcast_to(ground, feet.position[2].shape)
    support, reach = closed & ~contact.detached, contact.reach
    missed: Any = ()
    if reach:
        anywhere = jnp.isinf(numbers.capture_distance)
        shuts = support & ~reach.shut & ~anywhere
        missed = shuts & (feet.position[2] - ground > numbers.capture_distance)
        reach = Reach(closed, closed & (reach.missed | missed))
        support = support & ~reach.missed
    touching = support | (feet.position[2] <= ground)
    fresh = touching & ~contact.touching
    if reach:
        fresh = fresh | shuts
    below = jnp.stack([feet.position[0], feet.position[1], ground])
    grip_point = jnp.where(fresh, below, contact.grip_point)
    spring_damper = -numbers.contact_stiffness * (feet.position - grip_point) - numbers.contact_damping * feet.velocity
    force = jnp.where(touching, spring_damper, 0.0)
    if reach:
        force = jnp.where(support | anywhere, force, _push(force))
    torn_off = support & (force[2] < 0) & (norm(force) > numbers.holding_limit)
    attitude: Any = contact.attitude
    moment: Any = ()
    if turning is not None:
        attitude, moment = _resisted(attitude, turning, support, numbers)
    after = Contact(grip_point, touching, contact.detached | torn_off, reach, attitude)
    return after, Grip(force, support, torn_off, missed, moment)


def _resisted(attitude: Attitude, turning: Turning, support: Array, numbers: Parameters) -> tuple[Attitude, Array]:
    """Return the attitudes that grips hold on to, and the moments by which they do, (3, L, B) N m."""
    rotation = jnp.where(support & attitude.held, attitude.rotation, turning.rotation)
    moment = numbers.rotational_stiffness * turn_between(turning.rotation, rotation)
    moment = moment - numbers.rotational_damping * turning.velocity
    return Attitude(rotation, support), jnp.where(support, moment, 0.0)


def _push(force: Array) -> Array:
    """Return what of a force (3, L, B) pushes along the ground's normal."""
    return jnp.stack([jnp.zeros_like(force[0]), jnp.zeros_like(force[1]), jnp.maximum(force[2], 0.0)])
