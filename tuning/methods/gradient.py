"""Descent by Adam."""

from typing import NamedTuple

import jax
import numpy as np
import optax

from tuning.methods import descents
from tuning.methods.descents import Descent, Descents, Leg, choose
from tuning.methods.method import Request, Task

CLIP = 5.0  # norm of a gradient; the objective is 1 for pd
FALL = 10.0  # by how many times its value (1 for pd) a point is worse than the best where the loop has gone unstable
BACK = 0.5  # share of its steps that a start keeps which goes back to its best point


class Pace(NamedTuple):
    """How a descent by Adam moves."""

    rate: float  # of the first step, in the logarithm of a gain
    last: float  # share of it at the end
    smooth: float  # share of the iterations that follow the smooth extremes; the rest follow the true ones
    memory: float  # of the squared gradient, a share per step
    patience: float  # steps without a better point after which a start goes back to its best one


PACES = {
    descents.SINGLE: Pace(rate=0.7, last=0.03, smooth=0.5, memory=0.9, patience=5),
    descents.TIED: Pace(rate=0.7, last=0.03, smooth=0.5, memory=0.95, patience=np.inf),
    descents.RACE: Pace(rate=0.7, last=0.5, smooth=1.0, memory=0.9, patience=5),
    descents.ALONE: Pace(rate=0.35, last=0.03, smooth=0.3, memory=0.9, patience=5),
}


class Gradient(Descents):
    """Adam with a cosine schedule, projected on the bounds, many starts in one batch."""

    def descend(self, task: Task, leg: Leg, rng: np.random.Generator) -> Descent:
        return by_adam(task, leg, rng, PACES[leg.phase])


def by_adam(task: Task, leg: Leg, rng: np.random.Generator, pace: Pace = PACES[descents.TIED]) -> Descent:
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


def again(task: Task, theta: np.ndarray, iterations: int, number: int, of: int, rng: np.random.Generator) -> Descent:
    """Descend for the given time of several, from 0: first with the axes tied, each time with shorter steps."""
    space = task.problem.space
    ties = np.eye(space.size) if number and len(space.ties) < space.size else space.ties
    scales = np.full(len(theta), 0.5 * 0.6**number)
    return by_adam(task, Leg(theta, ties, iterations, f"descent {number + 1} of {of}", scales), rng)


METHOD = Gradient()
