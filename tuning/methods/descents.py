"""Descents along gradients, by Adam and by L-BFGS, in the same stages.

All axes are tied first, which is cheap; then a short race with the axes free; then its winner alone. A step with k
tangents costs 1 + k, so a first descent along two directions (damping and stiffness of all axes at once) brings the
starts close for a quarter of the price of twelve. Along twelve, one start that walks far does better than two that walk
half as far, but which of them is known only after some steps. An isotropic space has the first stage only.
"""

import functools
from collections.abc import Callable, Generator
from typing import Any, NamedTuple

import jax
import numpy as np
import optax

from tuning.methods.rounds import Points, Request, Task
from tuning.problem.evaluation import Evaluation
from tuning.problem.spaces import Space

STARTS = 3
CANDIDATES = 12  # random points walked per start that they give
SCALES = np.array([1.0, 0.5])  # of the steps of the starts that race, the best first: a bold one crosses to better
# valleys, a careful one gets further down its own
ONE_STAGE = 20  # iterations
STAGES = 12, 10, 64  # iterations: axes tied, the race, the winner alone


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
    return *STAGES[:2], wished or STAGES[2]


def rounds(task: Task) -> int:
    """Return how many rounds a run takes: the random points, then the iterations."""
    return sum(iterations(task)) + ((task.search.starts or STARTS) > 1)


