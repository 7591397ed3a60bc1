"""What a fit is worth: intervals, what the log does not tell, and whether the residuals are those of a right model.

Intervals are those of the posterior: the information of the samples, with starts eliminated, beside the prior. What the
samples say is divided by the square of a widening, the prior is not: no log makes it worse. It has two parts.

- The gradients of blocks, a limb in a window, may scatter more than those of independent noise. Their scatter is that
  of few blocks, so that it counts by Student's quantile.
- Where a signal's residuals are correlated, the model lacks something that moves. A parameter may have absorbed as much
  of it as the residuals still show, as far as that signal tells of the parameter (Cauchy and Schwarz). How much that
  is grows from nothing at the limits of the test, so that a false alarm costs little.

The delay of commands is no better known than the log's clock.

References:
    L. Breiman, Better Subset Regression Using the Nonnegative Garrote, 1995.
    H. White, Maximum Likelihood Estimation of Misspecified Models, 1982.
    H. R. Kuensch, The Jackknife and the Bootstrap for General Stationary Observations, 1989.
    G. M. Ljung, G. E. P. Box, On a Measure of Lack of Fit in Time Series Models, 1978.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2, t

from tuning.identification.fit.least_squares import Fitted, LeastSquares, eliminated
from tuning.identification.fit.levenberg_marquardt import prior_of
from tuning.identification.model.predicted import DELAY
from tuning.identification.model.variables import Variable

Z = 1.959964  # of 95 %
SEEN = 0.5  # of the prior's sd: what is known no better was not seen
_INSIDE = 3.0  # sd of the prior, within which an interval must lie for its parameter to be seen
_FEWEST = 8  # blocks, whose scatter is one
_LOUD = 0.35  # share of a direction that names a variable
_FALSE_ALARM = 1e-3  # of the test of all signals together
_LAGS, _MATTERS = 20, 0.1  # samples, and a correlation below which it is none that matters
_CLOCK = 0.1  # of a time step, to which the time of a command is known
_CLIP = 4.0  # of the noise: outliers say nothing of correlation
_WORST = 3.0  # error of what was held out, over the noise, beyond which nothing is told
_UNEXPLAINED = 0.5  # of a signal's standard deviation, that of its residuals: beyond it the fit explains nothing
_BLIND = 0.99  # of the prior's sd
_ROUNDING, _LEAST = 1e-10, 1e-300  # of the largest information along a direction


class Posterior(NamedTuple):
    """What is known of the variables, in coordinates."""

    covariance: Float[np.ndarray, "P P"]  # widened
    fisher: Float[np.ndarray, "P P"]  # covariance if noise were white and the model right, with the prior
    information: Float[np.ndarray, "P P"]  # of the samples alone
    widening: Float[np.ndarray, " P"]  # factor on sd
    seen: np.ndarray  # (P,) bool
    unseen: tuple[str, ...]  # directions, in words
    combined: tuple[str, ...]  # combinations of what was not seen that were, in words

    def blind(self, variables: Sequence[Variable]) -> list[bool]:
        """Return of which variables the samples say nothing at all, so that their prior stays."""
        sd = np.sqrt(np.diag(self.fisher))
        return [bool(own > _BLIND * v.sd) for own, v in zip(sd, variables, strict=True)]


class Whiteness(NamedTuple):
    """Of one signal's residuals over its noise."""

    signal: str
    probability: float  # of such correlation if they were white
    correlation: Float[np.ndarray, " lags"]
    period: float  # s, of a lag
    share: float  # of the residuals' variance, that the model lacks; 0: nothing
    samples: int

    @property
    def in_words(self) -> str:
        """What is wrong, in a line."""
        lag = int(np.argmax(np.abs(self.correlation))) + 1
        return (
            f"the model is wrong: residuals of {self.signal} are correlated, {self.correlation[lag - 1]:+.2f} "
            f"{lag * self.period:.3g} s apart"
        )


