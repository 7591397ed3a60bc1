"""Joints that are commanded by velocity: a manager turns position errors into rates, and the motor follows them.

The drivers of the paper's first author are of this kind: p = 10 1/s and d = 0.1 under a manager of 1 kHz.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import parameter
from mjx_climb.hardware.actuator import Actuator, ActuatorGains, Drive, Joints, JointSpring


class Commanded(NamedTuple):
    """Memory of the manager."""

    rate: Array  # (limb, joint) rad/s, commanded
    error: Array  # (limb, joint) rad, of the position when it was commanded
    age: Array  # () 1, time steps since then


class VelocityCommanded(Actuator):
    """A manager commands the rate `p e + d de/dt` of the position error e, and the motor follows it.

    The motor gives `velocity_gain` times the error of its rate, up to its torque limit. This loop is stiff: its torque
    is taken at the rates after the step, `(H + A) qdd = f + velocity_gain (command - rates)` with `A = h
    velocity_gain`, and holds at any time step. The config's kp and kd, and a law's factors of them, have no part in it.
    """

    KIND = "velocity"

    p: Array = parameter("1/s", bounds=(0.1, 1e3), default=10.0, long_name="rate per position error")
    d: Array = parameter("1", bounds=(0.0, 10.0), default=0.1, long_name="rate per rate of the position error")
    manager_period: Array = parameter("s", bounds=(0.0, 1.0), default=1e-3, long_name="period of the manager")
    velocity_gain: Array = parameter("N m s/rad", bounds=(1e-3, 1e3), default=5.0, long_name="gain of the motor's loop")
    largest_rate: Array = parameter("rad/s", bounds=(1e-3, np.inf), default=np.inf, long_name="largest commanded rate")
    armature: Array = parameter("kg m^2", bounds=(0.0, 10.0), default=0.0, long_name="armature")
    torque_limit: Array = parameter("N m", bounds=(1e-3, np.inf), default=np.inf, long_name="torque limit")

    def spring(self, period: float) -> JointSpring:
        """The manager's rate times the gain of the motor's loop, whose damping is taken after the step."""
        return JointSpring(
            self.velocity_gain * self.p, self.velocity_gain * (1 + self.d), self.velocity_gain * period + self.armature
        )

    def init(self, angles: Array) -> Commanded:
        """The memory of joints at rest."""
        none = jnp.zeros_like(angles)
        return Commanded(none, none, jnp.zeros_like(angles, shape=()))

    def step(
        self, memory: Commanded, targets: Array, gains: ActuatorGains, joints: Joints, period: float
    ) -> tuple[Commanded, Drive]:
        """The manager's memory after a step, and the motors' torques in it."""
        steps = jnp.maximum(jnp.round(jnp.asarray(self.manager_period) / period), 1.0)
        error, now = targets - joints.angles, memory.age == 0
        wanted = self.p * error + self.d * (error - memory.error) / (steps * period)
        rate = jnp.where(now, jnp.clip(wanted, -self.largest_rate, self.largest_rate), memory.rate)
        age = memory.age + 1
        age = jnp.where(age < steps - 0.5, age, 0.0)
        asked = self.velocity_gain * (rate - joints.rates)
        torque = jnp.clip(asked, -self.torque_limit, self.torque_limit)
        armature = self.armature + jnp.where(jnp.abs(asked) < self.torque_limit, self.velocity_gain * period, 0.0)
        return Commanded(rate, jnp.where(now, error, memory.error), age), Drive(torque, torque, armature)
