"""L-BFGS, projected on the bounds, with a backtracking line search of its own for every start of a batch."""

import jax
import numpy as np
import optax

from tuning.methods import gradient, starts
from tuning.methods.task import Points, Request, Task

MEMORY = 8
FIRST_STEP = 1.0  # length of the first step, in the logarithm of the gains
LONGEST_STEP = 2.0
DECREASE = 1e-4  # Armijo's share of the decrease that the slope promises
SHRINK = 0.4
GIVE_UP = 1e-3  # relative length of a trial step below which a start restarts along the gradient

rounds = gradient.rounds


def run(task: Task) -> Points:
    """Descend from every start; each round judges one trial point per start, with its gradient.

    A trial that diverges is a step too long. A start that is dead from the beginning goes on from a random point.
    """
    space = task.problem.space
    rng = np.random.default_rng(task.search.seed)
    trial = yield from starts.choose(task, gradient._starts(task), rng)
    count, n = trial.shape
    memory = optax.scale_by_lbfgs(memory_size=MEMORY)
    blank = jax.vmap(memory.init)(np.zeros((count, n), np.float32))
    update = jax.jit(jax.vmap(memory.update))
    state = blank
    theta, value = trial.copy(), np.full(count, np.inf)
    slope, step, length = np.zeros((count, n)), np.zeros((count, n)), np.ones(count)
    for _ in range(gradient._iterations(task)):
        found = yield Request(trial, True, "descent")
        good = found.alive & np.isfinite(found.gradient).all(1)
        promised = np.einsum("ij,ij->i", slope, trial - theta)
        bettered = np.isinf(value) | (found.descent <= value + DECREASE * np.minimum(promised, 0.0))
        accepted = good & bettered
        theta = np.where(accepted[:, None], trial, theta)
        value = np.where(accepted, found.descent, value)
        slope = np.where(accepted[:, None], found.gradient, slope)

        # a gain that lies on a bound and would pass it takes no part in the step
        outwards = ((theta <= space.lower) & (slope > 0)) | ((theta >= space.upper) & (slope < 0))
        free = np.where(outwards, 0.0, slope).astype(np.float32)
        directions, stepped = update(free, state, theta.astype(np.float32))
        state = gradient.choose(accepted, stepped, state)
        directions = np.where(outwards, 0.0, -np.asarray(directions, float))
        uphill = np.einsum("ij,ij->i", directions, free) >= 0
        directions = np.where(uphill[:, None], -free, directions)
        norm = np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        first = (np.asarray(jax.tree.leaves(state)[0]).reshape(count, -1)[:, 0] <= 1)[:, None]
        directions *= np.where(first, FIRST_STEP / norm, np.minimum(1.0, LONGEST_STEP / norm))

        length = np.where(accepted, 1.0, length * SHRINK)
        step = np.where(accepted[:, None], directions, step)
        stuck = length < GIVE_UP
        if stuck.any():
            state = gradient.choose(stuck, blank, state)
            along = -free / np.maximum(np.linalg.norm(free, axis=1, keepdims=True), 1e-12)
            step, length = np.where(stuck[:, None], along, step), np.where(stuck, 0.1, length)
        trial = space.clip(theta + length[:, None] * step)
        unborn = np.isinf(value)
        if unborn.any():
            trial = np.where(unborn[:, None], space.draw(rng, count), trial)
            theta, length = np.where(unborn[:, None], trial, theta), np.where(unborn, 1.0, length)
