"""The baseline: the joints follow the gait, whatever the forces."""

from jax import Array

from mjx_climb.control.law import Command, Law, Measurement, Reference, Start, no_shift


class PD(Law):
    """The law that commands the gait's own reference. It has no gains."""

    def init(self, start: Start) -> Array:
        """Return the shift that it never makes, (6, B)."""
        return no_shift(start)

    def step(self, state: Array, measurement: Measurement, reference: Reference) -> tuple[Array, Command]:
        """Return the reference as it is."""
        return state, Command(*reference, state)
