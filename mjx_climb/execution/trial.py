"""A small motion by a fast path and by XLA's plain one, compared: what `mjx_climb.execution.probe` runs elsewhere."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.execution.gpu_kernel import over_robots, tangents_over_robots

SAME = "the same"
_ROBOTS, _STEPS = 5, 3
_EQUATIONS = 20  # in a piece: so few that there are several
_TOLERANCE = {np.float32: 1e-4, np.float64: 1e-12}  # relative to the largest value


def take(path: str) -> None:
    """Take a path, "regions" or "kernel", and print `SAME`, or how far it was off.

    In each of its precisions it is compared with the plain one in the first of them.
    """
    jax.config.update("jax_enable_x64", True)
    fast, plain, precisions = _PATHS[path]
    states = [np.linspace(0.1, 0.9, 6 * _ROBOTS).reshape(_ROBOTS, 6).astype(dtype) for dtype in precisions]
    with ThreadPoolExecutor(1 + len(states)) as threads:  # the first walk on a machine waits for this
        exact = threads.submit(plain, states[0])
        moved = list(threads.map(fast, states))
    for dtype, found in zip(precisions, moved, strict=True):
        for mine, expected in zip(jax.tree.leaves(found), jax.tree.leaves(exact.result()), strict=True):
            off = float(np.abs(np.asarray(mine) - np.asarray(expected)).max() / np.abs(expected).max())
            if not off <= _TOLERANCE[dtype]:
                print(f"{off:.1g} off in {dtype.__name__}")
                return
    print(SAME)


def _pieces(state: np.ndarray) -> Any:
    """Return the motion of a batch and its forward derivative, in pieces."""
    return _moved(_step, state)


def _whole(state: np.ndarray) -> Any:
    """Return the same as XLA does it."""
    return _moved(_step, state)


def _moved(step: Callable[..., Any], state: np.ndarray) -> Any:
    motion = lambda first: jax.lax.scan(step, first, length=_STEPS)  # noqa: E731
    return jax.jit(lambda first: jax.jvp(motion, (first,), (jnp.ones_like(first),)))(state.T)


def _kernels(state: np.ndarray) -> Any:
    """Return the motion of two limbs that pull at each other, and its slopes, by kernels."""
    directions, limbs = _two_limbs(state)
    sloped = jax.jit(tangents_over_robots(_pulled, [True]))(directions, limbs)
    return jax.jit(over_robots(_pulled, [True]))(limbs), *sloped


def _mapped(state: np.ndarray) -> Any:
    """Return the same as XLA does it."""

    def slopes(first: Array, along: Array) -> Any:
        return jax.vmap(lambda rate: jax.jvp(_pulled, (first,), (rate,))[1])(along)

    directions, limbs = _two_limbs(state)
    motion = jax.jit(jax.vmap(_pulled))(limbs)
    return motion, motion, jax.jit(jax.vmap(slopes))(limbs, directions)


def _two_limbs(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two directions of two limbs' states, and the states: (robots, 2, 6, 2, 1) and (robots, 6, 2, 1)."""
    limbs = np.stack([state, state[:, ::-1]], 2)[..., None]
    return np.stack([np.cos(limbs), np.sin(limbs)], 1), limbs


def _pulled(first: Array) -> Any:
    def moved(now: Array, _: None) -> tuple[Array, None]:
        after = _step(now, None)[0]
        return after - 0.01 * after.sum(1, keepdims=True), None

    return jax.lax.scan(moved, first, length=_STEPS)[0]


_PATHS = {"regions": (_pieces, _whole, (np.float64, np.float32)), "kernel": (_kernels, _mapped, (np.float32,))}


def _step(state: Array, _: None) -> tuple[Array, Array]:
    """Return three angles and rates (6, ...) a moment later, and their sum: a sample of what a walk is made of."""
    angle, rate = state[:3], state[3:]
    held = jnp.where(angle > 0.5, 0.1 * rate, jnp.minimum(rate, 0.3))
    mass = 2 + jnp.cos(angle)
    load = jnp.concatenate([angle[1:], angle[:1]]) * jnp.sin(angle)
    lever = jnp.stack([mass[0] * load[1], mass[1] * load[2], mass[2] * load[0]])
    rate = held - 0.01 * (lever / jnp.sqrt(mass**2 + 0.1) + jnp.exp(-rate) * jnp.arctan2(angle, mass))
    after = jnp.concatenate([angle + 0.01 * rate, rate])
    return after, after.sum(0)
