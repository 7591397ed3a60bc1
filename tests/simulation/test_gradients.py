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
# relative changes of inertia, damping and stiffness (3, 6): all six axes of one at once, then each alone
ISOTROPIC = np.repeat(np.eye(3)[:, :, None], 6, axis=2)
DIRECTIONS = np.concatenate([ISOTROPIC, np.eye(18).reshape(18, 3, 6)])
STEPS = np.array([1e-4, 1e-5, 1e-6])
ROUNDING = 1e-12  # what is uncertain of a metric by the rounding of 8000 steps, relative


def assert_derivatives(scenarios, six_gains, numbers, directions, nominal=None):
    """Compare each derivative with the central difference of the step that suits it best.

    The metrics have kinks (maxima over time and limbs, sums of absolute values), so a difference is right while none of
    them lies within its step; `force_variation` and `cost_of_transport` have the most of them. A small step loses to
    rounding what a large one loses to kinks.
    """
    simulate = mc.simulator(scenarios[0])
    own = np.array([[*vars(six_gains(scenario)).values()][:3] for scenario in scenarios])
    own = own if nominal is None else np.broadcast_to(np.array(nominal)[:, None], own.shape)
    parameters = jax.tree.map(lambda *values: np.stack(values), *map(numbers, scenarios))

    def metrics(change, own, parameters):
        gains = own * (1 + change)
        found = simulate(mc.Gains(*(gains[:, i] for i in range(3))), parameters)
        return jnp.stack([found[name] for name in SMOOTH])

    def tangents(change, own, parameters):
        return jax.jvp(lambda c: metrics(c, own, parameters), (jnp.zeros_like(change),), (change,))[1]

    def of_all(function, changes):
        """Return values (metric, scenario, ...) of changes (..., 3, 6): a row of one batch for each of both."""
        flat = changes.reshape(-1, 3, 6)
        rows = jax.tree.map(lambda value: np.repeat(value, len(flat), axis=0), (own, parameters))
        # the rows are known where it is compiled: traced parameters could need stages that the scenario lacks
        found = jax.jit(lambda change: function(change, *rows))(np.tile(flat, (len(scenarios), 1, 1)))
        return np.asarray(found).reshape(len(SMOOTH), len(scenarios), *changes.shape[:-2])

    forward = of_all(tangents, directions)
    sides = of_all(metrics, np.multiply.outer(np.stack([STEPS, -STEPS], axis=1), directions))
    steps = STEPS[:, None, None, None]
    differences = np.moveaxis(sides[:, :, :, 0] - sides[:, :, :, 1], 2, 0) / (2 * steps)
    values = sides.mean((2, 3, 4))[..., None]
    assert np.isfinite(values).all() and np.isfinite(forward).all()
    size = np.maximum(np.abs(forward), 1e-300)
    error = np.abs(differences - forward)
    relative = (np.maximum(error - ROUNDING * np.abs(values) / steps, 0) / size).min(0).max((1, 2))
    # derivatives that a difference can tell without any allowance for rounding
    clear = np.abs(forward) > 1e-4 * np.abs(values)
    clearly = np.where(clear, (error / size).min(0), 0).max((1, 2))
    report = dict(zip(SMOOTH, zip(relative, clearly, clear.sum((1, 2)), strict=True), strict=True))
    assert max(relative.max(), clearly.max()) <= 1e-3, report
    assert clear.sum() > 0.2 * clear.size, report


@pytest.mark.slow
@pytest.mark.nightly
def test_two_gains_in_case_2(case, gains, numbers):
    """Damping and stiffness of all axes at once, at gains that matter: every smooth metric's derivative is right."""
    assert_derivatives([case("case_2", "virtual_model")], gains, numbers, ISOTROPIC[1:], nominal=(1.0, 1e2, 3e3))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "nominal"),
    [("virtual_model", None), ("virtual_model", (1.0, 1e2, 3e3)), ("measured_pose", None), ("end_effector", None)],
)
def test_every_gain_in_every_case(case, gains, numbers, law, nominal):
    """All 18 gains, together and alone, at the paper's values and at soft ones: every smooth metric, every case."""
    assert_derivatives([case(name, law) for name in CASES], gains, numbers, DIRECTIONS, nominal)
