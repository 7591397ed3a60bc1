"""A known mass that hangs on each foot while a log is made."""

import jax.numpy as jnp

from mjx_climb.dynamics.foot_mass import with_foot_mass
from mjx_climb.robot.constants import Robot


def with_mass(robot: Robot, mass: float) -> Robot:
    """Return a robot with a point mass at each foot, kg."""
    return robot if mass == 0 else with_foot_mass(robot, jnp.asarray(mass, float))
