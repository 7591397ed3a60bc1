"""A robot with a point mass at each foot."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.physics.spatial import skew
from mjx_climb.robot.constants import Robot


def with_foot_mass(robot: Robot, mass: Array | float) -> Robot:
    """Return a robot with a point mass () kg at each foot; the same one where this is a plain 0."""
    if not isinstance(mass, jax.Array) and mass == 0:
        return robot
    own, place, foot = robot.link_mass[:, -1:], robot.link_center[:, -1], robot.foot_center
    center = (own * place + mass * foot) / (own + mass)
    inertia = robot.link_inertia[:, -1]
    for arm, weight in ((place - center, own), (foot - center, mass)):
        crossed = jax.vmap(skew)(jnp.asarray(arm))
        inertia = inertia - jnp.reshape(weight, (-1, 1, 1)) * (crossed @ crossed)
    last = {"link_mass": own[:, 0] + mass, "link_center": center, "link_inertia": inertia}
    new: dict[str, Any] = {name: jnp.asarray(getattr(robot, name)).at[:, -1].set(v) for name, v in last.items()}
    return dataclasses.replace(robot, **new)
