"""The baseline: the joints follow the gait, whatever the forces."""

import jax.numpy as jnp

from mjx_climb.control.law import Command, Law, Measurement, Reference, Start


class PD(Law):
    """The law that commands the gait's own reference. It has no gains and no state."""

    def init(self, start: Start) -> tuple[()]:
        """Return nothing."""
        return ()

    def step(self, state: tuple[()], measurement: Measurement, reference: Reference) -> tuple[tuple[()], Command]:
        """Return the reference as it is."""
        return state, Command(*reference, jnp.zeros_like(measurement.wrench))
