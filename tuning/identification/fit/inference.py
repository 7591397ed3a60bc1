"""The worth of a fit: intervals, parameters that the log does not tell, and tests of the residuals.

Intervals are those of the posterior: the information of the samples, with starts eliminated, beside the prior. The
information of the samples is divided by the square of a widening, the prior is not: no log makes it worse. The
widening has two parts.

- The gradients of blocks, a limb in a window, may scatter more than those of independent noise. Their scatter is that
  of few blocks, so that it counts by Student's quantile.
- Where a signal's residuals are correlated in time, the model lacks something that moves: a discrepancy with this
  correlation counts as noise. How much of it counts grows from nothing at the limits of the test, so that a false alarm
  costs little.

The held-out part may be predicted worse than the noise; intervals are wider by as much. A variable that the samples do
not tell is held at its nominal value: its posterior is its prior, and the others' intervals have that doubt in them.
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

from tuning.identification.fit.problem import Fitted, Problem
from tuning.identification.model.predicted import DELAY
from tuning.identification.model.variables import Variable

Z = 1.959964  # of 95 %
SEEN = 0.5  # of the prior's sd: a wider posterior counts as not told
_FEWEST = 8  # blocks, whose scatter is one
_LOUD = 0.35  # share of a direction that names a variable
_FALSE_ALARM = 1e-3  # of the test of all signals together
_LAGS, _MATTERS = 20, 0.1  # samples, and a correlation below which it is none that matters
_CLOCK = 0.1  # of a time step, to which the time of a command is known
_CLIP = 4.0  # of the noise: outliers say nothing of correlation
_UNEXPLAINED = 0.5  # of a signal's standard deviation, that of its residuals: beyond it the fit explains little
_HELPS = {  # motions and weights that tell a key apart, by a part of its name
    "load_friction": "another weight", "control.k": "another P gain", "armature": "faster motions",
    "mass": "faster motions", "viscous": "long fast strokes", "no_load_speed": "long fast strokes",
    "torque_limit": "a motion at the limit", "friction": "slow reversals", "backlash": "slow reversals",
    "delay": "steps of the command", "stiffness": "another weight", "gain": "another weight",
}  # fmt: skip
_ROUNDING, _LEAST = 1e-10, 1e-300  # of the largest information along a direction


class Posterior(NamedTuple):
    """The posterior of the variables, in coordinates; held ones have their priors."""

    covariance: Float[np.ndarray, "P P"]  # widened
    unseen: tuple[str, ...]  # directions, in words
    combined: tuple[str, ...]  # told combinations of variables that are not told, in words


class Whiteness(NamedTuple):
    """Of one signal's residuals over its noise."""

    signal: str
    correlation: Float[np.ndarray, " lags"]
    period: float  # s, of a lag
    share: float  # of the residuals' variance, that the model lacks; 0: nothing
    lasting: Float[np.ndarray, " lags"]  # the part of the correlation that counts, from the first lag on
    rows: np.ndarray  # (samples,), in the order of time

    @property
    def in_words(self) -> str:
        """The fault of the model, in a line."""
        lag = int(np.argmax(np.abs(self.correlation))) + 1
        return (
            f"the model is wrong: residuals of {self.signal} are correlated, {self.correlation[lag - 1]:+.2f} "
            f"{lag * self.period:.3g} s apart"
        )


def untold(problem: Problem, found: Fitted) -> np.ndarray:
    """Which of the variables that were asked for the samples do not tell, (P,) bool: those to be held.

    All of which they say next to nothing, were the others known; else the one they tell least.
    """
    sd, asked = problem.prior.sd, problem.free & np.array([not v.beside for v in problem.model.variables])
    alone = asked & (np.diag(found.information) * sd**2 + 1 < 1 / SEEN**2)
    if alone.any():
        return np.asarray(alone)
    free = np.flatnonzero(problem.free)
    known = np.zeros(len(sd))
    known[free] = np.sqrt(np.diag(covariance_of(found.information[np.ix_(free, free)], sd[free]))) / sd[free]
    known[~asked] = 0.0
    return np.asarray((known == known.max()) & (known > SEEN))


def posterior(problem: Problem, found: Fitted, tests: Sequence[Whiteness], ahead: float = 1.0) -> Posterior:
    """Return the posterior of a fit.

    Arguments:
        problem: as it was fitted.
        found: where the search ended.
        tests: of its residuals.
        ahead: error of the held-out part over the noise; intervals are wider by its excess over 1.
    """
    variables, sd, free = problem.model.variables, problem.prior.sd, np.flatnonzero(problem.free)
    held, information = np.flatnonzero(~problem.free), found.information
    fisher = covariance_of(information[np.ix_(free, free)], sd[free])
    own = np.sqrt(np.diag(fisher))
    moved = found.along[:, free] @ fisher  # of the estimates by each row
    expected = np.diag(fisher @ information[np.ix_(free, free)] @ fisher)
    square = max(ahead, 1.0) ** 2 * np.maximum(
        _scatter(problem, found, moved, expected), _discrepancy(found, moved, tests)
    )
    of_samples = np.maximum(1 / own**2 - 1 / sd[free] ** 2, 0.0)
    widened = 1 / np.sqrt(1 / sd[free] ** 2 + of_samples / square)
    along_held = -fisher @ information[np.ix_(free, held)]  # how they move with the held ones
    covariance = np.diag(sd**2)
    covariance[np.ix_(free, held)] = along_held * sd[held] ** 2
    covariance[np.ix_(held, free)] = covariance[np.ix_(free, held)].T
    covariance[np.ix_(free, free)] = (
        fisher * np.outer(widened / own, widened / own) + (along_held * sd[held] ** 2) @ along_held.T
    )
    covariance += np.diag(_of_clock(problem, found, np.sqrt(np.diag(covariance))) ** 2)
    return Posterior(covariance, *_directions(variables, information, sd, found.x))


