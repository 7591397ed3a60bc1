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
    **options: Any,
) -> dict[str, np.ndarray]:
    """Return `Simulation.metrics`: a batch of robots, metrics alone.

    Options are `engine` and `smooth` of a `Simulation`, and those of its method.
    """
    simulation, how = _simulation(scenario, law, metrics, options)
    return simulation.metrics(gains, parameters, **how)


def rollout_histories(
    scenario: Scenario,
    gains: AnyGains | None = None,
    parameters: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    **options: Any,
) -> dict[str, np.ndarray]:
    """Return `Simulation.histories`: metrics and some histories of a batch; options as of `rollout_metrics`."""
    simulation, how = _simulation(scenario, law, metrics, options)
    return simulation.histories(gains, parameters, **how)


def rollout_jvp(
    scenario: Scenario,
    gains: AnyGains,
    directions: AnyGains,
    parameters: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    **options: Any,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return `Simulation.jvp`: metrics of a batch, and their tangents; options as of `rollout_metrics`."""
    simulation, how = _simulation(scenario, law, metrics, options)
    return simulation.jvp(gains, directions, parameters, **how)


def _simulation(
    scenario: Scenario, law: Law | None, metrics: Iterable[Metric], options: dict[str, Any]
) -> tuple[Simulation, dict[str, Any]]:
    """Return a simulation, and the options that are its method's."""
    of = {name: options.pop(name) for name in ("engine", "smooth") if name in options}
    return Simulation(scenario, law, metrics, **of), options


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
