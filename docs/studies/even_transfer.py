"""Load transfer that shares a push as the clairvoyant plan of docs/studies/ceiling.md does: evenly, and under tension.

`evenness` q weighs each foot by its wanted force to the power -q: the sum of the forces to the power 2 + q is least, so
that a large q keeps the largest force small. `tension` T holds the feet apart, or together, by forces without a wrench.
"""

import jax.numpy as jnp
from jax import Array

from mjx_climb.control import LoadTransfer, gain
from mjx_climb.control.force_distribution import distributed, least_forces, net_wrench

SWEEPS, LEAST, WIDEST = 2, 0.1, 10.0  # of the weights, N, and the largest factor on a weight


class EvenTransfer(LoadTransfer):
    """Load transfer towards forces of like size, with tension between the feet."""

    evenness: Array = gain("1", length=1, bounds=(0.0, 3.0), default=0.0, long_name="power of the largest forces")
    tension: Array = gain("N", length=1, bounds=(-3.0, 3.0), default=0.0, long_name="pull between the feet")

    def wanted(self, wrench: Array, lever: Array, weight: Array) -> Array:
        """Return forces of like size that make up a wrench, and the tension."""
        force = distributed(wrench, lever, weight, self.pull_limit)
        for _ in range(SWEEPS):
            size = jnp.sqrt((force * force).sum(1) + LEAST**2)
            mean = (weight * size).sum() / weight.sum()
            factor = jnp.clip((mean / size) ** jnp.ravel(self.evenness), 1 / WIDEST, WIDEST)
            force = distributed(wrench, lever, weight * factor, self.pull_limit)
        out = lever * jnp.array([1.0, 1.0, 0.0], lever.dtype)
        out = weight[:, None] * out / jnp.sqrt((out * out).sum(1, keepdims=True) + 1e-6)
        return force + self.tension * (out - least_forces(net_wrench(lever, out), lever, weight))
