"""What the world does to the base: cargo and pushes, each in its window of time."""

import jax.numpy as jnp
from jax import Array

from mjx_climb.quantities.parameters import Parameters
from mjx_climb.walk.gait import Plan


def acting(parameters: Parameters, plan: Plan, step: Array) -> tuple[Array, Array]:
    """Return the cargo at the base's centre of mass, () kg, and force and moment there, (6,) N and N m, world axes."""
    loaded, pushed = ((step >= start) & (step < stop) for start, stop in (plan.cargo, plan.pushes))
    wrenches = jnp.concatenate([parameters.push_force, parameters.push_moment], axis=1)
    cargo = jnp.where(loaded, parameters.cargo_mass, 0.0)
    return cargo, jnp.where(pushed[:, None], wrenches, 0.0).sum(0)
