"""Eq. 3 of the paper behind a low-pass filter, with two gains of its own."""

import jax.numpy as jnp

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance


class Filtered(VirtualModelAdmittance):
    """Base admittance that sees the wrench through a first-order filter."""

    cutoff: object = mc.gain("Hz", bounds=(1.0, 200.0), default=20.0, long_name="cut-off of the filter")
    share: object = mc.gain("1", length=1, bounds=(0.05, 1.0), default=1.0, long_name="share of the wrench")

    def init(self, start):
        """Return the state of Eq. 3, the filter's poles (6,) and its last output (6,)."""
        return super().init(start), jnp.exp(-2 * jnp.pi * self.cutoff * start.period), jnp.zeros(6)

    def step(self, state, measured, reference):
        """Filter the wrench, then do what Eq. 3 does with it."""
        mass, pole, before = state
        wrench = pole * before + (1 - pole) * self.share * measured.wrench
        mass, command = super().step(mass, measured._replace(wrench=wrench), reference)
        return (mass, pole, wrench), command
