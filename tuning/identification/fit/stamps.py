"""The noise of a log: of each signal, and of the time stamps.

A time stamp may miss the moment at which its samples were taken. What was sampled at one stamp then is off together,
each sample by its rate times the stamp's error: noise that grows with the motion and is common to all joints. The
errors are taken to be normal, and independent from stamp to stamp. Each is a number of the fit with that prior, and is
eliminated. Their standard deviation is that of the largest marginal likelihood, or zero where the log shows none.

Rates are held as the fit has them: a gradient along the rates too would need that of the determinant of the errors'
information beside it, and the two cancel in the mean.

References:
    P. J. Huber, Robust Statistics, 1981.
    W. A. Fuller, Measurement Error Models, 1987.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize_scalar

HUBER = 2.5  # standard deviations, beyond which a sample counts by its size alone
_WINSORIZED = 0.97756  # mean of min(z^2, HUBER^2) of a normal z
_ROUNDS = 20  # of weights, and of noise and stamps by turns
_SHOWN = 5.4  # gain in log likelihood of errors that are there: by chance once in two thousand logs (chi^2, one-sided)
_CLOCKS = (1e-6, 0.05)  # s, between which the standard deviation is sought


class Stamped(NamedTuple):
    """What errors of time stamps make of residuals."""

    error: Float[np.ndarray, " rows"]  # s, of the stamp of each row; 0 of what is not fitted
    rate: Float[np.ndarray, " rows"]  # SI units per s
    weight: Float[np.ndarray, " rows"]  # Huber's, over the square of the noise; 0 of what is not fitted
    stiffness: Float[np.ndarray, " stamps"]  # s^-2, curvature of the cost along each stamp's error
    cost: float  # of samples and errors


def stamped(
    residuals: np.ndarray, rate: np.ndarray, fitted: np.ndarray, stamp: Int[np.ndarray, " rows"], noise: np.ndarray,
    clock: float,
) -> Stamped:  # fmt: skip
    """Return the likeliest errors of stamps for residuals, all (rows,), and the cost under Huber's loss.

    Arguments:
        residuals: SI units.
        rate: SI units per s.
        fitted: bool; the others have no weight.
        stamp: of each row.
        noise: standard deviation of each row, SI units.
        clock: standard deviation of the stamps' errors, s; 0: there are none.
    """
    count = int(stamp.max(initial=-1)) + 1
    error: np.ndarray = np.zeros(count)
    stiffness: np.ndarray = np.zeros(0)
    for _ in range(_ROUNDS if clock else 1):
        scaled = np.abs(residuals - rate * error[stamp]) / noise
        weight = np.where(fitted, np.minimum(1.0, HUBER / np.maximum(scaled, 1e-12)), 0.0) / noise**2
        if clock:
            stiffness = 1 / clock**2 + np.bincount(stamp, weight * rate**2, count)
            before, error = error, np.bincount(stamp, weight * rate * residuals, count) / stiffness
            if np.abs(error - before).max() < 1e-6 * clock:
                break
    loss = np.where(scaled < HUBER, scaled**2 / 2, HUBER * scaled - HUBER**2 / 2)
    cost = float(loss[fitted].sum()) + (float((error**2).sum()) / 2 / clock**2 if clock else 0.0)
    return Stamped(np.where(fitted, error[stamp], 0.0), rate, weight, stiffness, cost)


class Noise(NamedTuple):
    """Standard deviations of a log's noise."""

    signals: Float[np.ndarray, " signals"]
    clock: float  # s, of time stamps


def change(before: Noise, after: Noise) -> float:
    """Return the largest relative change of a standard deviation."""
    of_signals = float(np.abs(np.log(after.signals / before.signals)).max())
    largest = max(before.clock, after.clock)
    return max(of_signals, abs(after.clock - before.clock) / largest if largest else 0.0)


def noise_of(
    residuals: np.ndarray, late: Stamped, fitted: np.ndarray, which: tuple[np.ndarray, np.ndarray], before: Noise
) -> Noise:
    """Return the noise as residuals have it, outliers winsorised; a signal of few samples keeps what it had.

    Arguments:
        residuals: (rows,) less what errors of stamps make, SI units.
        late: those errors.
        fitted: (rows,) bool.
        which: signal and stamp of each row.
        before: noise that the fit had.
    """
    signal, stamp = which
    whole = residuals + late.rate * late.error
    quiet = _of_signals(residuals, fitted, signal, before.signals)
    clock = before.clock
    for _ in range(_ROUNDS):
        latest, quieter = clock, quiet
        now = stamped(whole, late.rate, fitted, stamp, quiet[signal], clock)
        clock = _clock(whole, now, stamp)
        now = stamped(whole, late.rate, fitted, stamp, quiet[signal], clock)
        own = now.weight * now.rate**2 / now.stiffness[stamp] if clock else 0.0  # share of a row in its stamp's error
        left = (whole - now.rate * now.error) / np.sqrt(np.maximum(1 - own, 0.01))
        quiet = _of_signals(left, fitted, signal, quieter)
        if abs(clock - latest) <= 1e-3 * clock and np.abs(np.log(quiet / quieter)).max() < 1e-3:
            break
    return Noise(quiet, clock)


def _of_signals(residuals: np.ndarray, fitted: np.ndarray, signal: np.ndarray, before: np.ndarray) -> np.ndarray:
    noise = before.copy()
    for number in range(len(noise)):
        own = residuals[fitted & (signal == number)]
        if len(own) < 10:
            continue
        sd = 1.4826 * float(np.median(np.abs(own)))
        for _ in range(10):
            sd = float(np.sqrt(np.minimum(own**2, (HUBER * sd) ** 2).mean() / _WINSORIZED))
        noise[number] = max(sd, 1e-9)
    return noise


def _clock(residuals: np.ndarray, late: Stamped, stamp: np.ndarray) -> float:
    """Return the standard deviation of stamps' errors that has the largest marginal likelihood, s; 0: none is shown."""
    count = int(stamp.max(initial=-1)) + 1
    pull = np.bincount(stamp, late.weight * late.rate * residuals, count)
    known = np.bincount(stamp, late.weight * late.rate**2, count)

    def loss(logarithm: float) -> float:
        square = np.exp(2 * logarithm)
        return float((np.log1p(square * known) - pull**2 * square / (1 + square * known)).sum()) / 2

    found = minimize_scalar(loss, bounds=np.log(_CLOCKS), method="bounded")
    return float(np.exp(found.x)) if found.fun < -_SHOWN else 0.0
