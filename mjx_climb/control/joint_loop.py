"""The joints' own loop, the same under every law."""

import jax.numpy as jnp
from jax import Array

from mjx_climb.quantities.parameters import Parameters


def joint_torque(numbers: Parameters, target: Array, joint_angles: Array, joint_rates: Array) -> Array:
    """Return `tau = kp (phi_des - phi) - kd phidot`, (3, L, B) N m; the desired rate is zero."""
    return jnp.asarray(numbers.kp * (target - joint_angles) - numbers.kd * joint_rates)
