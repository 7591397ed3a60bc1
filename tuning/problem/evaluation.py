"""The problem that is searched or evaluated; points of its space in batches, with tangents where asked for."""

import dataclasses
import functools
from collections.abc import Hashable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

import mjx_climb as mc
from mjx_climb.arrays import AnyArray, namespace
from mjx_climb.component import with_values
from mjx_climb.control import law_of
from mjx_climb.control.combined import either
from mjx_climb.execution import devices
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import AnyGains, by_name
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.walk.structure import structure
from tuning.gains.gains_file import replaced
from tuning.problem.ensemble import Ensemble
from tuning.problem.objectives import NO_OBJECTIVE, Goal, Objective, OwnObjective
from tuning.problem.spaces import NO_SPACE, Space, to_gains64

# Directions above which derivatives are taken in reverse mode: a tangent costs some 0.4 values on a CPU and 0.65 on an
# H200, reverse mode of two sums some ten; `doctor --bench` measures where they meet. All gains with axes stay below.
REVERSE_ABOVE = 24
RIGID = 1e12  # kg, kg m^2: a virtual mass that no wrench moves, with which base admittance is pd


class Evaluation(NamedTuple):
    """The evaluation of B points; arrays of numpy."""

    value: np.ndarray  # (B,)
    descent: np.ndarray  # (B,)
    penalty: np.ndarray  # (B,)
    feasible: np.ndarray  # (B,) bool
    gradient: np.ndarray  # (B, k) derivatives of `descent` along the k directions asked for
    sharp: np.ndarray  # (B, k) derivatives of value plus penalty with true extremes, which exist almost everywhere
    metrics: Mapping[str, np.ndarray]  # (B,) each

    @property
    def alive(self) -> np.ndarray:
        """Which points walked to the end (B,)."""
        return np.asarray(np.isfinite(self.descent))

    @property
    def merit(self) -> np.ndarray:
        """Value plus penalty (B,), for searches that only compare; huge where the walk diverged."""
        total = self.value + self.penalty
        return np.asarray(np.where(np.isfinite(total), total, 1e6))


