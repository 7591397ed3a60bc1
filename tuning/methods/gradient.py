"""Adam with a cosine schedule, projected on the bounds, many starts in one batch."""

import jax
import numpy as np
import optax

from tuning.methods import staged
from tuning.methods.task import Points, Request, Task

RATE = 0.7  # of the first step, in the logarithm of a gain
LAST = 0.03  # share of it at the end
CLIP = 5.0  # norm of a gradient; the objective is 1 for pd
SMOOTH = 0.5  # share of the iterations that follow the smooth extremes; the rest follow the true ones

rounds = staged.rounds


def run(task: Task) -> Points:
    """Descend from every start, with the axes tied, then free."""
    return staged.run(task, descend)


def descend(task: Task, theta, ties, iterations: int, rng, phase: str, scales: np.ndarray):
    """Move along the rows of `ties`; return the points visited (iterations, B, n) and their merits (iterations, B).

    A start whose walk diverges, or whose gradient is not finite, is dead: it goes on from a random point, with a
    fresh memory. The others do not notice.
    """
    space = task.problem.space
    schedule = optax.cosine_decay_schedule(RATE, iterations, alpha=LAST)
    direction = optax.scale_by_adam(b1=0.8, b2=0.95)
    blank = jax.vmap(direction.init)(np.zeros((len(theta), len(ties)), np.float32))
    update = jax.jit(jax.vmap(direction.update))
    state, visited, merits = blank, [], []
    for iteration in range(iterations):
        found = yield Request(theta, ties, phase)
        visited.append(theta)
        merits.append(found.merit)
        gradient = found.gradient if iteration < SMOOTH * iterations else found.sharp
        dead = ~(found.alive & np.isfinite(gradient).all(1))
        slope = np.where(dead[:, None], 0.0, gradient).astype(np.float32)
        slope = slope * np.minimum(1.0, CLIP / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12))
        steps, state = update(slope, state)
        rates = float(schedule(iteration)) * scales[:, None]
        theta = space.clip(theta - rates * np.asarray(steps, float) @ ties)
        if dead.any():
            theta = np.where(dead[:, None], space.draw_tied(rng, len(theta)), theta)
            state = choose(dead, blank, state)
    return np.array(visited), np.array(merits)


def choose(rows: np.ndarray, yes, no):
    """Return the rows of one pytree where `rows` (B,) is true and those of another elsewhere."""
    return jax.tree.map(lambda y, n: np.where(rows.reshape(-1, *[1] * (np.ndim(y) - 1)), y, n), yes, no)
