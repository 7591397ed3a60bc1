"""A learned law with memory: neurons that forget, each in a time of its own, shift the feet by the measured forces.

    python docs/studies/ceiling_laws.py results/laws 1_2 memory --members 4096 --minutes 3

searches its 876 numbers beside load transfer, by gradients of an adjoint over 4,096 walks.
"""

import jax.numpy as jnp
import numpy as np

import mjx_climb as mc

INNER, FEET = 32, 4
FORCE, SHIFT = 10.0, 2e-3  # N and m, the size of what goes in and comes out
TIME = 0.05  # s, within which feet follow

WEIGHTS = np.random.default_rng(0).normal(0, 0.3, (INNER, 3 * FEET))


class Remembering(mc.Law):
    """Twelve forces, 32 neurons, twelve shifts: `memory dn/dt = tanh(inner F) - n`, `TIME dx/dt = g(output n) - x`."""

    inner: object = mc.gain("1", shape=(INNER, 3 * FEET), bounds=(-1.0, 1.0), default=WEIGHTS)
    inner_bias: object = mc.gain("1", shape=(INNER,), bounds=(-1.0, 1.0), default=0.0)
    memory: object = mc.gain("s", shape=(INNER,), bounds=(1e-2, 2.0), default=np.geomspace(2e-2, 1.0, INNER))
    output: object = mc.gain("1", shape=(3 * FEET, INNER), bounds=(-1.0, 1.0), default=0.0)
    output_bias: object = mc.gain("1", shape=(3 * FEET,), bounds=(-1.0, 1.0), default=0.0)

    def init(self, start):
        """Return shares of the way that feet and neurons go in a step, the neurons, and shifts (foot, 3)."""
        shares = start.period / TIME, start.period / (start.period + self.memory)
        return shares, jnp.zeros(INNER), jnp.zeros((FEET, 3))

    def step(self, state, measured, reference):
        """Shift each foot towards the network's output."""
        shares, neurons, shift = state
        inner = jnp.tanh(self.inner @ (measured.foot_force.ravel() / FORCE) + self.inner_bias)
        neurons = neurons + shares[1] * (inner - neurons)
        wanted = SHIFT * jnp.tanh(self.output @ neurons + self.output_bias)
        shift = shift + shares[0] * (wanted.reshape(FEET, 3) - shift)
        still = mc.control.shifted(reference, jnp.zeros(6))
        return (shares, neurons, shift), still._replace(foot_position=reference.foot_position + shift)


beside = mc.control.combined(mc.control.LoadTransfer(), Remembering())
