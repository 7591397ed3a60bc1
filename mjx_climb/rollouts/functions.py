"""What a `Simulation` does, in one call: names that notebooks and scripts begin with."""

import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np
from numpy.typing import DTypeLike

from mjx_climb import execution
from mjx_climb.control import Law
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.rollouts.resolve import AnyGains, is_traced
from mjx_climb.rollouts.trajectory import Trajectory, named
from mjx_climb.rollouts.walks import Metrics, metrics_of_samples
from mjx_climb.scenario.model import Scenario
from mjx_climb.simulation import Simulation
from mjx_climb.walk.metrics import METRICS, Metric
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.structure import structure


def rollout(
    scenario: Scenario,
    gains: AnyGains | None = None,
    parameters: Parameters | None = None,
    *,
    law: Law | None = None,
    dtype: DTypeLike = np.float64,
    engine: str = DEFAULT_ENGINE,
) -> Trajectory:
    """Return `Simulation.rollout`: one robot, full time histories."""
    return Simulation(scenario, law, engine=engine).rollout(gains, parameters, dtype=dtype)


def rollout_metrics(
    scenario: Scenario,
    gains: AnyGains | None = None,
    parameters: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    engine: str = DEFAULT_ENGINE,
    smooth: bool = False,
    **how: Any,
) -> dict[str, np.ndarray]:
    """Return `Simulation.metrics`, which says what `how` may be: a batch of robots, metrics alone."""
    return Simulation(scenario, law, metrics, engine, smooth=smooth).metrics(gains, parameters, **how)


def rollout_histories(
    scenario: Scenario,
    gains: AnyGains | None = None,
    parameters: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    engine: str = DEFAULT_ENGINE,
    **how: Any,
) -> dict[str, np.ndarray]:
    """Return `Simulation.histories`, which says what `how` may be: a batch of robots, metrics and some histories."""
    return Simulation(scenario, law, metrics, engine).histories(gains, parameters, **how)


def rollout_jvp(
    scenario: Scenario,
    gains: AnyGains,
    directions: AnyGains,
    parameters: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    engine: str = DEFAULT_ENGINE,
    smooth: bool = False,
    **how: Any,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return `Simulation.jvp`, which says what `how` may be: metrics of a batch, and their tangents."""
    return Simulation(scenario, law, metrics, engine, smooth=smooth).jvp(gains, directions, parameters, **how)


def simulator(
    scenario: Scenario,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    engine: str = DEFAULT_ENGINE,
    smooth: bool = False,
) -> Callable[..., Metrics]:
    """Return `Simulation.simulate`, a pure function `f(gains=None, parameters=None) -> metrics`.

    Equal arguments give the same function, so that `jax.jit` compiles it once.
    """
    simulation = Simulation(scenario, law, metrics, engine, smooth=smooth)
    return simulation.simulate if is_traced(simulation.law) else _same(_ByValue(simulation)).simulate


class _ByValue:
    """A simulation as the key of a cache: equal to others of the same structure, scenario and law."""

    def __init__(self, simulation: Simulation) -> None:
        leaves, tree = jax.tree.flatten(simulation.law)
        arrays = [np.asarray(leaf) for leaf in leaves]
        values = tuple((array.shape, array.dtype.str, array.tobytes()) for array in arrays)
        self.simulation = simulation
        self.key = simulation.scenario, simulation.structure, tree, values

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByValue) and self.key == other.key


@functools.lru_cache(maxsize=64)
def _same(key: _ByValue) -> Simulation:
    return key.simulation


def metrics(trajectory: Trajectory, metrics: Iterable[Metric] = METRICS) -> dict[str, float | str | bool | None]:
    """Return the metrics of one walk, those of `mjx_climb.METRICS` or others, in their units.

    `detached_at` and `detached_limb` (a name) are None while all limbs hold, as is what is not defined. Where the state
    stopped being finite, `diverged`, the others are those of the walk until then.

    Raises:
        ValueError: two metrics of one name, or one that does not keep its shapes.
    """
    samples = Sample(**{name: getattr(trajectory, name) for name in Sample._fields})
    shape = structure(trajectory.scenario, DEFAULT_ENGINE, trajectory.parameters, metrics=metrics)
    found = execution.run_one(metrics_of_samples, shape, samples, trajectory.parameters)
    return named({name: found[name].item() for name in shape.metrics.names}, trajectory.limbs)
