"""Where descents start: the scenario's own gains, and the best of random points, side by side."""

from collections.abc import Generator

import numpy as np

from tuning.problem.evaluation import Evaluation
from tuning.searches.methods.task import Request, Task

CANDIDATES = 12  # random points walked per start that they give


def choose(task: Task, count: int, rng: np.random.Generator) -> Generator[Request, Evaluation, np.ndarray]:
    """Return (count, n) points: the scenario's own gains first, then the best of a Latin hypercube.

    Random points have the same gains on all axes: of points drawn in twelve dimensions hardly one is any good.
    """
    if count == 1:
        return task.start[None]
    drawn = task.problem.space.draw_tied(rng, CANDIDATES * (count - 1))
    found = yield Request(drawn, None, "random points")
    best = np.argsort(found.merit, kind="stable")[: count - 1]
    return np.concatenate([task.start[None], drawn[best]])