@dataclasses.dataclass(frozen=True)
class Problem:
    """A scenario with its law, metrics and engine; for a search also a space of gains and an objective.

    `parameters` replaces the scenario's. With a leading axis (members, 1), those of `ensemble` for example, every point
    walks through all members, and its score is the mean over them where the objective does not say otherwise.
    """

    scenario: mc.Scenario
    space: Space = NO_SPACE
    objective: Goal = NO_OBJECTIVE
    parameters: mc.Parameters | None = None
    members: int = 1
    dtype: type = np.float32
    engine: str = DEFAULT_ENGINE
    metrics: mc.MetricTable = mc.METRICS
    law: mc.Law | None = None  # the scenario's where None
    own_objective: OwnObjective | None = None  # as its user gave it, None for the weighted terms
    own_method: Any = None  # a `tuning.methods.Method` of the user's, None for a shipped one
    ensemble: Ensemble | None = None  # from which the parameters were drawn

    @property
    def walks(self) -> dict[str, Any]:
        """The law, metrics and engine as arguments of `mc.rollout_metrics`."""
        return {"law": self.law, "metrics": self.metrics, "engine": self.engine}

    def with_gains(self, gains: AnyGains | None) -> "Problem":
        """The problem with some gains in place of the scenario's or the law's own."""
        if gains is None:
            return self
        scenario, law = replaced(self.scenario, self.law, gains)
        return dataclasses.replace(self, scenario=scenario, law=law)

    def env_steps(self, points: int, tangents: int = 0) -> int:
        """Return the cost of evaluating points: a step with k tangents counts 1 + k, `REVERSE_ABOVE` at most."""
        return points * self.members * self.scenario.steps * (1 + min(tangents, REVERSE_ABOVE))

    def evaluate(
        self, theta: Float[np.ndarray, "B n"], directions: Float[np.ndarray, "k n"] | None = None
    ) -> Evaluation:
        """Simulate with the gains of B points and score them, with derivatives along some directions.

        In forward mode, a tangent for each direction; in reverse mode, where there are more than `REVERSE_ABOVE`.
        """
        theta = np.asarray(theta, float)
        along = np.zeros((0, theta.shape[1])) if directions is None else np.asarray(directions, float)
        with devices.on_host():
            evaluated = self._forward if 0 < len(along) <= REVERSE_ABOVE else self._reverse
            derivatives, reported = evaluated(theta, along)
            gradient, sharp = (np.asarray(each).T for each in derivatives)
        found: Evaluation = jax.tree.map(np.asarray, Evaluation(gradient=gradient, sharp=sharp, **reported))
        return found

    @functools.cached_property
    def simulation(self) -> mc.Simulation:
        """The walks of points."""
        return mc.Simulation(self.scenario, **self.walks, parameters=self.parameters, smooth=True)

    @property
    def _how(self) -> dict[str, Any]:
        """How points walk; those that the time step is too long for too, which results leave out."""
        return {"dtype": self.dtype, "unsteady": True}

    def _forward(self, theta: np.ndarray, along: np.ndarray) -> tuple[Any, dict[str, Any]]:
        """Return derivatives (2, k, B) of descent and of value plus penalty, and the report."""
        tangents = self.space.to_tangents(theta, along)
        gains = to_gains64(self.space, theta)
        metrics, tangents = self.simulation.jvp(gains, tangents, **self._how)
        with jax.enable_x64(np.dtype(self.dtype) == np.float64):
            derivatives, reported = _scored_tangents(self.objective, metrics, tangents)
        return derivatives, reported

    def _reverse(self, theta: np.ndarray, along: np.ndarray) -> tuple[Any, dict[str, Any]]:
        """Return the result of `_forward`; along no direction, the walks alone."""
        gains = to_gains64(self.space, theta)
        metrics = self.simulation.metrics(gains, **self._how)
        with jax.enable_x64(np.dtype(self.dtype) == np.float64):
            if not len(along):
                return np.zeros((2, 0, len(theta)), self.dtype), report_of(self.objective, metrics)
            weights, report = _scored_weights(self.objective, metrics)
        found = self.simulation.vjp(gains, weights, **self._how)
        with jax.enable_x64(True):
            _, pull_back = jax.vjp(lambda theta: by_name(self.space.to_gains(theta)), theta)
            gradients = jax.vmap(lambda each: pull_back(each)[0])(jax.tree.map(lambda v: jnp.asarray(v, float), found))
        return (np.asarray(gradients) @ along.T).transpose(0, 2, 1).astype(self.dtype), report


