"""The baseline: the joints follow the gait, whatever the forces."""

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.law import Command, Law, Measurement, Reference
from mjx_climb.quantities.parameters import Gains


def build(gains: Gains, time_step: float | Array) -> Law:
    """Return the law that commands the gait's own reference."""
    del time_step
    no_shift = jnp.zeros_like(gains.stiffness)

    def command(state: tuple[()], measurement: Measurement, reference: Reference) -> tuple[tuple[()], Command]:
        return state, Command(*reference, no_shift)

    return Law(initial=(), command=command)
