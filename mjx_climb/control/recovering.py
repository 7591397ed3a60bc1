"""Thresholds of the recovery as gains, so that they are swept, tuned and stored with those of a law.

`LoadTransfer+Recovering` is load transfer, with the gains of both. A gain `recovery_NAME` of any law takes the place of
`control.recovery.NAME`; this law has nothing else.
"""

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.law import Command, Law, Measurement, Reference, Start, gain


class Recovering(Law):
    """The gait's own reference, interrupted where a threshold is passed."""

    recovery_shift: Array = gain(
        "m", length=1, bounds=(2e-3, 2e-1), default=0.015, long_name="shift of the base that interrupts"
    )
    recovery_utilization: Array = gain(
        "1", length=1, bounds=(1e-1, 1e1), default=0.6, long_name="use of a grip that interrupts"
    )
    recovery_landing_time: Array = gain("s", length=1, bounds=(3e-2, 5e-1), default=0.25, long_name="time of a landing")
    recovery_rest_time: Array = gain(
        "s", length=1, bounds=(2e-2, 2.0), default=1.2, long_name="time at rest after a landing"
    )
    recovery_take_over: Array = gain(
        "1", length=1, bounds=(1e-2, 1.0), default=0.3, long_name="share of a shift that is taken over"
    )
    recovery_return_time: Array = gain(
        "s", length=1, bounds=(1e-1, 1e1), default=1.0, long_name="time of the base's return", searched=False
    )

    def init(self, start: Start) -> tuple[()]:
        """Return no state."""
        return ()

    def step(self, state: tuple[()], measured: Measurement, reference: Reference) -> tuple[tuple[()], Command]:
        """Return the reference as it is."""
        return state, Command(*reference[:3], jnp.zeros_like(reference.base_position, shape=6))
