"""Points of a space, judged in batches: they walk, with slopes where asked for, and the objective judges them."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

import mjx_climb as mc
from mjx_climb.compilation import devices
from mjx_climb.compilation.cache import enable_cache
from mjx_climb.compilation.kept_programs import kept
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.rollouts.given import AnyGains
from mjx_climb.rollouts.identity import identity
from mjx_climb.rollouts.rollout import given_in, metrics_of
from mjx_climb.walk.step import structure
from tuning.problem.objectives import Goal, Judge
from tuning.problem.spaces import Space, to_gains64


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
        return np.asarray(np.isfinite(self.descent))

    @property
    def merit(self) -> np.ndarray:
        """One number per point for searches that only compare: value plus penalty, huge where the walk diverged."""
        total = self.value + self.penalty
        return np.asarray(np.where(np.isfinite(total), total, 1e6))


@dataclasses.dataclass(frozen=True)
class Problem:
    """What is searched: a space, an objective over the metrics, and the walks that give them.

    `numbers` replaces the scenario's. With a leading axis (members, 1) every point walks through an ensemble, and its
    score is the mean over the members.
    """

    scenario: mc.Scenario
    space: Space
    objective: Goal
    numbers: mc.Parameters | None = None
    members: int = 1
    dtype: type = np.float32
    engine: str = DEFAULT_ENGINE
    metrics: mc.MetricTable = mc.METRICS
    law: mc.Law | None = None  # the scenario's where None
    judge: Judge | None = None  # the objective as its user gave it, None for the weighted terms

    def env_steps(self, points: int, tangents: int = 0) -> int:
        """Return what judging so many points costs; a step with k tangents counts 1 + k."""
        return points * self.members * self.scenario.steps * (1 + tangents)

    def evaluate(
        self, theta: Float[np.ndarray, "B n"], directions: Float[np.ndarray, "k n"] | None = None
    ) -> Evaluation:
        """Walk with the gains of B points and judge them, with slopes along some directions."""
        with devices.on_host():
            return self._evaluate(np.asarray(theta, float), directions)

    def _evaluate(self, theta: np.ndarray, directions: np.ndarray | None) -> Evaluation:
        walk: dict[str, Any] = {
            "metrics": self.metrics, "dtype": self.dtype, "engine": self.engine, "smooth": True, "law": self.law,
        }  # fmt: skip
        if directions is None:
            metrics = mc.rollout_metrics(self.scenario, to_gains64(self.space, theta), self.numbers, **walk)
            with jax.enable_x64(np.dtype(self.dtype) == np.float64):
                judged = _judged(self.objective, metrics)[1]
            none: np.ndarray = np.zeros((len(theta), 0), self.dtype)
            return _in_numpy(Evaluation(gradient=none, sharp=none, **judged))
        metrics, slopes = mc.rollout_slopes(
            self.scenario, *_along(self.space, theta, np.asarray(directions, float)), self.numbers, **walk
        )
        with jax.enable_x64(np.dtype(self.dtype) == np.float64):
            (gradient, sharp), judged = _judged_slopes(self.objective, metrics, slopes)
        return _in_numpy(Evaluation(gradient=gradient.T, sharp=sharp.T, **judged))


def _in_numpy(found: Evaluation) -> Evaluation:
    arrays: Evaluation = jax.tree.map(np.asarray, found)
    return arrays


def _along(space: Space, theta: np.ndarray, directions: np.ndarray) -> tuple[AnyGains, AnyGains]:
    """Return the gains (B, 6) of points and their rates of change (k, B, 6) along directions (k, n)."""
    with jax.enable_x64(True):
        along = jnp.broadcast_to(directions[:, None, :], (len(directions), *theta.shape))
        rates = jax.vmap(lambda v: jax.jvp(space.to_gains, (theta,), (v,))[1])(along)
        return to_gains64(space, theta), jax.tree.map(np.asarray, rates)


@functools.partial(jax.jit, static_argnums=0)
def _judged(objective: Goal, metrics: Mapping[str, Array]) -> tuple[tuple[Array, Array], dict[str, Any]]:
    """Return descent and value plus penalty, (B,) each, to be differentiated; and what is reported beside them."""
    score = objective.score(metrics)

    # an objective may have judged the members together: its scores have lost their axis then
    def mean(value: Array | np.ndarray) -> Array:
        return jnp.asarray(value.mean(0) if value.ndim > 1 else value)

    dtype = score.value.dtype
    reported: dict[str, Any] = {
        "value": mean(score.value),
        "descent": mean(score.descent),
        "penalty": mean(score.penalty),
        "feasible": score.feasible.all(0) if score.feasible.ndim > 1 else score.feasible,
        "metrics": {name: mean(jnp.asarray(value, dtype)) for name, value in metrics.items()},
    }
    return (reported["descent"], reported["value"] + reported["penalty"]), reported


@functools.partial(jax.jit, static_argnums=0)
def _judged_slopes(
    objective: Goal, metrics: Mapping[str, Array], slopes: Mapping[str, Array]
) -> tuple[tuple[Array, Array], dict[str, Any]]:
    """Return the slopes (k, B) of `_judged`'s first two from those of the metrics, and what is reported."""
    others = {name: value for name, value in metrics.items() if name not in slopes}
    real = {name: metrics[name] for name in slopes}

    def push(slope: Mapping[str, Array]) -> tuple[Any, tuple[Array, Array], dict[str, Any]]:
        return jax.jvp(lambda m: _judged(objective, {**m, **others}), (real,), (slope,), has_aux=True)

    _, sloped, reported = jax.vmap(push, out_axes=(None, 0, None))(slopes)
    return sloped, reported


def under_pd(scenario: mc.Scenario) -> mc.Scenario:
    """Return the scenario with pd in place of its law."""
    return scenario.with_overrides({"control.controller": "pd", "control.reading": "virtual_model", "own": None})


@functools.lru_cache(maxsize=8)
def baseline(
    scenario: mc.Scenario, engine: str = DEFAULT_ENGINE, metrics: mc.MetricTable = mc.METRICS
) -> dict[str, float]:
    """Return the metrics of pd in float64 with nothing torn off, and their smooth companions."""
    enable_cache()
    pd = under_pd(scenario)
    in_pieces = mc.pieces_pay(engine, "cpu")
    with devices.on_host(), jax.enable_x64(True):
        walker = given_in(pd, None, None, None, np.float64)
        shape = structure(pd, engine, walker.numbers, metrics=metrics, smooth=True, in_pieces=in_pieces)
        options = mc.compiler_options(1, in_pieces=in_pieces, backend="cpu")
        found = kept(metrics_of, identity, options)(shape, walker.law, walker.numbers)
        return {name: float(value) for name, value in found.items()}
