"""Cargo and pushes on the base, each in its window of time."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import FINITE, NONNEGATIVE, UNLIMITED, parameter
from mjx_climb.disturbances.disturbance import Body, Disturbance, External


class Cargo(Disturbance):
    """A point mass at the base's centre of mass, from `start` until before `stop`."""

    GROUP: ClassVar[str] = "cargo"
    LISTED: ClassVar[bool] = False

    mass: Array = parameter("kg", bounds=NONNEGATIVE, default=0.0, long_name="mass of the cargo")
    start: Array = parameter("s", bounds=NONNEGATIVE, default=2.0, long_name="loading of the cargo", in_steps=True)
    stop: Array = parameter("s", bounds=UNLIMITED, default=np.inf, long_name="unloading of the cargo", in_steps=True)

    def begins(self) -> Array:
        """The instant of loading; infinite without a mass or a time."""
        return jnp.where((jnp.asarray(self.mass) > 0) & (self.stop > self.start), self.start, jnp.inf)

    def act(self, time: Array, body: Body) -> External:
        """The mass, while it is there."""
        return External(cargo_mass=jnp.where((time >= self.start) & (time < self.stop), self.mass, 0.0))


class Push(Disturbance):
    """A constant force and moment on the base, world axes, from `start` until before `stop`."""

    GROUP: ClassVar[str] = "pushes"

    force: Array = parameter("N", shape=(3,), bounds=FINITE, default=0.0, long_name="force of the push")
    moment: Array = parameter("N m", shape=(3,), bounds=FINITE, default=0.0, long_name="moment of the push")
    start: Array = parameter("s", bounds=NONNEGATIVE, default=0.0, long_name="start of the push", in_steps=True)
    stop: Array = parameter("s", bounds=UNLIMITED, default=np.inf, long_name="end of the push", in_steps=True)

    def begins(self) -> Array:
        """The first instant; infinite without a wrench or a time."""
        some = (jnp.asarray(self.force) != 0).any() | (jnp.asarray(self.moment) != 0).any()
        return jnp.where(some & (self.stop > self.start), self.start, jnp.inf)

    def act(self, time: Array, body: Body) -> External:
        """The wrench, while it lasts."""
        wrench = jnp.concatenate([jnp.asarray(self.force), jnp.asarray(self.moment)])
        return External(base_wrench=jnp.where((time >= self.start) & (time < self.stop), wrench, 0.0))
