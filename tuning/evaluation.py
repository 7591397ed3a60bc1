"""Points of a space, judged in batches: one compiled program for values, one for values and gradients."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

import mjx_climb as mc
from mjx_climb.compilation import enable_cache
from mjx_climb.dynamics import DEFAULT_ENGINE
from tuning.objectives import Objective
from tuning.spaces import Space


class Evaluation(NamedTuple):
    """What is known about B points; arrays of numpy."""

    value: np.ndarray  # (B,)
    descent: np.ndarray  # (B,)
    penalty: np.ndarray  # (B,)
    feasible: np.ndarray  # (B,) bool
    gradient: np.ndarray  # (B, k) slopes of `descent` along the k directions asked for
    sharp: np.ndarray  # (B, k) slopes of value plus penalty with true extremes, which exist almost everywhere
    metrics: Mapping[str, np.ndarray]  # (B,) each

    @property
    def alive(self) -> np.ndarray:
        """Which points walked to the end (B,)."""
        return np.isfinite(self.descent)

    @property
    def merit(self) -> np.ndarray:
        """One number per point for searches that only compare: value plus penalty, huge where the walk diverged."""
        total = self.value + self.penalty
        return np.where(np.isfinite(total), total, 1e6)


@dataclasses.dataclass(frozen=True)
class Problem:
    """What is searched: a space, an objective over the metrics, and the walks that give them.

    `numbers` replaces the scenario's. With a leading axis (members, 1) every point walks through an ensemble, and its
    score is the mean over the members.
    """

    scenario: mc.Scenario
    space: Space
    objective: Objective
    numbers: mc.Parameters | None = None
    members: int = 1
    dtype: type = np.float32
    engine: str = DEFAULT_ENGINE

    def env_steps(self, points: int, tangents: int = 0) -> int:
        """Return what judging so many points costs; a step with k tangents counts 1 + k."""
        return points * self.members * self.scenario.steps * (1 + tangents)

    def evaluate(
        self, theta: Float[np.ndarray, "B n"], directions: Float[np.ndarray, "k n"] | None = None
    ) -> Evaluation:
        """Walk with the gains of B points and judge them, with slopes along some directions."""
        enable_cache()
        double = np.dtype(self.dtype) == np.float64
        with jax.enable_x64(double):
            numbers = mc.parameters(self.scenario, self.dtype) if self.numbers is None else self.numbers
            numbers = jax.tree.map(lambda value: np.asarray(value, self.dtype), numbers)
            given = np.zeros((0, self.space.size)) if directions is None else directions
            run = _compiled(self.scenario, self.space, self.objective, self.engine, len(theta), len(given))
            result = run(np.asarray(theta, self.dtype), np.asarray(given, self.dtype), numbers)
            return jax.tree.map(np.asarray, Evaluation(*result))


class _ById:
    """Makes a program's ingredients hashable by what they are."""

    def __init__(self, *parts):
        self.parts = parts
        self.key = tuple(_key(part) for part in parts)

    def __hash__(self):
        return hash(self.key)

    def __eq__(self, other):
        return self.key == other.key


def _key(part):
    if isinstance(part, Space):
        arrays = tuple((name, index.tobytes()) for name, index in part.index.items())
        return part.names, part.fixed.tobytes(), arrays
    return part


def _compiled(scenario, space, objective, engine, batch, tangents):
    return _program(_ById(scenario, space, objective), engine, batch, tangents > 0)


@functools.lru_cache(maxsize=32)
def _program(ingredients: _ById, engine: str, batch: int, gradient: bool):
    scenario, space, objective = ingredients.parts
    simulate = mc.simulator(scenario, engine=engine, smooth=True, in_pieces=mc.pieces_pay(engine))

    def judged(theta: Array, numbers: mc.Parameters):
        metrics = simulate(space.to_gains(theta), numbers)
        score = objective.score(metrics)
        # an objective may have judged the members together: its scores have lost their axis then
        mean = lambda value: value.mean(0) if value.ndim > 1 else value  # noqa: E731
        averages = {name: mean(jnp.asarray(value, theta.dtype)) for name, value in metrics.items()}
        feasible = score.feasible.all(0) if score.feasible.ndim > 1 else score.feasible
        descent, value, penalty = mean(score.descent), mean(score.value), mean(score.penalty)
        return (descent, value + penalty), (value, penalty, feasible, averages)

    def values(theta, directions, numbers):
        (descent, _), (value, penalty, feasible, metrics) = judged(theta, numbers)
        none = jnp.zeros((theta.shape[0], 0), theta.dtype)
        return value, descent, penalty, feasible, none, none, metrics

    def gradients(theta, directions, numbers):
        along = jnp.broadcast_to(directions[:, None, :], (len(directions), *theta.shape))
        push = lambda v: jax.jvp(lambda t: judged(t, numbers), (theta,), (v,), has_aux=True)  # noqa: E731
        (descent, _), (smooth, sharp), (value, penalty, feasible, metrics) = jax.vmap(push, out_axes=(None, 0, None))(
            along
        )
        return value, descent, penalty, feasible, smooth.T, sharp.T, metrics

    return jax.jit(
        gradients if gradient else values, compiler_options=mc.compiler_options(batch, in_pieces=mc.pieces_pay(engine))
    )


@functools.lru_cache(maxsize=8)
def baseline(scenario: mc.Scenario, engine: str = DEFAULT_ENGINE) -> dict[str, float]:
    """Return the metrics of pd in float64 with nothing torn off, and their smooth companions."""
    enable_cache()
    pd = scenario.with_overrides({"control.controller": "pd", "control.reading": "virtual_model"})
    with jax.enable_x64(True):
        simulate = mc.simulator(pd, engine=engine, smooth=True, in_pieces=mc.pieces_pay(engine))
        numbers = jax.tree.map(np.asarray, mc.parameters(pd))
        gains = mc.Gains(np.ones(6), np.ones(6), np.ones(6))
        metrics = jax.jit(simulate, compiler_options=mc.compiler_options(1, in_pieces=mc.pieces_pay(engine)))(
            gains, numbers
        )
        return {name: float(value) for name, value in metrics.items()}
