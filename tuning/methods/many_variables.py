"""Descent in many variables whose slopes reverse mode gives: Adam for several problems side by side.

Unlike the methods of `METHODS` it knows no gains: a problem is a row of variables, and a function evaluates them.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.methods.adam import Adam

SMOOTH = 0.6  # share of the evaluations that follow the smooth companions of extremes; the rest follow the true ones
LAST = 0.03  # share of the first step that the last one has
PATIENCE = 8  # evaluations without a better point after which a problem goes back to its best one
MEMORY = 0.9, 0.97  # of slopes and of their squares, a share per step
TINY = 1e-30


class Evaluated(NamedTuple):
    """The evaluation of a point of each problem."""

    merit: Float[np.ndarray, " problem"]  # to compare points; infinite for a walk that was lost
    slopes: Float[np.ndarray, "problem variable"]


class Descended(NamedTuple):
    """The best point of each problem."""

    x: Float[np.ndarray, "problem variable"]
    merit: Float[np.ndarray, " problem"]
    first: Float[np.ndarray, " problem"]  # the merit of the point that was begun with
    slope: Float[np.ndarray, " problem"]  # norm of the smooth slopes at the best point, relative to that at the first


Evaluate = Callable[[np.ndarray, float], Evaluated]  # of a point of each problem, and `sharp` of `Walks.evaluate`


def descend(
    evaluate: Evaluate,
    x: Float[np.ndarray, "problem variable"],
    evaluations: int,
    *,
    step: float,
    known: Float[np.ndarray, " problem"] | None = None,
) -> Descended:
    """Move each problem's variables down its slopes and return the best point of each, at best the first one.

    The smooth companions of extremes lead first, the true metrics at the end; points are compared by the true ones. A
    problem that is lost, or has found nothing better for a while, goes back to its best point and steps half as far.

    Arguments:
        evaluate: of points and `sharp`.
        x: where to begin.
        evaluations: how many, two or more; the last one is of the best point.
        step: of a variable in the first evaluation, in its unit.
        known: the merits of the first points, where they have been evaluated before: the best are no worse.
    """
    rates = step * (LAST + (1 - LAST) * 0.5 * (1 + np.cos(np.pi * np.arange(evaluations) / evaluations)))
    x = np.array(x, float)
    adam = Adam(x, x.shape[1], MEMORY, PATIENCE, TINY)
    first = begun = np.full(len(x), np.nan)
    adam.least = adam.least if known is None else known
    for number, rate in enumerate(rates[:-1]):
        found = evaluate(x, float(number >= SMOOTH * evaluations))
        lost = ~(np.isfinite(found.merit) & np.isfinite(found.slopes).all(1))
        slopes = np.where(lost[:, None], 0.0, found.slopes)
        if number == 0:
            first, begun, adam.there = found.merit if known is None else known, slopes, slopes
        x, steps = adam.step(x, found.merit, slopes, lost)
        x = x - rate * steps
    end = evaluate(adam.best, 0.0)
    slope = np.linalg.norm(end.slopes, axis=1) / np.maximum(np.linalg.norm(begun, axis=1), 1e-300)
    return Descended(adam.best, adam.least, first, slope)
