"""Descent in many variables whose slopes reverse mode gives: Adam for several problems side by side.

Unlike the methods of `METHODS` it knows no gains: a problem is a row of variables, and what evaluates them a function.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.methods.descents import choose

SMOOTH = 0.6  # share of the evaluations that follow the smooth companions of extremes; the rest follow the true ones
LAST = 0.03  # share of the first step that the last one has
PATIENCE = 8  # evaluations without a better point after which a problem goes back to its best one
BACK = 0.5  # share of its steps that it keeps then
MEMORY = 0.9, 0.97  # of slopes and of their squares, a share per step


class Evaluated(NamedTuple):
    """What is known about a point of each problem."""

    merit: Float[np.ndarray, " problem"]  # what points are compared by; infinite for a walk that was lost
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
    x, count = np.array(x, float), len(x)
    best, least = x, np.full(count, np.inf) if known is None else known
    there = mean = square = np.zeros_like(x)  # the slopes at the best point, and what Adam remembers of all
    waited, made, scale = np.zeros(count, int), np.zeros((count, 1)), np.ones((count, 1))
    first = begun = np.full(count, np.nan)
    for number in range(evaluations - 1):
        found = evaluate(x, float(number >= SMOOTH * evaluations))
        sound = np.isfinite(found.merit) & np.isfinite(found.slopes).all(1)
        slopes = np.where(sound[:, None], found.slopes, 0.0)
        if number == 0:
            first, begun, there = found.merit if known is None else known, slopes, slopes
        better = sound & (found.merit < least)
        least = np.where(better, found.merit, least)
        best, there = choose(better, (x, slopes), (best, there))
        waited = np.where(better, 0, waited + 1)
        back = ~sound | (waited >= PATIENCE)
        x, slopes = choose(back, (best, there), (x, slopes))
        mean, square, made = choose(back, (0 * mean, 0 * square, 0 * made), (mean, square, made))
        scale, waited = np.where(back[:, None], BACK * scale, scale), np.where(back, 0, waited)
        made = made + 1
        mean = MEMORY[0] * mean + (1 - MEMORY[0]) * slopes
        square = MEMORY[1] * square + (1 - MEMORY[1]) * slopes**2
        sizes = np.sqrt(square / (1 - MEMORY[1] ** made))
        x = x - rates[number] * scale * mean / (1 - MEMORY[0] ** made) / np.maximum(sizes, 1e-30)
    end = evaluate(best, 0.0)
    slope = np.linalg.norm(end.slopes, axis=1) / np.maximum(np.linalg.norm(begun, axis=1), 1e-300)
    return Descended(best, least, first, slope)
