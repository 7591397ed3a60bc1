"""The seam of disturbances: wrenches and masses from outside."""

import abc
from collections.abc import Iterable
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.component import Component
from mjx_climb.physics.kinematics import LimbFrames, joint_axes
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.physics.state import State
from mjx_climb.robot.constants import Robot


class External(NamedTuple):
    """External loads as the equations of motion take them; None: no such load."""

    # (6,) N, N m: the whole force, and its moment about the base's centre of mass, world axes
    base_wrench: Any = None
    joint_torque: Any = None  # (limb, joint) N m, N of sliding joints
    cargo_mass: Any = None  # () kg, at the base's centre of mass


class Body(NamedTuple):
    """How the robot is in a step."""

    robot: Robot
    frames: LimbFrames  # of the links, in the base's axes
    state: State

    def untouched(self) -> External:
        """Nothing from outside."""
        zero = jnp.zeros_like(self.state.base_position[0])
        return External(jnp.zeros_like(zero, shape=6), jnp.zeros_like(self.state.joint_angles), zero)

    def under(self, force: Array, moment: Array, point: Array) -> External:
        """A force and a moment on each link, by the transpose of the Jacobian of the point where they act.

        Arguments:
            force: (limb, joint, 3) N, in the axes of the base.
            moment: (limb, joint, 3) N m, in the axes of the base.
            point: (limb, joint, 3) m, where the force acts, from the base's centre of mass, in the axes of the base.
        """
        axes, position = joint_axes(self.robot, self.frames), self.frames.position
        about_base = moment + jnp.cross(point, force)
        # a joint bears loads on its own link and on those beyond it
        beyond, turning = _from_foot_inwards(force), _from_foot_inwards(about_base)
        turned = turning - jnp.cross(position, beyond)
        torque = (axes.angular * turned).sum(-1)
        if axes.linear is not None:
            torque = torque + (axes.linear * beyond).sum(-1)
        rotation = quaternion_to_matrix(self.state.base_orientation)
        whole = jnp.concatenate([rotation @ force.sum((0, 1)), rotation @ about_base.sum((0, 1))])
        return self.untouched()._replace(base_wrench=whole, joint_torque=torque)


def _from_foot_inwards(values: Array) -> Array:
    """Sums over each link and those beyond it, of values (limb, joint, 3)."""
    sums = [values[:, -1]]
    for link in reversed(range(values.shape[1] - 1)):
        sums.append(sums[-1] + values[:, link])
    return jnp.stack(sums[::-1], axis=1)


def sum_of(all_of_them: Iterable[External]) -> External:
    """Return the sum of disturbances."""
    total = External()
    for each in all_of_them:
        pairs = zip(total, each, strict=True)
        total = External(*(more if one is None else one if more is None else one + more for one, more in pairs))
    return total


class Disturbance(Component, abc.ABC):
    """Base of disturbances: a class that inherits from it becomes a frozen dataclass and a pytree.

    Fields made by `parameter` are its values. `act` is written for one robot.
    """

    GROUP: ClassVar[str] = "others"  # key in the section `disturbance` of a config
    LISTED: ClassVar[bool] = True  # whether that key has a list of them

    def begins(self) -> Array | None:
        """The instant at which it begins to act, () s; infinite: never. None: not told."""
        return None

    @abc.abstractmethod
    def act(self, time: Array, body: Body) -> External:
        """The loads in a step.

        Arguments:
            time: () s, of the middle of the step: a load that starts at an instant starts with the step nearest to it.
            body: the robot at the beginning of the step.
        """
