"""A learned law: a network whose weights are gains shifts each foot by what all feet measure."""

import jax.numpy as jnp
import numpy as np

import mjx_climb as mc

INNER, FEET = 16, 4
FORCE, SHIFT = 10.0, 2e-3  # N and m, the size of what goes in and comes out
TIME = 0.05  # s, within which feet follow

WEIGHTS = np.random.default_rng(0).normal(0, 0.3, (INNER, 3 * FEET))


class Network(mc.Law):
    """Twelve forces, sixteen neurons, twelve shifts: `TIME dx/dt = SHIFT tanh(output tanh(inner F)) - dx`."""

    inner: object = mc.gain("1", shape=(INNER, 3 * FEET), bounds=(-1.0, 1.0), default=WEIGHTS)
    inner_bias: object = mc.gain("1", shape=(INNER,), bounds=(-1.0, 1.0), default=0.0)
    output: object = mc.gain("1", shape=(3 * FEET, INNER), bounds=(-1.0, 1.0), default=0.0)
    output_bias: object = mc.gain("1", shape=(3 * FEET,), bounds=(-1.0, 1.0), default=0.0)

    def init(self, start):
        """Return the share of the way that feet go in a step, and their shifts (foot, 3)."""
        return start.period / TIME, jnp.zeros((FEET, 3))

    def step(self, state, measured, reference):
        """Shift each foot towards what the network makes of the forces."""
        share, shift = state
        inner = jnp.tanh(self.inner @ (measured.foot_force.ravel() / FORCE) + self.inner_bias)
        wanted = SHIFT * jnp.tanh(self.output @ inner + self.output_bias)
        shift = shift + share * (wanted.reshape(FEET, 3) - shift)
        still = mc.control.shifted(reference, jnp.zeros(6))
        return (share, shift), still._replace(foot_position=reference.foot_position + shift)
