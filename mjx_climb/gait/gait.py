"""The seam of gaits: when limbs swing, where base and feet should be, and the ground below the feet."""

import abc
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from mjx_climb.component import Component
from mjx_climb.control import Reference
from mjx_climb.gait.schedule import Schedule
from mjx_climb.physics.contact.contact import Grip
from mjx_climb.physics.kinematics import Surface


class Body(NamedTuple):
    """State of the robot as a whole, for the decisions of a gait; world axes."""

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
    base_position: Array  # (3,) m
    base_rotation: Array  # (3, 3)
    grip_point: Array  # (limb, 3) m, where feet grip or last gripped


class Gait(Component, abc.ABC):
    """Base of gaits, whose methods are written for one robot; the memory is a pytree that keeps its shapes."""

    @abc.abstractmethod
    def init(self) -> tuple[PyTree, Reference]:
        """The memory of a robot that has not swung, and its reference, with the feet on their first footholds."""

    @abc.abstractmethod
    def schedule(self, memory: PyTree, step: Array) -> Schedule:
        """The phases of the limbs at a step, () integer."""

    @abc.abstractmethod
    def ground(self, memory: PyTree, now: Schedule) -> tuple[Array, Surface | None]:
        """The height of the ground below each foot, (limb,) m, and its planes there; None: it is level."""

    @abc.abstractmethod
    def reference(
        self, memory: PyTree, now: Schedule, step: Array, base_position: Array, grip_point: Array
    ) -> tuple[PyTree, Reference]:
        """The memory after a step, and the reference at it.

        Arguments:
            base_position: (3,) m, world, of the base.
            grip_point: (limb, 3) m, world: shut grippers stay there.
        """

    def look_ahead(self, memory: PyTree, now: Schedule, step: Array, reference: Reference, body: Body) -> PyTree:
        """The memory after the decisions of a planning period, before the step with which it begins."""
        return memory

    def after_contacts(self, memory: PyTree, now: Schedule, step: Array, grip: Grip) -> PyTree:
        """The memory after a step whose contacts are known."""
        return memory

    def stands(self, memory: PyTree, grip: Grip) -> Array:
        """Which limbs found no grip, so that the robot stands, (limb,) bool."""
        return jnp.zeros_like(grip.support)

    def share_of_limits(self, memory: PyTree, now: Schedule, foot_force: Array) -> Array | None:
        """The share of its hold's limit that a force (limb, 3) N on each foot uses, (limb,); None: no hold has one."""
        return None

    def pulls(self, memory: PyTree, now: Schedule, surface: Surface | None, holding_force: Array) -> Array:
        """The pulls that margins may count on, () N; on holds (limb, 3) N, each foot's times its hold's normal.

        `holding_force` () N is that of the contact; 0: it names none, and that of the hold counts.
        """
        return holding_force
