"""Descents along gradients in stages, which `gradient.py` and `lbfgs.py` carry out.

All axes are tied first, which is cheap; then a short race with the axes free; then its winner alone. A step with k
tangents costs 1 + k, so a first descent along two directions (damping and stiffness of all axes at once) brings the
starts close for a quarter of the price of twelve. Along twelve, one start that walks far does better than two that walk
half as far, but which of them is known only after some steps. An isotropic space has the first stage only.
"""

import abc
from collections.abc import Generator
from typing import Any, NamedTuple

import jax
import numpy as np

from tuning.methods.method import Method, Points, Request, Task
from tuning.problem.evaluation import Evaluation

STARTS = 3
CANDIDATES = 12  # random points walked per start that they give
SCALES = np.array([1.0, 0.5])  # of the steps of the starts that race, the best first: a bold one crosses to better
# valleys, a careful one gets further down its own
ONE_STAGE = 20  # iterations
STAGES = 12, 10, 64  # iterations: axes tied, the race, the winner alone
SINGLE, TIED, RACE, ALONE = "descent", "axes tied", "axes free", "winner alone"  # phases of a search


class Leg(NamedTuple):
    """A descent of B points."""

    theta: np.ndarray  # (B, n) where they start
    ties: np.ndarray  # (k, n) directions in which they move
    iterations: int
    phase: str
    scales: np.ndarray  # (B,) of their steps


Descent = Generator[Request, Evaluation, tuple[np.ndarray, np.ndarray]]


class Descents(Method):
    """Descents from several starts with the axes tied, a race of the two best with the axes free, the winner alone."""

    gradients = True

    @abc.abstractmethod
    def descend(self, task: Task, leg: Leg, rng: np.random.Generator) -> Descent:
        """Move along the rows of `leg.ties`; return the points visited (iterations, B, n) and their merits."""

    def rounds(self, task: Task) -> int:
        return sum(iterations(task)) + ((task.search.starts or STARTS) > 1)

    def run(self, task: Task) -> Points:
        """Take the scenario's own gains for the first start, for the others the best known gains and random points.

        A space whose axes are tied anyway has a single descent.
        """
        space, count, theta = task.problem.space, task.search.starts or STARTS, task.start[None]
        rng = np.random.default_rng(task.search.seed)
        first, *others = iterations(task)
        if count > 1:
            # the same gains on all axes: of points drawn in twelve dimensions hardly one is any good
            drawn = space.draw_tied(rng, CANDIDATES * (count - 1))
            drawn[: len(task.known) - 1] = task.known[1:]
            found = yield Request(drawn, None, "random points")
            theta = np.concatenate([theta, drawn[np.argsort(found.merit, kind="stable")[: count - 1]]])
        scales = np.ones(len(theta))
        if not others:
            yield from self.descend(task, Leg(theta, space.ties, first, SINGLE, scales), rng)
            return
        visited = yield from self.descend(task, Leg(theta, space.ties, first, TIED, scales), rng)
        free, theta = np.eye(space.size), _best(*visited, len(SCALES))
        visited = yield from self.descend(task, Leg(theta, free, others[0], RACE, SCALES[: len(theta)]), rng)
        yield from self.descend(task, Leg(_best(*visited, 1), free, others[1], ALONE, np.ones(1)), rng)


def iterations(task: Task) -> tuple[int, ...]:
    """Return how many iterations the stages take; a number in the settings is that of the last one."""
    wished, space = task.search.iterations, task.problem.space
    if len(space.ties) == space.size:
        return (wished or ONE_STAGE,)
    return *STAGES[:2], wished or STAGES[2]


def _best(visited: np.ndarray, merits: np.ndarray, count: int) -> np.ndarray:
    """Return the best point of each of the best starts (count, n), the best first."""
    best, rows = np.argmin(merits, axis=0), np.arange(merits.shape[1])
    order = np.argsort(merits[best, rows], kind="stable")[:count]
    return np.asarray(visited[best, rows][order])


def choose(rows: np.ndarray, yes: Any, no: Any) -> Any:
    """Return the rows of one pytree where `rows` (B,) is true and those of another elsewhere."""
    return jax.tree.map(lambda y, n: np.where(rows.reshape(-1, *[1] * (np.ndim(y) - 1)), y, n), yes, no)
