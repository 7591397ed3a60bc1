"""Descent by L-BFGS."""

import jax
import numpy as np
import optax

from tuning.methods.descents import Descent, Descents, Leg, choose
from tuning.methods.method import Request, Task
from tuning.problem.spaces import Space

MEMORY = 8
FIRST_STEP = 1.0  # length of the first step, in the logarithm of the gains
LONGEST_STEP = 2.0
DECREASE = 1e-4  # Armijo's share of the decrease that the gradient promises
SHRINK = 0.4
GIVE_UP = 1e-2  # relative length of a trial step below which a start forgets and follows the gradient


class LBFGS(Descents):
    """L-BFGS, projected on the bounds, with a backtracking line search of its own for every start of a batch."""

    def descend(self, task: Task, leg: Leg, rng: np.random.Generator) -> Descent:
        return by_lbfgs(task, leg, rng)


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


METHOD = LBFGS()