def posterior(problem: LeastSquares, found: Fitted, tests: Sequence[Whiteness]) -> Posterior:
    """Return the posterior of a fit."""
    variables, prior = problem.model.variables, prior_of(problem.model)
    _, information, _ = eliminated(found.normal)
    information = (information + information.T) / 2
    fisher = covariance_of(information, prior.sd)
    sd = np.sqrt(np.diag(fisher))
    moved = problem.sensitivity(found) @ fisher  # of the estimates by each row
    square = (
        _scatter(problem, found, moved, np.diag(fisher @ information @ fisher))
        + (_absorbed(problem, found, moved, tests) / sd) ** 2
    )
    of_samples = np.maximum(1 / sd**2 - 1 / prior.sd**2, 0.0)
    widened = 1 / np.sqrt(1 / prior.sd**2 + of_samples / square)
    covariance = fisher * np.outer(widened / sd, widened / sd) + np.diag(_of_clock(problem, found, sd) ** 2)
    seen = np.array([
        is_seen(v, x, own) for v, x, own in zip(variables, found.x, np.sqrt(np.diag(covariance)), strict=True)
    ])  # fmt: skip
    unseen, combined = _directions(variables, information, prior.sd, found.x)
    return Posterior(covariance, fisher, information, widened / sd, seen, unseen, combined)


def is_seen(variable: Variable, x: float, sd: float) -> bool:
    """Return whether a log tells a variable: its interval lies well inside the prior, and the search met no bound."""
    inside = abs(x - variable.mean) + Z * sd < _INSIDE * variable.sd
    return bool(sd < SEEN * variable.sd and inside and not variable.bound_at(x))


