"""The seam of contacts: the forces between feet and ground, and the loss of a grip."""

import abc
from typing import ClassVar, NamedTuple, TypeVar

import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from mjx_climb.component import Component
from mjx_climb.physics.kinematics import Feet, Turning

AnyContact = TypeVar("AnyContact", bound="Contact")


class Grip(NamedTuple):
    """Contacts of one step; forces and moments are those of the ground on the feet, world axes."""

    foot_force: Array  # (limb, 3) N
    foot_moment: Array  # (limb, 3) N m; zero unless grips transmit moments
    grip_point: Array  # (limb, 3) m, world, where the foot grips or last gripped
    support: Array  # (limb,) bool: the gripper holds
    contact: Array  # (limb,) bool: the ground acts on the foot
    detached: Array  # (limb,) bool: the gripper was torn off before this step, for good
    torn_off: Array  # (limb,) bool: the gripper is torn off in this step, and lets go from the next one on
    missed: Array  # (limb,) bool: the gripper shut out of reach, or gave up, in this step: the foot may try again
    utilization: Array  # (limb,) 1, share of its limit that a grip uses; 0 without a grip, above 1 it cannot hold


def along_normal(vector: Array, feet: Feet) -> Array:
    """Return the parts of vectors (limb, 3) along the ground's normal, (limb,)."""
    return vector[:, 2] if feet.surface is None else (vector * feet.surface.normal).sum(1)


def clearance(feet: Feet, ground: Array) -> tuple[Array, Array]:
    """Return how far feet are off the ground, (limb,) m, and the points of the ground below them, (limb, 3) m.

    `ground` is its height, (limb,) m, where z is the normal.
    """
    position, surface = feet.position, feet.surface
    if surface is None:
        return position[:, 2] - ground, jnp.concatenate([position[:, :2], ground[:, None]], axis=1)
    off = ((position - surface.point) * surface.normal).sum(1)
    return off, position - off[:, None] * surface.normal


class Springs(NamedTuple):
    """How a foot is held, as linear springs and dampers, for the check of the time step."""

    stiffness: Array | float  # N/m
    damping: Array | float  # N s/m
    rotational_stiffness: Array | float = 0.0  # N m/rad
    rotational_damping: Array | float = 0.0  # N m s/rad


class Contact(Component, abc.ABC):
    """Base of contacts: a class that inherits from it becomes a frozen dataclass and a pytree.

    Fields made by `parameter` are its values. `init` and `step` are written for one robot.
    """

    may_fail: ClassVar[bool] = False  # whether grips may fail that are within reach: the gait waits for them

    def set_up(self: AnyContact, time_step: float) -> AnyContact:
        """This contact for walks of a time step, s."""
        return self

    @property
    def transmits_moments(self) -> bool:
        """Whether the contact turns the feet: `step` is then given how they are turned."""
        return False

    @abc.abstractmethod
    def init(self, grip_point: Array, rotation: Array) -> PyTree:
        """The memory of contacts whose grippers are all shut and rest.

        Arguments:
            grip_point: (limb, 3) m, world, where the feet are.
            rotation: (limb, 3, 3), of the links that end in feet, to world axes.
        """

    @abc.abstractmethod
    def step(
        self, memory: PyTree, feet: Feet, turning: Turning | None, closed: Array, ground: Array
    ) -> tuple[PyTree, Grip]:
        """The memory after a step, of the same structure and shapes, and the contacts in it.

        Arguments:
            memory: of `init` or the step before.
            feet: position, velocity and lever of the feet, world axes; the surface below them, where there are holds.
            turning: attitude of the feet; None unless the contact transmits moments.
            closed: (limb,) bool, which grippers are commanded shut.
            ground: (limb,) m, height of the ground below each foot.
        """

    def tear_off(self, memory: PyTree, grip: Grip, torn: Array) -> tuple[PyTree, Grip]:
        """Memory and contacts of a step in which some grips (limb,) are torn off by holds that bear less than they."""
        raise NotImplementedError(f"{type(self).__name__}.tear_off")

    def holding_force(self) -> Array | float:
        """The pull along the ground's normal that stability margins may count on, () N; 0: none."""
        return 0.0

    def springs(self) -> Springs | None:
        """The springs that hold a foot, for the check of the time step; None: not known, and left out there."""
        return None

    def unbreakable(self: AnyContact) -> AnyContact:
        """A contact that never lets go and reports the same utilization, for searches that need smooth walks.

        This one where it cannot break.
        """
        return self
