"""The seam of actuators: from joint targets to the torques on the joints."""

import abc
from typing import NamedTuple

from jax import Array
from jaxtyping import PyTree

from mjx_climb.component import Component
from mjx_climb.scenario import declared


class JointLoop(declared.JointLoop, Component):
    """Gains of the joint loop, those of all joints alike."""


class ActuatorGains(NamedTuple):
    """Gains of the joint loop in a step."""

    kp: Array  # () or (limb, joint) N m/rad
    kd: Array  # () or (limb, joint) N m s/rad
    ki: Array | float = 0.0  # () or (limb, joint) N m/(rad s); felt where the actuator integrates


class Joints(NamedTuple):
    """The true state of the joints in a step, not the encoders'."""

    angles: Array  # (limb, joint) rad, m of sliding joints
    rates: Array  # (limb, joint) rad/s, m/s
    load: Array | None  # (limb, joint) N m, of all but the actuators; None unless the actuator asks for it


class Drive(NamedTuple):
    """Torques of the actuators in a step."""

    motor_torque: Array  # (limb, joint) N m
    joint_torque: Array  # (limb, joint) N m, less friction
    armature: Array | None = None  # (limb, joint) kg m^2, inertia of the motors at the joints, in this step


class JointSpring(NamedTuple):
    """How a joint is held at its target, as a linear spring and damper, for the check of the time step."""

    stiffness: Array | float  # N m/rad
    damping: Array | float  # N m s/rad
    armature: Array | float = 0.0  # kg m^2, of `Drive`


class Actuator(Component, abc.ABC):
    """Base of actuators: a class that inherits from it becomes a frozen dataclass and a pytree.

    Fields made by `parameter` are its values. `init` and `step` are written for one robot, for all joints at once.
    """

    @property
    def feels_load(self) -> bool:
        """Whether `step` asks for the load on the joints."""
        return False

    def spring(self, period: float) -> JointSpring | None:
        """The spring that holds a joint, for the check of a time step, s; None: not known, and not checked."""
        return None

    @abc.abstractmethod
    def init(self, angles: Array) -> PyTree:
        """The memory of actuators that have always rested at joint angles (limb, joint) rad, under no torque."""

    @abc.abstractmethod
    def step(
        self, memory: PyTree, targets: Array, gains: ActuatorGains, joints: Joints, period: float
    ) -> tuple[PyTree, Drive]:
        """The memory after a step, of the same structure and shapes, and the actuators' torques in it.

        Arguments:
            memory: of `init` or the step before.
            targets: of the joints, (limb, joint) rad, as the bus delivers them.
            gains: of the joint loop, those of the config times the law's factors.
            joints: angles, rates and load.
            period: length of the step, s.
        """
