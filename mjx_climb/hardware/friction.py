"""Friction in a joint: dry, of its load too, and viscous.

Dry friction is a bristle that bends by `PRESLIDING` before it slips (an elastic, perfectly plastic spring, also called
Jenkin's element). A joint at rest is held by a spring, not by a viscosity: it does not creep, and what holds it is
smooth. The spring is evaluated as the contacts' springs are, so it is stable where they are: `checks.time_step` asks.
"""

import jax.numpy as jnp
from jax import Array

PRESLIDING = 5e-4  # rad: a third of what a servo's encoder of 4096 counts can tell


def bent(bristle: Array, rate: Array, time_step: float) -> Array:
    """Return the bristles after one step at `rate` rad/s: their bend as a share of what they bear, -1 to 1."""
    return jnp.clip(bristle + rate * (time_step / PRESLIDING), -1.0, 1.0)


def dry(bristle: Array, motor_torque: Array, coulomb: Array, load: Array) -> Array:
    """Return the torque of dry friction on the joint, N m.

    Arguments:
        bristle: (..., B), see `bent`.
        motor_torque: (..., B) N m, through the gears.
        coulomb: (B,) N m.
        load: (B,) 1, share of the motor's torque that is lost.
    """
    return -(coulomb + load * jnp.abs(motor_torque)) * bristle


def viscous(rate: Array, coefficient: Array) -> Array:
    """Return the torque of viscous friction on the joint, N m; `coefficient` (B,) N m s/rad."""
    return -coefficient * rate