def report_of(objective: Goal, metrics: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the fields of an `Evaluation` of points without derivatives, by their metrics (B,) or (members, B)."""
    # NumPy sorts members in a tenth of XLA's time, and one thread in less than several, which wait for Python
    by_numpy = isinstance(objective, Objective) and objective.function is None
    report: dict[str, Any] = (_scored if by_numpy else _compiled_scored)(objective, metrics)[1]
    return report


def _scored(objective: Goal, metrics: Mapping[str, Any]) -> tuple[tuple[AnyArray, AnyArray], dict[str, Any]]:
    """Return descent and value plus penalty, (B,) each, to be differentiated; and the report beside them."""
    score = objective.score(metrics)
    xp = namespace(score.value)

    # an objective may have joined the members: its scores have lost their axis then
    def mean(value: AnyArray) -> AnyArray:
        return xp.asarray(value.mean(0) if value.ndim > 1 else value)

    reported: dict[str, Any] = {name: mean(getattr(score, name)) for name in ("value", "descent", "penalty")}
    reported["feasible"] = score.feasible.all(0) if score.feasible.ndim > 1 else score.feasible
    reported["metrics"] = {name: mean(xp.asarray(value, score.value.dtype)) for name, value in metrics.items()}
    return (reported["descent"], reported["value"] + reported["penalty"]), reported


_compiled_scored = jax.jit(_scored, static_argnums=0)


@functools.partial(jax.jit, static_argnums=0)
def _scored_tangents(
    objective: Goal, metrics: Mapping[str, Array], tangents: Mapping[str, Array]
) -> tuple[tuple[Array, Array], dict[str, Any]]:
    """Return the tangents (k, B) of `_scored`'s first two from those of the metrics, and the report."""
    others = {name: value for name, value in metrics.items() if name not in tangents}
    real = {name: metrics[name] for name in tangents}

    def push(tangent: Mapping[str, Array]) -> tuple[Any, tuple[Array, Array], dict[str, Any]]:
        return jax.jvp(lambda m: _scored(objective, {**m, **others}), (real,), (tangent,), has_aux=True)

    _, pushed, reported = jax.vmap(push, out_axes=(None, 0, None))(tangents)
    return pushed, reported


@functools.partial(jax.jit, static_argnums=0)
def _scored_weights(objective: Goal, metrics: Mapping[str, Array]) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return the derivatives of `_scored`'s first two, summed over points, by each real metric (2, ...); the report."""
    real = {name: value for name, value in metrics.items() if jnp.issubdtype(value.dtype, jnp.floating)}
    scores, pull_back, reported = jax.vjp(lambda m: _scored(objective, {**metrics, **m}), real, has_aux=True)
    # points walk apart: the sum over them has the derivatives of each
    one, none = jnp.ones_like(scores[0]), jnp.zeros_like(scores[0])
    (weights,) = jax.vmap(pull_back)((jnp.stack([one, none]), jnp.stack([none, one])))
    return weights, reported


def under_pd(scenario: mc.Scenario) -> mc.Scenario:
    """Return the scenario with pd in place of its law."""
    changes = {"control.controller": "pd", "control.reading": "virtual_model"}
    return scenario.with_own(law=None, metrics=[], objective=None).with_overrides(changes)


def walk_of_any(
    scenario: mc.Scenario, law: mc.Law | None, engine: str = DEFAULT_ENGINE, *, beside: mc.Law | None = None
) -> mc.Trajectory:
    """Return a walk under pd, base admittance or the law `beside` them, by one compiled program for all of these.

    Pd is base admittance with a `RIGID` virtual mass: its walk is that of its own program to the displacement of that
    mass, some 1e-10 m. Walks whose force sensors may fall silent are the law's own: base admittance would notice.

    Arguments:
        scenario: under pd or base admittance.
        law: the law beside them with its gains; None: the scenario's.
        beside: its kind, where there is one in the program.
    """
    rigid = scenario.with_overrides({"control.controller": "base_admittance"})
    if structure(rigid, engine, own_parameters(rigid)).stages.silent_sensors:
        return mc.rollout(scenario, law=law, engine=engine)
    mass, control = law_of(rigid), scenario.control
    if control.controller == "pd":
        mass = with_values(mass, {"inertia": RIGID})
    if beside is not None:
        mass = either(mass, beside if law is None else law, take_second=law is not None)
    walk = mc.rollout(rigid, law=mass, engine=engine)
    if law is None:
        gains: Any = mc.Gains(*(np.full(6, getattr(control, name)) for name in mc.Gains.AXES))
        return dataclasses.replace(walk, scenario=scenario, gains=gains, law="")
    gains = {name: np.asarray(getattr(law, name), float) for name in law.GAINS}
    return dataclasses.replace(walk, scenario=scenario, gains=gains, law=type(law).__name__)


def baseline(
    scenario: mc.Scenario, engine: str = DEFAULT_ENGINE, metrics: mc.MetricTable = mc.METRICS
) -> dict[str, float]:
    """Return the metrics of pd in float64 with nothing torn off, and their smooth companions."""
    pd = under_pd(scenario)
    parameters = own_parameters(pd)
    # a file that the scenario names may have been edited since
    contents = tuple(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(parameters))
    return dict(_of_pd(pd, engine, metrics, structure(pd, engine, parameters), contents))


@functools.lru_cache(maxsize=8)
def _of_pd(pd: mc.Scenario, engine: str, metrics: mc.MetricTable, *contents: Hashable) -> dict[str, float]:
    """Return the metrics of a scenario under pd; `contents` are what its files hold."""
    found = mc.rollout_metrics(pd, metrics=metrics, engine=engine, dtype=np.float64, smooth=True)
    return {name: float(value) for name, value in found.items()}


def pd_of(scenario: mc.Scenario, parameters: mc.Parameters, **walks: Any) -> dict[str, np.ndarray]:
    """Return the metrics of pd in the walks of some parameters (leading batch axes), in float32 as a search sees them.

    `walks` are metrics and engine, as of `mjx_climb.rollout_metrics`.
    """
    ones = np.ones(6)
    gains = mc.Gains(ones, ones, ones)
    walks = {**walks, "dtype": np.float32, "smooth": True, "unsteady": True}
    return mc.rollout_metrics(under_pd(scenario), gains, parameters, **walks)
