"""Stages that descents share: all axes tied, which is cheap; a short race with the axes free; its winner alone.

A step with k tangents costs 1 + k, so a first descent along two directions (damping and stiffness of all axes at
once) brings the starts close for a quarter of the price of twelve. Along twelve, one start that walks far does better
than two that walk half as far, but which of them is known only after some steps. An isotropic space has the first
stage only.
"""

from collections.abc import Callable, Generator
from typing import NamedTuple

import numpy as np

from tuning.problem.evaluation import Evaluation
from tuning.searches.methods.task import Points, Request, Task

STARTS = 3
CANDIDATES = 12  # random points walked per start that they give
SCALES = np.array([1.0, 0.5])  # of the steps of the starts that race, the best first: a bold one crosses to better
# valleys, a careful one gets further down its own
ONE_STAGE = 20  # iterations
TIED, RACE, ALONE = 12, 10, 64  # iterations of the three stages


class Leg(NamedTuple):
    """A descent of B points."""

    theta: np.ndarray  # (B, n) where they start
    ties: np.ndarray  # (k, n) directions in which they move
    iterations: int
    phase: str
    scales: np.ndarray  # (B,) of their steps


Descent = Generator[Request, Evaluation, tuple[np.ndarray, np.ndarray]]  # all points visited, and their merits
Descend = Callable[[Task, Leg, np.random.Generator], Descent]


def iterations(task: Task) -> tuple[int, ...]:
    """Return how many iterations the stages take; a number in the settings is that of the last one."""
    wished, space = task.search.iterations, task.problem.space
    if len(space.ties) == space.size:
        return (wished or ONE_STAGE,)
    return TIED, RACE, wished or ALONE


def rounds(task: Task) -> int:
    """Return how many rounds a run takes: the random points, then the iterations."""
    return sum(iterations(task)) + ((task.search.starts or STARTS) > 1)


def run(task: Task, single: Descend, tied: Descend, race: Descend, alone: Descend) -> Points:
    """Choose starts, descend with the axes tied, let the two best race with the axes free, go on with the winner.

    A space whose axes are tied anyway has a single descent.
    """
    space = task.problem.space
    rng = np.random.default_rng(task.search.seed)
    first, *others = iterations(task)
    theta = yield from _starts(task, rng)
    scales = np.ones(len(theta))
    if not others:
        yield from single(task, Leg(theta, space.ties, first, "descent", scales), rng)
        return
    visited = yield from tied(task, Leg(theta, space.ties, first, "axes tied", scales), rng)
    free, theta = np.eye(space.size), _best(*visited, len(SCALES))
    visited = yield from race(task, Leg(theta, free, others[0], "axes free", SCALES[: len(theta)]), rng)
    yield from alone(task, Leg(_best(*visited, 1), free, others[1], "winner alone", np.ones(1)), rng)


def _starts(task: Task, rng: np.random.Generator) -> Generator[Request, Evaluation, np.ndarray]:
    """Return (count, n) points: the scenario's own gains first, then the best of a Latin hypercube.

    Random points have the same gains on all axes: of points drawn in twelve dimensions hardly one is any good.
    """
    count = task.search.starts or STARTS
    if count == 1:
        return task.start[None]
    drawn = task.problem.space.draw_tied(rng, CANDIDATES * (count - 1))
    found = yield Request(drawn, None, "random points")
    best = np.argsort(found.merit, kind="stable")[: count - 1]
    return np.concatenate([task.start[None], drawn[best]])


def _best(visited: np.ndarray, merits: np.ndarray, count: int) -> np.ndarray:
    """Return the best point of each of the best starts (count, n), the best first."""
    best, rows = np.argmin(merits, axis=0), np.arange(merits.shape[1])
    order = np.argsort(merits[best, rows], kind="stable")[:count]
    return np.asarray(visited[best, rows][order])