def _scatter(problem: Problem, found: Fitted, moved: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return the scatter of the gradients of blocks over that of independent noise (k,), 1 or more.

    Arguments:
        problem: as it was fitted.
        found: the fit.
        moved: (rows, k) change of the estimates by a unit of each row.
        expected: (k,) squares of the estimates' deviations by the noise of the samples alone.
    """
    rows, windows = problem.rows, problem.model.windows
    limb = windows.limb[rows.signal]
    limbs = 1 if problem.clock else 1 + int(limb.max())  # errors of stamps are common to all limbs
    block = rows.window * limbs + (0 if problem.clock else limb)
    scores = np.zeros((1 + int(block.max()), moved.shape[1]))
    np.add.at(scores, block, moved * (found.weight * found.scaled * problem.fitted)[:, None])
    scores = scores[scores.any(axis=1)]
    blocks = len(scores)
    if blocks < _FEWEST:
        return np.ones(moved.shape[1])
    spread = (scores**2).sum(0) * blocks / (blocks - 1) * (t.ppf(0.975, blocks - 1) / Z) ** 2
    return np.asarray(np.maximum(spread / np.maximum(expected, 1e-12 * expected.max()), 1.0))


def _discrepancy(found: Fitted, moved: np.ndarray, tests: Sequence[Whiteness]) -> Float[np.ndarray, " k"]:
    """Return by how much correlated residuals raise the estimates' variances (k,): 1 or more."""
    weight, by_itself = found.weight[:, None], np.full(moved.shape[1], _LEAST)
    together = by_itself
    for test in tests:
        own = moved[test.rows] * weight[test.rows]
        square = (own**2).sum(0)
        by_itself, together = by_itself + square, together + square
        if len(test.lasting):
            apart = np.stack([_sums(column, len(test.lasting)) for column in own.T], axis=1)
            together = together + 2 * np.maximum(test.lasting @ apart[1:], 0.0)
    return np.asarray(together / by_itself)


def unexplained(noise: Float[np.ndarray, " signals"], moved: Float[np.ndarray, " signals"]) -> str:
    """Return how much of the log a fit leaves unexplained, in a line; "" where it is little.

    Arguments:
        noise: standard deviation of the residuals of each signal.
        moved: standard deviation of each signal.
    """
    left = float(np.min(noise / moved))  # others may be of joints at rest
    if left <= _UNEXPLAINED:
        return ""
    return f"the fit leaves {100 * left:.0f} % or more of what each signal moves by unexplained"


def _of_clock(problem: Problem, found: Fitted, sd: np.ndarray) -> np.ndarray:
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
    """The covariance (P, P) of variables with priors of standard deviations `sd`, in any units.

    A direction within rounding of zero has no information but its prior's.
    """
    scale = np.sqrt(np.diag(information).clip(0.0) + 1 / sd**2)
    of_prior = 1 / (scale * sd) ** 2
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale) + np.diag(of_prior))
    known = np.where(values > _ROUNDING, values, np.maximum(vectors.T**2 @ of_prior, _LEAST))
    return np.asarray((vectors / known) @ vectors.T / np.outer(scale, scale))


def _directions(
    variables: Sequence[Variable], information: np.ndarray, sd: np.ndarray, x: np.ndarray
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """In words the directions that the log does not tell, and the combinations of their variables that it tells."""
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
        helps = dict.fromkeys(what for key in (first, *others) for part, what in _HELPS.items() if part in key)
        lines.append(
            f"this log does not tell {first}{apart}" + (f" (add {' or '.join([*helps][:2])})" if helps else "")
        )
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


def whiteness(problem: Problem, found: Fitted) -> list[Whiteness]:
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
        sums = _sums(np.clip(found.scaled[own], -_CLIP, _CLIP), count // 5)
        every = sums[1:] / (sums[0] or 1.0)
        correlation = every[:lags]
        statistic = count * (count + 2) * float((correlation**2 / (count - np.arange(1, lags + 1))).sum())
        by_chance = float(chi2.isf(_FALSE_ALARM / len(windows.names), lags))
        period = float(np.median(np.diff(when[own])))
        largest = float(np.abs(correlation).max())
        share = unmodelled(largest, statistic / by_chance)
        lasts = every[: int(np.argmax(every < _MATTERS)) if (every < _MATTERS).any() else len(every)]
        lasts = lasts * (share / largest if share else 0.0)
        tests.append(Whiteness(name, correlation, period, share, lasts, own))
    return tests


def _sums(values: Float[np.ndarray, " samples"], lags: int) -> Float[np.ndarray, " lags"]:
    """Sums of products of values with those so many samples later, from lag 0 on."""
    size = 2 ** int(np.ceil(np.log2(2 * len(values))))
    return np.asarray(np.fft.irfft(np.abs(np.fft.rfft(values, size)) ** 2, size)[: lags + 1])


def unmodelled(correlation: float, statistic: float) -> float:
    """Return the share of the residuals' variance that the model lacks, 0 up to the limits of the test.

    Noise is not correlated, so that the correlation bounds the unmodelled share. It is shrunk by the correlation that
    chance would give, and by one too small to matter (the non-negative garrote).

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
