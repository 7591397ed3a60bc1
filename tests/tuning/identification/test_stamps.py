"""Errors of time stamps: against the dense covariance of samples that share them, and as draws have them."""

import numpy as np
import pytest
from scipy.special import huber

from tuning.identification.fit.stamps import HUBER, Noise, noise_of, stamped

CLOCK = 3e-4  # s


def draws(clock, stamps=400, signals=6, seed=0):
    """Return residuals, rates, stamps and signals of rows, and the noise of each signal."""
    rng = np.random.default_rng(seed)
    stamp, signal = (each.ravel() for each in np.mgrid[:stamps, :signals])
    noise = np.geomspace(5e-4, 0.05, signals)
    rate = 3 * noise[signal] / CLOCK * rng.normal(0, 1, len(stamp))
    residuals = rate * rng.normal(0, clock, stamps)[stamp] + noise[signal] * rng.normal(0, 1, len(stamp))
    return residuals, rate, stamp, signal, noise


def test_the_cost_is_that_of_the_dense_covariance():
    residuals, rate, stamp, signal, noise = draws(CLOCK, stamps=7)
    fitted = stamp < 5
    found = stamped(residuals / 10, rate, fitted, stamp, noise[signal], CLOCK)  # far below Huber's bound
    own, r = noise[signal][fitted], residuals[fitted] / 10
    together = stamp[fitted][:, None] == stamp[fitted]
    covariance = np.diag(own**2) + CLOCK**2 * np.outer(rate[fitted], rate[fitted]) * together
    assert found.cost == pytest.approx(r @ np.linalg.solve(covariance, r) / 2, rel=1e-9)
    likeliest = CLOCK**2 * (together * rate[fitted]) @ np.linalg.solve(covariance, r)
    np.testing.assert_allclose(found.error[fitted], likeliest, rtol=1e-9)
    assert not found.error[~fitted].any() and not found.weight[~fitted].any()


def test_an_outlier_costs_what_hubers_loss_says():
    noise, residuals = np.full(7, 0.3), 0.3 * np.array([-9.0, -2.51, -2.49, 0.0, 1.0, 2.6, 40.0])
    none = np.zeros(7)
    found = stamped(residuals, none, np.ones(7, bool), none.astype(int), noise, 0.0)
    assert found.cost == pytest.approx(huber(HUBER, residuals / noise).sum(), rel=1e-12)


def test_an_outlier_moves_its_stamp_no_more_than_huber_lets_it():
    residuals, rate, stamp, signal, noise = draws(CLOCK)
    whole = np.ones(len(stamp), bool)
    before = stamped(residuals, rate, whole, stamp, noise[signal], CLOCK).error
    residuals[0] += 1e3 * noise[0]
    after = stamped(residuals, rate, whole, stamp, noise[signal], CLOCK).error
    assert np.abs(after - before).max() < CLOCK


@pytest.mark.parametrize("clock", [0.0, CLOCK / 3, CLOCK])
def test_noise_and_clock_are_told_apart(clock):
    residuals, rate, stamp, signal, noise = draws(clock)
    whole = np.ones(len(stamp), bool)
    known = Noise(2 * noise, 0.0)
    late = stamped(residuals, rate, whole, stamp, known.signals[signal], known.clock)
    found = noise_of(residuals, late, whole, (signal, stamp), known)
    assert found.clock == pytest.approx(clock, rel=0.2)
    np.testing.assert_allclose(found.signals, noise, rtol=0.15)  # four standard deviations
    assert abs(np.log(found.signals / noise).mean()) < 0.05  # as many: stamps take none of the noise


def test_errors_that_the_log_does_not_show_are_none():
    found = []
    for seed in range(40):
        residuals, rate, stamp, signal, noise = draws(0.0, seed=seed)
        whole = np.ones(len(stamp), bool)
        late = stamped(residuals, rate, whole, stamp, noise[signal], 0.0)
        found.append(noise_of(residuals, late, whole, (signal, stamp), Noise(noise, 0.0)).clock)
    assert not any(found)
