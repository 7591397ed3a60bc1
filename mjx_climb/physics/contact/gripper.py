"""Grip: a spring-damper between a foot and the point where it gripped, and its letting go."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.kinematics import Feet, Turning, turn_between
from mjx_climb.physics.spatial import norm


class Reach(NamedTuple):
    """What grippers with a capture distance remember."""

    shut: Array  # (limb,) bool: commanded shut at the last step
    missed: Array  # (limb,) bool: shut out of reach, and open since


class Attitude(NamedTuple):
    """What grips that transmit moments remember."""

    rotation: Array  # (limb, 3, 3), of the foot when its gripper last shut
    held: Array  # (limb,) bool: the gripper held at the last step


class Contact(NamedTuple):
    """What the contacts remember from step to step."""

    grip_point: Array  # (limb, 3) m, world
    touching: Array  # (limb,) bool: the ground acted on the foot at the last step
    detached: Array  # (limb,) bool: the gripper was torn off, for good
    reach: Reach | tuple[()] = ()  # where grippers have a capture distance
    attitude: Attitude | tuple[()] = ()  # where grips transmit moments


class Grip(NamedTuple):
    """Contacts of one step."""

    foot_force: Array  # (limb, 3) N, of the ground on the foot, world axes
    foot_moment: Array  # (limb, 3) N m, of the ground on the foot, world axes; zero unless grips transmit moments
    support: Array  # (limb,) bool: the gripper holds
    torn_off: Array  # (limb,) bool: the holding limit was passed in this step
    missed: Array  # (limb,) bool: it shut out of reach in this step


def grip(
    contact: Contact, feet: Feet, closed: Array, ground: Array, parameters: Parameters, turning: Turning | None = None
) -> tuple[Contact, Grip]:
    """Return the contacts after this step and the forces in it.

    `closed` (limb,) says which grippers are commanded shut, `ground` (limb,) m how high it is below each foot. A shut
    gripper holds its foot to the grip point both ways. An open one, or one torn off, feels the ground while its foot is
    at or below it. The grip point is below the foot, at the ground's height, where the gripper shuts or the foot first
    touches. A supporting limb lets go, from the next step on, when the ground pulls its foot down and the whole force
    is larger than the holding limit (ClimbLab's rule).

    With a `Reach` and a finite capture distance a gripper that shuts further off the ground holds nothing and stays
    open until its next swing, and the ground only pushes a foot whose gripper is open, along its normal. With an
    `Attitude` a gripper that holds also keeps its foot from turning, by the sine of the angle from the attitude in
    which it shut (the gradient of a potential of 1 - cos) and by the rate; it lets go by its force alone.
    """
    height = feet.position[:, 2]
    support, missed, caught = closed & ~contact.detached, jnp.zeros_like(closed), jnp.zeros_like(closed)
    reach, attitude = contact.reach, contact.attitude
    if reach:
        limited = jnp.isfinite(parameters.capture_distance)
        caught = support & ~reach.shut & limited
        missed = caught & (height - ground > parameters.capture_distance)
        reach = Reach(closed, closed & (reach.missed | missed))
        support = support & ~reach.missed
    touching = support | (height <= ground)
    # a gripper with a capture distance anchors anew when it shuts, though its foot touched before
    fresh = (touching & ~contact.touching) | caught
    below = jnp.concatenate([feet.position[:, :2], ground[:, None]], axis=1)
    grip_point = jnp.where(fresh[:, None], below, contact.grip_point)
    force = parameters.contact_stiffness * (grip_point - feet.position) - parameters.contact_damping * feet.velocity
    force = jnp.where(touching[:, None], force, 0.0)
    if reach:
        push = jnp.where(np.array([False, False, True]), jnp.maximum(force, 0.0), 0.0)
        force = jnp.where((support | ~limited)[:, None], force, push)
    torn_off = support & (force[:, 2] < 0) & (norm(force) > parameters.holding_limit)
    moment = jnp.zeros_like(force)
    if attitude and turning is not None:
        held_on = (support & attitude.held)[:, None, None]
        rotation = jnp.where(held_on, attitude.rotation, turning.rotation)
        moment = parameters.rotational_stiffness * turn_between(turning.rotation, rotation)
        moment = jnp.where(support[:, None], moment - parameters.rotational_damping * turning.velocity, 0.0)
        attitude = Attitude(rotation, support)
    after = Contact(grip_point, touching, contact.detached | torn_off, reach, attitude)
    return after, Grip(force, moment, support, torn_off, missed)
