"""Errors of time stamps: against the dense covariance of samples that share them, and as draws have them."""

import numpy as np
import pytest

from tuning.identification.fit.stamps import Noise, Samples, noise_of, whitened

CLOCK = 3e-4  # s


def draws(clock, stamps=400, signals=6, seed=0):
    """Return residuals, rates, stamps and signals of rows, and the noise of each signal."""
    rng = np.random.default_rng(seed)
    stamp, signal = (each.ravel() for each in np.mgrid[:stamps, :signals])
    noise = np.geomspace(5e-4, 0.05, signals)
    rate = 3 * noise[signal] / CLOCK * rng.normal(0, 1, len(stamp))
    residuals = rate * rng.normal(0, clock, stamps)[stamp] + noise[signal] * rng.normal(0, 1, len(stamp))
    return residuals, rate, stamp, signal, noise


def samples_of(stamp, signal, spacing=0.01):
    return Samples(signal, stamp, np.full(len(stamp), True), spacing, np.ones(1 + signal.max()))


def test_samples_are_whitened_by_their_dense_covariance():
    residuals, rate, stamp, signal, noise = draws(CLOCK, stamps=7)
    own = noise[signal]
    found = whitened((residuals / own)[:, None], CLOCK * rate / own, stamp)[:, 0]
    together = stamp[:, None] == stamp
    covariance = np.diag(own**2) + CLOCK**2 * np.outer(rate, rate) * together
    assert found @ found == pytest.approx(residuals @ np.linalg.solve(covariance, residuals), rel=1e-9)
    np.testing.assert_allclose(whitened((residuals / own)[:, None], 0 * rate, stamp)[:, 0], residuals / own)


@pytest.mark.parametrize("clock", [0.0, CLOCK / 3, CLOCK])
def test_noise_and_clock_are_told_apart(clock):
    residuals, rate, stamp, signal, noise = draws(clock)
    found = noise_of(residuals, rate, samples_of(stamp, signal), Noise(2 * noise, 0.0))
    assert found.clock == pytest.approx(clock, rel=0.2)
    np.testing.assert_allclose(found.signals, noise, rtol=0.15)  # four standard deviations
    assert abs(np.log(found.signals / noise).mean()) < 0.05  # as many: stamps take none of the noise


def test_errors_that_the_log_does_not_show_are_none():
    found = []
    for seed in range(40):
        residuals, rate, stamp, signal, noise = draws(0.0, seed=seed)
        found.append(noise_of(residuals, rate, samples_of(stamp, signal), Noise(noise, 0.0)).clock)
    assert not any(found)


def test_stamps_err_by_half_their_spacing_at_most():
    residuals, rate, stamp, signal, noise = draws(50 * CLOCK)
    found = noise_of(residuals, rate, samples_of(stamp, signal, 0.01), Noise(noise, 0.0))
    assert 0.004 < found.clock <= 0.005


def test_errors_that_go_on_from_stamp_to_stamp_are_the_models():
    """A model that is late by a part of a millisecond that waxes and wanes: not a clock, whose errors are white."""
    _, rate, stamp, signal, noise = draws(0.0)
    late = CLOCK * np.sin(2 * np.pi * stamp / 60)
    found = noise_of(rate * late + noise[signal] * 0.1, rate, samples_of(stamp, signal), Noise(noise, 0.0))
    assert found.clock == 0.0


def test_the_clock_of_a_log_of_one_signal_is_not_fitted():
    residuals, rate, stamp, signal, noise = draws(CLOCK, signals=1)
    assert noise_of(residuals, rate, samples_of(stamp, signal), Noise(noise, 0.0)).clock == 0.0


def test_a_log_without_noise_has_a_little():
    """A signal's noise of 1e-9 ended in a FloatingPointError, or in a clock of 0.05 s."""
    _, rate, stamp, signal, _ = draws(0.0)
    found = noise_of(0 * rate, rate, samples_of(stamp, signal), Noise(np.full(6, 1e-9), 0.0))
    assert found.clock == 0.0 and (found.signals == 1e-5).all()
