"""The gripper of the paper's Eq. 5: a spring-damper between a foot and the point where it gripped, and its letting go.

`F_e = k_s (p_grip - p) - d_s pdot` per axis, both ways, N. An open gripper's foot feels the ground at or below it.
"""

import dataclasses
from collections.abc import Collection
from typing import Any, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from mjx_climb.component import given
from mjx_climb.physics.contact.contact import Contact, Grip, Springs, along_normal, clearance
from mjx_climb.physics.kinematics import Feet, Turning, turn_between
from mjx_climb.physics.spatial import norm
from mjx_climb.scenario import declared

_TINY = 1e-30  # N, of a limit of zero
_UP = np.array([0.0, 0.0, 1.0])
_NORMAL = np.array([False, False, True])  # of the ground, among the axes of the world


def _compiled(default: Any) -> Any:
    return dataclasses.field(default=default, metadata={"compiled": True})


class Reach(NamedTuple):
    """Memory of grippers with a capture distance."""

    shut: Array  # (limb,) bool: commanded shut at the last step
    missed: Array  # (limb,) bool: shut out of reach, and open since


class Attitude(NamedTuple):
    """Memory of grips that transmit moments."""

    rotation: Array  # (limb, 3, 3), of the foot when its gripper last shut
    held: Array  # (limb,) bool: the gripper held at the last step


class GripperMemory(NamedTuple):
    """Memory of the contacts from step to step."""

    grip_point: Array  # (limb, 3) m, world
    touching: Array  # (limb,) bool: the ground acted on the foot at the last step
    detached: Array  # (limb,) bool: the gripper was torn off, for good
    reach: Reach | None = None  # where grippers have a capture distance
    attitude: Attitude | None = None  # where grips transmit moments
    closing: "Closing | None" = None  # where grippers take time to close


class Closing(NamedTuple):
    """Memory of grippers that take time to close."""

    held: Array  # (limb,) bool: the gripper held at the last step
    pressed: Array  # (limb,) bool: the ground acted on the foot when the gripper shut
    closure: Array  # (limb,) 1, how far the gripper has closed


