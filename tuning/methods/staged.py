"""Two stages that descents share: all axes tied, which is cheap, then every coordinate of the space by itself.

A step with k tangents costs 1 + k, so a first descent along two directions (damping and stiffness of all axes at
once) brings the starts close for a quarter of the price of twelve. An isotropic space has the first stage only.
"""

from collections.abc import Callable, Generator

import numpy as np

from tuning.evaluation import Evaluation
from tuning.methods import starts
from tuning.methods.task import Points, Request, Task

STARTS = 3
KEPT = 2  # starts that go on to the second stage
ONE_STAGE = 20  # iterations
TIED, FREE = 12, 40  # iterations of the two stages

# (task, points (B, n), ties (k, n), iterations, rng, phase, scale of the first step) -> visited points and merits
Descent = Callable[..., Generator[Request, Evaluation, tuple[np.ndarray, np.ndarray]]]


def iterations(task: Task) -> tuple[int, int]:
    """Return how many iterations the two stages take; a number in the settings is that of the last stage."""
    space, wished = task.problem.space, task.search.iterations
    if len(space.ties) == space.size:
        return wished or ONE_STAGE, 0
    return TIED, wished or FREE


def rounds(task: Task) -> int:
    """Return how many rounds a run takes: the random points, then the iterations."""
    return sum(iterations(task)) + ((task.search.starts or STARTS) > 1)


def run(task: Task, descend: Descent) -> Points:
    """Choose starts, descend with the axes tied, then from the best points with the axes free."""
    space = task.problem.space
    rng = np.random.default_rng(task.search.seed)
    first, second = iterations(task)
    theta = yield from starts.choose(task, task.search.starts or STARTS, rng)
    visited, merit = yield from descend(task, theta, space.ties, first, rng, "axes tied" if second else "descent", 1.0)
    if not second:
        return
    best = np.argmin(merit, axis=0)  # of each start
    rows = np.arange(len(theta))
    order = np.argsort(merit[best, rows], kind="stable")[:KEPT]
    theta = visited[best, rows][order]
    yield from descend(task, theta, np.eye(space.size), second, rng, "axes free", 0.5)
