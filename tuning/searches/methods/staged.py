"""Stages that descents share: all axes tied, which is cheap; a short race with the axes free; its winner alone.

A step with k tangents costs 1 + k, so a first descent along two directions (damping and stiffness of all axes at
once) brings the starts close for a quarter of the price of twelve. Along twelve, one start that walks far does better
than two that walk half as far, but which of them is known only after some steps. An isotropic space has the first
stage only.
"""

from collections.abc import Callable

import numpy as np

from tuning.searches.methods import starts
from tuning.searches.methods.task import Descent, Points, Task

STARTS = 3
SCALES = np.array([1.0, 0.5])  # of the steps of the starts that race, the best first: a bold one crosses to better
# valleys, a careful one gets further down its own
ONE_STAGE = 20  # iterations
TIED, RACE, ALONE = 12, 10, 64  # iterations of the three stages

# (task, points (B, n), ties (k, n), iterations, rng, phase, scales of the steps (B,))
Descend = Callable[..., Descent]


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
    theta = yield from starts.choose(task, task.search.starts or STARTS, rng)
    scales = np.ones(len(theta))
    if not others:
        yield from single(task, theta, space.ties, first, rng, "descent", scales)
        return
    visited = yield from tied(task, theta, space.ties, first, rng, "axes tied", scales)
    free = np.eye(space.size)
    theta = _best(*visited, len(SCALES))
    visited = yield from race(task, theta, free, others[0], rng, "axes free", SCALES[: len(theta)])
    yield from alone(task, _best(*visited, 1), free, others[1], rng, "winner alone", np.ones(1))


def _best(visited: np.ndarray, merits: np.ndarray, count: int) -> np.ndarray:
    """Return the best point of each of the best starts (count, n), the best first."""
    best, rows = np.argmin(merits, axis=0), np.arange(merits.shape[1])
    order = np.argsort(merits[best, rows], kind="stable")[:count]
    return np.asarray(visited[best, rows][order])