class SpringGrip(declared.SpringGrip, Contact):
    """A gripper that holds its foot to the grip point both ways; a subclass says when it is torn off.

    The grip point is below the foot, on the ground, where the gripper shuts or the foot first touches. With a finite
    capture distance a gripper that shuts further off the ground holds nothing and stays open until its next swing, and
    the ground only pushes a foot whose gripper is open, along its normal. A grip with a rotational stiffness also keeps
    its foot from turning, by the sine of the angle since it shut (the gradient of a potential of
    1 - cos) and by the rate; it lets go by its force alone.

    With a closing time a gripper that shuts off the ground holds its foot where it is, without force. The grip point is
    then drawn to the ground: its gap falls to 1/e in this time, while the pull on the foot stays below the closing
    force, and the damper comes in alike.
    """

    # structure of the walk, by the values of its robots
    limited_reach: bool = _compiled(False)  # some gripper has a capture distance
    rotational: bool = _compiled(False)  # grips transmit moments
    closes: bool = _compiled(False)  # some gripper takes time to close
    time_step: float = _compiled(1e-3)  # s, of the walk
    breaks: bool = _compiled(True)  # grips are torn off

    def compiled_for(self, moving: Collection[str] = ()) -> Self:
        """Grippers with a reach, and with moments, where some robot has them."""
        reach = "capture_distance" in moving or bool(np.isfinite(np.asarray(self.capture_distance)).any())
        turns = "rotational_stiffness" in moving or given(self.rotational_stiffness)
        closes = "closing_time" in moving or given(self.closing_time)
        return dataclasses.replace(self, limited_reach=reach, rotational=turns, closes=closes)

    def set_up(self, time_step: float) -> Self:
        """Grippers that know the time step of a walk, s."""
        return dataclasses.replace(self, time_step=time_step) if self.closes else self

    @property
    def transmits_moments(self) -> bool:
        """Whether grips have a rotational stiffness."""
        return self.rotational

    def init(self, grip_point: Array, rotation: Array) -> PyTree:
        """The memory of grippers that are shut at their grip points and rest."""
        shut = jnp.ones(len(grip_point), bool)
        reach = Reach(shut, ~shut) if self.limited_reach else None
        attitude = Attitude(rotation, ~shut) if self.rotational else None
        closing = Closing(shut, shut, jnp.ones_like(grip_point[:, 0])) if self.closes else None
        return GripperMemory(grip_point, shut, ~shut, reach, attitude, closing)

    def step(
        self, memory: PyTree, feet: Feet, turning: Turning | None, closed: Array, ground: Array
    ) -> tuple[PyTree, Grip]:
        """The memory after a step, and the contacts in it; no grip is torn off."""
        off, below = clearance(feet, ground)
        support, missed, caught = closed & ~memory.detached, jnp.zeros_like(closed), jnp.zeros_like(closed)
        reach, attitude = memory.reach, memory.attitude
        if reach is not None:
            limited = jnp.isfinite(self.capture_distance)
            caught = support & ~reach.shut & limited
            missed = caught & (off > self.capture_distance)
            reach = Reach(closed, closed & (reach.missed | missed))
            support = support & ~reach.missed
        touching = support | (off <= 0)
        # a gripper with a capture distance anchors anew when it shuts, though its foot touched before
        fresh = (touching & ~memory.touching) | caught
        # ClimbLab takes the nearest point of a map of 0.98 mm pitch, and contacts begin with a kick (departure 4)
        anchor, closing = below, memory.closing
        if closing is not None:
            slow = jnp.asarray(self.closing_time) > 0
            anchor = jnp.where((support & slow & (off > 0))[:, None], feet.position, below)
        grip_point = jnp.where(fresh[:, None], anchor, memory.grip_point)
        if closing is not None:
            grip_point, closing = self._closed(closing, grip_point, feet, ground, support, fresh | ~memory.touching)
        # paper Eq. 5, with the true velocity of the foot: ClimbLab's damper takes the free-floating Jacobian's, which
        # adds energy (docs/explanation/departures.md, 3)
        drag = self.damping * feet.velocity
        if closing is not None:
            drag = _with_closure(drag, feet, closing)
        force = self.stiffness * (grip_point - feet.position) - drag
        force = jnp.where(touching[:, None], force, 0.0)
        if reach is not None:
            push = jnp.where(_NORMAL, jnp.maximum(force, 0.0), 0.0)
            if feet.surface is not None:
                push = jnp.maximum(along_normal(force, feet), 0.0)[:, None] * feet.surface.normal
            force = jnp.where((support | ~limited)[:, None], force, push)
        moment = jnp.zeros_like(force)
        if attitude is not None and turning is not None:
            moment, attitude = self._held_attitude(attitude, turning, support)
        after = GripperMemory(grip_point, touching, memory.detached, reach, attitude, closing)
        none = jnp.zeros_like(support)
        grip = Grip(force, moment, grip_point, support, touching, memory.detached, none, missed, force[:, 2] * 0)
        return after, grip

    def used(self, memory: PyTree, grip: Grip, utilization: Array) -> tuple[PyTree, Grip]:
        """Memory and contacts with the shares (limb,) of their limits that grips use; those above 1 are torn off."""
        grip = grip._replace(utilization=jnp.where(grip.support, utilization, 0.0))
        return self.tear_off(memory, grip, grip.utilization > 1) if self.breaks else (memory, grip)

    def tear_off(self, memory: PyTree, grip: Grip, torn: Array) -> tuple[PyTree, Grip]:
        """Memory and contacts with some grips torn off in this step."""
        return memory._replace(detached=memory.detached | torn), grip._replace(torn_off=grip.torn_off | torn)

    def springs(self) -> Springs:
        """Those of Eq. 5, and of grips that transmit moments."""
        if not self.rotational:
            return Springs(self.stiffness, self.damping)
        return Springs(self.stiffness, self.damping, self.rotational_stiffness, self.rotational_damping)

    def unbreakable(self) -> Self:
        """Grips that never let go."""
        return dataclasses.replace(self, breaks=False)

    def _closed(
        self, closing: Closing, grip_point: Array, feet: Feet, ground: Array, support: Array, fresh: Array
    ) -> tuple[Array, Closing]:
        """The grip points (limb, 3) m of grippers after a step of closing, and their memory."""
        shuts, slow = support & ~closing.held, jnp.asarray(self.closing_time) > 0
        share = jnp.where(slow, -jnp.expm1(-self.time_step / jnp.where(slow, self.closing_time, 1.0)), 1.0)
        gap, _ = clearance(feet._replace(position=grip_point), ground)
        off, _ = clearance(feet, ground)
        # the lowest grip point at which the spring pulls no harder than the gripper closes
        lowest = off - self.closing_force / self.stiffness
        drawn = jnp.maximum(gap * (1 - share), jnp.minimum(gap, lowest))
        draws = support & ~shuts & slow & (gap > 0)
        # no quotient of two gaps: they fall to 1e-20 m, whose squares in derivatives are not finite in float32
        moved = grip_point - (gap - drawn)[:, None] * _normals(feet)
        closure = jnp.where(shuts, jnp.where(slow & fresh, 0.0, 1.0), closing.closure + (1 - closing.closure) * share)
        pressed = jnp.where(shuts, off <= 0, closing.pressed)
        return jnp.where(draws[:, None], moved, grip_point), Closing(support, pressed, jnp.where(support, closure, 1.0))

    def _held_attitude(self, attitude: Attitude, turning: Turning, support: Array) -> tuple[Array, Attitude]:
        """The moments that keep feet from turning, (limb, 3) N m, and the attitudes that they hold."""
        held = (support & attitude.held)[:, None, None]
        rotation = jnp.where(held, attitude.rotation, turning.rotation)
        moment = self.rotational_stiffness * turn_between(turning.rotation, rotation)
        moment = jnp.where(support[:, None], moment - self.rotational_damping * turning.velocity, 0.0)
        return moment, Attitude(rotation, support)


