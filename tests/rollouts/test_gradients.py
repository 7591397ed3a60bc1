"""Forward-mode derivatives through whole walks, of every smooth metric by every gain, against central differences."""

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
STEPS = np.array([1e-4, 1e-5, 1e-6])
ROUNDING = 1e-12  # what is uncertain of a metric by the rounding of 8000 steps, relative


class Walks:
    """All smooth metrics of a batch of walks, (metric, B), as a function of relative changes of the gains (B, 3, 6)."""

    def __init__(self, scenarios, gains, parameters, nominal=None):
        self.simulate = mc.simulator(scenarios[0])
        self.nominal = np.array([[getattr(gains(s), name) for name in GAINS] for s in scenarios])
        if nominal is not None:
            self.nominal = np.broadcast_to(np.array(nominal)[:, None], self.nominal.shape)
        self.parameters = jax.tree.map(lambda *values: np.stack(values), *map(parameters, scenarios))
        self.values = jax.jit(self._values)
        self.tangents = jax.jit(
            lambda change, *rest: jax.jvp(lambda c: self._values(c, *rest[1:]), (change,), rest[:1])[1]
        )

    def _values(self, change, nominal, parameters):
        gains = nominal * (1 + change)
        metrics = self.simulate(mc.Gains(*(gains[:, i] for i in range(3))), parameters)
        return jnp.stack([metrics[name] for name in SMOOTH])

    def rows(self, count):
        """Return the nominal gains and the parameters, `count` rows for each scenario."""
        repeat = lambda value: np.repeat(value, count, axis=0)  # noqa: E731
        return repeat(self.nominal), jax.tree.map(repeat, self.parameters)

    def forward(self, directions):
        """Return derivatives (metric, scenario, direction) by forward mode: a row of the batch for each direction."""
        change = np.tile(directions, (len(self.nominal), 1, 1))
        tangents = self.tangents(np.zeros_like(change), change, *self.rows(len(directions)))
        return np.asarray(tangents).reshape(len(SMOOTH), -1, len(directions))

    def differences(self, directions):
        """Return central differences (step, metric, scenario, direction) and metrics (metric, scenario, 1)."""
        sides = np.multiply.outer(np.stack([STEPS, -STEPS], axis=1), directions)
        flat = sides.reshape(-1, *directions.shape[1:])
        values = np.asarray(self.values(np.tile(flat, (len(self.nominal), 1, 1)), *self.rows(len(flat))))
        values = values.reshape(len(SMOOTH), -1, *sides.shape[:3])
        slopes = (values[:, :, :, 0] - values[:, :, :, 1]) / (2 * STEPS[:, None])
        return np.moveaxis(slopes, 2, 0), values.mean((2, 3, 4))[..., None]


def assert_derivatives(walks, directions):
    """Compare each derivative with the central difference of the step that suits it best.

    The metrics have kinks (maxima over time and limbs, sums of absolute values), so a difference is right while none of
    them lies within its step; `force_variation` and `cost_of_transport` have the most of them. A small step loses to
    rounding what a large one loses to kinks.
    """
    forward = walks.forward(directions)
    differences, values = walks.differences(directions)
    assert np.isfinite(values).all() and np.isfinite(forward).all()
    noise = ROUNDING * np.abs(values) / STEPS[:, None, None, None]
    error = np.abs(differences - forward)
    relative = (np.maximum(error - noise, 0) / np.maximum(np.abs(forward), 1e-300)).min(0).max((1, 2))
    # derivatives that a difference can tell without any allowance for rounding
    clear = np.abs(forward) > 1e-4 * np.abs(values)
    clearly = np.where(clear, (error / np.maximum(np.abs(forward), 1e-300)).min(0), 0).max((1, 2))
    report = {name: f"{a:.0e} {b:.0e} ({n})" for name, a, b, n in zip(SMOOTH, relative, clearly, clear.sum((1, 2)))}  # noqa: B905
    print(report)
    assert relative.max() <= 1e-3, report
    assert clearly.max() <= 1e-3, report
    assert clear.sum() > 0.2 * clear.size, report


@pytest.mark.slow
def test_two_gains_in_case_2(case, gains, numbers):
    """Damping and stiffness of all axes at once, at gains that matter: every smooth metric's derivative is right."""
    walks = Walks([case("case_2", "virtual_model")], gains, numbers, nominal=(1.0, 1e2, 3e3))
    assert_derivatives(walks, ISOTROPIC[1:])


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "nominal"),
    [
        ("virtual_model", None),
        ("virtual_model", (1.0, 1e2, 3e3)),
        ("measured_pose", None),
        ("end_effector", None),
    ],
)
def test_every_gain_in_every_case(case, gains, numbers, law, nominal):
    """All 18 gains, together and alone, at the paper's values and at soft ones: every smooth metric, every case."""
    assert_derivatives(Walks([case(name, law) for name in CASES], gains, numbers, nominal), DIRECTIONS)