def run(task: Task, single: Descend, tied: Descend, race: Descend, alone: Descend) -> Points:
    """Descend from several starts with the axes tied, let the two best race with the axes free, go on with the winner.

    The scenario's own gains are the first start, the others the best of further known gains and random points. A space
    whose axes are tied anyway has a single descent.
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
        yield from single(task, Leg(theta, space.ties, first, "descent", scales), rng)
        return
    visited = yield from tied(task, Leg(theta, space.ties, first, "axes tied", scales), rng)
    free, theta = np.eye(space.size), _best(*visited, len(SCALES))
    visited = yield from race(task, Leg(theta, free, others[0], "axes free", SCALES[: len(theta)]), rng)
    yield from alone(task, Leg(_best(*visited, 1), free, others[1], "winner alone", np.ones(1)), rng)


def _best(visited: np.ndarray, merits: np.ndarray, count: int) -> np.ndarray:
    """Return the best point of each of the best starts (count, n), the best first."""
    best, rows = np.argmin(merits, axis=0), np.arange(merits.shape[1])
    order = np.argsort(merits[best, rows], kind="stable")[:count]
    return np.asarray(visited[best, rows][order])


CLIP = 5.0  # norm of a gradient; the objective is 1 for pd
FALL = 10.0  # by how many times its value (1 for pd) a point is worse than the best where the loop has gone unstable
BACK = 0.5  # share of its steps that a start keeps which goes back to its best point


def again(task: Task, theta: np.ndarray, iterations: int, number: int, of: int, rng: np.random.Generator) -> Descent:
    """Descend for the given time of several, from 0: first with the axes tied, each time with shorter steps."""
    space = task.problem.space
    ties = np.eye(space.size) if number and len(space.ties) < space.size else space.ties
    scales = np.full(len(theta), 0.5 * 0.6**number)
    return by_adam(task, Leg(theta, ties, iterations, f"descent {number + 1} of {of}", scales), rng)


class Pace(NamedTuple):
    """How a descent by Adam moves."""

    rate: float  # of the first step, in the logarithm of a gain
    last: float  # share of it at the end
    smooth: float  # share of the iterations that follow the smooth extremes; the rest follow the true ones
    memory: float  # of the squared gradient, a share per step
    patience: float  # steps without a better point after which a start goes back to its best one


SINGLE = Pace(rate=0.7, last=0.03, smooth=0.5, memory=0.9, patience=5)
TIED = Pace(rate=0.7, last=0.03, smooth=0.5, memory=0.95, patience=np.inf)
RACE = Pace(rate=0.7, last=0.5, smooth=1.0, memory=0.9, patience=5)
ALONE = Pace(rate=0.35, last=0.03, smooth=0.3, memory=0.9, patience=5)


def gradient(task: Task) -> Points:
    """Adam with a cosine schedule, projected on the bounds, many starts in one batch."""
    return run(task, *(functools.partial(by_adam, pace=pace) for pace in (SINGLE, TIED, RACE, ALONE)))


def by_adam(task: Task, leg: Leg, rng: np.random.Generator, pace: Pace = TIED) -> Descent:
    """Move along the rows of `leg.ties`; return the points visited (iterations, B, n) and their merits (iterations, B).

    Good gains often lie close to a cliff, beyond which the loop is unstable. A step over it (the walk diverges, or its
    value is out of all proportion) is taken back: the start steps again from its best point, half as far, with a fresh
    memory. So does one that has found nothing better for a while: Adam steps as far along an axis that hardly matters
    as along one that does, and may leave a good valley for a worse one. A start that has no such point goes on from a
    random one. The others do not notice.
    """
    space, (theta, ties, iterations, phase, scales) = task.problem.space, leg
    schedule = optax.cosine_decay_schedule(pace.rate, iterations, alpha=pace.last)
    direction = optax.scale_by_adam(b1=0.8, b2=pace.memory)
    update = jax.jit(jax.vmap(direction.update))
    with jax.enable_x64(False):  # independent of the caller's setting: a search repeats itself bit by bit
        blank = jax.vmap(direction.init)(np.zeros((len(theta), len(ties)), np.float32))
        rate = [float(schedule(iteration)) for iteration in range(iterations)]
    state, visited, merits = blank, [], []
    best, gradient_there = theta, np.zeros((len(theta), len(ties)))  # of each start so far
    least, value_there = np.full(len(theta), np.inf), np.full(len(theta), np.inf)
    waited = np.zeros(len(theta), int)
    for iteration in range(iterations):
        found = yield Request(theta, ties, phase)
        visited.append(theta)
        merits.append(found.merit)
        gradient = found.gradient if iteration < pace.smooth * iterations else found.sharp
        over = found.value > value_there + FALL * np.maximum(1.0, np.abs(value_there))
        lost = over | ~(found.alive & np.isfinite(gradient).all(1))
        better = ~lost & (found.merit < least)
        here, there = (theta, gradient, found.merit, found.value), (best, gradient_there, least, value_there)
        best, gradient_there, least, value_there = choose(better, here, there)
        waited = np.where(better, 0, waited + 1)
        back = lost | (waited >= pace.patience)
        waited = np.where(back, 0, waited)
        theta, clipped = choose(back, (best, gradient_there), (theta, gradient))
        scales = np.where(back & np.isfinite(least), BACK * scales, scales)
        state = choose(back, blank, state)
        clipped = clipped * np.minimum(1.0, CLIP / np.maximum(np.linalg.norm(clipped, axis=1, keepdims=True), 1e-12))
        with jax.enable_x64(False):
            steps, state = update(clipped.astype(np.float32), state)
        rates = rate[iteration] * scales[:, None]
        theta = space.clip(theta - rates * np.asarray(steps, float) @ ties * space.strides)
        homeless = lost & np.isinf(least)
        if homeless.any():
            theta, state = choose(homeless, (space.draw_tied(rng, len(theta)), blank), (theta, state))
    return np.array(visited), np.array(merits)


def choose(rows: np.ndarray, yes: Any, no: Any) -> Any:
    """Return the rows of one pytree where `rows` (B,) is true and those of another elsewhere."""
    return jax.tree.map(lambda y, n: np.where(rows.reshape(-1, *[1] * (np.ndim(y) - 1)), y, n), yes, no)


MEMORY = 8
FIRST_STEP = 1.0  # length of the first step, in the logarithm of the gains
LONGEST_STEP = 2.0
DECREASE = 1e-4  # Armijo's share of the decrease that the gradient promises
SHRINK = 0.4
GIVE_UP = 1e-2  # relative length of a trial step below which a start forgets and follows the gradient


def lbfgs(task: Task) -> Points:
    """L-BFGS, projected on the bounds, with a backtracking line search of its own for every start of a batch."""
    return run(task, *[by_lbfgs] * 4)


def by_lbfgs(task: Task, leg: Leg, rng: np.random.Generator) -> Descent:
    """Move along the rows of `leg.ties`; return the points visited (iterations, B, n) and their merits (iterations, B).

    Each round evaluates one trial point per start. A trial that diverges is a step too long; a start that is dead from
    the beginning goes on from a random point.
    """
    space, (theta, ties, iterations, phase, scales) = task.problem.space, leg
    count, k = len(theta), len(ties)
    memory = optax.scale_by_lbfgs(memory_size=MEMORY)
    with jax.enable_x64(False):  # independent of the caller's setting: a search repeats itself bit by bit
        blank = jax.vmap(memory.init)(np.zeros((count, k), np.float32))
    update = jax.jit(jax.vmap(memory.update))
    state, fresh, visited, merits = blank, np.ones(count, bool), [], []
    trial, place, value = theta.copy(), np.zeros((count, k)), np.full(count, np.inf)  # place: moved along the ties
    aim, gradient, step, length = place.copy(), np.zeros((count, k)), np.zeros((count, k)), np.ones(count)
    for _ in range(iterations):
        found = yield Request(trial, ties, phase)
        visited.append(trial)
        merits.append(found.merit)
        good = found.alive & np.isfinite(found.gradient).all(1)
        promised = np.minimum((gradient * (aim - place)).sum(1), 0.0)
        accepted = good & (np.isinf(value) | (found.descent <= value + DECREASE * promised))
        there = theta, place, value, gradient
        theta, place, value, gradient = choose(accepted, (trial, aim, found.descent, found.gradient), there)
        outwards = _outwards(space, theta, gradient, ties)
        free = np.where(outwards, 0.0, gradient).astype(np.float32)
        with jax.enable_x64(False):
            directions, stepped = update(free, state, place.astype(np.float32))
        state = choose(accepted, stepped, state)
        directions = np.where(outwards, 0.0, np.asarray(directions, float))
        directions = np.where(((directions * free).sum(1) > 0)[:, None], -directions, -free)
        norm = np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        shorter = np.minimum(1.0, LONGEST_STEP / norm)
        directions *= np.where(fresh[:, None], scales[:, None] * FIRST_STEP / norm, shorter)
        fresh &= ~accepted
        length = np.where(accepted, 1.0, length * SHRINK)
        step = np.where(accepted[:, None], directions, step)
        stuck = length < GIVE_UP
        if stuck.any():
            along = -free / np.maximum(np.linalg.norm(free, axis=1, keepdims=True), 1e-12)
            state, step = choose(stuck, (blank, along), (state, step))
            length = np.where(stuck, 0.1, length)
        trial = space.clip(theta + length[:, None] * step @ ties)
        # the step as the bounds cut it: promises and curvature are of the points that were walked
        aim = place + (trial - theta) @ ties.T / ties.sum(1)
        unborn = np.isinf(value)
        if unborn.any():
            trial = choose(unborn, space.draw_tied(rng, count), trial)
            theta, aim = choose(unborn, (trial, place), (theta, aim))
            length = np.where(unborn, 1.0, length)
    return np.array(visited), np.array(merits)


def _outwards(space: Space, theta: np.ndarray, gradient: np.ndarray, ties: np.ndarray) -> np.ndarray:
    """Return (B, k) which directions have all their coordinates on a bound and would pass it: no step goes there."""
    ends = theta <= space.lower, theta >= space.upper
    lowest, highest = ((at.astype(float) @ ties.T) >= ties.sum(1) for at in ends)
    return np.asarray((lowest & (gradient > 0)) | (highest & (gradient < 0)))
