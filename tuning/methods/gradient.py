"""Adam with a cosine schedule, projected on the bounds, many starts in one batch."""

import jax
import numpy as np
import optax

from tuning.methods import starts
from tuning.methods.task import Points, Request, Task

STARTS = {"isotropic": 3, "split": 3, "diagonal": 3}
ITERATIONS = {"isotropic": 20, "split": 25, "diagonal": 40}
RATE = 0.7  # of the first step, in the logarithm of a gain
LAST = 0.03  # share of it at the end
CLIP = 5.0  # norm of a gradient; the objective is 1 for pd


def rounds(task: Task) -> int:
    """Return how many rounds a run takes: the random points, then the iterations."""
    return _iterations(task) + (_starts(task) > 1)


def _starts(task: Task) -> int:
    return task.search.starts or STARTS[task.search.space]


def _iterations(task: Task) -> int:
    return task.search.iterations or ITERATIONS[task.search.space]


def run(task: Task) -> Points:
    """Descend from every start.

    A start whose walk diverges, or whose gradient is not finite, is dead: it goes on from a random point, with a
    fresh memory. The others do not notice.
    """
    space, iterations = task.problem.space, _iterations(task)
    rng = np.random.default_rng(task.search.seed)
    theta = yield from starts.choose(task, _starts(task), rng)
    schedule = optax.cosine_decay_schedule(RATE, iterations, alpha=LAST)
    direction = optax.scale_by_adam(b1=0.8, b2=0.95)
    blank = jax.vmap(direction.init)(np.zeros_like(theta, np.float32))
    update = jax.jit(jax.vmap(direction.update))
    state = blank
    for iteration in range(iterations):
        found = yield Request(theta, True, "descent")
        dead = ~(found.alive & np.isfinite(found.gradient).all(1))
        slope = np.where(dead[:, None], 0.0, found.gradient).astype(np.float32)
        slope = slope * np.minimum(1.0, CLIP / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12))
        steps, state = update(slope, state)
        theta = space.clip(theta - float(schedule(iteration)) * np.asarray(steps, float))
        if dead.any():
            theta = np.where(dead[:, None], space.draw(rng, len(theta)), theta)
            state = choose(dead, blank, state)


def choose(rows: np.ndarray, yes, no):
    """Return the rows of one pytree where `rows` (B,) is true and those of another elsewhere."""
    return jax.tree.map(lambda y, n: np.where(rows.reshape(-1, *[1] * (np.ndim(y) - 1)), y, n), yes, no)
