"""Cargo and pushes on the base, each in its window of time."""

from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from mjx_climb.disturbances.disturbance import Body, Disturbance, External
from mjx_climb.scenario import declared


class Cargo(declared.Cargo, Disturbance):
    """A point mass at the base's centre of mass, from `start` until before `stop`."""

    GROUP: ClassVar[str] = "cargo"
    LISTED: ClassVar[bool] = False

    def begins(self) -> Array:
        """The instant of loading; infinite without a mass or a time."""
        return jnp.where((jnp.asarray(self.mass) > 0) & (self.stop > self.start), self.start, jnp.inf)

    def act(self, time: Array, body: Body) -> External:
        """The mass, while it is there."""
        return External(cargo_mass=jnp.where((time >= self.start) & (time < self.stop), self.mass, 0.0))


class Push(declared.Push, Disturbance):
    """A constant force and moment on the base, world axes, from `start` until before `stop`."""

    GROUP: ClassVar[str] = "pushes"

    def begins(self) -> Array:
        """The first instant; infinite without a wrench or a time."""
        some = (jnp.asarray(self.force) != 0).any() | (jnp.asarray(self.moment) != 0).any()
        return jnp.where(some & (self.stop > self.start), self.start, jnp.inf)

    def act(self, time: Array, body: Body) -> External:
        """The wrench, while it lasts."""
        wrench = jnp.concatenate([jnp.asarray(self.force), jnp.asarray(self.moment)])
        return External(base_wrench=jnp.where((time >= self.start) & (time < self.stop), wrench, 0.0))
