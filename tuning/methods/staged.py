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
SCALES = np.array([1.0, 0.5])  # of the steps of the starts that go on to the second stage, the best first: a bold
# one crosses to better valleys, a careful one gets further down its own
ONE_STAGE = 20  # iterations
TIED, FREE = 12, 40  # iterations of the two stages

# (task, points (B, n), ties (k, n), iterations, rng, phase, scales of the steps (B,)) -> visited points and merits
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
    phase = "axes tied" if second else "descent"
    visited, merit = yield from descend(task, theta, space.ties, first, rng, phase, np.ones(len(theta)))
    if not second:
        return
    best = np.argmin(merit, axis=0)  # of each start
    rows = np.arange(len(theta))
    order = np.argsort(merit[best, rows], kind="stable")[: len(SCALES)]
    theta = visited[best, rows][order]
    yield from descend(task, theta, np.eye(space.size), second, rng, "axes free", SCALES[: len(theta)])
