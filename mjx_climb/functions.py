"""What a `Simulation` does, in one call or stepped by hand: names that notebooks and scripts begin with."""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from mjx_climb import execution
from mjx_climb.control import Law
from mjx_climb.execution.batch_axes import axes_behind, is_traced, over_batch
from mjx_climb.inputs.parameters import Parameters
from mjx_climb.inputs.resolve import AnyGains, checked_dtype
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.robot.constants import load_robot
from mjx_climb.scenario.model import Scenario
from mjx_climb.simulation import Simulation, SimulationState
from mjx_climb.trajectory import Trajectory, named
from mjx_climb.walk.control_loop import Action, JointTargets, checked_action
from mjx_climb.walk.metrics import METRICS, Metric
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.structure import structure
from mjx_climb.walks import Metrics, metrics_of_samples


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
    return _simulation(scenario, law, metrics, options).metrics(gains, parameters, **options)


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
    return _simulation(scenario, law, metrics, options).histories(gains, parameters, **options)


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
    return _simulation(scenario, law, metrics, options).jvp(gains, directions, parameters, **options)


def _simulation(scenario: Scenario, law: Law | None, metrics: Iterable[Metric], options: dict[str, Any]) -> Simulation:
    """Return a simulation with its own options, which leave the dictionary."""
    own = {name: options.pop(name) for name in ("engine", "smooth") if name in options}
    return Simulation(scenario, law, metrics, **own)


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
    leaves, tree = jax.tree.flatten(simulation.law)
    if is_traced(leaves):
        return simulation.simulate
    values = tuple((array.shape, array.dtype.str, array.tobytes()) for array in map(np.asarray, leaves))
    if len(_SIMULATORS) >= 64:
        del _SIMULATORS[next(iter(_SIMULATORS))]  # the oldest
    # JAX knows a function by the object: a bound method is another one each time it is looked up
    return _SIMULATORS.setdefault((scenario, simulation.structure, tree, values), simulation.simulate)


_SIMULATORS: dict[Any, Callable[..., Metrics]] = {}  # by what they simulate


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


class Environment:
    """A scenario's robots, to be stepped by hand under its law or another, or under actions of one's own.

    ```python
    env = mjx_climb.Environment(scenario)
    state = env.reset(gains, parameters)
    state, sample = env.step(state)
    ```

    `reset` and `step` are pure and compiled, for `jit`, `vmap`, `scan` and derivatives; made again from equal
    arguments, an environment is not compiled again. The walk is that of `mjx_climb.rollout`, and goes on where a
    rollout would end.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        law: Law | None = None,
        engine: str = DEFAULT_ENGINE,
        dtype: DTypeLike | None = None,
    ) -> None:
        """Prepare a `Simulation` of a precision; JAX's own setting where `dtype` is None.

        Raises:
            ConfigError, ValueError: as a `Simulation`, and a precision other than float32 and float64.
        """
        self.scenario = scenario
        self.simulation = Simulation(scenario, law, engine=engine)
        self.dtype: np.dtype = checked_dtype(jnp.result_type(float) if dtype is None else dtype)

    def reset(
        self, gains: AnyGains | None = None, parameters: Parameters | None = None, *, batch: int | tuple[int, ...] = ()
    ) -> SimulationState:
        """Return robots in the rest stance with all grippers shut, as `Simulation.reset` does one.

        Gains and parameters have any leading batch axes that broadcast; `batch` has further ones, where neither has
        them: `batch=(64,)`, or 64, for 64 equal robots.

        Raises:
            ValueError: as `Simulation.reset`, but for batch axes, and shapes that do not broadcast, or no robots.
        """
        sizes = tuple(batch) if isinstance(batch, Iterable) else (batch,)
        return self.simulation.start(gains, parameters, self.dtype, sizes)

    def step(
        self, state: SimulationState, action: Action = None, gains: AnyGains | None = None
    ) -> tuple[SimulationState, Sample]:
        """Return what `Simulation.step` does, of all robots: a sample has their batch axes in place of time.

        An action, and gains from this step on as `Simulation.with_gains` takes them, `kp` and `kd` too, are for all
        robots or have the batch axes of the state.

        Raises:
            ValueError: gains as of `reset`, or for more robots than there are; an action of another shape.
        """
        if gains is not None:
            state = self.simulation.with_gains(state, gains)
        shape = state.step.shape
        acting = checked_action(action, load_robot(self.scenario.robot), self.dtype, shape)
        axes = (axes_behind(state, shape), jax.tree.map(lambda _: 2 if isinstance(action, JointTargets) else 1, acting))
        after: tuple[SimulationState, Sample] = over_batch(self.simulation.step, (state, acting), axes, shape)
        return after
