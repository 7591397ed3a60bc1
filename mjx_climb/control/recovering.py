"""Thresholds of the recovery as gains, so that they are swept, tuned and stored with those of a law.

`LoadTransfer+Recovering` is load transfer, with the gains of both. A gain `recovery_NAME` of any law takes the place of
`control.recovery.NAME`; this law has nothing else.
"""

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.law import Command, Law, Measurement, Reference, Start, scalar


class Recovering(Law):
    """The gait's own reference, interrupted where a threshold is passed."""

    recovery_shift: Array = scalar("m", "shift of the base that interrupts", bounds=(2e-3, 2e-1), default=0.015)
    recovery_utilization: Array = scalar("1", "use of a grip that interrupts", bounds=(1e-1, 1e1), default=0.6)
    recovery_landing_time: Array = scalar("s", "time of a landing", bounds=(3e-2, 5e-1), default=0.25)
    recovery_rest_time: Array = scalar("s", "time at rest after a landing", bounds=(2e-2, 2.0), default=1.2)
    recovery_take_over: Array = scalar("1", "share of a shift that is taken over", bounds=(1e-2, 1.0), default=0.3)
    recovery_return_time: Array = scalar(
        "s", "time of the base's return", bounds=(1e-1, 1e1), default=1.0, searched=False
    )

    def init(self, start: Start) -> tuple[()]:
        """Return no state."""
        return ()

    def step(self, state: tuple[()], measured: Measurement, reference: Reference) -> tuple[tuple[()], Command]:
        """Return the reference as it is."""
        return state, Command(*reference[:3], jnp.zeros_like(reference.base_position, shape=6))
