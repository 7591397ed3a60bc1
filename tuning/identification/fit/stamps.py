"""The noise of a log: of each signal, and of the time stamps.

A time stamp may miss the moment at which its samples were taken. The samples of one stamp are then off together,
each by its rate times the stamp's error: noise that grows with the motion and is common to the joints. The
errors are taken to be normal and independent from stamp to stamp. Samples of a stamp then have the covariance
`1 + a a^T` in units of their noise, by which they are whitened. The errors' standard deviation is that of the largest
marginal likelihood, at most half the spacing of the stamps, and none where the log shows none. Errors that go on from
stamp to stamp are the model's, and of one signal alone they cannot be told from its noise.

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
_LEAST = 1e-6  # s, of a clock's error
_GOES_ON = 0.3  # correlation of neighbouring stamps' errors, from which they are the model's
_QUIET = 1e-5  # of a signal's standard deviation, its least noise


class Noise(NamedTuple):
    """Standard deviations of a log's noise."""

    signals: Float[np.ndarray, " signals"]
    clock: float  # s, of time stamps


class Samples(NamedTuple):
    """The samples of a log, as far as their noise asks for."""

    signal: Int[np.ndarray, " rows"]
    stamp: Int[np.ndarray, " rows"]
    fitted: np.ndarray  # (rows,) bool
    spacing: float  # s, between stamps
    moved: Float[np.ndarray, " signals"]  # standard deviation of each signal, SI units

    @property
    def shared(self) -> bool:
        """Whether several signals share most stamps."""
        count = np.bincount(self.stamp[self.fitted])
        return bool(np.median(count[count > 0]) > 1) if self.fitted.any() else False


def whitened(
    values: Float[np.ndarray, "rows k"], late: Float[np.ndarray, " rows"], stamp: Int[np.ndarray, " rows"]
) -> Float[np.ndarray, "rows k"]:
    """Columns of samples over their noise, those of each stamp by the inverse root of `1 + late late^T`."""
    count = int(stamp.max(initial=-1)) + 1
    square = np.bincount(stamp, late**2, count)
    share = np.where(square > 0, (1 - 1 / np.sqrt(1 + square)) / np.maximum(square, 1e-300), 0.0)
    together = np.stack([np.bincount(stamp, late * column, count) for column in values.T], axis=1)
    return np.asarray(values - late[:, None] * (share[:, None] * together)[stamp])


def change(before: Noise, after: Noise) -> float:
    """Return the largest relative change of a standard deviation."""
    of_signals = float(np.abs(np.log(after.signals / before.signals)).max())
    largest = max(before.clock, after.clock)
    return max(of_signals, abs(after.clock - before.clock) / largest if largest else 0.0)


def noise_of(residuals: np.ndarray, rate: np.ndarray, samples: Samples, before: Noise) -> Noise:
    """Return the noise as residuals have it, outliers winsorised; a signal of few samples keeps its own.

    Arguments:
        residuals: (rows,), SI units.
        rate: (rows,) SI units per s, that samples change by.
        samples: of the log.
        before: noise that the fit had.
    """
    signal, stamp = samples.signal, samples.stamp
    quiet = _of_signals(residuals, samples, before.signals)
    if not samples.shared:
        return Noise(quiet, 0.0)
    clock, most = before.clock, max(samples.spacing / 2, 2 * _LEAST)
    for _ in range(_ROUNDS):
        latest, quieter = clock, quiet
        now = _stamped(residuals, rate, samples, quiet[signal], clock)
        clock = _clock(residuals, rate, now, stamp, most)
        now = _stamped(residuals, rate, samples, quiet[signal], clock)
        own = now.weight * rate**2 / now.stiffness[stamp] if clock else 0.0  # share of a row in its stamp's error
        left = (residuals - rate * now.error[stamp]) / np.sqrt(np.maximum(1 - own, 0.01))
        quiet = _of_signals(left, samples, quieter)
        if abs(clock - latest) <= 1e-3 * clock and np.abs(np.log(quiet / quieter)).max() < 1e-3:
            break
    # errors are none where the clock is 0
    if _goes_on(now):
        return Noise(_of_signals(residuals, samples, before.signals), 0.0)
    return Noise(quiet, clock)


class _Stamped(NamedTuple):
    """The likeliest errors of stamps."""

    error: Float[np.ndarray, " stamps"]  # s
    weight: Float[np.ndarray, " rows"]  # Huber's, over the square of the noise; 0 of rows that are not fitted
    stiffness: Float[np.ndarray, " stamps"]  # s^-2, curvature of the cost along each error
    known: Float[np.ndarray, " stamps"]  # s^-2, by the samples alone


def _stamped(
    residuals: np.ndarray, rate: np.ndarray, samples: Samples, noise: np.ndarray, clock: float
) -> _Stamped:  # fmt: skip
    stamp, count = samples.stamp, int(samples.stamp.max(initial=-1)) + 1
    error: np.ndarray = np.zeros(count)
    for _ in range(_ROUNDS if clock else 1):
        scaled = np.abs(residuals - rate * error[stamp]) / noise
        weight = np.where(samples.fitted, np.minimum(1.0, HUBER / np.maximum(scaled, 1e-12)), 0.0) / noise**2
        known = np.bincount(stamp, weight * rate**2, count)
        stiffness = known + (1 / clock**2 if clock else np.inf)
        latest, error = error, np.bincount(stamp, weight * rate * residuals, count) / stiffness
        if np.abs(error - latest).max() < 1e-6 * clock:
            break
    return _Stamped(error, weight, stiffness, known)


def _of_signals(residuals: np.ndarray, samples: Samples, before: np.ndarray) -> np.ndarray:
    noise = before.copy()
    for number in range(len(noise)):
        own = residuals[samples.fitted & (samples.signal == number)]
        if len(own) < 10:
            continue
        sd = 1.4826 * float(np.median(np.abs(own)))
        for _ in range(10):
            sd = float(np.sqrt(np.minimum(own**2, (HUBER * sd) ** 2).mean() / _WINSORIZED))
        noise[number] = max(sd, _QUIET * float(samples.moved[number]), 1e-12)
    return noise


def _clock(residuals: np.ndarray, rate: np.ndarray, late: _Stamped, stamp: np.ndarray, most: float) -> float:
    """Return the standard deviation of stamps' errors that has the largest marginal likelihood, s; 0: none is shown."""
    pull = np.bincount(stamp, late.weight * rate * residuals, len(late.known))

    def loss(logarithm: float) -> float:
        square = np.exp(2 * logarithm)
        gain = pull**2 * square / (1 + square * late.known)
        return float((np.log1p(square * late.known) - gain).sum()) / 2

    found = minimize_scalar(loss, bounds=np.log((_LEAST, most)), method="bounded")
    return float(np.exp(found.x)) if found.fun < -_SHOWN else 0.0


def _goes_on(late: _Stamped) -> bool:
    """Whether the errors of neighbouring stamps are correlated, as a model's are and a clock's are not."""
    error = late.error[late.known > 0]
    total = float(error @ error)
    return bool(total > 0 and float(error[1:] @ error[:-1]) > _GOES_ON * total)
