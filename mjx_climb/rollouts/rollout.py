"""Rollouts: one robot with full histories, or a batch with its metrics alone; jit-compiled once per shape."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Sharding
from jax.typing import ArrayLike
from numpy.typing import DTypeLike

from mjx_climb.compilation import devices
from mjx_climb.compilation.cpu_pieces import in_kernels
from mjx_climb.compilation.first_possible import first_possible
from mjx_climb.compilation.gpu_kernel import over_robots
from mjx_climb.compilation.options import compiler_options, enable_cache, kernel_pays, pieces_pay
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.quantities.parameters import Gains, Parameters, batch_last, batch_shape, parameters
from mjx_climb.quantities.parameters import gains as gains_of
from mjx_climb.robot.constants import load_robot
from mjx_climb.rollouts.trajectory import Trajectory, from_samples, to_samples
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.metrics import METRICS, Context, Metric, MetricTable, running
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.step import Carry, Structure, advance, begin, prepare, structure, weighing

Metrics = dict[str, Array]
Progress = tuple[Carry, running.Running]
Tree = TypeVar("Tree", bound=Gains | Parameters)


def _floating_dtype(tree: Gains) -> jnp.dtype:
    """Return the precision of a tree's arrays, or the one in force where it holds plain numbers alone."""
    arrays = [leaf for leaf in jax.tree.leaves(tree) if hasattr(leaf, "dtype")]
    floats = [leaf for leaf in arrays if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.result_type(*floats) if floats else jnp.result_type(float)


def metrics_of(structure: Structure, gains: Gains, numbers: Parameters) -> Metrics:
    """Walk a batch and return its metrics, with the batch axes that gains and parameters broadcast to."""
    return walk_recorded(structure, gains, numbers, lambda sample: ())[0]


def walk_recorded(
    structure: Structure, gains: Gains, numbers: Parameters, record: Callable[[Sample], Any]
) -> tuple[Metrics, Any]:
    """Walk a batch and return its metrics, and what `record` keeps of each sample, stacked over time."""
    shape, dtype = batch_shape(gains, numbers), _floating_dtype(gains)
    batch = math.prod(shape)
    walk = prepare(structure, *batch_last(gains, numbers, shape, dtype))
    metrics = structure.metrics
    context = Context(walk.robot, walk.numbers.gravity, walk.numbers.heading, walk.time_step)

    def step(carry: Progress, _: None) -> tuple[Progress, Any]:
        walked, values = carry
        walked, sample = advance(walk, walked, values.steps)
        return (walked, running.accumulate(metrics, values, sample, context)), record(sample)

    start = (begin(walk, batch), running.start(metrics, batch, dtype))
    step = in_kernels(step) if structure.in_pieces else step
    (_, values), records = jax.lax.scan(step, start, length=structure.steps)
    result = running.finish(metrics, values, context)
    return {name: value.reshape(shape) for name, value in result.items()}, records


def _samples_of(structure: Structure, gains: Gains, numbers: Parameters) -> Sample:
    """Walk one robot and return every sample, stacked over time."""
    walk = prepare(structure, *batch_last(gains, numbers, (), _floating_dtype(gains)))
    step: Callable[[Carry, Array], tuple[Carry, Sample]] = functools.partial(advance, walk)
    step = in_kernels(step) if structure.in_pieces else step
    return jax.lax.scan(step, begin(walk, 1), jnp.arange(structure.steps))[1]


@functools.cache
def _compiled_samples(in_pieces: bool) -> Callable[..., Sample]:
    return jax.jit(_samples_of, static_argnums=0, compiler_options=compiler_options(1, in_pieces=in_pieces))


@functools.cache
def _compiled_metrics(batch: int, in_pieces: bool) -> Callable[..., Metrics]:
    return jax.jit(metrics_of, static_argnums=0, compiler_options=compiler_options(batch, in_pieces=in_pieces))


def _metrics_in_kernel(structure: Structure, gains: Gains, numbers: Parameters) -> Metrics:
    """Walk robots of one batch axis as `metrics_of` does, as a single GPU kernel."""
    return over_robots(functools.partial(metrics_of, structure), [_varying(gains), _varying(numbers)])(gains, numbers)


@functools.cache
def _compiled_kernel(batch: int) -> Callable[..., Metrics]:
    kernel = jax.jit(_metrics_in_kernel, static_argnums=0)
    return first_possible(kernel, functools.partial(_compiled_metrics, batch, False), "the GPU kernel")


def simulator(
    scenario: Scenario,
    *,
    metrics: Iterable[Metric] = METRICS,
    engine: str = DEFAULT_ENGINE,
    smooth: bool = False,
    in_pieces: bool = False,
) -> Callable[..., Metrics]:
    """Return a pure function `f(gains, parameters=None) -> metrics` for `jit`, `vmap`, `jvp` and `jacfwd`.

    Arguments:
        scenario: what walks where; its control gains are not used, its other numbers are the default parameters.
        metrics: what the walk is judged by, as `mjx_climb.METRICS + (mine,)`.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        smooth: for searches: no gripper is torn off, whatever the force (`peak_pull_force` tells), and the metrics have
            smooth companions, see `mjx_climb.walk.metrics.extremes`.
        in_pieces: several times faster on a CPU (see `mjx_climb.pieces_pay`), for values and forward derivatives alone:
            XLA stops the process at some other transformations of such a program.

    Returns:
        A function of `Gains` (and `Parameters`) with any leading batch axes, in the precision of the gains. It gives a
        dict of arrays with those batch axes, named and in units as the metrics say. A batch axis in the gains is
        faster than `vmap`: it stays contiguous. NaN stands for what is not defined: `detached_at` while all limbs
        hold (`detached_limb` is then -1, else the index of the limb). Where the state stopped being finite, `diverged`,
        the others are those of the walk until then.

    Raises:
        ValueError: two metrics of one name, or, when it walks, one that does not keep its shapes.
    """
    shape = structure(scenario, engine, metrics=metrics, smooth=smooth, in_pieces=in_pieces)

    def simulate(gains: Gains, numbers: Parameters | None = None) -> Metrics:
        dtype = _floating_dtype(gains)
        gains = jax.tree.map(lambda value: jnp.asarray(value, dtype), gains)
        return metrics_of(shape, gains, parameters(scenario, dtype) if numbers is None else numbers)

    return simulate


def _cast(tree: Tree, dtype: DTypeLike) -> Tree:
    cast: Tree = jax.tree.map(lambda value: np.asarray(value, dtype), tree)
    return cast


def rollout(
    scenario: Scenario,
    gains: Gains | None = None,
    numbers: Parameters | None = None,
    *,
    dtype: DTypeLike = np.float64,
    engine: str = DEFAULT_ENGINE,
) -> Trajectory:
    """Walk one robot through a scenario and return the full time histories.

    Arguments:
        scenario: what walks where, under which controller and disturbance.
        gains: of the admittance law; the scenario's own where None.
        numbers: parameters in place of the scenario's, unbatched.
        dtype: precision of the simulation; float64 needs no setting of JAX's.
        engine: the dynamics, one of `mjx_climb.ENGINES`.

    Raises:
        ValueError: batched gains or parameters (see `rollout_metrics`).
    """
    gains, numbers = given(scenario, gains, numbers, dtype)
    if batch_shape(gains, numbers) != ():
        raise ValueError("rollout walks one robot: for a batch of gains or parameters use rollout_metrics")
    enable_cache()
    in_pieces = pieces_pay(engine)
    with jax.enable_x64(np.dtype(dtype) == np.float64):
        samples = _compiled_samples(in_pieces)(structure(scenario, engine, in_pieces=in_pieces), gains, numbers)
        samples = jax.tree.map(np.asarray, samples)
    return from_samples(samples, scenario, gains, numbers, load_robot(scenario.robot).limbs)


def _six(gain: ArrayLike) -> np.ndarray:
    """Return a gain with its axis of six, so that scalar gains need no program of their own."""
    value = np.atleast_1d(gain)
    return np.broadcast_to(value, (*value.shape[:-1], 6))


def given(
    scenario: Scenario, gains: Gains | None, numbers: Parameters | None, dtype: DTypeLike
) -> tuple[Gains, Parameters]:
    """Return gains and parameters as numpy arrays, the scenario's own where None is given."""
    with jax.enable_x64(True):
        gains = gains_of(scenario) if gains is None else gains
        numbers = parameters(scenario) if numbers is None else numbers
        six = {name: _six(getattr(gains, name)) for name in Gains.AXES}
        return _cast(dataclasses.replace(gains, **six), dtype), _cast(numbers, dtype)


def metrics(trajectory: Trajectory, metrics: Iterable[Metric] = METRICS) -> dict[str, float | str | bool | None]:
    """Return the metrics of one walk, those of `mjx_climb.METRICS` or others, in their units.

    `detached_at` and `detached_limb` (a name) are None while all limbs hold, as is what is not defined. Where the state
    stopped being finite, `diverged`, the others are those of the walk until then.

    Raises:
        ValueError: two metrics of one name, or one that does not keep its shapes.
    """
    robot, numbers = load_robot(trajectory.scenario.robot), trajectory.numbers
    samples = to_samples(trajectory)
    dtype = samples.base_position.dtype
    with jax.enable_x64(dtype == np.float64):
        robot = jax.tree.map(lambda value: jnp.asarray(value, dtype), robot)
        gravity, heading = jnp.asarray(numbers.gravity, dtype)[:, None], jnp.asarray(numbers.heading, dtype)[None]
        context = Context(
            weighing(robot, jnp.asarray(numbers.mass_scale, dtype)[None]),
            gravity,
            heading,
            trajectory.scenario.time_step,
        )
        found = _accumulated(MetricTable(metrics), samples, context)
        values = {name: value.item() for name, value in found.items()}
    return named(values, trajectory.limbs)


@functools.partial(jax.jit, static_argnums=0)
def _accumulated(metrics: MetricTable, samples: Sample, context: Context) -> Metrics:
    def step(values: running.Running, sample: Sample) -> tuple[running.Running, None]:
        return running.accumulate(metrics, values, sample, context), None

    values = running.start(metrics, 1, samples.base_position.dtype)
    return running.finish(metrics, jax.lax.scan(step, values, samples)[0], context)


def named(values: Mapping[str, Any], limbs: tuple[str, ...]) -> dict[str, float | str | bool | None]:
    """Return scalar metrics with None for what is not defined and the limb by name: what goes into JSON."""
    result = {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}
    if "detached_limb" in values:
        result["detached_limb"] = limbs[values["detached_limb"]] if values["detached_limb"] >= 0 else None
    return result


def rollout_metrics(
    scenario: Scenario,
    gains: Gains | None = None,
    numbers: Parameters | None = None,
    *,
    metrics: Iterable[Metric] = METRICS,
    dtype: DTypeLike = np.float32,
    batch_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    engine: str = DEFAULT_ENGINE,
    smooth: bool = False,
) -> dict[str, np.ndarray]:
    """Walk a batch of robots on all devices and return their metrics; memory does not grow with time.

    Arguments:
        scenario: what walks where.
        gains: with leading batch axes, `Gains(damping=(..., 6), ...)`; the scenario's own where None.
        numbers: parameters with leading batch axes that broadcast with the gains'.
        metrics: what the walks are judged by, as `mjx_climb.METRICS + (mine,)`.
        dtype: precision of the simulation.
        batch_size: at most so many robots in one call of the compiled program, one call at a time on a GPU and one on
            each core of a CPU.
        progress: called with the number of robots that have walked and the number in all, after each call.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        smooth: for searches, see `simulator`.

    Returns:
        Arrays with the batch axes of gains and parameters, by the names of the metrics; NaN and -1 as `simulator` says.
    """
    inputs = given(scenario, gains, numbers, dtype)
    walk = structure(scenario, engine, metrics=metrics, smooth=smooth, in_pieces=pieces_pay(engine))
    in_kernel = kernel_pays(engine, dtype)

    def program(robots: int) -> Callable[..., Metrics]:
        return _compiled_kernel(robots) if in_kernel else _compiled_metrics(robots, walk.in_pieces)

    return walk_batch(program, walk, inputs, batch_shape(*inputs), batch_size, progress)


def walk_batch(
    compiled: Callable[[int], Callable[..., Metrics]],
    structure: Structure,
    inputs: tuple[Gains, *tuple[Gains | Parameters, ...]],
    shape: tuple[int, ...],
    batch_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, np.ndarray]:
    """Return what a batched program gives for a batch, walked in parts on all devices; see `rollout_metrics`.

    `compiled` gives the program for so many robots. It takes the structure and the inputs,
    trees of arrays whose batch axes broadcast to `shape`, with one batch axis instead, and returns a dict of arrays
    with the batch as their first axis.
    """
    count = math.prod(shape)
    share = devices.share_size(count, batch_size)
    gains, *others = inputs
    flat, flat_others = _flattened(gains, shape), [_flattened(tree, shape) for tree in others]
    double = any(leaf.dtype == np.float64 for leaf in jax.tree.leaves(inputs))
    enable_cache()
    walked = functools.partial(compiled(share), structure)

    def walk(rows: np.ndarray, sharding: Sharding) -> Metrics:
        some = _rows(flat, rows)
        stiffness = np.broadcast_to(some.stiffness, (share, *np.shape(some.stiffness)[-1:]))  # batched, come what may
        some = dataclasses.replace(some, stiffness=stiffness)
        with jax.enable_x64(double):  # holds for one thread
            return walked(*jax.device_put((some, *(_rows(tree, rows) for tree in flat_others)), sharding))

    result = devices.spread(walk, count, share, progress)
    return {name: value.reshape((*shape, *value.shape[1:])) for name, value in result.items()}


def _flattened(tree: Tree, shape: tuple[int, ...]) -> Tree:
    """Return gains or parameters with one batch axis wherever they vary, before each value's own axes."""
    robots = math.prod(shape)
    changes: dict[str, Any] = {}
    for name, value in vars(tree).items():
        if value is None:
            continue
        split = value.ndim - tree.AXES.get(name, 0)
        tail = value.shape[split:]
        count = math.prod(value.shape[:split])
        changes[name] = (
            np.broadcast_to(value, (*shape, *tail)).reshape(robots, *tail) if count > 1 else value.reshape(tail)
        )
    return dataclasses.replace(tree, **changes)


def _rows(tree: Tree, rows: np.ndarray) -> Tree:
    """Return some environments of a flattened tree."""
    varying: dict[str, Any] = {
        n: v[rows] for n, v in vars(tree).items() if v is not None and v.ndim > tree.AXES.get(n, 0)
    }
    return dataclasses.replace(tree, **varying)


def _varying(tree: Tree) -> Tree:
    """Return in place of each value of a flattened tree whether it varies from robot to robot."""
    varying: dict[str, Any] = {n: jnp.ndim(v) > tree.AXES.get(n, 0) for n, v in vars(tree).items() if v is not None}
    return dataclasses.replace(tree, **varying)
