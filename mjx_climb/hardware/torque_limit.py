"""What a motor can give: a torque at standstill, less along a straight line with its speed."""

import jax.numpy as jnp
from jax import Array


def limited(torque: Array, rate: Array, torque_limit: Array, no_load_speed: Array) -> Array:
    """Return the torque that the motor gives, N m, for the one that is asked for.

    With the motion it falls to nothing at the no-load speed and brakes beyond it; against the motion it is limited
    alone.

    Arguments:
        torque, rate: (..., B) N m and rad/s.
        torque_limit: (B,) N m, at standstill; infinite: none.
        no_load_speed: (B,) rad/s; infinite: the same limit at any speed.
    """
    slowness = rate / no_load_speed
    bound = jnp.where(jnp.isfinite(torque_limit), torque_limit, 0.0)
    upper, lower = bound * jnp.clip(1 - slowness, -1.0, 1.0), -bound * jnp.clip(1 + slowness, -1.0, 1.0)
    return jnp.where(jnp.isfinite(torque_limit), jnp.clip(torque, lower, upper), torque)
