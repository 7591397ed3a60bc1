"""Forward-mode derivatives through whole walks, of every smooth metric by every gain, against central differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc

CASES = ("case_1_1", "case_1_2", "case_2")
SMOOTH = (
    "peak_foot_force", "force_variation", "peak_pull_force", "peak_joint_torque", "cost_of_transport", "travel",
    "base_deviation", "min_tsm", "min_gia_margin", "joint_limit_margin",
)  # fmt: skip
GAINS = ("inertia", "damping", "stiffness")
# relative changes of gains (axes: gain, translations and rotations): all six axes at once, then each alone
ISOTROPIC = np.repeat(np.eye(3)[:, :, None], 6, axis=2)
DIRECTIONS = np.concatenate([ISOTROPIC, np.eye(18).reshape(18, 3, 6)])
STEPS = np.array([1e-3, 1e-4, 1e-5, 1e-6])


class Walks:
    """All smooth metrics of a batch of walks, (metric, B), as a function of relative changes of the gains (B, 3, 6)."""

    def __init__(self, scenarios, gains, numbers, nominal=None):
        self.simulate = mc.simulator(scenarios[0])
        self.nominal = np.array([[getattr(gains(s), name) for name in GAINS] for s in scenarios])
        if nominal is not None:
            self.nominal = np.broadcast_to(np.array(nominal)[:, None], self.nominal.shape)
        self.numbers = jax.tree.map(lambda *values: np.stack(values), *map(numbers, scenarios))
        self.values = jax.jit(self._values)
        self.slopes = jax.jit(lambda change, *rest: jax.jvp(lambda c: self._values(c, *rest[1:]), (change,), rest[:1])[1])

    def _values(self, change, nominal, numbers):
        gains = nominal * (1 + change)
        metrics = self.simulate(mc.Gains(*(gains[:, i] for i in range(3))), numbers)
        return jnp.stack([metrics[name] for name in SMOOTH])

    def rows(self, *others):
        """Return what `values` needs, a row for each scenario and each element of `others`, in this order."""
        repeat = lambda value: np.repeat(value, others[0], axis=0)  # noqa: E731
        return repeat(self.nominal), jax.tree.map(repeat, self.numbers)

    def forward(self, directions):
        """Return derivatives (metric, scenario, direction) by forward mode."""
        change = np.tile(directions, (len(self.nominal), 1, 1))
        slopes = self.slopes(np.zeros_like(change), change, *self.rows(len(directions)))
        return np.asarray(slopes).reshape(len(SMOOTH), -1, len(directions))

    def differences(self, directions):
        """Return central differences (step, metric, scenario, direction)."""
        sides = np.stack([STEPS, -STEPS], axis=1)[:, :, None, None, None] * directions
        flat = np.tile(sides.reshape(-1, *directions.shape[1:]), (len(self.nominal), 1, 1))
        values = np.asarray(self.values(flat, *self.rows(sides[..., 0, 0].size)))
        values = values.reshape(len(SMOOTH), -1, len(STEPS), 2, len(directions))
        return np.moveaxis((values[:, :, :, 0] - values[:, :, :, 1]) / (2 * STEPS[:, None]), 2, 0), values
