"""Play in the gears of a joint."""

import jax.numpy as jnp
from jax import Array


def across(error: Array, backlash: Array) -> Array:
    """Return the part of a position error (..., B) rad that the gears pass on.

    The motor rests at its target; the link is free to move by half the play `backlash` (B,) rad to either side.
    """
    play = backlash / 2
    return error - jnp.clip(error, -play, play)
