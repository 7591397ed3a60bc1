"""Descent by Adam in stages.

All axes are tied first, which is cheap; then a short race with the axes free; then its winner alone. A step with k
tangents costs 1 + k, so a first descent along two directions (damping and stiffness of all axes at once) brings the
starts close for a quarter of the price of twelve. Along twelve, one start that walks far does better than two that walk
half as far, but which of them is known only after some steps. An isotropic space has the first stage only.
"""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np

from mjx_climb.scenario.messages import ConfigError
from tuning.methods.adam import Adam, choose
from tuning.methods.method import Method, Points, Request, Task
from tuning.problem.evaluation import Evaluation

STARTS = 3
CANDIDATES = 12  # random points walked per start that they give
SCALES = np.array([1.0, 0.5])  # of the steps of the starts that race, the best first: a bold one crosses to better
# valleys, a careful one gets further down its own
ONE_STAGE = 20  # iterations
STAGES = 12, 10, 64  # iterations: axes tied, the race, the winner alone
CLIP = 5.0  # norm of a gradient; the objective is 1 for pd
FALL = 10.0  # by how many times its value (1 for pd) a point is worse than the best where the loop has gone unstable
TINY = 1e-8


class Pace(NamedTuple):
    """How a descent by Adam moves."""

    phase: str  # of a search
    rate: float  # of the first step, in the logarithm of a gain
    last: float  # share of it at the end
    smooth: float  # share of the iterations that follow the smooth extremes; the rest follow the true ones
    memory: float  # of the squared gradient, a share per step
    patience: float  # steps without a better point after which a start goes back to its best one


SINGLE = Pace("descent", rate=0.7, last=0.03, smooth=0.5, memory=0.9, patience=5)
TIED = Pace("axes tied", rate=0.7, last=0.03, smooth=0.5, memory=0.95, patience=np.inf)
RACE = Pace("axes free", rate=0.7, last=0.5, smooth=1.0, memory=0.9, patience=5)
ALONE = Pace("winner alone", rate=0.35, last=0.03, smooth=0.3, memory=0.9, patience=5)


class Leg(NamedTuple):
    """A descent of B points."""

    theta: np.ndarray  # (B, n) where they start
    ties: np.ndarray  # (k, n) their directions
    iterations: int
    pace: Pace
    scales: np.ndarray  # (B,) of their steps


Descent = Generator[Request, Evaluation, tuple[np.ndarray, np.ndarray]]


class Gradient(Method):
    """Descents from several starts with the axes tied, a race of the two best with the axes free, the winner alone.

    Each is Adam with a cosine schedule, projected on the bounds, its starts in one batch.
    """

    gradients = True

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
        visited = yield from by_adam(task, Leg(theta, space.ties, first, TIED if others else SINGLE, scales), rng)
        if others:
            free, theta = np.eye(space.size), _best(*visited, len(SCALES))
            visited = yield from by_adam(task, Leg(theta, free, others[0], RACE, SCALES[: len(theta)]), rng)
            yield from by_adam(task, Leg(_best(*visited, 1), free, others[1], ALONE, np.ones(1)), rng)


def iterations(task: Task) -> tuple[int, ...]:
    """Return how many iterations the stages take; a number in the settings is that of the last one."""
    wished, space = task.search.iterations, task.problem.space
    if len(space.ties) == space.size:
        return (wished or ONE_STAGE,)
    return *STAGES[:2], wished or STAGES[2]


def by_adam(task: Task, leg: Leg, rng: np.random.Generator) -> Descent:
    """Move along the rows of `leg.ties`; return the points visited (iterations, B, n) and their merits (iterations, B).

    Good gains often lie close to a cliff, beyond which the loop is unstable. A step over it (the walk diverges, or its
    value is out of all proportion) is taken back. A start that has no point to go back to goes on from a random one.
    """
    space, (theta, ties, iterations, pace, scales) = task.problem.space, leg
    adam = Adam(theta, len(ties), (0.8, pace.memory), pace.patience, TINY, scales)
    cosine = 0.5 * (1 + np.cos(np.pi * np.arange(iterations) / iterations))
    visited, merits, value_there = [], [], np.full(len(theta), np.inf)  # at the best point of each start so far
    walked = known = False
    for iteration, rate in enumerate(pace.rate * (pace.last + (1 - pace.last) * cosine)):
        found = yield Request(theta, ties, pace.phase)
        visited.append(theta)
        merits.append(found.merit)
        gradient = found.gradient if iteration < pace.smooth * iterations else found.sharp
        over = found.value > value_there + FALL * np.maximum(1.0, np.abs(value_there))
        finite = np.isfinite(gradient).all(1)
        walked, known = walked or bool(found.alive.any()), known or bool((found.alive & finite).any())
        lost = over | ~(found.alive & finite)
        value_there = np.where(~lost & (found.merit < adam.least), found.value, value_there)
        slopes = np.where(lost[:, None], 0.0, np.asarray(gradient, float))
        slopes *= np.minimum(1.0, CLIP / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-12))
        theta, steps = adam.step(theta, found.merit, slopes, lost)
        theta = space.clip(theta - rate * steps @ ties * space.strides)
        homeless = lost & np.isinf(adam.least)
        if homeless.any():
            theta = choose(homeless, space.draw_tied(rng, len(theta)), theta)
            adam.forget(homeless)
    if walked and not known:
        raise ConfigError("", "method", "cmaes or grid, as no point that walks has a finite gradient", "gradient")
    return np.array(visited), np.array(merits)


def again(task: Task, theta: np.ndarray, iterations: int, number: int, of: int, rng: np.random.Generator) -> Descent:
    """Descend for the given time of several, from 0: first with the axes tied, each time with shorter steps."""
    space = task.problem.space
    ties = np.eye(space.size) if number and len(space.ties) < space.size else space.ties
    pace = TIED._replace(phase=f"descent {number + 1} of {of}")
    return by_adam(task, Leg(theta, ties, iterations, pace, np.full(len(theta), 0.5 * 0.6**number)), rng)


def _best(visited: np.ndarray, merits: np.ndarray, count: int) -> np.ndarray:
    """Return the best point of each of the best starts (count, n), the best first."""
    best, rows = np.argmin(merits, axis=0), np.arange(merits.shape[1])
    order = np.argsort(merits[best, rows], kind="stable")[:count]
    return np.asarray(visited[best, rows][order])


METHOD = Gradient()
