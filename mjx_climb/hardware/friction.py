"""Friction in a joint: dry, of its load too, and viscous.

Dry friction is a bristle, a spring with a damper, that slips once it bears as much as the friction can (an elastic,
perfectly plastic element, also called Jenkin's, damped as LuGre's bristles are). A joint at rest is held by the spring,
not by a viscosity: it does not creep, and what holds it has derivatives.

A bristle that is not to ring is damped more than light links can bear in a step of explicit Euler. So what it bears in
a step is taken at the rates after the step: `(H + A) qdd = f - borne(rates before)` with `A = h dborne/drate` on the
joints' diagonal of H, where an armature is too. It then holds at any time step.
"""

import jax.numpy as jnp
from jax import Array

PRESLIDING = 5e-4  # rad, bend at which it slips: a third of what a servo's encoder of 4096 counts can tell
RELAXATION = 5e-3  # s, damper over spring: close to the critical damping of a link of 1e-3 kg m^2 under 0.1 N m


def bent(bristle: Array, rate: Array, time_step: float) -> Array:
    """Return the bristles after one step at `rate` rad/s: their bend as a share of `PRESLIDING`, -1 to 1."""
    return jnp.clip(bristle + rate * (time_step / PRESLIDING), -1.0, 1.0)


def dry(bristle: Array, rate: Array, most: Array, time_step: float) -> tuple[Array, Array]:
    """Return the torque of dry friction on the joint, N m, and what it adds to the armature in this step, kg m^2.

    Arguments:
        bristle: (..., B), see `bent`.
        rate: (..., B) rad/s.
        most: (..., B) N m, what the friction can bear.
    """
    slope = (RELAXATION + time_step) / PRESLIDING
    share = bristle + rate * slope
    sticks = jnp.abs(share) < 1
    return -most * jnp.clip(share, -1.0, 1.0), jnp.where(sticks, most * (slope * time_step), 0.0)


def viscous(rate: Array, coefficient: Array) -> Array:
    """Return the torque of viscous friction on the joint, N m; `coefficient` (B,) N m s/rad."""
    return -coefficient * rate
