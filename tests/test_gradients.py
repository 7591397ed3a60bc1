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

    def rows(self, count):
        """Return the nominal gains and the parameters, `count` rows for each scenario."""
        repeat = lambda value: np.repeat(value, count, axis=0)  # noqa: E731
        return repeat(self.nominal), jax.tree.map(repeat, self.numbers)

    def forward(self, directions):
        """Return derivatives (metric, scenario, direction) by forward mode: a row of the batch for each direction."""
        change = np.tile(directions, (len(self.nominal), 1, 1))
        slopes = self.slopes(np.zeros_like(change), change, *self.rows(len(directions)))
        return np.asarray(slopes).reshape(len(SMOOTH), -1, len(directions))

    def differences(self, directions):
        """Return central differences (step, metric, scenario, direction) and metrics (metric, scenario, 1)."""
        sides = np.multiply.outer(np.stack([STEPS, -STEPS], axis=1), directions)
        flat = sides.reshape(-1, *directions.shape[1:])
        values = np.asarray(self.values(np.tile(flat, (len(self.nominal), 1, 1)), *self.rows(len(flat))))
        values = values.reshape(len(SMOOTH), -1, *sides.shape[:3])
        slopes = (values[:, :, :, 0] - values[:, :, :, 1]) / (2 * STEPS[:, None])
        return np.moveaxis(slopes, 2, 0), values.mean((2, 3, 4))[..., None]


def assert_derivatives(walks, directions):
    """Compare on the plateau, which the differences alone give: where two neighbouring steps agree best."""
    forward = walks.forward(directions)
    differences, values = walks.differences(directions)
    assert np.isfinite(values).all() and np.isfinite(forward).all()
    plateau = np.abs(np.diff(differences, axis=0)).argmin(0)
    best = np.take_along_axis(differences, plateau[None], axis=0)[0]
    # A difference of two walks over 1e-3 knows no more than 1e-8 of the metric: each walk is rounded to some 1e-11.
    error = np.abs(forward - best) - 1e-8 * np.abs(values)
    relative = error / np.maximum(np.abs(forward), 1e-300)
    worst = dict(zip(SMOOTH, relative.max((1, 2)), strict=True))
    sensible = (np.abs(forward) > 1e-5 * np.abs(values)).mean((1, 2))
    print({name: f"{value:.1e}" for name, value in worst.items()}, sensible)
    assert all(value <= 1e-3 for value in worst.values()), worst
    # the comparison is of something: no metric is blind to all of the gains
    assert (sensible > 0).all(), dict(zip(SMOOTH, sensible, strict=True))


def test_two_gains_in_case_2(case, gains, numbers):
    """Damping and stiffness of all axes at once, at gains that matter: every smooth metric's derivative is right."""
    walks = Walks([case("case_2", "virtual_model")], gains, numbers, nominal=(1.0, 1e2, 3e3))
    assert_derivatives(walks, ISOTROPIC[1:])


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