def _scatter(problem: LeastSquares, found: Fitted, moved: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return the scatter of the gradients of blocks over that of independent noise (P,), 1 or more.

    Arguments:
        problem: what was fitted.
        found: the fit.
        moved: (rows, P) what a unit of each row moves the estimates by, over the square of its noise.
        expected: (P,) squares of the estimates' deviations by the noise of the samples alone.
    """
    limbs = 1 if problem.clock else 1 + int(problem.limb.max())  # errors of stamps are common to all limbs
    block = problem.place * limbs + (0 if problem.clock else problem.limb)
    scores = np.zeros((1 + int(block.max()), moved.shape[1]))
    np.add.at(scores, block, moved * (found.normal.stamps.weight * found.normal.residuals)[:, None])
    scores = scores[scores.any(axis=1)]
    blocks = len(scores)
    if blocks < _FEWEST:
        return np.ones(moved.shape[1])
    spread = (scores**2).sum(0) * blocks / (blocks - 1) * (t.ppf(0.975, blocks - 1) / Z) ** 2
    return np.asarray(np.maximum(spread / np.maximum(expected, 1e-12 * expected.max()), 1.0))


def _absorbed(
    problem: LeastSquares, found: Fitted, moved: np.ndarray, tests: Sequence[Whiteness]
) -> Float[np.ndarray, " P"]:
    """Return how far what the model lacks may have moved the estimates, all signals' parts in one direction."""
    names, weight, most = problem.model.windows.names, found.normal.stamps.weight, np.zeros(moved.shape[1])
    for test in tests:
        own = problem.rows.signal == names.index(test.signal)
        most += np.sqrt(test.share * test.samples * (weight[own, None] * moved[own] ** 2).sum(0))
    return most


def useless(noise: Float[np.ndarray, " signals"], moved: Float[np.ndarray, " signals"], ahead: float | None) -> str:
    """Return why a fit as a whole tells nothing, in a line; "" where it does.

    Arguments:
        noise: standard deviation of the residuals of each signal.
        moved: standard deviation of each signal.
        ahead: error of what was held out, over the noise; None: nothing was.
    """
    if ahead is not None and not ahead <= _WORST:
        return f"what was held out is predicted {ahead:.3g} times worse than the noise: no interval is given"
    left = float(np.min(noise / moved))  # others may be of joints at rest
    if not left <= _UNEXPLAINED:
        return (
            f"the fit leaves {100 * left:.0f} % or more of what each signal moves by unexplained: no interval is given"
        )
    return ""


def _of_clock(problem: LeastSquares, found: Fitted, sd: np.ndarray) -> np.ndarray:
    """Return each variable's derivative by the log's clock (P,), s: the time from a command to a sample.

    Velocities that are late against positions, as those of a simulator of first order are by half its step, show how
    well times are meant; without velocities nothing does.
    """
    keys, most = [v.key for v in problem.model.variables], _CLOCK * problem.model.windows.time_step
    late = keys.index("log.velocity.delay") if "log.velocity.delay" in keys else None
    if late is not None:
        shown = abs(float(found.x[late]))
        most = min(shown, most) if shown > 3 * sd[late] else 0.0
    return np.array([most if key == DELAY else 0.0 for key in keys])


def covariance_of(information: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return the covariance (P, P) of variables of which a prior knows each to `sd`, in what unit they are.

    What rounding leaves of a direction is no information: of that the prior alone is known.
    """
    scale = np.sqrt(np.diag(information).clip(0.0) + 1 / sd**2)
    of_prior = 1 / (scale * sd) ** 2
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale) + np.diag(of_prior))
    known = np.where(values > _ROUNDING, values, np.maximum(vectors.T**2 @ of_prior, _LEAST))
    return np.asarray((vectors / known) @ vectors.T / np.outer(scale, scale))


def _directions(
    variables: Sequence[Variable], information: np.ndarray, sd: np.ndarray, x: np.ndarray
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return in words the directions that the log does not tell, and what it tells of the same variables together."""
    values, vectors = np.linalg.eigh(information * np.outer(sd, sd))
    blind = np.maximum(values, 0.0) + 1 < 1 / SEEN**2
    lines, involved = [], np.zeros(len(variables), bool)
    for direction in vectors[:, blind].T:
        loud = np.abs(direction) > _LOUD
        loud |= np.abs(direction) == np.abs(direction).max()
        if all(v.beside for v, named in zip(variables, loud, strict=True) if named):
            continue
        involved |= loud
        first, *others = [v.key for v, named in zip(variables, loud, strict=True) if named]
        apart = f" from {' and '.join(others)}" if others else ""
        lines.append(f"this log does not tell {first}{apart}")
    combined = []
    for value, direction in zip(values[~blind], vectors[:, ~blind].T, strict=True):
        share = direction / sd  # on the variables themselves
        named = (np.abs(direction) > _LOUD) & involved
        if named.sum() < 2 or (direction[involved] ** 2).sum() < 0.5:
            continue
        share = share / np.abs(share[named]).max()
        terms = [f"{share[n]:+.3g} {_coordinate(variables[n])}" for n in np.flatnonzero(named).tolist()]
        width = Z / math.sqrt(value) / np.abs(direction / sd)[named].max()
        combined.append(f"{' '.join(terms)} = {float(share[named] @ x[named]):.4g} +- {width:.2g}")
    return tuple(dict.fromkeys(lines)), tuple(combined)


def _coordinate(variable: Variable) -> str:
    return f"log({variable.key})" if variable.log else variable.key


def whiteness(problem: LeastSquares, found: Fitted) -> list[Whiteness]:
    """Return the test of Ljung and Box for the residuals of each signal, of the windows that were fitted."""
    rows, windows, tests = problem.rows, problem.model.windows, []
    when = windows.begin[rows.window] + (rows.step + rows.share) * windows.time_step
    for number, name in enumerate(windows.names):
        own = np.flatnonzero((rows.signal == number) & problem.fitted)
        own = own[np.argsort(when[own], kind="stable")]
        count = len(own)
        lags = min(_LAGS, count // 5)
        if lags < 1:
            continue
        scaled = np.clip(found.normal.residuals[own] / found.noise[number], -_CLIP, _CLIP)
        total = float((scaled**2).sum()) or 1.0
        correlation = np.array([float(scaled[lag:] @ scaled[:-lag]) / total for lag in range(1, lags + 1)])
        statistic = count * (count + 2) * float((correlation**2 / (count - np.arange(1, lags + 1))).sum())
        by_chance = float(chi2.isf(_FALSE_ALARM / len(windows.names), lags))
        period = float(np.median(np.diff(when[own])))
        share = unmodelled(float(np.abs(correlation).max()), statistic / by_chance)
        tests.append(Whiteness(name, float(chi2.sf(statistic, lags)), correlation, period, share, count))
    return tests


def unmodelled(correlation: float, statistic: float) -> float:
    """Return the share of the residuals' variance that the model lacks, 0 up to the limits of the test.

    Noise is not correlated, so that what is correlated makes up as much of the residuals as their correlation says. It
    is shrunk by what chance, and a correlation too small to matter, would have (the non-negative garrote).

    Arguments:
        correlation: the largest, 0 to 1.
        statistic: of the test, over the value that it exceeds by chance once in so many logs.
    """
    shown = max(1 - 1 / statistic, 0.0) if statistic else 0.0
    return correlation * shown * (max(1 - (_MATTERS / correlation) ** 2, 0.0) if correlation else 0.0)


def suspicious(tests: Sequence[Whiteness]) -> list[Whiteness]:
    """Return the tests whose signals are not white, the worst first."""
    return sorted((test for test in tests if test.share), key=lambda test: -np.abs(test.correlation).max())


def interval(variable: Variable, x: float, sd: float) -> tuple[float, float]:
    """Return the 95 % interval in SI units, inside the bounds."""
    ends = np.array([x - Z * sd, x + Z * sd])
    low, high = np.clip(np.exp(ends) if variable.log else ends, variable.lower, variable.upper)
    return float(low), float(high)
