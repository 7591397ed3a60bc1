"""The methods of a `Simulation` as functions, for notebooks and scripts."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from numpy.typing import DTypeLike

from mjx_climb import execution
from mjx_climb.control import Law
from mjx_climb.execution.batch_axes import axes_behind, is_traced, over_batch
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE, ENGINES, checked_engine
from mjx_climb.physics.state import Acceleration, Loads, State
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import Scenario
from mjx_climb.scenario.values import G
from mjx_climb.shapes import check_shape
from mjx_climb.simulation import Simulation
from mjx_climb.trajectory import Trajectory, named
from mjx_climb.walk.metrics import METRICS, Metric, MetricTable, start
from mjx_climb.walk.sample import DIMS, Sample
from mjx_climb.walk.structure import structure
from mjx_climb.walks import PART, Metrics, metrics_of_samples


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


def rollout_vjp(
    scenario: Scenario,
    gains: AnyGains,
    weights: Mapping[str, ArrayLike],
    parameters: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    **options: Any,
) -> dict[str, np.ndarray]:
    """Return `Simulation.vjp`: derivatives of weighted metrics by all gains; options as of `rollout_metrics`."""
    return _simulation(scenario, law, metrics, options).vjp(gains, weights, parameters, **options)


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


_SIMULATORS: dict[Any, Callable[..., Metrics]] = {}  # by scenario, structure and gains


def metrics(trajectory: Trajectory, metrics: Iterable[Metric] = METRICS) -> dict[str, float | str | bool | None]:
    """Return the metrics of one walk, those of `mjx_climb.METRICS` or others, in their units.

    `detached_at` and `detached_limb` (a name) are None while all limbs hold, as are undefined metrics. Where the state
    stopped being finite, `diverged`, the others are those of the walk until then.

    Raises:
        ValueError: two metrics of one name, or one that does not keep its shapes.
    """
    steps, parameters = len(trajectory.time), trajectory.parameters
    whole = {name: np.asarray(getattr(trajectory, name)) for name in DIMS}
    shape = structure(trajectory.scenario, DEFAULT_ENGINE, parameters, metrics=metrics)
    dtype = whole["base_position"].dtype
    running = _room(shape.metrics, dtype)
    how, found = (parameters, np.asarray(shape.time_step, dtype), np.asarray(steps, np.int32)), dict[str, np.ndarray]()
    for first in range(0, steps, PART):  # by one program for walks of any length
        part: dict[str, Any] = {name: _filled(values[first : first + PART]) for name, values in whole.items()}
        asked = shape._replace(steps=0, time_step=0.0), Sample(**part), *how, running
        running, found = execution.run_one(metrics_of_samples, *asked)
    return named({name: found[name].item() for name in shape.metrics.names}, trajectory.limbs)


@functools.lru_cache(maxsize=64)
def _room(metrics: MetricTable, dtype: np.dtype) -> Any:
    """Return zeros in place of running values: tracing for their shapes takes longer than a short walk's metrics."""
    with jax.enable_x64(dtype == np.float64):
        like = jax.eval_shape(lambda: start(metrics, dtype))
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), like)


def _filled(values: np.ndarray) -> np.ndarray:
    """Return the values of a part of a walk, and zeros behind them where it is a shorter one."""
    return np.concatenate([values, np.zeros((PART - len(values), *values.shape[1:]), values.dtype)])


STANDARD_GRAVITY = (0.0, 0.0, -G)


def forward_dynamics(
    state: State,
    tau: ArrayLike,
    foot_force: ArrayLike,
    base_wrench: ArrayLike,
    cargo_mass: ArrayLike,
    *,
    gravity: ArrayLike | tuple[float, float, float] = STANDARD_GRAVITY,
    robot: str | Robot = "hubrobo_v3_2",
    engine: str = DEFAULT_ENGINE,
) -> Acceleration:
    """Solve the equations of motion for the accelerations (paper Eq. 1).

    Arguments:
        state: with any leading batch axes, or none.
        tau: joint torques (..., joints) N m, forces N of sliding joints, limb after limb.
        foot_force: force of the ground on each foot (..., limbs, 3) N, world axes.
        base_wrench: force and moment on the base at its centre of mass (..., 6) N and N m, world axes.
        cargo_mass: point mass at the base's centre of mass (...,) kg.
        gravity: (..., 3) m/s^2, world axes.
        robot: name of a robot or its constants.
        engine: one of `mjx_climb.ENGINES`.

    Raises:
        ConfigError: no such engine.
        ValueError: a state or loads of another shape.
    """
    checked_engine(engine)
    robot = load_robot(robot) if isinstance(robot, str) else robot
    sizes, batch = {"limbs": len(robot.limbs), "joints": robot.joint_lower.size}, jnp.shape(state.base_position)[:-1]
    own = zip(vars(state), ("3", "4", "3", "3", "joints", "joints"), strict=True)
    dims = {f"state.{name}": (getattr(state, name), each) for name, each in own}
    dims |= {"tau": (tau, "joints"), "foot_force": (foot_force, "limbs 3"), "base_wrench": (base_wrench, "6")}
    for name, (value, each) in (dims | {"cargo_mass": (cargo_mass, ""), "gravity": (gravity, "3")}).items():
        check_shape(name, np.shape(value), each, sizes, batch)
    loads = Loads(*(jnp.asarray(load) for load in (tau, foot_force, base_wrench, cargo_mass, gravity)))
    return cast(Acceleration, _forward_dynamics(state, loads, robot, engine))


@functools.partial(jax.jit, static_argnames="engine")
def _forward_dynamics(state: State, loads: Loads, robot: Robot, engine: str) -> Acceleration:
    dtype, shape = jnp.result_type(state.base_position), jnp.shape(state.base_position)[:-1]
    joints = (len(robot.limbs), robot.joints)
    solve = ENGINES[engine](robot)

    def alone(state: State, loads: Loads) -> Acceleration:
        angles, rates = state.joint_angles.reshape(joints), state.joint_rates.reshape(joints)
        state = dataclasses.replace(state, joint_angles=angles, joint_rates=rates)
        result = solve(state, loads.joint_torque.reshape(joints), *loads[1:])
        return dataclasses.replace(result, joints=result.joints.ravel())

    given = jax.tree.map(lambda value: jnp.asarray(value, dtype), (state, loads))
    axes = axes_behind(state, shape), Loads._make((1, 2, 1, 0, 1))
    # XLA's default for float32 on a GPU is TF32, of ten bits
    with jax.default_matmul_precision("highest"):
        return over_batch(alone, given, axes, shape)
