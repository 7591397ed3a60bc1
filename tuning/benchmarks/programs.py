"""What the benchmark runs of this program: closed loops, metrics included, and their forward gradients."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

import mjx_climb as mc
from mjx_climb.rollouts.rollout import Metrics

TIME_STEP = 0.001  # s


def scenario(steps: int) -> mc.Scenario:
    """Return so many steps of the paper's case 1.2 (lunar gravity, base admittance), its cargo on from the start."""
    cargo = {"disturbance.cargo": {"mass": 1.0, "start": 0.0}}
    return mc.Scenario(gravity=(0.0, 0.0, -1.635)).with_overrides(
        {"duration": steps * TIME_STEP, "time_step": TIME_STEP, **cargo}
    )


def gains(batch: int) -> dict[str, np.ndarray]:
    """Return the gains (batch, 6) of a sweep over stiffness."""
    stiffness = np.geomspace(1e3, 1e5, batch)[:, None] * np.ones(6)
    return {"inertia": np.ones((batch, 6)), "damping": np.full((batch, 6), 1e3), "stiffness": stiffness}


def walk(batch: int, steps: int, engine: str, dtype: DTypeLike = np.float32) -> Callable[[], object]:
    """Return a function that walks a batch by `mjx_climb.rollout_metrics`, as a sweep does."""
    case, values = scenario(steps), mc.Gains(**gains(batch))
    return lambda: mc.rollout_metrics(case, values, dtype=dtype, engine=engine)


def value(batch: int, steps: int, engine: str) -> tuple[jax.stages.Wrapped, jax.Array]:
    """Return metrics as a function of shifts (12, batch) of log damping and log stiffness, and shifts of zero."""
    return _jit(_shifted(batch, steps, engine), batch, engine), jnp.zeros((12, batch), jnp.float32)


def gradient(tangents: int, batch: int, steps: int, engine: str) -> tuple[jax.stages.Wrapped, jax.Array]:
    """Return the same with `tangents` forward derivatives of every metric: 2 (both gains, all axes alike) or 12."""
    function = _shifted(batch, steps, engine)
    directions = np.kron(np.eye(2), np.ones((1, 6))) if tangents == 2 else np.eye(12)

    def pushed(shift: jax.Array) -> tuple[Metrics, Metrics]:
        def push(direction: jax.Array) -> tuple[Metrics, Metrics]:
            return jax.jvp(function, (shift,), (direction[:, None] + jnp.zeros_like(shift),))

        return jax.vmap(push, out_axes=(None, 0))(jnp.asarray(directions, shift.dtype))

    return _jit(pushed, batch, engine), jnp.zeros((12, batch), jnp.float32)


def _shifted(batch: int, steps: int, engine: str) -> Callable[[jax.Array], Metrics]:
    metrics = mc.simulator(scenario(steps), engine=engine, in_pieces=mc.pieces_pay(engine))
    given = {name: np.asarray(values, np.float32) for name, values in gains(batch).items()}

    def shifted(shift: jax.Array) -> Metrics:
        factor = jnp.exp(shift).T
        damping, stiffness = given["damping"] * factor[:, :6], given["stiffness"] * factor[:, 6:]
        return metrics(mc.Gains(given["inertia"], damping, stiffness))

    return shifted


def _jit(function: Callable[..., Any], batch: int, engine: str) -> jax.stages.Wrapped:
    return jax.jit(function, compiler_options=mc.compiler_options(batch, in_pieces=mc.pieces_pay(engine)))
