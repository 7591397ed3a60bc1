"""Levenberg and Marquardt's method, from several points in one batch, within bounds."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from tuning.identification.fit.iterates import Iterate, Iterates
from tuning.identification.fit.least_squares import Ending, Fitted, LeastSquares, Normal, eliminated, raised
from tuning.identification.model.predicted import Fit

_ENOUGH = 0.02  # decrease of the cost, half a chi^2, at which the search ends
_DAMPING, _SOFTER, _HARDER, _MOST = 1e-4, 0.1, 10.0, 1e3
_FULL = 0.1  # damping with which a step is nearly the full one
_NEAR = 0.2  # standard deviations from a minimum, of each variable that is asked for


class Prior(NamedTuple):
    mean: np.ndarray
    sd: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def prior_of(model: Fit) -> Prior:
    """Return priors and bounds of the coordinates, (P,) each."""
    low, high = np.reshape([v.bounds for v in model.variables], (-1, 2)).T
    mean, sd = np.reshape([(v.mean, v.sd) for v in model.variables], (-1, 2)).T
    return Prior(mean, sd, low, high)


def search(
    problem: LeastSquares, x: np.ndarray, start: np.ndarray, most: int, text: str, kept: Iterates
) -> list[Fitted]:
    """Return where the search from each of several points (points, P) ends; all points move together, in one batch."""
    prior, points = prior_of(problem.model), len(x)
    first = Iterate(x, start, np.full(points, _DAMPING), *np.zeros((2, points), bool))
    iteration, (x, start, damping, slow, done) = kept.begin(text, most, first)
    normals = problem.linearized(x, start)
    costs = [n.cost + _prior_cost(prior, each) for n, each in zip(normals, x, strict=True)]
    done = done | ~np.isfinite(costs)
    while iteration < most and not done.all():
        kept.show(iteration, min(costs))
        iteration += 1
        memory = problem.model.memory
        steps = [_step(normals[k], x[k], damping[k], start[k], prior, memory) for k in range(points)]
        trial, trial_start = (np.stack(each) for each in zip(*steps, strict=True))
        found = problem.linearized(trial, trial_start)
        for k, normal in enumerate(found):
            cost = normal.cost + _prior_cost(prior, trial[k])
            full = damping[k] <= _FULL  # one that damping cuts short gains little anywhere
            if done[k]:
                continue
            if cost <= costs[k]:
                little = costs[k] - cost < _ENOUGH
                slow[k], done[k] = little, little and (full or slow[k])
                x, start = x.copy(), start.copy()
                x[k], start[k], normals[k], costs[k] = trial[k], trial_start[k], normal, cost
                damping[k] = max(damping[k] * _SOFTER, 1e-12)
            else:
                damping[k] *= _HARDER
                done[k] = damping[k] > _MOST or (cost - costs[k] < _ENOUGH / 4 and full)
        kept.keep(iteration, Iterate(x, start, damping, slow, done))
    kept.end(iteration)
    ends = []
    asked = np.array([not v.beside for v in problem.model.variables])
    for k, normal in enumerate(normals):
        away = _away(normal, x[k], prior) if np.isfinite(costs[k]) else np.full(len(x[k]), np.inf)
        ended: Ending = "converged" if (away[asked] < _NEAR).all() else "stuck" if done[k] else "out of iterations"
        ends.append(Fitted(x[k], start[k], problem.noise, problem.clock, normal, costs[k], iteration, away, ended))
    return ends


def _prior_cost(prior: Prior, x: np.ndarray) -> float:
    return float((((x - prior.mean) / prior.sd) ** 2).sum()) / 2


def _step(
    normal: Normal, x: np.ndarray, damping: float, start: np.ndarray, prior: Prior, memory: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the next point and starts."""
    gradient, matrix, ways = _system(normal, x, damping, prior)
    after = np.clip(x + _move(gradient, matrix, x, prior), prior.lower, prior.upper)
    later = start.copy()
    if ways:
        of_states = np.stack([way[:, -1] - way[:, :-1] @ (after - x) for way in ways])
        later += of_states.reshape(len(ways), len(start), -1).swapaxes(0, 1).reshape(start.shape)
    if "bristle" in memory:
        place = 2 + memory.index("bristle")
        later[..., place] = np.clip(later[..., place], -1.0, 1.0)
    return after, later


def _away(normal: Normal, x: np.ndarray, prior: Prior) -> Float[np.ndarray, " P"]:
    """Return how far a step without damping would move each variable, in its standard deviations: 0 at a minimum."""
    gradient, matrix, _ = _system(normal, x, 0.0, prior)
    try:
        covariance = cho_solve(_factor(matrix), np.eye(len(x)))
    except FloatingPointError:  # rounding leaves no step without damping
        return np.full(len(x), np.inf)
    return np.asarray(np.abs(_move(gradient, matrix, x, prior)) / np.sqrt(np.diag(covariance)))


def _system(
    normal: Normal, x: np.ndarray, damping: float, prior: Prior
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return gradient and matrix of the variables with their priors, and what eliminates the states."""
    gradient, matrix, ways = eliminated(normal, damping)
    return gradient + (prior.mean - x) / prior.sd**2, matrix + np.diag((1 + damping) / prior.sd**2), ways


def _move(gradient: np.ndarray, matrix: np.ndarray, x: np.ndarray, prior: Prior) -> np.ndarray:
    """Return the step of the variables: those at a bound that it would pass stay there."""
    free, move = np.ones(len(x), bool), np.zeros(len(x))
    while free.any():
        inner = np.ix_(free, free)
        move = np.zeros(len(x))
        move[free] = cho_solve(_factor(matrix[inner]), gradient[free])
        out = free & (((x <= prior.lower) & (move < 0)) | ((x >= prior.upper) & (move > 0)))
        if not out.any():
            break
        free &= ~out
    return move


def _factor(matrix: np.ndarray) -> Any:
    """Return a Cholesky factor; what is not positive definite by rounding is raised by as much."""
    diagonal = np.diag(np.maximum(np.diag(matrix), 1e-300))
    return raised(lambda share: cho_factor(matrix + share * diagonal, lower=True))
