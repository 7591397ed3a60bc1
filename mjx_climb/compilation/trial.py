"""A small motion by a fast path and by XLA's plain one, compared: what `mjx_climb.compilation.probe` runs elsewhere."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.compilation.cpu_pieces import in_kernels
from mjx_climb.compilation.gpu_kernel import over_robots, slopes_over_robots

SAME = "the same"
_ROBOTS, _STEPS = 5, 3
_EQUATIONS = 20  # in a piece: so few that there are several
_TOLERANCE = {np.float32: 1e-4, np.float64: 1e-12}  # relative to the largest value


def take(path: str) -> None:
    """Take a path, "pieces" or "kernel", and print `SAME`, or how far it was off."""
    jax.config.update("jax_enable_x64", True)
    of_path, precisions = _PATHS[path]
    states = [np.linspace(0.1, 0.9, 6 * _ROBOTS).reshape(_ROBOTS, 6).astype(dtype) for dtype in precisions]
    with ThreadPoolExecutor(len(states)) as threads:  # the first walk on a machine waits for this
        moved = list(threads.map(of_path, states))
    for dtype, (fast, plain) in zip(precisions, moved, strict=True):
        for mine, expected in zip(jax.tree.leaves(fast), jax.tree.leaves(plain), strict=True):
            off = float(np.abs(np.asarray(mine) - np.asarray(expected)).max() / np.abs(expected).max())
            if not off <= _TOLERANCE[dtype]:
                print(f"{off:.1g} off in {dtype.__name__}")
                return
    print(SAME)


def _pieces(state: np.ndarray) -> tuple[Any, Any]:
    """Return the motion of a batch and its forward derivative, in pieces and whole."""

    def moved(step: Callable[..., Any]) -> Any:
        motion = lambda first: jax.lax.scan(step, first, length=_STEPS)  # noqa: E731
        return jax.jit(lambda first: jax.jvp(motion, (first,), (jnp.ones_like(first),)))(state.T)

    return moved(in_kernels(_step, _EQUATIONS)), moved(_step)


def _kernel(state: np.ndarray) -> tuple[Any, Any]:
    """Return the motion of two limbs that pull at each other, and its slopes, by kernels and as XLA does it."""

    def moved(now: Array, _: None) -> tuple[Array, None]:
        after = _step(now, None)[0]
        return after - 0.01 * after.sum(1, keepdims=True), None

    def motion(first: Array) -> Any:
        return jax.lax.scan(moved, first, length=_STEPS)[0]

    limbs = np.stack([state, state[:, ::-1]], 2)[..., None]  # (robots, 6, 2, 1)
    directions = np.stack([np.cos(limbs), np.sin(limbs)], 1)

    def slopes(first: Array, along: Array) -> Any:
        return jax.vmap(lambda rate: jax.jvp(motion, (first,), (rate,))[1])(along)

    fast = jax.jit(over_robots(motion, [True], limbs=2))(limbs)
    sloped = jax.jit(slopes_over_robots(motion, [True], limbs=2))(directions, limbs)
    plain = jax.jit(jax.vmap(motion))(limbs)
    return (fast, *sloped), (plain, plain, jax.jit(jax.vmap(slopes))(limbs, directions))


_PATHS = {"pieces": (_pieces, (np.float32, np.float64)), "kernel": (_kernel, (np.float32,))}


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
