"""Eq. 3 of the paper behind a low-pass filter, with two parameters of its own."""

import jax.numpy as jnp

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance


class Filtered(VirtualModelAdmittance):
    """Base admittance that sees the wrench through a first-order filter."""

    cutoff: object = mc.gain("Hz", bounds=(1.0, 200.0), default=20.0, long_name="cut-off of the filter")
    share: object = mc.gain("1", length=1, bounds=(0.05, 1.0), default=1.0, long_name="share of the wrench")

    def init(self, start):
        """Return the state of Eq. 3, the filter's pole and its last output, (6, B) each."""
        pole = jnp.exp(-2 * jnp.pi * self.cutoff * start.period)
        return super().init(start), pole, jnp.zeros_like(pole)

    def step(self, state, measurement, reference):
        """Filter the wrench, then do what Eq. 3 does with it."""
        inner, pole, before = state
        wrench = pole * before + (1 - pole) * self.share * measurement.wrench
        inner, command = super().step(inner, measurement._replace(wrench=wrench), reference)
        return (inner, pole, wrench), command