def _with_closure(drag: Array, feet: Feet, closing: Closing) -> Array:
    """The drag (limb, 3) N of dampers that come in as grippers close; along the normal pressed feet feel all of it."""
    along = along_normal(drag, feet)
    whole = jnp.where(closing.pressed, along * (1 - closing.closure), 0.0)
    return closing.closure[:, None] * drag + whole[:, None] * _normals(feet)


def _normals(feet: Feet) -> Array:
    """The ground's normals below feet, (limb, 3)."""
    return jnp.broadcast_to(_UP, feet.position.shape) if feet.surface is None else feet.surface.normal


class Gripper(declared.Gripper, SpringGrip):
    """A grip with one limit (ClimbLab's rule).

    A supporting limb lets go, from the next step on, when the ground pulls its foot down and the whole force is larger
    than the holding limit.
    """

    KIND = "gripper"

    def step(
        self, memory: PyTree, feet: Feet, turning: Turning | None, closed: Array, ground: Array
    ) -> tuple[PyTree, Grip]:
        """The memory after a step, and the contacts in it."""
        after, grip = super().step(memory, feet, turning, closed, ground)
        return self.used(after, grip, self.utilization(grip.foot_force, along_normal(grip.foot_force, feet)))

    def utilization(self, force: Array, normal: Array) -> Array:
        """The share of the holding limit that forces of the ground on the feet use, (limb,) 1.

        Arguments:
            force: (limb, 3) N.
            normal: (limb,) N, their parts along the ground's normal.
        """
        # ClimbLab's rule with the 15 N of the paper (docs/explanation/departures.md, 11)
        return jnp.where(normal < 0, norm(force) / jnp.maximum(self.holding_limit, _TINY), 0.0)

    def holding_force(self) -> Array:
        """The holding limit, () N; 0 where grippers are never torn off: margins are then those of bare feet."""
        return jnp.where(jnp.isfinite(self.holding_limit), self.holding_limit, 0.0)
